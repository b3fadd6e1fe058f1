"""A device with a touch screen, and a phone with tilt sensors, by Chromium's DevTools protocol."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from itertools import cycle

from playwright.sync_api import Locator, Page

from tests.worlds.waiting import PATIENCE, wait_for

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


class TouchPointer:
    """The only finger on the screen of a page whose context has touch."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self._session = page.context.new_cdp_session(page)
        self._down = False

    def press(self, what: Locator, dx: float = 0, dy: float = 0) -> None:
        """Puts it on the middle of an element, and moves it away from there (pixels)."""
        x, y = self._middle(what)
        self._put(x, y)
        if dx or dy:
            for step in range(1, MOVES + 1):
                self._tell("touchMove", (x + dx * step / MOVES, y + dy * step / MOVES))

    def lift(self) -> None:
        """Lifts it, if it is down."""
        if self._down:
            self._tell("touchEnd")
            self._down = False

    def _middle(self, what: Locator) -> tuple[float, float]:
        """The middle of an element, once it can be touched."""
        # Not only scrolled into view: also not covered by the top bar.
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


class Phone(TouchPointer):
    """A phone whose sensors report its orientation only on request."""

    def __init__(self, page: Page) -> None:
        super().__init__(page)
        # Headless Chromium grants a page no sensors by itself.
        page.context.grant_permissions(["accelerometer", "gyroscope"])
        self._tremor = cycle((-TREMOR, TREMOR))

    def tilt(self, beta: float) -> None:
        """The sensors report the orientation once.

        :param beta: degrees by which the upper edge is raised
        """
        angles = {"alpha": 0, "beta": beta + next(self._tremor), "gamma": 0}
        self._session.send("DeviceOrientation.setDeviceOrientationOverride", angles)

    def tilt_until(
        self, what: str, fact: Callable[[], object], beta: float, seconds: float = PATIENCE
    ) -> None:
        """The sensors report continuously until the condition holds."""

        def so() -> object:
            self.tilt(beta)
            return fact()

        wait_for(what, so, seconds)

    def hold_tilted(self, button: Locator, what: str, obeyed: Callable[[], object], beta: float) -> None:
        """Holds a button at rest, then tilts, until the robot obeys.

        Repeated if a busy machine made the sensors seem silent.
        """

        def held() -> bool:
            self.lift()
            # Located before the sensors report, since their values soon become too old for a press.
            x, y = self._middle(button)
            self._at_rest()
            self._put(x, y)
            with suppress(AssertionError):
                self.tilt_until(what, obeyed, beta, OBEYED_SECONDS)
                return True
            return False

        wait_for(what, held)

    def _at_rest(self) -> None:
        """The orientation at the touch counts as level."""
        self.page.evaluate(LISTENS)

        def reported() -> bool:
            beta = self.page.evaluate("betaTold")
            return beta is not None and abs(beta - LEVEL) <= 2 * TREMOR

        self.tilt_until("the page knows how the phone is held", reported, LEVEL)
