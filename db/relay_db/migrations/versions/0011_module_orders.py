"""Orders to modules of robots that are offline.

Revision ID: 0011
Revises: 0010
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "module_order",
        sa.Column("robot_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("module", sa.String(length=63), nullable=False),
        sa.Column("start", sa.Boolean(), nullable=False),
        sa.Column("user_id", sa.Integer(), nullable=True),
        sa.Column("by", sa.String(length=255), nullable=False),
        sa.Column("at", sa.Double(), nullable=False),
        sa.ForeignKeyConstraint(
            ["robot_id"], ["robot.id"], name=op.f("fk_module_order_robot_id_robot"), ondelete="CASCADE"
        ),
        sa.ForeignKeyConstraint(
            ["user_id"],
            ["user_account.id"],
            name=op.f("fk_module_order_user_id_user_account"),
            ondelete="CASCADE",
        ),
        sa.PrimaryKeyConstraint("robot_id", "module", name=op.f("pk_module_order")),
    )
    op.create_index(op.f("ix_module_order_user_id"), "module_order", ["user_id"], unique=False)


def downgrade() -> None:
    op.drop_table("module_order")
