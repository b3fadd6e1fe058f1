"""The camera process under a real daemon: a simulated ROS camera, and a relay that receives its frames."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import psutil
import pytest
import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Image

from relay_protocol import frames, link
from robot_client.platforms.ros2.transport import without_shared_memory
from tests.robot_client.robot_process import Robot, until
from tests.worlds.fake_relay import PATIENCE, FakeRelay, Peer
from tests.worlds.processes import mortal
from tests.worlds.rtsp_camera import RtspCamera, card

RAW = "/camera/image_raw"
COMPRESSED = "/camera/image_raw/compressed"
PROCESS = "robot_client.camera.main"
SIZE = (640, 480)


@pytest.fixture(scope="module")
def camera(environment: dict[str, str]) -> Iterator[None]:
    """A simulated robot that publishes images while it has subscribers."""
    command = mortal([sys.executable, "-m", "robot_client.sim.main", "--camera", "--seed", "1"])
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "READY\n"
            yield
        finally:
            process.terminate()


class Scene:
    """A registered daemon beside that robot."""

    def __init__(self, relay: FakeRelay, robot: Robot, *options: str) -> None:
        self.relay = relay
        self.robot = robot
        self.process = robot.run(*options)
        # A busy machine may delay a process for seconds.
        self.control = relay.register(heartbeat=5.0)

    def cameras(self) -> list[psutil.Process]:
        return self.robot.children(self.process, PROCESS)

    def until_listed(self, name: str, **like: object) -> link.Camera:
        """The camera, once the robot has reported these values."""
        while True:
            for each in self.control.expect(link.Cameras).cameras:
                if each.name == name and all(getattr(each, key) == value for key, value in like.items()):
                    return each

    def video(self, name: str, settings: link.VideoSettings | None = None, stream: str = "s1") -> Peer:
        return self.relay.video(self.control, name, settings, stream)


@pytest.fixture
def relay() -> Iterator[FakeRelay]:
    with closing(FakeRelay()) as made:
        yield made


@pytest.fixture
def robot(relay: FakeRelay, tmp_path: Path, environment: dict[str, str]) -> Iterator[Robot]:
    with closing(Robot(relay, tmp_path / "state", environment)) as made:
        made.enroll()
        yield made


@pytest.fixture
def scene(relay: FakeRelay, robot: Robot, camera: None) -> Scene:
    made = Scene(relay, robot)
    made.until_listed(RAW)
    return made


def picture(peer: Peer) -> tuple[frames.VideoFrame, npt.NDArray[np.uint8]]:
    frame = peer.expect(frames.VideoFrame)
    decoded = cv2.imdecode(np.frombuffer(frame.body, np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None
    return frame, decoded.astype(np.uint8)


def test_real_camera_is_shown_and_ends_with_its_stream(scene: Scene) -> None:
    """JPEG in the camera's size, counted from 1 and stamped with the wall clock, after `stream_status`; no
    frame follows 2 s after `close_video`, and the camera's size and rate are known.
    """
    assert scene.cameras() == []
    before = time.time()
    peer = scene.video(RAW)
    first, shown = picture(peer)
    (playing,) = [each for each in peer.skipped if isinstance(each, link.StreamStatus)]
    assert (playing.width, playing.height, playing.quality, playing.reduced) == (*SIZE, 80, 0)
    assert first.number == 1
    # A frame that was kept may be a second old.
    assert before - 5 < first.stamp / 1e9 <= time.time()
    assert first.body.startswith(b"\xff\xd8\xff")
    assert shown.shape == (SIZE[1], SIZE[0], 3)
    assert shown.std() > 10
    for number in range(2, 12):
        assert picture(peer)[0].number == number
    seen = scene.until_listed(RAW, encoding="rgb8", width=SIZE[0], height=SIZE[1])
    assert seen.type == "sensor_msgs/msg/Image"
    scene.control.send(link.CloseVideo(stream="s1"))
    peer.expect(link.Bye)
    peer.expect_end()


def test_settings_are_followed_and_cameras_shared(scene: Scene) -> None:
    """Two streams of one camera, one of them smaller, rotated and slower, come from one process."""
    whole = scene.video(RAW)
    small = scene.video(RAW, link.VideoSettings(width=160, rotate=90, fps=4, quality=50), "s2")
    assert picture(whole)[1].shape == (480, 640, 3)
    began, shown = picture(small)
    assert shown.shape == (round(160 * 640 / 480), 160, 3)
    for _ in range(8):
        last, _ = picture(small)
    assert 8 / ((last.stamp - began.stamp) / 1e9) < 5
    assert len(scene.cameras()) == 1


def test_inhibited_camera_shows_nothing_for_its_time(scene: Scene) -> None:
    """Its images are samples of its topic too; another transport continues, and so does this one afterwards."""
    peer, other = scene.video(RAW), scene.video(COMPRESSED, stream="s2")
    picture(peer)
    picture(other)
    begun = time.time()
    assert scene.control.order(link.Inhibit(id=5, resource=RAW, ms=1500)).ok
    quiet = time.time()
    while (after := picture(peer)[0].stamp / 1e9) < quiet:
        pass
    assert after >= begun + 1.4
    while picture(other)[0].stamp / 1e9 < quiet:
        pass
    assert not [each for each in other.skipped if isinstance(each, link.StreamRefused)]


def test_jpeg_of_the_camera_itself_passes_untouched(scene: Scene) -> None:
    """A CompressedImage without edits is sent unchanged, even if a higher quality was requested."""
    asked = scene.video(COMPRESSED, link.VideoSettings(quality=100))
    frame, shown = picture(asked)
    assert shown.shape == (480, 640, 3)
    done, again = cv2.imencode(".jpg", shown, (cv2.IMWRITE_JPEG_QUALITY, 100))
    assert done
    assert len(frame.body) < 0.7 * len(again)


@pytest.fixture
def once(environment: dict[str, str]) -> Iterator[str]:
    """A topic on which one image was published before any subscription."""
    context = rclpy.Context()
    with without_shared_memory(rclpy.get_rmw_implementation_identifier()):
        rclpy.init(context=context)
        node: Any = rclpy.create_node("map", context=context)
    kept = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publisher = node.create_publisher(Image, "/map", kept)
    publisher.publish(Image(height=48, width=64, step=64, encoding="mono8", data=bytes([90]) * 64 * 48))
    yield "/map"
    node.destroy_node()
    rclpy.shutdown(context=context)


def test_frame_that_was_published_once_is_shown_to_all_viewers(
    relay: FakeRelay, robot: Robot, once: str
) -> None:
    """To the first, to a concurrent one with another format, and to a later one after a time without viewers."""
    scene = Scene(relay, robot)
    scene.until_listed(once)
    first = scene.video(once)
    number, shown = picture(first)
    assert (number.number, shown.shape) == (1, (48, 64, 3))
    assert abs(int(shown[5, 5, 0]) - 90) < 3
    (playing,) = [each for each in first.skipped if isinstance(each, link.StreamStatus)]
    assert playing.latched
    assert picture(scene.video(once, link.VideoSettings(width=32), "s2"))[1].shape == (24, 32, 3)
    scene.control.send(link.CloseVideo(stream="s1"))
    scene.control.send(link.CloseVideo(stream="s2"))
    first.expect_end()
    again, _ = picture(scene.video(once, link.VideoSettings(quality=50), "s3"))
    assert again.number == 1


@pytest.fixture
def wild(environment: dict[str, str]) -> Iterator[Any]:
    """Publishes any Image on ``/wild``."""
    context = rclpy.Context()
    with without_shared_memory(rclpy.get_rmw_implementation_identifier()):
        rclpy.init(context=context)
        node: Any = rclpy.create_node("wild", context=context)
    yield node.create_publisher(Image, "/wild", 1)
    node.destroy_node()
    rclpy.shutdown(context=context)


def test_bad_spell_of_a_camera_and_its_changes_end_no_stream(
    relay: FakeRelay, robot: Robot, wild: Any
) -> None:
    """Images that are too short, of an unknown encoding, and then of another size and encoding."""
    scene = Scene(relay, robot)
    scene.until_listed("/wild")
    peer = scene.video("/wild")

    def until_seen(high: int, wide: int, **image: Any) -> int:
        """Publishes it until it is shown; returns the frame's number."""
        with publishing(wild, height=high, width=wide, **image):
            while True:
                frame, shown = picture(peer)
                if shown.shape == (high, wide, 3):
                    return frame.number

    def until_reported(words: str, **image: Any) -> None:
        with publishing(wild, height=48, width=64, **image):
            while words not in peer.expect(link.StreamStatus).problem:
                pass

    until_seen(48, 64, step=64, encoding="mono8", data=bytes(64 * 48))
    until_reported("the message has 9", step=64, encoding="mono8", data=bytes(9))
    until_reported("'odd' can't be shown", step=64, encoding="odd", data=bytes(64 * 48))
    last = until_seen(24, 32, step=96, encoding="rgb8", data=bytes(96 * 24))
    assert until_seen(96, 128, step=128, encoding="nv12", data=bytes([128]) * (128 * 144)) > last
    assert not [each for each in peer.skipped if isinstance(each, link.StreamRefused)]
    assert [each for each in peer.skipped if isinstance(each, link.StreamStatus)][-1].problem == ""


