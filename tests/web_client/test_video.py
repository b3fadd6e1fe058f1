"""The cameras of the cockpit in a real browser, with a fake relay."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from playwright.sync_api import Locator, Page, expect

from tests.worlds.browser import ready_to_drive
from tests.worlds.waiting import wait_for

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
    """An open cockpit with live video."""
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


def shows(canvas: Locator, x: int, y: int, colour: tuple[int, int, int]) -> None:
    """Waits until a point of a canvas has a colour: the canvas is there before its frame."""
    wait_for("the picture is drawn", lambda: near(pixel(canvas, x, y), colour))


def near(colour: tuple[int, int, int], other: tuple[int, int, int]) -> bool:
    return all(abs(a - b) <= 5 for a, b in zip(colour, other, strict=True))


def last_watch(relay: FakeRelay) -> dict[str, Any]:
    entry = relay.log(op="watch")[-1]
    return {key: value for key, value in entry.items() if key not in ("op", "at", "user", "robot")}


def test_the_frame_is_the_cameras(open_page: OpenPage) -> None:
    """The canvas has the size and the pixels of the camera's image."""
    page = watching(open_page)
    expect(part(page, "size")).to_have_text("640 × 480")
    shows(part(pane(page, FRONT), "canvas"), 2, 477, FLOOR[FRONT])
    expect(part(page, "bytes")).to_have_text(re.compile(r"[1-9]\d* kB/s"))


def test_frame_is_taken_after_it_was_drawn(open_page: OpenPage, relay: FakeRelay) -> None:
    """The page sends ``frame_ack`` for each frame, in order and once."""
    watching(open_page)
    relay.until(lambda: len(relay.log(op="frame_ack")) > 5, "no pictures were taken")
    numbers = [entry["number"] for entry in relay.log(op="frame_ack")]
    assert numbers == list(range(1, len(numbers) + 1))


def test_another_camera(open_page: OpenPage) -> None:
    """Selecting another camera shows its video, also after a reload."""
    page = watching(open_page)
    part(page, "topic").select_option(REAR)
    canvas = part(pane(page, REAR), "canvas")
    expect(canvas).to_be_visible()
    shows(canvas, 2, 477, FLOOR[REAR])
    page.reload()
    expect(part(pane(page, REAR), "canvas")).to_be_visible()


def test_requested_parts_are_sent(open_page: OpenPage, relay: FakeRelay) -> None:
    """Each control opens the stream again with its parameter, and the video follows."""
    page = watching(open_page)
    assert last_watch(relay) == {"topic": FRONT}
    part(page, "settings").click()
    part(page, "ask-width").select_option("320")
    expect(part(page, "size")).to_have_text("320 × 240")
    assert last_watch(relay) == {"topic": FRONT, "width": "320"}
    part(page, "ask-rotate").select_option("90")
    expect(part(page, "size")).to_have_text("320 × 426")
    shows(part(page, "canvas"), 2, 2, FLOOR[FRONT])
    part(page, "ask-quality").select_option("40")
    part(page, "ask-fps").select_option("5")
    asked = {"topic": FRONT, "width": "320", "rotate": "90", "quality": "40", "fps": "5"}
    relay.until(lambda: last_watch(relay) == asked, "quality and rate were not asked for")
    expect(part(page, "fps")).to_have_text("5 fps")
    page.reload()
    expect(part(page, "size")).to_have_text("320 × 426")
    assert last_watch(relay) == asked


def test_two_cameras_side_by_side(open_page: OpenPage) -> None:
    """A second pane shows another camera beside the first; after closing it the first stays."""
    page = watching(open_page)
    part(page, "add").click()
    for camera, colour in FLOOR.items():
        canvas = part(pane(page, camera), "canvas")
        expect(canvas).to_be_visible()
        shows(canvas, 2, 477, colour)
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


