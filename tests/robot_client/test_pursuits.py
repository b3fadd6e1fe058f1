"""Goals that move the robot, told to the guard and noted on the disk, in memory."""

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
    ADRIFT,
    BEAT,
    FAREWELL,
    KEPT,
    LOOKS,
    MAX_ACTIONS,
    MAX_ADRIFT,
    MAX_ASKING,
    UNPROVEN,
    ActiveGoals,
)
from robot_client.motion.goal_canceller import PATIENCE, GoalCanceller
from robot_client.motion.goal_status_reader import AFTER, STATUS
from robot_client.motion.guard_port import NoGuard
from robot_client.motion.guard_protocol import CANCEL, GOALS_WITHIN_MS, cancelling
from robot_client.motion.stop_store import MemoryStopStore
from robot_client.motion.typed_topic import TypedTopic
from robot_client.platforms.base import ABORTED, CANCELED, GoalOutcome, GraphView
from robot_client.platforms.memory import MemoryGoal, MemoryPlatform
from tests.robot_client.daemon_scene import DRIVER, Line
from tests.robot_client.daemon_scene import Scene as DaemonScene
from tests.robot_client.goal_statuses import published

SPIN = "/robot1/spin"
ACCEPTED = b"\0\1\0\0" + bytes(4) + b"\1" + bytes(3 + 24)
REFUSED = b"\0\1\0\0\1" + bytes(7)
REFUSED_SILENTLY = b"\0\1\0\0" + bytes(8)
"""As a server of rclpy says it: no error, and nothing that is being cancelled."""
UNKNOWN = b"\0\1\0\0\2" + bytes(7)
ENDED = b"\0\1\0\0\3" + bytes(7)


class Feed(NoGuard):
    """Remembers what the guard would hear."""

    def __init__(self) -> None:
        self.topics: set[TypedTopic] = set()
        self.commands: list[tuple[TypedTopic, bool, int]] = []

    def topic(self, on: TypedTopic) -> None:
        self.topics.add(on)

    def forget(self, on: TypedTopic) -> None:
        self.topics.discard(on)

    def command(self, on: TypedTopic, moving: bool, at: int) -> None:
        self.commands.append((on, moving, at))


class BrokenLatch(MemoryStopStore):
    def keep_goals(self, actions: list[str]) -> None:
        raise Unavailable("the disk is full")


class Scene:
    """
    :param left: what lies on the disk at the start
    """

    def __init__(self, left: Sequence[str] | None = (), latch: MemoryStopStore | None = None) -> None:
        self.clock = Clock()
        self.feed = Feed()
        self.latch = latch or MemoryStopStore()
        self.latch.noted = None if left is None else list(left)
        self.platform = MemoryPlatform(GraphView())
        self.asked: list[str] = []
        self.wished: list[bytes] = []
        """The ids of the goals to be cancelled."""
        policy = MotionPolicy(actions=["*/spin"])
        sweep = GoalCanceller(policy, self.platform, self.clock, lambda topic: False)
        self.pursuits = ActiveGoals(policy.actions, self.feed, sweep, self.latch, self.clock, self.now)

    def now(self) -> int:
        return round(self.clock.seconds() * 1e9)

    def begin(self, action: str = SPIN) -> MemoryGoal:
        goal = MemoryGoal(action, b"", None)
        self.pursuits.check(action)
        self.pursuits.add(action, goal)
        return goal

    def appear(self, action: str, answer: bytes | None = ACCEPTED) -> None:
        """An action is there that answers so, or not at all, to the wish to cancel all its goals."""

        def cancel(request: bytes) -> bytes | Deferred[bytes]:
            self.asked.append(action)
            self.wished.append(request[4:20])
            return Deferred() if answer is None else answer

        self.platform.services[action + CANCEL] = cancel
        actions = {**self.platform.view.actions, action: link.Service(types=["t"])}
        self.platform.view = GraphView(actions=actions)

    def vanish(self, action: str) -> None:
        actions = {name: each for name, each in self.platform.view.actions.items() if name != action}
        self.platform.view = GraphView(actions=actions)

    def look(self, times: int = 1) -> None:
        for _ in range(times):
            self.pursuits.look()
            self.clock.advance(1.0)


