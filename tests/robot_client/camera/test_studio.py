"""Which streams share a camera, and for how long it is there, with a node of ROS that the test is."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
from twisted.internet.task import Clock

from relay_protocol.errors import NotFound
from relay_protocol.link import VideoSettings
from robot_client.camera.frame import Frame
from robot_client.camera.ipc import CameraSeen, CameraSettings, NoFrames, OpenStream
from robot_client.camera.stream_manager import LINGER, StreamManager
from tests.robot_client.camera.cards import Coded, image_cdr


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
        self.told: list[Any] = []
        self.subscribed: list[tuple[str, bool, str]] = []
        self.subscriptions: list[Subscription] = []
        self.closed = 0
        self.studio = StreamManager(
            self.reactor,
            CameraSettings(address="127.0.0.1:1", node="camera", streams=8),
            self.told.append,
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

    def watch(self, topic: str = "", qos: str = "", **more: Any) -> tuple[Any, list[Frame]]:
        """A stream's view, and what came."""
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
        return self.studio.watch(line, got.append), got

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
    """All get each picture, and it is closed with the last of them."""
    (one, first), (other, second) = scene.watch("/a"), scene.watch("/a")
    (subscription,) = scene.subscriptions
    for value in (7, 8):
        subscription.show(grey(value))
    assert [level(shot) for shot in first + second] == [7, 8, 7, 8]
    one.close()
    assert not subscription.closed
    other.close()
    assert subscription.closed


def test_what_is_opened_tells_cameras_apart_and_not_their_names(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A topic and a camera without ROS of one name, two types of one topic, two qualities of service."""
    captured: list[str] = []

    def capture(
        source: str, on_picture: Callable[[Any], None], tell: Callable[[str, str], None]
    ) -> Subscription:
        captured.append(source)
        return Subscription(on_picture)

    monkeypatch.setattr("robot_client.camera.capture.Capture", capture)
    _, of_the_topic = scene.watch("/webcam/compressed", camera="/webcam", source="/a.avi", compressed=True)
    _, of_the_source = scene.watch(camera="/webcam", source="/a.avi", qos="default")
    scene.watch("/webcam/compressed", source="/b.avi", compressed=True)
    scene.watch(camera="/other", source="/a.avi")
    scene.watch("/webcam/compressed")
    scene.watch("/webcam/compressed", qos="default", compressed=True)
    assert scene.subscribed == [
        ("/webcam/compressed", True, ""),
        ("/webcam/compressed", False, ""),
        ("/webcam/compressed", True, "default"),
    ]
    assert captured == ["/a.avi"]
    for subscription in scene.subscriptions[1:]:
        subscription.show(grey(9))
    assert of_the_topic == of_the_source == []


def test_topic_that_got_another_type_is_subscribed_anew(scene: Scene) -> None:
    """Also while a stream of the former one goes on."""
    scene.watch("/a")
    _, got = scene.watch("/a", compressed=True)
    assert scene.subscribed == [("/a", False, ""), ("/a", True, "")]
    scene.subscriptions[0].show(grey(1))
    assert got == []


def test_second_stream_of_a_slow_camera_has_its_picture_at_once(scene: Scene) -> None:
    """However long the next one is off."""
    scene.watch("/slow")
    for value in (1, 2):
        scene.subscriptions[0].show(grey(value))
        scene.reactor.pump([1] * 20)
    view, _ = scene.watch("/slow")
    assert scene.newest(view) == 2


def test_inhibited_camera_has_no_picture_for_new_streams(scene: Scene) -> None:
    """Until it may be seen again; a latched one that came meanwhile comes then."""
    view, got = scene.watch("/a")
    scene.subscriptions[0].latched = True
    scene.subscriptions[0].show(grey(1))
    scene.studio.take(NoFrames(topics=["/a"]))
    assert scene.newest(view) is None
    scene.subscriptions[0].show(grey(2))
    assert [level(shot) for shot in got] == [1]
    scene.studio.take(NoFrames(topics=[]))
    assert [level(shot) for shot in got] == [1, 2]
    assert scene.newest(view) == 2


def test_slow_camera_is_kept_for_who_comes_again(scene: Scene) -> None:
    """What came after the first viewer had given up is there for the next, at once."""
    first, _ = scene.watch("/slow")
    scene.reactor.pump([1] * 10)
    first.close()
    scene.reactor.pump([1] * 5)
    scene.subscriptions[0].show(grey(3))
    scene.reactor.pump([1] * 5)
    second, _ = scene.watch("/slow")
    assert scene.newest(second) == 3
    scene.reactor.pump([1] * 60)
    assert not scene.subscriptions[0].closed
    assert len(scene.subscriptions) == 1


@pytest.mark.parametrize("pictures", [1, 3])
def test_slow_camera_is_kept_whenever_its_picture_came(scene: Scene, pictures: int) -> None:
    """Just before its viewer left, too: by the time between pictures, or because nobody knows that yet."""
    view, _ = scene.watch("/slow")
    for value in range(pictures):
        scene.reactor.pump([1] * 20)
        scene.subscriptions[0].show(grey(value))
    view.close()
    scene.reactor.pump([1] * 9)
    assert not scene.subscriptions[0].closed
    assert scene.newest(scene.watch("/slow")[0]) == pictures - 1


def test_rate_is_told_of_pictures_that_nobody_watched_for_long(scene: Scene) -> None:
    """Two that came while it was kept are enough, and the last of them may just have come."""
    scene.watch("/slow")[0].close()
    for value in range(2):
        scene.reactor.pump([1] * 14)
        scene.subscriptions[0].show(grey(value))
    scene.studio.stop("the test goes on")
    assert scene.told[-1].fps == pytest.approx(1 / 14, rel=0.01)


def test_slow_camera_is_let_go_after_a_while(scene: Scene) -> None:
    """Its rate is told before, if it was found out."""
    view, _ = scene.watch("/slow")
    scene.subscriptions[0].show(grey(1))
    scene.reactor.pump([1] * 10)
    view.close()
    scene.reactor.pump([1] * 10)
    scene.subscriptions[0].show(grey(2))
    assert not scene.subscriptions[0].closed
    scene.reactor.pump([1] * round(LINGER))
    assert scene.subscriptions[0].closed
    assert isinstance(scene.told[-1], CameraSeen)
    assert scene.told[-1].fps == pytest.approx(0.05)


def test_no_more_slow_cameras_are_kept_than_streams_may_be(scene: Scene) -> None:
    """The one that was left first goes first."""
    for number in range(10):
        scene.watch(f"/slow_{number}")[0].close()
    assert [each.closed for each in scene.subscriptions] == [True] * 2 + [False] * 8


def test_end_of_the_process_lets_all_go() -> None:
    """Also what is kept."""
    scene = Scene()
    view, _ = scene.watch("/slow")
    view.close()
    scene.studio.stop("the test is over")
    assert scene.subscriptions[0].closed
    assert scene.closed == 1
    assert scene.reactor.getDelayedCalls() == []


def test_camera_that_is_not_there_is_said(scene: Scene) -> None:
    """Neither a topic nor an address."""
    with pytest.raises(NotFound, match="no camera /c"):
        scene.watch()
