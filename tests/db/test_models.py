"""Constraints of the tables, for every writer."""

from __future__ import annotations

import pytest
from sqlalchemy import text
from sqlalchemy.exc import IntegrityError

from relay_db import queries
from relay_db.engine import Database
from relay_protocol.errors import Unavailable

HASH = "a" * 64


@pytest.fixture
def filled(database: Database) -> Database:
    """User 1, group 1, robot 1, all in realm 1."""
    with database.begin() as s:
        assert queries.add_user(s, "ann", None).id == 1
        assert queries.add_group(s, "lab").id == 1
        assert queries.add_robot(s, "rover").id == 1
    return database


RIGHT = "INSERT INTO robot_right (robot_id, user_id, group_id, level, allow, deny) VALUES "
TOKEN = "INSERT INTO access_token (user_id, token_hash, kind, label, created) VALUES "

ENTRY = (
    "INSERT INTO service_registry_entry "
    "(id, realm_id, user_id, kind, name, address, description, data, ttl, registered, expires) VALUES "
)


@pytest.mark.parametrize(
    "statement",
    [
        pytest.param(RIGHT + "(1, 1, 1, 'viewer', '[]', '[]')", id="right of a user and a group"),
        pytest.param(RIGHT + "(1, NULL, NULL, 'viewer', '[]', '[]')", id="right of nobody"),
        pytest.param(RIGHT + "(1, 1, NULL, 'god', '[]', '[]')", id="unknown level"),
        pytest.param(RIGHT + "(7, 1, NULL, 'viewer', '[]', '[]')", id="right on no robot"),
        pytest.param(
            RIGHT + "(1, 1, NULL, 'viewer', '[]', '[]'), (1, 1, NULL, 'owner', '[]', '[]')",
            id="two rights of one user on one robot",
        ),
        pytest.param(TOKEN + f"(1, '{HASH}', 'magic', '', 1)", id="unknown kind of token"),
        pytest.param(TOKEN + "(1, 'swb_secret', 'access', '', 1)", id="a token that is no hash"),
        pytest.param(TOKEN + f"(9, '{HASH}', 'access', '', 1)", id="token of nobody"),
        pytest.param(
            TOKEN + f"(1, '{HASH}', 'access', '', 1), (1, '{HASH}', 'access', '', 1)", id="token twice"
        ),
        pytest.param(
            "INSERT INTO robot (realm_id, name, description) VALUES (1, 'rover', '')", id="robot twice"
        ),
        pytest.param(
            "INSERT INTO robot (realm_id, name, description) VALUES (9, 'x', '')", id="no such realm"
        ),
        pytest.param("INSERT INTO user_group (realm_id, name) VALUES (1, 'lab')", id="group twice"),
        pytest.param("INSERT INTO realm (name) VALUES ('default')", id="realm twice"),
        pytest.param("DELETE FROM realm", id="realm with people in it"),
        pytest.param(
            "INSERT INTO revision (id, number, audit_id, audit_hash) VALUES (2, 1, 0, '')",
            id="second revision",
        ),
        pytest.param(
            "INSERT INTO enrolment_code (robot_id, code_hash, expires) VALUES (1, 'K7QF-92MB', 1)",
            id="a code that is no hash",
        ),
        pytest.param(
            "INSERT INTO robot_key (robot_id, public_key, fingerprint, agent, created) "
            "VALUES (1, '', 'ff', '', 1)",
            id="key without bytes",
        ),
        pytest.param("INSERT INTO membership (group_id, user_id) VALUES (1, 9)", id="member that is nobody"),
        pytest.param(ENTRY + "('a', 1, 1, '', 'x', '', '', '', 1, 1, 2)", id="entry of no kind"),
        pytest.param(ENTRY + "('a', 1, 1, 'x', 'x', '', '', '', 0, 1, 2)", id="entry for no time"),
        pytest.param(ENTRY + "('a', 1, 9, 'x', 'x', '', '', '', 1, 1, 2)", id="entry of nobody"),
    ],
)
def test_the_tables_refuse(filled: Database, statement: str) -> None:
    """An invalid row violates a constraint of the database."""
    with pytest.raises(Unavailable) as caught, filled.connection() as connection:
        connection.execute(text(statement))
    assert isinstance(caught.value.__cause__, IntegrityError)


def test_numbers_are_never_given_out_twice(filled: Database) -> None:
    """A new token must not get the number of a removed one, which an open session may still use."""
    numbers = []
    for _ in range(2):
        with filled.begin() as s:
            numbers.append(queries.create_token(s, 1, HASH, kind="access", expires=None, now=1.0))
        with filled.begin() as s:
            assert queries.revoke_token(s, numbers[-1])
    assert numbers[0] != numbers[1]
