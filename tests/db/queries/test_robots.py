"""Robots, keys and enrolment codes, on both databases."""

from __future__ import annotations

import threading
from itertools import count

import pytest
from sqlalchemy.orm import Session

from relay_db import queries
from relay_db.engine import Database
from relay_db.queries import RobotKeyRecord, RobotRecord, robots
from relay_protocol.errors import Invalid, NotFound, Refused
from relay_protocol.identity import fingerprint

CODE = "c" * 64
KEY = b"k" * 32


_codes = (f"{number:064x}" for number in count(1))


def _enrol(s: Session, robot: RobotRecord, key: bytes = KEY, now: float = 5.0) -> RobotRecord:
    code = next(_codes)
    queries.issue_enrolment_code(s, robot.id, code, now + 1)
    return queries.redeem_enrolment_code(s, robot.name, code, key, fingerprint(key), "robot 1", now)


@pytest.fixture
def rover(database: Database) -> RobotRecord:
    """A robot without a key."""
    with database.begin() as s:
        return queries.add_robot(s, "rover", "the small one")


def test_a_robot_is_found_by_its_name(database: Database, rover: RobotRecord) -> None:
    with database.reading() as s:
        assert queries.find_robot(s, "rover") == RobotRecord(rover.id, "rover", "default", "the small one")
        assert queries.list_robots(s) == [rover]
        assert queries.list_robots(s, "elsewhere") == []


@pytest.mark.parametrize("name", ["Rover", "", "a b", "-a", "a/b", "a" * 64, "a\n"])
def test_a_robot_name_that_cannot_be_is_refused(database: Database, name: str) -> None:
    """Names are part of URLs."""
    with database.begin() as s, pytest.raises(Invalid, match="a robot's name"):
        queries.add_robot(s, name)


def test_a_robot_is_not_called_like_an_address_of_the_relay(database: Database) -> None:
    """Its own page would be out of reach."""
    with database.begin() as s, pytest.raises(Invalid, match="cannot have the name 'stream'"):
        queries.add_robot(s, "stream")


