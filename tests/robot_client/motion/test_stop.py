"""A stop of a whole daemon in memory: zero, the stored stop, and the resume."""

from __future__ import annotations

from typing import Any

import pytest

from relay_protocol import link
from relay_protocol.errors import Unavailable
from robot_client.motion.goal_canceller import GoalCanceller
from robot_client.motion.graph_zero_publisher import GraphZeroPublisher
from robot_client.motion.hardware import Hardware
from robot_client.motion.motion_control import MotionControl
from robot_client.motion.order_handler import STORE_EVERY, UNEXPECTED_ERROR
from robot_client.motion.stop_store import MemoryStopStore, StopRecorder
from robot_client.platforms.base import GraphView
from tests.worlds.memory_platform import TWIST
from tests.worlds.robot_commands import (
    GO,
    NAVIGATE,
    ZERO,
    SwitchWorld,
    messages_of,
    order,
    resume,
    stop,
    subscribed_topic,
)
from tests.worlds.robot_daemon import DRIVER, RelayEnd, Scene
from tests.worlds.robot_failures import broken


def test_stop_publishes_zero_cancels_goals_and_refuses_commands(scene: Scene, control: RelayEnd) -> None:
    """Zero is published before the answer."""
    scene.platform.actions = {NAVIGATE, "/count"}
    scene.platform.services["/arm/move"] = lambda request: request
    line = scene.driving(control)
    line.send(link.SendActionGoal(id="g", action="/count", type="a/action/B", source=DRIVER, cdr=""))
    assert order(control, stop()) == {"op": "order_result", "id": 2}
    assert scene.platform.published[-1] == ("/cmd_vel", ZERO)
    assert scene.platform.goals[0].cancelled
    scene.command(line, GO)
    line.received()
    line.send(link.SendActionGoal(id="n", action=NAVIGATE, type="a/action/B", source=DRIVER, cdr=""))
    (refused,) = messages_of(line, "action_result")
    assert "stopped until it is resumed" in refused["reason"]
    scene.run(1)
    assert {body for _, body in scene.platform.published[1:]} == {ZERO}


def test_stop_publishes_zero_also_on_topics_that_do_not_move(scene: Scene, control: RelayEnd) -> None:
    """On every topic that clients may command: another node may move the robot."""
    line = scene.channel(control)
    line.send(link.Advertise(number=5, topic="/cmd_vel", type=TWIST))
    order(control, stop())
    scene.run(0.5)
    assert scene.platform.published == 5 * [("/cmd_vel", ZERO)]


def test_stop_lasts_through_a_restart(scene: Scene, control: RelayEnd) -> None:
    """A daemon that starts with a stored stop reports it and obeys no command."""
    scene.driving(control)
    order(control, stop())
    again = Scene(scene.stop_store)
    control = again.register()
    (state,) = messages_of(control, "motion_state")
    assert (state["stopped"]["by"], state["stopped"]["why"]) == ("eve", "test")
    control.send(link.ControlGrant(id=1, holder=DRIVER))
    line = again.channel(control)
    line.send(link.Advertise(number=5, topic="/cmd_vel", type=TWIST))
    again.command(line, GO)
    again.run(1)
    assert again.platform.published == []


def test_stream_that_went_on_through_the_stop_is_refused_after_the_resume(
    scene: Scene, control: RelayEnd
) -> None:
    """After a pause it is obeyed."""
    line = scene.driving(control)
    order(control, stop())
    for _ in range(10):
        scene.clock.advance(0.05)
        scene.command(line, GO)
    assert order(control, resume()) == {"op": "order_result", "id": 3}
    assert scene.stop_store.stopped is None
    for _ in range(10):
        scene.clock.advance(0.05)
        scene.command(line, GO)
    assert scene.platform.published.count(("/cmd_vel", GO)) == 1
    scene.clock.advance(0.51)
    scene.command(line, GO)
    assert scene.platform.published[-1] == ("/cmd_vel", GO)


def test_stop_has_the_time_of_its_command(scene: Scene, control: RelayEnd) -> None:
    """By the relay's clock."""
    assert order(control, link.Stop(id=2, by="eve", at=1700.25)) == {"op": "order_result", "id": 2}
    assert scene.daemon.authority.stopped == link.Stopped(by="eve", since=1700.25)
    assert scene.stop_store.stopped == link.Stopped(by="eve", since=1700.25)


