"""Alerts, and the rules by which users are notified of them.

Revision ID: 0003
Revises: 0002
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "alert",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("robot_id", sa.Integer(), nullable=False),
        sa.Column("kind", sa.String(length=63), nullable=False),
        sa.Column("about", sa.String(length=255), nullable=False),
        sa.Column("level", sa.String(length=16), nullable=False),
        sa.Column("text", sa.Text(), nullable=False),
        sa.Column("first_at", sa.Double(), nullable=False),
        sa.Column("last_at", sa.Double(), nullable=False),
        sa.Column("times", sa.Integer(), nullable=False),
        sa.Column("news", sa.Integer(), nullable=False),
        sa.Column("over_at", sa.Double(), nullable=True),
        sa.Column("ack_by", sa.String(length=255), nullable=True),
        sa.Column("ack_at", sa.Double(), nullable=True),
        sa.CheckConstraint("level IN ('info', 'warning', 'error')", name=op.f("ck_alert_level")),
        sa.ForeignKeyConstraint(
            ["robot_id"], ["robot.id"], name=op.f("fk_alert_robot_id_robot"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_alert")),
    )
    op.create_index(op.f("ix_alert_robot_id"), "alert", ["robot_id", "last_at"])
    op.create_index(op.f("ix_alert_last_at"), "alert", ["last_at"])
    op.create_index(op.f("ix_alert_over_at"), "alert", ["over_at"])
    op.create_table(
        "alert_rule",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("user_id", sa.Integer(), nullable=False),
        sa.Column("label", sa.String(length=255), nullable=False),
        sa.Column("robots", sa.String(length=255), nullable=False),
        sa.Column("kinds", sa.Text(), nullable=False),
        sa.Column("level", sa.String(length=16), nullable=False),
        sa.Column("channel", sa.String(length=16), nullable=False),
        sa.Column("url", sa.Text(), nullable=False),
        sa.Column("secret", sa.String(length=255), nullable=False),
        sa.Column("over", sa.Boolean(), nullable=False),
        sa.Column("group_s", sa.Double(), nullable=False),
        sa.Column("quiet", sa.Text(), nullable=True),
        sa.Column("created", sa.Double(), nullable=False),
        sa.CheckConstraint(
            "channel IN ('portal', 'webhook', 'apprise')", name=op.f("ck_alert_rule_channel")
        ),
        sa.CheckConstraint("level IN ('info', 'warning', 'error')", name=op.f("ck_alert_rule_level")),
        sa.ForeignKeyConstraint(
            ["user_id"],
            ["user_account.id"],
            name=op.f("fk_alert_rule_user_id_user_account"),
            ondelete="CASCADE",
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_alert_rule")),
        sqlite_autoincrement=True,
    )
    op.create_index(op.f("ix_alert_rule_user_id"), "alert_rule", ["user_id"])


def downgrade() -> None:
    op.drop_table("alert_rule")
    op.drop_table("alert")
