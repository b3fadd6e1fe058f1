"""A browser and a fake relay for the portal's tests."""

from __future__ import annotations

import json
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, expect

from tests.worlds.browser import checked_pages, chromium, open_session, portal
from tests.worlds.processes import Process

HERE = Path(__file__).parent
PASSWORD = "correct horse"
WAIT_SECONDS = 60.0

expect.set_options(timeout=WAIT_SECONDS * 1000)

Json = dict[str, Any]


class FakeRelay:
    """The fake relay as a test sees it."""

    def __init__(self, url: str) -> None:
        self.url = url

    def do(self, **order: Any) -> None:
        """Changes what the relay does, see ``Relay.do`` in ``fake_relay.py``."""
        data = json.dumps(order).encode()
        urllib.request.urlopen(urllib.request.Request(self.url + "/fake/do", data, method="POST")).close()

    def log(self, **wanted: Any) -> list[Json]:
        """Messages of pages so far, in order, filtered by these values."""
        with urllib.request.urlopen(self.url + "/fake/log") as answer:
            entries: list[Json] = json.load(answer)
        return [entry for entry in entries if all(entry.get(key) == value for key, value in wanted.items())]

    def until(self, ready: Callable[[], Any], what: str) -> Any:
        """Polls until a condition is true, and fails with ``what`` otherwise."""
        deadline = time.monotonic() + WAIT_SECONDS
        while not (found := ready()):
            if time.monotonic() > deadline:
                pytest.fail(f"waited {WAIT_SECONDS:.0f} s in vain: {what}")
            time.sleep(0.05)
        return found

    def commands(self, topic: str = "/cmd_vel") -> list[tuple[float, float]]:
        """The motion commands received, as (ahead, turn)."""
        return [
            (entry["msg"]["linear"]["x"], entry["msg"]["angular"]["z"])
            for entry in self.log(op="publish", topic=topic)
        ]


def run_relay(folder: Path) -> Iterator[FakeRelay]:
    process = Process([str(HERE / "fake_relay.py"), "--portal", str(portal())], folder, "fake-relay")
    try:
        yield FakeRelay(f"http://127.0.0.1:{process.wait_to_say('READY').split()[1]}")
    finally:
        process.stop()


@pytest.fixture
def relay(tmp_path: Path) -> Iterator[FakeRelay]:
    yield from run_relay(tmp_path)


@pytest.fixture(scope="module")
def shared_relay(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FakeRelay]:
    """One for all tests of a file."""
    yield from run_relay(tmp_path_factory.mktemp("relay"))


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as browser:
        yield browser


OpenPage = Callable[..., Page]


@pytest.fixture
def open_page(browser: Browser, relay: FakeRelay) -> Iterator[OpenPage]:
    """Opens pages of the portal; an uncaught error or a violation of the CSP in any of them fails the test."""
    with checked_pages(browser, relay.url, WAIT_SECONDS) as new_page:

        def open_page(
            path: str = "/", width: int = 1280, height: int = 800, user: str | None = None, **options: Any
        ) -> Page:
            page = new_page(width, height, **options)
            if user is not None:
                open_session(page, user, PASSWORD)
            page.goto(path)
            return page

        yield open_page