def test_second_stop_and_needless_resume_succeed(scene: Scene, control: RelayEnd) -> None:
    assert order(control, resume())["id"] == 3
    order(control, stop())
    assert order(control, link.Stop(id=4, by="ben")) == {"op": "order_result", "id": 4}
    assert scene.daemon.authority.stopped is not None
    assert scene.daemon.authority.stopped.by == "eve"


class FullDisk(MemoryStopStore):
    """Stores nothing, removes nothing."""

    def store(self, stopped: link.Stopped) -> None:
        raise Unavailable("the disk is full")

    def clear(self) -> None:
        raise Unavailable("the disk is read-only")


def test_stop_that_can_not_be_stored_holds_and_raises_an_alert() -> None:
    """The robot is resumed only when the record is removed."""
    scene = Scene(FullDisk())
    control = scene.register()
    scene.driving(control)
    control.received()
    control.send(stop())
    received = [each for each in control.received() if isinstance(each, dict)]
    (done,) = [each for each in received if each["op"] == "order_result"]
    assert (done["ok"], done["reason"]) == (False, "the disk is full")
    assert any("disk is full" in each["text"] for each in received if each["op"] == "alert")
    assert scene.platform.published[-1] == ("/cmd_vel", ZERO)
    assert order(control, resume())["reason"] == "the disk is read-only; the disk is full"
    assert scene.daemon.authority.stopped is not None


class CountingStopStore(MemoryStopStore):
    """Counts its calls, and fails as often as set."""

    def __init__(self, fails: int = 0) -> None:
        super().__init__()
        self.fails = fails
        self.writes = 0

    def store(self, stopped: link.Stopped) -> None:
        self.writes += 1
        if self.writes <= self.fails:
            raise Unavailable("the disk is full")
        super().store(stopped)


class Broken(MemoryStopStore):
    """Fails with an unexpected error."""

    def store(self, stopped: link.Stopped) -> None:
        raise RuntimeError("secret internals")


def test_unexpected_error_of_the_store_is_answered() -> None:
    """The stop is in effect and can be resumed; details stay in the log."""
    scene = Scene(Broken())
    control = scene.register()
    scene.driving(control)
    done = order(control, stop())
    assert (done["ok"], "can't be stored" in done["reason"], "secret" in done["reason"]) == (
        False,
        True,
        False,
    )
    assert scene.platform.published[-1] == ("/cmd_vel", ZERO)
    assert scene.daemon.authority.stopped is not None
    assert order(control, resume()) == {"op": "order_result", "id": 3}
    assert scene.daemon.authority.stopped is None


@pytest.mark.parametrize(
    ("owner", "part"),
    [
        (MotionControl, "zero_commanded_topics"),
        (Hardware, "stop"),
        (GoalCanceller, "stop"),
        (GraphZeroPublisher, "start"),
        (StopRecorder, "store"),
    ],
)
def test_unexpected_error_in_one_part_of_a_stop_does_not_prevent_the_others(
    monkeypatch: pytest.MonkeyPatch, owner: type, part: str
) -> None:
    """The answer says that one has failed."""
    switched = SwitchWorld()
    with monkeypatch.context() as broken_for_now:
        broken_for_now.setattr(owner, part, broken)
        switched.control.send(stop())
        for _ in switched.answers:
            switched.answer(True)
    (done,) = switched.done()
    assert (done["ok"], done["reason"]) == (False, UNEXPECTED_ERROR)
    assert switched.scene.daemon.authority.stopped is not None
    assert (len(switched.asked) == 1) is (owner is not Hardware)
    assert (switched.scene.stop_store.stopped is not None) is (owner is not StopRecorder)
    switched.control.send(resume())
    switched.answer(True)
    assert switched.done() == [{"op": "order_result", "id": 3}]


@pytest.mark.parametrize(
    ("owner", "part"), [(Hardware, "resume"), (MemoryStopStore, "clear"), (GoalCanceller, "end")]
)
def test_resume_with_an_unexpected_error_leaves_the_robot_stopped(
    monkeypatch: pytest.MonkeyPatch, owner: type, part: str
) -> None:
    """Switch and record too; the next resume works."""
    switched = SwitchWorld()
    switched.control.send(stop())
    switched.answer(True)
    switched.control.received()
    with monkeypatch.context() as broken_for_now:
        broken_for_now.setattr(owner, part, broken)
        switched.control.send(resume())
        while switched.answers:
            switched.answer(True)
    (done,) = switched.done()
    assert (done["ok"], "log says why" in done["reason"], "secret" in done["reason"]) == (False, True, False)
    assert switched.asked[-1] == b"\0\1\0\0\1"
    assert switched.scene.stop_store.stopped is not None
    switched.control.send(resume(4))
    switched.answer(True)
    assert switched.done() == [{"op": "order_result", "id": 4}]


