"""Robots and users that belong to several realms.

Revision ID: 0009
Revises: 0008
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "robot_realm",
        sa.Column("robot_id", sa.Integer(), nullable=False),
        sa.Column("realm_id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=63), nullable=False),
        sa.ForeignKeyConstraint(
            ["robot_id"], ["robot.id"], name=op.f("fk_robot_realm_robot_id_robot"), ondelete="CASCADE"
        ),
        sa.ForeignKeyConstraint(
            ["realm_id"], ["realm.id"], name=op.f("fk_robot_realm_realm_id_realm"), ondelete="RESTRICT"
        ),
        sa.PrimaryKeyConstraint("robot_id", "realm_id", name=op.f("pk_robot_realm")),
        sa.UniqueConstraint("realm_id", "name", name=op.f("uq_robot_realm_realm_id_name")),
    )
    op.execute("INSERT INTO robot_realm (robot_id, realm_id, name) SELECT id, realm_id, name FROM robot")
    op.create_table(
        "guest_account",
        sa.Column("user_id", sa.Integer(), nullable=False),
        sa.Column("home_id", sa.Integer(), nullable=False),
        sa.ForeignKeyConstraint(
            ["user_id"],
            ["user_account.id"],
            name=op.f("fk_guest_account_user_id_user_account"),
            ondelete="CASCADE",
        ),
        sa.ForeignKeyConstraint(
            ["home_id"],
            ["user_account.id"],
            name=op.f("fk_guest_account_home_id_user_account"),
            ondelete="CASCADE",
        ),
        sa.PrimaryKeyConstraint("user_id", name=op.f("pk_guest_account")),
    )
    op.create_index(op.f("ix_guest_account_home_id"), "guest_account", ["home_id"])


def downgrade() -> None:
    # Without the links it is unknown whether these accounts are disabled, and whose password they have.
    op.execute("DELETE FROM user_account WHERE id IN (SELECT user_id FROM guest_account)")
    other = (
        "DELETE FROM robot_right WHERE coalesce("
        "(SELECT realm_id FROM user_account WHERE id = robot_right.user_id), "
        "(SELECT realm_id FROM user_group WHERE id = robot_right.group_id)) "
        "<> (SELECT realm_id FROM robot WHERE id = robot_right.robot_id)"
    )
    op.execute(other)
    # Groups and entries from the time of sharing must not name a robot of another realm.
    home = "(SELECT realm_id FROM robot WHERE id = robot_id)"
    op.execute(
        f"DELETE FROM robot_membership WHERE (SELECT realm_id FROM robot_group WHERE id = group_id) <> {home}"
    )
    op.execute(f"DELETE FROM directory_entry WHERE robot_id IS NOT NULL AND realm_id <> {home}")
    op.drop_table("guest_account")
    op.drop_table("robot_realm")
