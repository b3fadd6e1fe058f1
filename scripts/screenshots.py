"""Take the pictures of the documents: ``make screenshots``.

They show ``make demo``: its robot being driven, as an animation; its map while it drives to a goal; and its processes,
in the portal and by ``switchboard top``. The portal has one theme, which is dark.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO, StringIO
from itertools import pairwise
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, sync_playwright
from rich.console import Console
from rich.text import Text

BIN = Path(sys.executable).parent
IMAGES = Path(__file__).parents[1] / "docs/images"
ROBOT = "robot-one"
GOAL = {"x": "4.2", "y": "-1.9", "degrees": "180"}
"""Behind the table."""
COLUMNS = 144
"""Width of the terminal in which ``switchboard top`` runs, in characters."""

DRIVE = ((0, -66), (-34, -56), (0, -66), (34, -56), (0, -66), (0, 0))
"""Positions of the joystick, pixels from its middle, each for the same time."""

DRIVE_SECONDS = 2.0
FRAME_SECONDS = 0.15
DRIVE_SIZE = (800, 650)
"""Pixels of the animation."""

WHOLE_TABLE = """
document.querySelector('.layout').style.display = 'block'
document.querySelector('[data-testid=processes] .scroll').style.maxHeight = 'none'
"""
"""Shows all rows and columns, which the page scrolls."""


class Demo:
    """``switchboard demo`` in a folder of its own.

    :ivar login: an address that logs the administrator in, once
    """

    def __init__(self, folder: Path) -> None:
        self.data = folder / "data"
        command = [BIN / "switchboard", "demo", "--http", "127.0.0.1:0", "--data", self.data]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        self.login = ""

    def wait(self) -> None:
        """Wait until the relay is ready."""
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if found := re.search(r"http\S+/login#code=\S+", line):
                self.login = found[0]
            if line.startswith("READY"):
                return
        sys.exit("The demo ended before it was ready.")

    def stop(self) -> None:
        """End it and its robots."""
        self._process.terminate()
        self._process.wait()

    def top(self) -> str:
        """One table of ``switchboard top``."""
        command = [BIN / "switchboard", "--data", self.data, "top", ROBOT, "--every", "3", "--sort", "part"]
        environment = {**os.environ, "COLUMNS": str(COLUMNS)}
        return subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout


@contextmanager
def open_cockpit(demo: Demo) -> Iterator[Page]:
    """The cockpit of the demo's robot, in Chromium, with all its modules running."""
    chromium = shutil.which("chromium-headless-shell") or shutil.which("chromium")
    if chromium is None:
        sys.exit("There is no Chromium. Install the package 'chromium-headless-shell'.")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1280, "height": 1400})
        page.goto(demo.login)
        page.locator(f"[data-robot={ROBOT}] a").first.click()
        page.locator("[data-name=navigator][data-state=running]").wait_for(timeout=120_000)
        yield page
        browser.close()


def record_drive(page: Page, name: str) -> None:
    """An animation: the joystick drives the robot, with what its camera and its scanner see."""
    page.set_viewport_size({"width": 1280, "height": 1040})
    page.get_by_test_id("camera-pane").get_by_text(re.compile(r"^[1-9]\d* fps")).wait_for(timeout=120_000)
    page.get_by_test_id("control-take").click()
    joystick = page.get_by_test_id("joystick")
    joystick.and_(page.locator("[aria-disabled=false]")).wait_for()
    box = joystick.bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    frames: list[Image.Image] = []
    times: list[float] = []
    for dx, dy in DRIVE:
        page.mouse.move(x + dx, y + dy, steps=4)
        until = time.monotonic() + DRIVE_SECONDS
        while time.monotonic() < until:
            times.append(time.monotonic())
            shot = Image.open(BytesIO(page.screenshot(type="jpeg", quality=90))).convert("RGB")
            frames.append(shot.resize(DRIVE_SIZE, Image.Resampling.LANCZOS))
            page.wait_for_timeout(max(0.0, FRAME_SECONDS - (time.monotonic() - times[-1])) * 1000)
    page.mouse.up()
    milliseconds = [round((after - before) * 1000) for before, after in pairwise(times)]
    frames[0].save(
        IMAGES / name,
        save_all=True,
        append_images=frames[1:],
        duration=[*milliseconds, 1500],
        loop=0,
        quality=60,
        method=6,
    )
    page.set_viewport_size({"width": 1280, "height": 1400})


def show_map(page: Page) -> None:
    """Let the robot drive to a goal, past obstacles. Control is taken already."""
    page.get_by_test_id("map-canvas").scroll_into_view_if_needed()
    page.locator("[data-testid=map-canvas][data-map=drawn]").wait_for()
    page.get_by_test_id("layer-costmap").select_option("/global_costmap/costmap")
    page.get_by_test_id("goal-set").click()
    for field, value in GOAL.items():
        page.get_by_test_id(f"goal-{field}").fill(value)
    page.get_by_test_id("goal-send").click()
    page.locator("[data-testid=map-canvas][data-costmap=drawn]").wait_for()
    page.get_by_text(re.compile(r"^1\.\d m left")).wait_for(timeout=120_000)


def show_processes(page: Page) -> None:
    """Open the table of processes, in the order of their parts."""
    page.get_by_test_id("goal-words").filter(has_text=re.compile(r"\w")).wait_for(timeout=60_000)
    page.get_by_test_id("processes-toggle").click()
    table = page.get_by_test_id("processes")
    table.get_by_role("button", name="Part").click()
    table.locator("[data-part=daemon]").first.filter(has_text="running").or_(
        table.locator("[data-part=daemon]").first.filter(has_text="sleeping")
    ).wait_for()
    # The share of a CPU is known from the second measurement on.
    table.get_by_text("–", exact=True).first.wait_for(state="detached")
    page.evaluate(WHOLE_TABLE)


def take(page: Page, testid: str, name: str) -> None:
    """A picture of a part of the page, in 256 colours."""
    with tempfile.NamedTemporaryFile(suffix=".png") as file:
        page.get_by_test_id(testid).screenshot(path=file.name)
        Image.open(file.name).convert("RGB").quantize(256).save(IMAGES / name, optimize=True)


def draw_terminal(text: str, title: str, name: str) -> None:
    """A terminal with this text."""
    console = Console(record=True, width=COLUMNS, file=StringIO(), force_terminal=True)
    console.print(Text(text.rstrip()), no_wrap=True, crop=False)
    # A fixed id keeps the picture the same where its text is.
    console.save_svg(str(IMAGES / name), title=title, unique_id="terminal")


def main() -> None:
    argparse.ArgumentParser(description=__doc__).parse_args()
    with tempfile.TemporaryDirectory() as folder:
        demo = Demo(Path(folder))
        try:
            demo.wait()
            with open_cockpit(demo) as page:
                record_drive(page, "drive.webp")
                show_map(page)
                take(page, "map", "map.png")
                show_processes(page)
                take(page, "processes", "processes.png")
                draw_terminal(demo.top(), f"switchboard top {ROBOT}", "top.svg")
        finally:
            demo.stop()


if __name__ == "__main__":
    main()
