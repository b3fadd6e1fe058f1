"""The service registry: services and applications with addresses and leases.

Revision ID: 0007
Revises: 0006
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None

TABLE = "directory_entry"

INDICES = {
    "realm_id": ("realm_id", "kind", "name"),
    "user_id": ("user_id",),
    "robot_id": ("robot_id",),
    "expires": ("expires",),
}
"""Columns of the indexes, by the end of their names."""


def upgrade() -> None:
    op.create_table(
        TABLE,
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("realm_id", sa.Integer(), nullable=False),
        sa.Column("user_id", sa.Integer(), nullable=False),
        sa.Column("robot_id", sa.Integer(), nullable=True),
        sa.Column("kind", sa.String(length=63), nullable=False),
        sa.Column("name", sa.String(length=128), nullable=False),
        sa.Column("address", sa.Text(), nullable=False),
        sa.Column("description", sa.String(length=255), nullable=False),
        sa.Column("data", sa.Text(), nullable=False),
        sa.Column("ttl", sa.Double(), nullable=False),
        sa.Column("registered", sa.Double(), nullable=False),
        sa.Column("expires", sa.Double(), nullable=False),
        sa.CheckConstraint("kind <> ''", name=op.f(f"ck_{TABLE}_kind")),
        sa.CheckConstraint("ttl > 0", name=op.f(f"ck_{TABLE}_ttl")),
        _reference("realm_id", "realm", "RESTRICT"),
        _reference("user_id", "user_account", "CASCADE"),
        _reference("robot_id", "robot", "CASCADE"),
        sa.PrimaryKeyConstraint("id", name=op.f(f"pk_{TABLE}")),
    )
    for end, columns in INDICES.items():
        op.create_index(op.f(f"ix_{TABLE}_{end}"), TABLE, list(columns))


def downgrade() -> None:
    op.drop_table(TABLE)


def _reference(column: str, table: str, ondelete: str) -> sa.ForeignKeyConstraint:
    name = op.f(f"fk_{TABLE}_{column}_{table}")
    return sa.ForeignKeyConstraint([column], [f"{table}.id"], name=name, ondelete=ondelete)
