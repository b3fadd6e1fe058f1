"""The portal in a real browser, with a real relay and a simulated robot."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from mcap.reader import make_reader
from playwright.sync_api import Browser, Page, expect

from robot_client.motion.watchdog import STOP_ZEROS
from tests.worlds.browser import (
    SMALL_CAMERA,
    checked_pages,
    hold_joystick,
    hold_resume,
    open_session,
    open_topic,
    picture,
    ready_to_drive,
    running_world,
    seen,
)
from tests.worlds.driving import LET_GO_SECONDS
from tests.worlds.relay_process import Relay
from tests.worlds.robot_process import Robot
from tests.worlds.video_clients import get
from tests.worlds.waiting import wait_for

PASSWORD = "correct horse"
WAIT_SECONDS = 60.0

OpenPage = Callable[..., Page]


class World:
    """A relay, a robot with its camera on, a pilot and a watcher."""

    def __init__(self, folder: Path) -> None:
        self.relay = Relay(folder)
        self.robot = Robot(self.relay, "rover", camera=True, sim_options=SMALL_CAMERA)
        self.pilot = self.relay.user("pilot")
        self.relay.user("watcher")
        self.relay.cli("right", "grant", "pilot", "rover", "operator")
        self.relay.cli("right", "grant", "watcher", "rover", "viewer")

    @property
    def url(self) -> str:
        """The URL of the portal."""
        return f"http://127.0.0.1:{self.relay.http_port}"

    def put_back(self) -> None:
        """The robot stands at its start."""
        with self.relay.connect("rover", self.pilot) as client:
            wait_for("the robot is put back", lambda: client.call("/reset")["result"])

    def stop(self) -> None:
        self.robot.stop()
        self.relay.stop()


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """One world for all tests; a test that restarts the relay leaves it running."""
    yield from running_world(World, tmp_path_factory.mktemp("browser"))


@pytest.fixture
def open_page(browser: Browser, world: World) -> Iterator[OpenPage]:
    """Opens pages of the portal; an uncaught error or a violation of the CSP in any of them fails the test."""
    with checked_pages(browser, world.url, WAIT_SECONDS) as new_page:

        def open_page(path: str = "/", user: str = "", width: int = 1280, height: int = 800) -> Page:
            page = new_page(width, height)
            if user:
                open_session(page, user, PASSWORD)
            page.goto(path)
            return page

        yield open_page


def log_in(page: Page, user: str) -> None:
    """Submits the login form."""
    seen(page, "login-user").fill(user)
    seen(page, "login-password").fill(PASSWORD)
    seen(page, "login-submit").click()


def ready(page: Page) -> None:
    """Waits until the cockpit is connected, has control, and shows live video."""
    ready_to_drive(page)
    expect(seen(page, "camera-fps")).to_have_text(re.compile(r"[1-9]\d* fps"))


def colours(page: Page, canvas: str) -> int:
    """The number of colours on a canvas, at every 16th pixel."""
    return int(
        seen(page, canvas).evaluate(
            """canvas => {
                const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height)
                const seen = new Set()
                for (let i = 0; i < data.length; i += 64) seen.add(data[i] * 65536 + data[i + 1] * 256 + data[i + 2])
                return seen.size
            }"""
        )
    )


def stands_after_zero(world: World, page: Page, since: int) -> None:
    """Waits until the last commands to the robot are zeros, and it stands.

    The page sends zero once; the robot's daemon repeats it for 200 ms, for subscribers that may have missed
    it. On a busy computer the page may be late, so that the watchdog has stopped the robot already in the
    same way.
    """

    def commands() -> list[tuple[float, float]]:
        return [(each["v"], each["w"]) for each in world.robot.events("command", since)]

    wait_for("a zero came", lambda: commands()[-1:] == [(0, 0)])
    wait_for("the robot stands", lambda: not world.robot.moving())
    page.wait_for_timeout(700)  # shows absence: no further command, and no zero but the daemon's repeats
    reported = commands()
    last = max(index for index, each in enumerate(reported) if each != (0, 0))
    assert 1 <= len(reported[last + 1 :]) <= 2 * STOP_ZEROS


def turn_by_key(world: World, page: Page) -> None:
    """Holding A turns the robot; releasing it sends zero and the robot stands."""
    since = time.monotonic_ns()
    page.keyboard.down("a")
    wait_for("the robot moves", world.robot.moving)
    page.keyboard.up("a")
    stands_after_zero(world, page, since)


# --- login ------------------------------------------------------------------------------------------------


def test_a_password_leads_to_the_robots_and_into_the_cockpit(world: World, open_page: OpenPage) -> None:
    """Log in, see the robot online, open it: video, scan, odometry, latency and topics are live."""
    page = open_page("/")
    log_in(page, "pilot")
    card = page.locator("[data-testid=robot-card][data-robot=rover]")
    expect(card.get_by_test_id("robot-state")).to_have_attribute("data-state", re.compile("online|in_use"))
    card.get_by_test_id("open-robot").click()
    ready(page)
    expect(seen(page, "latency-badge")).to_contain_text(re.compile(r"\d+ ms"))
    expect(seen(page, "odom-x")).to_have_text(re.compile(r"-?−?\d+\.\d\d"))
    open_topic(page, "/battery_state")
    expect(seen(page, "topic-echo")).to_contain_text("percentage")
    assert colours(page, "camera-canvas") > 50
    first = picture(page, "camera-canvas")
    wait_for("the picture changes", lambda: picture(page, "camera-canvas") != first)


def test_a_one_time_link_logs_in_once(browser: Browser, tmp_path: Path) -> None:
    """The link of a relay's first start opens the portal as administrator; a second use shows an error."""
    relay = Relay(tmp_path)
    try:
        assert relay.process is not None
        link = re.search(r"http://\S+/login#code=\S+", relay.process.said())
        assert link is not None
        for words in (None, "already used"):
            context = browser.new_context()
            page = context.new_page()
            page.goto(link[0])
            if words is None:
                expect(seen(page, "fleet-empty")).to_contain_text("switchboard robot add NAME")
            else:
                expect(seen(page, "login-error")).to_contain_text(words)
            assert "#code" not in page.url
            context.close()
    finally:
        relay.stop()


