"""How a gamepad is held, and what its stick means. Pure.

Nothing moves unless the dead man's button is held. Whatever ends that against the will of who holds it (the pad or
the connection is gone, control is lost, the robot was stopped) has the stick and the button let go of before they count
again.
"""

from __future__ import annotations

import enum
import math
from typing import NamedTuple

FROZEN = 0.5
"""Seconds between two looks after which what is held is not believed any more: the program stood still."""


class GamepadState(NamedTuple):
    """A gamepad at one moment.

    :ivar ahead: of the stick, from -1 (towards oneself) to 1
    :ivar left: of the stick, from -1 (right) to 1
    :ivar held: whether the dead man's button is pressed
    :ivar stop: whether the stop button is
    :ivar back: whether the button that gives control back is
    """

    ahead: float
    left: float
    held: bool
    stop: bool = False
    back: bool = False


class Stick(NamedTuple):
    """What is asked for, in parts of the fastest: from -1 to 1, ahead and to the left."""

    ahead: float
    left: float


CENTRE = Stick(0.0, 0.0)


class Curve(NamedTuple):
    """What a stick's deflection means.

    :ivar dead: the deflection below which it counts as in its middle: worn sticks never quite return
    :ivar expo: from 0 (in proportion) to 1 (by the third power: gentle near the middle)
    """

    dead: float = 0.15
    expo: float = 0.4

    def bend(self, look: GamepadState) -> Stick:
        """Nothing in the middle, no jump where that ends, and all at the rim."""
        far = math.hypot(look.ahead, look.left)
        if not math.isfinite(far) or far <= self.dead:
            return CENTRE
        part = (min(far, 1.0) - self.dead) / (1.0 - self.dead)
        strength = (1.0 - self.expo) * part + self.expo * part**3
        return Stick(look.ahead / far * strength, look.left / far * strength)


class DeadmanPhase(enum.Enum):
    """How the pad is held."""

    ABSENT = "no gamepad"
    SPENT = "let go of stick and button"
    READY = "hold the button to drive"
    HELD = "driving"


class DriveEnd(enum.Enum):
    """What ended driving."""

    RELEASED = "the button was released"
    GONE = "the gamepad is gone"
    FROZEN = "the program stood still for too long"
    NOT_ALLOWED = "driving is not possible any more"


class Deadman:
    """What one look after the other means.

    :param curve: of the stick
    :ivar phase: how the pad is held now
    :ivar ended: what ended driving last
    """

    def __init__(self, curve: Curve) -> None:
        self.phase = DeadmanPhase.ABSENT
        self.ended: DriveEnd | None = None
        self._curve = curve
        self._looked = math.inf

    def look(self, look: GamepadState | None, allowed: bool, now: float) -> Stick | None:
        """What the robot is to do now; ``None``: nothing, and where something was under way, to stand.

        :param look: ``None`` where there is no gamepad
        :param allowed: whether driving is possible at all
        :param now: seconds, suspends included
        """
        froze, self._looked = now - self._looked > FROZEN, now
        stick = CENTRE if look is None else self._curve.bend(look)
        if self.phase is DeadmanPhase.HELD:
            self._hold(look, allowed, froze)
            return stick if self.phase is DeadmanPhase.HELD else None
        if look is None:
            self.phase = DeadmanPhase.ABSENT
        elif self.phase is DeadmanPhase.READY and look.held:
            # The hand begins in the middle: a robot follows only who has let go before.
            self.phase = DeadmanPhase.HELD if allowed else DeadmanPhase.SPENT
            return CENTRE if allowed else None
        elif self.phase is not DeadmanPhase.READY:
            self.phase = DeadmanPhase.READY if not look.held and stick == CENTRE else DeadmanPhase.SPENT
        return None

    def drop(self) -> None:
        """What is held counts no more until it was let go of."""
        if self.phase is not DeadmanPhase.ABSENT:
            self.phase = DeadmanPhase.SPENT

    def _hold(self, look: GamepadState | None, allowed: bool, froze: bool) -> None:
        if look is None:
            self.phase, self.ended = DeadmanPhase.ABSENT, DriveEnd.GONE
        elif not look.held:
            self.phase, self.ended = DeadmanPhase.READY, DriveEnd.RELEASED
        elif froze:
            self.phase, self.ended = DeadmanPhase.SPENT, DriveEnd.FROZEN
        elif not allowed:
            self.phase, self.ended = DeadmanPhase.SPENT, DriveEnd.NOT_ALLOWED
