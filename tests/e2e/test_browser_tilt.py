"""A phone's sensors drive the simulated robot by the portal, with a real browser and relay."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, expect

from tests.worlds.browser import ready_to_drive, running_world, seen, stands, take_control
from tests.worlds.portal_relay import OpenPage, PortalWorld, pages_of
from tests.worlds.touch import Phone
from tests.worlds.waiting import wait_for

PEOPLE = {"ann": "operator", "olga": "owner"}
GRACE = ("--control-grace", "1")
PHONE: dict[str, Any] = {"width": 390, "height": 844, "has_touch": True, "is_mobile": True}

AHEAD = 12.0
"""Degrees by which the upper edge is raised when the phone is tilted forwards as far as it counts."""

MOMENT_S = 0.5
"""Seconds that prove an absence: a phone whose button is held is obeyed after a fifth of that."""

WORDS_MS = 5000
"""Milliseconds for what the page shows at once."""


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[PortalWorld]:
    """One world for all, without obstacles; each test leaves the robot without a controller."""

    def on_a_field(folder: Path) -> PortalWorld:
        return PortalWorld(folder, PEOPLE, *GRACE, sim_options=("--world", "open"))

    yield from running_world(on_a_field, tmp_path_factory.mktemp("tilt"))


@pytest.fixture
def open_page(browser: Browser, world: PortalWorld) -> Iterator[OpenPage]:
    """Opens pages of the portal for a user; an uncaught error or a violation of the CSP in any of them fails
    the test.
    """
    with pages_of(browser, world) as open_page:
        yield open_page


@pytest.fixture
def phone(open_page: OpenPage) -> Phone:
    """Ann's phone, with control and permission to read its sensors."""
    page = open_page("ann", **PHONE)
    phone = Phone(page)
    ready_to_drive(page)
    seen(page, "input-tilt").tap()
    allow_tilting(page)
    return phone


def allow_tilting(page: Page) -> None:
    """Gives the permission that a browser asks for whenever the button appears."""
    seen(page, "tilt-ask").tap()


def drive(world: PortalWorld, phone: Phone) -> int:
    """Holds the button and tilts until the robot moves straight ahead; returns the time before."""
    since = time.monotonic_ns()
    phone.hold_tilted(seen(phone.page, "tilt-hold"), "the robot moves", world.robot.moving, AHEAD)
    assert all(ahead > 0 and turn == 0 for ahead, turn in world.movements(since))
    return since


def tilt_without_effect(world: PortalWorld, phone: Phone) -> None:
    """The phone stays tilted for a moment, and no command reaches the robot."""
    since = time.monotonic_ns()
    phone.tilt_until("a moment is over", lambda: time.monotonic_ns() - since > 1e9 * MOMENT_S, AHEAD)
    assert world.movements(since) == []


def stands_tilted(world: PortalWorld, phone: Phone) -> None:
    """Waits until the robot stands, while the sensors go on."""
    phone.tilt_until("the robot stands", lambda: not world.robot.moving(), AHEAD)


def ends_with_zero(world: PortalWorld, since: int) -> None:
    """Waits until the robot stands, with a zero as last command."""
    wait_for("a zero came", lambda: world.commands(since)[-1:] == [(0, 0)])
    world.stands()


def is_silent(page: Page) -> bool:
    """Whether the page shows in time that the sensors ended the drive."""
    try:
        words = "the phone no longer reports its orientation"
        expect(seen(page, "drive-words")).to_contain_text(words, timeout=WORDS_MS)
    except AssertionError:
        return False
    return True


def test_it_drives_while_the_button_is_held_and_lifted_it_stands(world: PortalWorld, phone: Phone) -> None:
    """Tilting without the button has no effect; releasing it sends zero though the sensors go on."""
    tilt_without_effect(world, phone)
    since = drive(world, phone)
    phone.lift()
    stands_tilted(world, phone)
    ends_with_zero(world, since)
    tilt_without_effect(world, phone)
    drive(world, phone)
    phone.lift()
    stands_tilted(world, phone)


def test_sensors_that_fall_silent_make_it_stand(world: PortalWorld, phone: Phone) -> None:
    """Even with the finger on the button; when the sensors are back, the button has to be pressed again."""
    for _ in range(5):
        since = drive(world, phone)
        ends_with_zero(world, since)
        # Otherwise the machine was so busy that the link was late before the sensors were silent.
        if is_silent(phone.page):
            break
    else:
        pytest.fail("each time the robot stood for another reason")
    tilt_without_effect(world, phone)
    phone.lift()
    drive(world, phone)
    phone.lift()
    stands_tilted(world, phone)


def test_it_moves_nothing_while_another_has_control(
    world: PortalWorld, phone: Phone, open_page: OpenPage
) -> None:
    """After a takeover during the drive the robot stands; the button disappears under the finger."""
    laptop = open_page("olga")
    stands(laptop, "held")
    drive(world, phone)
    seen(laptop, "control-ask").click()
    seen(laptop, "control-ask-send").click()
    standing = seen(laptop, "control")
    phone.tilt_until(
        "olga may take over", lambda: standing.get_attribute("data-state") == "may_take_over", AHEAD
    )
    seen(laptop, "control-over").click()
    stands(laptop, "yours")
    stands_tilted(world, phone)
    expect(seen(phone.page, "drive-words")).to_contain_text("olga has control now.")
    expect(seen(phone.page, "tilt-hold")).to_have_count(0)
    tilt_without_effect(world, phone)
    phone.lift()
    world.moves_by(lambda: laptop.keyboard.down("a"), lambda: laptop.keyboard.up("a"))
    laptop.keyboard.up("a")
    world.stands()
    seen(laptop, "control-release").click()
    take_control(phone.page)
    allow_tilting(phone.page)
    drive(world, phone)
    phone.lift()
    stands_tilted(world, phone)
