"""Commands that say when they were sent."""

from __future__ import annotations

import pytest

from bench.driving import ages_ms, first_move, sent_before, stamped_turn

MS = 1_000_000


@pytest.mark.parametrize("sent", [0, 123_456_789_012_345, 10**13 - MS])
def test_the_age_of_a_command_is_read_from_the_record(sent: int) -> None:
    """To 0.01 ms, also after the counter has restarted."""
    record = [
        {"event": "command", "t": sent + 250 * MS, "v": 0.2, "w": stamped_turn(sent)},
        {"event": "command", "t": sent + 300 * MS, "v": 0.0, "w": 0.0},
        {"event": "standstill", "t": sent + 310 * MS},
    ]
    assert ages_ms(record) == pytest.approx([250.0], abs=0.01)


@pytest.mark.parametrize(("sent", "before"), [(-MS, True), (0, False), (5 * MS, False)])
def test_a_command_from_before_a_moment_is_known(sent: int, before: bool) -> None:
    """Though it was executed after it; zeros do not count."""
    moment = 123_456_789_012_000
    record = [
        {"event": "command", "t": moment + 300 * MS, "v": 0.0, "w": 0.0},
        {"event": "command", "t": moment + 400 * MS, "v": 0.2, "w": stamped_turn(moment + sent)},
        {"event": "moving", "t": moment + 401 * MS},
    ]
    assert sent_before(moment, record) is before


@pytest.mark.parametrize(("v", "w"), [(0.2, 0.0), (-0.2, 0.0), (0.0, 0.6)])
def test_the_first_command_to_move_is_found(v: float, w: float) -> None:
    """After zeros: forward, backward or turning; with only zeros there is none."""
    zeros = [{"event": "command", "t": 1, "v": 0.0, "w": 0.0}, {"event": "standstill", "t": 2}]
    moves = [{"event": "command", "t": at, "v": v, "w": w} for at in (3, 4)]
    assert first_move(zeros + moves) == 3
    assert first_move(zeros) == 0


def test_text_in_a_command_moves_nothing_else() -> None:
    """The turning speed is the same to 1 in 10,000."""
    assert stamped_turn(10**13 - 1) == pytest.approx(0.6, abs=1.1e-4)
