"""Modules and processes in the cockpit: a real robot, its modules, and Chromium."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Locator, Page, expect

from tests.worlds.accessibility import violations
from tests.worlds.browser import checked_pages, open_session, running_world, seen, was_notified
from tests.worlds.module_settings import MODULES
from tests.worlds.relay_process import Relay
from tests.worlds.robot_process import Robot
from tests.worlds.waiting import wait_for

PASSWORD = "correct horse"
WAIT_SECONDS = 60.0
BROKEN = f"""
[[module]]
name = "broken"
command = ["{sys.executable}", "-c", "raise SystemExit(3)"]
autostart = false
restart = "never"
"""
TALKING = f"""
[[module]]
name = "talking"
command = ["{sys.executable}", "-u", "-c", '''
import time
for number in range(250): print("ERROR:root:" * (number in (3, 77)) + f"line {{number}};")
time.sleep(600)
''']
term_after_s = 0.5
kill_after_s = 0.5
"""
PROCESS = re.compile(r"^process \d+$")


class RobotWithModules:
    def __init__(self, folder: Path) -> None:
        self.relay = Relay(folder)
        for user in ("owner", "viewer", "watcher"):
            self.relay.user(user)
        self.robot = Robot(self.relay, "rover", settings=MODULES + BROKEN + TALKING)
        for user in ("owner", "viewer"):
            self.relay.cli("right", "grant", user, "rover", user)
        self.relay.cli("right", "grant", "watcher", "rover", "viewer", "--allow", "manage:processes")

    def stop(self) -> None:
        self.robot.stop()
        self.relay.stop()


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RobotWithModules]:
    yield from running_world(RobotWithModules, tmp_path_factory.mktemp("modules"))


@pytest.fixture(scope="module")
def cockpit(browser: Browser, world: RobotWithModules) -> Iterator[Callable[[str], Page]]:
    with checked_pages(browser, f"http://127.0.0.1:{world.relay.http_port}", WAIT_SECONDS) as new_page:

        def open_cockpit(user: str) -> Page:
            page = new_page(1280, 900)
            open_session(page, user, PASSWORD)
            page.goto("/cockpit/rover")
            seen(page, "presence").wait_for()
            return page

        yield open_cockpit


@pytest.fixture(scope="module")
def page(cockpit: Callable[[str], Page]) -> Page:
    """The owner's."""
    return cockpit("owner")


def row(page: Page, name: str) -> Locator:
    return page.locator(f'[data-testid="module"][data-name="{name}"]')


def wait_state(module: Locator, state: str) -> None:
    expect(module).to_have_attribute("data-state", state, timeout=WAIT_SECONDS * 1000)


def test_a_module_is_started_restarted_and_stopped(page: Page) -> None:
    wait_state(row(page, "base"), "running")
    cleaning = row(page, "cleaning")
    cleaning.get_by_test_id("module-start").click()
    wait_state(cleaning, "running")
    cleaning.get_by_test_id("module-log-toggle").click()
    expect(seen(page, "module-log")).to_contain_text("swept", timeout=WAIT_SECONDS * 1000)
    former = cleaning.get_by_text(PROCESS).inner_text()
    cleaning.get_by_test_id("module-restart").click()
    expect(cleaning.get_by_text(former, exact=True)).to_have_count(0, timeout=WAIT_SECONDS * 1000)
    wait_state(cleaning, "running")
    expect(cleaning.get_by_text(PROCESS)).not_to_have_text(former)
    cleaning.get_by_test_id("module-stop").click()
    wait_state(cleaning, "stopped")


def test_a_module_that_has_failed_is_started_or_stopped(page: Page) -> None:
    """It is wanted until it is stopped."""
    broken = row(page, "broken")
    broken.get_by_test_id("module-start").click()
    wait_state(broken, "failed")
    expect(broken).to_contain_text("Exit code 3.")
    expect(broken.get_by_test_id("module-start")).to_be_enabled()
    broken.get_by_test_id("module-stop").click()
    wait_state(broken, "stopped")
    expect(broken.get_by_test_id("module-stop")).to_have_count(0)