@pytest.fixture
def scene() -> Scene:
    return Scene()


def end(goal: MemoryGoal) -> None:
    goal.result.callback(GoalOutcome(CANCELED, None, "as you wish"))


def lose(goal: MemoryGoal) -> None:
    goal.result.callback(GoalOutcome(ABORTED, None, "its action vanished", certain=False))


def test_the_guard_hears_of_a_goal_as_long_as_it_goes_on(scene: Scene) -> None:
    """Often enough that it can tell a daemon that stands still, and no more when the goal has ended."""
    goal = scene.begin()
    for _ in range(20):
        scene.clock.advance(BEAT)
    times = [at for on, moving, at in scene.feed.commands if moving and on == cancelling(SPIN)]
    assert len(times) == 21
    assert 5 * BEAT * 1000 <= GOALS_WITHIN_MS
    end(goal)
    assert scene.feed.commands[-1] == (cancelling(SPIN), False, scene.now())
    told = len(scene.feed.commands)
    scene.clock.advance(KEPT - 1)
    assert len(scene.feed.commands) == told
    assert scene.feed.topics == {cancelling(SPIN)}
    scene.clock.advance(1)
    assert scene.feed.topics == set()
    assert scene.clock.getDelayedCalls() == []


def test_the_last_of_an_actions_goals_counts(scene: Scene) -> None:
    """One that ends leaves the guard and the note to the others, and what follows soon finds the guard ready."""
    first, second = scene.begin(), scene.begin()
    end(first)
    assert scene.feed.commands[-1][1]
    assert scene.latch.noted == [SPIN]
    end(second)
    assert scene.latch.noted == []
    scene.begin()
    scene.clock.advance(KEPT * 2)
    assert scene.feed.topics == {cancelling(SPIN)}


def test_who_waits_for_a_standstill_waits_for_the_last_goal(scene: Scene) -> None:
    """Or for as long as he likes; then he is told which actions go on."""
    told: list[tuple[str, list[str]]] = []

    def wait(name: str, seconds: float) -> None:
        scene.pursuits.standing(seconds).addCallback(lambda going: told.append((name, going)))

    wait("none", 1.0)
    first, second = scene.begin(), scene.begin("/left/spin")
    wait("impatient", 1.0)
    wait("patient", 3.0)
    end(first)
    scene.clock.advance(1.0)
    assert told == [("none", []), ("impatient", ["/left/spin"])]
    end(second)
    scene.clock.advance(9.0)
    assert told[2:] == [("patient", [])]


def test_actions_with_goals_are_noted(scene: Scene) -> None:
    """As long as one is under way, so that a daemon that starts knows what was left."""
    left, right = scene.begin("/left/spin"), scene.begin("/right/spin")
    assert scene.latch.noted == ["/left/spin", "/right/spin"]
    end(left)
    assert scene.latch.noted == ["/right/spin"]
    end(right)
    assert scene.latch.noted == []


def test_what_is_left_is_cancelled_once_as_it_appears() -> None:
    """Others are left alone; the note goes when it is done."""
    scene = Scene(["/late/spin", SPIN])
    scene.appear("/other/spin")
    scene.appear(SPIN)
    scene.look(3)
    assert scene.asked == [SPIN]
    assert scene.latch.noted == ["/late/spin"]
    scene.appear("/late/spin")
    scene.look(LOOKS)
    assert scene.asked == [SPIN, "/late/spin"]
    assert scene.latch.noted == []


