"""A phone that is tilted drives the simulated robot: how long until it does, and until the phone shows that it does.

The phone is a page of the portal in Chromium, as wide as one and with a touched screen; its sensors are those of the
DevTools protocol, told before the browser is asked to tell them. What the robot does is in its own record, what the
page shows in that of the page, by the same machine's clock.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from playwright.sync_api import Page, expect

import relay_server
from bench.driving import first_move
from bench.relay import Relay
from bench.report import Unavailable
from tests.worlds.browser import chromium, chromium_path, ready_to_drive, seen
from tests.worlds.robot_process import Robot
from tests.worlds.touch import LEVEL, OBEYED_SECONDS, Phone
from tests.worlds.waiting import wait_for

PHONE: dict[str, Any] = {
    "viewport": {"width": 390, "height": 844},
    "has_touch": True,
    "is_mobile": True,
}
TILT = 28.0
"""Degrees, ahead and back in turn: beyond what counts as far as it goes."""

REST = 0.3
"""Seconds that the button is held and the robot stands before the phone is tilted."""

PATIENCE_MS = 60_000

WATCH = """() => {
  const speed = document.querySelector('[data-testid=odom-speed]')
  window.movesAt = null
  new MutationObserver(() => {
    if (!/[1-9]/.test(speed.textContent)) window.movesAt = null
    else window.movesAt ??= Date.now()
  }).observe(speed, { characterData: true, childList: true, subtree: true })
}"""
"""Keeps since when the page shows a speed that is not zero, Unix milliseconds."""

HELD = """() => movesAt === null
  && document.querySelector('[data-testid=tilt-hold]')?.getAttribute('aria-pressed') === 'true'"""
"""Whether the button is held while the page shows that the robot stands."""


class Tilts(NamedTuple):
    """What came of them.

    :ivar commands: milliseconds from the tilt to the command that the robot carried out
    :ivar shown: milliseconds from the tilt to odometry of it on the page
    :ivar anew: how many were not obeyed within some seconds, and done anew: a page that is held up ends driving
    """

    commands: list[float]
    shown: list[float]
    anew: int


class Tilted:
    """A phone whose page has control of a robot.

    :param page: the robot's cockpit
    """

    def __init__(self, page: Page, robot: Robot) -> None:
        self._page = page
        self._robot = robot
        self.anew = 0
        self._phone = Phone(page)
        ready_to_drive(page)
        page.evaluate(WATCH)
        seen(page, "input-tilt").tap()
        seen(page, "tilt-ask").tap()

    def tilt(self, by: float) -> tuple[float, float]:
        """Hold the button for a while, then tilt; milliseconds to the command, and to what the page shows.

        :param by: degrees by which the upper edge is lowered
        """

        def obeyed() -> tuple[float, float] | None:
            button = seen(self._page, "tilt-hold")
            self._phone.hold_tilted(button, "the button is held", self._rested(), LEVEL)
            since, at = time.monotonic_ns(), time.time()
            try:
                self._phone.tilt_until("it is obeyed", self._moves_at, LEVEL - by, OBEYED_SECONDS)
            except AssertionError:
                self.anew += 1
                return None
            finally:
                self._phone.lift()
            came = wait_for("it is in the record", lambda: first_move(self._robot.events("command", since)))
            return (came - since) / 1e6, self._page.evaluate("shownAt") - at * 1000

        took: tuple[float, float] = wait_for("a tilt is obeyed", obeyed)
        return took

    def _moves_at(self) -> bool:
        """Whether the page shows that the robot moves; since when is kept, as it may stand the next moment."""
        return bool(self._page.evaluate("(window.shownAt = movesAt) !== null"))

    def _rested(self) -> Callable[[], bool]:
        """What tells whether the button is held, and the robot stands, for long enough."""
        since = time.monotonic()

        def rested() -> bool:
            nonlocal since
            if not self._page.evaluate(HELD) or self._robot.moving():
                since = time.monotonic()
            return time.monotonic() - since > REST

        return rested


@contextlib.contextmanager
def phone(relay: Relay, robot: Robot, user: str, password: str) -> Iterator[Tilted]:
    """Somebody's, in whose hand the robot is.

    :raises Unavailable: there is no Chromium, or no portal to open
    """
    if chromium_path() is None:
        raise Unavailable("no Chromium (Debian: apt install chromium-headless-shell)")
    if not (relay_server.PORTAL / "index.html").is_file():
        raise Unavailable("the portal is not built (make web)")
    expect.set_options(timeout=PATIENCE_MS)
    url = f"http://127.0.0.1:{relay.http_port}"
    with chromium() as browser:
        context = browser.new_context(base_url=url, **PHONE)
        context.set_default_timeout(PATIENCE_MS)
        login = {"user": user, "password": password}
        answer = context.request.post("/api/v1/session", data=login, headers={"Origin": url})
        assert answer.ok, answer.text()
        page = context.new_page()
        page.goto(f"/cockpit/{robot.name}")
        yield Tilted(page, robot)
        context.close()


def tilts(relay: Relay, robot: Robot, user: str, password: str, runs: int, first: int = 0) -> Tilts:
    """Tilt a phone, ahead and back in turn.

    :param first: the number of the first; what has number 0 is not counted
    :raises Unavailable: there is no Chromium, or no portal to open
    """
    found = Tilts([], [], 0)
    with phone(relay, robot, user, password) as hand:
        for number in range(first, runs + 1):
            command, shown = hand.tilt(-TILT if number % 2 else TILT)
            if number:  # until number 0 the robot's guard got ready
                found.commands.append(command)
                found.shown.append(shown)
    return found._replace(anew=hand.anew)
