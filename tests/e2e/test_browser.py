"""The portal in a real browser, with the real relay and a real (simulated) robot behind it."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from mcap.reader import make_reader
from playwright.sync_api import Browser, Page, expect
from switchboard_browser import (
    hold_joystick,
    hold_resume,
    lived_in,
    picture,
    ready_to_drive,
    seen,
    sound_pages,
)
from switchboard_drive import LET_GO_SECONDS
from switchboard_pulse import Pulse
from switchboard_relay import Relay
from switchboard_robot import Robot
from switchboard_video import get
from switchboard_waiting import wait_for

from robot_client.motion.safety import REPEATS

PASSWORD = "correct horse"
WAIT_SECONDS = 60.0

OpenPage = Callable[..., Page]


class House:
    """A relay, a robot with its camera on, a pilot and a watcher."""

    def __init__(self, folder: Path) -> None:
        self.relay = Relay(folder)
        self.robot = Robot(self.relay, "rover", camera=True)
        self.pilot = self.relay.user("pilot")
        self.relay.user("watcher")
        self.relay.cli("right", "grant", "pilot", "rover", "operator")
        self.relay.cli("right", "grant", "watcher", "rover", "viewer")

    @property
    def url(self) -> str:
        """Where the portal is."""
        return f"http://127.0.0.1:{self.relay.http_port}"

    def put_back(self) -> None:
        """The robot stands where it began."""
        with self.relay.connect("rover", self.pilot) as client:
            wait_for("the robot is put back", lambda: client.call("/reset")["result"])

    def stop(self) -> None:
        """End everything."""
        self.robot.stop()
        self.relay.stop()


@pytest.fixture(scope="module")
def house(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    """One house for all; the tests that restart its relay leave it whole."""
    yield from lived_in(House, tmp_path_factory.mktemp("browser"))


@pytest.fixture
def open_page(browser: Browser, house: House) -> Iterator[OpenPage]:
    """Opens pages of the portal; an uncaught error or a breach of the CSP in any of them fails the test."""
    with sound_pages(browser, house.url, WAIT_SECONDS) as new_page:

        def open_page(path: str = "/", user: str = "", width: int = 1280, height: int = 800) -> Page:
            page = new_page(width, height)
            page.goto("/login" if user else path)
            if user:
                log_in(page, user)
                expect(seen(page, "robot-card")).to_have_count(1)
                page.goto(path)
            return page

        yield open_page


def log_in(page: Page, user: str) -> None:
    """Fill in the form."""
    seen(page, "login-user").fill(user)
    seen(page, "login-password").fill(PASSWORD)
    seen(page, "login-submit").click()


def ready(page: Page) -> None:
    """The cockpit is connected, has control, and its picture is live."""
    ready_to_drive(page)
    expect(seen(page, "camera-fps")).to_have_text(re.compile(r"[1-9]\d* fps"))


def colours(page: Page, canvas: str) -> int:
    """How many different colours a canvas shows, of those at every 16th pixel."""
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


def stands_after_zero(house: House, page: Page, since: int) -> None:
    """What reached the robot since then ends with zeros alone, and it stands.

    The page says zero once; the robot's daemon repeats it for 200 ms, for subscribers that may have missed it. A page
    that was late, as on a busy computer, has had the robot stopped by its watchdog already, in the same way.
    """

    def commands() -> list[tuple[float, float]]:
        return [(each["v"], each["w"]) for each in house.robot.events("command", since)]

    wait_for("a zero came", lambda: commands()[-1:] == [(0, 0)])
    wait_for("the robot stands", lambda: not house.robot.moving())
    page.wait_for_timeout(700)  # proves absence: no further command, and no zero but the daemon's repeats
    told = commands()
    last = max(index for index, each in enumerate(told) if each != (0, 0))
    assert 1 <= len(told[last + 1 :]) <= 2 * REPEATS


def turn_by_key(house: House, page: Page) -> None:
    """Holding A turns the robot on the spot; lifting it brings zero and standstill."""
    since = time.monotonic_ns()
    page.keyboard.down("a")
    wait_for("the robot moves", house.robot.moving)
    page.keyboard.up("a")
    stands_after_zero(house, page, since)


# --- coming in --------------------------------------------------------------------------------------------


def test_a_password_leads_to_the_robots_and_into_the_cockpit(house: House, open_page: OpenPage) -> None:
    """Log in, see the robot online, open it: picture, scan, odometry, latency and topics are live."""
    page = open_page("/")
    log_in(page, "pilot")
    card = page.locator("[data-testid=robot-card][data-robot=rover]")
    expect(card.get_by_test_id("robot-state")).to_have_attribute("data-state", re.compile("online|in_use"))
    card.get_by_test_id("open-robot").click()
    ready(page)
    expect(seen(page, "latency-badge")).to_contain_text(re.compile(r"\d+ ms"))
    expect(seen(page, "odom-x")).to_have_text(re.compile(r"-?−?\d+\.\d\d"))
    row = page.locator("[data-testid=topic-row][data-topic='/battery_state']")
    row.click()
    expect(seen(page, "topic-echo")).to_contain_text("percentage")
    assert colours(page, "camera-canvas") > 50
    first = picture(page, "camera-canvas")
    wait_for("the picture changes", lambda: picture(page, "camera-canvas") != first)


def test_a_one_time_link_logs_in_once(browser: Browser, tmp_path: Path) -> None:
    """The link of a relay's first start opens the portal as administrator; used again it says so."""
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
    """After logging out only the login is left, also for an address typed by hand."""
    page = open_page("/fleet", "pilot")
    seen(page, "user-menu").click()
    seen(page, "logout").click()
    expect(seen(page, "login-user")).to_be_visible()
    page.goto("/cockpit/rover")
    expect(seen(page, "login-user")).to_be_visible()


