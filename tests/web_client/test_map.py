"""The map in the cockpit: one page, with a fake relay whose robot starts Nav2 while the page is open."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import pytest
from playwright.sync_api import Browser, Page, expect

from tests.worlds.accessibility import violations
from tests.worlds.browser import checked_pages, open_session, picture, seen, take_control

if TYPE_CHECKING:
    FakeRelay = Any

PASSWORD = "correct horse"
WAIT_SECONDS = 60.0
COSTMAP = "/global_costmap/costmap"
OPERATOR = {"user": "driver", "robot": "rover-1", "level": "operator"}


@pytest.fixture(scope="module")
def page(browser: Browser, shared_relay: FakeRelay) -> Iterator[Page]:
    with checked_pages(browser, shared_relay.url, WAIT_SECONDS) as new_page:
        page = new_page(1280, 900)
        open_session(page, "driver", PASSWORD)
        page.goto("/cockpit/rover-1")
        seen(page, "map").scroll_into_view_if_needed()
        yield page


@pytest.fixture
def nav2(shared_relay: FakeRelay, page: Page) -> FakeRelay:
    """The relay; its robot runs Nav2, is not stopped and has no goal."""
    shared_relay.do(navigation=True)
    shared_relay.do(robot="rover-1", resumed=True, no_path=False)
    expect(seen(page, "map-canvas")).to_have_attribute("data-map", "drawn")
    return shared_relay


def goals(relay: FakeRelay) -> list[dict[str, Any]]:
    return [entry["args"]["pose"] for entry in relay.log(op="send_action_goal")]


def drag(page: Page, dx: float, dy: float) -> None:
    """Presses right of the middle of the map, drags, and releases."""
    seen(page, "map-canvas").scroll_into_view_if_needed()
    box = seen(page, "map-canvas").bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2 + 40, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + dx, y + dy, steps=4)
    page.mouse.up()


def send_by_numbers(page: Page, x: float, y: float, degrees: float) -> None:
    seen(page, "goal-set").click()
    for field, value in (("x", x), ("y", y), ("degrees", degrees)):
        seen(page, f"goal-{field}").fill(str(value))
    seen(page, "goal-send").click()


COUNT_PIXELS = """(canvas, colour) => {
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height)
  let count = 0
  for (let i = 0; i < data.length; i += 4) {
    const r = data[i], g = data[i + 1], b = data[i + 2]
    count += colour === "amber" ? r > 180 && g > 130 && b < 120 : g - r > 40 && b > g
  }
  return count
}"""
"""The path is amber; the scan, the trail and the robot's ring are cyan."""
LAYER_PIXELS = 250
"""On the enlarged map the ring has about half as many; the scan has more, and so has the trail soon."""


def pixels(page: Page, colour: str) -> int:
    return int(seen(page, "map-canvas").evaluate(COUNT_PIXELS, colour))


def test_without_nav2_there_is_a_scan_and_no_goal_button(page: Page) -> None:
    expect(seen(page, "map-notes")).to_contain_text("publishes no map")
    expect(seen(page, "map-pose")).to_contain_text("Robot at −1.00, 0.00 m, heading 0°, in the frame odom")
    expect(seen(page, "goal-blocked")).to_contain_text("no navigate_to_pose action")
    expect(seen(page, "goal-set")).to_have_count(0)


@pytest.mark.parametrize("width", [390, 1280])
def test_map_and_pose_in_its_frame(page: Page, nav2: FakeRelay, width: int) -> None:
    page.set_viewport_size({"width": width, "height": 900})
    expect(seen(page, "map-pose")).to_contain_text("Robot at 10.00, 4.00 m, heading 90°, in the frame map")
    expect(seen(page, "map-notes")).to_have_count(0)
    assert violations(page) == []
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")


def test_the_costmap_is_received_only_while_it_is_shown(page: Page, nav2: FakeRelay) -> None:
    assert nav2.log(op="subscribe", topic=COSTMAP) == []
    seen(page, "layer-costmap").select_option(COSTMAP)
    expect(seen(page, "map-canvas")).to_have_attribute("data-costmap", "drawn")
    seen(page, "layer-costmap").select_option("")
    expect(seen(page, "map-canvas")).to_have_attribute("data-costmap", "none")
    nav2.until(lambda: nav2.log(op="unsubscribe", topic=COSTMAP), "the costmap was not unsubscribed")
    [subscribed] = nav2.log(op="subscribe", topic=COSTMAP)
    assert (subscribed["throttle_rate"], subscribed["queue_length"]) == (1000, 1)


def test_the_view_is_moved_enlarged_and_fitted(page: Page, nav2: FakeRelay) -> None:
    def changes(act: Any) -> None:
        before = picture(page, "map-canvas")
        act()
        nav2.until(lambda: picture(page, "map-canvas") != before, "the view did not change")

    seen(page, "layer-scan").uncheck()
    seen(page, "layer-trail").uncheck()
    changes(lambda: seen(page, "map-in").click())
    changes(lambda: drag(page, 30, 0))
    changes(lambda: page.mouse.wheel(0, -200))
    changes(lambda: seen(page, "map-fit").click())
    seen(page, "layer-scan").check()


