"""Groups of robots, to which one order can be given.

Revision ID: 0004
Revises: 0003
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "robot_group",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("realm_id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=63), nullable=False),
        sa.ForeignKeyConstraint(
            ["realm_id"], ["realm.id"], name=op.f("fk_robot_group_realm_id_realm"), ondelete="RESTRICT"
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_robot_group")),
        sa.UniqueConstraint("realm_id", "name", name=op.f("uq_robot_group_realm_id_name")),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "robot_membership",
        sa.Column("group_id", sa.Integer(), nullable=False),
        sa.Column("robot_id", sa.Integer(), nullable=False),
        sa.ForeignKeyConstraint(
            ["group_id"],
            ["robot_group.id"],
            name=op.f("fk_robot_membership_group_id_robot_group"),
            ondelete="CASCADE",
        ),
        sa.ForeignKeyConstraint(
            ["robot_id"], ["robot.id"], name=op.f("fk_robot_membership_robot_id_robot"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("group_id", "robot_id", name=op.f("pk_robot_membership")),
    )
    op.create_index(op.f("ix_robot_membership_robot_id"), "robot_membership", ["robot_id"])


def downgrade() -> None:
    op.drop_table("robot_membership")
    op.drop_table("robot_group")
