"""Diagnostics of services."""

from __future__ import annotations

from robot_client.services.health import InputWatch, Level


def test_states_of_an_input() -> None:
    """Waiting, received, silent, received again."""
    now = [0.0]
    fresh = InputWatch("/scan", 2.0, lambda: now[0])
    waiting = fresh.problem()
    assert waiting is not None
    assert (waiting.level, waiting.message) == (Level.STALE, "waiting for /scan")
    fresh.received()
    now[0] = 2.0
    assert fresh.problem() is None
    now[0] = 3.4
    silent = fresh.problem()
    assert silent is not None
    assert (silent.level, silent.message) == (Level.STALE, "nothing from /scan for 3 s")
    fresh.received()
    assert fresh.problem() is None
