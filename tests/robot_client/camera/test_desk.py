"""Which cameras the relay is told of, and what the camera process is told to show."""

from __future__ import annotations

from typing import Any

import pytest
from twisted.internet.task import Clock

from relay_protocol import limits, link
from robot_client.camera.ipc import CameraSeen, CameraSettings, OpenStream
from robot_client.camera.service import COMPRESSED, IMAGE, TELL_EVERY, DaemonCameras
from robot_client.camera.supervisor import CameraSupervisor
from robot_client.platforms.base import GraphView


class Keeper(CameraSupervisor):
    """Keeps no process, but what it was asked."""

    def __init__(self) -> None:
        super().__init__(Clock(), CameraSettings(address="", node="", streams=8))
        self.opened: list[OpenStream] = []
        self.closed: list[str] = []

    def open(self, line: OpenStream) -> None:
        self.opened.append(line)

    def close(self, stream: str, why: str) -> None:
        self.closed.append(stream)

    def close_all(self, why: str) -> None:
        self.closed.append("all")


def topics(**types: str) -> GraphView:
    """Topics with one publisher each; ``_`` in their names stands for ``/``."""
    return GraphView(
        topics={
            "/" + name.replace("_", "/"): link.Topic(types=[type], publishers=["/driver"])
            for name, type in types.items()
        }
    )


class Scene:
    def __init__(self, **configured: str) -> None:
        self.clock = Clock()
        self.keeper = Keeper()
        self.said: list[Any] = []
        self.desk = DaemonCameras(
            {"/" + name: source for name, source in configured.items()},
            self.keeper,
            self.said.append,
            self.clock,
        )

    def told(self) -> list[str]:
        """Names of the latest word."""
        return [each.name for each in self.said[-1].cameras]

    def order(self, camera: str, **settings: Any) -> OpenStream:
        self.desk.open(
            link.OpenVideo(stream="s", ticket="t", camera=camera, settings=link.VideoSettings(**settings))
        )
        return self.keeper.opened[-1]


@pytest.fixture
def scene() -> Scene:
    made = Scene()
    made.desk.registered(2.0)
    return made


def test_relay_is_told_of_all_cameras_after_the_welcome() -> None:
    """Topics of pictures that have publishers, and what the settings name; nothing else, also if there is none."""
    scene = Scene(usb="v4l2:/dev/video0")
    view = topics(front=IMAGE, scan="sensor_msgs/msg/LaserScan", front_compressed=COMPRESSED)
    view.topics["/silent"] = link.Topic(types=[IMAGE])
    scene.desk.look(view)
    assert scene.said == []
    scene.desk.registered(2.0)
    assert [(each.name, each.type) for each in scene.said[-1].cameras] == [
        ("/front", IMAGE),
        ("/front/compressed", COMPRESSED),
        ("/usb", ""),
    ]


def test_robot_without_cameras_says_so(scene: Scene) -> None:
    """An empty list is told too: the relay need not wait for one."""
    assert scene.said == [link.Cameras(streams=8)]


def test_changes_are_told_once_a_second_at_most(scene: Scene) -> None:
    """Of changes that follow each other the last state counts; no change, no word."""
    for name in ("a", "b", "c"):
        scene.desk.look(topics(**{name: IMAGE}))
    assert len(scene.said) == 1
    scene.clock.advance(TELL_EVERY)
    assert (len(scene.said), scene.told()) == (2, ["/c"])
    scene.desk.look(topics(c=IMAGE))
    scene.clock.advance(10)
    assert len(scene.said) == 2
    scene.desk.look(topics())
    scene.clock.advance(0)
    assert (len(scene.said), scene.told()) == (3, [])