def test_a_log_is_read_backwards_and_by_level(page: Page) -> None:
    talking = row(page, "talking")
    talking.get_by_test_id("module-log-toggle").click()
    log = talking.get_by_test_id("module-log")
    expect(log).to_contain_text("line 249;", timeout=WAIT_SECONDS * 1000)
    expect(log).not_to_contain_text("line 77;")
    earlier = talking.get_by_test_id("module-log-earlier")
    earlier.click()
    expect(log).to_contain_text("line 77;")
    expect(log).to_contain_text("line 249;")
    talking.get_by_test_id("module-log-level").select_option("Errors and above")
    # The earlier page is not read for it: the robot finds both.
    expect(log).to_contain_text("line 3;")
    expect(log.locator("p")).to_have_count(2)
    expect(earlier).to_have_count(0)
    talking.get_by_test_id("module-log-level").select_option("All")
    expect(log).to_contain_text("line 249;")
    for width in (390, 1280):
        page.set_viewport_size({"width": width, "height": 900})
        assert violations(page) == []
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")


def processes(page: Page) -> Locator:
    """The table, with rows of the daemon and the modules."""
    toggle = seen(page, "processes-toggle")

    def opened() -> bool:
        """While panels above it load, a click may miss it."""
        if toggle.get_attribute("aria-expanded") == "false":
            toggle.click()
        return toggle.get_attribute("aria-expanded") == "true"

    wait_for("the table of processes opens", opened)
    table = seen(page, "processes")
    for part in ("daemon", "guard", "base"):
        # If it fails, it says what the table shows.
        expect(table).to_contain_text(part, timeout=WAIT_SECONDS * 1000)
        table.locator(f'[data-part="{part}"]').first.wait_for()
    return table


def test_processes_are_shown_at_any_width(page: Page) -> None:
    table = processes(page)
    seen(page, "processes-every").select_option("0.5 s")
    expect(table.locator('[data-part="daemon"]').first).not_to_contain_text("–")
    for width in (390, 1280):
        page.set_viewport_size({"width": width, "height": 900})
        assert violations(page) == []
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")


@pytest.mark.parametrize(
    ("title", "number", "order"),
    [("PID", 3, ["descending", "ascending"]), ("Part", 1, ["ascending", "descending"])],
)
def test_a_click_on_a_column_sorts_by_it_and_another_reverses(
    page: Page, title: str, number: int, order: list[str]
) -> None:
    """Numbers begin with the largest, texts with the first of the alphabet."""
    table = processes(page)
    heading = table.get_by_role("columnheader", name=title, exact=True)
    for expected in order:
        heading.get_by_role("button").click()
        expect(heading).to_have_attribute("aria-sort", expected)
        texts = table.locator(f"tbody td:nth-child({number})").all_inner_texts()
        cells: list[Any] = [int(text) for text in texts] if title == "PID" else texts
        assert len(set(cells)) > 1
        assert cells == sorted(cells, reverse=expected == "descending")


def test_an_order_to_a_robot_that_is_offline_is_pending_until_the_opposite(
    page: Page, world: RobotWithModules
) -> None:
    base = row(page, "base")
    wait_state(base, "running")
    table = processes(page)
    expect(table.get_by_test_id("processes-stale")).to_have_count(0)
    log = row(page, "talking").get_by_test_id("module-log")
    expect(log).to_contain_text("line 249;")
    world.robot.daemon.kill()
    expect(seen(page, "modules")).to_contain_text("last known", timeout=WAIT_SECONDS * 1000)
    expect(seen(page, "modules-note")).to_have_text(
        re.compile("^Robot rover is offline; last reported .*[.]$")
    )
    # The last known processes and lines stay in sight, and are marked.
    expect(table.get_by_test_id("processes-stale")).to_have_text(re.compile("^stale, .* old$"))
    expect(table.locator('[data-part="daemon"]').first).to_be_visible()
    row(page, "talking").get_by_test_id("module-log-earlier").click()
    expect(row(page, "talking").get_by_test_id("module-log-problem")).to_contain_text("offline")
    expect(log).to_contain_text("line 249;")
    expect(base.get_by_test_id("module-restart")).to_be_disabled()
    pending = base.get_by_test_id("module-pending")
    expect(pending).to_have_count(0)
    base.get_by_test_id("module-stop").click()
    expect(pending).to_have_text("To stop when the robot is back, ordered by owner.")
    was_notified(
        page, "Robot rover is offline. The order for base is carried out when it answers or is back."
    )
    base.get_by_test_id("module-start").click()
    expect(pending).to_have_text("To start when the robot is back, ordered by owner.")
    expect(base.get_by_test_id("module-stop")).to_be_visible()
    world.robot.start_daemon()
    expect(pending).to_have_count(0, timeout=WAIT_SECONDS * 1000)
    expect(seen(page, "modules")).not_to_contain_text("last known")
    expect(table.get_by_test_id("processes-stale")).to_have_count(0, timeout=WAIT_SECONDS * 1000)
    wait_state(base, "running")


