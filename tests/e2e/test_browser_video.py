"""The cockpit's cameras in a real browser: real relay, daemon and camera process, simulated camera."""

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
from playwright.sync_api import Browser, Error, Locator, Page, expect

from tests.worlds.browser import checked_pages, open_session, running_world
from tests.worlds.chaos_proxy import ChaosProxy
from tests.worlds.http_requests import ask
from tests.worlds.other_pages import OtherPages, readme_example
from tests.worlds.relay_process import Relay
from tests.worlds.robot_process import Robot
from tests.worlds.video_clients import CAMERA, decoded, get
from tests.worlds.waiting import wait_for

PASSWORD = "correct horse"
WAIT_SECONDS = 60.0
COMPRESSED = f"{CAMERA}/compressed"
"""The same camera as JPEG of its own."""
RESTART_SECONDS = 60.0
"""A busy machine needs some seconds for a new process, and the page asks less and less often meanwhile."""
REVOKED = f"Your right to view {CAMERA} was revoked."

OpenPage = Callable[[], Page]


class World:
    """A relay, a robot with its camera on, a viewer."""

    def __init__(self, folder: Path) -> None:
        self.modules = folder / "modules"
        """Where the robot's Python looks for modules first."""
        self.modules.mkdir()
        self.pages = OtherPages(folder / "pages")
        self.relay = Relay(folder, "--origin", self.pages.listed)
        # With an installed ROS, unlike a wheel, its modules are found by this path.
        paths = os.pathsep.join(filter(None, (str(self.modules), os.environ.get("PYTHONPATH"))))
        self.robot = Robot(
            self.relay,
            "rover",
            camera=True,
            sim_options=("--no-depth",),
            daemon_env={"PYTHONPATH": paths},
        )
        self.watcher = self.relay.user("watcher")
        self.relay.cli("right", "grant", "watcher", "rover", "viewer")

        def cameras() -> set[str]:
            known = get(self.relay, self.watcher, "cameras").json["cameras"]
            return {each["name"] for each in known}

        wait_for("its cameras are known", lambda: cameras() == {CAMERA, COMPRESSED})

    def snapshot(self, **parameters: Any) -> bytes:
        """A JPEG of the robot's camera."""
        return get(self.relay, self.watcher, "snapshot", **parameters).body

    def scene(self, **parameters: Any) -> Any:
        """The robot's camera as pixels, height × width × 3."""
        return decoded(self.snapshot(**parameters))

    def streams(self) -> list[dict[str, Any]]:
        """The robot's streams in ``/relay/status``."""
        with self.relay.connect("rover", self.watcher) as client:
            client.send(op="subscribe", topic="/relay/status")
            return list(client.until(op="publish", topic="/relay/status")["msg"]["video"])

    def until_streamed(self, camera: str, **like: Any) -> None:
        """Waits until one stream of a camera has viewers and these values."""

        def there() -> bool:
            watched = [each for each in self.streams() if each["camera"] == camera and each["viewers"]]
            return len(watched) == 1 and like.items() <= watched[0].items()

        wait_for(f"{camera} is shown with {like}", there)

    def camera_process(self) -> psutil.Process:
        """The daemon's camera process, once it runs."""

        def found() -> psutil.Process | None:
            children = psutil.Process(self.robot.daemon.popen.pid).children()
            return next((each for each in children if "robot_client.camera.main" in each.cmdline()), None)

        process: psutil.Process = wait_for("there is a camera process", found)
        return process

    def links(self) -> int:
        """The number of streams of the camera process, each with its own connection."""
        connections = self.camera_process().net_connections("tcp")
        return sum(bool(each.raddr) and each.raddr.port == self.relay.robots_port for each in connections)

    def stop(self) -> None:
        self.pages.stop()
        self.robot.stop()
        self.relay.stop()


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """One world for all; each test leaves its robot online."""
    yield from running_world(World, tmp_path_factory.mktemp("browser"))


@pytest.fixture
def open_page(browser: Browser, world: World) -> Iterator[OpenPage]:
    """Opens cockpits; an uncaught error or a violation of the CSP in any of them fails the test."""
    with checked_pages(
        browser, f"http://127.0.0.1:{world.relay.http_port}", WAIT_SECONDS, steady=False
    ) as new_page:
        yield lambda: in_cockpit(new_page(1280, 800))


