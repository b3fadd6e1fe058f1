"""Upgrades the tables of a database to the version of this code.

Importing Alembic takes a third of a second, so it is imported only if there is something to upgrade.
"""

from __future__ import annotations

from pathlib import Path

from sqlalchemy import Connection, inspect, text

from relay_protocol.errors import Unavailable

HEAD = "0024"
"""The newest migration in ``migrations/versions``."""

_LOCK = 0x5357_4244
"""Key of the advisory lock under which migrations run on PostgreSQL."""


def is_current(connection: Connection) -> bool:
    """Whether the tables have the version :data:`HEAD`."""
    return _version(connection) == HEAD


def upgrade(connection: Connection) -> None:
    """Run the missing migrations within the open write transaction.

    :raises Unavailable: the database was written by a newer version
    """
    if connection.dialect.name == "postgresql":
        connection.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": _LOCK})
    if is_current(connection):
        return
    from alembic import command
    from alembic.config import Config
    from alembic.script import ScriptDirectory

    config = Config()
    folder = Path(__file__).parent / "migrations"
    config.set_main_option("script_location", str(folder).replace("%", "%%"))
    config.attributes["connection"] = connection
    version = _version(connection)
    known = {script.revision for script in ScriptDirectory.from_config(config).walk_revisions()}
    if version is not None and version not in known:
        raise Unavailable(
            f"the database was written by a newer Switchboard (schema {version}, this one knows {HEAD}); "
            "install that version or a newer one"
        )
    command.upgrade(config, "head")


def _version(connection: Connection) -> str | None:
    if not inspect(connection).has_table("alembic_version"):
        return None
    version: str | None = connection.execute(text("SELECT version_num FROM alembic_version")).scalar()
    return version
