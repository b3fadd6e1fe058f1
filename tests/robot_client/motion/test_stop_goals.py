"""A stop cancels the goals of all actions that move the robot."""

from __future__ import annotations

import pytest
from twisted.internet.defer import Deferred

from relay_protocol import link
from robot_client.motion.goal_canceller import MAX_NAMES, MAX_REQUESTS, STOP_SECONDS
from robot_client.motion.goal_status_reader import READ_AFTER, STATUS
from robot_client.motion.guard_protocol import CANCEL
from robot_client.motion.hardware import Switches
from robot_client.motion.stop_store import MemoryStopStore
from robot_client.platforms.base import CANCELED, GoalOutcome, GraphView
from tests.worlds.memory_platform import TWIST
from tests.worlds.robot_commands import (
    ALL_GOALS,
    BEFORE,
    NAVIGATE,
    ZERO,
    ActionsWorld,
    order,
    resume,
    stop,
    subscribed_topic,
)
from tests.worlds.robot_daemon import DRIVER
from tests.worlds.robot_failures import broken


@pytest.mark.parametrize(("code", "good"), [(0, True), (1, False), (2, True), (3, True)])
def test_stop_cancels_every_goal_of_the_actions_that_move_the_robot(
    acting: ActionsWorld, code: int, good: bool
) -> None:
    """Also goals of an earlier daemon; only a refusal makes the answer bad."""
    acting.control.send(stop())
    assert acting.asked == [ALL_GOALS]
    assert acting.messages("order_result") == []
    acting.answer(code)
    (done,) = acting.messages("order_result")
    assert done.get("ok", True) is good
    assert good or NAVIGATE in done["reason"]


def test_stop_waits_two_seconds_for_an_action(acting: ActionsWorld) -> None:
    """Then the answer and an alert name the action."""
    acting.control.send(stop())
    acting.pass_seconds(round(STOP_SECONDS) - 1)
    assert acting.messages("order_result") == []
    acting.pass_seconds(1)
    received = [each for each in acting.control.received() if isinstance(each, dict)]
    (done,) = [each for each in received if each["op"] == "order_result"]
    assert (done["id"], done["ok"], NAVIGATE in done["reason"]) == (2, False, True)
    (alert,) = [each for each in received if each["op"] == "alert"]
    assert (alert["level"], alert["kind"], NAVIGATE in alert["text"]) == ("error", "stop", True)


def test_unanswered_cancel_request_is_repeated_every_second(acting: ActionsWorld) -> None:
    """Then the alert ends, and later goals are not cancelled."""
    acting.control.send(stop())
    acting.pass_seconds(10)
    assert 9 <= len(acting.asked) <= 11
    acting.control.received()
    acting.answer()
    asked = len(acting.asked)
    acting.pass_seconds(10)
    assert len(acting.asked) == asked
    (alert,) = acting.messages("alert")
    assert (alert["kind"], alert["over"]) == ("stop", True)


def test_resume_ends_cancel_requests_and_their_alert(acting: ActionsWorld) -> None:
    acting.control.send(stop())
    acting.pass_seconds(3)
    acting.control.received()
    given_up = acting.given_up
    assert given_up == len(acting.asked) - 1
    acting.control.send(resume())
    assert acting.given_up == given_up + 1
    (alert,) = acting.messages("alert")
    assert alert["over"] is True
    asked = len(acting.asked)
    acting.pass_seconds(5)
    assert len(acting.asked) == asked


def test_action_that_appears_during_a_stop_gets_one_cancel_request(acting: ActionsWorld) -> None:
    """One that returns gets none."""
    acting.show()
    assert order(acting.control, stop()) == {"op": "order_result", "id": 2}
    acting.pass_seconds(60)
    acting.show(NAVIGATE)
    acting.pass_seconds(1)
    acting.answer()
    acting.show()
    acting.pass_seconds(2)
    acting.show(NAVIGATE)
    acting.pass_seconds(5)
    assert acting.asked == [ALL_GOALS]
    assert acting.messages("alert") == []


def test_stop_cancels_every_time(acting: ActionsWorld) -> None:
    """Other clients may have sent goals since."""
    for id in (2, 3):
        acting.control.send(stop(id))
        acting.answer()
        acting.pass_seconds(3)
    assert acting.asked == 2 * [ALL_GOALS]
    assert acting.messages("order_result") == [
        {"op": "order_result", "id": 2},
        {"op": "order_result", "id": 3},
    ]