def test_without_the_relay_the_last_states_and_processes_are_marked(
    page: Page, world: RobotWithModules
) -> None:
    table = processes(page)
    expect(table.get_by_test_id("processes-stale")).to_have_count(0, timeout=WAIT_SECONDS * 1000)
    world.relay.freeze()
    try:
        expect(table.get_by_test_id("processes-stale")).to_be_visible(timeout=WAIT_SECONDS * 1000)
        expect(table.locator('[data-part="daemon"]').first).to_be_visible()
        expect(seen(page, "modules-note")).to_contain_text("The relay does not answer")
        expect(row(page, "base")).to_be_visible()
    finally:
        world.relay.thaw()
    expect(seen(page, "modules-note")).to_have_count(0, timeout=WAIT_SECONDS * 1000)
    expect(table.get_by_test_id("processes-stale")).to_have_count(0, timeout=WAIT_SECONDS * 1000)


def test_a_pending_order_that_the_robot_refuses_is_shown(page: Page, world: RobotWithModules) -> None:
    """The robot came back without the module. A module that is back as well shows it until its next order."""
    cleaning = row(page, "cleaning")
    world.robot.daemon.kill()
    expect(seen(page, "modules")).to_contain_text("last known", timeout=WAIT_SECONDS * 1000)
    cleaning.get_by_test_id("module-start").click()
    expect(cleaning.get_by_test_id("module-pending")).to_be_visible()
    whole, world.robot._settings = world.robot._settings, TALKING
    world.robot.start_daemon()
    refused = cleaning.get_by_test_id("module-refused")
    expect(refused).to_contain_text(
        "was refused: robot rover: the robot has no module", timeout=WAIT_SECONDS * 1000
    )
    wait_state(cleaning, "unknown")
    expect(cleaning.get_by_role("button")).to_have_count(0)
    listed = world.relay.run_cli("module", "list", "rover").stdout
    assert "A pending order was refused: start cleaning, by owner: robot rover: the robot has no" in listed
    world.robot.daemon.kill()
    world.robot._settings = whole
    world.robot.start_daemon()
    wait_state(cleaning, "stopped")
    expect(refused).to_be_visible()
    cleaning.get_by_test_id("module-start").click()
    wait_state(cleaning, "running")
    expect(refused).to_have_count(0)
    cleaning.get_by_test_id("module-stop").click()
    wait_state(cleaning, "stopped")


def test_a_viewer_sees_no_modules(cockpit: Callable[[str], Page]) -> None:
    page = cockpit("viewer")
    with page.expect_response(lambda answer: answer.url.endswith("/rover/modules")):
        page.reload()
    seen(page, "presence").wait_for()
    expect(seen(page, "modules")).to_have_count(0)


def test_a_user_with_the_right_on_processes_alone_sees_them_and_no_modules(
    cockpit: Callable[[str], Page],
) -> None:
    page = cockpit("watcher")
    expect(seen(page, "modules")).to_contain_text(
        "You may manage none of its modules.", timeout=WAIT_SECONDS * 1000
    )
    processes(page)
    expect(page.get_by_test_id("module")).to_have_count(0)
