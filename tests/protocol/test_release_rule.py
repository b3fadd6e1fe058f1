"""When the controls must be released before a source commands again: the rule shared by relay and robot."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from relay_protocol.release_rule import (
    HELD_NS,
    QUEUED_NS,
    RECONNECT_NS,
    RELEASE_NS,
    CommandStreams,
    ReconnectGuard,
    StreamsBeforeLoss,
    is_released,
)

MS = 1_000_000
USER = 7
SOURCE = 3
WHEELS = "/cmd_vel"


def test_the_contract() -> None:
    """The values in SPEC 1.7 and 2.5."""
    assert (RELEASE_NS, RECONNECT_NS, HELD_NS, QUEUED_NS) == (500 * MS, 5000 * MS, 1000 * MS, 300_000 * MS)


@pytest.mark.parametrize(
    ("steps", "must_release"),
    [
        ("", False),
        ("refused@0", True),
        ("refused@0 sent@499", True),
        ("refused@0 sent@500", False),
        ("refused@0 refused@400 sent@899", True),
        ("refused@0 refused@400 sent@900", False),
        ("refused@0 zero", False),
        ("refused@0 zero refused@10 sent@20", True),
        ("moves@0 sent@10", False),
        ("moves@0 stop sent@10", True),
        ("moves@0 stop sent@500", False),
        ("moves@0 stop restart@400 sent@899", True),
        ("moves@0 stop zero", False),
        ("refused@0 other@0 sent@10", True),
    ],
)
def test_a_stream_is_released_by_zero_or_by_silence(steps: str, must_release: bool) -> None:
    """One row for each case; times in milliseconds."""
    streams: CommandStreams[str] = CommandStreams(8)
    sent = 0
    for step in steps.split():
        what, _, ms = step.partition("@")
        now = int(ms or 0) * MS
        actions: dict[str, Callable[[], object]] = {
            "refused": lambda now=now: streams.refused(WHEELS, now),  # type: ignore[misc]
            "other": lambda now=now: streams.refused("/arm", now),  # type: ignore[misc]
            "moves": lambda now=now: streams.note_command(WHEELS, now, now),  # type: ignore[misc]
            "zero": lambda: streams.zero(WHEELS),
            "stop": streams.all_must_release,
            "restart": lambda now=now: streams.restart_silence(now),  # type: ignore[misc]
            "sent": lambda: None,
        }
        actions[what]()
        sent = now
    assert streams.must_release(WHEELS, sent) is must_release


@pytest.mark.parametrize(
    ("arrived", "sent", "counts", "began"),
    [
        (499, 499, True, False),
        (500, 500, True, True),
        (900, 499, True, False),
        (900, 500, True, True),
        (900, 900, False, False),
    ],
    ids=["short", "long", "a link that stalls", "long before it stalled", "while stopped"],
)
def test_silence_is_what_lies_between_arrival_and_sending(
    arrived: int, sent: int, counts: bool, began: bool
) -> None:
    streams: CommandStreams[str] = CommandStreams(8)
    assert streams.note_command(WHEELS, 0, 0).began
    stream = streams.note_command(WHEELS, arrived * MS, sent * MS, silence_releases=counts)
    assert (stream.began, stream.last) == (began, arrived * MS)


def test_streams_that_must_be_released_outlast_those_that_are() -> None:
    """New streams first displace released ones, then the one with the longest pause."""
    streams: CommandStreams[int] = CommandStreams(4)
    streams.refused(0, 600 * MS)
    for key in (1, 2, 3):
        streams.note_command(key, 0, 0)
    streams.note_command(4, 700 * MS, 700 * MS)
    assert [key in streams for key in range(5)] == [True, False, False, False, True]
    for key in (5, 6, 7):
        streams.refused(key, 700 * MS)
    assert [key in streams for key in (0, 4, 5, 6, 7)] == [False, True, True, True, True]
    assert len(streams) == 4


def test_streams_that_must_be_released_are_kept_while_silence_does_not_count() -> None:
    streams: CommandStreams[int] = CommandStreams(4)
    streams.note_command(1, 0, 0)
    streams.all_must_release()
    streams.note_command(2, 0, 0)
    streams.forget_released(RELEASE_NS, keep_refused=True)
    assert (1 in streams, 2 in streams) == (True, False)
    streams.forget_released(RELEASE_NS)
    assert len(streams) == 0


def test_streams_can_be_required_to_release_by_a_condition() -> None:
    streams: CommandStreams[int] = CommandStreams()
    for key in range(4):
        streams.note_command(key, 0, 0).never_contended = key != 2
    streams.require_release(lambda key, stream: key == 1 or not stream.never_contended)
    assert [streams.must_release(key, 0) for key in range(4)] == [False, True, True, False]


@given(st.lists(st.tuples(st.sampled_from("mrz"), st.integers(0, 700))))
def test_no_stream_that_was_refused_moves_before_zero_or_silence(steps: list[tuple[str, int]]) -> None:
    """For any order of commands, refusals and pauses."""
    streams: CommandStreams[str] = CommandStreams(2)
    now, refused_at = 0, None
    for what, pause in steps:
        now += pause * MS
        if what == "z":
            streams.zero(WHEELS)
            refused_at = None
        elif what == "r":
            streams.refused(WHEELS, now)
            refused_at = now
        elif refused_at is not None and not is_released(refused_at, now):
            assert streams.must_release(WHEELS, now)
            streams.refused(WHEELS, now)
            refused_at = now
        else:
            assert not streams.note_command(WHEELS, now, now).must_release
            refused_at = None


@pytest.mark.parametrize(
    ("released", "away", "silent_since", "queued"),
    [
        (True, 0, 1000, False),
        (True, 400_000, 1000, False),
        (False, 0, 2000, False),
        (False, 5000, 7000, False),
        (False, 5001, None, True),
        (False, 300_000, None, True),
        (False, 300_001, None, False),
    ],
    ids=[
        "released, at once",
        "released, late",
        "held on, at once",
        "held on, within 5 s",
        "after 5 s",
        "after 5 min",
        "later",
    ],
)
def test_reconnecting_does_not_count_as_a_release(
    released: bool, away: int, silent_since: int | None, queued: bool
) -> None:
    """The last command came at 1 s, the connection ended at 2 s; times in milliseconds."""
    guard = ReconnectGuard(8)
    assert guard.silent_since(USER, 0) is None
    guard.connection_ended(USER, 1000 * MS, 2000 * MS, released=released)
    opened = (2000 + away) * MS
    expected = None if silent_since is None else silent_since * MS
    assert guard.silent_since(USER, opened) == expected
    assert guard.may_be_queued(USER, opened, opened + RELEASE_NS - 1) is queued
    assert not guard.may_be_queued(USER, opened, opened + RELEASE_NS)
    assert guard.silent_since(USER + 1, opened) is None
    guard.forget(USER)
    assert guard.silent_since(USER, opened) is None


def test_a_second_connection_that_ends_does_not_excuse_the_first() -> None:
    guard = ReconnectGuard(8)
    guard.connection_ended(USER, 1000 * MS, 2000 * MS, released=False)
    guard.connection_ended(USER, 500 * MS, 2500 * MS, released=True)
    assert guard.silent_since(USER, 2500 * MS) == 2500 * MS


def test_users_whose_connection_ended_are_bounded() -> None:
    guard = ReconnectGuard(2)
    for user in (1, 2, 3):
        guard.connection_ended(user, 0, 0, released=False)
    assert [guard.silent_since(user, 0) is not None for user in (1, 2, 3)] == [False, True, True]


@pytest.mark.parametrize(
    ("steps", "now", "continues"),
    [
        ("", 0, False),
        ("command", 0, False),
        ("restore", 0, False),
        ("command lose restore", 0, True),
        ("command lose restore", 4999, True),
        ("command lose restore", 5000, False),
        ("command lose restore decided_on", 0, False),
        ("control lose restore", 0, True),
        ("control lose restore zero", 0, False),
        ("control lose restore lose restore", 0, True),
    ],
)
def test_the_loss_of_a_link_is_no_release(steps: str, now: int, continues: bool) -> None:
    """For a source that commanded before, and for a user who had control, by any connection."""
    guard = StreamsBeforeLoss(8)
    for step in steps.split():
        {
            "command": lambda: guard.note_command(SOURCE),
            "control": lambda: guard.controlled_by("ann"),
            "lose": guard.link_lost,
            "restore": lambda: guard.link_restored(0),
            "decided_on": lambda: guard.decided_on(SOURCE, WHEELS, 1),
            "zero": lambda: guard.released("ann", WHEELS),
        }[step]()
    assert guard.continues(SOURCE, WHEELS, "ann", now * MS) is continues
    assert guard.lost is steps.endswith("lose")
