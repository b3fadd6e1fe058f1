"""A phone's sensors drive the simulated robot by the portal: a real browser and relay between them."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, expect
from switchboard_browser import lived_in, ready_to_drive, seen, stands, take_control
from switchboard_household import Household, OpenPage, pages_of
from switchboard_touch import Phone
from switchboard_waiting import wait_for

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
def house(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Household]:
    """One house for all, on a field where nothing is in the way; each test leaves the robot free."""

    def on_a_field(folder: Path) -> Household:
        return Household(folder, PEOPLE, *GRACE, sim_options=("--world", "open"))

    yield from lived_in(on_a_field, tmp_path_factory.mktemp("tilt"))


@pytest.fixture
def open_page(browser: Browser, house: Household) -> Iterator[OpenPage]:
    """Opens pages of the portal for a user; an uncaught error or a breach of the CSP in any of them fails the test."""
    with pages_of(browser, house) as open_page:
        yield open_page


@pytest.fixture
def phone(open_page: OpenPage) -> Phone:
    """Ann's, which has control, and may tell the page how it is held."""
    page = open_page("ann", **PHONE)
    ready_to_drive(page)
    seen(page, "input-tilt").tap()
    allow_tilting(page)
    return Phone(page)


def allow_tilting(page: Page) -> None:
    """What a browser wants to be asked each time the button is there anew."""
    seen(page, "tilt-ask").tap()


def drive(house: Household, phone: Phone) -> int:
    """Hold the button and tilt until the robot moves, straight ahead; the moment before."""
    since = time.monotonic_ns()
    phone.hold_tilted(seen(phone.page, "tilt-hold"), "the robot moves", house.robot.moving, AHEAD)
    assert all(ahead > 0 and turn == 0 for ahead, turn in house.movements(since))
    return since


def tilt_in_vain(house: Household, phone: Phone) -> None:
    """The phone stays tilted for a moment, and nothing of it reaches the robot."""
    since = time.monotonic_ns()
    phone.tilt_until("a moment is over", lambda: time.monotonic_ns() - since > 1e9 * MOMENT_S, AHEAD)
    assert house.movements(since) == []


def stands_tilted(house: Household, phone: Phone) -> None:
    """Wait until the robot stands, while the sensors go on telling."""
    phone.tilt_until("the robot stands", lambda: not house.robot.moving(), AHEAD)


def ends_with_zero(house: Household, since: int) -> None:
    """Wait until the robot stands, and was told so last."""
    wait_for("a zero came", lambda: house.commands(since)[-1:] == [(0, 0)])
    house.stands()


def is_silent(page: Page) -> bool:
    """Whether the page says, within a while, that driving ended because of the sensors."""
    try:
        words = "the phone no longer tells how it is held"
        expect(seen(page, "drive-words")).to_contain_text(words, timeout=WORDS_MS)
    except AssertionError:
        return False
    return True


def test_it_drives_while_the_button_is_held_and_lifted_it_stands(house: Household, phone: Phone) -> None:
    """Tilted without the button it does nothing; lifted, a zero comes though the sensors go on."""
    tilt_in_vain(house, phone)
    since = drive(house, phone)
    phone.lift()
    stands_tilted(house, phone)
    ends_with_zero(house, since)
    tilt_in_vain(house, phone)
    drive(house, phone)
    phone.lift()
    stands_tilted(house, phone)


def test_sensors_that_fall_silent_make_it_stand(house: Household, phone: Phone) -> None:
    """Though the finger stays; when they tell again, the button has to be pressed anew."""
    for _ in range(5):
        since = drive(house, phone)
        ends_with_zero(house, since)
        # Else the machine was so busy that the link was late before the phone was silent.
        if is_silent(phone.page):
            break
    else:
        pytest.fail("each time the robot stood for another reason")
    tilt_in_vain(house, phone)
    phone.lift()
    drive(house, phone)
    phone.lift()
    stands_tilted(house, phone)


def test_it_moves_nothing_while_another_has_control(
    house: Household, phone: Phone, open_page: OpenPage
) -> None:
    """Taken over while it drives, the robot stands; the finger is still there, and no button under it any more."""
    laptop = open_page("olga")
    stands(laptop, "held")
    drive(house, phone)
    seen(laptop, "control-ask").click()
    seen(laptop, "control-ask-send").click()
    standing = seen(laptop, "control")
    phone.tilt_until("olga may take over", lambda: standing.get_attribute("data-standing") == "ripe", AHEAD)
    seen(laptop, "control-over").click()
    stands(laptop, "yours")
    stands_tilted(house, phone)
    expect(seen(phone.page, "drive-words")).to_contain_text("olga has control now.")
    expect(seen(phone.page, "tilt-hold")).to_have_count(0)
    tilt_in_vain(house, phone)
    phone.lift()
    house.moves_by(lambda: laptop.keyboard.down("a"), lambda: laptop.keyboard.up("a"))
    laptop.keyboard.up("a")
    house.stands()
    seen(laptop, "control-release").click()
    take_control(phone.page)
    allow_tilting(phone.page)
    drive(house, phone)
    phone.lift()
    stands_tilted(house, phone)
