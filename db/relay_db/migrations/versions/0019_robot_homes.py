"""The relay of a cluster that each robot is connected to.

Revision ID: 0019
Revises: 0018
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0019"
down_revision = "0018"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "robot_home",
        sa.Column("robot_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("relay", sa.String(length=64), nullable=False),
        sa.Column("epoch", sa.Integer(), nullable=False),
        sa.ForeignKeyConstraint(
            ["robot_id"], ["robot.id"], name=op.f("fk_robot_home_robot_id_robot"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("robot_id", name=op.f("pk_robot_home")),
    )


def downgrade() -> None:
    op.drop_table("robot_home")