def test_nothing_begins_before_what_is_left_is_cancelled() -> None:
    """A new goal would be cancelled with the old ones; other actions need not wait."""
    scene = Scene([SPIN])
    with pytest.raises(Unavailable, match="try again in a moment"):
        scene.begin()
    scene.begin("/other/spin")
    scene.appear(SPIN)
    scene.look()
    with pytest.raises(Unavailable, match="try again in a moment"):
        scene.begin()  # what it publishes of its goals may yet say that one goes on
    scene.look(2)
    scene.begin()
    scene.look(LOOKS)
    assert scene.asked == [SPIN]
    assert scene.latch.noted == ["/other/spin", SPIN]


def test_an_action_that_does_not_answer_is_asked_again() -> None:
    """Until it does."""
    scene = Scene([SPIN])
    scene.appear(SPIN, None)
    scene.look(2)
    assert scene.clock.seconds() >= 2 * PATIENCE
    assert scene.asked == [SPIN, SPIN]
    scene.appear(SPIN)
    scene.look(2)
    assert len(scene.asked) == 3


def test_an_action_that_refuses_to_end_what_is_left_is_asked_until_it_does() -> None:
    """However long: it is noted and nothing new begins there, while actions that never appear are given up."""
    scene = Scene([SPIN, "/late/spin"])
    scene.appear(SPIN, REFUSED)
    scene.look(3 * LOOKS)
    assert len(scene.asked) == 3 * LOOKS
    assert scene.latch.noted == [SPIN]
    assert scene.pursuits.overdue == [SPIN]
    with pytest.raises(Unavailable, match="try again in a moment"):
        scene.begin()
    scene.begin("/late/spin")
    scene.appear(SPIN)
    scene.look(3)
    assert len(scene.asked) == 3 * LOOKS + 1
    assert scene.latch.noted == ["/late/spin"]
    assert scene.pursuits.overdue == []
    scene.begin()


def test_what_is_left_goes_on_where_only_another_goal_of_its_action_is_cancelled() -> None:
    """The action says how many it cancels, and refuses the rest without a word: nothing begins beside that."""
    scene = Scene([SPIN])
    scene.appear(SPIN)
    scene.pursuits.look()
    scene.clock.advance(AFTER)
    scene.platform.emit(SPIN + STATUS, b"\0\1\0\0\1" + bytes(3 + 24) + b"\2")
    with pytest.raises(Unavailable, match="try again in a moment"):
        scene.begin()
    assert scene.pursuits.overdue == [SPIN]
    scene.look(3)
    assert scene.asked == [SPIN, SPIN]
    scene.begin()


def publish(scene: Scene, *goals: int) -> None:
    """An action that was just asked publishes that these goals go on."""
    scene.clock.advance(AFTER)
    told = published((bytes([goal]) * 16, GoalStatus.STATUS_EXECUTING) for goal in goals)
    scene.platform.emit(SPIN + STATUS, told)
    scene.clock.advance(1.0 - AFTER)


def test_goals_that_others_give_are_not_those_that_were_left() -> None:
    """A node may send its goal again as soon as one ends: it is cancelled once more at most, and holds up nobody."""
    scene = Scene([SPIN])
    scene.appear(SPIN)
    for goal in range(1, 6):
        scene.pursuits.look()
        publish(scene, goal)
    assert scene.asked == [SPIN, SPIN]
    assert scene.latch.noted == []
    assert scene.pursuits.overdue == []
    scene.begin()


def test_a_goal_that_was_left_is_cancelled_until_it_ends_among_those_of_others() -> None:
    """What has ended does not count again, nor what came later."""
    scene = Scene([SPIN])
    scene.appear(SPIN)
    for goals in ((1, 2), (3, 2, 4), (2,), (5, 2, 4)):
        scene.pursuits.look()
        publish(scene, *goals)
        assert scene.pursuits.overdue == [SPIN]
    scene.pursuits.look()
    publish(scene, 1, 5)
    assert scene.pursuits.overdue == []
    scene.look(3)
    assert len(scene.asked) == 5


