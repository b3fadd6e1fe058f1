"""Events and the audit chain, on both databases."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from sqlalchemy import text
from sqlalchemy.orm import Session

from relay_db import queries
from relay_db.engine import Database
from relay_db.queries import audit as audit_queries

ENTRIES = 5


def _append(s: Session, number: int) -> None:
    queries.append_audit(
        s,
        at=number + 0.25,
        actor="user:ann",
        action="right.grant",
        target=f"bob on rover-{number}",
        origin="192.0.2.7",
        data={"level": "viewer", "ratio": 0.1},
    )


@pytest.fixture
def audited(database: Database) -> Database:
    """A database with five audit entries."""
    for number in range(ENTRIES):
        with database.begin() as s:
            _append(s, number)
    return database


@contextmanager
def _tampering(database: Database) -> Iterator[Session]:
    """A session without the triggers that protect the audit log."""
    with database.begin() as s:
        if s.connection().dialect.name == "sqlite":
            for verb in ("update", "delete"):
                s.execute(text(f"DROP TRIGGER audit_entry_no_{verb}"))
        else:
            s.execute(text("ALTER TABLE audit_entry DISABLE TRIGGER USER"))
        yield s


def _verify(database: Database) -> int | None:
    with database.reading() as s:
        return queries.verify_audit(s)


def test_a_chain_is_whole(audited: Database) -> None:
    assert _verify(audited) is None
    with audited.reading() as s:
        latest, before = queries.list_audit(s, limit=2)
    assert (latest.id, before.id) == (5, 4)
    assert latest.target == "bob on rover-4"
    assert latest.data == {"level": "viewer", "ratio": 0.1}


def test_an_empty_chain_is_whole(database: Database) -> None:
    """No entries, no error."""
    assert _verify(database) is None


@pytest.mark.parametrize("page", [1, 2, 1000])
def test_a_chain_is_read_in_pages(audited: Database, monkeypatch: pytest.MonkeyPatch, page: int) -> None:
    """For any page size the result is the same."""
    monkeypatch.setattr(audit_queries, "_PAGE", page)
    assert _verify(audited) is None
    with _tampering(audited) as s:
        s.execute(text("UPDATE audit_entry SET actor = 'user:eve' WHERE id = 4"))
    assert _verify(audited) == 4


@pytest.mark.parametrize(
    ("statement", "broken"),
    [
        ("UPDATE audit_entry SET actor = 'user:anm' WHERE id = 2", 2),
        ("UPDATE audit_entry SET action = 'right.revoke' WHERE id = 3", 3),
        ("UPDATE audit_entry SET target = 'bob on rover-9' WHERE id = 1", 1),
        ("UPDATE audit_entry SET origin = '192.0.2.8' WHERE id = 5", 5),
        ("UPDATE audit_entry SET at = at + 0.001 WHERE id = 2", 2),
        ("UPDATE audit_entry SET data = replace(data, 'viewer', 'vieweR') WHERE id = 2", 2),
        ("UPDATE audit_entry SET data = data || ' ' WHERE id = 2", 2),
        ("UPDATE audit_entry SET data = 'no json' WHERE id = 2", 2),
        ("UPDATE audit_entry SET hash = replace(hash, substr(hash, 1, 1), 'x') WHERE id = 2", 2),
        ("DELETE FROM audit_entry WHERE id = 3", 3),
        ("DELETE FROM audit_entry WHERE id = 1", 1),
        ("DELETE FROM audit_entry WHERE id = 5", 5),
        ("DELETE FROM audit_entry", 1),
        ("UPDATE audit_entry SET id = 0 WHERE id = 1", 1),
        (
            "INSERT INTO audit_entry SELECT 6, at, actor, action, target, origin, data, hash "
            "FROM audit_entry WHERE id = 5",
            6,
        ),
        (
            "INSERT INTO audit_entry SELECT 0, at, actor, action, target, origin, data, hash "
            "FROM audit_entry WHERE id = 5",
            1,
        ),
    ],
)
def test_tampering_is_found(audited: Database, statement: str, broken: int) -> None:
    """A change, a removal or an insertion anywhere, the ends too, is found with its number."""
    with _tampering(audited) as s:
        s.execute(text(statement))
    assert _verify(audited) == broken


def test_a_rewritten_last_entry_is_found(audited: Database) -> None:
    with _tampering(audited) as s:
        s.execute(text("DELETE FROM audit_entry WHERE id = 5"))
        before = s.execute(text("SELECT hash FROM audit_entry WHERE id = 4")).scalar_one()
        s.execute(text("UPDATE revision SET audit_id = 4, audit_hash = :hash").bindparams(hash=before))
        _append(s, 77)
        s.execute(text("UPDATE revision SET audit_hash = :hash").bindparams(hash="0" * 64))
    assert _verify(audited) == 5


def test_a_changed_byte_in_the_file_is_found(sqlite: Database, sqlite_url: str) -> None:
    with sqlite.begin() as s:
        for number in range(ENTRIES):
            _append(s, number)
    sqlite.close()
    path = Path(sqlite_url.removeprefix("sqlite:///"))
    whole = path.read_bytes()
    place = whole.index(b"bob on rover-2")
    for byte in (b"B", b"\xff"):
        path.write_bytes(whole[:place] + byte + whole[place + 1 :])
        changed = Database(sqlite_url)
        assert _verify(changed) == 3
        changed.close()


JSON = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text()
    | st.lists(st.text())
)


def test_any_text_can_be_audited(database: Database) -> None:

    @settings(deadline=None, max_examples=40)
    @given(st.text(), st.dictionaries(st.text(), JSON))
    @example("\x00\ud800", {"\x00": "\ud800"})
    def audit(words: str, data: dict[str, object]) -> None:
        with database.begin() as s:
            queries.append_audit(s, at=1.5, actor=words, action=words, target=words, origin=words, data=data)
        assert _verify(database) is None
        with database.reading() as s:
            assert queries.list_audit(s, limit=1)[0].data == data

    audit()


def test_data_that_is_no_json_is_refused(database: Database) -> None:
    """NaN has no form in JSON."""
    with pytest.raises(ValueError, match="JSON"), database.begin() as s:
        queries.append_audit(s, at=1.0, actor="a", action="b", target="c", data={"x": float("nan")})


def test_a_log_that_grows_meanwhile_is_whole(audited: Database) -> None:
    """Entries appended during the verification are not taken for insertions."""
    with audited.reading() as reader:
        assert queries.verify_audit(reader) is None
        with audited.begin() as s:
            _append(s, 77)
        assert queries.verify_audit(reader) is None
    assert _verify(audited) is None


def test_when_robots_were_removed(database: Database) -> None:
    with database.begin() as s:
        for at, action, target in (
            (1.0, "robot.remove", "rover"),
            (2.0, "robot.remove", "rover"),
            (3.0, "robot.add", "rover"),
            (4.0, "robot.remove", "tank"),
        ):
            queries.append_audit(s, at=at, actor="cli:root", action=action, target=target)
        assert queries.robot_removals(s, {"rover", "arm"}) == {"rover": 2.0}
        assert queries.robot_removals(s, ()) == {}
