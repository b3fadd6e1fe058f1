"""Ids of orders to stop, by which a stop that arrives by several paths is one stop.

Revision ID: 0012
Revises: 0011
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0012"
down_revision = "0011"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("stop_order", sa.Column("stop_id", sa.String(length=64), server_default=sa.text("''"), nullable=False))


def downgrade() -> None:
    with op.batch_alter_table("stop_order") as batch:
        batch.drop_column("stop_id")