# --- driving ----------------------------------------------------------------------------------------------


def test_the_joystick_drives_and_letting_go_stops(house: House, open_page: OpenPage) -> None:
    """The robot moves by its own record, picture and scan change; letting go brings zero and standstill."""
    house.put_back()
    page = open_page("/cockpit/rover", "pilot")
    ready(page)
    before = {name: picture(page, name) for name in ("scan-canvas", "camera-canvas")}
    since = time.monotonic_ns()
    hold_joystick(page, -60, -30)
    wait_for("the robot moves", house.robot.moving)
    expect(seen(page, "odom-speed")).not_to_have_text("0.00")
    for name, shown in before.items():
        wait_for(f"{name} changes", lambda name=name, shown=shown: picture(page, name) != shown)
    page.mouse.up()
    stands_after_zero(house, page, since)
    turning = [each for each in house.robot.events("command", since) if each["w"]]
    assert all(each["w"] > 0 for each in turning), "pulled to the left it turns left"
    expect(seen(page, "odom-speed")).to_have_text("0.00")


def test_the_keyboard_drives_and_lifting_the_key_stops(house: House, open_page: OpenPage) -> None:
    """A turns on the spot; lifting it brings zero and standstill."""
    page = open_page("/cockpit/rover", "pilot")
    ready(page)
    turn_by_key(house, page)


def test_a_page_that_loses_the_focus_stops(house: House, open_page: OpenPage) -> None:
    """Blur while driving stops the robot, though the key is still held."""
    page = open_page("/cockpit/rover", "pilot")
    ready(page)
    since = time.monotonic_ns()
    page.keyboard.down("a")
    wait_for("the robot moves", house.robot.moving)
    page.evaluate("window.dispatchEvent(new Event('blur'))")
    stands_after_zero(house, page, since)
    page.keyboard.up("a")


def test_a_page_that_is_closed_leaves_the_robot_standing(house: House, open_page: OpenPage) -> None:
    """Closing the tab while driving stops the robot."""
    page = open_page("/cockpit/rover", "pilot")
    ready(page)
    page.keyboard.down("a")
    wait_for("the robot moves", house.robot.moving)
    page.close()
    wait_for("the robot stands", lambda: not house.robot.moving())


def test_the_stop_button_stops(house: House, open_page: OpenPage) -> None:
    """STOP beats the key that is held, and lasts until somebody holds the button to resume."""
    page = open_page("/cockpit/rover", "pilot")
    ready(page)
    page.keyboard.down("a")
    wait_for("the robot moves", house.robot.moving)
    seen(page, "stop").click()
    wait_for("the robot stands", lambda: not house.robot.moving())
    page.keyboard.up("a")
    expect(seen(page, "stopped")).to_contain_text("By pilot")
    hold_resume(page)
    turn_by_key(house, page)


# --- rights -----------------------------------------------------------------------------------------------


def test_a_viewer_watches_and_sees_why_there_is_nothing_to_drive_with(
    house: House, open_page: OpenPage
) -> None:
    """The picture is live, the controls are off and say why; nothing reaches the robot."""
    page = open_page("/cockpit/rover", "watcher")
    expect(seen(page, "camera-fps")).to_have_text(re.compile(r"[1-9]\d* fps"))
    expect(seen(page, "drive-blocked")).to_contain_text("viewer")
    expect(seen(page, "control-take")).to_have_count(0)
    since = time.monotonic_ns()
    hold_joystick(page, 0, -60)
    page.mouse.up()
    page.keyboard.press("w")
    page.wait_for_timeout(500)  # proves absence
    assert house.robot.events("command", since) == []


