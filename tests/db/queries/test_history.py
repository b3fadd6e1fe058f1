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
from relay_db.queries import history

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
    """A session in which the triggers that guard the audit log are off."""
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
    """What was appended verifies, also an empty log; the latest is listed first."""
    assert _verify(audited) is None
    with audited.reading() as s:
        latest, before = queries.list_audit(s, limit=2)
    assert (latest.id, before.id) == (5, 4)
    assert latest.target == "bob on rover-4"
    assert latest.data == {"level": "viewer", "ratio": 0.1}


def test_an_empty_chain_is_whole(database: Database) -> None:
    """Nothing happened, nothing is wrong."""
    assert _verify(database) is None


@pytest.mark.parametrize("page", [1, 2, 1000])
def test_a_chain_is_read_in_pages(audited: Database, monkeypatch: pytest.MonkeyPatch, page: int) -> None:
    """However many entries are read at a time, the same is found."""
    monkeypatch.setattr(history, "_PAGE", page)
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
    """A change, a removal or an insertion anywhere, the ends too, is named by its number."""
    with _tampering(audited) as s:
        s.execute(text(statement))
    assert _verify(audited) == broken


def test_a_rewritten_last_entry_is_found(audited: Database) -> None:
    """Even with a hash that fits: the end of the chain is kept elsewhere."""
    with _tampering(audited) as s:
        s.execute(text("DELETE FROM audit_entry WHERE id = 5"))
        before = s.execute(text("SELECT hash FROM audit_entry WHERE id = 4")).scalar_one()
        s.execute(text("UPDATE revision SET audit_id = 4, audit_hash = :hash").bindparams(hash=before))
        _append(s, 77)
        s.execute(text("UPDATE revision SET audit_hash = :hash").bindparams(hash="0" * 64))
    assert _verify(audited) == 5


def test_a_changed_byte_in_the_file_is_found(sqlite: Database, sqlite_url: str) -> None:
    """Not by SQL: a byte of the file itself, also one that makes text invalid."""
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
    """Whatever someone claims to be called, the entry is kept and the chain holds."""

    @settings(deadline=None, max_examples=40)
    @given(st.text(), st.dictionaries(st.text(), JSON))
    @example("\x00\ud800", {"\x00": "\ud800"})
    def audit(words: str, data: dict[str, object]) -> None:
        with database.begin() as s:
            queries.append_audit(s, at=1.5, actor=words, action=words, target=words, origin=words, data=data)
            queries.record_event(s, at=1.5, kind=words or "x", source=words, data=data)
        assert _verify(database) is None
        with database.reading() as s:
            assert queries.list_audit(s, limit=1)[0].data == data

    audit()


def test_data_that_is_no_json_is_refused(database: Database) -> None:
    """NaN has no form in JSON."""
    with pytest.raises(ValueError, match="JSON"), database.begin() as s:
        queries.append_audit(s, at=1.0, actor="a", action="b", target="c", data={"x": float("nan")})


def test_an_event_of_what_was_removed_is_kept(database: Database) -> None:
    """A link that is cut because its robot was removed still leaves its event."""
    with database.begin() as s:
        queries.record_event(
            s, at=1.0, kind="offline", source="relay", robot_id=99, user_id=99, data={"n": 1}
        )
        [event] = queries.list_events(s)
    assert (event.robot_id, event.user_id, event.data) == (None, None, {"n": 1})


def test_a_log_that_grows_meanwhile_is_whole(audited: Database) -> None:
    """Entries appended while the chain is being verified are not taken for insertions."""
    with audited.reading() as reader:
        assert queries.verify_audit(reader) is None
        with audited.begin() as s:
            _append(s, 77)
        assert queries.verify_audit(reader) is None
    assert _verify(audited) is None


def test_events_are_listed_latest_first(database: Database) -> None:
    """All, of one robot, or of one kind, up to a limit."""
    with database.begin() as s:
        rover = queries.add_robot(s, "rover")
        queries.record_event(s, at=1.0, kind="online", source="relay", robot_id=rover.id, data={"n": 1})
        queries.record_event(s, at=2.0, kind="login", source="relay", data={"n": 2})
        queries.record_event(s, at=3.0, kind="online", source="relay", data={"n": 3})

        def listed(**only: object) -> list[object]:
            return [event.data["n"] for event in queries.list_events(s, **only)]  # type: ignore[arg-type]

        assert listed() == [3, 2, 1]
        assert listed(limit=2) == [3, 2]
        assert listed(kind="online") == [3, 1]
        assert listed(robot_id=rover.id) == [1]
        assert queries.purge_events(s, before=2.5) == 2
        assert listed() == [3]


def test_events_are_forgotten_in_batches_by_age_and_by_number(database: Database) -> None:
    """The oldest first, so many at a time; none is left over the bound however young."""
    with database.begin() as s:
        for number in range(10):
            queries.record_event(s, at=float(number), kind="online", source="relay", data={})

        def left() -> list[float]:
            return sorted(event.at for event in queries.list_events(s))

        assert queries.purge_events(s, before=5.0, most=100, batch=3) == 3
        assert left() == [3, 4, 5, 6, 7, 8, 9]
        assert [queries.purge_events(s, before=5.0, most=2, batch=2) for _ in range(4)] == [2, 2, 1, 0]
        assert left() == [8, 9]
        assert queries.purge_events(s, before=5.0) == 0


def test_when_robots_were_removed(database: Database) -> None:
    """By the audit log: the last time of each, and of none that were not asked about."""
    with database.begin() as s:
        for at, action, target in (
            (1.0, "robot.remove", "rover"),
            (2.0, "robot.remove", "rover"),
            (3.0, "robot.add", "rover"),
            (4.0, "robot.remove", "tank"),
        ):
            queries.append_audit(s, at=at, actor="cli:root", action=action, target=target)
        assert queries.removed_robots(s, {"rover", "arm"}) == {"rover": 2.0}
        assert queries.removed_robots(s, ()) == {}
