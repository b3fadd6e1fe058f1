"""The built portal in a real browser, with a fake relay."""

from __future__ import annotations

import gzip
import itertools
import re
import time
from typing import TYPE_CHECKING, Any

import pytest
from playwright.sync_api import Page, expect

from tests.worlds.browser import hold_joystick, open_topic, ready_to_drive, seen

if TYPE_CHECKING:
    from collections.abc import Callable

    from playwright.sync_api import Route

    OpenPage = Callable[..., Page]
    FakeRelay = Any

PASSWORD = "correct horse"
ZERO = (0, 0)
COCKPIT = "/cockpit/rover-1"


def driving(relay: FakeRelay, at_least: int = 3) -> None:
    relay.until(lambda: len([c for c in relay.commands() if c != ZERO]) >= at_least, "no commands came")


def assert_one_zero_then_silence(page: Page, relay: FakeRelay) -> None:
    relay.until(lambda: relay.commands()[-1:] == [ZERO], "no zero came")
    before = relay.commands()
    # Absence can only be shown by waiting.
    page.wait_for_timeout(700)
    after = relay.commands()
    assert after == before, f"commands after the zero: {after[len(before) :]}"
    moving = max(i for i, command in enumerate(after) if command != ZERO)
    assert after[moving + 1 :] == [ZERO]


class TestLogin:
    def test_wrong_password_is_shown(self, open_page: OpenPage) -> None:
        """A refused login shows the relay's reason and stays on the page."""
        page = open_page("/")
        seen(page, "login-user").fill("driver")
        seen(page, "login-password").fill("guess")
        seen(page, "login-submit").click()
        expect(seen(page, "login-error")).to_have_text("User or password is wrong.")
        expect(seen(page, "login-password")).to_have_value("")

    def test_right_password_leads_to_the_robots(self, open_page: OpenPage) -> None:
        """A login shows the fleet, and a reload keeps the session."""
        page = open_page("/")
        seen(page, "login-user").fill("driver")
        seen(page, "login-password").fill(PASSWORD)
        seen(page, "login-submit").click()
        expect(seen(page, "robot-card")).to_have_count(2)
        page.reload()
        expect(seen(page, "robot-card")).to_have_count(2)

    def test_a_blank_around_the_name_does_not_count(self, open_page: OpenPage) -> None:
        """Keyboards of phones add one."""
        page = open_page("/")
        seen(page, "login-user").fill(" driver ")
        seen(page, "login-password").fill(PASSWORD)
        seen(page, "login-submit").click()
        expect(seen(page, "robot-card")).to_have_count(2)

    @pytest.mark.parametrize("field", ["login-user", "login-password"])
    def test_caps_lock_is_shown(self, open_page: OpenPage, field: str) -> None:
        page = open_page("/")
        expect(seen(page, field)).to_be_visible()
        for on in (True, False):
            event = {"key": "a", "bubbles": True, "modifierCapsLock": on}
            seen(page, field).evaluate(
                "(field, how) => field.dispatchEvent(new KeyboardEvent('keydown', how))", event
            )
            expect(seen(page, "caps-lock")).to_have_count(1 if on else 0)
        # As the browser does when it fills a form in.
        seen(page, field).evaluate("field => field.dispatchEvent(new Event('keydown', { bubbles: true }))")
        expect(seen(page, "login-submit")).to_be_visible()

    def test_too_many_attempts_wait(self, open_page: OpenPage) -> None:
        """After 429 the button counts down the relay's time."""
        page = open_page("/login")
        seen(page, "login-user").fill("hasty")
        seen(page, "login-password").fill("x")
        seen(page, "login-submit").click()
        expect(seen(page, "login-submit")).to_have_text(re.compile(r"Try again in \d+ s"))
        expect(seen(page, "login-submit")).to_be_disabled()

    def test_login_link_works_once_and_leaves_no_code(self, open_page: OpenPage) -> None:
        """A one-time link logs in, its code is removed from the address, and the second use is refused with a
        reason.
        """
        page = open_page("/login#code=ONCE-ONLY")
        expect(seen(page, "robot-card")).to_have_count(3)
        assert "ONCE-ONLY" not in page.url
        other = open_page("/login#code=ONCE-ONLY")
        expect(seen(other, "login-error")).to_contain_text("used up")
        assert "ONCE-ONLY" not in other.url

    def test_login_link_may_be_opened_where_the_page_is_shown_already(self, open_page: OpenPage) -> None:
        """The page is not loaded again then."""
        page = open_page("/login")
        expect(seen(page, "login-user")).to_be_visible()
        page.evaluate("location.hash = 'code=ONCE-ONLY'")
        expect(seen(page, "robot-card")).to_have_count(3)
        assert "ONCE-ONLY" not in page.url

    def test_the_page_asked_for_comes_after_the_login(self, open_page: OpenPage) -> None:
        """A user who opens a cockpit without a session logs in and gets that cockpit."""
        page = open_page(COCKPIT)
        seen(page, "login-user").fill("driver")
        seen(page, "login-password").fill(PASSWORD)
        seen(page, "login-submit").click()
        expect(seen(page, "camera-canvas")).to_be_visible()

    def test_logout(self, open_page: OpenPage) -> None:
        """It ends the session and shows the login page."""
        page = open_page("/fleet", user="driver")
        seen(page, "user-menu").click()
        seen(page, "logout").click()
        expect(seen(page, "login-user")).to_be_visible()
        page.goto("/fleet")
        expect(seen(page, "login-user")).to_be_visible()


