"""What the portal is told of all robots: a stream that falls silent, many tabs, and tabs that change hands."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import pytest
from playwright.sync_api import Page, expect
from switchboard_browser import seen

if TYPE_CHECKING:
    from collections.abc import Callable

    OpenPage = Callable[..., Page]
    FakeRelay = Any

PASSWORD = "correct horse"
COCKPIT = "/cockpit/rover-1"


def dials(relay: FakeRelay) -> int:
    """How often pages have begun to follow."""
    return len(relay.log(op="follow"))


def enters(page: Page, user: str) -> None:
    """Somebody logs in at the page."""
    seen(page, "login-user").fill(user)
    seen(page, "login-password").fill(PASSWORD)
    seen(page, "login-submit").click()


def leaves(page: Page) -> None:
    """Who is logged in at the page logs out."""
    seen(page, "user-menu").click()
    seen(page, "logout").click()
    expect(seen(page, "login-user")).to_be_visible()


def belongs_to(page: Page, user: str) -> None:
    """Wait until the page shows this user."""
    expect(seen(page, "user-menu")).to_have_attribute("aria-label", f"Account of {user}")


def second_tab(page: Page, path: str) -> Page:
    """Another tab of the same browser."""
    other = page.context.new_page()
    other.goto(path)
    return other


class TestSilence:
    def test_it_is_said_and_another_connection_is_tried(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """Nobody reports the end of a relay that is frozen, or of a path that is lost."""
        page = open_page("/fleet", user="admin")
        expect(seen(page, "robot-card")).to_have_count(3)
        relay.do(blind=True)
        page.clock.install()
        page.clock.run_for(10_000)
        expect(seen(page, "lost")).to_contain_text("No connection to the relay.")
        expect(seen(page, "robots")).to_have_class(re.compile(r"\blost\b"))
        page.clock.run_for(10_000)
        relay.until(lambda: dials(relay) == 2, "the page did not dial anew")
        expect(seen(page, "lost")).to_be_visible()
        relay.do(blind=False, robot="rover-1", state="offline")
        expect(seen(page, "lost")).to_have_count(0)
        expect(seen(page, "robots")).not_to_have_class(re.compile(r"\blost\b"))
        state = page.locator("[data-robot=rover-1]").get_by_test_id("robot-state")
        expect(state).to_have_attribute("data-state", "offline")

    def test_nothing_is_said_to_be_well(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """That no alert stood open is not that none does."""
        page = open_page("/alerts", user="driver")
        expect(seen(page, "alerts-empty")).to_contain_text("No open alert")
        relay.do(blind=True)
        page.clock.install()
        page.clock.run_for(10_000)
        expect(seen(page, "alerts-empty")).to_contain_text("Nothing is known")

    def test_a_relay_that_tells_nothing_from_the_start(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """The page does not go on loading for ever."""
        relay.do(blind=True)
        page = open_page("/fleet", user="admin")
        expect(page.get_by_text("Loading the robots…")).to_be_visible()
        expect(seen(page, "lost")).to_be_visible()
        expect(page.get_by_text("Loading the robots…")).to_have_count(0)

    def test_a_relay_that_can_not_tell_says_why(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """Then the connection is well, and is kept."""
        page = open_page("/fleet", user="admin")
        expect(seen(page, "robot-card")).to_have_count(3)
        relay.do(unknown="the database does not answer")
        expect(seen(page, "lost")).to_contain_text(
            "can’t tell how things are now. The database does not answer."
        )
        relay.do(unknown="")
        expect(seen(page, "lost")).to_have_count(0)
        assert dials(relay) == 1


def test_stop_goes_out_however_many_tabs_are_open(open_page: OpenPage, relay: FakeRelay) -> None:
    """Tabs share the few connections a browser has to one host; no page holds one for ever."""
    page = open_page("/fleet", user="admin")
    tabs = [page, *(second_tab(page, "/fleet") for _ in range(6))]
    for tab in tabs:
        expect(seen(tab, "robot-card")).to_have_count(3)
    tabs[-1].get_by_role("button", name="Stop all robots").click()
    expect(seen(tabs[-1], "toast")).to_contain_text("1 robot is away")
    assert len(relay.log(op="POST fleet")) == 1


class TestWhosePage:
    @pytest.mark.parametrize("path", ["/fleet", COCKPIT])
    def test_a_login_in_another_tab_counts_here(self, open_page: OpenPage, path: str) -> None:
        """What the page asks for would be asked by that user from now on, so it is his wholly, and says so."""
        page = open_page(path, user="driver")
        belongs_to(page, "driver")
        other = second_tab(page, "/fleet")
        leaves(other)
        enters(other, "viewer")
        expect(seen(other, "robot-card")).to_have_count(1)
        belongs_to(page, "viewer")
        expect(page).to_have_url(re.compile(path))

    def test_it_is_said(self, open_page: OpenPage) -> None:
        """A login link opens another tab as another user, and nobody logs out before."""
        page = open_page("/fleet", user="driver")
        expect(seen(page, "robot-card")).to_have_count(2)
        second_tab(page, "/login#code=ONCE-ONLY")
        belongs_to(page, "admin")
        expect(seen(page, "robot-card")).to_have_count(3)
        expect(seen(page, "toast")).to_contain_text("admin has logged in in another tab.")
        page.reload()
        belongs_to(page, "admin")
        expect(seen(page, "robot-card")).to_have_count(3)
        expect(seen(page, "toast")).to_have_count(0)

    @pytest.mark.parametrize("path", ["/fleet", COCKPIT])
    def test_a_login_nobody_told_of_is_found_with_the_next_connection(
        self, open_page: OpenPage, relay: FakeRelay, path: str
    ) -> None:
        """A session that is another user's is not what this page had, though it is one."""
        page = open_page(path, user="admin")
        belongs_to(page, "admin")
        if path == COCKPIT:
            expect(seen(page, "link-state")).to_have_attribute("data-state", "open")
        answer = page.request.post(
            "/api/v1/session",
            data={"user": "viewer", "password": PASSWORD},
            headers={"X-Requested-With": "switchboard"},
        )
        assert answer.ok
        if path == COCKPIT:
            relay.do(close=1001)
        else:
            relay.do(broken=True)
            expect(seen(page, "lost").or_(page.get_by_label("Account of viewer"))).to_be_visible()
            relay.do(broken=False)
        belongs_to(page, "viewer")

    def test_a_logout_counts_in_all_tabs(self, open_page: OpenPage) -> None:
        """At once, and so does the next login."""
        page = open_page(COCKPIT, user="driver")
        belongs_to(page, "driver")
        other = second_tab(page, "/fleet")
        leaves(other)
        expect(seen(page, "login-notice")).to_contain_text("Your session has ended.")
        enters(other, "admin")
        belongs_to(page, "admin")
        expect(page).to_have_url(re.compile(COCKPIT))
