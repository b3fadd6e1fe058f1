"""The tables that migrations make are the tables the models describe."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import CheckConstraint, inspect, text

from relay_db import queries, schema
from relay_db.base import Base
from relay_db.engine import Database
from relay_protocol.errors import Unavailable

FOLDER = Path(schema.__file__).parent / "migrations"


def _scripts() -> ScriptDirectory:
    config = Config()
    config.set_main_option("script_location", str(FOLDER))
    return ScriptDirectory.from_config(config)


def test_models_match_the_migrations(database: Database) -> None:
    """Alembic finds nothing to change after an upgrade from empty."""
    with database.connection() as connection:
        context = MigrationContext.configure(
            connection, opts={"compare_type": True, "compare_server_default": True}
        )
        assert compare_metadata(context, Base.metadata) == []


def test_check_constraints_match_the_migrations(database: Database) -> None:
    """Alembic does not compare CHECK constraints, so their names are compared here."""
    with database.connection() as connection:
        inspector = inspect(connection)
        made = {
            (table, check["name"])
            for table in Base.metadata.tables
            for check in inspector.get_check_constraints(table)
        }
    meant = {
        (table.name, str(constraint.name))
        for table in Base.metadata.tables.values()
        for constraint in table.constraints
        if isinstance(constraint, CheckConstraint)
    }
    assert made == meant
    assert meant


def test_an_older_relay_names_no_robot_that_was_shared(empty_url: str) -> None:
    """Who goes back leaves nothing of it in groups, rights and the directory of other realms."""
    database = Database(empty_url)
    database.upgrade()
    with database.begin() as s:
        queries.add_realm(s, "lab2")
        robot = queries.add_robot(s, "rover")
        queries.share_robot(s, robot.id, "lab2")
        for realm in ("default", "lab2"):
            user = queries.add_user(s, "ann", None, realm=realm)
            queries.grant_right(s, robot.id, "viewer", user_id=user.id)
            queries.add_to_robot_group(s, queries.add_robot_group(s, "all", realm).id, robot.id)
    with database.connection() as connection:
        config = Config()
        config.set_main_option("script_location", str(FOLDER))
        config.attributes["connection"] = connection
        command.downgrade(config, "0008")
        for table in ("robot_right", "robot_membership"):
            assert connection.execute(text(f"SELECT count(*) FROM {table}")).scalar() == 1
        kept = (
            "SELECT realm.name FROM robot_membership JOIN robot_group ON robot_group.id = group_id "
            "JOIN realm ON realm.id = realm_id"
        )
        assert connection.execute(text(kept)).scalars().all() == ["default"]
    database.close()


def test_the_head_in_the_code_is_the_newest_migration() -> None:
    """The quick look at the version compares with the right one."""
    assert _scripts().get_heads() == [schema.HEAD]


def test_an_upgrade_of_a_current_database_changes_nothing(database: Database) -> None:
    """A second upgrade keeps what is there."""
    with database.begin() as s:
        queries.add_robot(s, "rover")
    database.upgrade()
    with database.reading() as s:
        assert queries.find_robot(s, "rover") is not None


def test_a_new_database_has_the_default_realm_and_revision_one(database: Database) -> None:
    """Seeds are there."""
    with database.reading() as s:
        assert [realm.name for realm in queries.list_realms(s)] == ["default"]
        assert queries.revision(s) == 1


def test_a_newer_schema_is_refused_in_words(database: Database) -> None:
    """Old code does not touch the database of newer code."""
    with database.connection() as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    with pytest.raises(Unavailable, match=r"newer Switchboard.*9999"):
        database.upgrade()


def test_a_failing_migration_leaves_nothing(empty_url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Migrations run in one transaction on both databases: half a schema is never seen."""
    run = command.upgrade

    def run_and_fail(*args: object) -> None:
        run(*args)  # type: ignore[arg-type]
        raise RuntimeError("power cut")

    monkeypatch.setattr(command, "upgrade", run_and_fail)
    database = Database(empty_url)
    with pytest.raises(RuntimeError, match="power cut"):
        database.upgrade()
    with database.connection() as connection:
        assert inspect(connection).get_table_names() == []
    monkeypatch.undo()
    database.upgrade()
    database.close()


def test_processes_that_start_at_once_upgrade_once(empty_url: str) -> None:
    """Three processes find an empty database; all of them end well, with one set of tables."""
    program = "import os; from relay_db.engine import Database; d = Database(os.environ['URL']); d.upgrade(); d.close()"
    environment = {**os.environ, "URL": empty_url, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    started = [
        subprocess.Popen([sys.executable, "-c", program], env=environment, stderr=subprocess.PIPE, text=True)
        for _ in range(3)
    ]
    errors = [process.communicate(timeout=60)[1] for process in started]
    assert [(process.returncode, error) for process, error in zip(started, errors, strict=True)] == [
        (0, "")
    ] * 3
    database = Database(empty_url)
    with database.reading() as s:
        assert [realm.name for realm in queries.list_realms(s)] == ["default"]
    database.close()


@pytest.mark.parametrize(
    "statement", ["UPDATE audit_entry SET actor = 'someone else'", "DELETE FROM audit_entry"]
)
def test_the_audit_log_only_grows(database: Database, statement: str) -> None:
    """The database itself refuses to change or remove an entry."""
    with database.begin() as s:
        queries.append_audit(s, at=1.0, actor="user:ann", action="test", target="x")
    with pytest.raises(Exception, match=r"only grows|same time"), database.connection() as connection:
        connection.execute(text(statement))
    with database.reading() as s:
        assert [entry.actor for entry in queries.list_audit(s)] == ["user:ann"]
