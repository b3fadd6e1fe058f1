"""The cameras of the cockpit in a real browser, against a fake relay."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from playwright.sync_api import Locator, Page, expect
from switchboard_browser import ready_to_drive

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    OpenPage = Callable[..., Page]
    FakeRelay = Any

COCKPIT = "/cockpit/rover-1"
FRONT, REAR = "/camera/image_raw/compressed", "/camera_rear/image_raw/compressed"
RUNS = re.compile(r"[1-9]\d* fps")
FLOOR = {FRONT: (70, 66, 58), REAR: (58, 66, 70)}
"""The colour at the bottom left corner of each camera's pictures: red, green, blue."""


def watching(open_page: OpenPage, **options: Any) -> Page:
    """An open cockpit with a live picture."""
    page = open_page(COCKPIT, **{"user": "driver", **options})
    expect(part(page, "fps")).to_have_text(RUNS)
    return page


def pane(page: Page, camera: str) -> Locator:
    return page.locator(f"[data-testid=camera-pane][data-camera='{camera}']")


def part(where: Page | Locator, name: str) -> Locator:
    return where.get_by_test_id(f"camera-{name}")


def pixel(canvas: Locator, x: int, y: int) -> tuple[int, int, int]:
    script = "(canvas, [x, y]) => [...canvas.getContext('2d').getImageData(x, y, 1, 1).data]"
    red, green, blue, _ = canvas.evaluate(script, [x, y])
    return red, green, blue


def near(colour: tuple[int, int, int], other: tuple[int, int, int]) -> bool:
    return all(abs(a - b) <= 5 for a, b in zip(colour, other, strict=True))


def last_watch(relay: FakeRelay) -> dict[str, Any]:
    entry = relay.log(op="watch")[-1]
    return {key: value for key, value in entry.items() if key not in ("op", "at", "user", "robot")}


def test_the_picture_is_the_cameras(open_page: OpenPage) -> None:
    """The canvas has the size and the pixels of what the camera sent."""
    page = watching(open_page)
    canvas = part(pane(page, FRONT), "canvas")
    expect(part(page, "size")).to_have_text("640 × 480")
    assert near(pixel(canvas, 2, 477), FLOOR[FRONT])
    expect(part(page, "bytes")).to_have_text(re.compile(r"[1-9]\d* kB/s"))


def test_each_picture_is_taken_after_it_was_drawn(open_page: OpenPage, relay: FakeRelay) -> None:
    """The page says ``took`` for each picture, in order and once."""
    watching(open_page)
    relay.until(lambda: len(relay.log(op="took")) > 5, "no pictures were taken")
    numbers = [entry["number"] for entry in relay.log(op="took")]
    assert numbers == list(range(1, len(numbers) + 1))


def test_another_camera(open_page: OpenPage) -> None:
    """Choosing another camera shows its picture, also after a reload."""
    page = watching(open_page)
    part(page, "topic").select_option(REAR)
    canvas = part(pane(page, REAR), "canvas")
    expect(canvas).to_be_visible()
    assert near(pixel(canvas, 2, 477), FLOOR[REAR])
    page.reload()
    expect(part(pane(page, REAR), "canvas")).to_be_visible()


def test_what_is_asked_for_is_sent(open_page: OpenPage, relay: FakeRelay) -> None:
    """Each control opens the stream anew with its parameter, and the picture follows."""
    page = watching(open_page)
    assert last_watch(relay) == {"topic": FRONT}
    part(page, "settings").click()
    part(page, "ask-width").select_option("320")
    expect(part(page, "size")).to_have_text("320 × 240")
    assert last_watch(relay) == {"topic": FRONT, "width": "320"}
    part(page, "ask-rotate").select_option("90")
    expect(part(page, "size")).to_have_text("320 × 426")
    assert near(pixel(part(page, "canvas"), 2, 2), FLOOR[FRONT])
    part(page, "ask-quality").select_option("40")
    part(page, "ask-fps").select_option("5")
    asked = {"topic": FRONT, "width": "320", "rotate": "90", "quality": "40", "fps": "5"}
    relay.until(lambda: last_watch(relay) == asked, "quality and rate were not asked for")
    expect(part(page, "fps")).to_have_text("5 fps")
    page.reload()
    expect(part(page, "size")).to_have_text("320 × 426")
    assert last_watch(relay) == asked