def test_logging_out_closes_the_portal(open_page: OpenPage) -> None:
    """Only the login page is left, for typed addresses too."""
    page = open_page("/fleet", "pilot")
    seen(page, "user-menu").click()
    seen(page, "logout").click()
    expect(seen(page, "login-user")).to_be_visible()
    page.goto("/cockpit/rover")
    expect(seen(page, "login-user")).to_be_visible()


# --- driving ----------------------------------------------------------------------------------------------


def test_the_joystick_drives_and_releasing_stops(world: World, open_page: OpenPage) -> None:
    """The robot moves by its own log, video and scan change; releasing sends zero and the robot stands."""
    world.put_back()
    page = open_page("/cockpit/rover", "pilot")
    ready(page)
    before = {name: picture(page, name) for name in ("scan-canvas", "camera-canvas")}
    since = time.monotonic_ns()
    hold_joystick(page, -60, -30)
    wait_for("the robot moves", world.robot.moving)
    expect(seen(page, "odom-speed")).not_to_have_text("0.00")
    for name, shown in before.items():
        wait_for(f"{name} changes", lambda name=name, shown=shown: picture(page, name) != shown)
    page.mouse.up()
    stands_after_zero(world, page, since)
    turning = [each for each in world.robot.events("command", since) if each["w"]]
    assert all(each["w"] > 0 for each in turning), "pulled to the left it turns left"
    expect(seen(page, "odom-speed")).to_have_text("0.00")


def test_the_keyboard_drives_and_lifting_the_key_stops(world: World, open_page: OpenPage) -> None:
    """A turns in place; releasing it sends zero and the robot stands."""
    page = open_page("/cockpit/rover", "pilot")
    ready(page)
    turn_by_key(world, page)


def test_a_page_that_loses_the_focus_stops(world: World, open_page: OpenPage) -> None:
    """Losing the focus stops the robot, though the key is still held."""
    page = open_page("/cockpit/rover", "pilot")
    ready(page)
    since = time.monotonic_ns()
    page.keyboard.down("a")
    wait_for("the robot moves", world.robot.moving)
    page.evaluate("window.dispatchEvent(new Event('blur'))")
    stands_after_zero(world, page, since)
    page.keyboard.up("a")


def test_a_page_that_is_closed_leaves_the_robot_standing(world: World, open_page: OpenPage) -> None:
    page = open_page("/cockpit/rover", "pilot")
    ready(page)
    page.keyboard.down("a")
    wait_for("the robot moves", world.robot.moving)
    page.close()
    wait_for("the robot stands", lambda: not world.robot.moving())


def test_the_stop_button_stops(world: World, open_page: OpenPage) -> None:
    """STOP overrides the held key, and lasts until a user holds the resume button."""
    page = open_page("/cockpit/rover", "pilot")
    ready(page)
    page.keyboard.down("a")
    wait_for("the robot moves", world.robot.moving)
    seen(page, "stop").click()
    wait_for("the robot stands", lambda: not world.robot.moving())
    page.keyboard.up("a")
    expect(seen(page, "stopped")).to_contain_text("By pilot")
    hold_resume(page)
    turn_by_key(world, page)


# --- rights -----------------------------------------------------------------------------------------------


def test_a_viewer_watches_and_sees_why_there_is_nothing_to_drive_with(
    world: World, open_page: OpenPage
) -> None:
    """The video is live, and the controls are disabled with a reason; no command reaches the robot."""
    page = open_page("/cockpit/rover", "watcher")
    expect(seen(page, "camera-fps")).to_have_text(re.compile(r"[1-9]\d* fps"))
    expect(seen(page, "drive-blocked")).to_contain_text("viewer")
    expect(seen(page, "control-take")).to_have_count(0)
    since = time.monotonic_ns()
    hold_joystick(page, 0, -60)
    page.mouse.up()
    page.keyboard.press("w")
    page.wait_for_timeout(500)  # shows absence
    assert world.robot.events("command", since) == []


