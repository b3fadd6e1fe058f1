"""Files of robots.

Revision ID: 0018
Revises: 0017
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0018"
down_revision = "0017"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "stored_file",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("robot_id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=1024), nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("size", sa.BigInteger(), nullable=False),
        sa.Column("state", sa.String(length=8), nullable=False),
        sa.Column("origin", sa.String(length=255), nullable=False),
        sa.Column("modified", sa.Double(), nullable=False),
        sa.Column("changed", sa.Double(), nullable=False),
        sa.CheckConstraint("size >= 0", name=op.f("ck_stored_file_size")),
        sa.CheckConstraint(
            "state IN ('incoming', 'stored', 'removing')", name=op.f("ck_stored_file_state")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_stored_file")),
        sa.UniqueConstraint("robot_id", "name", "sha256", name=op.f("uq_stored_file_robot_id_name_sha256")),
        sqlite_autoincrement=True,
    )
    op.create_index(op.f("ix_stored_file_state"), "stored_file", ["state", "changed"], unique=False)
    op.create_table(
        "file_usage",
        sa.Column("robot_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("realm_id", sa.Integer(), nullable=False),
        sa.Column("files", sa.Integer(), nullable=False),
        sa.Column("bytes", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("robot_id", name=op.f("pk_file_usage")),
    )
    op.create_index(op.f("ix_file_usage_realm_id"), "file_usage", ["realm_id"], unique=False)


def downgrade() -> None:
    op.drop_table("file_usage")
    op.drop_table("stored_file")