def test_two_cameras_side_by_side(open_page: OpenPage) -> None:
    """A second pane shows a camera that is not shown yet, beside the first; closed, the first stays."""
    page = watching(open_page)
    part(page, "add").click()
    for camera, colour in FLOOR.items():
        canvas = part(pane(page, camera), "canvas")
        expect(canvas).to_be_visible()
        assert near(pixel(canvas, 2, 477), colour)
    front, rear = (pane(page, camera).bounding_box() for camera in (FRONT, REAR))
    assert front is not None
    assert rear is not None
    assert front["y"] == rear["y"]
    assert front["x"] + front["width"] <= rear["x"]
    page.reload()
    expect(part(page, "pane")).to_have_count(2)
    part(pane(page, REAR), "remove").click()
    expect(part(page, "pane")).to_have_count(1)
    expect(part(pane(page, FRONT), "fps")).to_have_text(RUNS)


def test_pictures_that_stop_are_marked(open_page: OpenPage, relay: FakeRelay) -> None:
    """A second without a picture is said, and the last one stays, dimmed; the mark goes with the next."""
    page = watching(open_page)
    relay.do(silent=True)
    expect(part(page, "stale")).to_have_text(re.compile(r"No picture since \d+ s"))
    canvas = part(page, "canvas")
    assert canvas.evaluate("canvas => getComputedStyle(canvas).filter") != "none"
    assert near(pixel(canvas, 2, 477), FLOOR[FRONT])
    relay.do(silent=False)
    expect(part(page, "stale")).to_have_count(0)


def kept(open_page: OpenPage, relay: FakeRelay, seconds: float, **options: Any) -> Page:
    """An open cockpit that has got one picture, so old, and gets no more."""
    relay.do(kept=seconds, **options)
    page = open_page(COCKPIT, user="driver")
    relay.until(lambda: relay.log(op="took"), "the picture was not taken")
    return page


def test_an_old_picture_is_no_live_one(open_page: OpenPage, relay: FakeRelay) -> None:
    """The picture that a dead camera has left is dimmed, with its own age, until there is a new one."""
    page = kept(open_page, relay, 50)
    expect(part(page, "stale")).to_have_text(re.compile(r"No picture since (5\d|6\d) s"))
    canvas = part(page, "canvas")
    assert canvas.evaluate("canvas => getComputedStyle(canvas).filter") != "none"
    expect(canvas).to_have_attribute("aria-label", re.compile("^Old picture"))
    relay.do(kept=None)
    expect(part(page, "stale")).to_have_count(0)
    expect(part(page, "fps")).to_have_text(RUNS)


UNDIMMED = """() => {
    window.undimmed = 0
    const look = () => {
        const canvas = document.querySelector('[data-testid=camera-canvas]')
        const shown = canvas && canvas.style.visibility !== 'hidden'
        if (shown && !document.querySelector('[data-testid=camera-stale]')) window.undimmed += 1
        requestAnimationFrame(look)
    }
    look()
}"""


def test_an_old_picture_that_comes_again_is_no_newer(open_page: OpenPage, relay: FakeRelay) -> None:
    """A connection that is made anew and brings the same old picture shows it as old from its first frame on."""
    page = kept(open_page, relay, 50)
    expect(part(page, "stale")).to_be_visible()
    page.evaluate(UNDIMMED)
    relay.do(close_video=1001, clear_log=True)
    relay.until(lambda: relay.log(op="took"), "the picture was not taken again")
    page.evaluate("() => new Promise((drawn) => requestAnimationFrame(() => requestAnimationFrame(drawn)))")
    assert page.evaluate("window.undimmed") == 0


def test_an_old_picture_of_a_slow_camera_grows_older(open_page: OpenPage, relay: FakeRelay) -> None:
    """Until the next one is missed it is shown as it is, with an age that grows."""
    page = kept(open_page, relay, 20, source_fps=0.05)
    expect(part(page, "delay")).to_have_text(re.compile(r"^[23]\d s old$"))
    first = part(page, "delay").inner_text()
    expect(part(page, "delay")).not_to_have_text(first)
    assert int(part(page, "delay").inner_text().split()[0]) > int(first.split()[0])
    expect(part(page, "stale")).to_have_count(0)