class TestFleet:
    def test_cards_show_state_and_level(self, open_page: OpenPage) -> None:
        """Each robot of the user has a card with state, battery and level."""
        page = open_page("/", user="admin")
        card = page.locator("[data-testid=robot-card][data-robot=rover-1]")
        expect(card.get_by_test_id("robot-state")).to_have_attribute("data-state", "online")
        expect(card).to_contain_text("76 %")
        expect(card).to_contain_text("owner")

    @pytest.mark.parametrize("hours", [-5, 5])
    def test_times_go_by_the_relays_clock(self, open_page: OpenPage, relay: FakeRelay, hours: int) -> None:
        """The clock of the user's device may be wrong."""
        page = open_page("/robots", user="admin")
        page.add_init_script(
            f"(() => {{ const now = Date.now; Date.now = () => now() + {hours} * 3600_000 }})()"
        )
        page.goto("/")
        assert abs(page.evaluate("Date.now()") / 1000 - time.time()) > 3600
        card = page.locator("[data-testid=robot-card][data-robot=arm-3]")
        expect(card).to_contain_text("2 h ago")

    def test_changes_appear_by_themselves(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """A robot that goes offline is shown so without a reload."""
        page = open_page("/", user="admin")
        state = page.locator("[data-robot=rover-1]").get_by_test_id("robot-state")
        expect(state).to_have_attribute("data-state", "online")
        relay.do(robot="rover-1", state="offline")
        expect(state).to_have_attribute("data-state", "offline")

    def test_a_robot_that_has_not_received_its_stop(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """It is shown as stopped only after its confirmation."""
        page = open_page("/", user="admin")
        state = page.locator("[data-robot=arm-3]").get_by_test_id("robot-stopped")
        relay.do(robot="arm-3", stopped="ann", confirmed=False)
        expect(state).to_have_text("Being stopped")
        relay.do(robot="arm-3", state="online")
        expect(state).to_have_text("Stopped")

    def test_search_and_filter(self, open_page: OpenPage) -> None:
        """Words filter the list; a search without a result offers to clear it."""
        page = open_page("/", user="admin")
        seen(page, "robot-search").fill("kilted")
        expect(seen(page, "robot-card")).to_have_count(1)
        seen(page, "robot-search").fill("nothing like this")
        page.get_by_role("button", name="Show all robots").click()
        page.get_by_role("button", name="Offline").click()
        expect(seen(page, "robot-card")).to_have_attribute("data-robot", "arm-3")

    def test_empty_fleet_explains_what_to_do(self, open_page: OpenPage) -> None:
        """Without a robot the page names the command that adds one."""
        page = open_page("/", user="newcomer")
        expect(seen(page, "fleet-empty")).to_contain_text("switchboard robot add NAME")

    def test_text_from_robots_is_inert(self, open_page: OpenPage) -> None:
        """Markup in a robot's description is shown as text and makes no elements."""
        page = open_page("/", user="admin")
        card = page.locator("[data-robot=rover-2]")
        expect(card).to_contain_text("<img src=x onerror=alert(1)>")
        assert card.locator("img, b").count() == 0


UNANSWERED_MS = 1000
"""Until a stop without an answer is shown as not confirmed."""

STOPPING = re.compile("^(Stopping…|Not confirmed)$")
"""The label of a stop button without an answer: the second one after a second."""


class TestStopAll:
    def pressed(self, page: Page, relay: FakeRelay) -> None:
        page.get_by_role("button", name="Stop all robots").click()
        expect(seen(page, "toast")).to_contain_text("1 robot is offline, and will be stopped when back.")
        [asked] = relay.log(op="POST fleet")
        assert (asked["do"], asked["robots"]) == ("stop", ["*"])

    @pytest.mark.parametrize("path", ["/fleet", "/alerts"])
    def test_before_the_robots_are_known(self, open_page: OpenPage, relay: FakeRelay, path: str) -> None:
        """The relay knows which robots to stop."""
        relay.do(blind=True)
        self.pressed(open_page(path, user="admin"), relay)

    def test_where_there_is_no_page(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """A wrong address still has STOP."""
        page = open_page("/nowhere", user="admin")
        expect(page.get_by_text("Page not found")).to_be_visible()
        self.pressed(page, relay)

    def test_where_a_page_does_not_load(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """So has a page that hangs or fails to load."""
        page = open_page("/fleet", user="admin")
        expect(seen(page, "robot-card")).to_have_count(3)
        waiting: list[Route] = []
        page.route("**/assets/Alerts-*.js", lambda route: waiting.append(route))
        seen(page, "alerts-link").click()
        expect(seen(page, "robot-card")).to_have_count(0)
        self.pressed(page, relay)
        [stuck] = waiting
        stuck.abort()
        expect(page.get_by_text("The page could not be loaded")).to_be_visible()
        expect(page.get_by_role("button", name="Stop all robots")).to_be_visible()

    def test_while_the_login_is_unknown(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """A relay whose database hangs may still stop robots; the requested page is shown as soon as
        possible.
        """
        relay.do(failing=True)
        page = open_page("/alerts", user="admin")
        expect(page.get_by_text("The database does not answer. STOP is sent all the same.")).to_be_visible()
        self.pressed(page, relay)
        relay.do(failing=False)
        page.get_by_role("button", name="Try again").click()
        expect(page.get_by_role("heading", name="Alerts")).to_be_visible()

    def test_while_the_relay_is_silent(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """A page that cannot load does not stay blank for long."""
        relay.do(stuck=["session"])
        page = open_page("/fleet", user="admin")
        expect(page.get_by_text("The relay answers slowly.")).to_be_visible()
        self.pressed(page, relay)
        relay.do(stuck=[])
        expect(seen(page, "robot-card")).to_have_count(3)

    def test_a_login_that_turns_out_to_be_invalid(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """The login page says that no robot was stopped."""
        relay.do(failing=True)
        page = open_page("/fleet")
        page.get_by_role("button", name="Stop all robots").click()
        expect(seen(page, "login-notice")).to_contain_text("Nothing was stopped")
        relay.do(failing=False)
        seen(page, "login-user").fill("driver")
        seen(page, "login-password").fill(PASSWORD)
        seen(page, "login-submit").click()
        expect(seen(page, "robot-card")).to_have_count(2)

    def test_a_missing_answer_is_shown(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """The button shows at once that it is under way, and the page that it is not confirmed, until all
        stand.
        """
        page = open_page("/fleet", user="admin")
        button = page.get_by_role("button", name="Stop all robots")
        expect(seen(page, "robot-card")).to_have_count(3)
        relay.do(stuck=["orders", "pages"])
        page.clock.install()
        page.clock.pause_at(page.evaluate("Date.now()") + 1000)
        button.click()
        expect(button).to_have_text("Stopping…")
        page.clock.run_for(UNANSWERED_MS - 1)
        expect(button).to_have_text("Stopping…")
        page.clock.run_for(1)
        expect(button).to_have_text("Not confirmed")
        page.clock.resume()
        page.clock.fast_forward(23_000)
        expect(seen(page, "toast")).to_contain_text("It is unknown whether all robots are stopped.")
        expect(button).to_have_text("STOP all")
        page.clock.fast_forward(60_000)
        for robot in ("rover-1", "rover-2"):
            relay.do(robot=robot, stopped="ann")
            expect(page.locator(f"[data-robot={robot}]").get_by_test_id("robot-stopped")).to_have_text(
                "Stopped"
            )
            expect(seen(page, "toast")).to_be_visible()
        relay.do(robot="arm-3", stopped="ann", confirmed=False)
        state = page.locator("[data-robot=arm-3]").get_by_test_id("robot-stopped")
        expect(state).to_have_text("Being stopped")
        expect(seen(page, "toast")).to_be_visible()
        relay.do(robot="arm-3", stopped="ann")
        expect(state).to_have_text("Stopped")
        expect(seen(page, "toast")).to_have_count(0)

    @pytest.mark.parametrize("blind", [False, True])
    def test_where_no_request_gets_through(self, open_page: OpenPage, relay: FakeRelay, blind: bool) -> None:
        """It is sent by two websockets too, as one stop, whether or not the robots are known."""
        relay.do(blind=blind, stuck=["orders"])
        page = open_page("/fleet", user="admin")
        if not blind:
            expect(seen(page, "robot-card")).to_have_count(3)
        page.get_by_role("button", name="Stop all robots").click()
        expect(seen(page, "toast")).to_contain_text("2 robots are stopped.")
        # The answer to the first may come before the second is sent.
        relay.until(lambda: len(relay.log(op="page")) == 2, "it was not sent twice")
        asked = relay.log(op="page")
        assert [(each["do"], each["robots"]) for each in asked] == [("stop", ["*"])] * 2
        assert len({each["stop_id"] for each in asked}) == 1

    def test_a_missing_answer_of_one_robot_is_shown(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """The same with the button of its card; an unconfirmed stop can be dismissed."""
        page = open_page("/fleet", user="admin")
        page.route_web_socket(re.compile("/robots/rover-1$"), lambda _: None)  # connects to nothing
        button = page.locator("[data-robot=rover-1]").get_by_test_id("stop")
        relay.do(stuck=["orders"])
        page.clock.install()
        button.click()
        expect(button).to_have_text(STOPPING)
        page.clock.fast_forward(23_000)
        expect(seen(page, "toast")).to_contain_text("rover-1: the stop is not confirmed.")
        page.clock.fast_forward(60_000)
        seen(page, "toast").get_by_label("Dismiss").click()
        expect(seen(page, "toast")).to_have_count(0)

    def test_not_shown_without_a_login(self, open_page: OpenPage) -> None:
        """Without a user, or with a user without robots, there is no robot to stop."""
        page = open_page("/nowhere")
        expect(seen(page, "login-user")).to_be_visible()
        expect(seen(page, "stop")).to_have_count(0)
        page = open_page("/fleet", user="newcomer")
        expect(seen(page, "fleet-empty")).to_be_visible()
        expect(seen(page, "stop")).to_have_count(0)


class TestCockpit:
    def test_everything_arrives(self, open_page: OpenPage) -> None:
        """Video, scan, odometry, latency and topics show live data."""
        page = open_page(COCKPIT, user="driver")
        expect(seen(page, "link-state")).to_have_attribute("data-state", "open")
        expect(seen(page, "camera-fps")).to_have_text(re.compile(r"[1-9]\d* fps"))
        expect(seen(page, "odom-x")).to_have_text("−1.00")
        expect(seen(page, "latency-badge")).to_contain_text(re.compile(r"\d+ ms"))
        expect(seen(page, "leg-client-robot")).to_contain_text(re.compile(r"\d+ ms"))
        expect(seen(page, "leg-relay-robot")).to_have_text("4 ms")
        expect(seen(page, "topic-row")).to_have_count(11)
        for canvas in ("camera-canvas", "scan-canvas"):
            colours = seen(page, canvas).evaluate(
                """canvas => {
                    const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height)
                    const seen = new Set()
                    for (let i = 0; i < data.length; i += 4) seen.add(data[i] + ',' + data[i + 1] + ',' + data[i + 3])
                    return seen.size
                }"""
            )
            assert colours > 10, f"{canvas} shows {colours} colours"

    def test_echo_shows_shortened_messages(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """A selected topic is shown live with its rate and cut arrays, and does not change while paused."""
        page = open_page(COCKPIT, user="driver")
        seen(page, "topic-filter").fill("laser")
        open_topic(page, "/scan")
        expect(seen(page, "topic-echo")).to_contain_text("… 354 more")
        expect(seen(page, "topic-rate")).to_have_text(re.compile(r"\d+(\.\d)? Hz"))
        seen(page, "topic-pause").click()
        before = seen(page, "topic-echo").inner_text()
        page.wait_for_timeout(500)
        assert seen(page, "topic-echo").inner_text() == before

    def test_only_what_is_on_screen_is_subscribed(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """The page subscribes to three topics and one camera, and to one more topic while its echo is open."""
        page = open_page(COCKPIT, user="driver")
        expect(seen(page, "odom-x")).to_have_text("−1.00")
        shown = {"/relay/status", "/relay/control", "/scan", "/odom"}
        assert {entry["topic"] for entry in relay.log(op="subscribe")} == shown
        relay.until(lambda: relay.log(op="watch"), "no camera was watched")
        assert [entry["topic"] for entry in relay.log(op="watch")] == ["/camera/image_raw/compressed"]
        row = open_topic(page, "/battery_state")
        expect(seen(page, "topic-echo")).to_contain_text("percentage")
        row.click()
        relay.until(
            lambda: relay.log(op="unsubscribe", topic="/battery_state"), "the echo was not unsubscribed"
        )

    def test_data_that_stops_is_marked(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """When a robot falls silent its video and values are marked as old."""
        page = open_page(COCKPIT, user="driver")
        expect(seen(page, "camera-fps")).to_have_text(re.compile(r"[1-9]\d* fps"))
        relay.do(silent=True)
        expect(seen(page, "camera-stale")).to_have_text(re.compile(r"No frame for \d+ s"))
        expect(page.get_by_text(re.compile(r"stale, \d+ s old"))).to_have_count(2)
        relay.do(silent=False)
        expect(seen(page, "camera-stale")).to_have_count(0)

    def test_a_silent_relay_is_marked(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """Three seconds after the last status, its data about robot and users counts as old."""
        page = open_page(COCKPIT, user="driver")
        expect(seen(page, "person")).to_have_count(1)
        expect(seen(page, "status-stale")).to_have_count(0)
        relay.do(mute=True)
        expect(seen(page, "status-stale")).to_be_visible()
        expect(seen(page, "presence")).to_contain_text("stale")
        relay.do(mute=False)
        expect(seen(page, "status-stale")).to_have_count(0)

    def test_the_three_parts_of_the_delay_are_shown_on_request(self, open_page: OpenPage) -> None:
        """The badge opens a table with each part now, at the 95th percentile, and its losses."""
        page = open_page(COCKPIT, user="driver", width=390, height=844)
        expect(seen(page, "latency-badge")).to_contain_text(re.compile(r"\d+ ms"))
        seen(page, "latency-badge").click()
        table = page.get_by_role("group", name="Round trips")
        for leg in ("You to relay", "Relay to robot", "You to robot"):
            expect(table.get_by_role("row", name=leg)).to_contain_text(re.compile(r"\d+ ms.*6 ms.*0"))

    def test_refusals_are_shown(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """A status message of the relay appears unchanged."""
        page = open_page(COCKPIT, user="driver")
        expect(seen(page, "link-state")).to_have_attribute("data-state", "open")
        relay.until(lambda: relay.log(op="set_level", level="warning"), "the page did not ask for warnings")
        relay.do(say="driver may not call /reset: no right covers it")
        expect(seen(page, "toast")).to_contain_text("no right covers it")

    def test_robot_goes_offline(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """An offline robot is marked, and cannot be driven until it is back."""
        page = open_page(COCKPIT, user="driver")
        ready_to_drive(page)
        relay.do(robot="rover-1", state="offline")
        expect(seen(page, "drive-blocked")).to_have_text("The robot is offline.")
        relay.do(robot="rover-1", state="online")
        ready_to_drive(page)


class TestDriving:
    def test_joystick(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """Holding the joystick drives at the chosen speed; releasing sends one zero, then no command."""
        page = open_page(COCKPIT, user="driver")
        ready_to_drive(page)
        hold_joystick(page, dy=-120)
        driving(relay, 10)
        expect(seen(page, "odom-speed")).to_have_text("0.50")
        page.mouse.up()
        assert_one_zero_then_silence(page, relay)
        expect(seen(page, "odom-speed")).to_have_text("0.00")

        # Pulled to the left the robot turns left, which is positive in ROS.
        relay.do(clear_log=True)
        hold_joystick(page, dx=-60, dy=0)
        driving(relay)
        page.mouse.up()
        ahead, turn = next(command for command in reversed(relay.commands()) if command != ZERO)
        assert abs(ahead) < 0.1
        assert turn > 0.3

    def test_commands_keep_to_the_rate(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """For any motion of the stick, at most twenty commands a second are sent."""
        page = open_page(COCKPIT, user="driver")
        ready_to_drive(page)
        # By the page's clock, with all of the interaction: a slow machine only makes the time longer.
        began = page.evaluate("performance.now()")
        hold_joystick(page)
        box = seen(page, "joystick").bounding_box()
        for i in range(120):
            page.mouse.move(box["x"] + 60 + i % 40, box["y"] + 40)
        driving(relay, 5)
        page.mouse.up()
        seconds = (page.evaluate("performance.now()") - began) / 1000
        relay.until(lambda: relay.commands()[-1] == ZERO, "no zero came")
        assert len(relay.commands()) <= seconds * 20 + 2

    def test_keys(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """W drives ahead, and releasing it stops with one zero; keys in a filter are text."""
        page = open_page(COCKPIT, user="driver")
        ready_to_drive(page)
        seen(page, "topic-filter").press_sequentially("wasd ")
        expect(seen(page, "topic-filter")).to_have_value("wasd ")
        page.wait_for_timeout(300)  # shows absence
        assert relay.commands() == []
        seen(page, "topic-filter").clear()
        seen(page, "topic-filter").blur()
        page.keyboard.down("w")
        driving(relay)
        page.keyboard.up("w")
        assert_one_zero_then_silence(page, relay)
        assert relay.commands()[:2] == [ZERO, (0.5, 0)]

    def test_space_stops_for_any_focus(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """While driving, space stops, even if a button has the focus; the held key drives no further."""
        page = open_page(COCKPIT, user="driver")
        ready_to_drive(page)
        page.locator("[data-topic='/odom']").focus()
        page.keyboard.down("ArrowUp")
        driving(relay)
        page.keyboard.press("Space")
        assert_one_zero_then_silence(page, relay)
        page.keyboard.up("ArrowUp")
        expect(seen(page, "topic-echo")).to_have_count(0)

    def test_late_link_stops(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """When pongs are missing, driving ends, the page shows it, and no command is sent until a new press."""
        page = open_page(COCKPIT, user="driver")
        ready_to_drive(page)
        hold_joystick(page)
        driving(relay)
        relay.do(frozen=True)
        expect(seen(page, "link-late")).to_be_visible()
        expect(seen(page, "latency-badge")).to_contain_text("link late")
        assert_one_zero_then_silence(page, relay)
        relay.do(frozen=False)
        expect(seen(page, "link-late")).to_have_count(0)
        assert relay.commands()[-1] == ZERO
        page.mouse.up()

    def test_a_robot_that_does_not_answer_is_not_driven(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """While the relay answers and the robot does not, driving ends; after it recovers, only a new press
        moves it.
        """
        page = open_page(COCKPIT, user="driver")
        ready_to_drive(page)
        expect(seen(page, "leg-client-robot")).to_contain_text("ms")
        hold_joystick(page)
        driving(relay)
        relay.do(dead=True)
        expect(seen(page, "robot-late")).to_be_visible()
        expect(seen(page, "driving")).to_have_count(0)
        expect(seen(page, "latency-badge")).to_have_text("robot late")
        expect(seen(page, "drive-words")).to_contain_text("The robot responds slowly.")
        assert_one_zero_then_silence(page, relay)
        relay.do(dead=False)
        # Pinged again once the relay has given up on the pending ping.
        expect(seen(page, "latency-badge")).to_have_text(re.compile(r"\d+ ms"))
        expect(seen(page, "drive-words")).to_contain_text("Start again")
        page.mouse.move(640, 300, steps=5)
        assert_one_zero_then_silence(page, relay)
        page.mouse.up()
        before = len(relay.commands())
        hold_joystick(page)
        driving(relay, before + 1)
        page.mouse.up()

    def test_old_messages_are_dropped_after_a_reconnect(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """A link cut while driving reconnects by itself, without earlier commands."""
        page = open_page(COCKPIT, user="driver")
        ready_to_drive(page)
        page.keyboard.down("w")
        driving(relay)
        relay.do(close=1001, clear_log=True)
        relay.until(lambda: relay.log(op="set_level"), "the page did not come back")
        ready_to_drive(page)
        page.wait_for_timeout(300)
        assert [command for command in relay.commands() if command != ZERO] == []
        page.keyboard.up("w")

    def test_another_command_topic(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """The user selects among the topics of the type, and the selection survives a reload."""
        page = open_page(COCKPIT, user="driver")
        ready_to_drive(page)
        page.get_by_label("Command topic").select_option("/cmd_vel_nav")
        page.reload()
        ready_to_drive(page)
        expect(page.get_by_label("Command topic")).to_have_value("/cmd_vel_nav")
        page.keyboard.press("w")
        relay.until(lambda: relay.commands("/cmd_vel_nav")[-1:] == [ZERO], "nothing came on the chosen topic")
        assert relay.commands("/cmd_vel") == []

    def test_touch(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """A finger drives on a phone, and lifting it stops."""
        page = open_page(COCKPIT, user="driver", width=390, height=844, has_touch=True, is_mobile=True)
        ready_to_drive(page)
        box = seen(page, "joystick").bounding_box()
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        session = page.context.new_cdp_session(page)

        def touch(kind: str, *points: dict[str, float]) -> None:
            session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": list(points)})

        touch("touchStart", {"x": x, "y": y})
        touch("touchMove", {"x": x, "y": y - 50})
        driving(relay)
        touch("touchEnd")
        assert_one_zero_then_silence(page, relay)


class TestRights:
    def test_viewer_watches_but_does_not_drive(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """A viewer sees the data and the reason for the disabled controls; nothing is published or
        advertised.
        """
        page = open_page(COCKPIT, user="viewer")
        expect(seen(page, "camera-fps")).to_have_text(re.compile(r"[1-9]\d* fps"))
        expect(seen(page, "drive-blocked")).to_contain_text("viewer")
        expect(seen(page, "control-take")).to_have_count(0)
        hold_joystick(page)
        page.mouse.up()
        page.keyboard.press("w")
        page.wait_for_timeout(300)
        assert relay.log(op="publish") == []
        assert relay.log(op="advertise") == []

    def test_lowered_right_stops_driving(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """A driver who becomes a viewer is stopped and gets the reason."""
        page = open_page(COCKPIT, user="driver")
        ready_to_drive(page)
        hold_joystick(page)
        driving(relay)
        relay.do(user="driver", robot="rover-1", level="viewer")
        expect(seen(page, "drive-blocked")).to_contain_text("viewer")
        page.mouse.up()

    def test_revoked_right_is_shown(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """A channel cut for a revoked right shows the reason and does not reconnect; the camera stream ends
        too.
        """
        page = open_page(COCKPIT, user="driver")
        ready_to_drive(page)
        relay.until(lambda: relay.log(op="watch"), "no camera was watched")
        relay.do(close=4403, reason="revoked by admin", clear_log=True)
        expect(seen(page, "link-banner")).to_have_text(
            "You no longer have a right to this robot. Revoked by admin."
        )
        expect(seen(page, "link-state")).to_have_attribute("data-state", "closed")
        page.wait_for_timeout(1500)
        # A frame may have been under way.
        assert [entry for entry in relay.log() if entry["op"] != "frame_ack"] == []
        assert len(relay.log()) <= 1

    def test_unknown_robot_is_shown(self, open_page: OpenPage) -> None:
        """A robot without a right looks like a missing one."""
        page = open_page("/cockpit/arm-3", user="driver")
        expect(seen(page, "link-banner")).to_have_text(
            "This robot does not exist, or you have no right on it."
        )
        page.get_by_role("button", name="To the robots").click()
        expect(seen(page, "robot-card")).to_have_count(2)

    def test_ended_session_leads_to_the_login(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """When the session ends in the cockpit, a new login returns to it."""
        page = open_page(COCKPIT, user="driver")
        ready_to_drive(page)
        relay.do(close=4401)
        expect(seen(page, "login-notice")).to_contain_text("session has ended")
        seen(page, "login-user").fill("driver")
        seen(page, "login-password").fill(PASSWORD)
        seen(page, "login-submit").click()
        ready_to_drive(page)


WIDTHS = (1280, 768, 390)


class TestWidths:
    @pytest.mark.parametrize("path", ["/login", "/fleet", "/alerts", COCKPIT, "/nowhere"])
    def test_no_sideways_scrolling(self, open_page: OpenPage, path: str) -> None:
        """No page is wider than its window."""
        page = open_page(path, user=None if path == "/login" else "admin")
        expect(page.locator("main")).to_be_visible()
        if path == COCKPIT:
            ready_to_drive(page)
            page.locator("[data-topic='/scan']").click()
            expect(seen(page, "topic-echo")).to_contain_text("angle_min")
        for width in WIDTHS:
            page.set_viewport_size({"width": width, "height": 800})
            page.wait_for_function("document.documentElement.scrollWidth <= innerWidth")

    def test_the_cockpits_bar_shows_the_important_values(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """The links, the controller, the alerts and STOP are side by side and completely visible."""
        driver = open_page(COCKPIT, user="driver")
        ready_to_drive(driver)
        relay.do(alert={"robot": "rover-1", "text": "the battery is low"})
        page = open_page(COCKPIT, user="admin")
        expect(seen(page, "holder")).to_have_text("driver has control")
        expect(seen(page, "alerts-count")).to_have_text("1")
        expect(seen(page, "latency-badge")).to_contain_text(re.compile(r"\d+ ms"))
        for width in WIDTHS:
            page.set_viewport_size({"width": width, "height": 800})
            relay.until(lambda width=width: self._side_by_side(page, width), f"the bar is cut at {width} px")

    def _side_by_side(self, page: Page, width: int) -> bool:
        boxes = [
            seen(page, each).bounding_box() for each in ("latency-badge", "holder", "alerts-link", "stop")
        ]

        def apart(one: Any, other: Any) -> bool:
            beside = one["x"] + one["width"] <= other["x"] or other["x"] + other["width"] <= one["x"]
            return beside or abs(one["y"] - other["y"]) >= min(one["height"], other["height"])

        return (
            all(box["x"] >= 0 and box["x"] + box["width"] <= width and box["y"] < 100 for box in boxes)
            and all(apart(one, other) for one, other in itertools.combinations(boxes, 2))
            and seen(page, "holder").evaluate("it => it.scrollWidth <= it.clientWidth")
        )

    def test_stop_is_always_on_top(self, open_page: OpenPage) -> None:
        """STOP stays visible and the top bar uncovered at any scroll position."""
        page = open_page(COCKPIT, user="driver")
        ready_to_drive(page)
        for width in WIDTHS:
            page.set_viewport_size({"width": width, "height": 800})
            page.wait_for_function(f"innerWidth === {width}")
            page.evaluate("window.scrollTo(0, 0)")
            joystick = seen(page, "joystick").bounding_box()
            for y in (0, joystick["y"] + joystick["height"] / 2 - 28, 5000):
                page.evaluate(f"window.scrollTo(0, {y})")
                assert seen(page, "stop").evaluate(
                    """stop => {
                        const { left, top, width, height } = stop.getBoundingClientRect()
                        const within = top >= 0 && left >= 0 && left + width <= innerWidth
                        return within && document.elementFromPoint(left + width / 2, top + height / 2) === stop
                    }"""
                )
                x = joystick["x"] + joystick["width"] / 2
                assert page.evaluate(f"document.elementFromPoint({x}, 28).closest('header') !== null")


def test_joystick_is_under_the_video_on_a_phone(open_page: OpenPage) -> None:
    """On a phone the video is on top, the joystick below it, and both on one screen."""
    page = open_page(COCKPIT, user="driver", width=390, height=844)
    ready_to_drive(page)
    camera, joystick = (seen(page, name).bounding_box() for name in ("camera-canvas", "joystick"))
    assert camera["y"] + camera["height"] <= joystick["y"]
    assert joystick["y"] + joystick["height"] <= 844


def test_first_load_is_small(open_page: OpenPage) -> None:
    """All scripts and styles up to the cockpit stay below 150 kB, compressed."""
    page = open_page("/fleet", user="driver")
    bodies: list[bytes] = []
    page.on("response", lambda answer: bodies.append(answer.body()) if "/assets/" in answer.url else None)
    page.goto(COCKPIT)
    ready_to_drive(page)
    assert bodies
    assert sum(len(gzip.compress(body)) for body in bodies) < 150_000
