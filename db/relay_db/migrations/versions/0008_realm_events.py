"""How long events of each realm are stored.

Revision ID: 0008
Revises: 0007
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0008"
down_revision = "0007"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("realm", sa.Column("events_days", sa.Double(), nullable=True))


def downgrade() -> None:
    with op.batch_alter_table("realm") as batch:
        batch.drop_column("events_days")