def test_the_picture_of_an_hour_ago_is_dated(open_page: OpenPage, relay: FakeRelay) -> None:
    """A picture that its publisher keeps is dimmed, with its time, and nothing is said of a camera that is silent."""
    page = kept(open_page, relay, 3600)
    expect(part(page, "stale")).to_have_text(re.compile(r"^Picture of .*\d:\d\d.*, by the robot’s clock$"))


def test_the_time_of_an_old_picture_fits_on_a_phone(open_page: OpenPage, relay: FakeRelay) -> None:
    """With two cameras beside each other what is said of a picture stays in its pane."""
    relay.do(kept=3600)
    page = open_page(COCKPIT, user="driver", width=390, height=844)
    part(page, "add").click()
    expect(part(page, "stale")).to_have_count(2)
    for each in part(page, "pane").all():
        box, words = each.bounding_box(), part(each, "stale").bounding_box()
        assert box is not None
        assert words is not None
        assert box["x"] <= words["x"]
        assert words["x"] + words["width"] <= box["x"] + box["width"]


def test_a_clock_that_is_behind_makes_no_live_picture_old(open_page: OpenPage, relay: FakeRelay) -> None:
    """What comes after the first picture is live whatever its stamp says."""
    relay.do(ahead=-50)
    page = watching(open_page)
    expect(part(page, "delay")).to_have_text("age unknown")
    page.evaluate(UNDIMMED)
    taken = len(relay.log(op="took"))
    relay.until(lambda: len(relay.log(op="took")) > taken + 5, "no pictures were taken")
    expect(part(page, "stale")).to_have_count(0)
    assert page.evaluate("window.undimmed") > 0


def test_a_slow_stream_is_not_a_broken_one(open_page: OpenPage, relay: FakeRelay) -> None:
    """At one picture a second nothing is marked as missing."""
    page = watching(open_page)
    part(page, "settings").click()
    part(page, "ask-fps").select_option("1")
    relay.until(lambda: last_watch(relay).get("fps") == "1", "the rate was not asked for")
    taken = len(relay.log(op="took"))
    marks = page.evaluate(
        """() => new Promise(done => {
            let marks = 0
            const watch = new MutationObserver(() => {
                if (document.querySelector('[data-testid=camera-stale]')) marks += 1
            })
            watch.observe(document.body, { subtree: true, childList: true })
            setTimeout(() => { watch.disconnect(); done(marks) }, 2500)
        })"""
    )
    assert marks == 0
    assert 1 <= len(relay.log(op="took")) - taken <= 4


def test_the_delay_is_told_by_the_relays_clock(open_page: OpenPage, relay: FakeRelay) -> None:
    """The age of the picture is shown; when the robot's clock can't be right, so is that nobody knows it."""
    page = watching(open_page)
    expect(part(page, "delay")).to_have_text(re.compile(r"(< 1|\d+) ms old"))
    relay.do(ahead=3600)
    expect(part(page, "delay")).to_have_text("age unknown")


def test_a_thin_link_is_shown(open_page: OpenPage, relay: FakeRelay) -> None:
    """When the robot sends less than was asked for, the pane says so, and what it sends."""
    page = watching(open_page)
    expect(part(page, "reduced")).to_have_count(0)
    relay.do(reduced=0.5)
    expect(part(page, "reduced")).to_have_text("reduced: thin link")
    expect(part(page, "reduced")).to_have_attribute("title", re.compile("480 × 360 at quality 80"))


def test_another_form_than_asked_for_is_marked(open_page: OpenPage, relay: FakeRelay) -> None:
    """Which one, and why, is told; the mark goes with it."""
    page = watching(open_page)
    expect(part(page, "instead")).to_have_count(0)
    relay.do(instead={"width": 320, "fps": 5})
    expect(part(page, "instead")).to_have_text("others’ form: robot at its limit")
    expect(part(page, "instead")).to_have_attribute("title", re.compile("width 320, pictures per second 5"))
    relay.do(instead=None)
    expect(part(page, "instead")).to_have_count(0)


