"""OAuth clients (table ``program``), scopes of tokens, and families of refreshed tokens.

Revision ID: 0005
Revises: 0004
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "program",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("user_id", sa.Integer(), nullable=False),
        sa.Column("key", sa.String(length=64), nullable=False),
        sa.Column("verifier", sa.String(length=64), nullable=False),
        sa.Column("scope", sa.Text(), nullable=True),
        sa.Column("label", sa.String(length=255), nullable=False),
        sa.Column("created", sa.Double(), nullable=False),
        sa.CheckConstraint("length(verifier) = 64", name=op.f("ck_program_verifier")),
        _to("program", "user_id", "user_account"),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_program")),
        sa.UniqueConstraint("key", name=op.f("uq_program_key")),
        sqlite_autoincrement=True,
    )
    op.create_index(op.f("ix_program_user_id"), "program", ["user_id"])
    op.create_table(
        "token_family",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("user_id", sa.Integer(), nullable=False),
        sa.Column("scope", sa.Text(), nullable=True),
        sa.Column("refresh_hash", sa.String(length=64), nullable=False),
        sa.Column("former_hash", sa.String(length=64), nullable=True),
        sa.Column("created", sa.Double(), nullable=False),
        sa.Column("expires", sa.Double(), nullable=False),
        sa.CheckConstraint("length(refresh_hash) = 64", name=op.f("ck_token_family_refresh_hash")),
        sa.CheckConstraint("length(former_hash) = 64", name=op.f("ck_token_family_former_hash")),
        _to("token_family", "user_id", "user_account"),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_token_family")),
        sa.UniqueConstraint("refresh_hash", name=op.f("uq_token_family_refresh_hash")),
        sa.UniqueConstraint("former_hash", name=op.f("uq_token_family_former_hash")),
        sqlite_autoincrement=True,
    )
    op.create_index(op.f("ix_token_family_user_id"), "token_family", ["user_id"])
    with op.batch_alter_table("access_token", copy_from=_access_token()) as batch:
        batch.add_column(sa.Column("scope", sa.Text(), nullable=True))
        batch.add_column(sa.Column("program_id", sa.Integer(), nullable=True))
        batch.add_column(sa.Column("family_id", sa.Integer(), nullable=True))
        for column, table in (("program_id", "program"), ("family_id", "token_family")):
            batch.create_foreign_key(
                op.f(f"fk_access_token_{column}_{table}"), table, [column], ["id"], ondelete="CASCADE"
            )
            batch.create_index(op.f(f"ix_access_token_{column}"), [column])


def downgrade() -> None:
    with op.batch_alter_table("access_token") as batch:
        for column, table in (("program_id", "program"), ("family_id", "token_family")):
            batch.drop_index(op.f(f"ix_access_token_{column}"))
            batch.drop_constraint(op.f(f"fk_access_token_{column}_{table}"), type_="foreignkey")
            batch.drop_column(column)
        batch.drop_column("scope")
    op.drop_table("token_family")
    op.drop_table("program")


def _to(table: str, column: str, other: str) -> sa.ForeignKeyConstraint:
    name = op.f(f"fk_{table}_{column}_{other}")
    return sa.ForeignKeyConstraint([column], [f"{other}.id"], name=name, ondelete="CASCADE")


def _access_token() -> sa.Table:
    """The table before: SQLite creates it again, and its checks cannot be read from the database."""
    return sa.Table(
        "access_token",
        sa.MetaData(),
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("user_id", sa.Integer(), nullable=False),
        sa.Column("token_hash", sa.String(length=64), nullable=False),
        sa.Column("kind", sa.String(length=16), nullable=False),
        sa.Column("label", sa.String(length=255), nullable=False),
        sa.Column("created", sa.Double(), nullable=False),
        sa.Column("expires", sa.Double(), nullable=True),
        sa.CheckConstraint("kind IN ('access', 'session', 'login')", name=op.f("ck_access_token_kind")),
        sa.CheckConstraint("length(token_hash) = 64", name=op.f("ck_access_token_token_hash")),
        _to("access_token", "user_id", "user_account"),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_access_token")),
        sa.UniqueConstraint("token_hash", name=op.f("uq_access_token_token_hash")),
        sa.Index(op.f("ix_access_token_user_id"), "user_id"),
        sqlite_autoincrement=True,
    )