@contextmanager
def publishing(publisher: Any, **image: Any) -> Iterator[None]:
    """Twenty times a second."""
    over = threading.Event()

    def publish() -> None:
        while not over.wait(0.05):
            publisher.publish(Image(**image))

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def test_undecodable_frame_is_reported_on_the_link(scene: Scene) -> None:
    """A missing camera, and a crop outside the image, are refused with a reason, and the link ends."""
    for camera, settings, words in (
        ("/no/camera", link.VideoSettings(), "no camera /no/camera"),
        (RAW, link.VideoSettings(crop=(9, 8000, 10, 10)), "8000"),
    ):
        peer = scene.video(camera, settings)
        refused = peer.expect(link.StreamRefused)
        assert words in refused.reason
        assert not refused.busy
        peer.expect_end()


def test_killed_process_comes_back(scene: Scene) -> None:
    """After kill -9 the links end, and the next stream uses another process."""
    peer = scene.video(RAW)
    picture(peer)
    (process,) = scene.cameras()
    process.kill()
    peer.expect_end()
    picture(scene.video(RAW, stream="s2"))
    assert scene.cameras()[0].pid != process.pid
    assert "camera process" in scene.control.expect(link.Alert).text


def test_lost_control_link_ends_the_streams(scene: Scene) -> None:
    """An unregistered robot sends no frames; registered again it reports its cameras again."""
    peer = scene.video(RAW)
    picture(peer)
    scene.control.cut()
    peer.expect_end()
    scene.control = scene.relay.register()
    scene.until_listed(RAW)
    picture(scene.video(RAW))


