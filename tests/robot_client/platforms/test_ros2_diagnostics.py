"""Alerts from the robot's diagnostics."""

from __future__ import annotations

from pathlib import Path

import pytest
import pytest_twisted
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.serialization import serialize_message

from relay_protocol.link import Topic
from robot_client.platforms.base import GraphView, OnSample
from robot_client.platforms.ros2.health import (
    BURST,
    DIAGNOSTICS,
    MAX_GAPS,
    MAX_NAMES,
    MIN_GAPS,
    SILENT_PERIODS,
    SILENT_SECONDS,
    TOPIC,
    Diagnostics,
)
from robot_client.platforms.ros2.platform import Ros2Platform
from robot_client.platforms.ros2.types import Types
from tests.robot_client.ros import until
from tests.worlds.diagnostics_node import reporting
from tests.worlds.processes import Process, running

OK, WARN, ERROR, STALE = range(4)


class Scene:
    """Diagnostics and the alerts they raise."""

    def __init__(self) -> None:
        self.now = 0.0
        self.reported: list[str] = []
        self.texts: list[str] = []
        self.listeners: list[OnSample] = []
        self.diagnostics = Diagnostics(
            Types(), lambda topic, on_sample: self.listeners.append(on_sample), self._tell, lambda: self.now
        )

    def _tell(self, level: str, text: str, kind: str = "", about: str = "", over: bool = False) -> None:
        assert kind == "diagnostics"
        self.texts.append(text)
        self.reported.append(f"{about} {'over' if over else level}")

    def listens(self, type: str = DIAGNOSTICS, publishers: tuple[str, ...] = ("/base",)) -> None:
        """Add the topic to the graph."""
        self.diagnostics.update(GraphView(topics={TOPIC: Topic(types=[type], publishers=list(publishers))}))

    def regularly(self, period: float, *statuses: tuple[str, int], times: int = 2 * MAX_GAPS) -> None:
        """Publish the status of names, again and again."""
        for _ in range(times):
            self.passes(period - 0.1)
            self.publish(*statuses)

    def passes(self, seconds: float) -> None:
        """Let time pass, with reads of the graph."""
        until = self.now + seconds
        while self.now < until:
            self.now = min(until, self.now + 0.5)
            self.listens()

    def publish(self, *statuses: tuple[str, int]) -> None:
        """Publish the status of names."""
        array = DiagnosticArray()
        array.status = [
            DiagnosticStatus(name=name, level=bytes([level]), message=f"{name} is {level}")
            for name, level in statuses
        ]
        self.now += 0.1
        self.listeners[0](serialize_message(array))


@pytest.fixture
def scene() -> Scene:
    """Before the topic exists."""
    return Scene()


def test_error_raises_one_alert_that_ends(scene: Scene) -> None:
    """Warnings raise none, and end one."""
    scene.listens()
    for levels in ((OK, WARN), (ERROR, WARN), (ERROR, ERROR), (ERROR, OK), (WARN, OK), (ERROR, OK)):
        scene.publish(("motor", levels[0]), ("arm", levels[1]))
    assert scene.reported == ["motor error", "arm error", "arm over", "motor over", "motor error"]
    assert scene.texts[0] == "motor is 2"


def test_stale_raises_an_alert_only_for_a_name_that_was_alive(scene: Scene) -> None:
    scene.listens()
    for level in (STALE, STALE, OK, STALE, STALE, ERROR, OK, STALE, OK):
        scene.publish(("lidar", level))
    assert scene.reported == ["lidar warning", "lidar error", "lidar over", "lidar warning", "lidar over"]


def test_topic_is_subscribed_once_with_a_publisher_of_the_right_type(scene: Scene) -> None:
    scene.listens("std_msgs/msg/String")
    scene.listens(publishers=())
    scene.diagnostics.update(GraphView())
    assert scene.listeners == []
    scene.listens()
    scene.listens()
    assert len(scene.listeners) == 1


def test_names_are_bounded(scene: Scene) -> None:
    scene.listens()
    scene.publish(*((f"part {number}", ERROR) for number in range(MAX_NAMES + 50)))
    assert len(scene.reported) == MAX_NAMES
    scene.publish(("part 0", OK))
    assert scene.reported[-1] == "part 0 over"


def test_messages_over_the_rate_are_skipped(scene: Scene) -> None:
    scene.listens()
    for number in range(1000):
        scene.now -= 0.1
        scene.publish((f"part {number % 100}", ERROR))
    assert len(scene.reported) == BURST
    scene.now += 10
    scene.publish(("other", ERROR))
    assert scene.reported[-1] == "other error"


@pytest.mark.parametrize("body", [b"", b"\0\1\0\0\xff", b"\0\1\0\0" + b"\xff" * 64])
def test_invalid_messages_are_ignored(scene: Scene, body: bytes) -> None:
    scene.listens()
    scene.listeners[0](body)
    assert scene.reported == []


