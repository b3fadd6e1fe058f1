"""Goals that move the robot: the guard is notified of them, and their actions are stored, in memory."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from action_msgs.msg import GoalStatus
from twisted.internet.defer import Deferred
from twisted.internet.task import Clock

from relay_protocol import link
from relay_protocol.errors import Unavailable
from relay_protocol.link import MotionPolicy
from robot_client.motion.active_goals import (
    GOALS_END_SECONDS,
    GUARD_CLIENT_SECONDS,
    LEFTOVER_ATTEMPTS,
    LINK_UNPROVEN_AFTER,
    MAX_ACTIONS,
    MAX_CANCELLING,
    MAX_ORPHANED,
    NOTIFY_GUARD_EVERY,
    ORPHAN_SECONDS,
    ActiveGoals,
)
from robot_client.motion.goal_canceller import ANSWER_SECONDS, GoalCanceller
from robot_client.motion.goal_status_reader import READ_AFTER, STATUS
from robot_client.motion.guard_port import NoGuard
from robot_client.motion.guard_protocol import CANCEL, GOALS_WITHIN_MS, cancelling
from robot_client.motion.stop_store import MemoryStopStore
from robot_client.motion.typed_topic import TypedTopic
from robot_client.platforms.base import ABORTED, CANCELED, GoalOutcome, GraphView
from tests.worlds.goal_statuses import published
from tests.worlds.memory_platform import MemoryGoalHandle, MemoryPlatform
from tests.worlds.robot_daemon import DRIVER, RelayEnd
from tests.worlds.robot_daemon import Scene as DaemonScene

SPIN = "/robot1/spin"
ACCEPTED = b"\0\1\0\0" + bytes(4) + b"\1" + bytes(3 + 24)
REFUSED = b"\0\1\0\0\1" + bytes(7)
REFUSED_SILENTLY = b"\0\1\0\0" + bytes(8)
"""As a server of rclpy says it: no error, and nothing that is being cancelled."""
UNKNOWN = b"\0\1\0\0\2" + bytes(7)
ENDED = b"\0\1\0\0\3" + bytes(7)


class RecordingGuard(NoGuard):
    """Records the notifications of the guard."""

    def __init__(self) -> None:
        self.topics: set[TypedTopic] = set()
        self.commands: list[tuple[TypedTopic, bool, int]] = []
        self.matched = True

    def add_topic(self, topic: TypedTopic) -> None:
        self.topics.add(topic)

    def forget(self, topic: TypedTopic) -> None:
        self.topics.discard(topic)

    def ready(self, topic: TypedTopic) -> bool:
        return self.matched

    def note_command(self, topic: TypedTopic, moving: bool, at: int) -> None:
        self.commands.append((topic, moving, at))


class BrokenStopStore(MemoryStopStore):
    def store_actions(self, actions: list[str]) -> None:
        raise Unavailable("the disk is full")


class Scene:
    """
    :param left: what lies on the disk at the start
    """

    def __init__(self, left: Sequence[str] | None = (), stop_store: MemoryStopStore | None = None) -> None:
        self.clock = Clock()
        self.guard = RecordingGuard()
        self.stop_store = stop_store or MemoryStopStore()
        self.stop_store.actions = None if left is None else list(left)
        self.platform = MemoryPlatform(GraphView())
        self.asked: list[str] = []
        self.cancelled_ids: list[bytes] = []
        """The ids of the goals to be cancelled."""
        policy = MotionPolicy(actions=["*/spin"])
        goal_canceller = GoalCanceller(policy, self.platform, self.clock)
        self.active_goals = ActiveGoals(
            policy.actions, self.guard, goal_canceller, self.stop_store, self.clock, self.now
        )

    def now(self) -> int:
        return round(self.clock.seconds() * 1e9)

    def begin(self, action: str = SPIN) -> MemoryGoalHandle:
        goal = MemoryGoalHandle(action, b"", None)
        self.active_goals.check(action)
        self.active_goals.add(action, goal)
        return goal

    def appear(self, action: str, answer: bytes | None = ACCEPTED) -> None:
        """Add an action that gives this answer, or none, to a request to cancel all its goals."""

        def cancel(request: bytes) -> bytes | Deferred[bytes]:
            self.asked.append(action)
            self.cancelled_ids.append(request[4:20])
            return Deferred() if answer is None else answer

        self.platform.services[action + CANCEL] = cancel
        actions = {**self.platform.view.actions, action: link.Service(types=["t"])}
        self.platform.view = GraphView(actions=actions)

    def vanish(self, action: str) -> None:
        actions = {name: each for name, each in self.platform.view.actions.items() if name != action}
        self.platform.view = GraphView(actions=actions)

    def retry_cancels(self, times: int = 1) -> None:
        for _ in range(times):
            self.active_goals.retry_cancels()
            self.clock.advance(1.0)


@pytest.fixture
def scene() -> Scene:
    return Scene()


def end(goal: MemoryGoalHandle) -> None:
    goal.result.callback(GoalOutcome(CANCELED, None, "as you wish"))


def lose(goal: MemoryGoalHandle) -> None:
    goal.result.callback(GoalOutcome(ABORTED, None, "its action vanished", certain=False))


def test_guard_is_notified_repeatedly_while_a_goal_is_active(scene: Scene) -> None:
    """Often enough to detect a frozen daemon."""
    goal = scene.begin()
    for _ in range(20):
        scene.clock.advance(NOTIFY_GUARD_EVERY)
    times = [at for topic, moving, at in scene.guard.commands if moving and topic == cancelling(SPIN)]
    assert len(times) == 21
    assert 5 * NOTIFY_GUARD_EVERY * 1000 <= GOALS_WITHIN_MS
    end(goal)
    assert scene.guard.commands[-1] == (cancelling(SPIN), False, scene.now())
    before = len(scene.guard.commands)
    scene.clock.advance(GUARD_CLIENT_SECONDS - 1)
    assert len(scene.guard.commands) == before
    assert scene.guard.topics == {cancelling(SPIN)}
    scene.clock.advance(1)
    assert scene.guard.topics == set()
    assert scene.clock.getDelayedCalls() == []


def test_guard_has_the_clients_of_actions_in_the_graph_before_a_goal_begins(scene: Scene) -> None:
    """It takes DDS up to seconds to match them, and a goal may begin and the daemon die meanwhile."""
    scene.appear(SPIN)
    scene.appear("/other")
    scene.retry_cancels()
    assert scene.guard.topics == {cancelling(SPIN)}
    goal = scene.begin()
    scene.vanish(SPIN)
    scene.retry_cancels()
    assert scene.guard.topics == {cancelling(SPIN)}, "its goal may still be executed"
    end(goal)
    scene.clock.advance(GUARD_CLIENT_SECONDS)
    assert scene.guard.topics == set()
    scene.appear(SPIN)
    scene.retry_cancels()
    end(scene.begin())
    scene.clock.advance(GUARD_CLIENT_SECONDS)
    assert scene.guard.topics == {cancelling(SPIN)}, "it is in the graph"
    scene.vanish(SPIN)
    scene.retry_cancels()
    assert scene.guard.topics == set()


def test_a_goal_waits_until_the_guard_can_cancel_it(scene: Scene) -> None:
    """Also in the first second of the daemon, before the graph was read."""
    scene.appear(SPIN)
    scene.guard.matched = False
    with pytest.raises(Unavailable, match="the robot's guard can't cancel goals of /robot1/spin yet"):
        scene.begin()
    assert scene.guard.topics == {cancelling(SPIN)}
    scene.guard.matched = True
    scene.begin()


def test_an_action_that_is_not_in_the_graph_does_not_wait_for_the_guard(scene: Scene) -> None:
    scene.guard.matched = False
    scene.begin()


def test_action_is_active_until_its_last_goal_has_ended(scene: Scene) -> None:
    """The guard keeps its client for a while, as another goal may follow."""
    first, second = scene.begin(), scene.begin()
    end(first)
    assert scene.guard.commands[-1][1]
    assert scene.stop_store.actions == [SPIN]
    end(second)
    assert scene.stop_store.actions == []
    scene.begin()
    scene.clock.advance(GUARD_CLIENT_SECONDS * 2)
    assert scene.guard.topics == {cancelling(SPIN)}


def test_goals_ended_fires_after_the_last_goal_or_the_timeout(scene: Scene) -> None:
    """With the actions that are still active."""
    results: list[tuple[str, list[str]]] = []

    def wait(name: str, seconds: float) -> None:
        scene.active_goals.goals_ended(seconds).addCallback(lambda actions: results.append((name, actions)))

    wait("none", 1.0)
    first, second = scene.begin(), scene.begin("/left/spin")
    wait("impatient", 1.0)
    wait("patient", 3.0)
    end(first)
    scene.clock.advance(1.0)
    assert results == [("none", []), ("impatient", ["/left/spin"])]
    end(second)
    scene.clock.advance(9.0)
    assert results[2:] == [("patient", [])]


def test_actions_with_goals_are_stored(scene: Scene) -> None:
    left, right = scene.begin("/left/spin"), scene.begin("/right/spin")
    assert scene.stop_store.actions == ["/left/spin", "/right/spin"]
    end(left)
    assert scene.stop_store.actions == ["/right/spin"]
    end(right)
    assert scene.stop_store.actions == []


def test_leftover_goals_are_cancelled_once_when_their_action_appears() -> None:
    """Other actions are not affected."""
    scene = Scene(["/late/spin", SPIN])
    scene.appear("/other/spin")
    scene.appear(SPIN)
    scene.retry_cancels(3)
    assert scene.asked == [SPIN]
    assert scene.stop_store.actions == ["/late/spin"]
    scene.appear("/late/spin")
    scene.retry_cancels(LEFTOVER_ATTEMPTS)
    assert scene.asked == [SPIN, "/late/spin"]
    assert scene.stop_store.actions == []


def test_no_goal_begins_before_leftover_goals_of_its_action_are_cancelled() -> None:
    """A new goal would be cancelled with them."""
    scene = Scene([SPIN])
    with pytest.raises(Unavailable, match="try again in a moment"):
        scene.begin()
    scene.begin("/other/spin")
    scene.appear(SPIN)
    scene.retry_cancels()
    with pytest.raises(Unavailable, match="try again in a moment"):
        scene.begin()  # its published status may still show an active one
    scene.retry_cancels(2)
    scene.begin()
    scene.retry_cancels(LEFTOVER_ATTEMPTS)
    assert scene.asked == [SPIN]
    assert scene.stop_store.actions == ["/other/spin", SPIN]


def test_unanswered_cancel_request_for_leftover_goals_is_repeated() -> None:
    scene = Scene([SPIN])
    scene.appear(SPIN, None)
    scene.retry_cancels(2)
    assert scene.clock.seconds() >= 2 * ANSWER_SECONDS
    assert scene.asked == [SPIN, SPIN]
    scene.appear(SPIN)
    scene.retry_cancels(2)
    assert len(scene.asked) == 3


def test_refused_cancel_request_for_leftover_goals_is_repeated() -> None:
    """Without a limit; no goal begins on that action, and it stays stored."""
    scene = Scene([SPIN, "/late/spin"])
    scene.appear(SPIN, REFUSED)
    scene.retry_cancels(3 * LEFTOVER_ATTEMPTS)
    assert len(scene.asked) == 3 * LEFTOVER_ATTEMPTS
    assert scene.stop_store.actions == [SPIN]
    assert scene.active_goals.uncancelled_actions == [SPIN]
    with pytest.raises(Unavailable, match="try again in a moment"):
        scene.begin()
    scene.begin("/late/spin")
    scene.appear(SPIN)
    scene.retry_cancels(3)
    assert len(scene.asked) == 3 * LEFTOVER_ATTEMPTS + 1
    assert scene.stop_store.actions == ["/late/spin"]
    assert scene.active_goals.uncancelled_actions == []
    scene.begin()


def test_partly_refused_leftover_goals_are_detected_by_the_status() -> None:
    """rclpy leaves refused goals out of its answer."""
    scene = Scene([SPIN])
    scene.appear(SPIN)
    scene.active_goals.retry_cancels()
    scene.clock.advance(READ_AFTER)
    scene.platform.emit(SPIN + STATUS, b"\0\1\0\0\1" + bytes(3 + 24) + b"\2")
    with pytest.raises(Unavailable, match="try again in a moment"):
        scene.begin()
    assert scene.active_goals.uncancelled_actions == [SPIN]
    scene.retry_cancels(3)
    assert scene.asked == [SPIN, SPIN]
    scene.begin()


def publish(scene: Scene, *goals: int) -> None:
    """Publish, as the action that was just asked, that these goals are active."""
    scene.clock.advance(READ_AFTER)
    status = published((bytes([goal]) * 16, GoalStatus.STATUS_EXECUTING) for goal in goals)
    scene.platform.emit(SPIN + STATUS, status)
    scene.clock.advance(1.0 - READ_AFTER)


def test_later_goals_of_other_clients_are_not_leftover() -> None:
    """They are cancelled once more at most."""
    scene = Scene([SPIN])
    scene.appear(SPIN)
    for goal in range(1, 6):
        scene.active_goals.retry_cancels()
        publish(scene, goal)
    assert scene.asked == [SPIN, SPIN]
    assert scene.stop_store.actions == []
    assert scene.active_goals.uncancelled_actions == []
    scene.begin()


def test_leftover_goal_is_cancelled_until_it_ends_among_those_of_others() -> None:
    scene = Scene([SPIN])
    scene.appear(SPIN)
    for goals in ((1, 2), (3, 2, 4), (2,), (5, 2, 4)):
        scene.active_goals.retry_cancels()
        publish(scene, *goals)
        assert scene.active_goals.uncancelled_actions == [SPIN]
    scene.active_goals.retry_cancels()
    publish(scene, 1, 5)
    assert scene.active_goals.uncancelled_actions == []
    scene.retry_cancels(3)
    assert len(scene.asked) == 5


def test_refusing_action_is_given_up_after_ten_minutes_out_of_the_graph() -> None:
    scene = Scene([SPIN, "/left/spin"])
    for action in (SPIN, "/left/spin"):
        scene.appear(action, REFUSED)
    scene.retry_cancels(2)
    scene.vanish(SPIN)
    scene.retry_cancels(round(ORPHAN_SECONDS) - 1)
    scene.appear(SPIN, REFUSED)
    scene.retry_cancels()
    scene.vanish(SPIN)
    scene.retry_cancels(round(ORPHAN_SECONDS))
    assert scene.active_goals.uncancelled_actions == ["/left/spin", SPIN]
    with pytest.raises(Unavailable):
        scene.begin()
    scene.retry_cancels()
    assert scene.active_goals.uncancelled_actions == ["/left/spin"]
    assert scene.stop_store.actions == ["/left/spin"]
    scene.begin()


def test_leftover_action_that_never_appears_is_given_up() -> None:
    """After half a minute."""
    scene = Scene([SPIN])
    scene.retry_cancels(LEFTOVER_ATTEMPTS)
    scene.begin()
    scene.appear(SPIN)
    scene.retry_cancels()
    assert scene.asked == []


def test_damaged_store_counts_as_all_motion_actions() -> None:
    scene = Scene(None)
    scene.appear(SPIN)
    scene.appear("/dock_is_free")
    scene.retry_cancels(3)
    assert scene.asked == [SPIN]
    scene.begin()


def test_guard_is_notified_when_the_store_fails() -> None:
    scene = Scene(stop_store=BrokenStopStore())
    end(scene.begin())
    assert [moving for _, moving, _ in scene.guard.commands] == [True, False]


def test_number_of_actions_is_bounded() -> None:
    """One more is refused while all are active, and replaces an idle one."""
    scene = Scene()
    goals = [scene.begin(f"/r{number}/spin") for number in range(MAX_ACTIONS)]
    with pytest.raises(Unavailable, match=str(MAX_ACTIONS)):
        scene.begin()
    scene.begin("/r3/spin")
    end(goals[0])
    scene.begin()
    assert len(scene.guard.topics) == MAX_ACTIONS
    assert cancelling("/r0/spin") not in scene.guard.topics


def test_goals_of_clients_are_tracked_by_full_action_names() -> None:
    """Through the whole daemon, where they move the robot."""
    scene = DaemonScene()
    scene.platform.actions = {"/spin", "spin", "/look"}
    control = scene.register()
    control.send(link.ControlGrant(id=1, holder=DRIVER, user="ann", level="operator"))
    channel = scene.channel(control)
    for action in ("spin", "/look"):
        channel.send(link.SendActionGoal(id=action, action=action, type="t", source=DRIVER, cdr=""))
    assert len(scene.platform.goals) == 2
    assert scene.stop_store.actions == ["/spin"]
    channel.lose()
    assert scene.platform.goals[0].cancelled
    assert scene.stop_store.actions == ["/spin"]  # it has not ended yet
    end(scene.platform.goals[0])
    assert scene.stop_store.actions == []


def test_daemon_cancels_leftover_goals_after_its_start() -> None:
    """Every second, also without a relay."""
    stop_store = MemoryStopStore()
    stop_store.actions = ["/spin"]
    scene = DaemonScene(stop_store)
    asked: list[bytes] = []

    def cancel(request: bytes) -> bytes:
        asked.append(request)
        return ACCEPTED

    scene.platform.services["/spin" + CANCEL] = cancel
    scene.platform.view = GraphView(actions={"/spin": link.Service(types=["t"])})
    scene.run(3.0)
    assert len(asked) == 1
    assert stop_store.actions == []


def test_orphaned_goal_is_cancelled_when_its_action_returns(scene: Scene) -> None:
    """Only this goal, and once."""
    lost, other = scene.begin(), scene.begin()
    lose(lost)
    end(other)
    scene.retry_cancels(3)
    assert scene.asked == []
    assert scene.stop_store.actions == [SPIN]
    assert scene.guard.commands[-1][1] is True
    scene.appear(SPIN)
    scene.retry_cancels(3)
    assert scene.cancelled_ids == [lost.id]
    assert scene.stop_store.actions == []
    assert scene.guard.commands[-1][1] is False


def test_orphaned_goal_delays_neither_control_nor_new_goals(scene: Scene) -> None:
    lose(scene.begin())
    results: list[list[str]] = []
    scene.active_goals.goals_ended(1.0).addCallback(results.append)
    assert results == [[SPIN]]
    scene.begin()
    scene.appear(SPIN)
    scene.retry_cancels(2)
    assert len(scene.asked) == 1
    assert scene.stop_store.actions == [SPIN]
    assert scene.guard.commands[-1][1] is True


def test_unanswered_cancel_request_for_an_orphaned_goal_is_repeated(scene: Scene) -> None:
    """Every second."""
    lose(scene.begin())
    scene.appear(SPIN, None)
    scene.retry_cancels(5)
    assert len(scene.asked) == 5
    scene.appear(SPIN)
    scene.retry_cancels(3)
    assert len(scene.asked) == 6
    assert scene.stop_store.actions == []


@pytest.mark.parametrize("refusal", [REFUSED, REFUSED_SILENTLY], ids=["refused", "silent"])
@pytest.mark.parametrize("end", [ACCEPTED, UNKNOWN, ENDED], ids=["accepted", "unknown", "ended"])
def test_orphaned_goal_is_active_until_its_action_answers_without_refusal(
    scene: Scene, refusal: bytes, end: bytes
) -> None:
    """It is cancelled, unknown, or has ended."""
    lose(scene.begin())
    scene.appear(SPIN, refusal)
    scene.retry_cancels(5)
    assert len(scene.asked) == 5
    assert scene.stop_store.actions == [SPIN]
    assert scene.guard.commands[-1][1] is True
    assert scene.active_goals.uncancelled_actions == [SPIN]
    scene.appear(SPIN, end)
    scene.retry_cancels(3)
    assert len(scene.asked) == 6
    assert scene.stop_store.actions == []
    assert scene.active_goals.uncancelled_actions == []


def test_late_goal_is_cancelled_every_second_until_it_ends(scene: Scene) -> None:
    """Only this goal; one that ends within a second is not late."""
    going, other = scene.begin(), scene.begin()
    for action, answer in ((SPIN, REFUSED_SILENTLY), ("/quick/spin", ACCEPTED)):
        scene.appear(action, answer)
    quick = scene.begin("/quick/spin")
    for goal in (going, quick):
        scene.active_goals.note_cancelled(goal)
    scene.retry_cancels()
    assert (scene.asked, scene.active_goals.uncancelled_actions) == ([], ["/quick/spin", SPIN])
    end(quick)
    assert scene.active_goals.uncancelled_actions == [SPIN]
    scene.retry_cancels(3)
    scene.appear(SPIN)
    scene.retry_cancels(2)
    assert scene.cancelled_ids == 5 * [going.id]
    end(going)
    scene.retry_cancels(3)
    assert len(scene.cancelled_ids) == 5
    assert scene.active_goals.uncancelled_actions == []
    assert scene.active_goals.active_actions == [SPIN]
    end(other)


def test_cancel_requests_for_late_goals_are_bounded_and_reach_every_goal(scene: Scene) -> None:
    goals = [scene.begin() for _ in range(2 * MAX_CANCELLING)]
    for goal in goals:
        scene.active_goals.note_cancelled(goal)
    scene.appear(SPIN, None)
    scene.retry_cancels(2)
    assert len(scene.cancelled_ids) == MAX_CANCELLING
    scene.retry_cancels(2)
    assert set(scene.cancelled_ids) == {goal.id for goal in goals}


def test_change_of_active_actions_is_reported_once(scene: Scene) -> None:
    changes: list[list[str]] = []
    scene.active_goals.on_changed = lambda: changes.append(scene.active_goals.active_actions)
    goals = [scene.begin(), scene.begin()]
    for goal in goals:
        end(goal)
    assert changes == [[SPIN], []]


def test_orphaned_goals_are_bounded_in_time_and_number(scene: Scene) -> None:
    for number in range(MAX_ORPHANED + 1):
        lose(scene.begin(f"/r{number % 40}/spin"))
    assert len(scene.stop_store.actions or ()) == 40
    scene.appear("/r0/spin")
    scene.retry_cancels()
    assert len(scene.asked) == 1  # of two, but the first was forgotten
    scene.retry_cancels(round(ORPHAN_SECONDS))
    assert scene.stop_store.actions == []


def pursue(scene: DaemonScene, *actions: str) -> tuple[RelayEnd, RelayEnd]:
    """Start goals of these actions; return control link and channel."""
    scene.platform.actions = set(actions)
    control = scene.register()
    control.send(link.ControlGrant(id=1, holder=DRIVER, user="ann", level="operator"))
    channel = scene.channel(control)
    for action in actions:
        channel.send(link.SendActionGoal(id=action, action=action, type="t", source=DRIVER, cdr=""))
    return control, channel


def answer_pings(scene: DaemonScene, control: RelayEnd, seconds: float) -> int:
    """Let time pass with a relay that answers pings; return their number."""
    pings = 0
    for _ in range(round(seconds * 50)):
        scene.clock.advance(0.02)
        for each in control.received():
            if isinstance(each, dict) and each["op"] == "ping":
                pings += 1
                control.send(link.Pong(t=each["t"], at=scene.now()))
    return pings


def test_motion_goals_are_cancelled_after_two_silent_seconds_of_the_relay() -> None:
    """The link counts as lost much later."""
    scene = DaemonScene(answers=False)
    control, channel = pursue(scene, "/spin", "/look")
    spin, retry_cancels = scene.platform.goals
    answer_pings(scene, control, 3)
    assert not spin.cancelled
    scene.run(LINK_UNPROVEN_AFTER / 1e9 - 0.3)
    assert not spin.cancelled
    scene.run(0.6)
    assert (spin.cancelled, retry_cancels.cancelled) == (True, False)
    assert channel.transport.connected and control.transport.connected


def test_link_is_pinged_often_while_a_goal_is_active() -> None:
    """Ten times a second."""
    scene = DaemonScene(answers=False)
    control, _ = pursue(scene, "/spin")
    assert 16 <= answer_pings(scene, control, 2) <= 21
    lose(scene.platform.goals[0])
    answer_pings(scene, control, 0.1)
    assert answer_pings(scene, control, 4) <= 2


def test_silence_before_a_goal_began_does_not_count(scene: Scene) -> None:
    scene.clock.advance(100)
    scene.active_goals.link_proven_at = lambda: 0
    goal = scene.begin()
    scene.clock.pump([NOTIFY_GUARD_EVERY] * round(LINK_UNPROVEN_AFTER / 1e9 / NOTIFY_GUARD_EVERY))
    assert not goal.cancelled
    scene.clock.pump([NOTIFY_GUARD_EVERY] * 2)
    assert goal.cancelled
    scene.clock.pump([NOTIFY_GUARD_EVERY] * 20)
    assert goal.cancel_requests == 1


def stop_daemon(scene: DaemonScene) -> MemoryGoalHandle:
    """Shut a daemon down while it has an active goal."""
    pursue(scene, "/spin")
    scene.daemon.stop().addCallback(scene.left.append)
    return scene.platform.goals[0]


def test_shutdown_waits_for_the_ends_of_goals() -> None:
    scene = DaemonScene()
    goal = stop_daemon(scene)
    assert goal.cancelled
    scene.run(0.5)
    assert scene.left == []
    end(goal)
    assert len(scene.left) == 1
    assert scene.stop_store.actions == []


def test_shutdown_stores_the_actions_of_goals_that_do_not_end() -> None:
    """It waits for a moment only."""
    scene = DaemonScene()
    goal = stop_daemon(scene)
    scene.run(GOALS_END_SECONDS)
    assert len(scene.left) == 1
    lose(goal)  # as the platform does when it is stopped
    assert scene.stop_store.actions == ["/spin"]
