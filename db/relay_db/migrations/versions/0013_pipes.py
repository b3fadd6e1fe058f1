"""Pipes.

Revision ID: 0013
Revises: 0012
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0013"
down_revision = "0012"
branch_labels = None
depends_on = None

_OWNERS = {
    "owner_id": "user_account",
    "source_robot_id": "robot",
    "source_account_id": "user_account",
    "target_robot_id": "robot",
    "target_account_id": "user_account",
}


def _belongs(column: str, table: str) -> sa.ForeignKeyConstraint:
    name = op.f(f"fk_pipe_{column}_{table}")
    return sa.ForeignKeyConstraint([column], [f"{table}.id"], name=name, ondelete="CASCADE")


def upgrade() -> None:
    op.create_table(
        "pipe",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("realm_id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=63), nullable=False),
        *(sa.Column(column, sa.Integer(), nullable=False) for column in _OWNERS),
        sa.Column("settings", sa.Text(), nullable=False),
        sa.Column("enabled", sa.Boolean(), nullable=False),
        sa.Column("moves", sa.Boolean(), nullable=False),
        sa.Column("reason", sa.String(length=255), nullable=False),
        _belongs("realm_id", "realm"),
        *(_belongs(column, table) for column, table in _OWNERS.items()),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_pipe")),
        sa.UniqueConstraint("realm_id", "name", name=op.f("uq_pipe_realm_id_name")),
        sqlite_autoincrement=True,
    )
    for column in _OWNERS:
        op.create_index(op.f(f"ix_pipe_{column}"), "pipe", [column], unique=False)


def downgrade() -> None:
    op.drop_table("pipe")
