"""Output of a module, with a clock that stands still unless it is set."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from robot_client.modules.module_output import ModuleOutput, OutputLoss

MIB = 1024 * 1024
DROPPED = "bytes of output were dropped: more than 1048576 bytes a second to one stream"


class World:
    """An output with its lines, its clock and its calls that are due."""

    def __init__(self) -> None:
        self.now = 0.0
        self.lines: list[tuple[str, str]] = []
        self.notes: list[tuple[str, str]] = []
        self.later: list[tuple[float, Callable[[], None]]] = []
        self.drops = 0
        self.output = ModuleOutput(
            "out",
            lambda *line: self.lines.append(line),
            lambda *note: self.notes.append(note),
            lambda *call: self.later.append(call),
            self._dropped,
            lambda: self.now,
        )

    def _dropped(self) -> None:
        self.drops += 1


@pytest.fixture
def world() -> World:
    return World()


def test_lines_are_put_together_from_their_parts(world: World) -> None:
    for part in (b"one\ntw", b"o\nth", b"ree"):
        assert world.output.received(part)
    world.output.ended()
    assert world.lines == [("out", "one"), ("out", "two"), ("out", "three")]


def test_four_mebibytes_are_kept_at_once_and_one_a_second(world: World) -> None:
    block = b"x" * MIB
    assert [world.output.received(block) for _ in range(5)] == [True] * 4 + [False]
    world.now = 1.0
    assert [world.output.received(block) for _ in range(2)] == [True, False]


def test_a_line_costs_more_than_its_bytes(world: World) -> None:
    assert [world.output.received(b"\n" * 64 * 1024) for _ in range(2)] == [True, False]


def test_what_was_dropped_is_reported_once_a_second_also_if_nothing_follows(world: World) -> None:
    world.output.drop(1000)
    world.output.drop(234)
    ((seconds, report),) = world.later
    assert (seconds, world.notes) == (1.0, [])
    report()
    assert world.notes == [("error", f"1234 {DROPPED}")]
    world.output.drop(1)
    assert (len(world.later), world.drops) == (2, 3)


def test_the_end_reports_what_was_dropped(world: World) -> None:
    world.output.drop(7)
    world.output.ended()
    world.later[0][1]()
    assert world.notes == [("error", f"7 {DROPPED}")]


NO_ROOM = "without its log, into which lines can't be written: No space left on device"
FLOOD = "without part of its log: it writes more than 1 MiB a second to one of its streams"


def test_full_disk_is_a_loss_until_two_seconds_after_the_last_lost_line() -> None:
    loss = OutputLoss()
    reasons = []
    for now, is_lost in ((0.0, True), (1.0, True), (2.5, False), (3.0, False)):
        if is_lost:
            loss.not_written(now, "No space left on device")
        again = loss.update(now)
        reasons.append((loss.reason, again))
    assert reasons == [(NO_ROOM, True)] * 3 + [("", False)]


def test_flood_is_a_loss_after_ten_seconds() -> None:
    loss = OutputLoss()
    assert not loss.update(0.0)
    for second in range(11):
        loss.dropped(float(second))
        assert loss.update(float(second))
        assert loss.reason == (FLOOD if second == 10 else "")
    assert not loss.update(12.0)
    assert loss.reason == ""


def test_short_floods_are_no_loss() -> None:
    loss = OutputLoss()
    for second in range(0, 30, 3):
        loss.dropped(float(second))
        loss.update(float(second))
        assert loss.reason == ""