@pytest.mark.parametrize("how", ["terminate", "kill"])
def test_process_ends_with_its_daemon(scene: Scene, how: str) -> None:
    """Whether the daemon exits or is killed."""
    picture(scene.video(RAW))
    (process,) = scene.cameras()
    getattr(scene.process, how)()
    scene.process.wait(PATIENCE)
    until(lambda: not process.is_running())


def test_camera_without_ros_and_the_limit_of_streams(
    relay: FakeRelay, robot: Robot, tmp_path: Path, environment: dict[str, str]
) -> None:
    """A file is shown repeatedly as a camera; a stream over the limit of the settings is refused as too many."""
    film = tmp_path / "film.avi"
    writer = cv2.VideoWriter(str(film), cv2.VideoWriter.fourcc(*"MJPG"), 20, (64, 48))
    for grey in range(5):
        writer.write(np.full((48, 64, 3), 40 * grey, np.uint8))
    writer.release()
    config = tmp_path / "robot.toml"
    config.write_text(f'[cameras]\n"/film" = "{film}"\n[video]\nmax_streams = 1\n')
    scene = Scene(relay, robot, "--config", str(config))
    assert scene.until_listed("/film").type == ""
    peer = scene.video("/film")
    for _ in range(12):
        assert picture(peer)[1].shape == (48, 64, 3)
    refused = scene.video("/film", stream="s2").expect(link.StreamRefused)
    assert refused.busy
    scene.control.send(link.CloseVideo(stream="s1"))
    peer.expect_end()
    assert picture(scene.video("/film", stream="s3"))[0].number == 1


@pytest.fixture
def network(relay: FakeRelay, robot: Robot, tmp_path: Path) -> Iterator[tuple[Scene, RtspCamera]]:
    """A daemon with a network camera in its settings."""
    with closing(RtspCamera(login="ann:s3cret")) as camera:
        config = tmp_path / "robot.toml"
        config.write_text(f'[cameras]\n"/gate" = "{camera.url}"\n')
        scene = Scene(relay, robot, "--config", str(config))
        scene.until_listed("/gate")
        yield scene, camera


def test_camera_of_the_network_has_one_connection(network: tuple[Scene, RtspCamera]) -> None:
    """For any number of streams and any quality of service, which is a matter of ROS; it shows the camera's
    view.
    """
    scene, camera = network
    one = scene.video("/gate")
    other = scene.video("/gate", link.VideoSettings(width=80, qos="default"), "s2")
    assert picture(one)[1].shape == card(0).shape
    assert picture(other)[1].shape == (60, 80, 3)
    assert camera.visits == 1
    square = picture(one)[1][20, 20].astype(int)
    assert np.abs(square - card(0)[20, 20]).max() < 20


def test_silent_camera_delays_no_other(network: tuple[Scene, RtspCamera], robot: Robot) -> None:
    """While it is awaited, its stream closes in time, and so do process and daemon. No process list or log
    has its password.
    """
    scene, camera = network
    peer = scene.video("/gate")
    picture(peer)
    (process,) = scene.cameras()
    shown = [*process.cmdline(), *process.environ().values(), *psutil.Process(scene.process.pid).cmdline()]
    camera.stall()
    scene.control.send(link.CloseVideo(stream="s1"))
    peer.expect(link.Bye)
    peer.expect_end()
    scene.process.terminate()
    scene.process.wait(PATIENCE)
    assert not process.is_running()
    camera.close()
    assert not [text for text in (*shown, robot.log.read_text()) if "s3cret" in text]
