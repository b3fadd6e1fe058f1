"""Gamepads by pygame: virtual joysticks of its SDL, one that SDL does not know."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from pathlib import Path

import pytest

from robot_client.apps.deadman import GamepadState
from robot_client.apps.gamepads import Gamepads, Layout

pygame = pytest.importorskip("pygame")

UNKNOWN = 0
"""The kind of joystick for which SDL has no names of buttons."""

LOOSE = GamepadState(0.0, 0.0, False)


@pytest.fixture
def sdl(monkeypatch: pytest.MonkeyPatch) -> Iterator[ctypes.CDLL]:
    """The SDL that pygame has loaded; at the end all of it is let go of."""
    for each in ("SDL_VIDEODRIVER", "SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS", "SDL_NO_SIGNAL_HANDLERS"):
        monkeypatch.setenv(each, "dummy" if each.endswith("DRIVER") else "1")
    lines = Path("/proc/self/maps").read_text().splitlines()
    yield ctypes.CDLL(next(line.split()[-1] for line in lines if "libSDL2-" in line))
    pygame.quit()


def plug(sdl: ctypes.CDLL) -> int:
    """One pad more; its number among those there are."""
    number = int(sdl.SDL_JoystickAttachVirtual(UNKNOWN, 6, 15, 0))
    assert number >= 0
    return number


def test_a_pad_that_sdl_does_not_know_is_gone_when_it_is_unplugged(sdl: ctypes.CDLL) -> None:
    """Its last state is not what is held."""
    pads = Gamepads(Layout())
    assert pads.look() is None
    number = plug(sdl)
    assert pads.look() == LOOSE
    assert pads.look() == LOOSE
    sdl.SDL_JoystickDetachVirtual(number)
    assert pads.look() is None
    assert pads.look() is None
    assert pads.name == ""


def test_between_two_pads_there_is_none(sdl: ctypes.CDLL) -> None:
    """So what was held on the first ends, though the second is there already."""
    pads = Gamepads(Layout())
    first = plug(sdl)
    assert pads.look() == LOOSE
    plug(sdl)
    assert pads.look() == LOOSE
    sdl.SDL_JoystickDetachVirtual(first)
    assert pads.look() is None
    assert pads.look() == LOOSE