@pytest.mark.parametrize("level", [OK, WARN])
def test_silent_name_raises_one_alert_that_ends(scene: Scene, level: int) -> None:
    scene.listens()
    scene.regularly(1.0, ("arm", level))
    scene.passes(SILENT_SECONDS - 0.1)
    assert scene.reported == []
    scene.passes(60)
    assert (scene.reported, scene.texts) == (["arm warning"], ["arm reports nothing any more"])
    scene.publish(("arm", level))
    assert scene.reported == ["arm warning", "arm over"]


def test_other_names_raise_no_alert(scene: Scene) -> None:
    scene.listens()
    scene.regularly(1.0, ("arm", OK), ("leg", OK))
    scene.regularly(1.0, ("leg", OK))
    assert scene.reported == ["arm warning"]


def test_silence_counts_by_the_usual_period(scene: Scene) -> None:
    scene.listens()
    scene.regularly(10.0, ("disk", OK))
    scene.passes(SILENT_PERIODS * 10 - 1)
    assert scene.reported == []
    scene.passes(2)
    assert scene.reported == ["disk warning"]


def test_name_without_a_usual_period_is_never_silent(scene: Scene) -> None:
    scene.listens()
    scene.publish(("once", OK))
    scene.regularly(1.0, ("seldom", OK), times=MIN_GAPS)
    for _ in range(20):
        scene.now -= 0.1
        scene.publish(("burst", OK))
    scene.passes(1000)
    assert scene.reported == []


def test_silence_after_an_error_stays_an_error(scene: Scene) -> None:
    """With its last text."""
    scene.listens()
    scene.regularly(1.0, ("arm", ERROR))
    scene.passes(10)
    scene.publish(("arm", ERROR))
    scene.publish(("arm", OK))
    assert scene.reported == ["arm error", "arm error", "arm error", "arm over"]
    assert scene.texts[1] == "arm reports nothing any more; it was in ERROR: arm is 2"


@pytest.mark.parametrize(
    ("before", "back", "reported"),
    [(OK, "lidar warning", 2), (STALE, "lidar over", 1)],
)
def test_name_that_returns_as_stale_counts_as_new(
    scene: Scene, before: int, back: str, reported: int
) -> None:
    scene.listens()
    scene.regularly(1.0, ("lidar", before))
    scene.passes(10)
    scene.publish(("lidar", STALE))
    assert scene.reported == ["lidar warning", back]
    assert scene.texts[1] == "lidar is 3"
    scene.publish(("lidar", OK))
    assert len([each for each in scene.reported if each == "lidar over"]) == 1
    assert len(scene.reported) == reported + 1


def test_suspended_daemon_reads_its_messages_before_it_reports_silence(scene: Scene) -> None:
    scene.listens()
    scene.regularly(1.0, ("arm", OK), ("leg", OK))
    scene.now += 60
    scene.listens()
    scene.publish(("arm", OK))
    scene.passes(1)
    assert scene.reported == ["leg warning"]


def test_silence_is_detected_at_any_rate_of_checks(scene: Scene) -> None:
    scene.listens()
    scene.regularly(1.0, ("arm", OK))
    for _ in range(3):
        scene.now += 10
        scene.listens()
    assert scene.reported == ["arm warning"]


def test_no_name_is_silent_while_messages_are_skipped(scene: Scene) -> None:
    scene.listens()
    scene.regularly(1.0, ("arm", OK))
    for _ in range(2000):
        scene.now -= 0.09
        scene.publish(("other", OK))
        scene.listens()
    assert scene.reported == []
    scene.regularly(1.0, ("other", OK))
    assert scene.reported == ["arm warning"]


@pytest.mark.parametrize("ros", ["events"], indirect=True, scope="module")
@pytest_twisted.ensureDeferred
async def test_a_killed_node_is_reported_until_it_restarts(
    ros: Ros2Platform, environment: dict[str, str], tmp_path: Path
) -> None:
    """In a real graph, where it reports ten times a second."""
    reported: list[str] = []
    heard: list[bytes] = []

    def tell(level: str, text: str, kind: str = "", about: str = "", over: bool = False) -> None:
        reported.append(f"{kind} {about} {'over' if over else level}: {text}")

    ros.on_alert = tell
    ros.subscribe(TOPIC, DIAGNOSTICS, None, heard.append, lambda: None)

    def begun() -> Process:
        command = reporting("motor", "OK", "all is well", 0.1)
        return Process(command, tmp_path, "motor_driver", environment)

    node = begun()
    with running(node):
        await until(lambda: ros.graph() and len(heard) > 50)
        assert reported == []
        node.kill()
        silent = "diagnostics motor warning: motor reports nothing any more"
        await until(lambda: ros.graph() and reported == [silent])
    with running(begun()):
        await until(lambda: ros.graph() and reported == [silent, "diagnostics motor over: all is well"])
