"""The portal in a real browser, with any relay."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Protocol, TypeVar

import pytest
from playwright.sync_api import Browser, Locator, Page, expect, sync_playwright

import relay_server
from tests.worlds.waiting import wait_for

NOTES_TOASTS = """
window.toastsTold = [];
new MutationObserver((changes) => {
  for (const { addedNodes } of changes)
    for (const node of addedNodes)
      if (node instanceof Element && node.matches("[data-testid=toast]")) toastsTold.push(node.textContent);
}).observe(document, { childList: true, subtree: true });
"""
"""Toasts go after a moment: on a busy machine they may be gone before a test looks."""

ASKED_MOST, ASKED_MS = 10, 5000
"""How often control is asked for, and milliseconds for an answer."""

SMALL_CAMERA = ("--camera-size", "320x240", "--camera-fps", "5")
"""Options of the simulated robot where any picture will do: drawn, encoded and shown in little time."""

ARGUMENTS = ["--no-sandbox", "--disable-dev-shm-usage", "--disable-gpu", "--disable-background-networking"]

PROGRAMS = ("chromium-headless-shell", "chromium")
"""The first of these that is on PATH is used. The shell is the same engine without windows and profiles: a page takes a
third of the processor time.
"""


def portal() -> Path:
    """The folder of the built portal; without it the test fails with an explanation."""
    if not (relay_server.PORTAL / "index.html").is_file():
        pytest.fail("The portal is not built. Run 'make web', then the tests again.")
    return relay_server.PORTAL


class RelayWorld(Protocol):
    """A relay and other parts that a module's tests share."""

    def stop(self) -> None:
        """Ends all parts."""


H = TypeVar("H", bound=RelayWorld)


def running_world(world: Callable[[Path], H], folder: Path) -> Iterator[H]:
    """A world with the portal, which ends after its tests."""
    portal()
    made = world(folder)
    try:
        yield made
    finally:
        made.stop()


def chromium_path() -> str | None:
    """The path of Chromium, or None."""
    return next(filter(None, map(shutil.which, PROGRAMS)), None)


@contextmanager
def chromium() -> Iterator[Browser]:
    """Chromium; without it the test fails with an explanation."""
    path = chromium_path()
    if path is None:
        pytest.fail(
            "There is no Chromium. Install the package 'chromium-headless-shell', then run the tests again."
        )
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=ARGUMENTS)
        yield browser
        browser.close()


STEADY_CLOCK = """(() => {
  const machine = performance.now.bind(performance)
  let last = machine(), now = last
  performance.now = () => {
    const read = machine()
    now += Math.min(read - last, 200)
    last = read
    return now
  }
  setInterval(performance.now, 50)
})()"""
"""For a page its clock never jumps by more than 200 ms. A page that stood still ends driving, which is tested without a
browser; a machine that is busy with other tests must not look like that."""


@contextmanager
def checked_pages(
    browser: Browser, url: str, seconds: float, *, steady: bool = True
) -> Iterator[Callable[..., Page]]:
    """Opens empty pages; an uncaught error or a violation of the CSP in any of them fails the test at the
    end.

    It takes width and height in pixels, and further options of Playwright's ``new_context``.

    :param url: the base of the pages' paths
    :param seconds: the timeout of everything on a page
    :param steady: with :data:`STEADY_CLOCK`; tests that measure time on a page go without
    """
    faults: list[str] = []
    contexts = []

    def heard(text: str) -> None:
        if "Content Security Policy" in text:
            faults.append(text)

    def open_page(width: int, height: int, **options: Any) -> Page:
        context = browser.new_context(viewport={"width": width, "height": height}, base_url=url, **options)
        context.set_default_timeout(seconds * 1000)
        contexts.append(context)
        context.add_init_script(NOTES_TOASTS)
        if steady:
            context.add_init_script(STEADY_CLOCK)
        page = context.new_page()
        page.on("pageerror", lambda error: faults.append(f"uncaught: {error}"))
        page.on("console", lambda message: heard(message.text))
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert faults == []


def open_session(page: Page, user: str, password: str) -> None:
    """Logs in by a request: the form is one more page to load, and has tests of its own."""
    answer = page.request.post(
        "/api/v1/session",
        data={"user": user, "password": password},
        headers={"X-Requested-With": "switchboard"},
    )
    assert answer.ok, answer.text()


# --- the cockpit ------------------------------------------------------------------------------------------


def seen(page: Page, testid: str) -> Locator:
    """An element of the page by its test id."""
    return page.get_by_test_id(testid)


def picture(page: Page, canvas: str) -> str:
    """The content of a canvas, as a data URL."""
    return str(seen(page, canvas).evaluate("canvas => canvas.toDataURL()"))


def was_notified(page: Page, words: str) -> None:
    """Waits until a toast with these words has been shown, if only for a moment."""
    wait_for(f"a toast with '{words}'", lambda: any(words in each for each in page.evaluate("toastsTold")))


def stands(page: Page, how: str) -> None:
    """Waits until the page has this state of control: ``free``, ``yours``, ``asked``, ``held``, ``waiting``,
    …

    :param how: a regular expression
    """
    expect(seen(page, "control")).to_have_attribute("data-state", re.compile(f"^({how})$"))


def take_control(page: Page) -> None:
    """Takes control of a robot that is free or already the page's.

    A robot that has just reconnected may refuse, so the request is repeated.
    """
    stands(page, "free|yours")
    for _ in range(ASKED_MOST):
        if seen(page, "control").get_attribute("data-state") == "free":
            seen(page, "control-take").click()
        with suppress(AssertionError):
            expect(seen(page, "control")).to_have_attribute("data-state", "yours", timeout=ASKED_MS)
            return
    stands(page, "yours")


def ready_to_drive(page: Page) -> None:
    """Waits until the cockpit is connected, has control, and its joystick is enabled."""
    expect(seen(page, "link-state")).to_have_attribute("data-state", "open")
    take_control(page)
    expect(seen(page, "drive-blocked")).to_have_count(0)
    expect(seen(page, "joystick").locator(".back")).to_be_visible()


def hold_joystick(page: Page, dx: float = 0, dy: float = -60) -> None:
    """Presses the joystick with the mouse and drags it away from its middle (pixels)."""
    box = seen(page, "joystick").bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + dx, y + dy, steps=4)


def hold_resume(page: Page) -> None:
    """Holds the button that resumes a stopped robot."""
    # It waits until the button stands still, as the banner may still grow.
    seen(page, "resume").hover()
    page.mouse.down()
    expect(seen(page, "stopped")).to_have_count(0)
    page.mouse.up()


def open_topic(page: Page, topic: str) -> Locator:
    """Clicks on a topic in the cockpit's list; returns its row. The map above moves the list when it loads."""
    expect(seen(page, "map")).to_be_visible()
    row = page.locator(f"[data-testid=topic-row][data-topic='{topic}']")
    row.click()
    return row