def test_stop_during_another_stop_is_complete() -> None:
    """All goals are cancelled and zero is published again, although the switch still hangs."""
    acting = ActionsWorld(switches=Switches("/estop"))
    switch = link.Service(types=["std_srvs/srv/Trigger"])
    actions, topics = acting.scene.platform.view.actions, {"/nav_vel": subscribed_topic(TWIST)}
    acting.scene.platform.view = GraphView(actions=actions, topics=topics, services={"/estop": switch})
    acting.scene.platform.services["/estop"] = lambda request: Deferred()
    acting.control.send(stop())
    acting.answer()
    acting.pass_zeros(40)
    assert (len(acting.asked), acting.scene.platform.published) == (1, 20 * [("/nav_vel", ZERO)])
    acting.control.send(stop(4))
    assert acting.asked == 2 * [ALL_GOALS]
    acting.pass_zeros(40)
    assert acting.scene.platform.published == 40 * [("/nav_vel", ZERO)]
    assert acting.messages("order_result") == []
    acting.pass_seconds(3)
    first, second = acting.messages("order_result")
    assert [first["id"], second["id"]] == [2, 4]
    assert ("/estop did not answer" in second["reason"], NAVIGATE in second["reason"]) == (True, True)


def test_action_with_a_pending_request_gets_the_next_after_its_answer(acting: ActionsWorld) -> None:
    """Each action has one request at a time."""
    for id in (2, 3, 4):
        acting.control.send(stop(id))
    assert acting.asked == [ALL_GOALS]
    acting.answer()
    assert acting.messages("order_result") == [{"op": "order_result", "id": 2}]
    assert acting.asked == 2 * [ALL_GOALS]
    acting.answer()
    assert acting.messages("order_result") == [
        {"op": "order_result", "id": 3},
        {"op": "order_result", "id": 4},
    ]
    acting.pass_seconds(5)
    assert len(acting.asked) == 2
    assert acting.messages("alert") == []


def test_stops_have_their_own_timeouts(acting: ActionsWorld) -> None:
    """An answer to the second does not change that of the first."""
    acting.control.send(stop())
    acting.scene.clock.advance(0.5)
    acting.control.send(stop(4))
    acting.scene.clock.advance(0.5)
    assert acting.asked == 2 * [ALL_GOALS]
    acting.scene.clock.advance(0.9)
    assert acting.messages("order_result") == []
    acting.scene.clock.advance(0.1)
    (done,) = acting.messages("order_result")
    assert (done["id"], done["ok"], NAVIGATE in done["reason"]) == (2, False, True)
    acting.pass_zeros(5)
    acting.scene.daemon.order_handler.check()
    acting.answer()
    assert acting.messages("order_result") == [{"op": "order_result", "id": 4}]


def test_late_refusal_is_an_alert(acting: ActionsWorld) -> None:
    """The stop has been answered already."""
    acting.control.send(stop())
    acting.pass_seconds(3)
    acting.control.received()
    acting.answer(1)
    acting.pass_seconds(1)
    (alert,) = acting.messages("alert")
    assert f"{NAVIGATE} refuses" in alert["text"]


def test_refused_cancel_request_is_repeated_every_second(acting: ActionsWorld) -> None:
    """One alert at the beginning and one at the end."""
    acting.control.send(stop())
    acting.answer(1)
    (alert,) = acting.messages("alert")
    assert (alert["level"], alert["kind"]) == ("error", "stop")
    for _ in range(5):
        acting.pass_seconds(1)
        acting.answer(1)
    assert len(acting.asked) == 6
    assert acting.messages("alert") == []
    acting.pass_seconds(1)
    acting.answer()
    acting.pass_seconds(5)
    assert len(acting.asked) == 7
    assert [each["over"] for each in acting.messages("alert")] == [True]


EXECUTING = b"\0\1\0\0\1" + bytes(3 + 24) + b"\2"
ENDED = EXECUTING[:-1] + b"\4"
CANCELING = EXECUTING[:-1] + b"\3"
TWO = b"\0\1\0\0\2" + CANCELING[5:] + bytes(3 + 24) + b"\2"
"""Of one goal that is being cancelled, and one that goes on."""
ACCEPTED = b"\0\1\0\0" + bytes(4) + b"\1" + bytes(3 + 24)
"""An action's answer that it cancels one goal."""


