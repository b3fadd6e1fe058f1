"""Control with two users and more: real browsers, a real relay, a simulated robot."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, Page, WebSocketRoute, expect

from tests.worlds.browser import (
    hold_joystick,
    hold_resume,
    ready_to_drive,
    running_world,
    seen,
    stands,
    take_control,
    was_notified,
)
from tests.worlds.portal_relay import COCKPIT, OpenPage, PortalWorld, pages_of
from tests.worlds.waiting import wait_for

GRACE_SECONDS = 2.0
USERS = {"ann": "operator", "bob": "operator", "olga": "owner", "vera": "viewer"}


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[PortalWorld]:
    """One world for all; each test leaves the robot without a controller and not stopped."""
    grace = ("--control-grace", str(GRACE_SECONDS))
    yield from running_world(
        lambda folder: PortalWorld(folder, USERS, *grace), tmp_path_factory.mktemp("control")
    )


@pytest.fixture
def open_page(browser: Browser, world: PortalWorld) -> Iterator[OpenPage]:
    """Opens pages of the portal for a user; an uncaught error or a violation of the CSP in any of them fails
    the test.
    """
    with pages_of(browser, world) as open_page:
        yield open_page


def ask(page: Page, why: str = "") -> None:
    """Requests control from the controller."""
    seen(page, "control-ask").click()
    seen(page, "control-why").fill(why)
    seen(page, "control-ask-send").click()
    stands(page, "waiting")


def drive(world: PortalWorld, page: Page) -> int:
    """Holds a key until the robot turns; returns the time before."""
    since = time.monotonic_ns()
    page.keyboard.down("a")
    world.moves()
    return since


def stop_by(page: Page) -> None:
    """Presses STOP and waits for the robot's confirmation."""
    seen(page, "stop").click()
    # Until then it says "Stopping…".
    expect(seen(page, "stop")).to_have_text("STOP")
    expect(seen(page, "stopped")).to_contain_text("The robot is stopped.")


# --- handing over -----------------------------------------------------------------------------------------


def test_control_is_taken_asked_for_and_granted(world: PortalWorld, open_page: OpenPage) -> None:
    """One user drives, the other cannot; after a granted request it is the reverse, by the robot's own log."""
    ann, bob = open_page("ann"), open_page("bob")
    stands(bob, "free")
    take_control(ann)
    stands(bob, "held")
    expect(seen(bob, "control-words")).to_have_text("ann has control.")
    since = time.monotonic_ns()
    bob.keyboard.press("a")
    bob.wait_for_timeout(500)  # shows absence
    assert world.movements(since) == []
    drive(world, ann)

    ask(bob, "to the charger, please")
    expect(seen(ann, "control-request")).to_contain_text("bob requests control. “to the charger, please”")
    seen(ann, "control-grant").click()
    stands(bob, "yours")
    stands(ann, "held")
    world.stands()
    ann.keyboard.up("a")
    since = time.monotonic_ns()
    ann.keyboard.press("a")
    ann.wait_for_timeout(500)  # shows absence
    assert world.movements(since) == []
    drive(world, bob)
    bob.keyboard.up("a")
    world.stands()


def test_a_refused_request_leaves_everything_as_it_was(world: PortalWorld, open_page: OpenPage) -> None:
    """The controller continues, and the requester gets the reason."""
    ann, bob = open_page("ann"), open_page("bob")
    take_control(ann)
    stands(bob, "held")
    ask(bob)
    seen(ann, "control-refuse").click()
    stands(bob, "held")
    was_notified(bob, "ann keeps control")
    stands(ann, "yours")
    drive(world, ann)
    ann.keyboard.up("a")
    world.stands()


