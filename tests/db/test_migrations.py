"""The tables that migrations make are the tables the models describe."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import CheckConstraint, Connection, ForeignKeyConstraint, inspect, text

from relay_db import queries, schema
from relay_db.base import Base
from relay_db.engine import Database
from relay_protocol.errors import Unavailable

FOLDER = Path(schema.__file__).parent / "migrations"


def _config(connection: Connection | None = None) -> Config:
    config = Config()
    config.set_main_option("script_location", str(FOLDER))
    config.attributes["connection"] = connection
    return config


def test_models_match_the_migrations(database: Database) -> None:
    """Alembic finds nothing to change after an upgrade from empty."""
    with database.connection() as connection:
        context = MigrationContext.configure(
            connection, opts={"compare_type": True, "compare_server_default": True}
        )
        assert compare_metadata(context, Base.metadata) == []


def test_constraints_have_the_names_of_the_models(database: Database) -> None:
    """Alembic does not compare CHECK constraints and names of foreign keys, so their names are compared here."""
    with database.connection() as connection:
        inspector = inspect(connection)
        found = {
            (table, constraint["name"])
            for table in Base.metadata.tables
            for constraint in [*inspector.get_check_constraints(table), *inspector.get_foreign_keys(table)]
        }
    expected = {
        (table.name, str(constraint.name))
        for table in Base.metadata.tables.values()
        for constraint in table.constraints
        if isinstance(constraint, CheckConstraint | ForeignKeyConstraint)
    }
    assert found == expected
    assert expected


def test_an_older_relay_names_no_robot_that_was_shared(empty_url: str) -> None:
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
        command.downgrade(_config(connection), "0008")
        for table in ("robot_right", "robot_membership"):
            assert connection.execute(text(f"SELECT count(*) FROM {table}")).scalar() == 1
        kept = (
            "SELECT realm.name FROM robot_membership JOIN robot_group ON robot_group.id = group_id "
            "JOIN realm ON realm.id = realm_id"
        )
        assert connection.execute(text(kept)).scalars().all() == ["default"]
    database.close()


def test_an_upgrade_to_one_event_log_keeps_the_stored_events(empty_url: str) -> None:
    """The table that nothing read goes, also with rows in it; going back makes it again, empty."""
    database = Database(empty_url)
    with database.connection() as connection:
        command.upgrade(_config(connection), "0009")
        row = "INSERT INTO event (at, kind, source, data) VALUES (1, 'robot.online', 'relay', '{}')"
        connection.execute(text(row))
        row = "INSERT INTO memory (realm_id, number, at, kind, source, data, used) VALUES (1, 1, 1, 'x', '', '{}', 0)"
        connection.execute(text(row))
    database.upgrade()
    with database.reading() as s:
        assert [each.kind for each in queries.events_since(s, "default", 0, 10)] == ["x"]
    with database.connection() as connection:
        assert not inspect(connection).has_table("event")
        command.downgrade(_config(connection), "0009")
        assert connection.execute(text("SELECT count(*) FROM event")).scalar() == 0
    database.upgrade()
    database.close()


HASH = "a" * 64
OLD_ROWS = f"""
INSERT INTO user_account (id, realm_id, name, admin, disabled)
    VALUES (7, 1, 'ann', false, false), (8, 1, 'bob', false, false);
INSERT INTO robot (id, realm_id, name, description) VALUES (5, 1, 'rover', '');
INSERT INTO guest_account (user_id, home_id) VALUES (8, 7);
INSERT INTO program (user_id, key, verifier, label, created)
    VALUES (7, 'k', '{HASH}', 'p', 1), (7, 'l', '{HASH}', 'q', 1);
DELETE FROM program WHERE key = 'l';
INSERT INTO access_token (user_id, token_hash, kind, label, created, program_id)
    VALUES (7, '{HASH}', 'access', 't', 1, 1);
