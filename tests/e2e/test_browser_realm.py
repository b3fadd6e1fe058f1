"""An administrator manages their realm in the portal, in a real browser with a real relay."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Locator, Page, expect

from tests.worlds.browser import checked_pages, open_session, running_world, seen, was_notified
from tests.worlds.forked_programs import run_command
from tests.worlds.relay_process import Relay

PASSWORD = "correct horse"
WAIT_SECONDS = 60.0

GROUPS = re.compile(r"/api/v1/realm/groups$")
"""Where groups are added; lists of them are asked for with a query."""

OpenPage = Callable[..., Page]


class World:
    """A relay with an administrator ``root``, a user ``guest``, and a robot ``mower`` that has not enrolled."""

    def __init__(self, folder: Path) -> None:
        self.relay = Relay(folder)
        self.relay.user("root", admin=True)
        self.relay.user("guest")
        self.relay.cli("robot", "add", "mower", "--description", "Cuts the lawn")

    def stop(self) -> None:
        self.relay.stop()


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """One world for all; each test has robots and users of its own."""
    yield from running_world(World, tmp_path_factory.mktemp("realm"))


@pytest.fixture
def open_page(browser: Browser, world: World) -> Iterator[OpenPage]:
    """Opens pages of a logged-in user; an uncaught error or a violation of the CSP fails the test."""
    url = f"http://127.0.0.1:{world.relay.http_port}"
    with checked_pages(browser, url, WAIT_SECONDS) as new_page:

        def open_page(
            path: str, user: str = "root", password: str = PASSWORD, width: int = 1280, height: int = 800
        ) -> Page:
            page = new_page(width, height)
            open_session(page, user, password)
            page.goto(path)
            return page

        yield open_page


def log_in(page: Page, user: str, password: str = PASSWORD) -> None:
    """Submits the login form."""
    page.goto("/login")
    seen(page, "login-user").fill(user)
    seen(page, "login-password").fill(password)
    seen(page, "login-submit").click()


def row(page: Page, what: str, name: str) -> Locator:
    """The row of a robot, person or group."""
    key = "user" if what == "person" else what
    return page.locator(f"[data-testid=realm-{what}][data-{key}='{name}']")


def right(page: Page, robot: str, holder: str) -> Locator:
    """The row of a right."""
    of_robot = page.locator(f"[data-testid=rights-of][data-robot='{robot}']")
    return of_robot.locator(f"[data-testid=right][data-holder='{holder}']")


def inside(place: Locator, testid: str) -> Locator:
    """A part of a row."""
    return place.get_by_test_id(testid)


def add_user(page: Page, name: str, password: str) -> None:
    """Adds a user on the page of people."""
    seen(page, "person-add").click()
    seen(page, "person-name").fill(name)
    seen(page, "person-password").fill(password)
    seen(page, "person-add-sure").click()
    expect(row(page, "person", name)).to_be_visible()


def give(page: Page, robot: str, holder: str, level: str) -> None:
    """Gives a right on the page of rights."""
    here = page.locator(f"[data-testid=rights-of][data-robot='{robot}']")
    inside(here, "right-add-here").click()
    inside(here, "grant-who").fill(holder)
    inside(inside(here, "grant-form"), f"level-{level}").click()
    inside(here, "grant-sure").click()
    expect(right(page, robot, holder)).to_have_attribute("data-level", level)


def test_a_robot_is_added_and_enrols_by_the_command_that_is_shown(
    world: World, open_page: OpenPage, tmp_path: Path
) -> None:
    """Errors of a name are shown beside it; the code enrols the robot, and its key is listed and retired."""
    page = open_page("/fleet")
    seen(page, "realm-link").click()
    seen(page, "robot-add").click()
    seen(page, "robot-name").fill("Rover One")
    seen(page, "robot-description").fill("In the hall")
    seen(page, "robot-add-sure").click()
    expect(seen(page, "realm-problem")).to_contain_text("lower-case letters")
    expect(seen(page, "robot-description")).to_have_value("In the hall")
    seen(page, "robot-name").fill("mower")
    seen(page, "robot-add-sure").click()
    expect(seen(page, "realm-problem")).to_contain_text("The robot 'mower' exists already")
    seen(page, "robot-name").fill("rover-one")
    # A robot that is not shared enrols as well.
    seen(page, "realm-search").fill("nothing like it")
    expect(row(page, "robot", "mower")).to_have_count(0)
    seen(page, "robot-add-sure").click()

    expect(seen(page, "realm-code-until")).to_contain_text(re.compile(r"Valid until .+, for 15 minutes"))
    command = shlex.split(seen(page, "realm-command").inner_text())
    command[command.index("--state") + 1] = str(tmp_path / "state")
    done = run_command(command, stdin=seen(page, "realm-code-text").inner_text() + "\n")
    assert done.returncode == 0, done.stderr
    expect(seen(page, "realm-code-until")).to_contain_text("has enrolled")
    seen(page, "realm-code-done").click()

    seen(page, "realm-search").fill("")
    robot = row(page, "robot", "rover-one")
    expect(robot).to_contain_text("1 live key")
    inside(robot, "robot-show-keys").click()
    inside(robot, "key-retire").click()
    inside(robot, "realm-sure").click()
    expect(inside(robot, "realm-key")).to_contain_text("retired")
    expect(inside(robot, "robot-keys")).to_have_text("Not enrolled yet")


def test_enrolment_is_published(world: World, open_page: OpenPage, tmp_path: Path) -> None:
    """The third one retires the oldest of two live keys, so their number stays the same."""
    world.relay.cli("robot", "add", "veteran")
    page = open_page("/realm/robots")
    robot = row(page, "robot", "veteran")
    for number in range(3):
        inside(robot, "robot-code").click()
        command = shlex.split(inside(robot, "realm-command").inner_text())
        command[command.index("--state") + 1] = str(tmp_path / f"state-{number}")
        done = run_command(command, stdin=inside(robot, "realm-code-text").inner_text() + "\n")
        assert done.returncode == 0, done.stderr
        expect(inside(robot, "realm-code-until")).to_contain_text("has enrolled")
        inside(robot, "realm-code-done").click()
    expect(inside(robot, "robot-keys")).to_have_text("2 live keys")


def test_rights_that_can_not_be_loaded_are_marked_as_old(world: World, open_page: OpenPage) -> None:
    """Rights of one user must not be taken for those of another."""
    world.relay.user("daisy")
    world.relay.cli("right", "grant", "daisy", "mower", "viewer")
    page = open_page("/realm/rights")
    expect(right(page, "mower", "daisy")).to_be_visible()
    page.route("**/api/v1/realm/rights?*", lambda route: route.abort())
    seen(page, "rights-who").fill("toad")
    expect(seen(page, "realm-problem")).to_be_visible()


def test_a_robot_is_removed_after_a_warning_about_what_is_removed_with_it(
    world: World, open_page: OpenPage
) -> None:
    """The dialog lists what is removed; one press cancels it; a new code is shown until then."""
    world.relay.cli("robot", "add", "old-one")
    page = open_page("/realm/robots")
    robot = row(page, "robot", "old-one")
    inside(robot, "robot-code").click()
    expect(inside(robot, "realm-code-text")).to_have_text(re.compile(r"\S{8,}"))
    inside(robot, "robot-remove").click()
    expect(robot).to_contain_text("All rights on it and its recordings go with it")
    inside(robot, "realm-keep").click()
    expect(robot).to_be_visible()
    inside(robot, "robot-remove").click()
    inside(robot, "realm-sure").click()
    expect(robot).to_have_count(0)
    expect(row(page, "robot", "mower")).to_be_visible()


@pytest.mark.parametrize("width", [1280, 390])
def test_a_user_gets_a_right_and_loses_it(world: World, open_page: OpenPage, width: int) -> None:
    """A user added with a password sees the robot only with the right; all pages fit a phone."""
    name = f"luigi-{width}"
    page = open_page("/realm/people", width=width)
    add_user(page, name, "it is me again")
    seen(page, "realm-rights").click()
    give(page, "mower", name, "operator")
    assert page.evaluate("document.documentElement.scrollWidth - innerWidth") <= 0

    other = open_page("/fleet", name, "it is me again")
    card = other.locator("[data-testid=robot-card][data-robot=mower]")
    expect(card).to_contain_text(re.compile("operator", re.IGNORECASE))
    inside(right(page, "mower", name), "right-revoke").click()
    inside(right(page, "mower", name), "realm-sure").click()
    expect(right(page, "mower", name)).to_have_count(0)
    expect(card).to_have_count(0)
    expect(seen(other, "fleet-empty")).to_be_visible()


def test_a_right_is_changed_in_place_and_not_lost_by_accident(world: World, open_page: OpenPage) -> None:
    """Another level keeps the patterns; a second right asks for confirmation, and an invalid pattern shows an
    error.
    """
    for name in ("ann", "bob"):
        world.relay.user(name)
    world.relay.cli("right", "grant", "ann", "mower", "viewer", "--deny", "call:/blade")
    world.relay.cli("right", "grant", "bob", "mower", "viewer")
    page = open_page("/realm/rights?who=ann")
    ann = right(page, "mower", "ann")
    expect(ann).to_have_attribute("data-level", "viewer")
    expect(right(page, "mower", "bob")).to_have_count(0)
    inside(ann, "level-owner").click()
    expect(ann).to_have_attribute("data-level", "owner")
    expect(inside(ann, "right-denied")).to_contain_text("call:/blade")

    inside(ann, "right-edit").click()
    inside(ann, "right-allow").fill("mow:/lawn")
    inside(ann, "right-save").click()
    expect(inside(ann, "realm-problem")).to_contain_text("'mow:/lawn' is not a pattern")
    expect(inside(ann, "right-allow")).to_have_value("mow:/lawn")
    inside(ann, "right-allow").fill("call:/mow")
    inside(ann, "right-save").click()
    expect(inside(ann, "right-allowed")).to_contain_text("call:/mow")

    seen(page, "right-add").click()
    form = page.locator("form[data-testid=grant-form]")
    expect(inside(form, "grant-who")).to_have_value("ann")
    inside(form, "grant-robot").fill("mower")
    inside(form, "grant-sure").click()
    expect(seen(page, "grant-before")).to_contain_text("owner; call:/mow allowed; call:/blade denied")
    expect(ann).to_have_attribute("data-level", "owner")
    inside(form, "grant-sure").click()
    expect(ann).to_have_attribute("data-level", "viewer")
    expect(inside(ann, "right-denied")).to_have_count(0)


def test_two_administrators_do_not_overwrite_each_other(world: World, open_page: OpenPage) -> None:
    """A conflict shows a message and the present state; typed text is kept."""
    for name in ("bowser", "yoshi"):
        world.relay.user(name)
    world.relay.cli("right", "grant", "bowser", "mower", "viewer")
    page = open_page("/realm/rights")
    bowser = right(page, "mower", "bowser")
    inside(bowser, "right-edit").click()
    inside(bowser, "right-allow").fill("call:/mow")
    world.relay.cli("right", "grant", "bowser", "mower", "operator", "--deny", "call:/blade")
    inside(bowser, "right-save").click()
    expect(inside(bowser, "realm-problem")).to_contain_text("Another user has changed this")
    expect(bowser).to_have_attribute("data-level", "operator")
    expect(inside(bowser, "right-denied")).to_contain_text("call:/blade")
    expect(inside(bowser, "right-allow")).to_have_value("call:/mow")
    inside(bowser, "right-save").click()
    expect(inside(bowser, "right-allowed")).to_contain_text("call:/mow")
    expect(bowser).to_have_attribute("data-level", "operator")

    world.relay.cli("right", "revoke", "bowser", "mower")
    inside(bowser, "level-owner").click()
    was_notified(page, "Another user has removed this")
    expect(bowser).to_have_count(0)

    page.goto("/realm/people")
    yoshi = row(page, "person", "yoshi")
    inside(yoshi, "person-manage").click()
    world.relay.cli("user", "disable", "yoshi")
    inside(yoshi, "person-make-admin").click()
    expect(inside(yoshi, "realm-problem")).to_contain_text("Another user has changed this")
    expect(yoshi).to_contain_text("Disabled")
    expect(yoshi).not_to_contain_text("Administrator")
    inside(yoshi, "person-make-admin").click()
    expect(yoshi).to_contain_text("Administrator")


def test_group_is_listed_with_rights_and_members(world: World, open_page: OpenPage) -> None:
    """A group is added, filled, given a right and removed with its right."""
    world.relay.user("mario")
    page = open_page("/realm/groups")
    seen(page, "group-add").click()
    seen(page, "group-name").fill("crew")
    seen(page, "group-add-sure").click()
    group = row(page, "group", "crew")
    inside(group, "group-who").fill("nobody-of-this-name")
    inside(group, "group-join").click()
    expect(inside(group, "realm-problem")).to_contain_text("no such user")
    expect(inside(group, "group-who")).to_have_value("nobody-of-this-name")
    for name in ("mario", "guest"):
        inside(group, "group-who").fill(name)
        inside(group, "group-join").click()
        expect(group.locator(f"[data-testid=group-member][data-user={name}]")).to_be_visible()
    inside(group.locator("[data-user=guest]"), "group-leave").click()
    expect(inside(group, "group-member")).to_have_text(["mario"])

    seen(page, "realm-rights").click()
    give(page, "mower", "@crew", "viewer")
    expect(right(page, "mower", "@crew")).to_contain_text("mario")
    page.goto("/realm/rights?who=mario")
    expect(right(page, "mower", "@crew")).to_be_visible()
    page.goto("/realm/groups")
    inside(group, "group-remove").click()
    inside(group, "realm-sure").click()
    expect(group).to_have_count(0)
    page.goto("/realm/rights")
    expect(page.locator("[data-testid=rights-of][data-robot=mower]")).to_be_visible()
    expect(right(page, "mower", "@crew")).to_have_count(0)


def test_users_are_disabled_enabled_and_made_administrators(world: World, open_page: OpenPage) -> None:
    """Another user gets a new password, and sessions are revoked at once; administrators cannot remove
    themselves.
    """
    world.relay.user("peach")
    other = open_page("/fleet", "peach")
    page = open_page("/realm/people")
    peach = row(page, "person", "peach")
    inside(peach, "person-manage").click()
    session = peach.locator("[data-testid=realm-token][data-kind=session]")
    inside(session, "token-revoke").click()
    expect(session).to_have_count(0)
    expect(seen(other, "login-submit")).to_be_visible()

    inside(peach, "person-new-password").fill("short")
    inside(peach, "person-set-password").click()
    expect(inside(peach, "realm-problem")).to_contain_text("8 characters")
    inside(peach, "person-new-password").fill("another castle")
    inside(peach, "person-set-password").click()
    was_notified(page, "peach has a new password")
    inside(peach, "person-disable").click()
    expect(peach).to_contain_text("Disabled")
    log_in(other, "peach", "another castle")
    expect(seen(other, "login-error")).to_be_visible()
    inside(peach, "person-enable").click()
    inside(peach, "person-make-admin").click()
    expect(peach).to_contain_text("Administrator")

    log_in(other, "peach", "another castle")
    expect(seen(other, "realm-link")).to_be_visible()
    other.goto("/realm/people")
    own = row(other, "person", "peach")
    inside(own, "person-manage").click()
    for each in ("person-no-admin", "person-disable", "person-remove"):
        expect(inside(own, each)).to_be_disabled()

    inside(peach, "person-remove").click()
    inside(peach, "realm-sure").click()
    expect(peach).to_have_count(0)
    expect(seen(other, "login-submit")).to_be_visible()


def test_a_long_list_is_shown_in_parts_and_filtered_by_name(world: World, open_page: OpenPage) -> None:
    """The filter finds entries beyond the shown part."""
    for number in range(101):
        world.relay.cli("group", "add", f"many-{number:03d}")
    page = open_page("/realm/groups")
    expect(seen(page, "realm-group")).to_have_count(100)
    seen(page, "realm-more").click()
    expect(row(page, "group", "many-100")).to_be_visible()
    expect(seen(page, "realm-more")).to_have_count(0)
    seen(page, "realm-search").fill("Y-07")
    expect(seen(page, "realm-group")).to_have_count(10)
    seen(page, "realm-search").fill("many-0?0")
    expect(seen(page, "realm-group")).to_have_count(10)
    seen(page, "realm-search").fill("nothing of this")
    expect(seen(page, "realm-empty")).to_contain_text("Nothing matches")


def test_too_many_changes_are_refused_with_retry_after(open_page: OpenPage) -> None:
    """Typed text is kept, and a later press succeeds."""
    page = open_page("/realm/groups")
    problem = {"title": "Too Many Requests", "status": 429, "detail": "this realm is changed too often"}
    refused = {"status": 429, "headers": {"Retry-After": "2"}, "json": problem}
    page.route(GROUPS, lambda route: route.fulfill(**refused), times=1)
    seen(page, "group-add").click()
    seen(page, "group-name").fill("hasty")
    seen(page, "group-add-sure").click()
    expect(seen(page, "realm-problem")).to_have_text("This realm is changed too often. Wait 2 seconds.")
    expect(seen(page, "group-name")).to_have_value("hasty")
    seen(page, "group-add-sure").click()
    expect(row(page, "group", "hasty")).to_be_visible()


def test_users_without_the_right_see_a_refusal(open_page: OpenPage) -> None:
    """Neither the bar nor the menu has a link; the address shows the reason."""
    page = open_page("/fleet", "guest")
    expect(seen(page, "alerts-link")).to_be_visible()
    expect(seen(page, "realm-link")).to_have_count(0)
    seen(page, "user-menu").click()
    expect(seen(page, "logout")).to_be_visible()
    expect(seen(page, "realm-menu-link")).to_have_count(0)
    page.goto("/realm/rights")
    expect(page.get_by_text("You are not an administrator of this realm")).to_be_visible()
    expect(seen(page, "right-add")).to_have_count(0)
