"""Who drives, with two people and more at once: real browsers, the real relay, a simulated robot."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, Page, WebSocketRoute, expect
from switchboard_browser import (
    hold_joystick,
    hold_resume,
    lived_in,
    ready_to_drive,
    seen,
    stands,
    take_control,
    was_told,
)
from switchboard_household import COCKPIT, Household, OpenPage, pages_of
from switchboard_waiting import wait_for

GRACE_SECONDS = 2.0
USERS = {"ann": "operator", "bob": "operator", "olga": "owner", "vera": "viewer"}


@pytest.fixture(scope="module")
def house(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Household]:
    """One house for all; each test leaves the robot free, and able to move."""
    grace = ("--control-grace", str(GRACE_SECONDS))
    yield from lived_in(lambda folder: Household(folder, USERS, *grace), tmp_path_factory.mktemp("control"))


@pytest.fixture
def open_page(browser: Browser, house: Household) -> Iterator[OpenPage]:
    """Opens pages of the portal for a user; an uncaught error or a breach of the CSP in any of them fails the test."""
    with pages_of(browser, house) as open_page:
        yield open_page


def ask(page: Page, why: str = "") -> None:
    """Ask who has control for it."""
    seen(page, "control-ask").click()
    seen(page, "control-why").fill(why)
    seen(page, "control-ask-send").click()
    stands(page, "waiting")


def drive(house: Household, page: Page) -> int:
    """Hold a key until the robot turns; the moment before."""
    since = time.monotonic_ns()
    page.keyboard.down("a")
    house.moves()
    return since


def stop_by(page: Page) -> None:
    """Press STOP; it is done when the robot has confirmed it."""
    with page.expect_response(re.compile("/robots/rover/stop$")) as told:
        seen(page, "stop").click()
    assert told.value.ok
    expect(seen(page, "stopped")).to_contain_text("The robot is stopped.")


# --- handing over -----------------------------------------------------------------------------------------


def test_control_is_taken_asked_for_and_granted(house: Household, open_page: OpenPage) -> None:
    """One drives, the other can't; asked and granted it is the other way round, by the robot's own record."""
    ann, bob = open_page("ann"), open_page("bob")
    stands(bob, "free")
    take_control(ann)
    stands(bob, "held")
    expect(seen(bob, "control-words")).to_have_text("ann has control.")
    since = time.monotonic_ns()
    bob.keyboard.press("a")
    bob.wait_for_timeout(500)  # proves absence
    assert house.movements(since) == []
    drive(house, ann)

    ask(bob, "to the charger, please")
    expect(seen(ann, "control-request")).to_contain_text("bob asks for control. “to the charger, please”")
    seen(ann, "control-grant").click()
    stands(bob, "yours")
    stands(ann, "held")
    house.stands()
    ann.keyboard.up("a")
    since = time.monotonic_ns()
    ann.keyboard.press("a")
    ann.wait_for_timeout(500)  # proves absence
    assert house.movements(since) == []
    drive(house, bob)
    bob.keyboard.up("a")
    house.stands()


def test_a_refused_request_leaves_everything_as_it_was(house: Household, open_page: OpenPage) -> None:
    """The holder goes on, and who asked is told so."""
    ann, bob = open_page("ann"), open_page("bob")
    take_control(ann)
    stands(bob, "held")
    ask(bob)
    seen(ann, "control-refuse").click()
    stands(bob, "held")
    was_told(bob, "ann keeps control")
    stands(ann, "yours")
    drive(house, ann)
    ann.keyboard.up("a")
    house.stands()


def test_an_owner_takes_over_who_got_no_answer(house: Household, open_page: OpenPage) -> None:
    """While the holder drives and does not look, the owner gets control after the grace time; the robot stands."""
    ann, olga = open_page("ann"), open_page("olga")
    take_control(ann)
    stands(olga, "held")
    drive(house, ann)
    ask(olga)
    stands(olga, "ripe")
    seen(olga, "control-over").click()
    stands(olga, "yours")
    house.stands()
    expect(seen(ann, "drive-words")).to_have_text("olga has control now.")
    was_told(ann, "you have lost control of rover: olga has taken over")
    ann.keyboard.up("a")


def test_of_two_who_take_it_at_once_one_has_it(house: Household, open_page: OpenPage) -> None:
    """Both press the button in the same moment; one drives, the other sees who."""
    ann, bob = open_page("ann"), open_page("bob")
    for page in (ann, bob):
        stands(page, "free")
    buttons = [seen(page, "control-take").element_handle() for page in (ann, bob)]
    moment = time.time() * 1000 + 2000
    for button in buttons:
        button.evaluate("(button, at) => void setTimeout(() => button.click(), at - Date.now())", moment)
    badges = [seen(page, "holder") for page in (ann, bob)]
    for badge in badges:
        expect(badge).to_be_visible()
    assert sorted(badge.inner_text() == "You have control" for badge in badges) == [False, True]


def test_control_goes_with_the_page_that_had_it(house: Household, open_page: OpenPage) -> None:
    """Closing the tab while driving stops the robot and frees it for the others."""
    ann, bob = open_page("ann"), open_page("bob")
    take_control(ann)
    stands(bob, "held")
    drive(house, ann)
    ann.close()
    stands(bob, "free")
    house.stands()


def test_who_is_here_and_who_has_control_is_shown(house: Household, open_page: OpenPage) -> None:
    """Everybody sees everybody, and the mark at who has control; an owner sees addresses too."""
    ann, olga = open_page("ann"), open_page("olga")
    take_control(ann)
    for page in (ann, olga):
        people = seen(page, "person")
        expect(people).to_have_count(2)
        expect(people.first).to_have_attribute("data-user", "ann")
        expect(people.first.get_by_test_id("person-control")).to_be_visible()
    expect(seen(olga, "presence")).to_contain_text("127.0.0.1")
    expect(seen(ann, "presence")).not_to_contain_text("127.0.0.1")


# --- stop -------------------------------------------------------------------------------------------------


def test_a_viewer_stops_who_drives(house: Household, open_page: OpenPage) -> None:
    """STOP on the viewer's screen halts the robot and bars the driver, who alone of the two may resume."""
    ann, vera = open_page("ann"), open_page("vera")
    take_control(ann)
    drive(house, ann)
    seen(vera, "stop").click()
    house.stands()
    for page in (ann, vera):
        expect(seen(page, "stopped")).to_contain_text("The robot is stopped. By vera")
    expect(seen(vera, "resume")).to_have_count(0)
    expect(seen(vera, "resume-who")).to_have_text("ann, who has control, or an owner can resume it.")
    ann.keyboard.up("a")
    since = time.monotonic_ns()
    ann.keyboard.press("a")
    hold_joystick(ann)
    ann.mouse.up()
    ann.wait_for_timeout(500)  # proves absence
    assert house.movements(since) == []

    seen(ann, "resume").click()
    ann.wait_for_timeout(300)  # proves absence
    expect(seen(vera, "stopped")).to_be_visible()
    hold_resume(ann)
    expect(seen(vera, "stopped")).to_have_count(0)
    drive(house, ann)
    ann.keyboard.up("a")
    house.stands()