def test_silent_refusal_is_detected_by_the_published_status(acting: ActionsWorld) -> None:
    """An action without goals gives the same answer, so the stop is confirmed and an alert follows."""
    acting.control.send(stop())
    acting.answer()
    assert acting.messages("order_result") == [{"op": "order_result", "id": 2}]
    for _ in range(3):
        acting.scene.clock.advance(READ_AFTER)
        acting.scene.platform.emit(NAVIGATE + STATUS, EXECUTING)
        acting.pass_seconds(1)
        acting.answer()
    assert len(acting.asked) == 4
    (alert,) = acting.messages("alert")
    assert (alert["kind"], f"{NAVIGATE} refuses" in alert["text"]) == ("stop", True)
    acting.scene.clock.advance(READ_AFTER)
    acting.scene.platform.emit(NAVIGATE + STATUS, ENDED)
    acting.pass_seconds(5)
    assert [each["over"] for each in acting.messages("alert")] == [True]
    assert (len(acting.asked), acting.scene.platform.subscriptions) == (4, [])


def test_partial_refusal_is_detected_by_the_published_status(acting: ActionsWorld) -> None:
    """rclpy leaves refused goals out of its answer."""
    acting.control.send(stop())
    for _ in range(4):
        acting.answers.pop().callback(ACCEPTED)
        acting.scene.clock.advance(READ_AFTER)
        acting.scene.platform.emit(NAVIGATE + STATUS, TWO)
        if not acting.answers:
            acting.pass_seconds(1)
    received = [each for each in acting.control.received() if isinstance(each, dict)]
    assert [each for each in received if each["op"] == "order_result"] == [{"op": "order_result", "id": 2}]
    (alert,) = [each for each in received if each["op"] == "alert"]
    assert (alert["kind"], f"{NAVIGATE} refuses" in alert["text"]) == ("stop", True)
    acting.answers.pop().callback(ACCEPTED)
    acting.scene.clock.advance(READ_AFTER)
    acting.scene.platform.emit(NAVIGATE + STATUS, ENDED)
    acting.pass_seconds(5)
    assert [each["over"] for each in acting.messages("alert")] == [True]
    assert (len(acting.asked), acting.scene.platform.subscriptions) == (5, [])


def test_goal_accepted_just_after_the_cancel_request_is_cancelled_at_once(acting: ActionsWorld) -> None:
    acting.control.send(stop())
    acting.answers.pop().callback(ACCEPTED)
    acting.scene.clock.advance(READ_AFTER)
    acting.scene.platform.emit(NAVIGATE + STATUS, CANCELING)
    acting.scene.clock.advance(0.05)
    assert len(acting.asked) == 1
    acting.scene.platform.emit(NAVIGATE + STATUS, TWO)
    assert acting.asked == 2 * [ALL_GOALS]
    acting.answers.pop().callback(ACCEPTED)
    acting.scene.clock.advance(READ_AFTER)
    acting.scene.platform.emit(NAVIGATE + STATUS, CANCELING)
    acting.pass_seconds(5)
    assert (len(acting.asked), acting.scene.platform.subscriptions) == (2, [])
    assert acting.messages("alert") == []


def test_resume_ends_the_reading_of_status(acting: ActionsWorld) -> None:
    """Later goals continue."""
    acting.control.send(stop())
    acting.answer()
    acting.control.send(resume())
    acting.scene.clock.advance(READ_AFTER)
    assert acting.scene.platform.subscriptions == []
    acting.pass_seconds(3)
    assert len(acting.asked) == 1


def test_unfinished_goal_of_a_client_is_reported(acting: ActionsWorld) -> None:
    """The action has accepted the cancel request, but the goal has not ended."""
    acting.scene.platform.actions = {NAVIGATE}
    line = acting.scene.driving(acting.control)
    for id in "ab":
        line.send(link.SendActionGoal(id=id, action=NAVIGATE, type="a/action/B", source=DRIVER, cdr=""))
    first, second = acting.scene.platform.goals
    acting.control.received()
    acting.control.send(stop())
    acting.answer()
    first.result.callback(GoalOutcome(CANCELED, None))
    assert acting.messages("order_result") == []
    acting.pass_seconds(2)
    (done,) = acting.messages("order_result")
    assert (done["ok"], NAVIGATE in done["reason"]) == (False, True)
    second.result.callback(GoalOutcome(CANCELED, None))
    acting.pass_seconds(1)
    (alert,) = acting.messages("alert")
    assert (alert["kind"], alert["over"]) == ("stop", True)