def test_frames_that_stop_are_marked(open_page: OpenPage, relay: FakeRelay) -> None:
    """A second without a frame is shown, and the last one stays, dimmed; the mark ends with the next."""
    page = watching(open_page)
    relay.do(silent=True)
    expect(part(page, "stale")).to_have_text(re.compile(r"No frame for \d+ s"))
    canvas = part(page, "canvas")
    assert canvas.evaluate("canvas => getComputedStyle(canvas).filter") != "none"
    shows(canvas, 2, 477, FLOOR[FRONT])
    relay.do(silent=False)
    expect(part(page, "stale")).to_have_count(0)


def kept(open_page: OpenPage, relay: FakeRelay, seconds: float, **options: Any) -> Page:
    """An open cockpit with one frame of this age, and no further ones."""
    relay.do(kept=seconds, **options)
    page = open_page(COCKPIT, user="driver")
    relay.until(lambda: relay.log(op="frame_ack"), "the picture was not taken")
    return page


def test_an_old_frame_is_no_live_one(open_page: OpenPage, relay: FakeRelay) -> None:
    """The last frame of a dead camera is dimmed, with its age, until there is a new one."""
    page = kept(open_page, relay, 50)
    expect(part(page, "stale")).to_have_text(re.compile(r"No frame for (5\d|6\d) s"))
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


def test_an_old_frame_that_comes_again_is_no_newer(open_page: OpenPage, relay: FakeRelay) -> None:
    """A new connection with the same old frame shows it as old from the beginning."""
    page = kept(open_page, relay, 50)
    expect(part(page, "stale")).to_be_visible()
    page.evaluate(UNDIMMED)
    relay.do(close_video=1001, clear_log=True)
    relay.until(lambda: relay.log(op="frame_ack"), "the picture was not taken again")
    page.evaluate("() => new Promise((drawn) => requestAnimationFrame(() => requestAnimationFrame(drawn)))")
    assert page.evaluate("window.undimmed") == 0


def test_an_old_frame_of_a_slow_camera_grows_older(open_page: OpenPage, relay: FakeRelay) -> None:
    """Until the next one is overdue it is shown normally, with a growing age."""
    page = kept(open_page, relay, 20, source_fps=0.05)
    expect(part(page, "delay")).to_have_text(re.compile(r"^[23]\d s old$"))
    first = part(page, "delay").inner_text()
    expect(part(page, "delay")).not_to_have_text(first)
    assert int(part(page, "delay").inner_text().split()[0]) > int(first.split()[0])
    expect(part(page, "stale")).to_have_count(0)


def test_the_frame_of_an_hour_ago_is_dated(open_page: OpenPage, relay: FakeRelay) -> None:
    """A latched frame is dimmed, with its time, without an error about a silent camera."""
    page = kept(open_page, relay, 3600)
    expect(part(page, "stale")).to_have_text(re.compile(r"^Frame of .*\d:\d\d.*, by the robot’s clock$"))


def test_the_time_of_an_old_frame_fits_on_a_phone(open_page: OpenPage, relay: FakeRelay) -> None:
    """With two cameras side by side the text about a frame stays in its pane."""
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


def test_a_clock_that_is_behind_makes_no_live_frame_old(open_page: OpenPage, relay: FakeRelay) -> None:
    """Frames after the first are live for any stamp."""
    relay.do(ahead=-50)
    page = watching(open_page)
    expect(part(page, "delay")).to_have_text("age unknown")
    page.evaluate(UNDIMMED)
    taken = len(relay.log(op="frame_ack"))
    relay.until(lambda: len(relay.log(op="frame_ack")) > taken + 5, "no pictures were taken")
    expect(part(page, "stale")).to_have_count(0)
    assert page.evaluate("window.undimmed") > 0