def test_an_action_that_refused_and_is_gone_is_given_up() -> None:
    """After ten minutes in which it never came back; what is there is asked for ever."""
    scene = Scene([SPIN, "/left/spin"])
    for action in (SPIN, "/left/spin"):
        scene.appear(action, REFUSED)
    scene.look(2)
    scene.vanish(SPIN)
    scene.look(round(ADRIFT) - 1)
    scene.appear(SPIN, REFUSED)
    scene.look()
    scene.vanish(SPIN)
    scene.look(round(ADRIFT))
    assert scene.pursuits.overdue == ["/left/spin", SPIN]
    with pytest.raises(Unavailable):
        scene.begin()
    scene.look()
    assert scene.pursuits.overdue == ["/left/spin"]
    assert scene.latch.noted == ["/left/spin"]
    scene.begin()


def test_what_never_appears_is_given_up() -> None:
    """After half a minute, so that goals may begin there."""
    scene = Scene([SPIN])
    scene.look(LOOKS)
    scene.begin()
    scene.appear(SPIN)
    scene.look()
    assert scene.asked == []


def test_a_note_that_is_damaged_stands_for_every_action_that_moves() -> None:
    """Better too much is cancelled than something moves on."""
    scene = Scene(None)
    scene.appear(SPIN)
    scene.appear("/dock_is_free")
    scene.look(3)
    assert scene.asked == [SPIN]
    scene.begin()


def test_a_note_that_can_not_be_written_holds_up_nothing() -> None:
    """The guard is told all the same."""
    scene = Scene(latch=BrokenLatch())
    end(scene.begin())
    assert [moving for _, moving, _ in scene.feed.commands] == [True, False]


def test_there_is_room_for_so_many_actions() -> None:
    """One more is refused in words while all are busy, and takes the place of an idle one."""
    scene = Scene()
    goals = [scene.begin(f"/r{number}/spin") for number in range(MAX_ACTIONS)]
    with pytest.raises(Unavailable, match=str(MAX_ACTIONS)):
        scene.begin()
    scene.begin("/r3/spin")
    end(goals[0])
    scene.begin()
    assert len(scene.feed.topics) == MAX_ACTIONS
    assert cancelling("/r0/spin") not in scene.feed.topics


def test_goals_of_clients_are_followed_by_their_full_names() -> None:
    """Through the whole daemon, and only where they move the robot."""
    scene = DaemonScene()
    scene.platform.actions = {"/spin", "spin", "/look"}
    control = scene.register()
    control.say(link.Control(id=1, holder=DRIVER, user="ann", level="operator"))
    channel = scene.channel(control)
    for action in ("spin", "/look"):
        channel.say(link.SendActionGoal(id=action, action=action, type="t", source=DRIVER, cdr=""))
    assert len(scene.platform.goals) == 2
    assert scene.latch.noted == ["/spin"]
    channel.lose()
    assert scene.platform.goals[0].cancelled
    assert scene.latch.noted == ["/spin"]  # it has not ended yet
    end(scene.platform.goals[0])
    assert scene.latch.noted == []


def test_a_daemon_that_starts_looks_for_what_was_left() -> None:
    """By itself, every second, also where nobody is registered."""
    latch = MemoryStopStore()
    latch.noted = ["/spin"]
    scene = DaemonScene(latch)
    asked: list[bytes] = []

    def cancel(request: bytes) -> bytes:
        asked.append(request)
        return ACCEPTED

    scene.platform.services["/spin" + CANCEL] = cancel
    scene.platform.view = GraphView(actions={"/spin": link.Service(types=["t"])})
    scene.run(3.0)
    assert len(asked) == 1
    assert latch.noted == []


def test_a_goal_adrift_is_cancelled_when_its_action_is_seen_again(scene: Scene) -> None:
    """It alone, and once; guard and note have it until then."""
    lost, other = scene.begin(), scene.begin()
    lose(lost)
    end(other)
    scene.look(3)
    assert scene.asked == []
    assert scene.latch.noted == [SPIN]
    assert scene.feed.commands[-1][1] is True
    scene.appear(SPIN)
    scene.look(3)
    assert scene.wished == [lost.id]
    assert scene.latch.noted == []
    assert scene.feed.commands[-1][1] is False


