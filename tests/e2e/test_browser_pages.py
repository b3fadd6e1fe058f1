"""Every page of the portal: under a strict CSP, by axe-core's rules, and its size."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page

from tests.worlds.accessibility import violations
from tests.worlds.browser import SMALL_CAMERA, checked_pages, open_session, running_world, seen
from tests.worlds.relay_process import Relay
from tests.worlds.robot_process import Robot

PASSWORD = "correct horse"
WAIT_SECONDS = 60.0
LOGIN_BYTES = 120_000

SHOWN = {
    "/login": "login-user",
    "/fleet": "robot-card",
    "/cockpit/rover": "camera-fps",
    "/alerts": "alerts-robot",
    "/realm/robots": "realm-robot",
    "/realm/people": "realm-person",
    "/realm/groups": "",
    "/realm/rights": "",
    "/fleet/nothing": "",
}
"""What is on a page once it is all there, by its name for tests."""


class World:
    """A relay, a robot with its camera on, an administrator."""

    def __init__(self, folder: Path) -> None:
        self.relay = Relay(folder)
        self.robot = Robot(self.relay, "rover", camera=True, sim_options=SMALL_CAMERA)
        self.relay.user("root", admin=True)
        self.relay.cli("right", "grant", "root", "rover", "owner")

    def stop(self) -> None:
        self.robot.stop()
        self.relay.stop()


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """One world for all tests."""
    yield from running_world(World, tmp_path_factory.mktemp("pages"))


@pytest.fixture
def open_page(browser: Browser, world: World) -> Iterator[Callable[..., Page]]:
    """Opens pages; an uncaught error or a violation of the CSP in any of them fails the test."""
    with checked_pages(browser, f"http://127.0.0.1:{world.relay.http_port}", WAIT_SECONDS) as new_page:

        def open_page(path: str, width: int = 1280, height: int = 900) -> Page:
            page = new_page(width, height)
            if path != "/login":
                open_session(page, "root", PASSWORD)
            page.goto(path)
            if SHOWN.get(path):
                seen(page, SHOWN[path]).first.wait_for()
            # Not before: a page has no content while a part of it is loading.
            page.locator("main").first.wait_for()
            page.locator("h1").first.wait_for(state="attached")
            return page

        yield open_page


@pytest.mark.parametrize("width", [390, 1280])
@pytest.mark.parametrize("path", SHOWN)
def test_no_page_breaks_a_rule_of_axe(open_page: Callable[..., Page], path: str, width: int) -> None:
    """On a phone and on a desktop, with open menus and details too."""
    page = open_page(path, width)
    assert violations(page) == []
    if path != "/login":
        seen(page, "user-menu").click()
        assert violations(page) == []


@pytest.mark.parametrize("width", [390, 1280])
def test_the_pages_that_the_relay_makes_itself_break_no_rule(
    open_page: Callable[..., Page], width: int
) -> None:
    """The description of the API has its own style."""
    page = open_page("/api/docs", width)
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") != "rgba(0, 0, 0, 0)"
    assert violations(page) == []


def test_the_login_page_needs_few_bytes(open_page: Callable[..., Page]) -> None:
    """Headers and bodies, compressed."""
    page = open_page("/login")
    sizes = page.evaluate(
        "[...performance.getEntriesByType('navigation'), ...performance.getEntriesByType('resource')]"
        ".map(({ transferSize }) => transferSize)"
    )
    assert 0 < sum(sizes) <= LOGIN_BYTES
