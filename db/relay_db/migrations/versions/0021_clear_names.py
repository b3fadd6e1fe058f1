"""Tables and columns have the names of the models.

PostgreSQL renames them. SQLite cannot rename constraints and indexes, so tables whose constraints have old names are
copied.

Revision ID: 0021
Revises: 0020
"""

from __future__ import annotations

import re
from typing import NamedTuple

import sqlalchemy as sa
from alembic import op

revision = "0021"
down_revision = "0020"
branch_labels = None
depends_on = None


class Rename(NamedTuple):
    """A table before and after.

    :ivar columns: new names of columns
    :ivar others: new names of constraints and indexes that do not follow from those of the table and its columns
    """

    before: str
    after: str
    columns: dict[str, str] = {}
    others: dict[str, str] = {}

    def reversed(self) -> Rename:
        """The opposite change."""
        columns = {new: old for old, new in self.columns.items()}
        others = {new: old for old, new in self.others.items()}
        return Rename(self.after, self.before, columns, others)

    def name(self, old: str) -> str:
        """The new name of a constraint, index or sequence."""
        if old in self.others:
            return self.others[old]
        new = re.sub(rf"^((?:pk|uq|ck|fk|ix)_)?{self.before}(?=_|$)", rf"\g<1>{self.after}", old)
        for before, after in self.columns.items():
            new = re.sub(rf"(?<={self.after}_){before}(?=_|$)", after, new)
        return new


RENAMES = (
    Rename("guest_account", "linked_account", {"home_id": "home_user_id"}),
    Rename("program", "oauth_client", {"verifier": "digest_ha1"}),
    Rename(
        "access_token",
        "access_token",
        {"program_id": "oauth_client_id"},
        {"fk_access_token_program_id_program": "fk_access_token_oauth_client_id_oauth_client"},
    ),
    Rename("robot_home", "home_relay"),
    Rename("relay_lease", "relay_lease", {"name": "task", "until": "expires"}),
    Rename("role", "role_document"),
    Rename("role_run", "role_run", {}, {"fk_role_run_role_id_role": "fk_role_run_role_id_role_document"}),
    Rename("alert", "alert", {"times": "report_count", "news": "notification_count"}),
    Rename("alert_rule", "alert_rule", {"over": "notify_end"}),
    Rename("directory_entry", "service_registry_entry"),
    Rename("memory", "stored_event", {"used": "use_count"}),
    Rename("memory_count", "last_event_number", {"last": "number"}),
    Rename("stored_file", "stored_file", {"changed": "state_since"}),
)


def upgrade() -> None:
    _apply(RENAMES)


def downgrade() -> None:
    _apply(tuple(each.reversed() for each in RENAMES))


def _apply(renames: tuple[Rename, ...]) -> None:
    if op.get_bind().dialect.name == "sqlite":
        copied = [each for each in renames if each.before != each.after or each.others]
        for each in renames:
            if each not in copied:
                _rename_columns(each)
        _copy_on_sqlite(copied)
    else:
        for each in renames:
            _rename_on_postgresql(each)


def _rename_columns(rename: Rename) -> None:
    for old, new in rename.columns.items():
        op.execute(f"ALTER TABLE {rename.before} RENAME COLUMN {old} TO {new}")


# --- PostgreSQL -------------------------------------------------------------------------------------------


def _rename_on_postgresql(rename: Rename) -> None:
    before, after = rename.before, rename.after
    names = sa.text(
        "SELECT 'CONSTRAINT', conname FROM pg_constraint WHERE conrelid = to_regclass(:before) UNION ALL "
        "SELECT 'INDEX', relname FROM pg_index JOIN pg_class ON pg_class.oid = indexrelid "
        "WHERE indrelid = to_regclass(:before) "
        "AND NOT EXISTS (SELECT FROM pg_constraint WHERE conindid = indexrelid) UNION ALL "
        "SELECT 'SEQUENCE', relname FROM pg_depend JOIN pg_class ON pg_class.oid = objid "
        "WHERE refobjid = to_regclass(:before) AND relkind = 'S'"
    )
    for kind, old in op.get_bind().execute(names, {"before": before}).all():
        new = rename.name(old)
        if new == old:
            continue
        if kind == "CONSTRAINT":
            op.execute(f"ALTER TABLE {before} RENAME CONSTRAINT {old} TO {new}")
        else:
            op.execute(f"ALTER {kind} {old} RENAME TO {new}")
    _rename_columns(rename)
    if after != before:
        op.rename_table(before, after)


# --- SQLite -----------------------------------------------------------------------------------------------

_IDENTIFIER = re.compile(r"'[^']*'|\w+")
"""Also matches string literals, whose content is not changed."""


def _copy_on_sqlite(renames: list[Rename]) -> None:
    """Copy the tables with their new names, then drop the old ones.

    Dropping a table deletes the rows of other tables that refer to it. So copies refer to copies, and a table is dropped
    after those that refer to it. Renaming a copy changes what refers to it, too.
    """
    copies = {each.before: _copy_of(each) for each in renames}
    indexes = [statement for each in renames for statement in _indexes(each)]
    for each in renames:
        _copy_table(each, copies)
    for each in reversed(renames):
        op.execute(f"DROP TABLE {each.before}")
    for each in renames:
        op.execute(f"ALTER TABLE {_copy_of(each)} RENAME TO {each.after}")
    for statement in indexes:
        op.execute(statement)


def _copy_of(rename: Rename) -> str:
    return f"copy_of_{rename.before}"


def _indexes(rename: Rename) -> list[str]:
    """The statements that create the indexes of the renamed table."""
    query = sa.text("SELECT sql FROM sqlite_master WHERE type = 'index' AND tbl_name = :name AND sql IS NOT NULL")
    statements = op.get_bind().execute(query, {"name": rename.before}).scalars()
    return [_renamed(each, rename, {rename.before: rename.after}) for each in statements]


def _copy_table(rename: Rename, copies: dict[str, str]) -> None:
    before, copy, bind = rename.before, _copy_of(rename), op.get_bind()
    query = sa.text("SELECT sql FROM sqlite_master WHERE type = 'table' AND name = :name")
    statement = bind.execute(query, {"name": before}).scalar_one()
    columns = [each["name"] for each in sa.inspect(bind).get_columns(before)]
    op.execute(_renamed(statement, rename, copies))
    into = ", ".join(f'"{rename.columns.get(each, each)}"' for each in columns)
    of = ", ".join(f'"{each}"' for each in columns)
    op.execute(f"INSERT INTO {copy} ({into}) SELECT {of} FROM {before}")
    # Numbers of removed rows are not used again.
    op.execute(f"DELETE FROM sqlite_sequence WHERE name = '{copy}'")
    op.execute(f"INSERT INTO sqlite_sequence SELECT '{copy}', seq FROM sqlite_sequence WHERE name = '{before}'")


def _renamed(statement: str, rename: Rename, tables: dict[str, str]) -> str:
    """A statement of the old table with the new names."""

    def new_name(match: re.Match[str]) -> str:
        name = match[0]
        return tables.get(name) or rename.columns.get(name) or rename.name(name)

    return _IDENTIFIER.sub(new_name, statement)
