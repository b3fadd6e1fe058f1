"""What the robot's own diagnostics say is wrong."""

from __future__ import annotations

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.serialization import serialize_message

from relay_protocol.link import Topic
from robot_client.platforms.base import GraphView, OnSample
from robot_client.platforms.ros2_diagnostics import BURST, DIAGNOSTICS, NAMES, TOPIC, Diagnostics
from robot_client.platforms.ros2_types import Types

OK, WARN, ERROR, STALE = range(4)


class Scene:
    """Diagnostics that listen, and what they tell."""

    def __init__(self) -> None:
        self.now = 0.0
        self.told: list[str] = []
        self.texts: list[str] = []
        self.listeners: list[OnSample] = []
        self.diagnostics = Diagnostics(
            Types(), lambda topic, on_sample: self.listeners.append(on_sample), self._tell, lambda: self.now
        )

    def _tell(self, level: str, text: str, kind: str = "", about: str = "", over: bool = False) -> None:
        assert kind == "diagnostics"
        self.texts.append(text)
        self.told.append(f"{about} {'over' if over else level}")

    def listens(self, type: str = DIAGNOSTICS, publishers: tuple[str, ...] = ("/base",)) -> None:
        """There is such a topic."""
        self.diagnostics.look(GraphView(topics={TOPIC: Topic(types=[type], publishers=list(publishers))}))

    def publish(self, *statuses: tuple[str, int]) -> None:
        """A node tells how its parts are."""
        array = DiagnosticArray()
        array.status = [
            DiagnosticStatus(name=name, level=bytes([level]), message=f"{name} is {level}")
            for name, level in statuses
        ]
        self.now += 0.1
        self.listeners[0](serialize_message(array))


@pytest.fixture
def scene() -> Scene:
    """Nothing is there yet."""
    return Scene()


def test_errors_are_told_once_and_their_end(scene: Scene) -> None:
    """By name; warnings are no alerts, and end one."""
    scene.listens()
    for levels in ((OK, WARN), (ERROR, WARN), (ERROR, ERROR), (ERROR, OK), (WARN, OK), (ERROR, OK)):
        scene.publish(("motor", levels[0]), ("arm", levels[1]))
    assert scene.told == ["motor error", "arm error", "arm over", "motor over", "motor error"]
    assert scene.texts[0] == "motor is 2"


def test_stale_is_told_of_what_was_there(scene: Scene) -> None:
    """A part that has never come was perhaps never to; one that is stale may turn out to be broken."""
    scene.listens()
    for level in (STALE, STALE, OK, STALE, STALE, ERROR, OK, STALE, OK):
        scene.publish(("lidar", level))
    assert scene.told == ["lidar warning", "lidar error", "lidar over", "lidar warning", "lidar over"]


def test_it_listens_once_to_what_is_published_with_the_right_type(scene: Scene) -> None:
    """A topic without a publisher, or of another type, is let be."""
    scene.listens("std_msgs/msg/String")
    scene.listens(publishers=())
    scene.diagnostics.look(GraphView())
    assert scene.listeners == []
    scene.listens()
    scene.listens()
    assert len(scene.listeners) == 1


def test_names_are_bounded(scene: Scene) -> None:
    """Those beyond are passed over, and the others go on."""
    scene.listens()
    scene.publish(*((f"part {number}", ERROR) for number in range(NAMES + 50)))
    assert len(scene.told) == NAMES
    scene.publish(("part 0", OK))
    assert scene.told[-1] == "part 0 over"


def test_a_flood_is_not_read(scene: Scene) -> None:
    """The daemon has other things to do."""
    scene.listens()
    for number in range(1000):
        scene.now -= 0.1
        scene.publish((f"part {number % 100}", ERROR))
    assert len(scene.told) == BURST
    scene.now += 10
    scene.publish(("other", ERROR))
    assert scene.told[-1] == "other error"


@pytest.mark.parametrize("body", [b"", b"\0\1\0\0\xff", b"\0\1\0\0" + b"\xff" * 64])
def test_what_is_no_diagnostics_is_passed_over(scene: Scene, body: bytes) -> None:
    """Any node may publish anything there."""
    scene.listens()
    scene.listeners[0](body)
    assert scene.told == []
