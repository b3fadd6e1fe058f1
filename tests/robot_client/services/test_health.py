"""What services say of themselves."""

from __future__ import annotations

from robot_client.services.health import InputWatch, Level


def test_an_input_is_waited_for_then_fine_then_silent() -> None:
    """Each in words, and fine again when it comes again."""
    now = [0.0]
    fresh = InputWatch("/scan", 2.0, lambda: now[0])
    waiting = fresh.trouble()
    assert waiting is not None
    assert (waiting.level, waiting.message) == (Level.STALE, "waiting for /scan")
    fresh.came()
    now[0] = 2.0
    assert fresh.trouble() is None
    now[0] = 3.4
    silent = fresh.trouble()
    assert silent is not None
    assert (silent.level, silent.message) == (Level.STALE, "nothing from /scan for 3 s")
    fresh.came()
    assert fresh.trouble() is None
