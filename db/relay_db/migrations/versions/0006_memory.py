"""Stored events (table ``memory``) by source, kind, robot and user, numbered within each realm.

Revision ID: 0006
Revises: 0005
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None

INDICES = {
    "ix_memory_at": ("at",),
    "ix_memory_source": ("source", "at"),
    "ix_memory_kind": ("kind", "at"),
    "ix_memory_user": ("user_name", "at"),
    "ix_memory_robot": ("robot_id", "at"),
}
"""Each index begins with the realm and ends with the number."""


def upgrade() -> None:
    op.create_table(
        "memory",
        sa.Column("realm_id", sa.Integer(), nullable=False),
        sa.Column("number", sa.BigInteger(), nullable=False),
        sa.Column("at", sa.Double(), nullable=False),
        sa.Column("source", sa.String(length=128), nullable=False),
        sa.Column("kind", sa.String(length=63), nullable=False),
        sa.Column("robot_id", sa.Integer(), nullable=True),
        sa.Column("user_name", sa.String(length=63), nullable=True),
        sa.Column("data", sa.Text(), nullable=False),
        sa.Column("used", sa.Integer(), nullable=False),
        sa.CheckConstraint("kind <> ''", name=op.f("ck_memory_kind")),
        _of_realm("memory"),
        sa.PrimaryKeyConstraint("realm_id", "number", name=op.f("pk_memory")),
    )
    for name, columns in INDICES.items():
        op.create_index(op.f(name), "memory", ["realm_id", *columns, "number"])
    op.create_table(
        "memory_count",
        sa.Column("realm_id", sa.Integer(), nullable=False),
        sa.Column("last", sa.BigInteger(), nullable=False),
        _of_realm("memory_count"),
        sa.PrimaryKeyConstraint("realm_id", name=op.f("pk_memory_count")),
    )


def downgrade() -> None:
    op.drop_table("memory_count")
    op.drop_table("memory")


def _of_realm(table: str) -> sa.ForeignKeyConstraint:
    name = op.f(f"fk_{table}_realm_id_realm")
    return sa.ForeignKeyConstraint(["realm_id"], ["realm.id"], name=name, ondelete="RESTRICT")
