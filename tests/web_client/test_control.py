"""Driving: control, stop, and all ways to release, in a real browser with a fake relay."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import pytest
from playwright.sync_api import Page, expect

from tests.worlds.browser import hold_joystick, hold_resume, ready_to_drive, seen, stands, take_control
from tests.worlds.touch import Phone

if TYPE_CHECKING:
    from collections.abc import Callable

    OpenPage = Callable[..., Page]
    FakeRelay = Any

COCKPIT = "/cockpit/rover-1"
ZERO = (0, 0)
ROBOT = "rover-1"


def driving(relay: FakeRelay, at_least: int = 3) -> None:
    relay.until(lambda: len([c for c in relay.commands() if c != ZERO]) >= at_least, "no commands came")


def ends_with_one_zero(page: Page, relay: FakeRelay) -> None:
    """One zero, and no command after it."""
    relay.until(lambda: relay.commands()[-1:] == [ZERO], "no zero came")
    before = relay.commands()
    page.wait_for_timeout(500)  # shows absence
    assert relay.commands() == before
    moving = max(i for i, command in enumerate(before) if command != ZERO)
    assert before[moving + 1 :] == [ZERO]


def orders(relay: FakeRelay) -> list[str]:
    """Calls of ``/relay/…``, without pings."""
    asked = [entry["service"] for entry in relay.log(op="call_service")]
    return [name for name in asked if name.startswith("/relay/") and name != "/relay/ping"]


class TestControl:
    def test_no_command_before_control_is_taken(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """A free robot is not taken by opening its cockpit, nor by keys and joystick; only by the button."""
        page = open_page(COCKPIT, user="driver")
        stands(page, "free")
        expect(seen(page, "drive-blocked")).to_have_text("Take control to drive.")
        hold_joystick(page)
        page.mouse.up()
        page.keyboard.press("w")
        page.wait_for_timeout(300)  # shows absence
        assert relay.commands() == [] and orders(relay) == []
        take_control(page)
        expect(seen(page, "control-words")).to_have_text("You have control.")
        page.keyboard.press("w")
        relay.until(relay.commands, "no command came")

    def test_two_users_ask_grant_refuse_withdraw(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """Each sees the other's actions, and only the controller can drive."""
        ann, bob = open_page(COCKPIT, user="admin"), open_page(COCKPIT, user="driver")
        take_control(bob)
        expect(seen(ann, "control-words")).to_have_text("driver has control.")
        expect(seen(ann, "holder")).to_have_text("driver has control")
        expect(seen(ann, "drive-blocked")).to_contain_text("driver has control")

        seen(ann, "control-ask").click()
        seen(ann, "control-why").fill("<b>my turn</b>")
        seen(ann, "control-ask-send").click()
        stands(ann, "waiting")
        expect(seen(ann, "control-left")).to_have_text(re.compile(r"[12]?\d s left to answer"))
        expect(seen(bob, "control-request")).to_contain_text("admin requests control. “<b>my turn</b>”")
        expect(seen(bob, "request-left")).to_have_text(re.compile(r"\d+ s to answer"))
        seen(bob, "control-refuse").click()
        stands(ann, "held")
        expect(seen(ann, "control-answer")).to_have_count(0)
        expect(seen(bob, "control-request")).to_have_count(0)

        seen(ann, "control-ask").click()
        seen(ann, "control-ask-send").click()
        stands(ann, "waiting")
        seen(ann, "control-withdraw").click()
        stands(ann, "held")
        stands(bob, "yours")

        seen(ann, "control-ask").click()
        seen(ann, "control-ask-send").click()
        seen(bob, "control-grant").click()
        stands(ann, "yours")
        stands(bob, "held")
        bob.keyboard.press("w")
        ann.keyboard.press("w")
        relay.until(relay.commands, "no command came")
        assert {entry["user"] for entry in relay.log(op="publish", topic="/cmd_vel")} == {"admin"}
        seen(ann, "control-release").click()
        stands(bob, "free")

    def test_an_owner_takes_over_after_the_grace_time(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """The button appears when the holder has not answered in time."""
        relay.do(robot=ROBOT, grace=1.0)
        owner, driver = open_page(COCKPIT, user="admin"), open_page(COCKPIT, user="driver")
        take_control(driver)
        seen(owner, "control-ask").click()
        seen(owner, "control-ask-send").click()
        expect(seen(owner, "control-words")).to_have_text("driver has not answered. You may take over.")
        seen(owner, "control-over").click()
        stands(owner, "yours")
        stands(driver, "held")
        expect(seen(driver, "drive-words")).to_have_text("admin has control now.")

    def test_any_user_takes_over_from_a_program_that_does_not_answer(
        self, open_page: OpenPage, relay: FakeRelay
    ) -> None:
        """It took the robot by a command: an operator has the button too, after the grace time."""
        relay.do(robot=ROBOT, grace=1.0, implicit=True)
        program, driver = open_page(COCKPIT, user="admin"), open_page(COCKPIT, user="driver")
        take_control(program)
        seen(driver, "control-ask").click()
        seen(driver, "control-ask-send").click()
        expect(seen(program, "request-left")).to_have_text("That user may take over now.")
        expect(seen(driver, "control-words")).to_have_text("admin has not answered. You may take over.")
        seen(driver, "control-over").click()
        stands(driver, "yours")

    def test_an_answer_names_its_client(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """By the number of the shown connection: another user may have asked since."""
        ann, bob = open_page(COCKPIT, user="admin"), open_page(COCKPIT, user="driver")
        take_control(bob)
        for answer, order in (("control-refuse", "refuse_control"), ("control-grant", "grant_control")):
            seen(ann, "control-ask").click()
            seen(ann, "control-ask-send").click()
            stands(ann, "waiting")
            seen(bob, answer).click()
            stands(ann, "held" if answer == "control-refuse" else "yours")
            name = f"/relay/{order}"
            (asked,) = relay.until(
                lambda name=name: relay.log(op="call_service", service=name), "no answer came"
            )
            assert asked["args"]["client"] > 0

    def test_overrides_of_others_are_listed(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """Suppressions of the driving topic, and inhibitions of a panel's topic."""
        page = open_page(COCKPIT, user="driver")
        ready_to_drive(page)
        by = {"by": "runaway", "ms": 100}
        for width in (1280, 390):
            page.set_viewport_size({"width": width, "height": 800})
            expect(seen(page, "suppressed")).to_be_empty()
            stick = page.get_by_test_id("joystick").bounding_box()
            relay.do(
                robot=ROBOT,
                suppressed=[{"resource": "/cmd_vel", "sources": [99], **by}],
                inhibited=[
                    {"resource": "/scan", "hold": True, **by},
                    {"resource": "/odom", "hold": False, **by},
                ],
            )
            expect(seen(page, "suppressed")).to_have_text("runaway commands this topic.")
            scan, odometry = (
                page.get_by_role("region", name="Laser scan"),
                page.get_by_role("region", name="Odometry"),
            )
            expect(scan.get_by_test_id("suppressed-topic")).to_have_text("held by runaway")
            expect(odometry.get_by_test_id("suppressed-topic")).to_have_text("inhibited by runaway")
            expect(scan).not_to_contain_text("nearest")
            assert page.get_by_test_id("joystick").bounding_box() == stick
            assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
            relay.do(robot=ROBOT, suppressed=[], inhibited=[])
            expect(page.get_by_test_id("suppressed-topic")).to_have_count(0)
            expect(scan).to_contain_text("nearest")

    def test_control_of_another_window_is_brought_here(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """One user with two windows needs no permission."""
        first, second = open_page(COCKPIT, user="driver"), open_page(COCKPIT, user="driver")
        take_control(first)
        expect(seen(second, "control-words")).to_have_text("You have control in another window.")
        seen(second, "control-fetch").click()
        stands(second, "yours")
        stands(first, "elsewhere")

    def test_answer_of_the_relay_is_shown(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """A failed order is shown with the relay's reason."""
        page = open_page(COCKPIT, user="driver")
        stands(page, "free")
        relay.do(robot=ROBOT, deny="the robot does not agree")
        seen(page, "control-take").click()
        expect(seen(page, "control-answer")).to_have_text("the robot does not agree")

    def test_the_limit_of_the_level_bounds_the_slider(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """The robot's limit for an operator is the end of the slider and the scale of the joystick."""
        page = open_page(COCKPIT, user="driver")
        ready_to_drive(page)
        expect(seen(page, "joystick-scale")).to_have_text("0.50 m/s")
        slider = seen(page, "limit-linear")
        expect(slider).to_have_attribute("max", "1.2")
        slider.focus()
        page.keyboard.press("End")
        expect(seen(page, "joystick-scale")).to_have_text("1.20 m/s")
        expect(seen(page, "top-linear")).to_contain_text("of 1.20 allowed")
        expect(seen(page, "top-angular")).to_have_count(0)


class TestStop:
    def test_by_websocket_and_by_http_at_once(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """STOP uses both paths; the banner shows the user, and driving is disabled."""
        page = open_page(COCKPIT, user="driver")
        ready_to_drive(page)
        page.keyboard.down("w")
        driving(relay)
        seen(page, "stop").click()
        expect(seen(page, "stopped")).to_contain_text("By driver")
        expect(seen(page, "drive-blocked")).to_contain_text("The robot is stopped.")
        assert orders(relay)[-1:] == ["/relay/stop"]
        assert len(relay.log(op=f"POST robots/{ROBOT}/stop")) == 1
        ends_with_one_zero(page, relay)
        page.keyboard.up("w")

    def test_done_in_part(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """The page shows that the robot is stopped, and which part failed."""
        page = open_page(COCKPIT, user="driver")
        ready_to_drive(page)
        relay.do(robot=ROBOT, fault="no contactor")
        seen(page, "stop").click()
        expect(seen(page, "drive-words")).to_have_text("The robot is stopped.")
        words = f"Robot {ROBOT} is stopped, but a part of the stop failed: no contactor."
        expect(seen(page, "toast")).to_contain_text(words)
        expect(seen(page, "toast")).not_to_contain_text("not confirmed")

    @pytest.mark.parametrize("key", ["Enter", "Space"])
    def test_by_the_keyboard(self, open_page: OpenPage, relay: FakeRelay, key: str) -> None:
        """The button by Enter, and by space from anywhere; for viewers too."""
        page = open_page(COCKPIT, user="viewer")
        expect(seen(page, "link-state")).to_have_attribute("data-state", "open")
        if key == "Enter":
            seen(page, "stop").focus()
        page.keyboard.press(key)
        expect(seen(page, "stopped")).to_contain_text("By viewer")
        expect(seen(page, "resume-who")).to_contain_text("owner")
        expect(seen(page, "resume")).to_have_count(0)

    def test_without_a_websocket(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """While the link is down STOP uses only HTTP, and its result is shown before the link's lateness."""
        page = open_page(COCKPIT, user="driver")
        ready_to_drive(page)
        relay.do(frozen=True)
        expect(seen(page, "drive-words")).to_contain_text("The link is slow.")
        seen(page, "stop").click()
        late = page.locator("body:has([data-testid=link-late])")
        expect(late.get_by_test_id("drive-words")).to_have_text("The robot is stopped.", timeout=4000)
        assert relay.log(op=f"POST robots/{ROBOT}/stop")
        relay.do(frozen=False)
        page.reload()
        expect(seen(page, "stopped")).to_be_visible()

    def test_a_missing_answer_is_shown(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """The page shows at once that it is under way, then that it is not confirmed, until the robot stands."""
        page = open_page(COCKPIT, user="driver")
        ready_to_drive(page)
        relay.do(frozen=True, stuck=["orders"])
        expect(seen(page, "link-late")).to_be_visible()
        page.clock.install()
        seen(page, "stop").click()
        expect(seen(page, "drive-words")).to_have_text(
            re.compile("^(Stopping…|The stop is not confirmed yet.*)$")
        )
        expect(seen(page, "stop")).to_have_text(re.compile("^(Stopping…|Not confirmed)$"))
        page.clock.fast_forward(23_000)
        expect(seen(page, "drive-words")).to_contain_text("The stop is not confirmed.")
        expect(seen(page, "toast")).to_contain_text("The stop is not confirmed.")
        expect(seen(page, "stop")).to_have_text("STOP")
        page.clock.fast_forward(60_000)
        expect(seen(page, "toast")).to_be_visible()
        relay.do(frozen=False, stuck=[])
        expect(seen(page, "drive-words")).to_have_text("The robot is stopped.")
        expect(seen(page, "toast")).to_have_count(0)

    def test_the_relays_answer_is_shown(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """Not the page's view of the robot: one that has just returned is stopped, and not offline."""
        page = open_page(COCKPIT, user="driver")
        ready_to_drive(page)
        relay.do(robot=ROBOT, state="offline")
        expect(page.get_by_text("The robot is offline.").first).to_be_visible()
        relay.do(mute=True, stuck=["orders"])
        relay.do(robot=ROBOT, state="online")
        seen(page, "stop").click()
        expect(seen(page, "drive-words")).to_have_text("The robot is stopped.")
        relay.do(stuck=[])

    def test_of_a_robot_that_is_away(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """The page says that it will be stopped, for any order of the answers."""
        page = open_page(COCKPIT, user="driver")
        ready_to_drive(page)
        relay.do(robot=ROBOT, state="offline")
        expect(page.get_by_text("The robot is offline.").first).to_be_visible()
        seen(page, "stop").click()
        expect(seen(page, "drive-words")).to_contain_text("It is stopped as soon as it is online.")

    def test_resume_takes_a_press_that_lasts(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """A click resumes nothing; holding the button does, by mouse and by keyboard."""
        page = open_page(COCKPIT, user="admin")
        for by in ("mouse", "keyboard"):
            expect(seen(page, "link-state")).to_have_attribute("data-state", "open")
            seen(page, "stop").click()
            expect(seen(page, "stopped")).to_be_visible()
            seen(page, "resume").click()
            page.wait_for_timeout(300)  # shows absence
            expect(seen(page, "stopped")).to_be_visible()
            if by == "mouse":
                hold_resume(page)
                continue
            seen(page, "resume").focus()
            page.keyboard.down("Enter")
            expect(seen(page, "stopped")).to_have_count(0)
            page.keyboard.up("Enter")
        assert orders(relay).count("/relay/resume") == 2

    def test_resume_ends_when_the_focus_leaves_the_button(
        self, open_page: OpenPage, relay: FakeRelay
    ) -> None:
        """The key is released elsewhere then, and the robot stays stopped."""
        page = open_page(COCKPIT, user="admin")
        expect(seen(page, "link-state")).to_have_attribute("data-state", "open")
        seen(page, "stop").click()
        seen(page, "resume").focus()
        page.keyboard.down("Space")
        page.keyboard.press("Tab")
        expect(seen(page, "resume")).not_to_be_focused()
        page.keyboard.up("Space")
        page.wait_for_timeout(2000)  # shows absence
        expect(seen(page, "stopped")).to_be_visible()
        assert "/relay/resume" not in orders(relay)

    def test_a_stop_that_comes_while_the_finger_holds_is_not_resumed(
        self, open_page: OpenPage, relay: FakeRelay
    ) -> None:
        """Another user has stopped the robot again: the user has to see that and press again."""
        page = open_page(COCKPIT, user="admin")
        expect(seen(page, "link-state")).to_have_attribute("data-state", "open")
        for attempt in range(5):
            relay.do(robot=ROBOT, stopped=f"vic {attempt}")
            expect(seen(page, "stopped")).to_contain_text(f"by vic {attempt}", ignore_case=True)
            before = orders(relay).count("/relay/resume")
            seen(page, "resume").focus()
            page.keyboard.down("Space")
            relay.do(robot=ROBOT, stopped=f"eve {attempt}")
            page.wait_for_timeout(2000)  # shows absence
            page.keyboard.up("Space")
            # If the second stop took longer than the press, the page could not show it.
            if orders(relay).count("/relay/resume") == before:
                break
        else:
            pytest.fail("each time the robot was resumed")
        expect(seen(page, "stopped")).to_contain_text(f"Again by eve {attempt}")

    def test_of_one_robot_and_of_all_from_the_list(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """Each card has its STOP, and the top bar one for all; an offline robot is stopped when it is back."""
        page = open_page("/fleet", user="admin")
        page.locator("[data-robot=rover-2]").get_by_test_id("stop").click()
        expect(seen(page, "toast")).to_have_text(re.compile("rover-2 is stopped."))
        page.get_by_role("button", name="Stop all robots").click()
        expect(
            page.get_by_text("2 robots are stopped. 1 robot is offline, and will be stopped when back.")
        ).to_be_visible()
        [asked] = relay.log(op="POST fleet")
        assert (asked["do"], asked["robots"]) == ("stop", ["*"])


LEAVING = {
    "blur": "window.dispatchEvent(new Event('blur'))",
    "pagehide": "window.dispatchEvent(new Event('pagehide'))",
    "freeze": "document.dispatchEvent(new Event('freeze'))",
    "offline": "window.dispatchEvent(new Event('offline'))",
    "contextmenu": "document.body.dispatchEvent(new MouseEvent('contextmenu', { bubbles: true, cancelable: true }))",
    "pointercancel": "window.dispatchEvent(new PointerEvent('pointercancel', { bubbles: true }))",
    "lostpointercapture": "document.querySelector('[data-testid=joystick]')"
    ".dispatchEvent(new PointerEvent('lostpointercapture'))",
    "second finger": "document.body.dispatchEvent(Object.assign(new Event('touchstart', { bubbles: true }), "
    "{ touches: [{}, {}] }))",
    "dialog": "(() => { const d = document.createElement('dialog'); d.id = 'over'; document.body.append(d); "
    "d.showModal() })()",
    "dragstart": "document.body.dispatchEvent(new DragEvent('dragstart', { bubbles: true }))",
    "beforeprint": "window.dispatchEvent(new Event('beforeprint'))",
    "fullscreenchange": "document.dispatchEvent(new Event('fullscreenchange', { bubbles: true }))",
    "visibilitychange": "Object.defineProperty(document, 'hidden', { value: true, configurable: true });"
    "document.dispatchEvent(new Event('visibilitychange'))",
}


COMING_BACK = """
document.querySelector('dialog#over')?.remove()
Object.defineProperty(document, 'hidden', { value: false, configurable: true })
document.dispatchEvent(new Event('visibilitychange'))
"""


class TestLettingGo:
    def test_sends_one_zero(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """However the input is interrupted, one zero is sent, and an input that is still held drives no
        further.
        """
        page = open_page(COCKPIT, user="driver")
        for event, script in LEAVING.items():
            ready_to_drive(page)
            relay.do(clear_log=True)
            hold_joystick(page)
            driving(relay)
            page.evaluate(script)
            page.mouse.move(640, 300, steps=5)
            ends_with_one_zero(page, relay)
            page.mouse.up()
            assert relay.commands()[-1] == ZERO, event
            page.evaluate(COMING_BACK)

    def test_a_list_that_takes_the_keys(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """A key released while a list is open is not seen by the page: opening the list has ended driving
        before.
        """
        page = open_page(COCKPIT, user="driver")
        ready_to_drive(page)
        heard = "addEventListener('keyup', event => (document.body.dataset.up = event.code), true)"
        page.evaluate(heard)
        page.keyboard.down("w")
        driving(relay)
        page.get_by_label("Command topic").click()
        ends_with_one_zero(page, relay)
        expect(seen(page, "drive-words")).to_have_text("Stopped: a field or a list has the keyboard focus.")
        page.keyboard.up("w")
        page.keyboard.press("Escape")
        expect(page.locator("body[data-up=Escape]")).to_be_attached()
        ends_with_one_zero(page, relay)
        expect(page.get_by_label("Command topic")).to_be_focused()
        before = len(relay.commands())
        page.keyboard.down("w")
        driving(relay, before + 1)
        page.keyboard.up("w")
        ends_with_one_zero(page, relay)

    def test_a_list_that_the_keyboard_opens_under_the_joystick(
        self, open_page: OpenPage, relay: FakeRelay
    ) -> None:
        """The keyboard focuses a field while the mouse holds the joystick."""
        page = open_page(COCKPIT, user="driver")
        ready_to_drive(page)
        hold_joystick(page)
        driving(relay)
        page.get_by_label("Command topic").focus()
        ends_with_one_zero(page, relay)
        page.mouse.up()

    def test_a_repeated_key_that_falls_silent(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """If the system repeats keys, a key without repetitions was released unseen; it has to be pressed
        again.
        """
        page = open_page(COCKPIT, user="driver")
        ready_to_drive(page)
        page.keyboard.down("w")
        driving(relay)
        for _ in range(3):
            page.keyboard.down("w")
        expect(seen(page, "drive-words")).to_have_text("Stopped: no more key events. Press the key again.")
        page.keyboard.down("w")
        ends_with_one_zero(page, relay)
        page.keyboard.up("w")

    def test_a_key_that_is_never_repeated(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """Without key repetition one can still drive, for longer than any pause."""
        page = open_page(COCKPIT, user="driver")
        ready_to_drive(page)
        page.keyboard.down("w")
        driving(relay, 30)
        page.keyboard.up("w")
        ends_with_one_zero(page, relay)

    def test_control_that_is_lost(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """Driving ends and no command is sent, not even a zero: it would take a free robot."""
        page = open_page(COCKPIT, user="driver")
        ready_to_drive(page)
        hold_joystick(page)
        driving(relay)
        relay.do(robot=ROBOT, take_away=True)
        expect(seen(page, "drive-words")).to_contain_text("You no longer have control.")
        stands(page, "free")
        before = relay.commands()
        page.mouse.move(640, 300, steps=5)
        page.wait_for_timeout(500)  # shows absence
        assert relay.commands() == before
        page.mouse.up()

    def test_control_that_another_one_gets(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """It is free only for a moment: the driver sees the controller, not that control is free."""
        page, other = open_page(COCKPIT, user="driver"), open_page(COCKPIT, user="admin")
        ready_to_drive(page)
        stands(other, "held")
        relay.do(robot=ROBOT, take_away=True)
        expect(seen(page, "drive-words")).to_contain_text("It is free")
        take_control(other)
        expect(seen(page, "drive-words")).to_have_text("admin has control now.")

    def test_a_command_topic_that_is_gone(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """The zero is sent to the driven topic; another one is driven only after a new press."""
        page = open_page(COCKPIT, user="driver")
        ready_to_drive(page)
        hold_joystick(page)
        driving(relay)
        relay.do(gone="/cmd_vel")
        ends_with_one_zero(page, relay)
        expect(seen(page, "drive-words")).to_have_text("Stopped: the command topic was changed.")
        page.mouse.move(640, 300, steps=5)
        page.wait_for_timeout(300)  # shows absence
        assert relay.commands("/cmd_vel_nav") == []
        page.mouse.up()
        hold_joystick(page)
        relay.until(lambda: relay.commands("/cmd_vel_nav"), "no command came")
        page.mouse.up()

    def test_a_robot_that_another_user_stops(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """A stop by any user ends driving here, and shows the user."""
        page = open_page(COCKPIT, user="driver")
        ready_to_drive(page)
        hold_joystick(page)
        driving(relay)
        relay.do(robot=ROBOT, stopped="ann")
        expect(seen(page, "stopped")).to_contain_text("By ann")
        ends_with_one_zero(page, relay)
        page.mouse.up()


class TestKeys:
    def test_drive_and_stop_after_the_mouse_was_used(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """A clicked slider, list or button does not keep the keys: letters and arrows drive, space stops."""
        page = open_page(COCKPIT, user="driver")
        ready_to_drive(page)
        slider = seen(page, "limit-linear")
        slider.click()
        expect(slider).to_be_focused()
        speed = slider.input_value()
        expect(seen(page, "keys-hint")).to_contain_text("Space stops the robot for everybody.")
        for key in ("w", "ArrowUp"):
            before = len(relay.commands())
            page.keyboard.down(key)
            driving(relay, before + 3)
            page.keyboard.up(key)
            ends_with_one_zero(page, relay)
        assert slider.input_value() == speed
        seen(page, "input-gamepad").click()
        page.keyboard.press("Space")
        expect(seen(page, "stopped")).to_contain_text("By driver")
        expect(seen(page, "input-gamepad")).to_have_count(0)

    def test_belong_to_the_control_that_the_keyboard_led_to(
        self, open_page: OpenPage, relay: FakeRelay
    ) -> None:
        """Arrows move such a slider and space presses such a button; the page says so, and Esc returns the
        keys.
        """
        page = open_page(COCKPIT, user="driver")
        ready_to_drive(page)
        slider, button = seen(page, "limit-angular"), seen(page, "input-gamepad")
        slider.focus()
        speed = slider.input_value()
        page.keyboard.press("ArrowUp")
        assert slider.input_value() != speed and relay.commands() == []
        page.keyboard.press("Tab")
        expect(button).to_be_focused()
        expect(seen(page, "keys-hint")).to_contain_text("they neither drive nor stop. Esc gives them back.")
        page.keyboard.press("Space")
        expect(button).to_have_attribute("aria-pressed", "true")
        page.keyboard.press("Escape")
        expect(seen(page, "keys-hint")).to_contain_text("Space stops the robot for everybody.")
        page.keyboard.press("Space")
        expect(seen(page, "stopped")).to_contain_text("By driver")

    def test_letters_drive_while_other_controls_have_the_focus(
        self, open_page: OpenPage, relay: FakeRelay
    ) -> None:
        """A slider reached by the keyboard needs no letters; a text field needs all."""
        page = open_page(COCKPIT, user="driver")
        ready_to_drive(page)
        seen(page, "limit-linear").focus()
        page.keyboard.down("w")
        driving(relay)
        page.keyboard.up("w")
        ends_with_one_zero(page, relay)


PADS = """
  window.pad = { index: 0, id: 'Pad', connected: true, axes: [0, 0, 0, 0], timestamp: 0, mapping: 'standard',
                 buttons: Array.from({ length: 17 }, () => ({ pressed: false, touched: false, value: 0 })) }
  navigator.getGamepads = () => [window.pad, null, null, null]
"""


class TestGamepad:
    def open(self, open_page: OpenPage) -> Page:
        page = open_page("/fleet", user="driver")
        page.add_init_script(PADS)
        page.goto(COCKPIT)
        ready_to_drive(page)
        seen(page, "input-gamepad").click()
        expect(seen(page, "gamepad")).to_have_attribute("data-pad", "ready")
        return page

    def hold(self, page: Page, relay: FakeRelay) -> None:
        before = len(relay.commands())
        page.evaluate("pad.axes[1] = -1; pad.buttons[5].pressed = true")
        driving(relay, before + 3)

    def test_drives_while_the_shoulder_button_is_held(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """The stick alone moves nothing; releasing the button or unplugging the gamepad sends one zero."""
        page = self.open(open_page)
        page.evaluate("pad.axes[1] = -1")
        page.wait_for_timeout(300)  # shows absence
        assert relay.commands() == []
        self.hold(page, relay)
        assert relay.commands()[-1] == (0.5, 0)
        page.evaluate("pad.buttons[5].pressed = false")
        ends_with_one_zero(page, relay)

        self.hold(page, relay)
        page.evaluate("window.pad = null")
        ends_with_one_zero(page, relay)
        expect(seen(page, "drive-words")).to_have_text("Stopped: the gamepad was disconnected.")

    def test_controls_must_be_released_after_a_stop(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """A page that lost the focus is not driven on by a held button, nor by the gamepad's last state while
        no frames are drawn.
        """
        page = self.open(open_page)
        self.hold(page, relay)
        page.evaluate(LEAVING["blur"])
        ends_with_one_zero(page, relay)
        page.evaluate("pad.buttons[5].pressed = false")
        page.wait_for_timeout(100)  # the page sees that it was released
        self.hold(page, relay)
        page.evaluate("window.requestAnimationFrame = () => 0")
        before = len(relay.commands())
        driving(relay, before + 3)
        page.evaluate("pad.buttons[5].pressed = false")
        ends_with_one_zero(page, relay)

    def test_a_pad_with_another_layout_drives_by_a_chosen_button_only(
        self, open_page: OpenPage, relay: FakeRelay
    ) -> None:
        """Until then no button drives; the choice is stored."""
        page = self.open(open_page)
        page.evaluate("pad.mapping = ''; pad.axes[1] = -1")
        expect(seen(page, "gamepad")).to_have_attribute("data-pad", "unknown")
        page.evaluate("for (const button of [4, 5, 6, 7, 9]) pad.buttons[button].pressed = true")
        page.wait_for_timeout(300)  # shows absence
        assert relay.commands() == []
        page.evaluate("for (const button of pad.buttons) button.pressed = false")
        page.evaluate("pad.axes[1] = 0")

        seen(page, "gamepad-choose").click()
        expect(seen(page, "gamepad")).to_have_attribute("data-pad", "choosing")
        page.evaluate("pad.buttons[9].pressed = true")
        expect(seen(page, "gamepad")).to_have_attribute("data-pad", "ready")
        page.reload()
        ready_to_drive(page)
        page.evaluate("pad.mapping = ''")
        expect(seen(page, "gamepad")).to_have_attribute("data-pad", "ready")
        page.wait_for_timeout(100)  # the page sees that it was released
        page.evaluate("pad.axes[1] = -1; pad.buttons[9].pressed = true")
        driving(relay, 3)
        page.evaluate("pad.buttons[9].pressed = false")
        ends_with_one_zero(page, relay)


class TestTilt:
    def test_a_tilted_phone_drives(self, open_page: OpenPage, relay: FakeRelay) -> None:
        """Held and tilted it drives, released it stops with one zero; silent sensors stop it too."""
        page = open_page(COCKPIT, user="driver", width=390, height=844, has_touch=True, is_mobile=True)
        phone = Phone(page)
        ready_to_drive(page)
        seen(page, "input-tilt").click()
        seen(page, "tilt-ask").click()
        for leave in ("lift", "silence"):
            before = len(relay.commands())

            def driven(before: int = before) -> bool:
                return len(relay.commands()) > before + 3

            phone.hold_tilted(seen(page, "tilt-hold"), "commands come", driven, 12)
            assert max(ahead for ahead, _ in relay.commands()[before:]) == 0.5
            if leave == "lift":
                phone.lift()
            ends_with_one_zero(page, relay)
        phone.lift()
        expect(seen(page, "drive-words")).to_contain_text("no longer reports its orientation")