def test_live_keys_of_many_robots_are_asked_for_at_once(
    database: Database, rover: RobotRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Unknown, retired and other robots' keys are not included."""
    monkeypatch.setattr(robots, "_BATCH", 2)
    with database.begin() as s:
        fleet = [rover, *(queries.add_robot(s, f"robot-{number}") for number in range(4))]
        pairs = set()
        for number, robot in enumerate(fleet):
            for old in (0, 1):
                key = bytes([number, old]) * 16
                _enrol(s, robot, key)
                pairs.add((robot.id, fingerprint(key)))
        retired = (rover.id, fingerprint(bytes([0, 1]) * 16))
        queries.revoke_key(s, *retired, now=9.0)
        queries.remove_robot(s, fleet[4].id)
        live = {pair for pair in pairs if pair != retired and pair[0] != fleet[4].id}
        strange = {
            (rover.id, "ffff"),
            (999, fingerprint(KEY)),
            (fleet[1].id, fingerprint(bytes(32))),
            (1, "x\0"),
        }
        assert queries.live_keys(s, pairs | strange) == live
        assert queries.live_keys(s, []) == set()
        assert queries.live_keys(s, [(rover.id, fingerprint(bytes(32)))]) == {
            (rover.id, fingerprint(bytes(32)))
        }


def test_a_robot_name_is_taken_once(database: Database, rover: RobotRecord) -> None:
    """A second robot of the name is refused."""
    with database.begin() as s, pytest.raises(Invalid, match="already"):
        queries.add_robot(s, rover.name)


def test_a_code_makes_a_key_live(database: Database, rover: RobotRecord) -> None:
    """With the right code, in time."""
    with database.begin() as s:
        queries.issue_enrolment_code(s, rover.id, CODE, expires=10.0)
        got = queries.redeem_enrolment_code(s, "rover", CODE, KEY, fingerprint(KEY), "robot\x1b 1", 5.0)
    assert got == rover
    with database.reading() as s:
        assert queries.robot_key(s, "rover", fingerprint(KEY)) == RobotKeyRecord(
            rover.id, "rover", "default", KEY
        )
        assert queries.list_keys(s, rover.id) == [
            queries.KeyRecord(fingerprint(KEY), "robot\\x1b 1", 5.0, None)
        ]


def test_all_wrong_codes_get_the_same_error(database: Database, rover: RobotRecord) -> None:
    """Unknown robot, wrong, expired, used, replaced or another robot's code: the same error."""
    with database.begin() as s:
        other = queries.add_robot(s, "other")
        queries.issue_enrolment_code(s, other.id, "d" * 64, expires=10.0)
        queries.issue_enrolment_code(s, rover.id, "e" * 64, expires=10.0)
        queries.issue_enrolment_code(s, rover.id, CODE, expires=10.0)

    def reported(name: str, code: str, now: float = 5.0) -> str:
        with pytest.raises(Refused) as caught, database.begin() as s:
            queries.redeem_enrolment_code(s, name, code, KEY, fingerprint(KEY), "", now)
        return str(caught.value)

    sentences = {
        reported("nobody", CODE),
        reported("No such\x00name", CODE),
        reported("rover", "f" * 64),
        reported("rover", "d" * 64),
        reported("rover", "e" * 64),
        reported("rover", CODE, now=10.0),
    }
    with database.begin() as s:
        queries.redeem_enrolment_code(s, "rover", CODE, KEY, fingerprint(KEY), "", 9.9)
    sentences.add(reported("rover", CODE))
    assert len(sentences) == 1


def test_a_code_is_redeemed_by_one_of_two_at_once(database: Database, rover: RobotRecord) -> None:
    """Two threads send different keys with one code: one succeeds, the other is refused."""
    with database.begin() as s:
        queries.issue_enrolment_code(s, rover.id, CODE, expires=10.0)
    start = threading.Barrier(2)
    outcomes: list[str] = []

    def hand_in(key: bytes) -> None:
        start.wait(timeout=30)
        try:
            with database.begin() as s:
                queries.redeem_enrolment_code(s, "rover", CODE, key, fingerprint(key), "", 5.0)
            outcomes.append("in")
        except Refused:
            outcomes.append("refused")

    threads = [threading.Thread(target=hand_in, args=(bytes([number]) * 32,)) for number in (1, 2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=30)
    assert sorted(outcomes) == ["in", "refused"]
    with database.reading() as s:
        assert len(queries.list_keys(s, rover.id)) == 1


def test_a_third_key_retires_the_oldest(database: Database, rover: RobotRecord) -> None:
    """At most two keys are live."""
    keys = [bytes([number]) * 32 for number in (1, 2, 3)]
    with database.begin() as s:
        for number, key in enumerate(keys):
            _enrol(s, rover, key, now=float(number))
        assert [each.retired for each in queries.list_keys(s, rover.id)] == [None, None, 2.0]
        live = [queries.robot_key(s, "rover", fingerprint(key)) is not None for key in keys]
    assert live == [False, True, True]


def test_the_same_key_may_come_twice(database: Database, rover: RobotRecord) -> None:
    """A robot that did not get the answer tries again with a new code: nothing changes."""
    with database.begin() as s:
        _enrol(s, rover)
        _enrol(s, rover)
        assert len(queries.list_keys(s, rover.id)) == 1


def test_a_revoked_key_stays_revoked(database: Database, rover: RobotRecord) -> None:
    """It is refused, cannot be revoked again, and no code restores it."""
    with database.begin() as s:
        _enrol(s, rover)
        queries.revoke_key(s, rover.id, fingerprint(KEY), 7.0)
        assert queries.robot_key(s, "rover", fingerprint(KEY)) is None
    for name in (fingerprint(KEY), "feedface", "\x00", ""):
        with pytest.raises(NotFound), database.begin() as s:
            queries.revoke_key(s, rover.id, name, 8.0)
    with pytest.raises(Invalid, match="retired"), database.begin() as s:
        _enrol(s, rover)


def test_a_refused_key_does_not_spend_the_code(database: Database, rover: RobotRecord) -> None:
    """Both are in one transaction: when the key is refused, the code stays valid."""
    with database.begin() as s:
        queries.issue_enrolment_code(s, rover.id, CODE, expires=10.0)
    with pytest.raises(Invalid, match="32 bytes"), database.begin() as s:
        queries.redeem_enrolment_code(s, "rover", CODE, b"short", "ff", "", 5.0)
    with database.begin() as s:
        queries.redeem_enrolment_code(s, "rover", CODE, KEY, fingerprint(KEY), "", 5.0)


def test_a_removed_robot_leaves_nothing(database: Database, rover: RobotRecord) -> None:
    """Keys and rights are removed, and its number is not used again."""
    with database.begin() as s:
        _enrol(s, rover)
        ann = queries.add_user(s, "ann", None)
        queries.grant_right(s, rover.id, "viewer", user_id=ann.id)
        queries.remove_robot(s, rover.id)
        assert queries.robot_key(s, "rover", fingerprint(KEY)) is None
        assert queries.list_rights(s) == []
        assert queries.add_robot(s, "rover").id != rover.id
        for change in (
            lambda: queries.remove_robot(s, rover.id),
            lambda: queries.issue_enrolment_code(s, rover.id, "9" * 64, 1.0),
        ):
            with pytest.raises(NotFound):
                change()
