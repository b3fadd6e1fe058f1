"""Recordings in the built portal in a real browser, with a fake relay."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from playwright.sync_api import Locator, Page, expect

if TYPE_CHECKING:
    from collections.abc import Callable

    OpenPage = Callable[..., Page]
    FakeRelay = Any

COCKPIT = "/cockpit/rover-1"
MAGIC = b"\x89MCAP0\r\n"
DONE = {
    "state": "complete",
    "topics": ["/odom"],
    "lasted": 725.0,
    "bytes": 2_100_000,
    "messages": 12_345,
    "reason": "its time is over",
}


def seen(page: Page | Locator, name: str) -> Locator:
    return page.get_by_test_id(f"recording-{name}" if name else "recording")


def topic(page: Page, name: str) -> Locator:
    return page.locator(f"[data-testid=recording-topic][data-topic='{name}']")


def cockpit(open_page: OpenPage, user: str = "driver", **options: Any) -> Page:
    page = open_page(COCKPIT, user=user, **options)
    expect(page.get_by_test_id("link-state")).to_have_attribute("data-state", "open")
    return page


def put(relay: FakeRelay, **facts: Any) -> None:
    """Adds a recording."""
    relay.do(robot="rover-1", recording={**DONE, **facts})


def test_chosen_topics_and_cameras_are_recorded(open_page: OpenPage, relay: FakeRelay) -> None:
    """With the default limits; the page follows the recording, and stops it."""
    page = cockpit(open_page)
    seen(page, "new").click()
    expect(seen(page, "start")).to_be_disabled()
    seen(page, "filter").fill("odom")
    expect(seen(page, "topic")).to_have_count(1)
    topic(page, "/odom").check()
    seen(page, "camera").first.check()
    expect(seen(page, "form")).to_contain_text("1 topic and 1 camera")
    expect(seen(page, "room")).to_have_text("10 GB of 10 GB free on the relay")
    seen(page, "start").click()
    expect(seen(page, "state")).to_have_text("Recording")
    expect(seen(page, "form")).to_be_hidden()
    [asked] = relay.log(op="POST recordings")
    assert (asked["topics"], asked["cameras"]) == (["/odom"], ["/camera/image_raw"])
    assert (asked["seconds"], asked["megabytes"]) == (600, 1000)
    expect(seen(page, "time")).to_have_text(re.compile(r"0:0[1-9] of 10:00"))
    expect(seen(page, "messages")).not_to_have_text("0")
    expect(seen(page, "size")).to_contain_text("kB of 1 GB")
    expect(page.get_by_test_id("recordings")).to_contain_text("1 running")
    seen(page, "stop").click()
    expect(seen(page, "state")).to_have_text("Complete")
    expect(seen(page, "reason")).to_have_text("Stopped by driver.")


def test_limits_are_chosen_and_remembered(open_page: OpenPage, relay: FakeRelay) -> None:
    """No size beyond the free space is offered; the next recording begins with the same selection."""
    relay.do(left=3000.4)
    page = cockpit(open_page)
    seen(page, "new").click()
    expect(seen(page, "megabytes").locator("option")).to_have_text(
        ["100 MB", "1 GB", "3 GB, all that is left"]
    )
    topic(page, "/scan").check()
    seen(page, "seconds").select_option("1 h")
    seen(page, "megabytes").select_option("100 MB")
    seen(page, "start").click()
    expect(seen(page, "form")).to_be_hidden()
    assert relay.log(op="POST recordings", seconds=3600, megabytes=100)
    page.reload()
    seen(page, "new").click()
    expect(topic(page, "/scan")).to_be_checked()
    expect(topic(page, "/odom")).not_to_be_checked()
    expect(seen(page, "seconds")).to_have_value("3600")


def test_images_are_not_recorded_twice(open_page: OpenPage, relay: FakeRelay) -> None:
    """The topic of a camera's images cannot be selected beside the camera."""
    page = cockpit(open_page)
    seen(page, "new").click()
    topic(page, "/camera/image_raw/compressed").check()
    seen(page, "camera").first.check()
    expect(topic(page, "/camera/image_raw/compressed")).to_be_disabled()
    seen(page, "start").click()
    relay.until(lambda: relay.log(op="POST recordings", topics=[]), "it was not asked for")


def test_a_refusal_is_shown_with_the_relays_reason(open_page: OpenPage, relay: FakeRelay) -> None:
    """The selection is kept."""
    relay.do(refuse="you have 4 recordings running, the most one user may have")
    page = cockpit(open_page)
    seen(page, "new").click()
    topic(page, "/odom").check()
    seen(page, "start").click()
    expect(seen(page, "refused")).to_have_text("You have 4 recordings running, the most one user may have.")
    expect(topic(page, "/odom")).to_be_checked()


