"""What the robot's own diagnostics say is wrong."""

from __future__ import annotations

from pathlib import Path

import pytest
import pytest_twisted
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.serialization import serialize_message
from switchboard_diagnostics import reporting
from switchboard_processes import Process, running

from relay_protocol.link import Topic
from robot_client.platforms.base import GraphView, OnSample
from robot_client.platforms.ros2.diagnostics import (
    BURST,
    DIAGNOSTICS,
    GAPS,
    KNOWN,
    NAMES,
    PERIODS,
    SILENT,
    TOPIC,
    Diagnostics,
)
from robot_client.platforms.ros2.platform import Ros2Platform
from robot_client.platforms.ros2.types import Types
from tests.robot_client.ros import until

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

    def regularly(self, period: float, *statuses: tuple[str, int], times: int = 2 * GAPS) -> None:
        """A node tells how its parts are, again and again."""
        for _ in range(times):
            self.passes(period - 0.1)
            self.publish(*statuses)

    def passes(self, seconds: float) -> None:
        """Time goes by, and the graph is looked at."""
        until = self.now + seconds
        while self.now < until:
            self.now = min(until, self.now + 0.5)
            self.listens()

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


@pytest.mark.parametrize("level", [OK, WARN])
def test_a_name_that_ceases_is_told_and_over_when_it_reports_again(scene: Scene, level: int) -> None:
    """Its node has crashed, perhaps; it is told once."""
    scene.listens()
    scene.regularly(1.0, ("arm", level))
    scene.passes(SILENT - 0.1)
    assert scene.told == []
    scene.passes(60)
    assert (scene.told, scene.texts) == (["arm warning"], ["arm reports nothing any more"])
    scene.publish(("arm", level))
    assert scene.told == ["arm warning", "arm over"]


def test_only_the_name_that_ceases_is_told(scene: Scene) -> None:
    """Others go on."""
    scene.listens()
    scene.regularly(1.0, ("arm", OK), ("leg", OK))
    scene.regularly(1.0, ("leg", OK))
    assert scene.told == ["arm warning"]


def test_what_reports_seldom_is_waited_for_as_long_as_that_takes(scene: Scene) -> None:
    """Several of its usual periods."""
    scene.listens()
    scene.regularly(10.0, ("disk", OK))
    scene.passes(PERIODS * 10 - 1)
    assert scene.told == []
    scene.passes(2)
    assert scene.told == ["disk warning"]


def test_a_name_without_a_usual_period_is_not_told_as_silent(scene: Scene) -> None:
    """Heard once, too seldom, or only in a burst as when it begins."""
    scene.listens()
    scene.publish(("once", OK))
    scene.regularly(1.0, ("seldom", OK), times=KNOWN)
    for _ in range(20):
        scene.now -= 0.1
        scene.publish(("burst", OK))
    scene.passes(1000)
    assert scene.told == []


def test_what_was_in_error_and_ceases_is_still_one(scene: Scene) -> None:
    """Nobody has said that it is well; with what it said last, and with its own words when it is back."""
    scene.listens()
    scene.regularly(1.0, ("arm", ERROR))
    scene.passes(10)
    scene.publish(("arm", ERROR))
    scene.publish(("arm", OK))
    assert scene.told == ["arm error", "arm error", "arm error", "arm over"]
    assert scene.texts[1] == "arm reports nothing any more; it was in ERROR: arm is 2"


@pytest.mark.parametrize(
    ("before", "back", "told"),
    [(OK, "lidar warning", 2), (STALE, "lidar over", 1)],
)
def test_a_name_that_is_back_as_stale_is_as_if_it_had_begun(
    scene: Scene, before: int, back: str, told: int
) -> None:
    """What it waits for was there before it crashed, or never was."""
    scene.listens()
    scene.regularly(1.0, ("lidar", before))
    scene.passes(10)
    scene.publish(("lidar", STALE))
    assert scene.told == ["lidar warning", back]
    assert scene.texts[1] == "lidar is 3"
    scene.publish(("lidar", OK))
    assert len([each for each in scene.told if each == "lidar over"]) == 1
    assert len(scene.told) == told + 1


def test_a_daemon_that_stood_still_calls_nobody_silent_before_it_has_read_what_came(scene: Scene) -> None:
    """It looks at the graph first, and then hears what waited."""
    scene.listens()
    scene.regularly(1.0, ("arm", OK), ("leg", OK))
    scene.now += 60
    scene.listens()
    scene.publish(("arm", OK))
    scene.passes(1)
    assert scene.told == ["leg warning"]


def test_a_daemon_that_looks_seldom_sees_silence_as_well(scene: Scene) -> None:
    """How often the graph is looked at is a setting."""
    scene.listens()
    scene.regularly(1.0, ("arm", OK))
    for _ in range(3):
        scene.now += 10
        scene.listens()
    assert scene.told == ["arm warning"]


def test_nobody_is_silent_while_more_comes_than_is_read(scene: Scene) -> None:
    """What is passed over may have been anybody's."""
    scene.listens()
    scene.regularly(1.0, ("arm", OK))
    for _ in range(2000):
        scene.now -= 0.09
        scene.publish(("other", OK))
        scene.listens()
    assert scene.told == []
    scene.regularly(1.0, ("other", OK))
    assert scene.told == ["arm warning"]


@pytest.mark.parametrize("ros", ["events"], indirect=True, scope="module")
@pytest_twisted.ensureDeferred
async def test_a_node_that_is_killed_is_told_and_over_when_it_begins_again(
    ros: Ros2Platform, environment: dict[str, str], tmp_path: Path
) -> None:
    """In a real graph, where it reports ten times a second."""
    told: list[str] = []
    heard: list[bytes] = []

    def tell(level: str, text: str, kind: str = "", about: str = "", over: bool = False) -> None:
        told.append(f"{kind} {about} {'over' if over else level}: {text}")

    ros.on_alert = tell
    ros.subscribe(TOPIC, DIAGNOSTICS, None, heard.append, lambda: None)

    def begun() -> Process:
        command = reporting("motor", "OK", "all is well", 0.1)
        return Process(command, tmp_path, "motor_driver", environment)

    node = begun()
    with running(node):
        await until(lambda: ros.graph() and len(heard) > 50)
        assert told == []
        node.kill()
        silent = "diagnostics motor warning: motor reports nothing any more"
        await until(lambda: ros.graph() and told == [silent])
    with running(begun()):
        await until(lambda: ros.graph() and told == [silent, "diagnostics motor over: all is well"])
