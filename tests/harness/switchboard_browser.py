"""The portal in a real browser, whatever relay is behind it."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, sync_playwright

import relay_server

ARGUMENTS = ["--no-sandbox", "--disable-dev-shm-usage", "--disable-gpu", "--disable-background-networking"]


def portal() -> Path:
    """The folder of the built portal; without one the test fails in words."""
    if not (relay_server.PORTAL / "index.html").is_file():
        pytest.fail("The portal is not built. Run 'make web', then the tests again.")
    return relay_server.PORTAL


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
        page = context.new_page()
        page.on("pageerror", lambda error: faults.append(f"uncaught: {error}"))
        page.on("console", lambda message: heard(message.text))
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert faults == []
