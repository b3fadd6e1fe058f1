"""The cockpit's cameras in a real browser: real relay, daemon, camera process and simulated camera behind them."""

from __future__ import annotations

import base64
import os
import re
import time
from collections.abc import Callable, Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import psutil
import pytest
from playwright.sync_api import Browser, Locator, Page, expect
from switchboard_browser import lived_in, sound_pages
from switchboard_proxy import ChaosProxy
from switchboard_relay import Relay
from switchboard_robot import Robot
from switchboard_video import CAMERA, decoded, get
from switchboard_waiting import wait_for

PASSWORD = "correct horse"
WAIT_SECONDS = 60.0
COMPRESSED = f"{CAMERA}/compressed"
"""The same camera as JPEG of its own."""
RESTART_SECONDS = 60.0
"""A busy machine needs some seconds for a new process, and the page asks less and less often meanwhile."""
REVOKED = f"Your right to view {CAMERA} was revoked."

OpenPage = Callable[[], Page]


class House:
    """A relay, a robot with its camera on, a watcher."""

    def __init__(self, folder: Path) -> None:
        self.modules = folder / "modules"
        """Where the robot's Python looks for modules first."""
        self.modules.mkdir()
        self.relay = Relay(folder)
        # Where ROS is installed rather than a wheel, its modules are found by this path.
        paths = os.pathsep.join(filter(None, (str(self.modules), os.environ.get("PYTHONPATH"))))
        self.robot = Robot(self.relay, "rover", camera=True, daemon_env={"PYTHONPATH": paths})
        self.watcher = self.relay.user("watcher")
        self.relay.cli("right", "grant", "watcher", "rover", "viewer")

        def cameras() -> set[str]:
            known = get(self.relay, self.watcher, "cameras").json["cameras"]
            return {each["name"] for each in known}

        wait_for("its cameras are known", lambda: cameras() == {CAMERA, COMPRESSED})

    def snapshot(self, **parameters: Any) -> bytes:
        """What the robot sees now, as JPEG."""
        return get(self.relay, self.watcher, "snapshot", **parameters).body

    def scene(self, **parameters: Any) -> Any:
        """What the robot sees now: pixels, height × width × 3."""
        return decoded(self.snapshot(**parameters))

    def streams(self) -> list[dict[str, Any]]:
        """The robot's streams as ``/relay/status`` tells of them."""
        with self.relay.connect("rover", self.watcher) as client:
            client.send(op="subscribe", topic="/relay/status")
            return list(client.until(op="publish", topic="/relay/status")["msg"]["video"])

    def until_streamed(self, camera: str, **like: Any) -> None:
        """Wait until one stream of a camera is watched, and is like this."""

        def there() -> bool:
            watched = [each for each in self.streams() if each["camera"] == camera and each["viewers"]]
            return len(watched) == 1 and like.items() <= watched[0].items()

        wait_for(f"{camera} is shown with {like}", there)

    def camera_process(self) -> psutil.Process:
        """The daemon's process that makes pictures, once it has one."""

        def found() -> psutil.Process | None:
            children = psutil.Process(self.robot.daemon.popen.pid).children()
            return next((each for each in children if "robot_client.camera.main" in each.cmdline()), None)

        process: psutil.Process = wait_for("there is a camera process", found)
        return process

    def links(self) -> int:
        """How many streams its camera process sends, each by a connection of its own."""
        connections = self.camera_process().net_connections("tcp")
        return sum(bool(each.raddr) and each.raddr.port == self.relay.robots_port for each in connections)

    def stop(self) -> None:
        """End everything."""
        self.robot.stop()
        self.relay.stop()


