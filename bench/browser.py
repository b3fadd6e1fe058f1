"""Cameras in a real browser: how old the picture is that a page shows, by the clock in it, read back on the page.

Real relay, daemon and simulated robot; Chromium without a screen. Before each frame the page is about to show, the
clock's part of the ``<img>`` or of the portal's canvas is copied; when it has changed it is kept with the page's time,
which is the same machine's clock the camera drew. Reading it makes the browser decode the picture if it has not yet.
"""

from __future__ import annotations

import base64
import json
from typing import Any

import cv2
import numpy as np
from playwright.sync_api import Browser, Page

import relay_server
from bench.cameras import CAMERAS, TOPIC, USERS, Clock, Scene, counts, glass_to_glass, scene
from bench.report import Options, Row, Unavailable
from tests.worlds.browser import chromium, chromium_path

PATIENCE_MS = 30_000

LOOK = """async ([selector, left, top, width, height, wanted]) => {
    const source = document.querySelector(selector)
    const canvas = document.createElement('canvas')
    canvas.width = width
    canvas.height = height
    const context = canvas.getContext('2d', { willReadFrequently: true })
    const found = []
    const began = performance.now()
    let last = ''
    let looks = 0
    while (found.length < wanted) {
        await new Promise(requestAnimationFrame)
        looks += 1
        context.drawImage(source, left, top, width, height, 0, 0, width, height)
        const clock = canvas.toDataURL()
        if (clock !== last) found.push([clock, Date.now()])
        last = clock
    }
    return { found, rate: looks / (performance.now() - began) * 1000 }
}"""
"""Resolves to the clocks as PNG with the times they were seen, Unix milliseconds, and to the looks per second."""


def look(page: Page, selector: str, at: Scene, clock: Clock, count: int) -> dict[str, Any]:
    """What :data:`LOOK` finds in the pictures an element shows."""
    page.wait_for_function(
        "([selector, width]) => [...document.querySelectorAll(selector)]"
        ".some(each => (each.naturalWidth ?? each.width) === width)",
        arg=[selector, at.camera.width],
    )
    place = [clock.left, clock.top, clock.right - clock.left, clock.bottom - clock.top]
    return dict(page.evaluate(LOOK, [selector, *place, count]))


def pixels(address: str) -> Any:
    """What a ``data:`` address of a PNG holds, BGR."""
    body = base64.b64decode(address.partition(",")[2])
    return cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_COLOR)


def image(page: Page, at: Scene) -> str:
    """Show the MJPEG stream in an ``<img>`` of a page that seems to come from the relay; returns its selector."""
    address = f"{at.url}/bench.html"
    page.route(
        address,
        lambda asked: asked.fulfill(content_type="text/html", body=f'<img src="{at.path("stream")}">'),
    )
    page.goto(address)
    return "img"


def portal(page: Page, at: Scene, codec: str) -> str:
    """Open the cockpit with this camera; returns the selector of its canvas.

    :raises Unavailable: H.264 was asked for and JPEG is shown
    """
    wish = json.dumps({"panes": [{"camera": TOPIC, "codec": codec}]})
    page.add_init_script(f"localStorage.setItem('switchboard:cameras:rover', {json.dumps(wish)})")
    page.goto(f"{at.url}/cockpit/rover")
    page.get_by_test_id("camera-size").wait_for()
    if codec == "h264" and not page.get_by_test_id("camera-pane").get_by_text("H.264", exact=True).count():
        raise Unavailable("this Chromium, or the robot, has no H.264")
    return "[data-testid=camera-canvas]"


def ways(browser: Browser, at: Scene, options: Options) -> list[Row]:
    """Three, each on a page of its own."""
    first, count = counts(options)
    clock, rows = Clock(at.camera), []
    for way, show in (
        ("img, MJPEG", image),
        ("portal, websocket, JPEG", lambda page, at: portal(page, at, "jpeg")),
        ("portal, websocket, H.264", lambda page, at: portal(page, at, "h264")),
    ):
        context = browser.new_context(viewport={"width": 1400, "height": 1000})
        context.set_default_timeout(PATIENCE_MS)
        login = {"user": USERS[0], "password": "correct horse"}
        context.request.post(f"{at.url}/api/v1/session", data=login, headers={"Origin": at.url})
        page = context.new_page()
        seen = look(page, show(page, at), at, clock, first + count)
        context.close()
        ages = [clock.age_ms(pixels(address), ms / 1000) for address, ms in seen["found"][first:]]
        note = f"looked at {seen['rate']:.0f} times a second, drawn in software"
        rows += glass_to_glass("browser", f"{at.camera.name}, {way}", ages, note)
    return rows


def run(options: Options) -> list[Row]:
    """Both cameras.

    :raises Unavailable: there is no Chromium, or no portal to open
    """
    if chromium_path() is None:
        raise Unavailable("no Chromium (Debian: apt install chromium-headless-shell)")
    if not (relay_server.PORTAL / "index.html").is_file():
        raise Unavailable("the portal is not built (make web)")
    rows = []
    with chromium() as browser:
        for camera in CAMERAS[:1] if options.quick else CAMERAS:
            with scene(camera) as at:
                rows += ways(browser, at, options)
    for row in rows:
        print(f"    {row.what}: {row.ours:.1f} {row.unit}", flush=True)
    return rows