def test_publisher_of_zero_is_ready_while_a_goal_moves_the_robot(acting: ActionsWorld) -> None:
    """A robot with a frozen navigator stops at the first zero, without discovering a new publisher."""
    platform = acting.scene.platform
    platform.actions = {NAVIGATE}
    platform.view = GraphView(topics={"/nav_vel": subscribed_topic(TWIST)}, actions=platform.view.actions)
    line = acting.scene.driving(acting.control)
    line.send(link.SendActionGoal(id="g", action=NAVIGATE, type="a/action/B", source=DRIVER, cdr=""))
    assert "/nav_vel" in [each.topic for each in platform.publishers]
    platform.goals[0].result.callback(GoalOutcome(CANCELED, None))
    assert "/nav_vel" not in [each.topic for each in platform.publishers]


def test_stop_is_confirmed_when_the_last_goal_of_a_client_has_ended(acting: ActionsWorld) -> None:
    acting.scene.platform.actions = {NAVIGATE}
    line = acting.scene.driving(acting.control)
    line.send(link.SendActionGoal(id="g", action=NAVIGATE, type="a/action/B", source=DRIVER, cdr=""))
    acting.control.received()
    acting.control.send(stop())
    acting.answer()
    acting.scene.platform.goals[0].result.callback(GoalOutcome(CANCELED, None))
    assert acting.messages("order_result") == [{"op": "order_result", "id": 2}]


def test_stop_reports_an_unreadable_graph(acting: ActionsWorld, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its actions get their requests when it can be read."""
    with monkeypatch.context() as broken_for_now:
        broken_for_now.setattr(acting.scene.platform, "graph", broken)
        done = order(acting.control, stop())
    assert (done["ok"], "could not be read from the graph" in done["reason"]) == (False, True)
    acting.pass_seconds(1)
    assert acting.asked == [ALL_GOALS]


def test_stop_with_an_unreadable_graph_uses_the_actions_seen_before(
    acting: ActionsWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    acting.control.send(stop())
    acting.answer(1)
    acting.pass_seconds(1)
    acting.answer(1)
    acting.control.received()
    with monkeypatch.context() as broken_for_now:
        broken_for_now.setattr(acting.scene.platform, "graph", broken)
        asked = len(acting.asked)
        acting.control.send(stop(4))
        assert len(acting.asked) == asked + 1
        acting.answer(1)
        received = [each for each in acting.control.received() if isinstance(each, dict)]
    (done,) = [each for each in received if each["op"] == "order_result"]
    assert (
        "could not be read from the graph" in done["reason"],
        f"{NAVIGATE} refuses" in done["reason"],
    ) == (
        True,
        True,
    )
    assert not any(each.get("over") for each in received if each["op"] == "alert")


def test_cancel_requests_are_bounded_and_reach_every_action(
    acting: ActionsWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = [f"/r{number:03}/spin" for number in range(MAX_REQUESTS + 10)]
    acting.show(*names)
    asked: dict[str, int] = dict.fromkeys(names, 0)

    def call(service: str, type: str, request: bytes, timeout: float) -> Deferred[bytes]:
        asked[service.removesuffix(CANCEL)] += 1
        return Deferred()

    monkeypatch.setattr(acting.scene.platform, "call", call)
    acting.control.send(stop())
    assert sum(asked.values()) == MAX_REQUESTS
    acting.pass_seconds(2)
    assert min(asked.values()) == 1
    (done,) = acting.messages("order_result")
    assert "/r000/spin" in done["reason"]
    assert f"and {len(names) - MAX_NAMES} more" in done["reason"]


def test_daemon_that_starts_stopped_cancels_goals_of_the_earlier_one() -> None:
    """Until the action has answered."""
    acting = ActionsWorld(MemoryStopStore(BEFORE))
    acting.pass_seconds(40)
    assert len(acting.asked) >= 39
    acting.answer()
    asked = len(acting.asked)
    acting.pass_seconds(40)
    assert set(acting.asked) == {ALL_GOALS}
    assert len(acting.asked) == asked


def test_stop_reports_an_action_that_can_not_be_called(acting: ActionsWorld) -> None:
    acting.scene.platform.services.clear()
    acting.control.send(stop())
    acting.pass_seconds(2)
    (done,) = acting.messages("order_result")
    assert (done["ok"], NAVIGATE in done["reason"]) == (False, True)