def in_cockpit(page: Page) -> Page:
    """The cockpit with live video."""
    open_session(page, "watcher", PASSWORD)
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
    """Pixels of a canvas, height × width × 3."""
    data = part(where, "canvas").evaluate("canvas => canvas.toDataURL('image/png')")
    return decoded(base64.b64decode(data.partition(",")[2]))


def goes_on(where: Page | Locator, seconds: float = WAIT_SECONDS) -> None:
    """Waits until the canvas shows another frame with a later clock."""
    before = shown(where)

    def changed() -> bool:
        now = shown(where)
        return now.shape == before.shape and bool(cv2.absdiff(now, before).max() > 60)

    wait_for("the picture goes on", changed, seconds)


def ask_for(page: Page, **wanted: str) -> None:
    """Sets a value in the controls."""
    if not part(page, "controls").is_visible():
        part(page, "settings").click()
    for name, value in wanted.items():
        part(page, f"ask-{name}").select_option(value)


def same_scene(picture: Any, other: Any) -> bool:
    """Whether two pictures of a standing robot are equal, except for the clock."""
    return picture.shape == other.shape and bool(cv2.absdiff(picture, other).mean() < 8)


def listen(where: Locator) -> None:
    """From now on the page records messages over the video, with their times."""
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


def text_shown(page: Page, words: str) -> float:
    """Waits for a message over the video; returns its Unix time."""

    def found() -> float | None:
        return next((at for at, said in page.evaluate("window.heard") if words in said), None)

    return float(wait_for(f"the pane says '{words}'", found))


def gone(process: psutil.Process) -> bool:
    """Whether it has ended; its parent may have been killed before reaping it."""
    try:
        return process.status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True


def test_chosen_values_are_delivered(world: World, open_page: OpenPage) -> None:
    """Size, quality, rate and rotation reach the robot, and the picture has them; the shown rate, delay and
    bytes are right.
    """
    page = open_page()
    assert shown(page).shape == (480, 640, 3)
    ask_for(page, width="320", quality="40", fps="5")
    world.until_streamed(COMPRESSED, width=320, height=240, quality=40, fps=5)
    expect(part(page, "size")).to_have_text("320 × 240")
    assert same_scene(shown(page), world.scene(width=320, quality=40))
    ask_for(page, rotate="90")
    turned = world.scene(width=320, quality=40, rotate=90)
    world.until_streamed(COMPRESSED, width=320, height=turned.shape[0], quality=40, fps=5)
    expect(part(page, "size")).to_have_text(f"320 × {turned.shape[0]}")
    assert same_scene(shown(page), turned)
    expect(part(page, "fps")).to_have_text(re.compile("^[45] fps$"))
    expect(part(page, "delay")).to_have_text(re.compile(r"^(< 1|\d+) ms old$"))
    expect(part(page, "bytes")).to_have_text(re.compile(r"^\d+ kB/s$"))
    reported = int(str(part(page, "bytes").text_content()).split()[0]) * 1000
    size = len(world.snapshot(width=320, quality=40, rotate=90))
    assert 2 * size < reported < 8 * size


def test_the_snapshot_is_a_jpeg_of_what_is_shown(world: World, open_page: OpenPage, tmp_path: Path) -> None:
    """It shows the robot's view in the size on the screen, and its name has the capture time."""
    page = open_page()
    with page.expect_download() as reported:
        part(page, "snapshot").click()
    reported.value.save_as(tmp_path / "snapshot")
    name = re.fullmatch(
        r"rover-camera-image_raw-compressed-(.*)-(\d{3})Z\.jpg", reported.value.suggested_filename
    )
    assert name
    taken = datetime.strptime(f"{name[1]}.{name[2]}+0000", "%Y-%m-%dT%H-%M-%S.%f%z")
    assert abs(time.time() - taken.timestamp()) < WAIT_SECONDS
    saved = (tmp_path / "snapshot").read_bytes()
    assert saved.startswith(b"\xff\xd8\xff")
    assert same_scene(decoded(saved), world.scene())


