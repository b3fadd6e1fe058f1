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
from switchboard_browser import chromium, portal, sound_pages
from switchboard_processes import Process

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
        """What pages sent so far, in order, narrowed to messages with these values."""
        with urllib.request.urlopen(self.url + "/fake/log") as answer:
            entries: list[Json] = json.load(answer)
        return [entry for entry in entries if all(entry.get(key) == value for key, value in wanted.items())]

    def until(self, ready: Callable[[], Any], what: str) -> Any:
        """Polls until something is true, and fails with ``what`` if it never is."""
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


@pytest.fixture
def relay(tmp_path: Path) -> Iterator[FakeRelay]:
    process = Process([str(HERE / "fake_relay.py"), "--portal", str(portal())], tmp_path, "fake-relay")
    try:
        yield FakeRelay(f"http://127.0.0.1:{process.wait_to_say('READY').split()[1]}")
    finally:
        process.stop()


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as browser:
        yield browser


OpenPage = Callable[..., Page]


@pytest.fixture
def open_page(browser: Browser, relay: FakeRelay) -> Iterator[OpenPage]:
    """Opens pages of the portal; fails the test if any of them had an uncaught error or broke the CSP."""
    with sound_pages(browser, relay.url, WAIT_SECONDS) as new_page:

        def open_page(
            path: str = "/", width: int = 1280, height: int = 800, user: str | None = None, **options: Any
        ) -> Page:
            page = new_page(width, height, **options)
            if user is not None:
                answer = page.request.post(
                    "/api/v1/session",
                    data={"user": user, "password": PASSWORD},
                    headers={"X-Requested-With": "switchboard"},
                )
                assert answer.ok, answer.text()
            page.goto(path)
            return page

        yield open_page
