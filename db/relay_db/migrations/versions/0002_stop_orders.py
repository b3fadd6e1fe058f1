"""Orders to stop that robots have not confirmed yet.

Revision ID: 0002
Revises: 0001
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "stop_order",
        sa.Column("robot_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("by", sa.String(length=255), nullable=False),
        sa.Column("why", sa.Text(), nullable=False),
        sa.Column("at", sa.Double(), nullable=False),
        sa.ForeignKeyConstraint(
            ["robot_id"], ["robot.id"], name=op.f("fk_stop_order_robot_id_robot"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("robot_id", name=op.f("pk_stop_order")),
    )


def downgrade() -> None:
    op.drop_table("stop_order")