def test_a_revoked_right_is_shown(world: World, open_page: OpenPage) -> None:
    """The command line revokes the right; the open cockpit shows the reason, and a new right opens it again."""
    world.relay.user("leaver")
    world.relay.cli("right", "grant", "leaver", "rover", "operator")
    page = open_page("/cockpit/rover", "leaver")
    ready(page)
    world.relay.cli("right", "revoke", "leaver", "rover")
    expect(seen(page, "link-banner")).to_contain_text("revoked")
    expect(seen(page, "link-state")).to_have_attribute("data-state", "closed")


# --- failures ---------------------------------------------------------------------------------------------


def test_the_page_recovers_from_a_restart_of_the_relay(world: World, open_page: OpenPage) -> None:
    """After a stop and after a kill the open cockpit is live again by itself, still logged in."""
    page = open_page("/cockpit/rover", "pilot")
    ready(page)
    for end in (world.relay.stop, world.relay.kill):
        end()
        expect(seen(page, "link-state")).not_to_have_attribute("data-state", "open")
        world.relay.start()
        world.robot.wait_online()
        ready(page)
        first = picture(page, "camera-canvas")
        wait_for("the picture changes", lambda first=first: picture(page, "camera-canvas") != first)
    # A client that drove before the kill must release first.
    page.keyboard.press("a", delay=200)
    page.wait_for_timeout(1000 * LET_GO_SECONDS)  # a pause this long counts as a release
    turn_by_key(world, page)


def test_a_robot_that_goes_away_is_shown_so_and_comes_back(world: World, open_page: OpenPage) -> None:
    """Fleet and cockpit show the robot offline, and both are live again when it is back."""
    fleet = open_page("/fleet", "watcher")
    page = open_page("/cockpit/rover", "pilot")
    ready(page)
    state = fleet.locator("[data-robot=rover]").get_by_test_id("robot-state")
    world.robot.daemon.stop()
    expect(state).to_have_attribute("data-state", "offline")
    expect(seen(page, "drive-blocked")).to_have_text("The robot is offline.")
    world.robot.start_daemon()
    expect(state).not_to_have_attribute("data-state", "offline")
    ready(page)


# --- recording --------------------------------------------------------------------------------------------


def test_recording_from_the_cockpit_is_downloaded_there(
    world: World, open_page: OpenPage, tmp_path: Path
) -> None:
    """Topics are selected by hand, and the recording is watched, stopped, and read by MCAP's own library. A
    viewer does not see it.
    """
    page = open_page("/cockpit/rover", "pilot")
    seen(page, "recording-new").click()
    page.locator("[data-testid=recording-topic][data-topic='/odom']").check()
    seen(page, "recording-camera").first.check()
    seen(page, "recording-start").click()
    expect(seen(page, "recording-state")).to_have_text("Recording")
    expect(seen(page, "recording-messages")).to_have_text(re.compile(r"[1-9]\d+"))
    # Its first frame is sent to all viewers.
    assert get(world.relay, world.pilot, "snapshot").status == 200
    watcher = open_page("/cockpit/rover", "watcher")
    expect(seen(watcher, "topic-row").first).to_be_visible()
    expect(seen(watcher, "recordings")).to_have_count(0)
    seen(page, "recording-stop").click()
    expect(seen(page, "recording-reason")).to_have_text("Stopped by pilot.")
    with page.expect_download() as coming:
        seen(page, "recording-download").click()
    path = tmp_path / coming.value.suggested_filename
    coming.value.save_as(path)
    with path.open("rb") as stream:
        topics = {channel.topic for _, channel, _ in make_reader(stream).iter_messages()}
    assert "/odom" in topics and len(topics) == 2
    seen(page, "recording-delete").click()
    seen(page, "recording-delete-sure").click()
    expect(seen(page, "recording")).to_have_count(0)
    assert list((world.relay.data / "recordings").iterdir()) == []


# --- layout -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("width", "height"), [(390, 844), (1280, 800)])
def test_no_page_scrolls_sideways(open_page: OpenPage, tmp_path: Path, width: int, height: int) -> None:
    """Login, fleet and cockpit fit a phone and a laptop; screenshots are kept for review."""
    shots = {}
    page = open_page("/login", width=width, height=height)
    expect(seen(page, "login-submit")).to_be_visible()
    shots["login"] = page
    page = open_page("/fleet", "pilot", width, height)
    expect(seen(page, "robot-state")).to_be_visible()
    shots["fleet"] = page
    page = open_page("/cockpit/rover", "pilot", width, height)
    ready(page)
    open_topic(page, "/scan")
    expect(seen(page, "topic-echo")).to_contain_text("angle_min")
    shots["cockpit"] = page
    for name, each in shots.items():
        assert each.evaluate("document.documentElement.scrollWidth") <= width, name
        each.evaluate("window.scrollTo(0, 0)")
        each.screenshot(path=tmp_path / f"{name}-{width}.png", full_page=True)