def test_a_revoked_right_is_said_within_two_seconds(house: House, open_page: OpenPage) -> None:
    """The admin command line revokes; the open cockpit shows it in words, and a new right opens it again."""
    house.relay.user("leaver")
    house.relay.cli("right", "grant", "leaver", "rover", "operator")
    page = open_page("/cockpit/rover", "leaver")
    ready(page)
    house.relay.cli("right", "revoke", "leaver", "rover")
    with Pulse() as pulse:
        begun = time.monotonic()
        expect(seen(page, "link-banner")).to_contain_text("revoked")
        assert time.monotonic() - begun < 2 + pulse.lost()
    expect(seen(page, "link-state")).to_have_attribute("data-state", "closed")


# --- what breaks ------------------------------------------------------------------------------------------


def test_the_page_recovers_from_a_restart_of_the_relay(house: House, open_page: OpenPage) -> None:
    """Stopped, killed: each time the open cockpit is live again by itself, still logged in."""
    page = open_page("/cockpit/rover", "pilot")
    ready(page)
    for end in (house.relay.stop, house.relay.kill):
        end()
        expect(seen(page, "link-state")).not_to_have_attribute("data-state", "open")
        house.relay.start()
        house.robot.wait_online()
        ready(page)
        first = picture(page, "camera-canvas")
        wait_for("the picture changes", lambda first=first: picture(page, "camera-canvas") != first)
    # Whoever has driven this robot by the relay that was killed lets go of it first.
    page.keyboard.press("a", delay=200)
    page.wait_for_timeout(1000 * LET_GO_SECONDS)  # so long he must say nothing
    turn_by_key(house, page)


def test_a_robot_that_goes_away_is_shown_so_and_comes_back(house: House, open_page: OpenPage) -> None:
    """Fleet and cockpit tell that the robot is offline, and both are live again when it is back."""
    fleet = open_page("/fleet", "watcher")
    page = open_page("/cockpit/rover", "pilot")
    ready(page)
    state = fleet.locator("[data-robot=rover]").get_by_test_id("robot-state")
    house.robot.daemon.stop()
    expect(state).to_have_attribute("data-state", "offline")
    expect(seen(page, "drive-blocked")).to_have_text("The robot is offline.")
    house.robot.start_daemon()
    expect(state).not_to_have_attribute("data-state", "offline")
    ready(page)


# --- recording --------------------------------------------------------------------------------------------


def test_what_is_recorded_from_the_cockpit_is_downloaded_there(
    house: House, open_page: OpenPage, tmp_path: Path
) -> None:
    """Chosen by hand, followed, stopped, and read by MCAP's own library; who only watches sees nothing of it."""
    page = open_page("/cockpit/rover", "pilot")
    seen(page, "recording-new").click()
    page.locator("[data-testid=recording-topic][data-topic='/odom']").check()
    seen(page, "recording-camera").first.check()
    seen(page, "recording-start").click()
    expect(seen(page, "recording-state")).to_have_text("Recording")
    expect(seen(page, "recording-messages")).to_have_text(re.compile(r"[1-9]\d+"))
    # Its first picture goes to all who watch it.
    assert get(house.relay, house.pilot, "snapshot").status == 200
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
    assert list((house.relay.data / "recordings").iterdir()) == []


# --- looks ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("width", "height"), [(390, 844), (1280, 800)])
def test_no_page_scrolls_sideways(open_page: OpenPage, tmp_path: Path, width: int, height: int) -> None:
    """Login, fleet and cockpit fit a phone and a laptop; their pictures are kept for people to look at."""
    shots = {}
    page = open_page("/login", width=width, height=height)
    expect(seen(page, "login-submit")).to_be_visible()
    shots["login"] = page
    page = open_page("/fleet", "pilot", width, height)
    expect(seen(page, "robot-state")).to_be_visible()
    shots["fleet"] = page
    page = open_page("/cockpit/rover", "pilot", width, height)
    ready(page)
    page.locator("[data-testid=topic-row][data-topic='/scan']").click()
    expect(seen(page, "topic-echo")).to_contain_text("angle_min")
    shots["cockpit"] = page
    for name, each in shots.items():
        assert each.evaluate("document.documentElement.scrollWidth") <= width, name
        each.evaluate("window.scrollTo(0, 0)")
        each.screenshot(path=tmp_path / f"{name}-{width}.png", full_page=True)