def test_the_snapshot_is_what_is_shown(open_page: OpenPage, tmp_path: Path) -> None:
    """The button saves a JPEG of the picture, named after robot, camera and time."""
    page = watching(open_page)
    with page.expect_download() as told:
        part(page, "snapshot").click()
    name = told.value.suggested_filename
    assert re.fullmatch(r"rover-1-camera-image_raw-compressed-20\d\d-\d\d-\d\dT[\d-]+Z\.jpg", name)
    told.value.save_as(tmp_path / name)
    image = cv2.imdecode(np.fromfile(tmp_path / name, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    assert image.shape == (480, 640, 3)
    blue, green, red = (int(value) for value in image[477, 2])
    assert near((red, green, blue), FLOOR[FRONT])


def test_a_revoked_right_is_said(open_page: OpenPage, relay: FakeRelay) -> None:
    """Closed for a revoked right, the pane says so and asks no more by itself, until it is told to."""
    page = watching(open_page)
    relay.do(close_video=4403, reason="revoked by admin", clear_log=True)
    words = "You have no right to view this camera. Revoked by admin."
    expect(part(page, "words")).to_have_text(words)
    page.wait_for_timeout(1500)  # proves absence
    assert relay.log(op="watch") == []
    part(page, "retry").click()
    expect(part(page, "words")).to_have_count(0)
    expect(part(page, "fps")).to_have_text(RUNS)


def test_a_picture_that_is_decoded_late_takes_back_no_reason(open_page: OpenPage, relay: FakeRelay) -> None:
    """A picture that was under way when the stream ended is shown, and what is said about the end stays."""
    page = watching(open_page)
    page.evaluate(
        """() => {
            const decode = window.createImageBitmap
            window.createImageBitmap = async (...given) => {
                document.body.dataset.late = 'waits'
                await new Promise((end) => (window.goOn = end))
                const bitmap = await decode(...given)
                setTimeout(() => (document.body.dataset.late = 'shown'))
                return bitmap
            }
        }"""
    )
    expect(page.locator("body[data-late=waits]")).to_be_attached()
    relay.do(close_video=4403, reason="revoked by admin", clear_log=True)
    words = "You have no right to view this camera. Revoked by admin."
    expect(part(page, "words")).to_have_text(words)
    page.evaluate("window.goOn()")
    expect(page.locator("body[data-late=shown]")).to_be_attached()
    page.evaluate("() => new Promise((drawn) => requestAnimationFrame(() => requestAnimationFrame(drawn)))")
    expect(part(page, "words")).to_have_text(words)


@pytest.mark.parametrize("code", [1001, 1011, 4408, 4503])
def test_it_comes_back_by_itself(open_page: OpenPage, relay: FakeRelay, code: int) -> None:
    """After an end that may pass the page asks again."""
    page = watching(open_page)
    relay.do(close_video=code, clear_log=True)
    relay.until(lambda: len(relay.log(op="took")) > 1, "the pictures did not come back")
    expect(part(page, "stale")).to_have_count(0)


def test_a_hidden_page_watches_nothing(open_page: OpenPage, relay: FakeRelay) -> None:
    """A page in the background takes no pictures, and is live again when it is looked at."""
    page = watching(open_page)
    hide = """hidden => {
        Object.defineProperty(document, 'hidden', { value: hidden, configurable: true })
        document.dispatchEvent(new Event('visibilitychange'))
    }"""
    page.evaluate(hide, True)
    relay.do(clear_log=True)
    page.wait_for_timeout(700)  # proves absence
    assert len(relay.log(op="took")) <= 1
    page.evaluate(hide, False)
    relay.until(lambda: len(relay.log(op="took")) > 1, "the pictures did not come back")


def test_h264(open_page: OpenPage, relay: FakeRelay) -> None:
    """Chosen in the controls, H.264 is decoded and shown."""
    page = watching(open_page)
    part(page, "settings").click()
    part(page, "ask-codec").select_option("h264")
    relay.until(lambda: last_watch(relay).get("codec") == "h264", "H.264 was not asked for")
    relay.do(clear_log=True)
    relay.until(lambda: len(relay.log(op="took")) > 5, "no pictures were taken")
    canvas = part(page, "canvas")
    red, green, blue = pixel(canvas, 2, 477)
    assert red > green > blue
    expect(part(page, "codec-note")).to_have_count(0)


def test_h264_that_the_robot_has_not_falls_back(open_page: OpenPage, relay: FakeRelay) -> None:
    """Refused H.264 is replaced by JPEG, and the controls say why; of another camera it is tried anew."""
    page = watching(open_page)
    part(page, "settings").click()
    part(page, "ask-codec").select_option("h264")
    relay.until(lambda: last_watch(relay).get("codec") == "h264", "H.264 was not asked for")
    relay.do(close_video=4415, reason="the robot has no encoder for H.264")
    expect(part(page, "codec-note")).to_have_text(
        "The robot has no encoder for H.264. JPEG is shown instead."
    )
    relay.until(lambda: last_watch(relay) == {"topic": FRONT}, "JPEG was not asked for")
    expect(part(page, "stale")).to_have_count(0)
    part(page, "topic").select_option(REAR)
    expect(part(page, "codec-note")).to_have_count(0)
    relay.until(lambda: last_watch(relay) == {"topic": REAR, "codec": "h264"}, "H.264 was not tried anew")


@pytest.mark.parametrize(
    "reason",
    [
        "camera /camera/image_raw has given no picture for 10 s",
        "you begin streams of robot rover-1 faster than it can; try again in 1 s",
        "robot rover-1 shows 16 streams already, the most it can",
    ],
)
def test_h264_that_is_not_to_be_had_just_now_is_asked_for_again(
    open_page: OpenPage, relay: FakeRelay, reason: str
) -> None:
    """What is not the encoder's fault says nothing against H.264: the next time it is tried again, and shown."""
    page = watching(open_page)
    part(page, "settings").click()
    part(page, "ask-codec").select_option("h264")
    relay.until(lambda: last_watch(relay).get("codec") == "h264", "H.264 was not asked for")
    relay.do(close_video=4503, reason=reason, clear_log=True)
    relay.until(lambda: len(relay.log(op="took")) > 3, "the pictures did not come back")
    assert {each.get("codec") for each in relay.log(op="watch")} == {"h264"}
    expect(part(page, "codec-note")).to_have_count(0)


def test_why_there_is_no_h264_is_said(open_page: OpenPage) -> None:
    """On a page by plain http the choice is off, and the reason stands beside it."""
    page = open_page("/fleet", user="driver")
    page.add_init_script("Object.defineProperty(window, 'isSecureContext', { value: false })")
    page.goto(COCKPIT)
    expect(part(page, "fps")).to_have_text(RUNS)
    part(page, "settings").click()
    expect(part(page, "codec-note")).to_contain_text("H.264 needs https")
    expect(part(page, "ask-codec").locator("option[value=h264]")).to_be_disabled()


@pytest.mark.parametrize("width", [390, 768, 1280])
def test_four_cameras_fit(open_page: OpenPage, width: int) -> None:
    """With all panes and their controls open the page is no wider than its window."""
    page = watching(open_page, width=width, height=844)
    for count in (2, 3, 4):
        part(page, "add").click()
        expect(part(page, "pane")).to_have_count(count)
    expect(part(page, "add")).to_have_count(0)
    for button in part(page, "settings").all():
        button.click()
    expect(part(page, "controls")).to_have_count(4)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    for each in part(page, "pane").all():
        assert each.evaluate("pane => pane.scrollWidth <= pane.clientWidth")


def test_two_cameras_and_the_joystick_fit_on_a_phone(open_page: OpenPage) -> None:
    """With two cameras on a phone the joystick is still below them, on the same screen."""
    page = watching(open_page, width=390, height=844)
    part(page, "add").click()
    expect(part(page, "pane")).to_have_count(2)
    ready_to_drive(page)
    cameras = [each.bounding_box() for each in part(page, "canvas").all()]
    joystick = page.get_by_test_id("joystick").bounding_box()
    assert joystick is not None
    assert all(box is not None and box["y"] + box["height"] <= joystick["y"] for box in cameras)
    assert joystick["y"] + joystick["height"] <= 844