def test_goals_need_control(page: Page, nav2: FakeRelay) -> None:
    expect(seen(page, "goal-blocked")).to_have_text("Take control to set a goal.")
    nav2.do(**OPERATOR | {"level": "viewer"})
    expect(seen(page, "goal-blocked")).to_contain_text("You are a viewer.")
    nav2.do(**OPERATOR)
    seen(page, "goal-take").click()
    expect(seen(page, "goal-set")).to_be_visible()


def test_a_press_is_the_position_and_a_drag_the_heading(page: Page, nav2: FakeRelay) -> None:
    take_control(page)
    nav2.do(waits=0)
    seen(page, "goal-set").click()
    drag(page, 0, -60)
    expect(seen(page, "goal-progress")).to_have_text(re.compile(r"m left · 0:03 so far · .*1 recovery"))
    seen(page, "goal-cancel").click()
    expect(seen(page, "goal-words")).to_have_text("The goal is cancelled.")
    [goal] = goals(nav2)
    assert goal["header"] == {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": "map"}
    # The middle of the map is the origin of the odometry.
    assert goal["pose"]["position"]["x"] > 10.1
    assert goal["pose"]["position"]["y"] == pytest.approx(5.0, abs=0.05)
    assert goal["pose"]["orientation"]["z"] == pytest.approx(math.sin(math.pi / 4))


def test_a_goal_by_numbers_is_reached(page: Page, nav2: FakeRelay) -> None:
    take_control(page)
    send_by_numbers(page, 9, 4, 180)
    expect(seen(page, "goal-words")).to_have_text("The robot has arrived.")
    expect(seen(page, "map-pose")).to_contain_text(re.compile(r"Robot at (8\.9\d|9\.0\d), (3\.9\d|4\.0\d) m"))
    assert goals(nav2)[-1]["pose"]["orientation"]["z"] == pytest.approx(1)


def test_a_list_of_targets_is_driven_in_turn(page: Page, nav2: FakeRelay) -> None:
    take_control(page)
    seen(page, "goal-set").click()
    seen(page, "goal-list").check()
    for x in (9, 11):
        for field, value in (("x", x), ("y", 4), ("degrees", 0)):
            seen(page, f"goal-{field}").fill(str(value))
        seen(page, "goal-send").click()
    drag(page, 0, -60)
    expect(seen(page, "goal-targets")).to_contain_text("3 targets")
    assert violations(page) == []
    nav2.do(waits=1)
    seen(page, "goal-drive-list").click()
    expect(seen(page, "goal-progress")).to_have_text("target 2 of 3")
    nav2.do()
    expect(seen(page, "goal-words")).to_have_text("The robot has arrived.")
    expect(seen(page, "goal-targets")).to_have_count(0)
    sent = nav2.log(op="send_action_goal")[-1]
    assert (sent["action"], sent["action_type"]) == ("/follow_waypoints", "nav2_msgs/action/FollowWaypoints")
    assert [each["pose"]["position"]["x"] for each in sent["args"]["poses"]][:2] == [9, 11]


def test_layers_that_are_switched_off_are_not_drawn(page: Page, nav2: FakeRelay) -> None:
    take_control(page)
    seen(page, "map-fit").click()
    seen(page, "map-follow").click()
    for _ in range(3):
        seen(page, "map-in").click()
    # The goal is behind a wall, so the robot drives until the goal is cancelled.
    send_by_numbers(page, 30, 4, 0)
    seen(page, "layer-trail").check()
    seen(page, "layer-scan").uncheck()
    nav2.until(lambda: pixels(page, "amber") > 0, "the path is not drawn")
    nav2.until(lambda: pixels(page, "cyan") > LAYER_PIXELS, "the trail is not drawn")
    seen(page, "layer-plan").uncheck()
    nav2.until(lambda: pixels(page, "amber") == 0, "the path is still drawn")
    seen(page, "layer-trail").uncheck()
    nav2.until(lambda: pixels(page, "cyan") < LAYER_PIXELS, "the trail is still drawn")
    seen(page, "layer-scan").check()
    nav2.until(lambda: pixels(page, "cyan") > LAYER_PIXELS, "the scan is not drawn")
    seen(page, "layer-scan").uncheck()
    nav2.until(lambda: pixels(page, "cyan") < LAYER_PIXELS, "the scan is still drawn")
    seen(page, "goal-cancel").click()
    expect(seen(page, "goal-words")).to_have_text("The goal is cancelled.")


def test_a_goal_without_a_path_ends_with_a_reason(page: Page, nav2: FakeRelay) -> None:
    take_control(page)
    nav2.do(no_path=True)
    send_by_numbers(page, 0, 0, 0)
    expect(seen(page, "goal-words")).to_have_text("The robot did not arrive: there is no path to the goal.")


def test_a_stop_ends_the_goal(page: Page, nav2: FakeRelay) -> None:
    take_control(page)
    nav2.do(waits=0)
    send_by_numbers(page, 12, 4, 0)
    expect(seen(page, "goal-cancel")).to_be_visible()
    page.get_by_role("button", name="Stop the robot at once").click()
    expect(seen(page, "goal-words")).to_have_text("The goal was cancelled, because the robot was stopped.")
    expect(seen(page, "goal-blocked")).to_contain_text("The robot is stopped.")
    expect(seen(page, "goal-set")).to_have_count(0)