INSERT INTO access_token (user_id, token_hash, kind, label, created) VALUES (7, 'b{HASH[1:]}', 'access', 't', 1);
DELETE FROM access_token WHERE id = 2;
INSERT INTO robot_home (robot_id, relay, epoch) VALUES (5, 'one', 3);
INSERT INTO relay_lease (name, relay, until) VALUES ('alerts', 'one', 9);
INSERT INTO role (realm_id, name, revision, serial, owner_id, by, at, statements, robots, document)
    VALUES (1, 'lamp', 2, 4, 7, 'ann', 1, 1, '[]', '');
INSERT INTO role_run (role_id, user_id, at, parts, reason) VALUES (1, 7, 1, '[]', '');
INSERT INTO alert (id, robot_id, kind, about, level, text, first_at, last_at, times, news)
    VALUES ('a', 5, 'offline', '', 'error', 'x', 1, 2, 3, 4);
INSERT INTO alert_rule (user_id, label, robots, kinds, level, channel, url, secret, over, group_s, created)
    VALUES (7, '', '*', '[]', 'error', 'portal', '', '', true, 60, 1);
INSERT INTO directory_entry (id, realm_id, user_id, kind, name, address, description, data, ttl, registered, expires)
    VALUES ('e', 1, 7, 'k', 'n', 'a', '', '{{}}', 1, 1, 2);
INSERT INTO memory (realm_id, number, at, source, kind, data, used) VALUES (1, 6, 1, 's', 'k', '{{}}', 2);
INSERT INTO memory_count (realm_id, last) VALUES (1, 9);
INSERT INTO stored_file (robot_id, name, sha256, size, state, origin, modified, changed)
    VALUES (5, 'f', '{HASH}', 1, 'stored', 'g', 1, 2)
