"""The portal's stream about all robots: silence, many tabs, and a change of user."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import pytest
from playwright.sync_api import Page, expect

from tests.worlds.browser import seen

if TYPE_CHECKING:
    from collections.abc import Callable

    OpenPage = Callable[..., Page]
    FakeRelay = Any

PASSWORD = "correct horse"
COCKPIT = "/cockpit/rover-1"


def dials(relay: FakeRelay) -> int:
    """The number of streams that pages have opened."""
    return len(relay.log(op="follow"))


def enters(page: Page, user: str) -> None:
    """A user logs in at the page."""
    seen(page, "login-user").fill(user)
    seen(page, "login-password").fill(PASSWORD)
    seen(page, "login-submit").click()


def leaves(page: Page) -> None:
    """The page's user logs out."""
    seen(page, "user-menu").click()
    seen(page, "logout").click()
    expect(seen(page, "login-user")).to_be_visible()


def belongs_to(page: Page, user: str) -> None:
    """Waits until the page shows this user."""
    expect(seen(page, "user-menu")).to_have_attribute("aria-label", f"Account of {user}")


def second_tab(page: Page, path: str) -> Page:
    """Another tab of the same browser."""
    other = page.context.new_page()
    other.goto(path)
    return other


class TestSilence:
    def test_it_is_shown_and_another_connection_is_tried(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """The end of a frozen relay or of a lost path is not reported by the connection."""
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

    def test_health_is_not_claimed(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """A missing alert does not prove health."""
        page = open_page("/alerts", user="driver")
        expect(seen(page, "alerts-empty")).to_contain_text("No open alert")
        relay.do(blind=True)
        page.clock.install()
        page.clock.run_for(10_000)
        expect(seen(page, "alerts-empty")).to_contain_text("The state is unknown")

    def test_a_relay_that_is_silent_from_the_start(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """The page does not stay in its loading state."""
        relay.do(blind=True)
        page = open_page("/fleet", user="admin")
        expect(page.get_by_text("Loading the robots…")).to_be_visible()
        expect(seen(page, "lost")).to_be_visible()
        expect(page.get_by_text("Loading the robots…")).to_have_count(0)

    def test_a_relay_without_an_answer_gives_the_reason(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """Then the connection works, and is kept."""
        page = open_page("/fleet", user="admin")
        expect(seen(page, "robot-card")).to_have_count(3)
        relay.do(unknown="the database does not answer")
        expect(seen(page, "lost")).to_contain_text(
            "cannot report the current state. The database does not answer."
        )
        relay.do(unknown="")
        expect(seen(page, "lost")).to_have_count(0)
        assert dials(relay) == 1


def test_stop_goes_out_however_many_tabs_are_open(open_page: OpenPage, relay: FakeRelay) -> None:
    """Tabs share a browser's few connections to one host; no page holds one permanently."""
    page = open_page("/fleet", user="admin")
    tabs = [page, *(second_tab(page, "/fleet") for _ in range(6))]
    for tab in tabs:
        expect(seen(tab, "robot-card")).to_have_count(3)
    tabs[-1].get_by_role("button", name="Stop all robots").click()
    expect(seen(tabs[-1], "toast")).to_contain_text("1 robot is offline")
    assert len(relay.log(op="POST fleet")) == 1


class TestWhosePage:
    @pytest.mark.parametrize("path", ["/fleet", COCKPIT])
    def test_a_login_in_another_tab_counts_here(self, open_page: OpenPage, path: str) -> None:
        """Requests of this page would be that user's from now on, so the whole page becomes theirs, with a
        message.
        """
        page = open_page(path, user="driver")
        belongs_to(page, "driver")
        other = second_tab(page, "/fleet")
        leaves(other)
        enters(other, "viewer")
        expect(seen(other, "robot-card")).to_have_count(1)
        belongs_to(page, "viewer")
        expect(page).to_have_url(re.compile(path))

    def test_it_is_reported(self, open_page: OpenPage) -> None:
        """A login link opens another tab as another user without a logout."""
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
    def test_an_unannounced_login_is_found_with_the_next_connection(
        self, open_page: OpenPage, relay: FakeRelay, path: str
    ) -> None:
        """Another user's session does not count as the page's former one."""
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