def test_an_owner_without_an_answer_takes_over(world: PortalWorld, open_page: OpenPage) -> None:
    """The controller drives and does not answer: the owner gets control after the grace time, and the robot
    stands.
    """
    ann, olga = open_page("ann"), open_page("olga")
    take_control(ann)
    stands(olga, "held")
    drive(world, ann)
    ask(olga)
    stands(olga, "may_take_over")
    seen(olga, "control-over").click()
    stands(olga, "yours")
    world.stands()
    expect(seen(ann, "drive-words")).to_have_text("olga has control now.")
    was_notified(ann, "you have lost control of rover: olga has taken over")
    ann.keyboard.up("a")


def test_one_of_two_simultaneous_requests_gets_control(world: PortalWorld, open_page: OpenPage) -> None:
    """Both press the button at the same time; one drives, the other sees the controller."""
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


def test_control_goes_with_the_page_that_had_it(world: PortalWorld, open_page: OpenPage) -> None:
    """Closing the tab while driving stops the robot and releases control."""
    ann, bob = open_page("ann"), open_page("bob")
    take_control(ann)
    stands(bob, "held")
    drive(world, ann)
    ann.close()
    stands(bob, "free")
    world.stands()


def test_users_and_controller_are_shown(world: PortalWorld, open_page: OpenPage) -> None:
    """Every user sees all users, with a mark at the controller; an owner sees addresses too."""
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


def test_a_viewer_stops_the_driver(world: PortalWorld, open_page: OpenPage) -> None:
    """STOP on the viewer's page stops the robot and locks out the driver, who may resume; the viewer may not."""
    ann, vera = open_page("ann"), open_page("vera")
    take_control(ann)
    drive(world, ann)
    seen(vera, "stop").click()
    world.stands()
    for page in (ann, vera):
        expect(seen(page, "stopped")).to_contain_text("The robot is stopped. By vera")
    expect(seen(vera, "resume")).to_have_count(0)
    expect(seen(vera, "resume-who")).to_have_text("ann, who has control, or an owner can resume it.")
    ann.keyboard.up("a")
    since = time.monotonic_ns()
    ann.keyboard.press("a")
    hold_joystick(ann)
    ann.mouse.up()
    ann.wait_for_timeout(500)  # shows absence
    assert world.movements(since) == []

    seen(ann, "resume").click()
    ann.wait_for_timeout(300)  # shows absence
    expect(seen(vera, "stopped")).to_be_visible()
    hold_resume(ann)
    expect(seen(vera, "stopped")).to_have_count(0)
    drive(world, ann)
    ann.keyboard.up("a")
    world.stands()


@pytest.mark.parametrize("button", ["resume", "order-resume"])
def test_a_second_stop_ends_a_press_to_resume(world: PortalWorld, open_page: OpenPage, button: str) -> None:
    """The second stop comes while another user holds the resume button: the robot stays stopped, with the
    second user's name.
    """
    vera, ann = open_page("vera"), open_page("ann")
    olga = open_page("olga", COCKPIT if button == "resume" else "/fleet")
    if button == "order-resume":
        seen(olga, "fleet-order").click()
        seen(olga, "order-pattern").fill("rover")
        seen(olga, "order-do").select_option("resume")
    # If the second stop took longer than the press, it did not interrupt it.
    for _ in range(5):
        stop_by(vera)
        expect(seen(olga, "stopped" if button == "resume" else "robot-stopped")).to_be_visible()
        seen(olga, button).focus()
        olga.keyboard.down("Enter")
        stop_by(ann)
        olga.wait_for_timeout(2500)  # shows absence
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


def test_stop_goes_without_a_websocket(world: PortalWorld, open_page: OpenPage) -> None:
    """On a page whose websockets cannot open, STOP uses HTTP and stops another user's driving."""

    def cut(route: WebSocketRoute) -> None:
        """Connects to nothing."""

    ann = open_page("ann")
    vera = open_page("vera", prepare=lambda page: page.route_web_socket(re.compile("/robots/"), cut))
    take_control(ann)
    drive(world, ann)
    seen(vera, "stop").click()
    world.stands()
    expect(seen(ann, "stopped")).to_contain_text("By vera")
    expect(seen(vera, "drive-words")).to_have_text("The robot is stopped.")
    ann.keyboard.up("a")
    hold_resume(ann)