def test_two_cameras_side_by_side(world: World, open_page: OpenPage) -> None:
    """Each is a stream of its own, and both continue."""
    page = open_page()
    part(page, "add").click()
    panes = [pane(page, camera) for camera in (COMPRESSED, CAMERA)]
    for camera, each in zip((COMPRESSED, CAMERA), panes, strict=True):
        expect(part(each, "fps")).to_have_text(RUNS)
        world.until_streamed(camera, viewers=1, width=640)
        goes_on(each)
        assert same_scene(shown(each), world.scene())
    left, right = (each.bounding_box() for each in panes)
    assert left
    assert right
    assert left["y"] == right["y"]
    assert left["x"] + left["width"] <= right["x"]


FULL = """
  for (let number = 0; number < 6; number++) {
    const image = document.createElement('img')
    image.src = `/robots/rover/video/stream?topic=CAMERA&number=${number}`
    document.body.append(image)
  }
""".replace("CAMERA", CAMERA)
"""Six image streams hold all connections of HTTP/1.1 that the browser allows to the relay."""

IS_FULL = """
  () => fetch('/api/v1/session', { signal: AbortSignal.timeout(1000) }).then(() => false, () => true)
"""


def test_a_stop_passes_when_image_streams_hold_all_connections(world: World, open_page: OpenPage) -> None:
    """In the cockpit, on the card of a robot, and for all robots."""
    page = open_page()
    page.evaluate(FULL)
    wait_for("no request gets a connection", lambda: page.evaluate(IS_FULL))
    stop = page.get_by_test_id("stop")

    def stopped_by(click: Callable[[], None], words: Locator, text: str) -> None:
        click()
        expect(words).to_contain_text(text)
        # Another path of the same press may still arrive.
        wait_for("it is resumed", lambda: world.relay.run_cli("resume", "rover").returncode == 0)

    stopped_by(stop.click, page.get_by_test_id("drive-words"), "The robot is stopped.")
    page.get_by_role("link", name="all robots").click()
    card = page.get_by_test_id("robot-card")
    stopped_by(card.get_by_test_id("stop").click, page.get_by_text("rover is stopped."), "rover")
    expect(card.get_by_test_id("robot-stopped")).to_have_count(0)
    page.get_by_role("button", name="Stop all robots").click()
    expect(card.get_by_test_id("robot-stopped")).to_have_text("Stopped")
    assert page.evaluate(IS_FULL)
    world.relay.cli("resume", "rover")


HIDE = """hidden => {
  Object.defineProperty(document, 'hidden', { value: hidden, configurable: true })
  document.dispatchEvent(new Event('visibilitychange'))
}"""


def test_the_page_of_a_stream_holds_no_http_connection_and_pauses_while_it_is_hidden(
    world: World, open_page: OpenPage
) -> None:
    """Seven such pages leave room for requests."""
    page = open_page()
    page.goto("about:blank")
    wait_for("nobody watches", lambda: not any(each["viewers"] for each in world.streams()))
    pages = [page, *(page.context.new_page() for _ in range(6))]
    for each in pages:
        each.goto(f"/robots/rover/video/stream_viewer?topic={CAMERA}&width=320")
        expect(each.locator("img")).to_have_js_property("naturalWidth", 320)
    world.until_streamed(CAMERA, viewers=7, width=320)
    assert not page.evaluate(IS_FULL)
    for each in pages:
        each.evaluate(HIDE, True)
    wait_for("nobody watches", lambda: not any(each["viewers"] for each in world.streams()))
    page.evaluate(HIDE, False)
    world.until_streamed(CAMERA, viewers=1, width=320)
    before = page.evaluate("document.querySelector('img').src")
    wait_for("frames come", lambda: page.evaluate("document.querySelector('img').src") != before)
    for each in pages[1:]:
        each.close()


def test_the_page_of_png_gives_up_its_connection_while_it_is_hidden(
    world: World, open_page: OpenPage
) -> None:
    """PNG comes as an image stream, which holds an HTTP connection."""
    page = open_page()
    page.goto(f"/robots/rover/video/stream_viewer?topic={CAMERA}&width=320&type=png")
    world.until_streamed(CAMERA, viewers=1, width=320)
    expect(page.locator("img")).to_have_js_property("naturalWidth", 320)
    page.evaluate(HIDE, True)
    wait_for("nobody watches", lambda: not any(each["viewers"] for each in world.streams()))
    page.evaluate(HIDE, False)
    world.until_streamed(CAMERA, viewers=1, width=320)
    expect(page.locator("img")).to_have_js_property("naturalWidth", 320)