def test_a_goal_adrift_holds_up_no_new_one(scene: Scene) -> None:
    """It does not make a change of control wait, and what begins meanwhile goes on."""
    lose(scene.begin())
    told: list[list[str]] = []
    scene.pursuits.standing(1.0).addCallback(told.append)
    assert told == [[SPIN]]
    scene.begin()
    scene.appear(SPIN)
    scene.look(2)
    assert len(scene.asked) == 1
    assert scene.latch.noted == [SPIN]
    assert scene.feed.commands[-1][1] is True


def test_an_action_that_does_not_answer_for_a_goal_adrift_is_asked_again(scene: Scene) -> None:
    """Every second, until it does."""
    lose(scene.begin())
    scene.appear(SPIN, None)
    scene.look(5)
    assert len(scene.asked) == 5
    scene.appear(SPIN)
    scene.look(3)
    assert len(scene.asked) == 6
    assert scene.latch.noted == []


@pytest.mark.parametrize("refusal", [REFUSED, REFUSED_SILENTLY], ids=["refused", "silent"])
@pytest.mark.parametrize("end", [ACCEPTED, UNKNOWN, ENDED], ids=["accepted", "unknown", "ended"])
def test_a_goal_adrift_goes_on_until_its_action_does_not_refuse(
    scene: Scene, refusal: bytes, end: bytes
) -> None:
    """Guard and note have it until then: it is cancelled, or unknown, or has ended."""
    lose(scene.begin())
    scene.appear(SPIN, refusal)
    scene.look(5)
    assert len(scene.asked) == 5
    assert scene.latch.noted == [SPIN]
    assert scene.feed.commands[-1][1] is True
    assert scene.pursuits.overdue == [SPIN]
    scene.appear(SPIN, end)
    scene.look(3)
    assert len(scene.asked) == 6
    assert scene.latch.noted == []
    assert scene.pursuits.overdue == []


def test_a_goal_that_is_to_end_is_asked_to_until_it_has(scene: Scene) -> None:
    """It alone, every second, also when its action says that it cancels it; one that ends within a second is not."""
    going, other = scene.begin(), scene.begin()
    for action, answer in ((SPIN, REFUSED_SILENTLY), ("/quick/spin", ACCEPTED)):
        scene.appear(action, answer)
    quick = scene.begin("/quick/spin")
    for goal in (going, quick):
        scene.pursuits.end(goal)
    scene.look()
    assert (scene.asked, scene.pursuits.overdue) == ([], ["/quick/spin", SPIN])
    end(quick)
    assert scene.pursuits.overdue == [SPIN]
    scene.look(3)
    scene.appear(SPIN)
    scene.look(2)
    assert scene.wished == 5 * [going.id]
    end(going)
    scene.look(3)
    assert len(scene.wished) == 5
    assert scene.pursuits.overdue == []
    assert scene.pursuits.pursued == [SPIN]
    end(other)


def test_goals_that_are_to_end_are_asked_in_turn(scene: Scene) -> None:
    """So many at a time, though they never answer, and each in the end."""
    goals = [scene.begin() for _ in range(2 * MAX_ASKING)]
    for goal in goals:
        scene.pursuits.end(goal)
    scene.appear(SPIN, None)
    scene.look(2)
    assert len(scene.wished) == MAX_ASKING
    scene.look(2)
    assert set(scene.wished) == {goal.id for goal in goals}


def test_it_is_told_when_actions_begin_and_cease_to_pursue_goals(scene: Scene) -> None:
    """Once each, however many goals."""
    told: list[list[str]] = []
    scene.pursuits.on_changed = lambda: told.append(scene.pursuits.pursued)
    goals = [scene.begin(), scene.begin()]
    for goal in goals:
        end(goal)
    assert told == [[SPIN], []]