@pytest.mark.parametrize("button", ["resume", "order-resume"])
def test_a_second_stop_ends_a_press_to_resume(house: Household, open_page: OpenPage, button: str) -> None:
    """Somebody stops the stopped robot once more while another holds the button: it stays stopped, and he is named."""
    vera, ann = open_page("vera"), open_page("ann")
    olga = open_page("olga", COCKPIT if button == "resume" else "/fleet")
    if button == "order-resume":
        seen(olga, "fleet-order").click()
        seen(olga, "order-pattern").fill("rover")
        seen(olga, "order-do").select_option("resume")
    # Where the second stop took longer than the finger, the press was not ended by it.
    for _ in range(5):
        stop_by(vera)
        expect(seen(olga, "stopped" if button == "resume" else "robot-stopped")).to_be_visible()
        seen(olga, button).focus()
        olga.keyboard.down("Enter")
        stop_by(ann)
        olga.wait_for_timeout(2500)  # proves absence
        olga.keyboard.up("Enter")
        if "Again by ann" in seen(vera, "stopped").inner_text():
            break
        seen(olga, button).blur()
    else:
        pytest.fail("each time the robot was resumed")
    seen(olga, button).focus()
    olga.keyboard.down("Enter")
    expect(seen(vera, "stopped")).to_have_count(0)
    olga.keyboard.up("Enter")


def test_stop_goes_without_a_websocket(house: Household, open_page: OpenPage) -> None:
    """On a screen whose websockets never open STOP goes by HTTP, and halts who drives elsewhere."""

    def cut(route: WebSocketRoute) -> None:
        """Connected to nobody."""

    ann = open_page("ann")
    vera = open_page("vera", prepare=lambda page: page.route_web_socket(re.compile("/robots/"), cut))
    take_control(ann)
    drive(house, ann)
    seen(vera, "stop").click()
    house.stands()
    expect(seen(ann, "stopped")).to_contain_text("By vera")
    expect(seen(vera, "drive-words")).to_have_text("The robot is stopped.")
    ann.keyboard.up("a")
    hold_resume(ann)


