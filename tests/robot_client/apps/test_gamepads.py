"""Gamepads by pygame: virtual joysticks of its SDL, one that SDL does not know."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from pathlib import Path

import pytest

from robot_client.apps.joystick import ButtonLayout, Gamepads, GamepadState

pygame = pytest.importorskip("pygame")

UNKNOWN = 0
"""The kind of joystick for which SDL has no names of buttons."""

LOOSE = GamepadState(0.0, 0.0, False)


@pytest.fixture
def sdl(monkeypatch: pytest.MonkeyPatch) -> Iterator[ctypes.CDLL]:
    """The SDL library of pygame; at the end pygame is closed."""
    for each in ("SDL_VIDEODRIVER", "SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS", "SDL_NO_SIGNAL_HANDLERS"):
        monkeypatch.setenv(each, "dummy" if each.endswith("DRIVER") else "1")
    lines = Path("/proc/self/maps").read_text().splitlines()
    yield ctypes.CDLL(next(line.split()[-1] for line in lines if "libSDL2-" in line))
    pygame.quit()


def plug(sdl: ctypes.CDLL) -> int:
    """Plugs in another gamepad; returns its number."""
    number = int(sdl.SDL_JoystickAttachVirtual(UNKNOWN, 6, 15, 0))
    assert number >= 0
    return number


def test_a_pad_that_sdl_does_not_know_is_gone_when_it_is_unplugged(sdl: ctypes.CDLL) -> None:
    """Its last state does not count as held."""
    gamepads = Gamepads(ButtonLayout())
    assert gamepads.read() is None
    number = plug(sdl)
    assert gamepads.read() == LOOSE
    assert gamepads.read() == LOOSE
    sdl.SDL_JoystickDetachVirtual(number)
    assert gamepads.read() is None
    assert gamepads.read() is None
    assert gamepads.name == ""


def test_between_two_pads_there_is_none(sdl: ctypes.CDLL) -> None:
    """The state of the first ends, even if the second is connected."""
    gamepads = Gamepads(ButtonLayout())
    first = plug(sdl)
    assert gamepads.read() == LOOSE
    plug(sdl)
    assert gamepads.read() == LOOSE
    sdl.SDL_JoystickDetachVirtual(first)
    assert gamepads.read() is None
    assert gamepads.read() == LOOSE