def test_goals_adrift_are_forgotten_in_time_and_number(scene: Scene) -> None:
    """The oldest for one too many, the others after ten minutes."""
    for number in range(MAX_ADRIFT + 1):
        lose(scene.begin(f"/r{number % 40}/spin"))
    assert len(scene.latch.noted or ()) == 40
    scene.appear("/r0/spin")
    scene.look()
    assert len(scene.asked) == 1  # of two, but the first was forgotten
    scene.look(round(ADRIFT))
    assert scene.latch.noted == []


def pursue(scene: DaemonScene, *actions: str) -> tuple[Line, Line]:
    """Have actions pursue goals; the control link and the channel."""
    scene.platform.actions = set(actions)
    control = scene.register()
    control.say(link.Control(id=1, holder=DRIVER, user="ann", level="operator"))
    channel = scene.channel(control)
    for action in actions:
        channel.say(link.SendActionGoal(id=action, action=action, type="t", source=DRIVER, cdr=""))
    return control, channel


def answer_pings(scene: DaemonScene, control: Line, seconds: float) -> int:
    """Let time pass with a relay that answers; how many pings came."""
    pings = 0
    for _ in range(round(seconds * 50)):
        scene.clock.advance(0.02)
        for each in control.heard():
            if isinstance(each, dict) and each["op"] == "ping":
                pings += 1
                control.say(link.Pong(t=each["t"], at=scene.now()))
    return pings


def test_goals_are_cancelled_when_the_relay_is_silent() -> None:
    """After two seconds, long before the link counts as lost; those that move nothing go on."""
    scene = DaemonScene(answers=False)
    control, channel = pursue(scene, "/spin", "/look")
    spin, look = scene.platform.goals
    answer_pings(scene, control, 3)
    assert not spin.cancelled
    scene.run(UNPROVEN / 1e9 - 0.3)
    assert not spin.cancelled
    scene.run(0.6)
    assert (spin.cancelled, look.cancelled) == (True, False)
    assert channel.transport.connected and control.transport.connected


def test_link_is_proven_as_long_as_a_goal_is_under_way() -> None:
    """Ten pings a second, and as agreed again when it has ended, or is adrift."""
    scene = DaemonScene(answers=False)
    control, _ = pursue(scene, "/spin")
    assert 16 <= answer_pings(scene, control, 2) <= 21
    lose(scene.platform.goals[0])
    answer_pings(scene, control, 0.1)
    assert answer_pings(scene, control, 4) <= 2


def test_a_goal_that_has_just_begun_has_its_two_seconds(scene: Scene) -> None:
    """Before it began nobody may have asked for proof; then it is cancelled once."""
    scene.clock.advance(100)
    scene.pursuits.proof = lambda: 0
    goal = scene.begin()
    scene.clock.pump([BEAT] * round(UNPROVEN / 1e9 / BEAT))
    assert not goal.cancelled
    scene.clock.pump([BEAT] * 2)
    assert goal.cancelled
    scene.clock.pump([BEAT] * 20)
    assert goal.cancels == 1


def leave(scene: DaemonScene) -> MemoryGoal:
    """End a daemon in order while it has a goal pursued."""
    pursue(scene, "/spin")
    scene.daemon.stop().addCallback(scene.left.append)
    return scene.platform.goals[0]


def test_a_daemon_that_leaves_waits_for_the_ends_of_goals() -> None:
    """It is told of the last, and leaves no note."""
    scene = DaemonScene()
    goal = leave(scene)
    assert goal.cancelled
    scene.run(0.5)
    assert scene.left == []
    end(goal)
    assert len(scene.left) == 1
    assert scene.latch.noted == []


def test_a_daemon_that_leaves_notes_what_does_not_end() -> None:
    """It waits for a moment only; the next daemon finds the note."""
    scene = DaemonScene()
    goal = leave(scene)
    scene.run(FAREWELL)
    assert len(scene.left) == 1
    lose(goal)  # as the platform does when it is stopped
    assert scene.latch.noted == ["/spin"]