def test_what_was_seen_of_a_camera_is_told_and_kept(scene: Scene) -> None:
    """Size, encoding and rate, also to a relay that comes later; forgotten with the camera."""
    scene.desk.look(topics(a=IMAGE))
    scene.keeper.on_seen(CameraSeen(camera="/a", encoding="rgb8", width=640, height=480, fps=15.0, at=7.5))
    scene.keeper.on_seen(CameraSeen(camera="/gone", encoding="rgb8", width=1, height=1, fps=1.0, at=7.5))
    scene.clock.advance(TELL_EVERY)
    known = link.Camera(name="/a", type=IMAGE, encoding="rgb8", width=640, height=480, fps=15.0, seen=7.5)
    assert scene.said[-1].cameras == [known]
    scene.desk.unregistered("lost")
    scene.desk.registered(2.0)
    assert scene.said[-1].cameras == [known]
    scene.desk.look(topics())
    scene.desk.look(topics(a=IMAGE))
    scene.clock.advance(TELL_EVERY)
    assert scene.said[-1].cameras == [link.Camera(name="/a", type=IMAGE)]


def test_without_a_relay_nothing_is_said(scene: Scene) -> None:
    """After the loss of the control link all streams are closed, and changes wait for the next welcome."""
    scene.desk.look(topics(a=IMAGE))
    scene.desk.unregistered("lost")
    scene.clock.advance(10)
    assert scene.keeper.closed == ["all"]
    assert len(scene.said) == 1


def test_no_more_cameras_are_told_than_the_contract_takes(scene: Scene) -> None:
    """256 of them, and none with a name too long for it."""
    scene.desk.look(topics(**{f"c{number}": IMAGE for number in range(300)}, **{"x" * 300: IMAGE}))
    scene.clock.advance(TELL_EVERY)
    assert len(scene.told()) == limits.CAMERAS
    assert max(map(len, scene.told())) < limits.NAME


@pytest.mark.parametrize(
    ("camera", "transport", "topic", "compressed"),
    [
        ("/a", "", "/a", False),
        ("/a/compressed", "", "/a/compressed", True),
        ("/a", "compressed", "/a/compressed", True),
        ("/a/compressed", "raw", "/a", False),
        ("/b", "compressed", "/b", False),
        ("/a/compressed", "compressed", "/a/compressed", True),
        ("/c", "compressed", "/c/compressed", True),
        ("/d/compressed", "compressed", "/d/compressed", False),
    ],
)
def test_transport_chooses_the_topic(
    scene: Scene, camera: str, transport: str, topic: str, compressed: bool
) -> None:
    """Raw and compressed pictures of one camera are two topics; who asks for the other kind gets it if it is there."""
    scene.desk.look(
        topics(a=IMAGE, a_compressed=COMPRESSED, b=IMAGE, c_compressed=COMPRESSED, d_compressed=IMAGE)
    )
    line = scene.order(camera, transport=transport)
    assert (line.camera, line.topic, line.compressed, line.source) == (camera, topic, compressed, "")


def test_configured_camera_is_opened_by_its_source() -> None:
    """Its name goes before a topic of the same name."""
    scene = Scene(gate="rtsp://gate/1")
    scene.desk.look(topics(gate=IMAGE))
    scene.desk.registered(7.0)
    line = scene.order("/gate", width=320)
    assert (line.source, line.topic, line.heartbeat, line.settings.width) == ("rtsp://gate/1", "", 7.0, 320)


@pytest.mark.parametrize("transport", ["", "compressed", "raw"])
def test_configured_camera_has_no_other_form(transport: str) -> None:
    """A topic with the name that its compressed pictures would have is another camera."""
    scene = Scene(webcam="v4l2:/dev/video0")
    scene.desk.look(topics(webcam=IMAGE, webcam_compressed=COMPRESSED))
    line = scene.order("/webcam", transport=transport)
    assert (line.source, line.topic, line.compressed) == ("v4l2:/dev/video0", "", False)


def test_unknown_camera_is_left_for_the_process_to_refuse(scene: Scene) -> None:
    """The stream's own link is where the relay is told."""
    line = scene.order("/none")
    assert (line.source, line.topic) == ("", "")


def test_close_is_passed_on(scene: Scene) -> None:
    """By the name of the stream."""
    scene.desk.close(link.CloseVideo(stream="s"))
    assert scene.keeper.closed == ["s"]
