"""Two robots in the portal's diagram, and the three tasks of the paper on Roles, by mouse only and by
keyboard only.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from playwright.sync_api import Locator, Page, expect

from tests.worlds.json_robots import JsonRobot
from tests.worlds.relay_process import Relay

NAME = "Thermometer-Drive-Wheels"
ROLE = """<?xml version="1.0" encoding="UTF-8"?>
<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#" xmlns:fierro="fierro:" xmlns:switchboard="switchboard:">
  <fierro:role rdf:about="fierro:Thermometer-Drive-Wheels">
    <fierro:subject rdf:resource="fierro:Thermometer"/>
    <fierro:action rdf:resource="fierro:Drive"/>
    <fierro:directObject rdf:resource="fierro:Wheels"/>
  </fierro:role>
  <fierro:subject rdf:about="fierro:Thermometer"><fierro:data rdf:resource="fierro:DEGREES"/></fierro:subject>
  <fierro:field rdf:about="fierro:DEGREES">
    <switchboard:resource>robots/pad/topics/temperature#/data</switchboard:resource>
    <fierro:mapping rdf:resource="fierro:SPEED"/>
  </fierro:field>
  <fierro:action rdf:about="fierro:Drive">
    <fierro:process><fierro:process rdf:about="fierro:Driver"><fierro:port rdf:resource="fierro:Port_1"/></fierro:process></fierro:process>
    <fierro:function rdf:resource="fierro:BEEP"/>
  </fierro:action>
  <fierro:function rdf:about="fierro:BEEP"><switchboard:resource>robots/rover/services/beep</switchboard:resource></fierro:function>
  <fierro:directObject rdf:about="fierro:Wheels"><fierro:data rdf:resource="fierro:SPEED"/></fierro:directObject>
  <fierro:field rdf:about="fierro:SPEED">
    <switchboard:resource>robots/rover/topics/cmd_vel#/linear/x</switchboard:resource>
  </fierro:field>
</rdf:RDF>
"""  # noqa: E501
PAPER_SECONDS = {"pipe": 6.8 * 60, "command": 1.17 * 60}
"""Seconds of users of the paper's diagram."""


class DiagramWorld:
    """A relay with the robots ``pad`` and ``rover``, both operated by ann, and a file with a Role about them."""

    def __init__(self, folder: Path) -> None:
        self.relay = Relay(folder)
        self.token = self.relay.user("ann")
        self.robots = [JsonRobot(self.relay, name) for name in ("pad", "rover")]
        for robot in ("pad", "rover"):
            self.relay.cli("right", "grant", "ann", robot, "operator")
        self.role = folder / "thermometer.rdf"
        self.role.write_text(ROLE)

    @property
    def url(self) -> str:
        """The portal's URL."""
        return f"http://127.0.0.1:{self.relay.http_port}"

    def stop(self) -> None:
        for robot in self.robots:
            robot.stop()
        self.relay.stop()


@dataclass
class Effort:
    """The effort of a task.

    :ivar seconds: of a program that waits only for the page
    """

    task: str
    by: str
    clicks: int = 0
    drags: int = 0
    keys: int = 0
    seconds: float = 0.0