def foreign(browser: Browser, world: World, url: str) -> Page:
    """A page of another site, which has no session with the relay."""
    page = browser.new_context(base_url=url).new_page()
    page.set_default_timeout(WAIT_SECONDS * 1000)
    page.goto("/")
    return page


def ticket(world: World) -> str:
    """A ticket for all cameras."""
    answer = ask(
        world.relay.http_port,
        "POST",
        "/api/v1/tickets",
        {"robot": "rover", "for": "video"},
        token=world.watcher,
    )
    return str(answer.json["ticket"])


def test_the_example_of_the_readme_runs_on_a_page_of_a_listed_origin(world: World, browser: Browser) -> None:
    """With an unmodified roslib.js, from another site. From an origin that is not listed it gets no ticket."""
    address = f"127.0.0.1:{world.relay.http_port}"
    world.pages.add_program("example.js", readme_example(address, "rover", world.watcher))
    page = foreign(browser, world, world.pages.listed)
    with page.expect_console_message() as odometry:
        page.add_script_tag(url="/example.js", type="module")
    message = odometry.value.args[0].json_value()
    assert message.keys() == {"header", "child_frame_id", "pose", "twist"}
    page.context.close()
    page = foreign(browser, world, world.pages.unlisted)
    with page.expect_event("pageerror") as refused:
        page.add_script_tag(url="/example.js", type="module")
    assert "Failed to fetch" in str(refused.value)
    page.context.close()


FRAME = """([relay, query]) => {
  const frame = document.createElement('iframe')
  frame.src = `http://${relay}/robots/rover/video/stream_viewer?${query}`
  document.body.append(frame)
}"""
DRAWN = """async ([relay, query]) => {
  const image = new Image()
  image.crossOrigin = 'anonymous'
  image.src = `http://${relay}/robots/rover/video/snapshot?${query}`
  await image.decode()
  const canvas = document.createElement('canvas')
  canvas.getContext('2d').drawImage(image, 0, 0)
  return canvas.getContext('2d').getImageData(0, 0, 1, 1).data.length
}"""


def test_a_page_of_a_listed_origin_shows_a_camera(world: World, browser: Browser) -> None:
    """The page of a stream in a frame, and a snapshot in a canvas, each by a ticket."""
    address = f"127.0.0.1:{world.relay.http_port}"

    def query() -> str:
        return f"topic={CAMERA}&width=320&ticket={ticket(world)}"

    page = foreign(browser, world, world.pages.listed)
    page.evaluate(FRAME, [address, query()])
    expect(page.frame_locator("iframe").locator("img")).to_have_js_property("naturalWidth", 320)
    assert page.evaluate(DRAWN, [address, query()]) == 4
    page.context.close()
    page = foreign(browser, world, world.pages.unlisted)
    with page.expect_console_message(lambda message: "frame-ancestors" in message.text):
        page.evaluate(FRAME, [address, query()])
    with pytest.raises(Error, match="cannot be decoded"):
        page.evaluate(DRAWN, [address, query()])
    page.context.close()


def test_h264_is_shown(world: World, open_page: OpenPage) -> None:
    """The decoded frames show the robot's view, and continue."""
    page = open_page()
    ask_for(page, codec="h264")
    world.until_streamed(COMPRESSED, codec="h264", width=640)
    goes_on(page)
    assert same_scene(shown(page), world.scene())
    expect(part(page, "fps")).to_have_text(RUNS)
    expect(part(page, "codec-note")).to_have_count(0)


def test_h264_is_replaced_by_jpeg_over_a_link_that_is_too_slow_for_it(world: World, browser: Browser) -> None:
    """After 10 s without smooth video the page asks for JPEG, and shows why."""
    proxy = ChaosProxy(world.relay.http_port)
    try:
        with checked_pages(browser, f"http://127.0.0.1:{proxy.port}", WAIT_SECONDS) as new_page:
            page = in_cockpit(new_page(1280, 800))
            ask_for(page, codec="h264")
            world.until_streamed(COMPRESSED, codec="h264", width=640)
            proxy.squeeze_down(300_000)
            expect(part(page, "codec-note")).to_have_text(
                "This link is too slow for H.264. JPEG is shown instead."
            )
            world.until_streamed(COMPRESSED, codec="jpeg")
            proxy.squeeze_down(None)
            expect(part(page, "fps")).to_have_text(RUNS)
    finally:
        proxy.close()