def test_all_robots_are_stopped_and_resumed_from_the_list(world: PortalWorld, open_page: OpenPage) -> None:
    """STOP all stops driven robots; resuming uses a pattern, with a result for each robot."""
    ann, olga = open_page("ann"), open_page("olga", "/fleet")
    take_control(ann)
    drive(world, ann)
    olga.get_by_role("button", name="Stop all robots").click()
    world.stands()
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


# --- release ----------------------------------------------------------------------------------------------


LEAVING = {
    "hidden": "Object.defineProperty(document, 'hidden', { value: true, configurable: true });"
    "document.dispatchEvent(new Event('visibilitychange'))",
    "frozen": "document.dispatchEvent(new Event('freeze'))",
    "blur": "window.dispatchEvent(new Event('blur'))",
}


@pytest.mark.parametrize("script", LEAVING)
def test_a_page_that_is_hidden_sends_zero(world: PortalWorld, open_page: OpenPage, script: str) -> None:
    """A tab that is hidden, frozen or loses the focus sends zero, and no command after it."""
    page = open_page("ann")
    ready_to_drive(page)
    since = drive(world, page)
    page.evaluate(LEAVING[script])
    wait_for("a zero came", lambda: world.commands(since)[-1:] == [(0, 0)])
    world.stands()
    reported = len(world.commands(since))
    page.wait_for_timeout(700)  # shows absence
    assert [each for each in world.commands(since)[reported:] if each != (0, 0)] == []
    page.keyboard.up("a")


PAD = """
  window.pad = { index: 0, id: 'Pad', connected: true, axes: [-1, 0, 0, 0], timestamp: 0, mapping: 'standard',
                 buttons: Array.from({ length: 17 }, () => ({ pressed: false, touched: false, value: 0 })) }
  navigator.getGamepads = () => [window.pad, null, null, null]
"""


@pytest.mark.parametrize("script", ["pad.buttons[4].pressed = false", "window.pad = null"])
def test_a_released_or_disconnected_gamepad_stops_the_robot(
    world: PortalWorld, open_page: OpenPage, script: str
) -> None:
    """It drives only while its shoulder button is held."""
    page = open_page("ann", prepare=lambda page: page.add_init_script(PAD))
    ready_to_drive(page)
    seen(page, "input-gamepad").click()
    expect(seen(page, "gamepad")).to_have_attribute("data-pad", "ready")
    assert not world.robot.moving()
    page.evaluate("pad.buttons[4].pressed = true")
    world.moves()
    page.evaluate(script)
    world.stands()


# --- alerts -----------------------------------------------------------------------------------------------


def test_portal_on_another_page_shows_a_lost_robot(world: PortalWorld, open_page: OpenPage) -> None:
    """A toast and a count in the top bar; the page of alerts acknowledges it, and shows its end when the
    robot is back.
    """
    ann, vera = open_page("ann", "/fleet"), open_page("vera", "/alerts")
    expect(seen(ann, "robot-card")).to_have_count(1)
    expect(seen(vera, "alerts-empty")).to_be_visible()
    world.robot.daemon.stop()
    try:
        was_notified(ann, "rover")
        expect(seen(ann, "alerts-count")).to_have_text("1")
        alert = vera.locator("[data-testid=alert][data-kind=offline]")
        expect(alert).to_contain_text("rover")
        expect(alert.get_by_test_id("acknowledge")).to_have_count(0)
        seen(ann, "alerts-link").click()
        ann.locator("[data-testid=alert][data-kind=offline]").get_by_test_id("acknowledge").click()
        expect(alert).to_contain_text("ann looks after it")
        expect(seen(ann, "alerts-count")).to_have_count(0)
    finally:
        world.robot.start_daemon()
        world.robot.wait_online()
    expect(alert).to_have_count(0)
    seen(vera, "alerts-over").click()
    expect(alert).to_contain_text("over")
