"""One robot on a laptop, a tablet and a phone at the same time: a real browser, relay and simulated robot."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
from playwright.sync_api import Browser, Page, expect
from switchboard_browser import lived_in, picture, seen, stands, take_control
from switchboard_household import Household, OpenPage, pages_of
from switchboard_touch import Finger
from switchboard_waiting import wait_for

PEOPLE = {"ann": "operator", "bob": "operator", "vera": "viewer"}
CAMERA = ("--camera-size", "320x240", "--camera-fps", "5")

ASIDE = -60
"""Pixels: so far to the left the joystick turns the robot on the spot."""


class Devices(NamedTuple):
    """Whose cockpit is open on what."""

    laptop: Page
    tablet: Page
    phone: Page


@pytest.fixture(scope="module")
def house(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Household]:
    """One house for all; each test leaves the robot free, and able to move."""

    def with_camera(folder: Path) -> Household:
        return Household(folder, PEOPLE, camera=True, sim_options=CAMERA)

    yield from lived_in(with_camera, tmp_path_factory.mktemp("devices"))


@pytest.fixture
def devices(browser: Browser, house: Household) -> Iterator[Devices]:
    """Ann has a laptop, Bob a tablet, and Vera, who may only look, a phone."""
    with pages_of(browser, house) as open_page:
        yield opened(open_page)


def opened(open_page: OpenPage) -> Devices:
    """The cockpit on each, connected."""
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
    """Wait until each device shows who has control."""
    for page, mine in zip(devices, PEOPLE, strict=True):
        words = "You have control" if mine == user else f"{user} has control"
        expect(seen(page, "holder")).to_have_text(words)
        expect(page.locator(f"[data-testid=person][data-user={user}]")).to_contain_text("has control")


def picture_moves(page: Page) -> None:
    """Wait until the camera's picture is live, and another one than it was."""
    expect(seen(page, "camera-fps")).to_have_text(re.compile(r"[1-9]\d* fps"))
    before = picture(page, "camera-canvas")
    wait_for("the picture moves", lambda: picture(page, "camera-canvas") != before)


def show_motion(devices: Devices) -> None:
    """Wait until each device shows that the robot turns."""
    for page in devices:
        expect(seen(page, "odom-turn")).not_to_have_text(re.compile(r"^[-−]?0\.00$"))


def show_the_same(devices: Devices) -> None:
    """Wait until each device shows the robot standing, in the same place and direction."""

    def shown(page: Page) -> tuple[str, ...]:
        return tuple(seen(page, f"odom-{each}").inner_text() for each in ("x", "y", "heading", "speed"))

    def same() -> bool:
        told = {shown(page) for page in devices}
        return len(told) == 1 and re.fullmatch(r"[-−]?\d+\.\d\d", min(told)[0]) is not None

    wait_for("all show the same", same)


def key_turns(house: Household, page: Page) -> None:
    """Hold a key of the laptop until the robot moves."""
    house.moves_by(lambda: page.keyboard.down("a"), lambda: page.keyboard.up("a"))


def finger_turns(house: Household, page: Page, finger: Finger) -> None:
    """Pull the joystick with a finger until the robot moves."""
    house.moves_by(lambda: finger.press(seen(page, "joystick"), dx=ASIDE), finger.lift)


def test_all_see_the_same_robot_live(house: Household, devices: Devices) -> None:
    """Its picture moves on each, and where it stands is the same, before it is driven and afterwards."""
    for page in devices:
        picture_moves(page)
    show_the_same(devices)
    take_control(devices.laptop)
    key_turns(house, devices.laptop)
    show_motion(devices)
    devices.laptop.keyboard.up("a")
    house.stands()
    show_the_same(devices)


def test_control_goes_from_the_laptop_to_the_tablet(house: Household, devices: Devices) -> None:
    """All see who has it; asked for and granted, a finger on the tablet drives, and the laptop's keys no more."""
    laptop, tablet, phone = devices
    take_control(laptop)
    holder_is(devices, "ann")
    stands(phone, "held|watching")
    key_turns(house, laptop)
    seen(tablet, "control-ask").tap()
    seen(tablet, "control-ask-send").tap()
    stands(tablet, "waiting")
    expect(seen(laptop, "control-request")).to_contain_text("bob asks for control.")
    seen(laptop, "control-grant").click()
    holder_is(devices, "bob")
    house.stands()
    laptop.keyboard.up("a")
    since = time.monotonic_ns()
    laptop.keyboard.press("a")
    laptop.wait_for_timeout(500)  # proves absence: who has no control moves nothing
    assert house.movements(since) == []
    finger = Finger(tablet)
    finger_turns(house, tablet, finger)
    show_motion(devices)
    finger.lift()
    house.stands()
    turns = house.movements(since)
    assert turns and all(turn > 0 for _, turn in turns), "pulled to the left it turns left"


def test_the_phone_stops_the_robot_for_all(house: Household, devices: Devices) -> None:
    """Who may only look stops who drives; each shows by whom, and the finger of who has control resumes."""
    laptop, tablet, phone = devices
    take_control(tablet)
    holder_is(devices, "bob")
    finger = Finger(tablet)
    finger_turns(house, tablet, finger)
    seen(phone, "stop").tap()
    house.stands()
    for page in devices:
        expect(seen(page, "stopped")).to_contain_text("The robot is stopped. By vera")
    for page in (laptop, phone):
        expect(seen(page, "resume")).to_have_count(0)
        expect(seen(page, "resume-who")).to_have_text("bob, who has control, or an owner can resume it.")
    finger.lift()
    since = time.monotonic_ns()
    finger.press(seen(tablet, "joystick"), dx=ASIDE)
    tablet.wait_for_timeout(500)  # proves absence: a stopped robot is driven by nobody
    assert house.movements(since) == []
    finger.lift()

    finger.press(seen(tablet, "resume"))
    for page in devices:
        expect(seen(page, "stopped")).to_have_count(0)
    finger.lift()
    finger_turns(house, tablet, finger)
    finger.lift()
    house.stands()