class UserInput:
    """Mouse and keyboard of a page, with counters."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self._effort = Effort("", "")

    @contextmanager
    def doing(self, task: str, by: str) -> Iterator[Effort]:
        """Counts until the task is done."""
        self._effort, began = Effort(task, by), time.monotonic()
        yield self._effort
        self._effort.seconds = time.monotonic() - began

    def click(self, target: Locator) -> None:
        """One click."""
        target.click()
        self._effort.clicks += 1

    def keys(self, *pressed: str) -> None:
        """Press keys, such as ``Control+k``."""
        for each in pressed:
            self.page.keyboard.press(each)
            self._effort.keys += 1

    def type(self, text: str) -> None:
        """Type a text."""
        self.page.keyboard.type(text)
        self._effort.keys += len(text)

    def press_at(self, target: Locator) -> None:
        """Begins to drag."""
        self._move(target)
        self.page.mouse.down()

    def drag_to(self, target: Locator) -> None:
        """Drags on to an element, without releasing."""
        self._move(target)
        self._move(target)

    def release(self) -> None:
        """Ends the drag."""
        self.page.mouse.up()
        self._effort.drags += 1

    def _move(self, target: Locator) -> None:
        """To the middle of an element, when it has come to its place: boxes of a new page move."""
        before, box = None, target.bounding_box()
        while box is None or box != before:
            self.page.wait_for_timeout(50)
            before, box = box, target.bounding_box()
        self.page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2, steps=5)


def row(page: Page, element: str) -> Locator:
    """The row of an element in the diagram, such as ``robot:pad /temperature``."""
    return page.locator(".row-box", has=page.locator(f'[data-testid=element][data-id="{element}"]'))


PIPE_FROM, PIPE_TO = "robot:pad /temperature#data", "robot:rover /cmd_vel#linear.x"


def pipe_by_mouse(hands: UserInput, world: DiagramWorld) -> None:
    """Opens both topics, drags from field to field, starts the pipe."""
    page = hands.page
    for topic in ("robot:pad /temperature", "robot:rover /cmd_vel"):
        hands.click(row(page, topic).get_by_test_id("open"))
    row(page, PIPE_TO).wait_for()
    row(page, PIPE_FROM).wait_for()
    hands.press_at(row(page, PIPE_FROM).get_by_test_id("source"))
    hands.drag_to(row(page, PIPE_TO).get_by_test_id("target"))
    expect(page.get_by_test_id("drag-hint")).to_contain_text("data → linear.x: makes a pipe.")
    hands.release()
    hands.click(page.get_by_test_id("pipe-start"))
    expect(page.get_by_test_id("panel").get_by_test_id("pipe-state")).to_have_text("running")


def pipe_by_keys(hands: UserInput, world: DiagramWorld) -> None:
    """Finds the source, connects it by words of the target, starts the pipe."""
    page = hands.page
    hands.keys("Control+k")
    hands.type("pad temp")
    hands.keys("Enter")
    expect(page.locator("#diagram-panel")).to_be_focused()
    expect(page.get_by_test_id("connect-list").get_by_text("rover: /cmd_vel linear.x")).to_have_count(1)
    hands.keys("Tab", "Tab")
    hands.type("rover linear.x")
    expect(page.get_by_test_id("connect-do")).to_be_enabled()
    hands.keys("Enter")
    page.get_by_test_id("pipe-start").wait_for()
    expect(page.locator("#diagram-panel")).to_be_focused()
    expect(page.get_by_test_id("pipe-start")).to_be_enabled()
    hands.keys("Tab", "Tab", "Enter")
    expect(page.get_by_test_id("panel").get_by_test_id("pipe-state")).to_have_text("running")


def command_by_mouse(hands: UserInput, world: DiagramWorld) -> None:
    """Calls a service."""
    page = hands.page
    hands.click(row(page, "robot:rover /beep()").get_by_test_id("element"))
    hands.click(page.get_by_test_id("call-do"))
    expect(page.get_by_test_id("answer")).to_contain_text("beep")


def command_by_keys(hands: UserInput, world: DiagramWorld) -> None:
    """Calls a service."""
    page = hands.page
    hands.keys("Control+k")
    hands.type("rover beep")
    hands.keys("Enter")
    expect(page.locator("#diagram-panel")).to_be_focused()
    expect(page.get_by_test_id("call-do")).to_be_enabled()
    hands.keys("Tab", "Tab", "Enter")
    expect(page.get_by_test_id("answer")).to_contain_text("beep")


def operate_by_mouse(hands: UserInput, world: DiagramWorld) -> None:
    """Loads a Role from a file and starts it. The system's file dialogue is not counted."""
    page = hands.page
    with page.expect_file_chooser() as chooser:
        hands.click(page.get_by_test_id("load"))
    chooser.value.set_files(world.role)
    hands.click(page.get_by_test_id("panel-start"))
    expect(page.get_by_test_id("role-state")).to_have_text("running")


def operate_by_keys(hands: UserInput, world: DiagramWorld) -> None:
    """The same."""
    page, load = hands.page, hands.page.get_by_test_id("load")
    # A chooser that opens just after the listener was added may be missed.
    with page.expect_file_chooser() as chooser:
        hands.keys("Control+k")
        expect(page.get_by_test_id("find")).to_be_focused()
        while not load.evaluate("button => button === document.activeElement"):
            hands.keys("Shift+Tab")
        hands.keys("Enter")
    chooser.value.set_files(world.role)
    expect(page.locator("#diagram-panel")).to_have_text(NAME)
    expect(page.locator("#diagram-panel")).to_be_focused()
    expect(page.get_by_test_id("panel-start")).to_be_enabled()
    hands.keys("Tab", "Tab", "Enter")
    expect(page.get_by_test_id("role-state")).to_have_text("running")


Task = Callable[[UserInput, DiagramWorld], None]
TASKS: dict[str, dict[str, Task]] = {
    "mouse": {"pipe": pipe_by_mouse, "command": command_by_mouse, "operate": operate_by_mouse},
    "keyboard": {"pipe": pipe_by_keys, "command": command_by_keys, "operate": operate_by_keys},
}


def take_back(page: Page) -> None:
    """Stops everything and undoes all, so that the next task has the same beginning."""
    stop = page.get_by_test_id("role-stop")
    if stop.count():
        stop.click()
        expect(page.get_by_test_id("role-state")).to_have_text("stopped")
    undo = page.get_by_test_id("undo")
    while undo.get_attribute("title") != "Nothing to undo":
        expect(undo).to_be_enabled()
        before = undo.get_attribute("title") or ""
        undo.click()
        expect(undo).not_to_have_attribute("title", re.compile(f"^{re.escape(before)}$"))


def do_tasks(page: Page, world: DiagramWorld, by: str) -> list[Effort]:
    """All three tasks, by ``mouse`` or ``keyboard``; each is undone."""
    page.get_by_test_id("view-diagram" if by == "mouse" else "view-table").click()
    hands, efforts = UserInput(page), []
    for task, carry_out in TASKS[by].items():
        with hands.doing(task, by) as effort:
            carry_out(hands, world)
        efforts.append(effort)
        take_back(page)
    return efforts


def table(efforts: list[Effort]) -> str:
    """The figures, beside those of the paper."""
    lines = ["task      by        clicks drags keys  seconds  paper"]
    for each in efforts:
        paper = PAPER_SECONDS.get(each.task)
        lines.append(
            f"{each.task:9} {each.by:9} {each.clicks:6} {each.drags:5} {each.keys:4} {each.seconds:8.1f}"
            + (f"  {paper:.0f} s" if paper else "  –")
        )
    return "\n".join(lines)
