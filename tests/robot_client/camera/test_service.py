"""Reports of cameras to the relay, and requests to the camera process."""

from __future__ import annotations

from typing import Any

import pytest
from twisted.internet.task import Clock

from relay_protocol import limits, link
from robot_client.camera.ipc import CameraSeen, CameraSettings, OpenStream
from robot_client.camera.service import COMPRESSED, IMAGE, REPORT_INTERVAL, DaemonCameras
from robot_client.camera.supervisor import CameraSupervisor
from robot_client.platforms.base import GraphView


class Keeper(CameraSupervisor):
    """Records requests instead of running a process."""

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
    """Topics with one publisher each; ``_`` in their names means ``/``."""
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
        self.cameras = DaemonCameras(
            {"/" + name: source for name, source in configured.items()},
            self.keeper,
            self.said.append,
            self.clock,
            address=lambda: "",
        )

    def reported(self) -> list[str]:
        """Names in the latest report."""
        return [each.name for each in self.said[-1].cameras]

    def order(self, camera: str, **settings: Any) -> OpenStream:
        self.cameras.open(
            link.OpenVideo(stream="s", ticket="t", camera=camera, settings=link.VideoSettings(**settings))
        )
        return self.keeper.opened[-1]


@pytest.fixture
def scene() -> Scene:
    made = Scene()
    made.cameras.registered(2.0)
    return made


def test_relay_learns_of_all_cameras_after_the_welcome() -> None:
    """Image topics with publishers, and cameras of the settings; an empty list is reported too."""
    scene = Scene(usb="v4l2:/dev/video0")
    view = topics(front=IMAGE, scan="sensor_msgs/msg/LaserScan", front_compressed=COMPRESSED)
    view.topics["/silent"] = link.Topic(types=[IMAGE])
    scene.cameras.update_graph(view)
    assert scene.said == []
    scene.cameras.registered(2.0)
    assert [(each.name, each.type) for each in scene.said[-1].cameras] == [
        ("/front", IMAGE),
        ("/front/compressed", COMPRESSED),
        ("/usb", ""),
    ]


def test_robot_without_cameras_reports_it(scene: Scene) -> None:
    """The relay need not wait for a list."""
    assert scene.said == [link.Cameras(streams=8)]


def test_changes_are_reported_once_a_second_at_most(scene: Scene) -> None:
    """Only the last of several changes is reported, and no report comes without a change."""
    for name in ("a", "b", "c"):
        scene.cameras.update_graph(topics(**{name: IMAGE}))
    assert len(scene.said) == 1
    scene.clock.advance(REPORT_INTERVAL)
    assert (len(scene.said), scene.reported()) == (2, ["/c"])
    scene.cameras.update_graph(topics(c=IMAGE))
    scene.clock.advance(10)
    assert len(scene.said) == 2
    scene.cameras.update_graph(topics())
    scene.clock.advance(0)
    assert (len(scene.said), scene.reported()) == (3, [])


def test_measurements_of_a_camera_are_reported_and_stored(scene: Scene) -> None:
    """Size, encoding and rate, also to a later relay; removed with the camera."""
    scene.cameras.update_graph(topics(a=IMAGE))
    scene.keeper.on_seen(CameraSeen(camera="/a", encoding="rgb8", width=640, height=480, fps=15.0, at=7.5))
    scene.keeper.on_seen(CameraSeen(camera="/gone", encoding="rgb8", width=1, height=1, fps=1.0, at=7.5))
    scene.clock.advance(REPORT_INTERVAL)
    known = link.Camera(name="/a", type=IMAGE, encoding="rgb8", width=640, height=480, fps=15.0, seen=7.5)
    assert scene.said[-1].cameras == [known]
    scene.cameras.link_lost("lost")
    scene.cameras.registered(2.0)
    assert scene.said[-1].cameras == [known]
    scene.cameras.update_graph(topics())
    scene.cameras.update_graph(topics(a=IMAGE))
    scene.clock.advance(REPORT_INTERVAL)
    assert scene.said[-1].cameras == [link.Camera(name="/a", type=IMAGE)]


def test_without_a_relay_nothing_is_sent(scene: Scene) -> None:
    """After the loss of the control link all streams are closed, and changes wait for the next welcome."""
    scene.cameras.update_graph(topics(a=IMAGE))
    scene.cameras.link_lost("lost")
    scene.clock.advance(10)
    assert scene.keeper.closed == ["all"]
    assert len(scene.said) == 1


def test_no_more_cameras_are_reported_than_the_contract_takes(scene: Scene) -> None:
    """256 of them, without names that are too long."""
    scene.cameras.update_graph(topics(**{f"c{number}": IMAGE for number in range(300)}, **{"x" * 300: IMAGE}))
    scene.clock.advance(REPORT_INTERVAL)
    assert len(scene.reported()) == limits.CAMERAS
    assert max(map(len, scene.reported())) < limits.NAME


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
    """The requested transport is used if its topic exists."""
    scene.cameras.update_graph(
        topics(a=IMAGE, a_compressed=COMPRESSED, b=IMAGE, c_compressed=COMPRESSED, d_compressed=IMAGE)
    )
    line = scene.order(camera, transport=transport)
    assert (line.camera, line.topic, line.compressed, line.source) == (camera, topic, compressed, "")


def test_configured_camera_is_opened_by_its_source() -> None:
    """Its name precedes a topic of the same name."""
    scene = Scene(gate="rtsp://gate/1")
    scene.cameras.update_graph(topics(gate=IMAGE))
    scene.cameras.registered(7.0)
    line = scene.order("/gate", width=320)
    assert (line.source, line.topic, line.heartbeat, line.settings.width) == ("rtsp://gate/1", "", 7.0, 320)


@pytest.mark.parametrize("transport", ["", "compressed", "raw"])
def test_configured_camera_has_no_other_form(transport: str) -> None:
    """A topic with the name of its compressed images is another camera."""
    scene = Scene(webcam="v4l2:/dev/video0")
    scene.cameras.update_graph(topics(webcam=IMAGE, webcam_compressed=COMPRESSED))
    line = scene.order("/webcam", transport=transport)
    assert (line.source, line.topic, line.compressed) == ("v4l2:/dev/video0", "", False)


def test_unknown_camera_is_left_for_the_process_to_refuse(scene: Scene) -> None:
    """The relay gets the refusal on the stream's own link."""
    line = scene.order("/none")
    assert (line.source, line.topic) == ("", "")


def test_close_is_passed_on(scene: Scene) -> None:
    """By the name of the stream."""
    scene.cameras.close(link.CloseVideo(stream="s"))
    assert scene.keeper.closed == ["s"]
