"""Alerts, and one order to many robots, in a real browser against a fake relay."""

from __future__ import annotations

import json
import re
import time
from typing import TYPE_CHECKING, Any

import msgspec
import pytest
from playwright.sync_api import Page, Route, expect
from switchboard_browser import seen

from relay_server.fleet.order import Order

if TYPE_CHECKING:
    from collections.abc import Callable

    OpenPage = Callable[..., Page]
    FakeRelay = Any


def alert(relay: FakeRelay, text: str, **more: Any) -> None:
    """The relay tells of something."""
    relay.do(alert={"robot": "rover-1", "text": text, **more})


class TestAlerts:
    @pytest.mark.parametrize("path", ["/fleet", "/cockpit/rover-1", "/alerts"])
    def test_a_new_one_is_told_on_every_page(self, open_page: OpenPage, relay: FakeRelay, path: str) -> None:
        """What stood before is only counted; what comes is told once, in words that make no elements."""
        alert(relay, "it stood before")
        page = open_page(path, user="driver")
        expect(seen(page, "alerts-count")).to_have_text("1")
        expect(seen(page, "toast")).to_have_count(0)
        alert(relay, "<img src=x onerror=alert(1)>")
        expect(seen(page, "toast")).to_contain_text("rover-1: <img src=x onerror=alert(1)>")
        assert seen(page, "toast").locator("img").count() == 0
        expect(seen(page, "alerts-count")).to_have_text("2")

    def test_what_is_not_wanted_is_only_listed(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """The user's rules say what is shown by itself."""
        page = open_page("/alerts", user="driver")
        expect(seen(page, "alerts-empty")).to_contain_text(
            "No alert stands open that you may see on your robots."
        )
        alert(relay, "quiet", notify=False)
        expect(seen(page, "alert")).to_contain_text("quiet")
        expect(seen(page, "toast")).to_have_count(0)

    def test_many_at_once_are_one_toast(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """The toast leads to the list."""
        page = open_page("/fleet", user="driver")
        expect(seen(page, "robot-card")).to_have_count(2)
        # Between two of the fake relay's events all of these come together, or in two lots.
        for i in range(12):
            alert(relay, f"number {i}")
        toast = seen(page, "toast").filter(has_text=re.compile(r"rover-1: number 11, and 1?\d more"))
        toast.first.get_by_role("link", name="Alerts").click()
        expect(seen(page, "alert")).to_have_count(12)

    def test_the_list_is_narrowed_and_acknowledged(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """By state and robot; who acknowledges is shown, and the count goes down."""
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

    def test_what_is_long_over_does_not_come_back(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """The stream tells no more of it then; the list does not fall back on what it was told at first."""
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
        """A part more with each press, down to the oldest; another list begins anew, and what comes stands in front."""
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

    def test_what_is_gone_without_a_word_is_looked_up(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """An alert that leaves the stream while it is open was ended unheard, or is the user's no more."""
        alert(relay, "low", id="1")
        page = open_page("/alerts", user="driver")
        expect(seen(page, "alert")).to_be_visible()
        alert(relay, "low", id="1", state="over", over=time.time(), old=True)
        expect(seen(page, "alerts-empty")).to_be_visible()

    def test_without_a_connection_nothing_is_said_to_be_well(
        self, open_page: OpenPage, relay: FakeRelay
    ) -> None:
        """The page says that it is out of date, and asks again when the relay is back."""
        page = open_page("/alerts", user="driver")
        expect(seen(page, "alerts-empty")).to_contain_text("No open alert")
        relay.do(broken=True)
        expect(page.get_by_text("No connection to the relay.")).to_be_visible()
        expect(seen(page, "alerts-empty")).to_contain_text("Nothing is known")
        alert(relay, "low", old=True)
        relay.do(broken=False)
        expect(seen(page, "alert")).to_contain_text("low")
        expect(page.get_by_text("No connection to the relay.")).to_have_count(0)

    def test_notifications_are_asked_for_by_a_click(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """The browser is not asked before; once it allows them, an alert that nobody looks at is shown by it."""
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

    def test_a_robot_that_tells_something_again_and_again_is_told_of_now_and_then(
        self, open_page: OpenPage, relay: FakeRelay
    ) -> None:
        """The first alert at once, what comes soon after in one toast; what is worse waits for nothing."""
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
        """The stream tells of a hundred; when one of them is over, the one that takes its place is nothing new."""
        for i in range(101):
            alert(relay, f"number {i}", id=f"{i}", first=1000.0 + i, last=1000.0 + i, old=i == 0)
        page = open_page("/fleet", user="driver")
        expect(seen(page, "alerts-count")).to_have_text("99+")
        alert(relay, "number 0", id="0", old=False)
        alert(relay, "number 1", id="1", old=True)
        alert(relay, "a new one", id="new")
        expect(seen(page, "toast")).to_contain_text("a new one")
        expect(seen(page, "toast")).not_to_contain_text("more")
        alert(relay, "number 1", id="1", old=False, state="over", over=time.time(), news=2)
        expect(seen(page, "toast").last).to_contain_text("rover-1: over: number 1")


class TestOrders:
    def hold(self, page: Page) -> None:
        """Keep the button pressed by which many robots may move again."""
        seen(page, "order-resume").focus()
        page.keyboard.down("Space")
        expect(seen(page, "order-progress")).to_be_visible()
        page.keyboard.up("Space")

    def test_a_result_for_each_robot(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """The pattern is the relay's to read; what failed says why, and the bar is full."""
        page = open_page("/fleet", user="admin")
        seen(page, "fleet-order").click()
        seen(page, "order-pattern").fill("rover-*, arm-3")
        seen(page, "order-do").select_option("call")
        seen(page, "order-send").click()
        expect(seen(page, "order-failure")).to_have_text("Which service?")
        seen(page, "order-name").fill("/start")
        seen(page, "order-body").fill("{")
        seen(page, "order-send").click()
        expect(seen(page, "order-failure")).to_have_text("That is no JSON.")
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
        """Robots are chosen among those shown; to resume one that is away fails in words."""
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
        """Neither a click nor Enter in a field resumes any; the button kept pressed does."""
        page = open_page("/fleet", user="admin")
        seen(page, "fleet-order").click()
        seen(page, "order-pattern").fill("rover-*")
        seen(page, "order-do").select_option("resume")
        expect(seen(page, "order-send")).to_have_count(0)
        seen(page, "order-pattern").press("Enter")
        seen(page, "order-why").press("Enter")
        seen(page, "order-resume").click()
        page.wait_for_timeout(300)  # proves absence
        assert relay.log(op="POST fleet") == []
        self.hold(page)
        expect(seen(page, "order-progress")).to_have_text("2 of 2 robots, done")
        assert [asked["do"] for asked in relay.log(op="POST fleet")] == ["resume"]

    def test_a_name_that_means_no_robot_is_told(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """Who mistypes the robot he means to stop learns that it goes on."""
        page = open_page("/fleet", user="admin")
        seen(page, "fleet-order").click()
        seen(page, "order-pattern").fill("rover-1 rovr-2")
        seen(page, "order-send").click()
        expect(seen(page, "order-progress")).to_have_text("1 of 1 robots, done")
        expect(seen(page, "order-unmatched")).to_have_text("No robot of yours is meant by rovr-2.")

    @pytest.mark.parametrize("do", ["call", "publish", "set", "stop"])
    def test_only_what_is_shown_is_sent(self, open_page: OpenPage, relay: FakeRelay, do: str) -> None:
        """What was typed for another kind of order goes with none that does not have it: the relay would refuse it."""
        page = open_page("/fleet", user="admin")
        seen(page, "fleet-order").click()
        seen(page, "order-pattern").fill("rover-1")
        seen(page, "order-why").fill("wet floor")
        seen(page, "order-do").select_option("call")
        for field, typed in {"name": "/it", "type": "std_msgs/Empty", "body": "{}"}.items():
            seen(page, f"order-{field}").fill(typed)
        seen(page, "order-do").select_option(do)
        fields = {"name", "type", "body", "why"}
        shown = {each for each in fields if seen(page, f"order-{each}").count()}
        seen(page, "order-send").click()
        expect(seen(page, "order-progress")).to_have_text("1 of 1 robots, done")
        [asked] = relay.log(op="POST fleet")
        del asked["user"], asked["op"]
        order = msgspec.json.decode(json.dumps(asked), type=Order)
        order.check()
        as_sent = {"service": "name", "topic": "name", "args": "body", "msg": "body", "value": "body"}
        assert {as_sent.get(key, key) for key in asked.keys() - {"robots", "do"}} == shown

    def test_a_stop_without_an_answer_is_not_known_to_be_one(self, open_page: OpenPage) -> None:
        """An answer that ends before it began says nothing of any robot; the page says what to do."""
        page = open_page("/fleet", user="admin")
        page.route("**/api/v1/fleet", lambda route: route.fulfill(status=200, body=""))
        page.get_by_role("button", name="Stop all robots").click()
        toast = seen(page, "toast")
        expect(toast).to_contain_text(
            "No robot is known to be stopped: the answer broke off. Press STOP again"
        )
        expect(toast).to_have_attribute("role", "alert")

    def test_a_stop_can_not_be_ended_half_way(self, open_page: OpenPage) -> None:
        """While it goes on there is no button that ends it, and to leave the page does not."""
        page = open_page("/fleet", user="admin")
        ended: list[str] = []
        page.on("requestfailed", lambda request: ended.append(request.url))
        held: list[Route] = []
        page.route("**/api/v1/fleet", lambda route: held.append(route))
        seen(page, "fleet-order").click()
        seen(page, "order-pattern").fill("rover-1")
        seen(page, "order-send").click()
        expect(page.get_by_text("Stopping. It goes on when you leave.")).to_be_visible()
        expect(page.get_by_role("button", name="End it")).to_have_count(0)
        seen(page, "alerts-link").click()
        expect(seen(page, "alerts-empty")).to_be_visible()
        with page.expect_response("**/api/v1/fleet"):
            held[0].fulfill(status=200, body="")
        assert ended == []

    def test_a_long_order_fits_a_phone(self, open_page: OpenPage) -> None:
        """However many robots are named, the button that names them is no wider than the window."""
        page = open_page("/fleet", user="admin", width=390)
        seen(page, "fleet-order").click()
        seen(page, "order-pattern").fill(
            "rover-1 a-very-long-name-of-a-robot-* group:cleaners-of-the-second-hall"
        )
        for do in ("stop", "resume"):
            seen(page, "order-do").select_option(do)
            assert page.evaluate("document.documentElement.scrollWidth") <= 390
