"""A relay, a robot, and users who view and drive it by the portal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page

from tests.worlds.browser import checked_pages, open_session
from tests.worlds.relay_process import Relay
from tests.worlds.robot_process import Robot
from tests.worlds.waiting import wait_for

PASSWORD = "correct horse"
WAIT_SECONDS = 60.0
COCKPIT = "/cockpit/rover"

TAKEN_MOST, OBEYED_SECONDS = 10, 6.0
"""How often an input is taken hold of, and how long it may take until the robot moves by it."""

OpenPage = Callable[..., Page]


class PortalWorld:
    """A relay, the robot ``rover``, and users with a right on it.

    :param people: the level of each, by name
    :param options: of ``switchboard serve``
    :param robot: further ones of :class:`Robot`
    """

    def __init__(self, folder: Path, people: dict[str, str], *options: str, **robot: Any) -> None:
        self.relay = Relay(folder, *options)
        self.robot = Robot(self.relay, "rover", **robot)
        self.tokens = {user: self.relay.user(user, PASSWORD) for user in people}
        for user, level in people.items():
            self.relay.cli("right", "grant", user, "rover", level)

    @property
    def url(self) -> str:
        """The URL of the portal."""
        return f"http://127.0.0.1:{self.relay.http_port}"

    def commands(self, since: int) -> list[tuple[float, float]]:
        """Commands that reached the robot since a moment, as (ahead, turn)."""
        return [(each["v"], each["w"]) for each in self.robot.events("command", since)]

    def movements(self, since: int) -> list[tuple[float, float]]:
        """The same, without the zeros that are repeated when a robot is to stand."""
        return [each for each in self.commands(since) if each != (0, 0)]

    def stands(self) -> None:
        """Waits until the robot stands, by its own log."""
        wait_for("the robot stands", lambda: not self.robot.moving())

    def moves(self) -> None:
        """Waits until the robot moves, by its own log."""
        wait_for("the robot moves", self.robot.moving)

    def moves_by(self, hold: Callable[[], object], lift: Callable[[], object]) -> None:
        """Uses an input until the robot moves; repeated if a busy machine has made the link late."""
        for _ in range(TAKEN_MOST):
            hold()
            with suppress(AssertionError):
                wait_for("the robot moves", self.robot.moving, OBEYED_SECONDS)
                return
            lift()
        pytest.fail("the robot obeyed nobody")

    def stop(self) -> None:
        self.robot.stop()
        self.relay.stop()


@contextmanager
def pages_of(browser: Browser, world: PortalWorld) -> Iterator[OpenPage]:
    """Opens pages for logged-in users; an error or a violation of the CSP in any of them fails the test.

    It takes the user, the path, an action before the page loads, width and height in pixels, and further
    options of Playwright's ``new_context``.
    """
    with checked_pages(browser, world.url, WAIT_SECONDS) as new_page:

        def open_page(
            user: str,
            path: str = COCKPIT,
            prepare: Callable[[Page], object] | None = None,
            *,
            width: int = 1280,
            height: int = 800,
            **options: Any,
        ) -> Page:
            page = new_page(width, height, **options)
            open_session(page, user, PASSWORD)
            if prepare is not None:
                prepare(page)
            page.goto(path)
            return page

        yield open_page
