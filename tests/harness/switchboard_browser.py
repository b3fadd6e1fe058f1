"""The portal in a real browser, whatever relay is behind it."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Protocol, TypeVar

import pytest
from playwright.sync_api import Browser, Locator, Page, expect, sync_playwright
from switchboard_waiting import wait_for

import relay_server

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

ARGUMENTS = ["--no-sandbox", "--disable-dev-shm-usage", "--disable-gpu", "--disable-background-networking"]


def portal() -> Path:
    """The folder of the built portal; without one the test fails in words."""
    if not (relay_server.PORTAL / "index.html").is_file():
        pytest.fail("The portal is not built. Run 'make web', then the tests again.")
    return relay_server.PORTAL


class House(Protocol):
    """What a module's tests share, with a relay in it."""

    def stop(self) -> None:
        """End everything."""


H = TypeVar("H", bound=House)


def lived_in(house: Callable[[Path], H], folder: Path) -> Iterator[H]:
    """A house for the portal, ended when its tests are over."""
    portal()
    made = house(folder)
    try:
        yield made
    finally:
        made.stop()


@contextmanager
def chromium() -> Iterator[Browser]:
    """Chromium; where there is none the test fails in words."""
    path = shutil.which("chromium")
    if path is None:
        pytest.fail("There is no Chromium. Install the package 'chromium', then run the tests again.")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=ARGUMENTS)
        yield browser
        browser.close()


@contextmanager
def sound_pages(browser: Browser, url: str, seconds: float) -> Iterator[Callable[..., Page]]:
    """What opens empty pages; an uncaught error or a breach of the CSP in any of them fails the test at the end.

    It takes width and height in pixels, and further options of Playwright's ``new_context``.

    :param url: what the paths that pages go to are relative to
    :param seconds: how long anything on a page may take
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
        page = context.new_page()
        page.on("pageerror", lambda error: faults.append(f"uncaught: {error}"))
        page.on("console", lambda message: heard(message.text))
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert faults == []


# --- the cockpit ------------------------------------------------------------------------------------------


def seen(page: Page, testid: str) -> Locator:
    """An element of the page by its name for tests."""
    return page.get_by_test_id(testid)


def picture(page: Page, canvas: str) -> str:
    """What a canvas shows, as data."""
    return str(seen(page, canvas).evaluate("canvas => canvas.toDataURL()"))


def was_told(page: Page, words: str) -> None:
    """Wait until a toast with these words has been shown, were it for a moment."""
    wait_for(f"a toast with '{words}'", lambda: any(words in each for each in page.evaluate("toastsTold")))


def stands(page: Page, how: str) -> None:
    """Wait until the page stands so to control: ``free``, ``yours``, ``asked``, ``held``, ``waiting``, …

    :param how: a regular expression
    """
    expect(seen(page, "control")).to_have_attribute("data-standing", re.compile(f"^({how})$"))


def take_control(page: Page) -> None:
    """Have control of a robot that is free, or is the page's already.

    One that has just come back may refuse: whoever wants it asks once more.
    """
    stands(page, "free|yours")
    for _ in range(ASKED_MOST):
        if seen(page, "control").get_attribute("data-standing") == "free":
            seen(page, "control-take").click()
        with suppress(AssertionError):
            expect(seen(page, "control")).to_have_attribute("data-standing", "yours", timeout=ASKED_MS)
            return
    stands(page, "yours")


def ready_to_drive(page: Page) -> None:
    """The cockpit is connected, has control, and its joystick is on."""
    expect(seen(page, "link-state")).to_have_attribute("data-state", "open")
    take_control(page)
    expect(seen(page, "drive-blocked")).to_have_count(0)
    expect(seen(page, "joystick").locator(".back")).to_be_visible()


def hold_joystick(page: Page, dx: float = 0, dy: float = -60) -> None:
    """Press the joystick with the mouse and pull it away from its middle (pixels)."""
    box = seen(page, "joystick").bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + dx, y + dy, steps=4)


def hold_resume(page: Page) -> None:
    """Keep the button pressed by which a stopped robot may move again."""
    box = seen(page, "resume").bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.down()
    expect(seen(page, "stopped")).to_have_count(0)
    page.mouse.up()
