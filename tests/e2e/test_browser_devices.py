"""One robot on a laptop, a tablet and a phone at the same time: real browser and relay, simulated robot."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
from playwright.sync_api import Browser, Page, expect

from tests.worlds.browser import SMALL_CAMERA, picture, running_world, seen, stands, take_control
from tests.worlds.portal_relay import OpenPage, PortalWorld, pages_of
from tests.worlds.touch import TouchPointer
from tests.worlds.waiting import wait_for

PEOPLE = {"ann": "operator", "bob": "operator", "vera": "viewer"}

ASIDE = -60
"""Pixels: so far to the left the joystick turns the robot on the spot."""


class Devices(NamedTuple):
    """The users' devices with open cockpits."""

    laptop: Page
    tablet: Page
    phone: Page


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[PortalWorld]:
    """One world for all; each test leaves the robot without a controller and not stopped."""

    def with_camera(folder: Path) -> PortalWorld:
        return PortalWorld(folder, PEOPLE, camera=True, sim_options=SMALL_CAMERA)

    yield from running_world(with_camera, tmp_path_factory.mktemp("devices"))


@pytest.fixture
def devices(browser: Browser, world: PortalWorld) -> Iterator[Devices]:
    """Ann has a laptop, Bob a tablet, and Vera, a viewer, a phone."""
    with pages_of(browser, world) as open_page:
        yield opened(open_page)


def opened(open_page: OpenPage) -> Devices:
    """The connected cockpit on each device."""
    made = Devices(
        open_page("ann"),
        open_page("bob", width=820, height=1180, has_touch=True),
        open_page("vera", width=390, height=844, has_touch=True, is_mobile=True),
    )
    for page in made:
        expect(seen(page, "link-state")).to_have_attribute("data-state", "open")
        expect(seen(page, "person")).to_have_count(3)
    return made


def holder_is(devices: Devices, user: str) -> None:
    """Waits until each device shows the controller."""
    for page, mine in zip(devices, PEOPLE, strict=True):
        words = "You have control" if mine == user else f"{user} has control"
        expect(seen(page, "holder")).to_have_text(words)
        expect(page.locator(f"[data-testid=person][data-user={user}]")).to_contain_text("has control")


def picture_moves(page: Page) -> None:
    """Waits until the camera's picture is live and has changed."""
    expect(seen(page, "camera-fps")).to_have_text(re.compile(r"[1-9]\d* fps"))
    before = picture(page, "camera-canvas")
    wait_for("the picture moves", lambda: picture(page, "camera-canvas") != before)


def show_motion(devices: Devices) -> None:
    """Waits until each device shows that the robot turns."""
    for page in devices:
        expect(seen(page, "odom-turn")).not_to_have_text(re.compile(r"^[-−]?0\.00$"))


def show_the_same(devices: Devices) -> None:
    """Waits until each device shows the robot standing, at the same place and heading."""

    def shown(page: Page) -> tuple[str, ...]:
        return tuple(seen(page, f"odom-{each}").inner_text() for each in ("x", "y", "heading", "speed"))

    def same() -> bool:
        reported = {shown(page) for page in devices}
        return len(reported) == 1 and re.fullmatch(r"[-−]?\d+\.\d\d", min(reported)[0]) is not None

    wait_for("all show the same", same)


def key_turns(world: PortalWorld, page: Page) -> None:
    """Holds a key of the laptop until the robot moves."""
    world.moves_by(lambda: page.keyboard.down("a"), lambda: page.keyboard.up("a"))


def finger_turns(world: PortalWorld, page: Page, finger: TouchPointer) -> None:
    """Drags the joystick with a finger until the robot moves."""
    world.moves_by(lambda: finger.press(seen(page, "joystick"), dx=ASIDE), finger.lift)


def test_all_see_the_same_robot_live(world: PortalWorld, devices: Devices) -> None:
    """Video changes on each, and the shown position is the same before and after a drive."""
    for page in devices:
        picture_moves(page)
    show_the_same(devices)
    take_control(devices.laptop)
    key_turns(world, devices.laptop)
    show_motion(devices)
    devices.laptop.keyboard.up("a")
    world.stands()
    show_the_same(devices)


def test_control_goes_from_the_laptop_to_the_tablet(world: PortalWorld, devices: Devices) -> None:
    """All see the controller. After a granted request the tablet drives, and the laptop's keys do not."""
    laptop, tablet, phone = devices
    take_control(laptop)
    holder_is(devices, "ann")
    stands(phone, "held|watching")
    key_turns(world, laptop)
    seen(tablet, "control-ask").tap()
    seen(tablet, "control-ask-send").tap()
    stands(tablet, "waiting")
    expect(seen(laptop, "control-request")).to_contain_text("bob requests control.")
    seen(laptop, "control-grant").click()
    holder_is(devices, "bob")
    world.stands()
    laptop.keyboard.up("a")
    since = time.monotonic_ns()
    laptop.keyboard.press("a")
    laptop.wait_for_timeout(500)  # shows absence: a client without control moves nothing
    assert world.movements(since) == []
    finger = TouchPointer(tablet)
    finger_turns(world, tablet, finger)
    show_motion(devices)
    finger.lift()
    world.stands()
    turns = world.movements(since)
    assert turns and all(turn > 0 for _, turn in turns), "pulled to the left it turns left"


def test_the_phone_stops_the_robot_for_all(world: PortalWorld, devices: Devices) -> None:
    """The viewer stops the driver; each device shows the viewer's name, and the controller's touch resumes."""
    laptop, tablet, phone = devices
    take_control(tablet)
    holder_is(devices, "bob")
    finger = TouchPointer(tablet)
    finger_turns(world, tablet, finger)
    seen(phone, "stop").tap()
    world.stands()
    for page in devices:
        expect(seen(page, "stopped")).to_contain_text("The robot is stopped. By vera")
    for page in (laptop, phone):
        expect(seen(page, "resume")).to_have_count(0)
        expect(seen(page, "resume-who")).to_have_text("bob, who has control, or an owner can resume it.")
    finger.lift()
    since = time.monotonic_ns()
    finger.press(seen(tablet, "joystick"), dx=ASIDE)
    tablet.wait_for_timeout(500)  # shows absence: a stopped robot cannot be driven
    assert world.movements(since) == []
    finger.lift()

    finger.press(seen(tablet, "resume"))
    for page in devices:
        expect(seen(page, "stopped")).to_have_count(0)
    finger.lift()
    finger_turns(world, tablet, finger)
    finger.lift()
    world.stands()