def test_a_finished_recording_is_downloaded(open_page: OpenPage, relay: FakeRelay, tmp_path: Path) -> None:
    """By the session's cookie; the page shows duration, size, messages and the reason of the end."""
    put(relay, drops=17, problems=["/camera: the robot is at its limit"])
    page = cockpit(open_page)
    row = seen(page, "")
    expect(seen(row, "time")).to_have_text("12:05")
    expect(seen(row, "size")).to_have_text("2.1 MB")
    expect(seen(row, "messages")).to_have_text("12\u202f345")
    expect(seen(row, "drops")).to_have_text("17")
    expect(seen(row, "reason")).to_have_text("Its time is over.")
    expect(row).to_contain_text("/camera: the robot is at its limit.")
    with page.expect_download() as coming:
        seen(row, "download").click()
    path = tmp_path / "it.mcap"
    coming.value.save_as(path)
    assert path.read_bytes() == MAGIC + bytes(range(256)) * 8


def test_a_long_list_is_shown_in_parts(open_page: OpenPage, relay: FakeRelay) -> None:
    """Latest first; older ones on request, and they stay."""
    for number in range(230):
        put(relay, messages=number)
    page = cockpit(open_page)
    expect(seen(page, "")).to_have_count(100)
    expect(seen(page, "count")).to_have_text("100+")
    expect(seen(seen(page, "").first, "messages")).to_have_text("229")
    seen(page, "older").click()
    expect(seen(page, "")).to_have_count(200)
    seen(page, "older").click()
    expect(seen(page, "")).to_have_count(230)
    expect(seen(page, "older")).to_have_count(0)
    expect(seen(page, "count")).to_have_text("230")
    with page.expect_response(re.compile("/recordings[?]limit=300$")):
        pass
    expect(seen(page, "")).to_have_count(230)


def test_deleting_is_asked_about(open_page: OpenPage, relay: FakeRelay) -> None:
    """One press deletes nothing."""
    put(relay)
    page = cockpit(open_page)
    seen(page, "delete").click()
    page.get_by_role("button", name="Keep").click()
    assert relay.log(op="DELETE recordings/r0") == []
    seen(page, "delete").click()
    seen(page, "delete-sure").click()
    expect(seen(page, "")).to_have_count(0)
    assert len(relay.log(op="DELETE recordings/r0")) == 1


@pytest.mark.parametrize(("user", "buttons"), [("driver", 0), ("admin", 1)])
def test_only_its_maker_and_owners_may_end_it(
    open_page: OpenPage, relay: FakeRelay, user: str, buttons: int
) -> None:
    """Others may download the file."""
    put(relay, user="ann")
    put(relay, user="ann", state="recording")
    page = cockpit(open_page, user=user)
    expect(seen(page, "")).to_have_count(2)
    expect(seen(page, "download")).to_have_count(1)
    expect(seen(page, "stop")).to_have_count(buttons)
    expect(seen(page, "delete")).to_have_count(buttons)


def test_recordings_are_hidden_without_the_right(open_page: OpenPage, relay: FakeRelay) -> None:
    """For a viewer, even while others record."""
    put(relay)
    page = cockpit(open_page, user="viewer")
    expect(page.get_by_test_id("topic-row").first).to_be_visible()
    with page.expect_response(re.compile(r"/recordings\?")):
        pass
    expect(page.get_by_test_id("recordings")).to_have_count(0)


@pytest.mark.parametrize(
    ("order", "words"),
    [
        (
            {"denied": "record on /odom is denied to you by 'record:*'"},
            "may not record this robot. Record on /odom",
        ),
        ({"left": 0.3}, "use all 10 GB"),
        ({"left": 0, "megabytes": 0}, "stores no recordings"),
        ({"full": "the disk is nearly full: delete some"}, "The disk is nearly full: delete some."),
        ({"robot": "rover-1", "state": "offline"}, "The robot is offline."),
    ],
    ids=["right", "room", "none", "disk", "offline"],
)
def test_the_reason_why_nothing_can_be_recorded_is_shown(
    open_page: OpenPage, relay: FakeRelay, order: dict[str, Any], words: str
) -> None:
    """In place of the form; it updates by itself."""
    relay.do(**order)
    page = cockpit(open_page)
    expect(seen(page, "why")).to_contain_text(words)
    expect(seen(page, "new")).to_be_disabled()
    relay.do(denied="", full="", left=10_000, megabytes=10_000, robot="rover-1", state="online")
    expect(seen(page, "new")).to_be_enabled(timeout=40_000)
    expect(seen(page, "why")).to_have_count(0)


def test_it_fits(open_page: OpenPage, relay: FakeRelay) -> None:
    """Without sideways scrolling, with long names, the form and the question open."""
    put(
        relay,
        topics=[f"/a/rather/long/name/of/a/topic/number/{n}" for n in range(9)],
        problems=["long " * 40],
    )
    page = cockpit(open_page)
    seen(page, "new").click()
    seen(page, "delete").click()
    expect(seen(page, "form")).to_be_visible()
    for width in (1280, 390):
        page.set_viewport_size({"width": width, "height": 800})
        page.wait_for_function("document.documentElement.scrollWidth === innerWidth")
        box = seen(page, "delete-sure").bounding_box()
        assert box is not None and box["x"] >= 0 and box["x"] + box["width"] <= width
