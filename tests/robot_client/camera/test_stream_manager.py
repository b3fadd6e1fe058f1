"""Streams that share a camera, and how long it stays open, with a ROS node of the test."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
from twisted.internet.task import Clock

from relay_protocol.errors import NotFound
from relay_protocol.link import VideoSettings
from robot_client.camera.frame import Frame
from robot_client.camera.ipc import CameraSeen, CameraSettings, InhibitTopics, OpenStream
from robot_client.camera.stream_manager import LINGER, StreamManager
from tests.worlds.image_cards import Coded, image_cdr


class Reactor(Clock):
    def callFromThread(self, call: Callable[..., Any], *arguments: Any) -> None:
        call(*arguments)


class Subscription:
    def __init__(self, show: Callable[[bytes], None]) -> None:
        self.show = show
        self.latched = False
        self.closed = False

    def close(self) -> None:
        self.closed = True


class Scene:
    def __init__(self) -> None:
        self.reactor = Reactor()
        self.reported: list[Any] = []
        self.subscribed: list[tuple[str, bool, str]] = []
        self.subscriptions: list[Subscription] = []
        self.closed = 0
        self.studio = StreamManager(
            self.reactor,
            CameraSettings(address="127.0.0.1:1", node="camera", streams=8),
            self.reported.append,
            lambda name: self,
        )

    def subscribe(
        self, topic: str, compressed: bool, qos: str, on_picture: Callable[[bytes], None]
    ) -> Subscription:
        self.subscribed.append((topic, compressed, qos))
        self.subscriptions.append(Subscription(on_picture))
        return self.subscriptions[-1]

    def close(self) -> None:
        self.closed += 1

    def open_view(self, topic: str = "", qos: str = "", **more: Any) -> tuple[Any, list[Frame]]:
        """Opens a stream's view; returns the received frames."""
        got: list[Frame] = []
        line = OpenStream(
            stream="s",
            ticket="t",
            camera=more.pop("camera", topic or "/c"),
            topic=topic,
            settings=VideoSettings(qos=qos),
            heartbeat=2.0,
            **more,
        )
        return self.studio.open_view(line, got.append), got

    def newest(self, view: Any) -> int | None:
        shot = view.latest()
        return None if shot is None else level(shot)


def level(shot: Frame) -> int:
    return int(shot.raw().pixels[0, 0])


def grey(level: int) -> bytes:
    """A message with one pixel."""
    return image_cdr(Coded("mono8", 1, 1, False, 1, bytes([level])))


@pytest.fixture
def scene() -> Iterator[Scene]:
    made = Scene()
    yield made
    made.studio.stop("the test is over")


def test_streams_of_one_camera_share_it(scene: Scene) -> None:
    """All get each frame, and it is closed with the last of them."""
    (one, first), (other, second) = scene.open_view("/a"), scene.open_view("/a")
    (subscription,) = scene.subscriptions
    for value in (7, 8):
        subscription.show(grey(value))
    assert [level(shot) for shot in first + second] == [7, 8, 7, 8]
    one.close()
    assert not subscription.closed
    other.close()
    assert subscription.closed