def test_a_slow_stream_is_not_a_broken_one(open_page: OpenPage, relay: FakeRelay) -> None:
    """At one frame a second nothing is marked as missing."""
    page = watching(open_page)
    part(page, "settings").click()
    part(page, "ask-fps").select_option("1")
    relay.until(lambda: last_watch(relay).get("fps") == "1", "the rate was not asked for")
    taken = len(relay.log(op="frame_ack"))
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
    relay.until(lambda: len(relay.log(op="frame_ack")) > taken, "no picture was taken")


def test_the_delay_is_measured_by_the_relays_clock(open_page: OpenPage, relay: FakeRelay) -> None:
    """The age of the frame is shown, or that it is unknown if the robot's clock cannot be right."""
    page = watching(open_page)
    expect(part(page, "delay")).to_have_text(re.compile(r"(< 1|\d+) ms old"))
    relay.do(ahead=3600)
    expect(part(page, "delay")).to_have_text("age unknown")


def test_a_thin_link_is_shown(open_page: OpenPage, relay: FakeRelay) -> None:
    """When the robot sends less than requested, the pane shows that, and the present values."""
    page = watching(open_page)
    expect(part(page, "reduced")).to_have_count(0)
    relay.do(reduced=0.5)
    expect(part(page, "reduced")).to_have_text("reduced: slow link")
    expect(part(page, "reduced")).to_have_attribute("title", re.compile("480 × 360 at quality 80"))


def test_another_form_than_asked_for_is_marked(open_page: OpenPage, relay: FakeRelay) -> None:
    """The difference and the reason are shown; the mark ends with it."""
    page = watching(open_page)
    expect(part(page, "instead")).to_have_count(0)
    relay.do(instead={"width": 320, "fps": 5})
    expect(part(page, "instead")).to_have_text("shared settings: robot at its limit")
    expect(part(page, "instead")).to_have_attribute("title", re.compile("width 320, frames per second 5"))
    relay.do(instead=None)
    expect(part(page, "instead")).to_have_count(0)