def test_a_browser_without_webcodecs_shows_jpeg_with_the_reason(world: World, open_page: OpenPage) -> None:
    """Though H.264 was chosen when a decoder was available."""
    page = open_page()
    ask_for(page, codec="h264")
    world.until_streamed(COMPRESSED, codec="h264")
    page.add_init_script("delete window.VideoDecoder")
    page.reload()
    world.until_streamed(COMPRESSED, codec="jpeg")
    goes_on(page)
    part(page, "settings").click()
    expect(part(page, "codec-note")).to_contain_text("This browser has no decoder for H.264 (WebCodecs).")
    expect(part(page, "ask-codec")).to_have_value("jpeg")


def test_a_robot_without_pyav_shows_jpeg_with_the_reason(world: World, open_page: OpenPage) -> None:
    """The robot's reason is in the controls, and the video continues."""
    (world.modules / "av.py").write_text("raise ImportError('there is no av here')")
    page = open_page()
    # A camera process that has imported PyAV keeps it.
    process = world.camera_process()
    process.kill()
    wait_for("it is gone", lambda: gone(process))
    ask_for(page, codec="h264")
    try:
        words = re.compile("^H.264 needs PyAV.*JPEG is shown instead.$")
        expect(part(page, "codec-note")).to_have_text(words)
        world.until_streamed(COMPRESSED, codec="jpeg")
        goes_on(page)
    finally:
        (world.modules / "av.py").unlink()


def test_a_revoked_right_is_shown_at_once_and_ends_the_stream(world: World, open_page: OpenPage) -> None:
    """With two cameras: the pane of one shows the reason and keeps it, and the robot stops its stream. The
    other pane continues; a new right restores the video.
    """
    page = open_page()
    part(page, "add").click()
    denied, left = pane(page, CAMERA), pane(page, COMPRESSED)
    goes_on(denied)
    wait_for("the robot shows both and no others", lambda: world.links() == 2)
    listen(denied)
    world.relay.cli("right", "grant", "watcher", "rover", "viewer", "--deny", f"view:{CAMERA}")
    text_shown(page, REVOKED)
    last = shown(denied)
    wait_for("the robot shows one", lambda: world.links() == 1)
    goes_on(left)
    # Until the page knows that the camera is not available.
    expect(part(left, "topic").locator(f"option[value='{CAMERA}']")).to_have_count(0)
    expect(part(denied, "words")).to_contain_text(REVOKED)
    assert np.array_equal(shown(denied), last)
    world.relay.cli("right", "grant", "watcher", "rover", "viewer")
    goes_on(denied)
    expect(part(denied, "words")).to_have_count(0)


def test_frames_come_back_when_the_camera_process_was_killed(world: World, open_page: OpenPage) -> None:
    """The pane shows since when there is no frame, and continues by itself."""
    page = open_page()
    listen(pane(page, COMPRESSED))
    process = world.camera_process()
    process.kill()
    text_shown(page, "No frame for")
    goes_on(page, RESTART_SECONDS)
    expect(part(page, "stale")).to_have_count(0)
    assert world.camera_process().pid != process.pid


def test_frames_come_back_when_the_daemon_was_killed(world: World, open_page: OpenPage) -> None:
    """Its camera process ends with it; after a restart current viewers get their streams again."""
    page = open_page()
    process = world.camera_process()
    world.robot.daemon.kill()
    wait_for("the camera process has ended", lambda: gone(process))
    expect(part(page, "words")).to_have_text("The robot is offline.")
    expect(part(page, "stale")).to_have_text(re.compile(r"No frame for \d+ s"))
    world.robot.start_daemon()
    goes_on(page, RESTART_SECONDS)
    expect(part(page, "words")).to_have_count(0)
    expect(part(page, "fps")).to_have_text(RUNS)
