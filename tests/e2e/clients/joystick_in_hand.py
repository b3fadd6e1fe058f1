"""The joystick program with an SDL gamepad that is moved by lines on the standard input.

``plug``, ``unplug``, ``axis NUMBER VALUE``, ``button NUMBER 0|1``; the arguments are those of the program.
The gamepad is a virtual joystick of the SDL library that pygame contains, which pygame itself does not offer.
All but the device is real.
"""

from __future__ import annotations

import ctypes
import sys
import threading
from pathlib import Path

import pygame

from robot_client.apps import joystick

GAMEPAD = 1
AXES, BUTTONS = 6, 15


def sdl() -> ctypes.CDLL:
    """The SDL that pygame has loaded."""
    for line in Path("/proc/self/maps").read_text().splitlines():
        path = line.split()[-1]
        if "libSDL2-" in path:
            return ctypes.CDLL(path)
    raise SystemExit("pygame has loaded no SDL 2")


class Hand:
    """Moves the gamepad."""

    def __init__(self) -> None:
        self._sdl = sdl()
        self._sdl.SDL_JoystickOpen.restype = ctypes.c_void_p
        self._pad = ctypes.c_void_p()
        self._index = -1

    def plug(self) -> None:
        self._index = self._sdl.SDL_JoystickAttachVirtual(GAMEPAD, AXES, BUTTONS, 0)
        assert self._index >= 0, "no virtual joystick"
        self._pad = ctypes.c_void_p(self._sdl.SDL_JoystickOpen(self._index))

    def unplug(self) -> None:
        self._sdl.SDL_JoystickDetachVirtual(self._index)

    def axis(self, number: str, value: str) -> None:
        self._sdl.SDL_JoystickSetVirtualAxis(
            self._pad, int(number), ctypes.c_int16(round(float(value) * 32767))
        )

    def button(self, number: str, pressed: str) -> None:
        self._sdl.SDL_JoystickSetVirtualButton(self._pad, int(number), ctypes.c_uint8(int(pressed)))

    def obey(self) -> None:
        """Runs commands until the standard input ends."""
        for line in sys.stdin:
            what, *arguments = line.split()
            getattr(self, what)(*arguments)


if __name__ == "__main__":
    pygame.joystick.init()
    threading.Thread(target=Hand().obey, daemon=True).start()
    joystick.main()