def test_all_robots_are_stopped_and_resumed_from_the_list(house: Household, open_page: OpenPage) -> None:
    """STOP all halts who drives; the order to resume goes to a pattern, with a result for each robot."""
    ann, olga = open_page("ann"), open_page("olga", "/fleet")
    take_control(ann)
    drive(house, ann)
    olga.get_by_role("button", name="Stop all robots").click()
    house.stands()
    ann.keyboard.up("a")
    expect(seen(olga, "robot-stopped")).to_be_visible()
    expect(seen(olga, "robot-holder")).to_have_text("ann")
    seen(olga, "fleet-order").click()
    seen(olga, "order-pattern").fill("rov*")
    seen(olga, "order-do").select_option("resume")
    seen(olga, "order-resume").focus()
    olga.keyboard.down("Enter")
    expect(seen(olga, "order-progress")).to_have_text("1 of 1 robots, done")
    olga.keyboard.up("Enter")
    expect(seen(olga, "order-result")).to_contain_text("rover")
    expect(seen(olga, "robot-stopped")).to_have_count(0)
    expect(seen(ann, "stopped")).to_have_count(0)


# --- letting go -------------------------------------------------------------------------------------------


LEAVING = {
    "hidden": "Object.defineProperty(document, 'hidden', { value: true, configurable: true });"
    "document.dispatchEvent(new Event('visibilitychange'))",
    "frozen": "document.dispatchEvent(new Event('freeze'))",
    "blur": "window.dispatchEvent(new Event('blur'))",
}


@pytest.mark.parametrize("way", LEAVING)
def test_a_page_that_goes_out_of_sight_says_zero(house: Household, open_page: OpenPage, way: str) -> None:
    """A tab that is hidden, frozen by the browser or loses the focus sends zero, and nothing after it."""
    page = open_page("ann")
    ready_to_drive(page)
    since = drive(house, page)
    page.evaluate(LEAVING[way])
    wait_for("a zero came", lambda: house.commands(since)[-1:] == [(0, 0)])
    house.stands()
    told = len(house.commands(since))
    page.wait_for_timeout(700)  # proves absence
    assert [each for each in house.commands(since)[told:] if each != (0, 0)] == []
    page.keyboard.up("a")


PAD = """
  window.pad = { index: 0, id: 'Pad', connected: true, axes: [-1, 0, 0, 0], timestamp: 0, mapping: 'standard',
                 buttons: Array.from({ length: 17 }, () => ({ pressed: false, touched: false, value: 0 })) }
  navigator.getGamepads = () => [window.pad, null, null, null]
"""


@pytest.mark.parametrize("way", ["pad.buttons[4].pressed = false", "window.pad = null"])
def test_a_gamepad_that_is_let_go_or_gone_stops(house: Household, open_page: OpenPage, way: str) -> None:
    """It drives while its shoulder button is held, and no longer."""
    page = open_page("ann", prepare=lambda page: page.add_init_script(PAD))
    ready_to_drive(page)
    seen(page, "input-gamepad").click()
    expect(seen(page, "gamepad")).to_have_attribute("data-pad", "ready")
    assert not house.robot.moving()
    page.evaluate("pad.buttons[4].pressed = true")
    house.moves()
    page.evaluate(way)
    house.stands()


# --- alerts -----------------------------------------------------------------------------------------------


def test_who_looks_elsewhere_is_told_that_a_robot_is_gone(house: Household, open_page: OpenPage) -> None:
    """A toast and a count in the top bar; on the page of alerts it is acknowledged, and over when it is back."""
    ann, vera = open_page("ann", "/fleet"), open_page("vera", "/alerts")
    expect(seen(ann, "robot-card")).to_have_count(1)
    expect(seen(vera, "alerts-empty")).to_be_visible()
    house.robot.daemon.stop()
    try:
        was_told(ann, "rover")
        expect(seen(ann, "alerts-count")).to_have_text("1")
        alert = vera.locator("[data-testid=alert][data-kind=offline]")
        expect(alert).to_contain_text("rover")
        expect(alert.get_by_test_id("acknowledge")).to_have_count(0)
        seen(ann, "alerts-link").click()
        ann.locator("[data-testid=alert][data-kind=offline]").get_by_test_id("acknowledge").click()
        expect(alert).to_contain_text("ann looks after it")
        expect(seen(ann, "alerts-count")).to_have_count(0)
    finally:
        house.robot.start_daemon()
        house.robot.wait_online()
    expect(alert).to_have_count(0)
    seen(vera, "alerts-over").click()
    expect(alert).to_contain_text("over")
