"""Gamepads by pygame, without a window: what SDL says of the first there is."""

from __future__ import annotations

import os
from typing import Any, NamedTuple, Protocol

import click

from robot_client.apps.deadman import GamepadState

FULL = 32767.0
"""What SDL says of an axis at its end."""


class Gamepad(Protocol):
    """Anything one drives by."""

    @property
    def name(self) -> str:
        """In words, for people; empty where there is none."""

    def look(self) -> GamepadState | None:
        """How it is now; ``None`` where there is none, and once where it is another than before."""


class Layout(NamedTuple):
    """Where a pad has what, by the numbers of pygame: as pads of the Xbox kind have it.

    :ivar ahead: axis; -1 is away from oneself
    :ivar left: axis; -1 is to the left
    :ivar hold: the dead man's button, on the right shoulder
    :ivar stop: button (B)
    :ivar back: button that gives control back
    """

    ahead: int = 1
    left: int = 0
    hold: int = 5
    stop: int = 1
    back: int = 6


class Gamepads:
    """The first gamepad there is; one that is unplugged is gone, and the next one counts.

    :param layout: of pads that SDL does not know; what it knows has the same buttons in the same places
    :raises click.ClickException: there is no pygame
    """

    def __init__(self, layout: Layout) -> None:
        # Without a window there is no focus to have; signals are ours.
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
        os.environ["SDL_JOYSTICK_ALLOW_BACKGROUND_EVENTS"] = "1"
        os.environ["SDL_NO_SIGNAL_HANDLERS"] = "1"
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        try:
            import pygame
            from pygame._sdl2 import controller
        except ImportError as error:
            raise click.ClickException(f"a gamepad takes pygame: pip install '.[apps]' ({error})") from None
        self._pygame: Any = pygame
        self._controller: Any = controller
        self._layout = layout
        self._open: Any = None
        self._known = False
        pygame.display.init()  # events come by it
        pygame.joystick.init()
        controller.init()

    @property
    def name(self) -> str:
        """What it calls itself."""
        return "" if self._open is None else str(self._open.name)

    def look(self) -> GamepadState | None:
        """How it is now."""
        # Takes what has come. Only of a pad that SDL does not know nothing but the queue says that it is gone.
        removed = {
            event.instance_id
            for event in self._pygame.event.get()
            if event.type == self._pygame.JOYDEVICEREMOVED
        }
        if self._open is not None and not self._there(removed):
            self._open.quit()
            self._open = None
            # Also where another is there already: what was held was held on this one.
            return None
        if self._open is None and self._pygame.joystick.get_count():
            self._take()
        if self._open is None:
            return None
        return self._known_look() if self._known else self._plain_look()

    def _there(self, removed: set[int]) -> bool:
        if self._known:
            return bool(self._open.attached())
        return self._open.get_init() and self._open.get_instance_id() not in removed

    def _take(self) -> None:
        self._known = bool(self._controller.is_controller(0))
        self._open = self._controller.Controller(0) if self._known else self._pygame.joystick.Joystick(0)

    def _known_look(self) -> GamepadState:
        pygame, pad = self._pygame, self._open
        return GamepadState(
            -pad.get_axis(pygame.CONTROLLER_AXIS_LEFTY) / FULL,
            -pad.get_axis(pygame.CONTROLLER_AXIS_LEFTX) / FULL,
            bool(pad.get_button(pygame.CONTROLLER_BUTTON_RIGHTSHOULDER)),
            bool(pad.get_button(pygame.CONTROLLER_BUTTON_B)),
            bool(pad.get_button(pygame.CONTROLLER_BUTTON_BACK)),
        )

    def _plain_look(self) -> GamepadState:
        layout = self._layout
        return GamepadState(
            -self._axis(layout.ahead),
            -self._axis(layout.left),
            self._button(layout.hold),
            self._button(layout.stop),
            self._button(layout.back),
        )

    def _axis(self, number: int) -> float:
        return float(self._open.get_axis(number)) if number < self._open.get_numaxes() else 0.0

    def _button(self, number: int) -> bool:
        return bool(self._open.get_button(number)) if number < self._open.get_numbuttons() else False
