"""Jobs of functions.

Revision ID: 0016
Revises: 0015
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0016"
down_revision = "0015"
branch_labels = None
depends_on = None

_OWNERS = {"realm_id": "realm", "user_id": "user_account", "robot_id": "robot", "payer_id": "robot"}


def _belongs(column: str, table: str) -> sa.ForeignKeyConstraint:
    name = op.f(f"fk_function_job_{column}_{table}")
    return sa.ForeignKeyConstraint([column], [f"{table}.id"], name=name, ondelete="CASCADE")


def upgrade() -> None:
    op.create_table(
        "function_job",
        sa.Column("id", sa.String(length=32), nullable=False),
        *(sa.Column(column, sa.Integer(), nullable=column != "realm_id") for column in _OWNERS),
        sa.Column("key", sa.String(length=255), nullable=True),
        sa.Column("digest", sa.String(length=64), nullable=False),
        sa.Column("function", sa.String(length=63), nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("code", sa.String(length=32), nullable=False),
        sa.Column("error", sa.Text(), nullable=False),
        sa.Column("arguments", sa.LargeBinary(), nullable=False),
        sa.Column("result", sa.LargeBinary(), nullable=True),
        sa.Column("result_bytes", sa.Integer(), nullable=False),
        sa.Column("created", sa.Double(), nullable=False),
        sa.Column("started", sa.Double(), nullable=True),
        sa.Column("ended", sa.Double(), nullable=True),
        sa.Column("deadline", sa.Double(), nullable=False),
        sa.Column("expires", sa.Double(), nullable=True),
        sa.Column("attempts", sa.Integer(), nullable=False),
        sa.Column("run_seconds", sa.Double(), nullable=True),
        *(_belongs(column, table) for column, table in _OWNERS.items()),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_function_job")),
        sa.UniqueConstraint("user_id", "key", name=op.f("uq_function_job_user_id_key")),
        sa.UniqueConstraint("robot_id", "key", name=op.f("uq_function_job_robot_id_key")),
    )
    for column in ("realm_id", "payer_id", "expires", "state"):
        op.create_index(op.f(f"ix_function_job_{column}"), "function_job", [column], unique=False)


def downgrade() -> None:
    op.drop_table("function_job")
