"""Tokens in the URL of a robot, for Foxglove.

Revision ID: 0015
Revises: 0014
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0015"
down_revision = "0014"
branch_labels = None
depends_on = None

_KIND = "ck_access_token_kind"
_KINDS = "'access', 'session', 'login'"


def upgrade() -> None:
    with op.batch_alter_table("access_token", copy_from=_access_token(_KINDS)) as batch:
        batch.add_column(sa.Column("robot_id", sa.Integer(), nullable=True))
        batch.create_foreign_key(
            op.f("fk_access_token_robot_id_robot"), "robot", ["robot_id"], ["id"], ondelete="CASCADE"
        )
        batch.create_index(op.f("ix_access_token_robot_id"), ["robot_id"])
        batch.drop_constraint(op.f(_KIND), type_="check")
        batch.create_check_constraint(op.f(_KIND), f"kind IN ({_KINDS}, 'foxglove')")
        batch.create_check_constraint(
            op.f("ck_access_token_robot"), "(kind = 'foxglove') = (robot_id IS NOT NULL)"
        )


def downgrade() -> None:
    op.execute("DELETE FROM access_token WHERE kind = 'foxglove'")
    table = _access_token(f"{_KINDS}, 'foxglove'")
    table.append_column(sa.Column("robot_id", sa.Integer(), nullable=True))
    table.append_constraint(_to("robot_id", "robot"))
    table.append_constraint(
        sa.CheckConstraint(
            "(kind = 'foxglove') = (robot_id IS NOT NULL)", name=op.f("ck_access_token_robot")
        )
    )
    sa.Index(op.f("ix_access_token_robot_id"), table.c.robot_id)
    with op.batch_alter_table("access_token", copy_from=table) as batch:
        batch.drop_constraint(op.f("ck_access_token_robot"), type_="check")
        batch.drop_constraint(op.f(_KIND), type_="check")
        batch.create_check_constraint(op.f(_KIND), f"kind IN ({_KINDS})")
        batch.drop_index(op.f("ix_access_token_robot_id"))
        batch.drop_constraint(op.f("fk_access_token_robot_id_robot"), type_="foreignkey")
        batch.drop_column("robot_id")


def _to(column: str, other: str) -> sa.ForeignKeyConstraint:
    name = op.f(f"fk_access_token_{column}_{other}")
    return sa.ForeignKeyConstraint([column], [f"{other}.id"], name=name, ondelete="CASCADE")


def _access_token(kinds: str) -> sa.Table:
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
        sa.Column("scope", sa.Text(), nullable=True),
        sa.Column("program_id", sa.Integer(), nullable=True),
        sa.Column("family_id", sa.Integer(), nullable=True),
        sa.CheckConstraint(f"kind IN ({kinds})", name=op.f(_KIND)),
        sa.CheckConstraint("length(token_hash) = 64", name=op.f("ck_access_token_token_hash")),
        _to("user_id", "user_account"),
        _to("program_id", "program"),
        _to("family_id", "token_family"),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_access_token")),
        sa.UniqueConstraint("token_hash", name=op.f("uq_access_token_token_hash")),
        sa.Index(op.f("ix_access_token_user_id"), "user_id"),
        sa.Index(op.f("ix_access_token_program_id"), "program_id"),
        sa.Index(op.f("ix_access_token_family_id"), "family_id"),
        sqlite_autoincrement=True,
    )