def test_opened_device_identifies_a_camera(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """A topic and a camera without ROS with one name, two types of one topic, two qualities of service."""
    captured: list[str] = []

    def capture(
        source: str, on_picture: Callable[[Any], None], tell: Callable[[str, str], None]
    ) -> Subscription:
        captured.append(source)
        return Subscription(on_picture)

    monkeypatch.setattr("robot_client.camera.capture.Capture", capture)
    _, of_the_topic = scene.open_view(
        "/webcam/compressed", camera="/webcam", source="/a.avi", compressed=True
    )
    _, of_the_source = scene.open_view(camera="/webcam", source="/a.avi", qos="default")
    scene.open_view("/webcam/compressed", source="/b.avi", compressed=True)
    scene.open_view(camera="/other", source="/a.avi")
    scene.open_view("/webcam/compressed")
    scene.open_view("/webcam/compressed", qos="default", compressed=True)
    assert scene.subscribed == [
        ("/webcam/compressed", True, ""),
        ("/webcam/compressed", False, ""),
        ("/webcam/compressed", True, "default"),
    ]
    assert captured == ["/a.avi"]
    for subscription in scene.subscriptions[1:]:
        subscription.show(grey(9))
    assert of_the_topic == of_the_source == []


def test_topic_that_got_another_type_is_subscribed_again(scene: Scene) -> None:
    """Even while a stream of the former type continues."""
    scene.open_view("/a")
    _, got = scene.open_view("/a", compressed=True)
    assert scene.subscribed == [("/a", False, ""), ("/a", True, "")]
    scene.subscriptions[0].show(grey(1))
    assert got == []


def test_second_stream_of_a_slow_camera_has_its_frame_at_once(scene: Scene) -> None:
    """For any time until the next one."""
    scene.open_view("/slow")
    for value in (1, 2):
        scene.subscriptions[0].show(grey(value))
        scene.reactor.pump([1] * 20)
    view, _ = scene.open_view("/slow")
    assert scene.newest(view) == 2


def test_inhibited_camera_has_no_frame_for_new_streams(scene: Scene) -> None:
    """Until the inhibition ends; then a latched one from meanwhile is sent."""
    view, got = scene.open_view("/a")
    scene.subscriptions[0].latched = True
    scene.subscriptions[0].show(grey(1))
    scene.studio.handle(InhibitTopics(topics=["/a"]))
    assert scene.newest(view) is None
    scene.subscriptions[0].show(grey(2))
    assert [level(shot) for shot in got] == [1]
    scene.studio.handle(InhibitTopics(topics=[]))
    assert [level(shot) for shot in got] == [1, 2]
    assert scene.newest(view) == 2


def test_slow_camera_is_kept_for_the_next_viewer(scene: Scene) -> None:
    """A frame that arrived after the first viewer had left is sent to the next at once."""
    first, _ = scene.open_view("/slow")
    scene.reactor.pump([1] * 10)
    first.close()
    scene.reactor.pump([1] * 5)
    scene.subscriptions[0].show(grey(3))
    scene.reactor.pump([1] * 5)
    second, _ = scene.open_view("/slow")
    assert scene.newest(second) == 3
    scene.reactor.pump([1] * 60)
    assert not scene.subscriptions[0].closed
    assert len(scene.subscriptions) == 1


@pytest.mark.parametrize("pictures", [1, 3])
def test_slow_camera_is_kept_for_any_time_of_its_frame(scene: Scene, pictures: int) -> None:
    """Just before its viewer left, too: by the frame interval, or because that is unknown."""
    view, _ = scene.open_view("/slow")
    for value in range(pictures):
        scene.reactor.pump([1] * 20)
        scene.subscriptions[0].show(grey(value))
    view.close()
    scene.reactor.pump([1] * 9)
    assert not scene.subscriptions[0].closed
    assert scene.newest(scene.open_view("/slow")[0]) == pictures - 1


def test_rate_is_reported_of_frames_without_viewers_for_long(scene: Scene) -> None:
    """Two frames in that time are enough, and the last of them may have just arrived."""
    scene.open_view("/slow")[0].close()
    for value in range(2):
        scene.reactor.pump([1] * 14)
        scene.subscriptions[0].show(grey(value))
    scene.studio.stop("the test goes on")
    assert scene.reported[-1].fps == pytest.approx(1 / 14, rel=0.01)


def test_slow_camera_is_closed_after_a_while(scene: Scene) -> None:
    """Its rate is reported before, if it was measured."""
    view, _ = scene.open_view("/slow")
    scene.subscriptions[0].show(grey(1))
    scene.reactor.pump([1] * 10)
    view.close()
    scene.reactor.pump([1] * 10)
    scene.subscriptions[0].show(grey(2))
    assert not scene.subscriptions[0].closed
    scene.reactor.pump([1] * round(LINGER))
    assert scene.subscriptions[0].closed
    assert isinstance(scene.reported[-1], CameraSeen)
    assert scene.reported[-1].fps == pytest.approx(0.05)


def test_no_more_slow_cameras_are_kept_than_streams_may_be(scene: Scene) -> None:
    """The least recently used is closed first."""
    for number in range(10):
        scene.open_view(f"/slow_{number}")[0].close()
    assert [each.closed for each in scene.subscriptions] == [True] * 2 + [False] * 8


def test_end_of_the_process_closes_everything() -> None:
    """Including cameras kept open."""
    scene = Scene()
    view, _ = scene.open_view("/slow")
    view.close()
    scene.studio.stop("the test is over")
    assert scene.subscriptions[0].closed
    assert scene.closed == 1
    assert scene.reactor.getDelayedCalls() == []


def test_camera_that_is_not_there_is_reported(scene: Scene) -> None:
    """Neither a topic nor an address."""
    with pytest.raises(NotFound, match="no camera /c"):
        scene.open_view()