def test_the_snapshot_is_what_is_shown(open_page: OpenPage, tmp_path: Path) -> None:
    """The button saves a JPEG of the frame, named after robot, camera and time."""
    page = watching(open_page)
    with page.expect_download() as reported:
        part(page, "snapshot").click()
    name = reported.value.suggested_filename
    assert re.fullmatch(r"rover-1-camera-image_raw-compressed-20\d\d-\d\d-\d\dT[\d-]+Z\.jpg", name)
    reported.value.save_as(tmp_path / name)
    image = cv2.imdecode(np.fromfile(tmp_path / name, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    assert image.shape == (480, 640, 3)
    blue, green, red = (int(value) for value in image[477, 2])
    assert near((red, green, blue), FLOOR[FRONT])


def test_a_revoked_right_is_shown(open_page: OpenPage, relay: FakeRelay) -> None:
    """Closed for a revoked right, the pane shows it and does not retry until the user asks."""
    page = watching(open_page)
    relay.do(close_video=4403, reason="revoked by admin", clear_log=True)
    words = "You have no right to view this camera. Revoked by admin."
    expect(part(page, "words")).to_have_text(words)
    page.wait_for_timeout(1500)  # shows absence
    assert relay.log(op="watch") == []
    part(page, "retry").click()
    expect(part(page, "words")).to_have_count(0)
    expect(part(page, "fps")).to_have_text(RUNS)


def test_a_frame_that_is_decoded_late_takes_back_no_reason(open_page: OpenPage, relay: FakeRelay) -> None:
    """A frame that was being decoded when the stream ended is shown, and the message about the end stays."""
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


def test_it_comes_back_by_itself(open_page: OpenPage, relay: FakeRelay) -> None:
    """After a temporary end the page reconnects."""
    page = watching(open_page)
    for code in (1001, 1011, 4408, 4503):
        relay.do(close_video=code, clear_log=True)
        relay.until(
            lambda: relay.log(op="watch") and len(relay.log(op="frame_ack")) > 1,
            f"the pictures did not come back after {code}",
        )
        expect(part(page, "stale")).to_have_count(0)


def test_a_hidden_page_watches_nothing(open_page: OpenPage, relay: FakeRelay) -> None:
    """A page in the background requests no frames, and is live again when it is visible."""
    page = watching(open_page)
    hide = """hidden => {
        Object.defineProperty(document, 'hidden', { value: hidden, configurable: true })
        document.dispatchEvent(new Event('visibilitychange'))
    }"""
    page.evaluate(hide, True)
    relay.do(clear_log=True)
    page.wait_for_timeout(700)  # shows absence
    assert len(relay.log(op="frame_ack")) <= 1
    page.evaluate(hide, False)
    relay.until(lambda: len(relay.log(op="frame_ack")) > 1, "the pictures did not come back")


def test_h264(open_page: OpenPage, relay: FakeRelay) -> None:
    """Selected in the controls, H.264 is decoded and shown."""
    page = watching(open_page)
    part(page, "settings").click()
    part(page, "ask-codec").select_option("h264")
    relay.until(lambda: last_watch(relay).get("codec") == "h264", "H.264 was not asked for")
    relay.do(clear_log=True)
    relay.until(lambda: len(relay.log(op="frame_ack")) > 5, "no pictures were taken")
    canvas = part(page, "canvas")
    red, green, blue = pixel(canvas, 2, 477)
    assert red > green > blue
    expect(part(page, "codec-note")).to_have_count(0)


def test_h264_that_the_robot_has_not_falls_back(open_page: OpenPage, relay: FakeRelay) -> None:
    """Refused H.264 is replaced by JPEG, and the controls show the reason; another camera tries it again."""
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


PASSING = (
    "camera /camera/image_raw has sent no frame for 10 s",
    "you start streams of robot rover-1 too fast; try again in 1 s",
    "robot rover-1 has 16 streams open, the most it can",
)


def test_h264_that_is_not_to_be_had_just_now_is_asked_for_again(
    open_page: OpenPage, relay: FakeRelay
) -> None:
    """A failure outside the encoder does not exclude H.264: the next time it is tried again, and shown."""
    page = watching(open_page)
    part(page, "settings").click()
    part(page, "ask-codec").select_option("h264")
    relay.until(lambda: last_watch(relay).get("codec") == "h264", "H.264 was not asked for")
    for reason in PASSING:
        relay.do(close_video=4503, reason=reason, clear_log=True)
        relay.until(
            lambda: relay.log(op="watch") and len(relay.log(op="frame_ack")) > 3,
            f"the pictures did not come back after '{reason}'",
        )
        assert {each.get("codec") for each in relay.log(op="watch")} == {"h264"}
        expect(part(page, "codec-note")).to_have_count(0)


def test_the_reason_for_missing_h264_is_shown(open_page: OpenPage) -> None:
    """On a page by plain http the choice is disabled, with the reason beside it."""
    page = open_page("/fleet", user="driver")
    page.add_init_script("Object.defineProperty(window, 'isSecureContext', { value: false })")
    page.goto(COCKPIT)
    expect(part(page, "fps")).to_have_text(RUNS)
    part(page, "settings").click()
    expect(part(page, "codec-note")).to_contain_text("H.264 needs https")
    expect(part(page, "ask-codec").locator("option[value=h264]")).to_be_disabled()


def test_four_cameras_fit(open_page: OpenPage) -> None:
    """With all panes and their controls open the page is not wider than its window."""
    page = watching(open_page, height=844)
    for count in (2, 3, 4):
        part(page, "add").click()
        expect(part(page, "pane")).to_have_count(count)
    expect(part(page, "add")).to_have_count(0)
    for button in part(page, "settings").all():
        button.click()
    expect(part(page, "controls")).to_have_count(4)
    for width in (1280, 768, 390):
        page.set_viewport_size({"width": width, "height": 844})
        page.wait_for_function("document.documentElement.scrollWidth <= innerWidth")
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