@pytest.mark.parametrize("fails", [0, 2])
def test_stop_is_stored_once_and_again_only_after_a_failure(fails: int) -> None:
    stop_store = CountingStopStore(fails)
    control = Scene(stop_store).register()
    good = [order(control, stop(id)).get("ok", True) for id in range(2, 12)]
    assert good == [False] * fails + [True] * (10 - fails)
    assert stop_store.writes == fails + 1
    order(control, resume())
    order(control, stop())
    assert stop_store.writes == fails + 2


def test_failed_store_is_retried_while_the_robot_is_stopped() -> None:
    """The alert ends when it has worked."""
    stop_store = CountingStopStore(2)
    scene = Scene(stop_store)
    control = scene.register()
    assert order(control, stop())["ok"] is False
    texts: list[tuple[str, bool]] = []
    for _ in range(3 * STORE_EVERY):
        control.send(link.Ping(t=1))
        scene.clock.advance(1)
        texts += [(each["text"], each.get("over", False)) for each in messages_of(control, "alert")]
    assert stop_store.writes == 3
    assert stop_store.stopped is not None
    assert [over for _, over in texts] == [True]


def test_resume_ends_the_retries_and_the_alert_of_a_failed_store() -> None:
    stop_store = CountingStopStore(99)
    scene = Scene(stop_store)
    control = scene.register()
    order(control, stop())
    control.send(resume())
    assert [each["over"] for each in messages_of(control, "alert")] == [True]
    kept = stop_store.writes
    scene.run(3 * STORE_EVERY)
    assert stop_store.writes == kept


def test_hardware_is_stopped_before_the_disk_is_written(monkeypatch: pytest.MonkeyPatch) -> None:
    """A slow disk delays neither zero nor the switch."""
    switched = SwitchWorld()
    found: list[object] = []

    def store(stopped: link.Stopped) -> None:
        found.extend([switched.scene.platform.published[-1], len(switched.asked)])

    monkeypatch.setattr(switched.scene.stop_store, "store", store)
    switched.control.send(stop())
    assert found == [("/cmd_vel", ZERO), 1]


@pytest.fixture
def subscribed(scene: Scene) -> dict[str, link.Topic]:
    """A graph with subscribed topics."""
    topics = {
        "/nav_vel": subscribed_topic(TWIST),
        "/joy": subscribed_topic("sensor_msgs/msg/Joy"),
        "/chat": subscribed_topic("std_msgs/msg/String"),
        "/unheard": link.Topic(types=[TWIST]),
    }
    scene.platform.view = GraphView(topics=topics)
    return topics


def test_stop_publishes_zero_for_a_second_on_topics_of_other_nodes(
    scene: Scene, control: RelayEnd, subscribed: dict[str, link.Topic]
) -> None:
    """On motion topics with subscribers and a fixed zero; then the publisher is removed."""
    order(control, stop())
    assert scene.platform.published == [("/nav_vel", ZERO)]
    for _ in range(40):
        scene.clock.advance(0.05)
    assert scene.platform.published == 20 * [("/nav_vel", ZERO)]
    assert scene.platform.publishers == []


def test_resume_ends_the_zeros_of_a_stop(
    scene: Scene, control: RelayEnd, subscribed: dict[str, link.Topic]
) -> None:
    order(control, stop())
    order(control, resume())
    scene.run(1)
    assert scene.platform.published == [("/nav_vel", ZERO)]
    assert scene.platform.publishers == []


def test_zeros_of_a_stop_are_bounded_and_survive_a_failing_topic(
    scene: Scene, control: RelayEnd, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sixteen topics at most."""
    scene.platform.view = GraphView(
        topics={f"/v{number:02}": subscribed_topic(TWIST) for number in range(50)}
    )
    advertise = scene.platform.advertise

    def picky(topic: str, *args: Any) -> Any:
        if topic == "/v00":
            raise Unavailable("no such thing")
        return advertise(topic, *args)

    monkeypatch.setattr(scene.platform, "advertise", picky)
    assert order(control, stop()) == {"op": "order_result", "id": 2}
    assert [topic for topic, _ in scene.platform.published] == [f"/v{number:02}" for number in range(1, 16)]
