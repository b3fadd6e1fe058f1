"""A device with a screen that is touched, and a phone that is tilted: by Chromium's DevTools protocol."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from itertools import cycle

from playwright.sync_api import Locator, Page
from switchboard_waiting import PATIENCE, wait_for

LEVEL = 40.0
"""Degrees by which the upper edge is raised while the phone is held at rest."""

TREMOR = 0.5
"""Degrees: nobody holds a phone quite still, and angles that do not change are not told again."""

LISTENS = """() => {
  if (window.betaTold !== undefined) return
  window.betaTold = null
  addEventListener('deviceorientation', (told) => { window.betaTold = told.beta })
}"""

OBEYED_SECONDS = 4.0
"""Seconds in which a phone that is held and tilted moves something."""

MOVES = 4
"""Steps in which a finger is moved."""


class Finger:
    """The one finger on the screen of a page whose context has touch."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self._session = page.context.new_cdp_session(page)
        self._down = False

    def press(self, what: Locator, dx: float = 0, dy: float = 0) -> None:
        """Put it on the middle of something, and move it away from there (pixels)."""
        x, y = self._middle(what)
        self._put(x, y)
        if dx or dy:
            for step in range(1, MOVES + 1):
                self._tell("touchMove", (x + dx * step / MOVES, y + dy * step / MOVES))

    def lift(self) -> None:
        """Take it off, if it is on."""
        if self._down:
            self._tell("touchEnd")
            self._down = False

    def _middle(self, what: Locator) -> tuple[float, float]:
        """Where the middle of something is, once it can be touched."""
        # Not only scrolled into view: out from under the bar at the top, too.
        what.hover(trial=True)
        box = what.bounding_box()
        assert box is not None
        return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2

    def _put(self, x: float, y: float) -> None:
        self._tell("touchStart", (x, y))
        self._down = True

    def _tell(self, kind: str, *points: tuple[float, float]) -> None:
        touched = [{"x": x, "y": y} for x, y in points]
        self._session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": touched})


class Phone(Finger):
    """A phone whose sensors tell how it is held only when they are made to."""

    def __init__(self, page: Page) -> None:
        super().__init__(page)
        self._tremor = cycle((-TREMOR, TREMOR))

    def tilt(self, beta: float) -> None:
        """The sensors tell once how it is held.

        :param beta: degrees by which the upper edge is raised
        """
        angles = {"alpha": 0, "beta": beta + next(self._tremor), "gamma": 0}
        self._session.send("DeviceOrientation.setDeviceOrientationOverride", angles)

    def tilt_until(
        self, what: str, fact: Callable[[], object], beta: float, seconds: float = PATIENCE
    ) -> None:
        """The sensors go on telling until something is so."""

        def so() -> object:
            self.tilt(beta)
            return fact()

        wait_for(what, so, seconds)

    def hold_tilted(self, button: Locator, what: str, obeyed: Callable[[], object], beta: float) -> None:
        """Hold a button at rest, then tilt, until that is obeyed.

        Once more where the machine was so busy that the phone seemed to have fallen silent.
        """

        def held() -> bool:
            self.lift()
            # Found before the sensors tell: a moment later what they told is too old to press anything.
            x, y = self._middle(button)
            self._at_rest()
            self._put(x, y)
            with suppress(AssertionError):
                self.tilt_until(what, obeyed, beta, OBEYED_SECONDS)
                return True
            return False

        wait_for(what, held)

    def _at_rest(self) -> None:
        """As it is held when it is touched is what counts as level."""
        self.page.evaluate(LISTENS)

        def told() -> bool:
            beta = self.page.evaluate("betaTold")
            return beta is not None and abs(beta - LEVEL) <= 2 * TREMOR

        self.tilt_until("the page knows how the phone is held", told, LEVEL)