@pytest.fixture(scope="module")
def house(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    """One house for all; each test leaves its robot online."""
    yield from lived_in(House, tmp_path_factory.mktemp("browser"))


@pytest.fixture
def open_page(browser: Browser, house: House) -> Iterator[OpenPage]:
    """Opens cockpits; an uncaught error or a breach of the CSP in any of them fails the test."""
    with sound_pages(browser, f"http://127.0.0.1:{house.relay.http_port}", WAIT_SECONDS) as new_page:
        yield lambda: in_cockpit(new_page(1280, 800))


def in_cockpit(page: Page) -> Page:
    """The cockpit, with a picture that runs."""
    credentials = {"user": "watcher", "password": PASSWORD}
    headers = {"X-Requested-With": "switchboard"}
    assert page.request.post("/api/v1/session", data=credentials, headers=headers).ok
    page.goto("/cockpit/rover")
    expect(part(page, "fps")).to_have_text(RUNS)
    return page


RUNS = re.compile(r"^[1-9]\d* fps$")


def part(where: Page | Locator, name: str) -> Locator:
    """An element of a camera's pane."""
    return where.get_by_test_id(f"camera-{name}")


def pane(page: Page, camera: str) -> Locator:
    """The pane that shows a camera."""
    return page.locator(f"[data-testid=camera-pane][data-camera='{camera}']")


def shown(where: Page | Locator) -> Any:
    """What a canvas shows: pixels, height × width × 3."""
    data = part(where, "canvas").evaluate("canvas => canvas.toDataURL('image/png')")
    return decoded(base64.b64decode(data.partition(",")[2]))


def goes_on(where: Page | Locator, seconds: float = WAIT_SECONDS) -> None:
    """Wait until the picture on a canvas is another one, whose clock has gone on."""
    before = shown(where)

    def changed() -> bool:
        now = shown(where)
        return now.shape == before.shape and bool(cv2.absdiff(now, before).max() > 60)

    wait_for("the picture goes on", changed, seconds)


def ask_for(page: Page, **wanted: str) -> None:
    """Choose in the controls."""
    if not part(page, "controls").is_visible():
        part(page, "settings").click()
    for name, value in wanted.items():
        part(page, f"ask-{name}").select_option(value)


def same_scene(picture: Any, other: Any) -> bool:
    """Whether two pictures of a robot that stands show the same, but for the clock."""
    return picture.shape == other.shape and bool(cv2.absdiff(picture, other).mean() < 8)


def listen(where: Locator) -> None:
    """From now on the page keeps what is said over a picture, and when."""
    where.evaluate(
        """pane => {
            window.heard = []
            new MutationObserver(() => {
                for (const name of ['camera-stale', 'camera-words']) {
                    const words = pane.querySelector(`[data-testid=${name}]`)?.textContent
                    if (words) window.heard.push([Date.now() / 1000, words])
                }
            }).observe(pane, { subtree: true, childList: true, characterData: true })
        }"""
    )


def heard(page: Page, words: str) -> float:
    """Wait until something is said over the picture; the Unix time at which it was."""

    def found() -> float | None:
        return next((at for at, said in page.evaluate("window.heard") if words in said), None)

    return float(wait_for(f"the pane says '{words}'", found))


def gone(process: psutil.Process) -> bool:
    """Whether it has ended; who would reap it may have been killed before it."""
    try:
        return process.status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True


def test_what_is_chosen_is_what_comes(house: House, open_page: OpenPage) -> None:
    """Size, quality, rate and rotation reach the robot, and the picture has them; what is told of rate, age and bytes
    is so.
    """
    page = open_page()
    assert shown(page).shape == (480, 640, 3)
    ask_for(page, width="320", quality="40", fps="5")
    house.until_streamed(COMPRESSED, width=320, height=240, quality=40, fps=5)
    expect(part(page, "size")).to_have_text("320 × 240")
    assert same_scene(shown(page), house.scene(width=320, quality=40))
    ask_for(page, rotate="90")
    turned = house.scene(width=320, quality=40, rotate=90)
    house.until_streamed(COMPRESSED, width=320, height=turned.shape[0], quality=40, fps=5)
    expect(part(page, "size")).to_have_text(f"320 × {turned.shape[0]}")
    assert same_scene(shown(page), turned)
    expect(part(page, "fps")).to_have_text(re.compile("^[45] fps$"))
    expect(part(page, "delay")).to_have_text(re.compile(r"^(< 1|\d+) ms old$"))
    expect(part(page, "bytes")).to_have_text(re.compile(r"^\d+ kB/s$"))
    told = int(str(part(page, "bytes").text_content()).split()[0]) * 1000
    size = len(house.snapshot(width=320, quality=40, rotate=90))
    assert 2 * size < told < 8 * size


def test_the_snapshot_is_a_jpeg_of_what_is_shown(house: House, open_page: OpenPage, tmp_path: Path) -> None:
    """It is what the robot sees, of the size on the screen, and its name has the time it was taken."""
    page = open_page()
    with page.expect_download() as told:
        part(page, "snapshot").click()
    told.value.save_as(tmp_path / "snapshot")
    name = re.fullmatch(
        r"rover-camera-image_raw-compressed-(.*)-(\d{3})Z\.jpg", told.value.suggested_filename
    )
    assert name
    taken = datetime.strptime(f"{name[1]}.{name[2]}+0000", "%Y-%m-%dT%H-%M-%S.%f%z")
    assert abs(time.time() - taken.timestamp()) < WAIT_SECONDS
    saved = (tmp_path / "snapshot").read_bytes()
    assert saved.startswith(b"\xff\xd8\xff")
    assert same_scene(decoded(saved), house.scene())


def test_two_cameras_side_by_side(house: House, open_page: OpenPage) -> None:
    """Each is a stream of its own, and both go on."""
    page = open_page()
    part(page, "add").click()
    panes = [pane(page, camera) for camera in (COMPRESSED, CAMERA)]
    for camera, each in zip((COMPRESSED, CAMERA), panes, strict=True):
        expect(part(each, "fps")).to_have_text(RUNS)
        house.until_streamed(camera, viewers=1, width=640)
        goes_on(each)
        assert same_scene(shown(each), house.scene())
    left, right = (each.bounding_box() for each in panes)
    assert left
    assert right
    assert left["y"] == right["y"]
    assert left["x"] + left["width"] <= right["x"]


def test_h264_is_shown(house: House, open_page: OpenPage) -> None:
    """Decoded by the browser it is what the robot sees, and it goes on."""
    page = open_page()
    ask_for(page, codec="h264")
    house.until_streamed(COMPRESSED, codec="h264", width=640)
    goes_on(page)
    assert same_scene(shown(page), house.scene())
    expect(part(page, "fps")).to_have_text(RUNS)
    expect(part(page, "codec-note")).to_have_count(0)


def test_h264_gives_way_to_jpeg_over_a_link_that_is_too_thin_for_it(house: House, browser: Browser) -> None:
    """What comes of it now and then is no moving picture: after ten seconds the page asks for JPEG, and says why."""
    proxy = ChaosProxy(house.relay.http_port)
    try:
        with sound_pages(browser, f"http://127.0.0.1:{proxy.port}", WAIT_SECONDS) as new_page:
            page = in_cockpit(new_page(1280, 800))
            ask_for(page, codec="h264")
            house.until_streamed(COMPRESSED, codec="h264", width=640)
            proxy.squeeze_down(300_000)
            expect(part(page, "codec-note")).to_have_text(
                "This link is too thin for H.264. JPEG is shown instead."
            )
            house.until_streamed(COMPRESSED, codec="jpeg")
            proxy.squeeze_down(None)
            expect(part(page, "fps")).to_have_text(RUNS)
    finally:
        proxy.close()


def test_a_browser_without_webcodecs_shows_jpeg_and_says_why(house: House, open_page: OpenPage) -> None:
    """Though H.264 was chosen when it had a decoder."""
    page = open_page()
    ask_for(page, codec="h264")
    house.until_streamed(COMPRESSED, codec="h264")
    page.add_init_script("delete window.VideoDecoder")
    page.reload()
    house.until_streamed(COMPRESSED, codec="jpeg")
    goes_on(page)
    part(page, "settings").click()
    expect(part(page, "codec-note")).to_contain_text("This browser has no decoder for H.264 (WebCodecs).")
    expect(part(page, "ask-codec")).to_have_value("jpeg")


def test_a_robot_without_pyav_shows_jpeg_and_says_why(house: House, open_page: OpenPage) -> None:
    """Its own words are in the controls, and the picture goes on."""
    (house.modules / "av.py").write_text("raise ImportError('there is no av here')")
    page = open_page()
    # One that has imported it has it.
    process = house.camera_process()
    process.kill()
    wait_for("it is gone", lambda: gone(process))
    ask_for(page, codec="h264")
    try:
        words = re.compile("^H.264 needs PyAV.*JPEG is shown instead.$")
        expect(part(page, "codec-note")).to_have_text(words)
        house.until_streamed(COMPRESSED, codec="jpeg")
        goes_on(page)
    finally:
        (house.modules / "av.py").unlink()


def test_a_revoked_right_is_said_at_once_and_ends_the_stream(house: House, open_page: OpenPage) -> None:
    """To view one of two cameras: its pane says why, and goes on saying it; the robot sends no
    more of it; the other pane goes on; a new right brings the picture back.
    """
    page = open_page()
    part(page, "add").click()
    denied, left = pane(page, CAMERA), pane(page, COMPRESSED)
    goes_on(denied)
    wait_for("the robot shows both and no others", lambda: house.links() == 2)
    listen(denied)
    house.relay.cli("right", "grant", "watcher", "rover", "viewer", "--deny", f"view:{CAMERA}")
    heard(page, REVOKED)
    last = shown(denied)
    wait_for("the robot shows one", lambda: house.links() == 1)
    goes_on(left)
    # Until the page knows that there is no such camera for it.
    expect(part(left, "topic").locator(f"option[value='{CAMERA}']")).to_have_count(0)
    expect(part(denied, "words")).to_contain_text(REVOKED)
    assert np.array_equal(shown(denied), last)
    house.relay.cli("right", "grant", "watcher", "rover", "viewer")
    goes_on(denied)
    expect(part(denied, "words")).to_have_count(0)


def test_pictures_come_back_when_the_camera_process_was_killed(house: House, open_page: OpenPage) -> None:
    """The pane says since when there is none, and shows the next ones by itself."""
    page = open_page()
    listen(pane(page, COMPRESSED))
    process = house.camera_process()
    process.kill()
    heard(page, "No picture since")
    goes_on(page, RESTART_SECONDS)
    expect(part(page, "stale")).to_have_count(0)
    assert house.camera_process().pid != process.pid


def test_pictures_come_back_when_the_daemon_was_killed(house: House, open_page: OpenPage) -> None:
    """Its camera process ends with it; started again it shows what was watched to those who still do."""
    page = open_page()
    process = house.camera_process()
    house.robot.daemon.kill()
    wait_for("the camera process has ended", lambda: gone(process))
    expect(part(page, "words")).to_have_text("The robot is offline.")
    expect(part(page, "stale")).to_have_text(re.compile(r"No picture since \d+ s"))
    house.robot.start_daemon()
    goes_on(page, RESTART_SECONDS)
    expect(part(page, "words")).to_have_count(0)
    expect(part(page, "fps")).to_have_text(RUNS)
