"""The latest report of each robot's modules, and why a robot refused an order that was pending.

Revision ID: 0024
Revises: 0023
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0024"
down_revision = "0023"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "module_report",
        sa.Column("robot_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("at", sa.Double(), nullable=False),
        sa.Column("modules", sa.Text(), nullable=False),
        sa.ForeignKeyConstraint(
            ["robot_id"], ["robot.id"], name=op.f("fk_module_report_robot_id_robot"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("robot_id", name=op.f("pk_module_report")),
    )
    op.add_column("module_order", sa.Column("refused_at", sa.Double(), nullable=True))
    op.add_column(
        "module_order", sa.Column("refusal", sa.Text(), server_default=sa.text("''"), nullable=False)
    )


def downgrade() -> None:
    op.execute(sa.text("DELETE FROM module_order WHERE refused_at IS NOT NULL"))
    with op.batch_alter_table("module_order") as batch:
        batch.drop_column("refusal")
        batch.drop_column("refused_at")
    op.drop_table("module_report")
