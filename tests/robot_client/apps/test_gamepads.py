"""Gamepads by pygame: virtual joysticks of its SDL, one that SDL does not know."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from pathlib import Path

import pygame
import pytest

from robot_client.apps.joystick import ButtonLayout, Gamepads, GamepadState

UNKNOWN = 0
"""The kind of joystick for which SDL has no names of buttons."""

KNOWN = 1
"""A gamepad whose buttons SDL knows."""

LAYOUT = ButtonLayout(ahead=1, left=0, hold=5, stop=1, back=6)

LOOSE = GamepadState(0.0, 0.0, False)


@pytest.fixture
def sdl(monkeypatch: pytest.MonkeyPatch) -> Iterator[ctypes.CDLL]:
    """The SDL library of pygame; at the end all gamepads are unplugged and pygame is closed."""
    for each in ("SDL_VIDEODRIVER", "SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS", "SDL_NO_SIGNAL_HANDLERS"):
        monkeypatch.setenv(each, "dummy" if each.endswith("DRIVER") else "1")
    lines = Path("/proc/self/maps").read_text().splitlines()
    library = ctypes.CDLL(next(line.split()[-1] for line in lines if "libSDL2-" in line))
    yield library
    for device in reversed(range(library.SDL_NumJoysticks())):
        library.SDL_JoystickDetachVirtual(device)
    pygame.quit()


def plug(sdl: ctypes.CDLL, kind: int = UNKNOWN, axes: int = 6, buttons: int = 15) -> int:
    """Plugs in another gamepad; returns its number."""
    number = int(sdl.SDL_JoystickAttachVirtual(kind, axes, buttons, 0))
    assert number >= 0
    return number


def test_a_pad_that_sdl_does_not_know_is_gone_when_it_is_unplugged(sdl: ctypes.CDLL) -> None:
    """Its last state does not count as held."""
    gamepads = Gamepads(LAYOUT)
    assert gamepads.read() is None
    number = plug(sdl)
    assert gamepads.read() == LOOSE
    assert gamepads.read() == LOOSE
    sdl.SDL_JoystickDetachVirtual(number)
    assert gamepads.read() is None
    assert gamepads.read() is None
    assert gamepads.problem == ""


def test_between_two_pads_there_is_none(sdl: ctypes.CDLL) -> None:
    """The state of the first ends, even if the second is connected."""
    gamepads = Gamepads(LAYOUT)
    first = plug(sdl)
    assert gamepads.read() == LOOSE
    plug(sdl)
    assert gamepads.read() == LOOSE
    sdl.SDL_JoystickDetachVirtual(first)
    assert gamepads.read() is None
    assert gamepads.read() == LOOSE


def press(sdl: ctypes.CDLL, number: int, button: int) -> None:
    """Presses a button of a gamepad, by its number."""
    sdl.SDL_JoystickOpen.restype = ctypes.c_void_p
    pad = ctypes.c_void_p(sdl.SDL_JoystickOpen(number))
    sdl.SDL_JoystickSetVirtualButton(pad, button, ctypes.c_uint8(1))


def test_a_pad_that_sdl_does_not_know_drives_only_with_a_layout(sdl: ctypes.CDLL) -> None:
    """Without one its pressed buttons are shown."""
    gamepads = Gamepads(None)
    assert gamepads.read() is None
    assert gamepads.problem == ""
    number = plug(sdl)
    assert gamepads.read() is None
    assert "is not known; give --axes and --buttons (pressed: no button)" in gamepads.problem
    press(sdl, number, 5)
    assert gamepads.read() is None
    assert "(pressed: 5)" in gamepads.problem
    sdl.SDL_JoystickDetachVirtual(number)
    assert gamepads.read() is None
    assert gamepads.problem == ""


@pytest.mark.parametrize("layout", [None, LAYOUT])
def test_an_unknown_device_in_the_first_slot_does_not_hide_a_gamepad(
    sdl: ctypes.CDLL, layout: ButtonLayout | None
) -> None:
    gamepads = Gamepads(layout)
    plug(sdl)
    number = plug(sdl, KNOWN)
    assert gamepads.read() == LOOSE
    assert gamepads.problem == ""
    press(sdl, number, 10)
    assert gamepads.read() == LOOSE._replace(pressed=True)


def test_a_device_without_the_axes_of_the_layout_does_not_hide_a_pad_that_has_them(sdl: ctypes.CDLL) -> None:
    """Neither of them is known to SDL."""
    gamepads = Gamepads(LAYOUT)
    plug(sdl, axes=1, buttons=1)
    assert gamepads.read() is None
    assert "lacks axes or buttons of --axes and --buttons" in gamepads.problem
    number = plug(sdl)
    assert gamepads.read() == LOOSE
    assert gamepads.problem == ""
    press(sdl, number, LAYOUT.hold)
    assert gamepads.read() == LOOSE._replace(pressed=True)