"""

ROWS_BEFORE = {
    "SELECT user_id, home_id FROM guest_account": (8, 7),
    "SELECT id, user_id, key, verifier FROM program": (1, 7, "k", HASH),
    "SELECT id, user_id, program_id FROM access_token": (1, 7, 1),
    "SELECT robot_id, relay, epoch FROM robot_home": (5, "one", 3),
    "SELECT name, relay, until FROM relay_lease": ("alerts", "one", 9),
    "SELECT id, name, owner_id FROM role": (1, "lamp", 7),
    "SELECT role_id, user_id FROM role_run": (1, 7),
    "SELECT id, times, news FROM alert": ("a", 3, 4),
    "SELECT id, over FROM alert_rule": (1, True),
    "SELECT id, name, ttl FROM directory_entry": ("e", "n", 1),
    "SELECT realm_id, number, kind, used FROM memory": (1, 6, "k", 2),
    "SELECT realm_id, last FROM memory_count": (1, 9),
    "SELECT id, name, changed FROM stored_file": (1, "f", 2),
}
ROWS_AFTER = {
    "SELECT user_id, home_user_id FROM linked_account": (8, 7),
    "SELECT id, user_id, key, digest_ha1 FROM oauth_client": (1, 7, "k", HASH),
    "SELECT id, user_id, oauth_client_id FROM access_token": (1, 7, 1),
    "SELECT robot_id, relay, epoch FROM home_relay": (5, "one", 3),
    "SELECT task, relay, expires FROM relay_lease": ("alerts", "one", 9),
    "SELECT id, name, owner_id FROM role_document": (1, "lamp", 7),
    "SELECT role_id, user_id FROM role_run": (1, 7),
    "SELECT id, report_count, notification_count FROM alert": ("a", 3, 4),
    "SELECT id, notify_end FROM alert_rule": (1, True),
    "SELECT id, name, ttl FROM service_registry_entry": ("e", "n", 1),
    "SELECT realm_id, number, kind, use_count FROM stored_event": (1, 6, "k", 2),
    "SELECT realm_id, number FROM last_event_number": (1, 9),
    "SELECT id, name, state_since FROM stored_file": (1, "f", 2),
}


def _rows(connection: Connection, selects: dict[str, tuple[object, ...]]) -> dict[str, tuple[object, ...]]:
    return {select: tuple(connection.execute(text(select)).one()) for select in selects}


def _names(connection: Connection) -> set[tuple[str, str | None]]:
    """Names of all columns, constraints and indexes by their tables, and of sequences."""
    inspector = inspect(connection)
    found = (
        {("", each) for each in inspector.get_sequence_names()}
        if inspector.dialect.name == "postgresql"
        else set()
    )
    for table in inspector.get_table_names():
        found |= {(table, inspector.get_pk_constraint(table)["name"])}
        for named in (
            inspector.get_columns(table),
            inspector.get_check_constraints(table),
            inspector.get_foreign_keys(table),
            inspector.get_unique_constraints(table),
            inspector.get_indexes(table),
        ):
            found |= {(table, each["name"]) for each in named}
    return found


def test_new_names_keep_all_rows_up_and_down(empty_url: str) -> None:
    database = Database(empty_url)
    with database.connection() as connection:
        command.upgrade(_config(connection), "0020")
        names = _names(connection)
        for statement in OLD_ROWS.split(";"):
            connection.execute(text(statement))
        assert _rows(connection, ROWS_BEFORE) == ROWS_BEFORE
    with database.connection() as connection:
        command.upgrade(_config(connection), "0021")
        assert _rows(connection, ROWS_AFTER) == ROWS_AFTER
        old = re.compile(
            "guest|program|robot_home|directory|memory|pk_role$|_role_(realm|owner)|^role_id_seq"
        )
        assert [each for pair in _names(connection) for each in pair if each and old.search(each)] == []
    with database.connection() as connection:
        command.downgrade(_config(connection), "0020")
        assert _rows(connection, ROWS_BEFORE) == ROWS_BEFORE
        assert _names(connection) == names
    database.upgrade()
    with database.connection() as connection:
        assert _rows(connection, ROWS_AFTER) == ROWS_AFTER
    database.close()


def test_new_names_keep_the_numbers_of_removed_rows_unused(empty_url: str) -> None:
    database = Database(empty_url)
    with database.connection() as connection:
        command.upgrade(_config(connection), "0020")
        for statement in OLD_ROWS.split(";"):
            connection.execute(text(statement))
    database.upgrade()
    with database.begin() as s:
        assert queries.create_token(s, 7, "c" * 64, kind="access", expires=None, now=1.0) == 3
        assert queries.add_oauth_client(s, 7, "m", "d" * 64, scope=None, label="", now=1.0) == 3
        assert queries.remove_oauth_client(s, 1)
        assert [token.id for token in queries.list_tokens(s, 7)] == [3]
    database.close()


def test_pending_orders_to_modules_stay_up_and_down_and_refused_ones_do_not(empty_url: str) -> None:
    database = Database(empty_url)
    with database.connection() as connection:
        command.upgrade(_config(connection), "0023")
        rover = "INSERT INTO robot (id, realm_id, name, description) VALUES (5, 1, 'rover', '')"
        orders = (
            "INSERT INTO module_order (robot_id, module, start, by, at) "
            "VALUES (5, 'arm', true, 'ann', 1), (5, 'base', true, 'ann', 2)"
        )
        for statement in (rover, orders):
            connection.execute(text(statement))
    database.upgrade()
    with database.begin() as s:
        arm, base = queries.module_orders(s, 5)
        assert (arm.refused_at, arm.refusal) == (None, "")
        queries.refuse_module_order(s, base, 3.0, "it has no such module")
    with database.connection() as connection:
        command.downgrade(_config(connection), "0023")
        assert connection.execute(text("SELECT module FROM module_order")).scalars().all() == ["arm"]
    database.close()


def test_the_head_in_the_code_is_the_newest_migration() -> None:
    """The quick look at the version compares with the right one."""
    assert ScriptDirectory.from_config(_config()).get_heads() == [schema.HEAD]


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


def test_a_newer_schema_is_refused(database: Database) -> None:
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
    with (
        pytest.raises(Exception, match=r"only grows|conflicts with another"),
        database.connection() as connection,
    ):
        connection.execute(text(statement))
    with database.reading() as s:
        assert [entry.actor for entry in queries.list_audit(s)] == ["user:ann"]
