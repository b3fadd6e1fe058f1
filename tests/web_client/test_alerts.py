"""Alerts, and one order to many robots, in a real browser against a fake relay."""

from __future__ import annotations

import json
import re
import time
from typing import TYPE_CHECKING, Any

import msgspec
import pytest
from playwright.sync_api import Page, Route, expect

from relay_server.fleet.order import Order
from tests.worlds.browser import seen

if TYPE_CHECKING:
    from collections.abc import Callable

    OpenPage = Callable[..., Page]
    FakeRelay = Any


def alert(relay: FakeRelay, text: str, **more: Any) -> None:
    """The relay reports an alert."""
    relay.do(alert={"robot": "rover-1", "text": text, **more})


class TestAlerts:
    @pytest.mark.parametrize("path", ["/fleet", "/cockpit/rover-1", "/alerts"])
    def test_a_new_alert_is_shown_on_every_page(
        self, open_page: OpenPage, relay: FakeRelay, path: str
    ) -> None:
        """Earlier alerts are only counted; a new one is shown once, with its text escaped."""
        alert(relay, "it stood before")
        page = open_page(path, user="driver")
        expect(seen(page, "alerts-count")).to_have_text("1")
        expect(seen(page, "toast")).to_have_count(0)
        alert(relay, "<img src=x onerror=alert(1)>")
        expect(seen(page, "toast")).to_contain_text("rover-1: <img src=x onerror=alert(1)>")
        assert seen(page, "toast").locator("img").count() == 0
        expect(seen(page, "alerts-count")).to_have_text("2")

    def test_unselected_items_are_only_listed(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """The user's rules decide which are shown by themselves."""
        page = open_page("/alerts", user="driver")
        expect(seen(page, "alerts-empty")).to_contain_text("No open alerts that you may see on your robots.")
        alert(relay, "quiet", notify=False)
        expect(seen(page, "alert")).to_contain_text("quiet")
        expect(seen(page, "toast")).to_have_count(0)

    def test_many_at_once_are_one_toast(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """The toast leads to the list."""
        page = open_page("/fleet", user="driver")
        expect(seen(page, "robot-card")).to_have_count(2)
        # Between two of the fake relay's events all of these arrive together, or in two batches.
        for i in range(12):
            alert(relay, f"number {i}")
        toast = seen(page, "toast").filter(has_text=re.compile(r"rover-1: number 11, and 1?\d more"))
        toast.first.get_by_role("link", name="Alerts").click()
        expect(seen(page, "alert")).to_have_count(12)

    def test_the_list_is_narrowed_and_acknowledged(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """By state and robot; the acknowledging user is shown, and the count decreases."""
        alert(relay, "low", about="main")
        alert(relay, "was low", state="over", over=time.time() - 60)
        relay.do(alert={"robot": "rover-2", "text": "other", "may_acknowledge": False})
        page = open_page("/alerts", user="driver")
        expect(seen(page, "alert")).to_have_count(2)
        other = page.locator("[data-testid=alert][data-robot=rover-2]")
        expect(other.get_by_test_id("acknowledge")).to_have_count(0)
        seen(page, "alerts-robot").select_option("rover-1")
        expect(seen(page, "alert")).to_have_count(1)
        seen(page, "acknowledge").click()
        expect(seen(page, "alert")).to_contain_text("driver looks after it")
        expect(seen(page, "alerts-count")).to_have_text("1")
        assert len(relay.log(user="driver")) == 1
        seen(page, "alerts-over").click()
        expect(seen(page, "alert")).to_contain_text("was low")
        seen(page, "alerts-all").click()
        expect(seen(page, "alert")).to_have_count(2)

    def test_ended_goals_do_not_return(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """The stream no longer has it; the list does not return to its first state."""
        alert(relay, "low", id="1")
        page = open_page("/alerts", user="driver")
        expect(seen(page, "alert")).to_be_visible()
        alert(relay, "low", id="1", state="over", over=time.time())
        expect(seen(page, "alerts-empty")).to_be_visible()
        alert(relay, "low", id="1", old=True)
        alert(relay, "another", id="2")
        expect(seen(page, "alert")).to_contain_text("another")
        expect(seen(page, "alert")).to_have_count(1)

    def test_a_long_list_goes_on_with_what_is_older(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """One more part with each press, down to the oldest; another list begins again, and new alerts appear
        at the top.
        """
        for i in range(450):
            alert(relay, f"number {i}", id=f"{i}", last=1000.0 + i, state="over", over=1000.0 + i, old=True)
        alert(relay, "it stands", id="open", last=1.0)
        page = open_page("/alerts", user="driver")
        expect(seen(page, "alert")).to_have_count(1)
        older = seen(page, "alerts-older")
        expect(older).to_have_count(0)
        seen(page, "alerts-over").click()
        expect(seen(page, "alert")).to_have_count(200)
        older.click()
        expect(seen(page, "alert")).to_have_count(400)
        alert(relay, "a new one", id="new", state="over", over=time.time())
        expect(seen(page, "alert")).to_have_count(401)
        older.click()
        expect(seen(page, "alert")).to_have_count(451)
        expect(seen(page, "alert").first).to_contain_text("a new one")
        expect(seen(page, "alert").last).to_contain_text("number 0")
        expect(older).to_have_count(0)
        seen(page, "alerts-all").click()
        expect(seen(page, "alert").last).to_contain_text("number 251")
        expect(older).to_be_visible()

    def test_silently_removed_entry_is_looked_up(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """An open alert that leaves the stream has ended unnoticed, or the user has lost the right."""
        alert(relay, "low", id="1")
        page = open_page("/alerts", user="driver")
        expect(seen(page, "alert")).to_be_visible()
        alert(relay, "low", id="1", state="over", over=time.time(), old=True)
        expect(seen(page, "alerts-empty")).to_be_visible()

    def test_without_a_connection_nothing_is_shown_as_well(
        self, open_page: OpenPage, relay: FakeRelay
    ) -> None:
        """The page shows that it is out of date, and reloads when the relay is back."""
        page = open_page("/alerts", user="driver")
        expect(seen(page, "alerts-empty")).to_contain_text("No open alert")
        relay.do(broken=True)
        expect(page.get_by_text("No connection to the relay.")).to_be_visible()
        expect(seen(page, "alerts-empty")).to_contain_text("The state is unknown")
        alert(relay, "low", old=True)
        relay.do(broken=False)
        expect(seen(page, "alert")).to_contain_text("low")
        expect(page.get_by_text("No connection to the relay.")).to_have_count(0)

    def test_notifications_are_asked_for_by_a_click(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """The browser is not asked before; with permission, an alert on a hidden page is shown by the
        browser.
        """
        page = open_page("/login")
        page.add_init_script(
            """
            window.shown = []
            window.asked = 0
            window.Notification = class {
              static permission = 'default'
              static async requestPermission() { asked += 1; return (Notification.permission = 'granted') }
              constructor(words) { shown.push(words) }
            }
            document.hasFocus = () => false
            """
        )
        page.request.post(
            "/api/v1/session",
            data={"user": "driver", "password": "correct horse"},
            headers={"X-Requested-With": "switchboard"},
        )
        page.goto("/alerts")
        expect(seen(page, "alerts-empty")).to_be_visible()
        assert page.evaluate("asked") == 0
        seen(page, "notify").check()
        assert page.evaluate("asked") == 1
        alert(relay, "low")
        expect(seen(page, "toast")).to_be_visible()
        assert page.evaluate("shown") == ["rover-1: low"]

    def test_a_repeated_alert_is_announced_periodically(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """The first alert at once, others soon after in one toast; a more severe one at once."""
        page = open_page("/login")
        page.clock.install()
        page.request.post(
            "/api/v1/session",
            data={"user": "driver", "password": "correct horse"},
            headers={"X-Requested-With": "switchboard"},
        )
        page.goto("/fleet")
        expect(seen(page, "robot-card")).to_have_count(2)
        toast = seen(page, "toast")
        for i in range(4):
            alert(relay, f"part {i} is hot")
            expect(seen(page, "alerts-count")).to_have_text(f"{i + 1}")
            expect(toast).to_have_count(1)
            expect(toast).to_contain_text("rover-1: part 0 is hot")
        page.clock.fast_forward(10_000)
        expect(toast).to_contain_text("rover-1: part 3 is hot, and 2 more")
        alert(relay, "it is offline", level="error")
        expect(toast.last).to_contain_text("rover-1: it is offline")
        expect(toast).to_have_count(2)

    def test_those_that_find_no_room_in_the_stream_are_no_news_later(
        self, open_page: OpenPage, relay: FakeRelay
    ) -> None:
        """The stream has a hundred; when one ends, the one that takes its place is not new."""
        for i in range(101):
            alert(relay, f"number {i}", id=f"{i}", first=1000.0 + i, last=1000.0 + i, old=i == 0)
        page = open_page("/fleet", user="driver")
        expect(seen(page, "alerts-count")).to_have_text("99+")
        alert(relay, "number 0", id="0", old=False)
        alert(relay, "number 1", id="1", old=True)
        alert(relay, "a new one", id="new")
        expect(seen(page, "toast")).to_contain_text("a new one")
        expect(seen(page, "toast")).not_to_contain_text("more")
        alert(relay, "number 1", id="1", old=False, state="over", over=time.time(), notification_count=2)
        expect(seen(page, "toast").last).to_contain_text("rover-1: over: number 1")


class TestOrders:
    def hold(self, page: Page) -> None:
        """Holds the button that resumes many robots."""
        seen(page, "order-resume").focus()
        page.keyboard.down("Space")
        expect(seen(page, "order-progress")).to_be_visible()
        page.keyboard.up("Space")

    def test_a_result_for_each_robot(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """The relay expands the pattern; failures have a reason, and the bar is full."""
        page = open_page("/fleet", user="admin")
        seen(page, "fleet-order").click()
        seen(page, "order-pattern").fill("rover-*, arm-3")
        seen(page, "order-do").select_option("call")
        seen(page, "order-send").click()
        expect(seen(page, "order-failure")).to_have_text("Which service?")
        seen(page, "order-name").fill("/start")
        seen(page, "order-body").fill("{")
        seen(page, "order-send").click()
        expect(seen(page, "order-failure")).to_have_text("This is not JSON.")
        seen(page, "order-body").fill('{"fast": true}')
        seen(page, "order-send").click()
        expect(seen(page, "order-progress")).to_have_text("3 of 3 robots, 1 failed, done")
        [asked] = relay.log(op="POST fleet")
        assert (asked["robots"], asked["service"], asked["args"]) == (
            ["rover-*", "arm-3"],
            "/start",
            {"fast": True},
        )
        expect(seen(page, "order-result")).to_have_count(3)

    def test_chosen_robots_and_what_fails(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """Robots are selected in the list; resuming an offline one fails with a reason."""
        page = open_page("/fleet", user="admin")
        seen(page, "fleet-order").click()
        page.get_by_role("button", name="All 3 shown").click()
        seen(page, "order-do").select_option("resume")
        self.hold(page)
        expect(seen(page, "order-progress")).to_have_text("3 of 3 robots, 1 failed, done")
        failed = page.locator("[data-testid=order-result][data-robot=arm-3]")
        expect(failed).to_contain_text("failed")
        expect(failed).to_contain_text("the robot is offline")

    def test_many_are_resumed_by_a_press_that_lasts(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """Neither a click nor Enter in a field resumes any; holding the button does."""
        page = open_page("/fleet", user="admin")
        seen(page, "fleet-order").click()
        seen(page, "order-pattern").fill("rover-*")
        seen(page, "order-do").select_option("resume")
        expect(seen(page, "order-send")).to_have_count(0)
        seen(page, "order-pattern").press("Enter")
        seen(page, "order-why").press("Enter")
        seen(page, "order-resume").click()
        page.wait_for_timeout(300)  # shows absence
        assert relay.log(op="POST fleet") == []
        self.hold(page)
        expect(seen(page, "order-progress")).to_have_text("2 of 2 robots, done")
        assert [asked["do"] for asked in relay.log(op="POST fleet")] == ["resume"]

    def test_a_name_that_matches_no_robot_is_reported(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """A user who mistypes the robot to stop learns that it continues."""
        page = open_page("/fleet", user="admin")
        seen(page, "fleet-order").click()
        seen(page, "order-pattern").fill("rover-1 rovr-2")
        seen(page, "order-send").click()
        expect(seen(page, "order-progress")).to_have_text("1 of 1 robots, done")
        expect(seen(page, "order-unmatched")).to_have_text("None of your robots matches rovr-2.")

    def test_only_what_is_shown_is_sent(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """Values of another kind of order are left out: the relay would refuse them."""
        page = open_page("/fleet", user="admin")
        seen(page, "fleet-order").click()
        seen(page, "order-pattern").fill("rover-1")
        seen(page, "order-why").fill("wet floor")
        seen(page, "order-do").select_option("call")
        for field, typed in {"name": "/it", "type": "std_msgs/Empty", "body": "{}"}.items():
            seen(page, f"order-{field}").fill(typed)
        fields = {"name", "type", "body", "why", "action"}
        as_sent = {"service": "name", "topic": "name", "args": "body", "msg": "body", "value": "body"}
        as_sent["module"] = "name"
        for do in ("call", "publish", "set", "stop", "module"):
            relay.do(clear_log=True)
            seen(page, "order-do").select_option(do)
            shown = {each for each in fields if seen(page, f"order-{each}").count()}
            seen(page, "order-send").click()
            [asked] = relay.until(lambda: relay.log(op="POST fleet"), f"no order to {do} was sent")
            expect(seen(page, "order-progress")).to_have_text("1 of 1 robots, done")
            del asked["user"], asked["op"]
            order = msgspec.json.decode(json.dumps(asked), type=Order)
            order.check()
            assert order.do == do
            assert {as_sent.get(key, key) for key in asked.keys() - {"robots", "do", "stop_id"}} == shown

    def test_a_module_of_many_robots_is_stopped(self, open_page: OpenPage, relay: FakeRelay) -> None:
        page = open_page("/fleet", user="admin")
        seen(page, "fleet-order").click()
        seen(page, "order-pattern").fill("*")
        seen(page, "order-do").select_option("module")
        seen(page, "order-send").click()
        expect(seen(page, "order-failure")).to_have_text("Which module?")
        seen(page, "order-name").fill("cleaning")
        seen(page, "order-action").select_option("stop")
        seen(page, "order-send").click()
        expect(seen(page, "order-progress")).to_have_text("3 of 3 robots, done")
        [asked] = relay.log(op="POST fleet")
        assert (asked["do"], asked["module"], asked["action"]) == ("module", "cleaning", "stop")
        for robot, words in (("rover-1", "done"), ("arm-3", "when it is back")):
            result = page.locator(f"[data-testid=order-result][data-robot={robot}]")
            expect(result).to_contain_text(words)

    def test_a_stop_without_an_answer_is_not_known_to_be_one(
        self, open_page: OpenPage, relay: FakeRelay
    ) -> None:
        """An aborted answer contains no robot."""
        page = open_page("/fleet", user="admin")
        page.route("**/api/v1/fleet", lambda route: route.fulfill(status=200, body=""))
        relay.do(stuck=["pages"])
        page.clock.install()
        page.get_by_role("button", name="Stop all robots").click()
        page.clock.fast_forward(23_000)
        toast = seen(page, "toast")
        expect(toast).to_contain_text("It is unknown whether all robots are stopped.")
        expect(toast).to_have_attribute("role", "alert")

    def test_a_stop_can_not_be_cancelled(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """During the stop there is no cancel button, and leaving the page does not cancel it. Without an answer it
        is said not to be confirmed.
        """
        page = open_page("/fleet", user="admin")
        relay.do(stuck=["pages"])
        ended: list[str] = []
        page.on("requestfailed", lambda request: ended.append(request.url))
        held: list[Route] = []
        page.route("**/api/v1/fleet", lambda route: held.append(route))
        seen(page, "fleet-order").click()
        seen(page, "order-pattern").fill("rover-1")
        seen(page, "order-send").click()
        expect(seen(page, "order-unconfirmed")).to_contain_text("Not confirmed: no robot has answered yet.")
        expect(page.get_by_role("button", name="Cancel")).to_have_count(0)
        seen(page, "alerts-link").click()
        expect(seen(page, "alerts-empty")).to_be_visible()
        with page.expect_response("**/api/v1/fleet"):
            held[0].fulfill(status=200, body="")
        assert ended == []

    def test_a_stop_passes_when_all_requests_are_stuck(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """Of a pattern, too: by websockets, of which the one of the updates is open already."""
        page = open_page("/fleet", user="admin")
        page.route("**/api/v1/fleet", lambda route: None)
        seen(page, "fleet-order").click()
        seen(page, "order-pattern").fill("rover-*")
        seen(page, "order-why").fill("wet floor")
        seen(page, "order-send").click()
        expect(seen(page, "order-progress")).to_have_text("2 of 2 robots, done")
        asked = relay.log(op="page")
        assert [(each["robots"], each["do"], each["why"]) for each in asked] == [
            (["rover-*"], "stop", "wet floor")
        ] * 2
        assert len({each["stop_id"] for each in asked}) == 1

    def test_a_long_order_fits_a_phone(self, open_page: OpenPage) -> None:
        """For any number of robots the button is not wider than the window."""
        page = open_page("/fleet", user="admin", width=390)
        seen(page, "fleet-order").click()
        seen(page, "order-pattern").fill(
            "rover-1 a-very-long-name-of-a-robot-* group:cleaners-of-the-second-hall"
        )
        for do in ("stop", "resume"):
            seen(page, "order-do").select_option(do)
            assert page.evaluate("document.documentElement.scrollWidth") <= 390
