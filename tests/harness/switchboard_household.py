"""A relay, a robot, and people who see and drive it by the portal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page
from switchboard_browser import sound_pages
from switchboard_relay import Relay
from switchboard_robot import Robot
from switchboard_waiting import wait_for

PASSWORD = "correct horse"
WAIT_SECONDS = 60.0
COCKPIT = "/cockpit/rover"

TAKEN_MOST, OBEYED_SECONDS = 10, 6.0
"""How often an input is taken hold of, and how long it may take until the robot moves by it."""

OpenPage = Callable[..., Page]


class Household:
    """A relay, the robot ``rover``, and people with a right on it.

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
        """Where the portal is."""
        return f"http://127.0.0.1:{self.relay.http_port}"

    def commands(self, since: int) -> list[tuple[float, float]]:
        """What reached the robot since a moment, as (ahead, turn)."""
        return [(each["v"], each["w"]) for each in self.robot.events("command", since)]

    def movements(self, since: int) -> list[tuple[float, float]]:
        """The same, without the zeros that are said again and again when a robot is to stand."""
        return [each for each in self.commands(since) if each != (0, 0)]

    def stands(self) -> None:
        """Wait until the robot stands, by its own record."""
        wait_for("the robot stands", lambda: not self.robot.moving())

    def moves(self) -> None:
        """Wait until the robot moves, by its own record."""
        wait_for("the robot moves", self.robot.moving)

    def moves_by(self, hold: Callable[[], object], lift: Callable[[], object]) -> None:
        """Take hold of an input until the robot moves; once more where a busy machine has made the link late."""
        for _ in range(TAKEN_MOST):
            hold()
            with suppress(AssertionError):
                wait_for("the robot moves", self.robot.moving, OBEYED_SECONDS)
                return
            lift()
        pytest.fail("the robot obeyed nobody")

    def stop(self) -> None:
        """End everything."""
        self.robot.stop()
        self.relay.stop()


@contextmanager
def pages_of(browser: Browser, house: Household) -> Iterator[OpenPage]:
    """What opens pages for people who are logged in; an error or a breach of the CSP in any of them fails the test.

    It takes the user, the path, what is to be done to the page first, width and height in pixels, and further
    options of Playwright's ``new_context``.
    """
    with sound_pages(browser, house.url, WAIT_SECONDS) as new_page:

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
            answer = page.request.post("/api/v1/session", data={"user": user, "password": PASSWORD})
            assert answer.ok, answer.text()
            if prepare is not None:
                prepare(page)
            page.goto(path)
            return page

        yield open_page
