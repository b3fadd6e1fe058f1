"""The relay's orders about motion, on a whole daemon in memory."""

from __future__ import annotations

from typing import Any

import pytest
from twisted.internet.defer import Deferred

from relay_protocol import frames, link
from relay_protocol.errors import Unavailable
from robot_client.config import LimitSettings, RobotSettings, SafetySettings, Speeds
from robot_client.motion.goal_canceller import HEARD_WITHIN, MAX_ACTIONS, MAX_NAMES, GoalCanceller
from robot_client.motion.goal_status_reader import AFTER, STATUS
from robot_client.motion.guard_protocol import CANCEL
from robot_client.motion.hardware import LOOKS, PATIENCE, RARELY, Hardware, Switches
from robot_client.motion.motion import MotionControl
from robot_client.motion.orders import KEEP_EVERY, UNFORESEEN
from robot_client.motion.state_reporter import TELL_EVERY
from robot_client.motion.stop_store import MemoryStopStore, StopRecorder
from robot_client.motion.zero_publisher import ZeroPublisher
from robot_client.platforms.base import CANCELED, GoalOutcome, GraphView
from robot_client.platforms.memory import TWIST, twist
from tests.robot_client.breaking import broken
from tests.robot_client.daemon_scene import DRIVER, Line, Scene

GO, ZERO = twist(1.0), twist()
OTHER = 8
JOY = "sensor_msgs/msg/Joy"
NAVIGATE = "/navigate_to_pose"
ALL_GOALS = b"\0\1\0\0" + bytes(24)
NOTHING_LEFT = b"\0\1\0\0" + bytes(8)
"""An action's answer where it has no goals."""


def said(line: Line, op: str) -> list[Any]:
    return [each for each in line.heard() if isinstance(each, dict) and each["op"] == op]


def order(line: Line, message: link.Message) -> dict[str, Any]:
    """Give one order; its answer."""
    line.heard()
    line.say(message)
    (done,) = said(line, "done")
    return dict(done)


@pytest.fixture
def scene() -> Scene:
    return Scene()


@pytest.fixture
def control(scene: Scene) -> Line:
    return scene.register()


def stop(id: int = 2) -> link.Stop:
    return link.Stop(id=id, by="eve", why="test")


def resume(id: int = 3) -> link.Resume:
    return link.Resume(id=id, by="ann")


# --- control -----------------------------------------------------------------------------------------------


def test_at_first_nobody_moves_the_robot(scene: Scene, control: Line) -> None:
    """Before control was given a command goes nowhere and is counted."""
    line = scene.channel(control)
    line.say(link.Advertise(number=5, topic="/cmd_vel", type=TWIST))
    scene.command(line, GO)
    assert scene.platform.published == []
    assert scene.daemon._health().refused_commands == 1


def test_commands_that_make_no_sense_are_told_in_the_health(scene: Scene, control: Line) -> None:
    """Counted beside those that are dropped for other reasons, goals among them."""
    line = scene.driving(control)
    line.say(link.Advertise(number=6, topic="/goal_pose", type="geometry_msgs/msg/PoseStamped"))
    control.heard()
    for number in (5, 6):
        line.protocol.dataReceived(frames.encode_command(number, scene.now(), DRIVER, twist(float("nan"))))
    scene.daemon._tell_health()
    (health,) = said(control, "health")
    assert health["invalid_commands"] == 2
    assert health.get("refused_commands", 0) == 0


def test_control_for_another_stops_what_moved_before_it_is_done(scene: Scene, control: Line) -> None:
    """Zero goes out first, goals that move the robot are cancelled, and the former one is not obeyed any more."""
    scene.platform.actions = {NAVIGATE, "/dock_is_free"}
    line = scene.driving(control)
    for id, action in (("g", NAVIGATE), ("h", "/dock_is_free")):
        line.say(link.SendActionGoal(id=id, action=action, type="a/action/B", source=DRIVER, cdr=""))
    control.heard()
    control.say(link.Control(id=9, holder=OTHER, user="ben"))
    assert scene.platform.published[-1] == ("/cmd_vel", ZERO)
    assert [goal.cancelled for goal in scene.platform.goals] == [True, False]
    assert said(control, "done") == []
    scene.platform.goals[0].result.callback(GoalOutcome(CANCELED, None))
    assert said(control, "done") == [{"op": "done", "id": 9}]
    scene.command(line, twist(0.7))
    assert ("/cmd_vel", twist(0.7)) not in scene.platform.published
    scene.command(line, twist(0.3), OTHER)
    assert scene.platform.published[-1] == ("/cmd_vel", twist(0.3))


def test_goal_that_does_not_end_holds_up_a_change_of_control_for_a_second(
    scene: Scene, control: Line
) -> None:
    """Then the next one has it all the same, also where the channel is gone that the goal came by; the holder's own
    goals hold up nothing that is said of him.
    """
    scene.platform.actions = {NAVIGATE}
    line = scene.driving(control)
    line.say(link.SendActionGoal(id="g", action=NAVIGATE, type="a/action/B", source=DRIVER, cdr=""))
    assert order(control, link.Control(id=8, holder=DRIVER, user="ann", level="owner"))["id"] == 8
    for id in (9, 10):
        control.say(link.Control(id=id, holder=id))
        scene.clock.advance(0.999)
        assert said(control, "done") == []
        scene.clock.advance(0.001)
        assert said(control, "done") == [{"op": "done", "id": id}]
    control.say(link.Control(id=11))
    line.lose()
    assert said(control, "done") == []
    scene.platform.goals[0].result.callback(GoalOutcome(CANCELED, None))
    assert said(control, "done") == [{"op": "done", "id": 11}]


def lasting(line: Line) -> dict[str, bool]:
    """What was told about goals that outlast control, and whether it was that none does."""
    return {
        each["about"]: each.get("over", False) for each in said(line, "alert") if each["kind"] == "control"
    }


def test_goal_that_outlasts_its_drivers_control_is_told_and_cancelled_again_until_it_ends(
    acting: Acting,
) -> None:
    """An action may refuse to cancel it; the next one's goals there go on."""
    acting.scene.platform.actions = {NAVIGATE}
    line = acting.scene.driving(acting.control)
    line.say(link.SendActionGoal(id="g", action=NAVIGATE, type="a/action/B", source=DRIVER, cdr=""))
    (former,) = acting.scene.platform.goals
    acting.control.heard()
    acting.control.say(link.Control(id=9, holder=OTHER))
    acting.pass_seconds(1)
    heard = [each for each in acting.control.heard() if isinstance(each, dict)]
    (alert,) = [each for each in heard if each["op"] == "alert"]
    assert (alert["level"], NAVIGATE in alert["text"]) == ("error", True)
    assert [each["id"] for each in heard if each["op"] == "done"] == [9]
    line.say(link.SendActionGoal(id="n", action=NAVIGATE, type="a/action/B", source=OTHER, cdr=""))
    for _ in range(5):
        acting.answer()  # no error, and nothing that is being cancelled
        acting.pass_seconds(1, line)
    assert 5 <= len(acting.asked) <= 6
    assert set(acting.asked) == {b"\0\1\0\0" + former.id + bytes(8)}
    assert lasting(acting.control) == {}
    former.result.callback(GoalOutcome(CANCELED, None))
    acting.pass_seconds(3, line)
    assert lasting(acting.control) == {"goals": True}
    assert len(acting.asked) <= 6
    assert not acting.scene.platform.goals[1].cancelled


def test_goal_that_outlasts_the_control_link_is_told_when_it_is_back(acting: Acting) -> None:
    """Control is lost by that as well, and nobody may drive on."""
    acting.scene.platform.actions = {NAVIGATE}
    line = acting.scene.driving(acting.control)
    line.say(link.SendActionGoal(id="g", action=NAVIGATE, type="a/action/B", source=DRIVER, cdr=""))
    acting.control.lose()
    acting.scene.run(3)
    control = acting.scene.register()
    assert lasting(control) == {"goals": False}


def test_goal_of_a_driver_who_keeps_control_is_nobodys_concern(acting: Acting) -> None:
    """It goes on, and what he has cancelled himself may take its time."""
    acting.scene.platform.actions = {NAVIGATE}
    line = acting.scene.driving(acting.control)
    line.say(link.SendActionGoal(id="g", action=NAVIGATE, type="a/action/B", source=DRIVER, cdr=""))
    line.say(link.CancelActionGoal(id="g"))
    acting.pass_seconds(10, line)
    assert (acting.asked, lasting(acting.control)) == ([], {})


def test_control_for_the_holder_disturbs_nothing(scene: Scene, control: Line) -> None:
    """Who has it goes on moving; only his level changes."""
    scene.driving(control)
    assert order(control, link.Control(id=9, holder=DRIVER, user="ann", level="owner"))["id"] == 9
    assert scene.platform.published == [("/cmd_vel", GO)]
    assert scene.daemon.authority.level == "owner"


def test_robot_that_can_not_be_stopped_is_not_given_to_another(
    scene: Scene, control: Line, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The answer says why, and nobody holds control then."""
    scene.driving(control)
    monkeypatch.setattr(scene.platform.sinks[0], "publish", broken)
    done = order(control, link.Control(id=9, holder=OTHER))
    assert done["ok"] is False
    assert "/cmd_vel" in done["reason"]
    assert scene.daemon.authority.holder == 0


def test_control_is_lost_with_the_link(scene: Scene, control: Line) -> None:
    """A robot that comes back is held by nobody."""
    scene.driving(control)
    control.lose()
    scene.run(1)
    (told,) = said(scene.register(), "safety")
    assert "holder" not in told


# --- stop --------------------------------------------------------------------------------------------------


def test_stop_is_zero_and_no_more_commands(scene: Scene, control: Line) -> None:
    """Zero is said before the answer, all goals are cancelled, and further commands and goals are refused."""
    scene.platform.actions = {NAVIGATE, "/count"}
    scene.platform.services["/arm/move"] = lambda request: request
    line = scene.driving(control)
    line.say(link.SendActionGoal(id="g", action="/count", type="a/action/B", source=DRIVER, cdr=""))
    assert order(control, stop()) == {"op": "done", "id": 2}
    assert scene.platform.published[-1] == ("/cmd_vel", ZERO)
    assert scene.platform.goals[0].cancelled
    scene.command(line, GO)
    line.heard()
    line.say(link.SendActionGoal(id="n", action=NAVIGATE, type="a/action/B", source=DRIVER, cdr=""))
    (refused,) = said(line, "action_result")
    assert "stopped until somebody resumes" in refused["reason"]
    scene.run(1)
    assert {body for _, body in scene.platform.published[1:]} == {ZERO}


def test_stop_says_zero_also_on_what_seems_to_stand(scene: Scene, control: Line) -> None:
    """Something else on the robot may move it: zero goes to every topic that clients may command."""
    line = scene.channel(control)
    line.say(link.Advertise(number=5, topic="/cmd_vel", type=TWIST))
    order(control, stop())
    scene.run(0.5)
    assert scene.platform.published == 5 * [("/cmd_vel", ZERO)]


def test_stop_lasts_through_a_restart(scene: Scene, control: Line) -> None:
    """A daemon that starts with a kept stop is stopped, says so at once, and obeys nobody."""
    scene.driving(control)
    order(control, stop())
    again = Scene(scene.latch)
    control = again.register()
    (told,) = said(control, "safety")
    assert (told["stopped"]["by"], told["stopped"]["why"]) == ("eve", "test")
    control.say(link.Control(id=1, holder=DRIVER))
    line = again.channel(control)
    line.say(link.Advertise(number=5, topic="/cmd_vel", type=TWIST))
    again.command(line, GO)
    again.run(1)
    assert again.platform.published == []


def test_resume_moves_nothing_by_itself(scene: Scene, control: Line) -> None:
    """A stream that went on through the stop is not obeyed after it; after a pause it is."""
    line = scene.driving(control)
    order(control, stop())
    for _ in range(10):
        scene.clock.advance(0.05)
        scene.command(line, GO)
    assert order(control, resume()) == {"op": "done", "id": 3}
    assert scene.latch.stopped is None
    for _ in range(10):
        scene.clock.advance(0.05)
        scene.command(line, GO)
    assert scene.platform.published.count(("/cmd_vel", GO)) == 1
    scene.clock.advance(0.51)
    scene.command(line, GO)
    assert scene.platform.published[-1] == ("/cmd_vel", GO)


def test_a_stop_is_told_with_the_time_at_which_it_was_ordered(scene: Scene, control: Line) -> None:
    """By the relay's clock, so that nobody takes its confirmation for another stop."""
    assert order(control, link.Stop(id=2, by="eve", at=1700.25)) == {"op": "done", "id": 2}
    assert scene.daemon.authority.stopped == link.Stopped(by="eve", since=1700.25)
    assert scene.latch.stopped == link.Stopped(by="eve", since=1700.25)


def test_second_stop_and_needless_resume_are_done(scene: Scene, control: Line) -> None:
    """Whoever stops a stopped robot, or resumes one that is not, is told that it is so."""
    assert order(control, resume())["id"] == 3
    order(control, stop())
    assert order(control, link.Stop(id=4, by="ben")) == {"op": "done", "id": 4}
    assert scene.daemon.authority.stopped is not None
    assert scene.daemon.authority.stopped.by == "eve"


class FullDisk(MemoryStopStore):
    """Keeps nothing, clears nothing."""

    def keep(self, stopped: link.Stopped) -> None:
        raise Unavailable("the disk is full")

    def clear(self) -> None:
        raise Unavailable("the disk is read-only")


def test_stop_that_can_not_be_kept_is_told_and_holds() -> None:
    """The robot is stopped all the same, a person is told, and it is resumed only when the record is gone."""
    scene = Scene(FullDisk())
    control = scene.register()
    scene.driving(control)
    control.heard()
    control.say(stop())
    heard = [each for each in control.heard() if isinstance(each, dict)]
    (done,) = [each for each in heard if each["op"] == "done"]
    assert (done["ok"], done["reason"]) == (False, "the disk is full")
    assert any("disk is full" in each["text"] for each in heard if each["op"] == "alert")
    assert scene.platform.published[-1] == ("/cmd_vel", ZERO)
    assert order(control, resume())["reason"] == "the disk is read-only; the disk is full"
    assert scene.daemon.authority.stopped is not None


class CountingLatch(MemoryStopStore):
    """Fails as often as it is told to."""

    def __init__(self, fails: int = 0) -> None:
        super().__init__()
        self.fails = fails
        self.kept = 0

    def keep(self, stopped: link.Stopped) -> None:
        self.kept += 1
        if self.kept <= self.fails:
            raise Unavailable("the disk is full")
        super().keep(stopped)


class Broken(MemoryStopStore):
    """Fails as nobody foresaw."""

    def keep(self, stopped: link.Stopped) -> None:
        raise RuntimeError("secret internals")


def test_stop_whose_record_fails_unforeseen_is_answered_and_can_be_resumed() -> None:
    """It is in effect; what went wrong is said in words, and its details stay in the log."""
    scene = Scene(Broken())
    control = scene.register()
    scene.driving(control)
    done = order(control, stop())
    assert (done["ok"], "can't be kept" in done["reason"], "secret" in done["reason"]) == (False, True, False)
    assert scene.platform.published[-1] == ("/cmd_vel", ZERO)
    assert scene.daemon.authority.stopped is not None
    assert order(control, resume()) == {"op": "done", "id": 3}
    assert scene.daemon.authority.stopped is None


@pytest.mark.parametrize(
    ("owner", "part"),
    [
        (MotionControl, "halt"),
        (Hardware, "stop"),
        (GoalCanceller, "stop"),
        (ZeroPublisher, "say"),
        (StopRecorder, "keep"),
    ],
)
def test_part_of_a_stop_that_fails_unforeseen_keeps_no_other_from_being_done(
    monkeypatch: pytest.MonkeyPatch, owner: type, part: str
) -> None:
    """The answer says that one has failed; the robot is stopped, and can be resumed."""
    switched = Switched()
    with monkeypatch.context() as broken_for_now:
        broken_for_now.setattr(owner, part, broken)
        switched.control.say(stop())
        for _ in switched.answers:
            switched.answer(True)
    (done,) = switched.done()
    assert (done["ok"], done["reason"]) == (False, UNFORESEEN)
    assert switched.scene.daemon.authority.stopped is not None
    assert (len(switched.asked) == 1) is (owner is not Hardware)
    assert (switched.scene.latch.stopped is not None) is (owner is not StopRecorder)
    switched.control.say(resume())
    switched.answer(True)
    assert switched.done() == [{"op": "done", "id": 3}]


@pytest.mark.parametrize(
    ("owner", "part"), [(Hardware, "resume"), (MemoryStopStore, "clear"), (GoalCanceller, "end")]
)
def test_resume_that_fails_unforeseen_is_taken_back(
    monkeypatch: pytest.MonkeyPatch, owner: type, part: str
) -> None:
    """The robot stays stopped, switch and record as well, the answer says so, and the next one resumes it."""
    switched = Switched()
    switched.control.say(stop())
    switched.answer(True)
    switched.control.heard()
    with monkeypatch.context() as broken_for_now:
        broken_for_now.setattr(owner, part, broken)
        switched.control.say(resume())
        while switched.answers:
            switched.answer(True)
    (done,) = switched.done()
    assert (done["ok"], "log says why" in done["reason"], "secret" in done["reason"]) == (False, True, False)
    assert switched.asked[-1] == b"\0\1\0\0\1"
    assert switched.scene.latch.stopped is not None
    switched.control.say(resume(4))
    switched.answer(True)
    assert switched.done() == [{"op": "done", "id": 4}]


@pytest.mark.parametrize("fails", [0, 2])
def test_stop_is_kept_once_and_again_only_when_that_failed(fails: int) -> None:
    """A robot that is told to stop again and again does not write each time."""
    latch = CountingLatch(fails)
    control = Scene(latch).register()
    good = [order(control, stop(id)).get("ok", True) for id in range(2, 12)]
    assert good == [False] * fails + [True] * (10 - fails)
    assert latch.kept == fails + 1
    order(control, resume())
    order(control, stop())
    assert latch.kept == fails + 2


def test_stop_that_could_not_be_kept_is_kept_later() -> None:
    """While the robot is stopped it is tried now and then; a person hears when it could not be, and when it is."""
    latch = CountingLatch(2)
    scene = Scene(latch)
    control = scene.register()
    assert order(control, stop())["ok"] is False
    texts: list[tuple[str, bool]] = []
    for _ in range(3 * KEEP_EVERY):
        control.say(link.Ping(t=1))
        scene.clock.advance(1)
        texts += [(each["text"], each.get("over", False)) for each in said(control, "alert")]
    assert latch.kept == 3
    assert latch.stopped is not None
    assert [over for _, over in texts] == [True]


def test_resume_ends_what_could_not_be_kept() -> None:
    """Nobody is told any more that a stop is not on the disk, and none comes there."""
    latch = CountingLatch(99)
    scene = Scene(latch)
    control = scene.register()
    order(control, stop())
    control.say(resume())
    assert [each["over"] for each in said(control, "alert")] == [True]
    kept = latch.kept
    scene.run(3 * KEEP_EVERY)
    assert latch.kept == kept


def test_hardware_is_stopped_before_the_disk_is_written(monkeypatch: pytest.MonkeyPatch) -> None:
    """A slow disk does not delay the switch, nor the zero before it."""
    switched = Switched()
    found: list[object] = []

    def keep(stopped: link.Stopped) -> None:
        found.extend([switched.scene.platform.published[-1], len(switched.asked)])

    monkeypatch.setattr(switched.scene.latch, "keep", keep)
    switched.control.say(stop())
    assert found == [("/cmd_vel", ZERO), 1]


# --- the switch in the hardware ----------------------------------------------------------------------------


class Switched:
    """A daemon with a service that stops its hardware; :attr:`answers` are those of its calls that are to come."""

    def __init__(self, type: str = "std_srvs/srv/SetBool", stopped: link.Stopped | None = None) -> None:
        self.scene = Scene(MemoryStopStore(stopped), Switches("/estop"))
        self.scene.platform.view = GraphView(services={"/estop": link.Service(types=[type])})
        self.scene.platform.services["/estop"] = self._called
        self.asked: list[bytes] = []
        self.answers: list[Deferred[bytes]] = []
        self.control = self.scene.register()
        if stopped is None:
            self.scene.driving(self.control)
        self.control.heard()

    def _called(self, request: bytes) -> Deferred[bytes]:
        self.asked.append(request)
        self.answers.append(Deferred())
        return self.answers[-1]

    def answer(self, good: bool, words: str = "") -> None:
        text = words.encode() + b"\0"
        body = b"\0\1\0\0" + bytes([good]) + b"\0\0\0" + len(text).to_bytes(4, "little") + text
        self.answers.pop(0).callback(body)

    def done(self) -> list[dict[str, Any]]:
        return said(self.control, "done")

    def pass_seconds(self, seconds: int, good: bool | None = None) -> list[tuple[str, bool]]:
        """Let time pass; with what was told a person, and whether it was that something is over.

        :param good: what the service says at once; ``None``: nothing
        """
        told: list[tuple[str, bool]] = []
        for _ in range(seconds):
            self.control.say(link.Ping(t=1))
            self.scene.clock.advance(1)
            while self.answers and good is not None:
                if self.answers[0].called:
                    self.answers.pop(0)
                else:
                    self.answer(good)
            told += [(each["text"], each.get("over", False)) for each in said(self.control, "alert")]
        return told


def test_stop_waits_for_the_hardware_with_its_answer_only() -> None:
    """Zero goes out first; the answer comes when the service has said yes."""
    switched = Switched()
    switched.control.say(stop())
    assert switched.scene.platform.published[-1] == ("/cmd_vel", ZERO)
    assert switched.asked == [b"\0\1\0\0\1"]
    assert switched.done() == []
    switched.answer(True)
    assert switched.done() == [{"op": "done", "id": 2}]
    switched.control.say(resume())
    assert switched.asked[1:] == [b"\0\1\0\0\0"]
    switched.answer(True)
    assert switched.done() == [{"op": "done", "id": 3}]
    assert switched.scene.daemon.authority.stopped is None


def test_trigger_is_for_the_stop_alone() -> None:
    """A service of type Trigger is called when the robot is stopped, not when it is resumed."""
    switched = Switched("std_srvs/srv/Trigger")
    switched.control.say(stop())
    switched.answer(True)
    switched.control.say(resume())
    assert [each["id"] for each in switched.done()] == [2, 3]
    assert switched.asked == [b"\0\1\0\0\0"]


def test_hardware_that_fails_is_told_and_the_robot_stays_stopped() -> None:
    """The answer and an alert have its words; what fails at the resume leaves the robot stopped."""
    switched = Switched()
    switched.control.say(stop())
    switched.answer(False, "fuse \x1b blown")
    heard = [each for each in switched.control.heard() if isinstance(each, dict)]
    (done,) = [each for each in heard if each["op"] == "done"]
    assert done["ok"] is False
    assert r"fuse \x1b blown" in done["reason"]
    assert any("fuse" in each["text"] for each in heard if each["op"] == "alert")
    switched.control.say(resume())
    switched.answer(False)
    switched.answer(True)
    assert switched.done()[0]["ok"] is False
    assert switched.scene.daemon.authority.stopped is not None


def test_hardware_that_a_failed_resume_let_go_is_stopped_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """And the stop is kept again, before anybody is told that the robot stays stopped; a stop meanwhile is done."""
    switched = Switched()
    switched.control.say(stop())
    switched.answer(True)

    def half_gone() -> None:
        switched.scene.latch.stopped = None
        raise Unavailable("the disk is read-only")

    monkeypatch.setattr(switched.scene.latch, "clear", half_gone)
    switched.control.heard()
    switched.control.say(resume())
    switched.answer(True)
    assert switched.asked == [b"\0\1\0\0\1", b"\0\1\0\0\0", b"\0\1\0\0\1"]
    switched.control.say(stop(4), resume(5))
    assert [(each["id"], each["ok"]) for each in switched.done()] == [(5, False)]
    switched.answer(True)
    (first, second) = switched.done()
    assert (first["id"], first["ok"], first["reason"]) == (3, False, "the disk is read-only")
    assert second == {"op": "done", "id": 4}
    assert switched.scene.latch.stopped is not None
    assert switched.scene.daemon.authority.stopped is not None


def test_switch_that_fails_at_a_resume_is_thrown_again() -> None:
    """It may have let go in part; what goes wrong with that is told too."""
    switched = Switched()
    switched.control.say(stop())
    switched.answer(True)
    switched.control.heard()
    switched.control.say(resume())
    switched.answer(False, "stuck")
    assert switched.done() == []
    assert switched.asked[-1] == b"\0\1\0\0\1"
    switched.answer(False, "fuse blown")
    (done,) = switched.done()
    assert ("stuck" in done["reason"], "fuse blown" in done["reason"]) == (True, True)


def test_hardware_that_is_silent_is_given_up() -> None:
    """After five seconds the answer says so; all who stopped the robot meanwhile get it."""
    switched = Switched()
    switched.control.say(stop(), stop(5))
    assert len(switched.asked) == 1
    for _ in range(round(PATIENCE) + 1):
        switched.control.say(link.Ping(t=1))
        switched.scene.clock.advance(1)
    done = switched.done()
    assert [(each["id"], each["ok"]) for each in done] == [(2, False), (5, False)]
    assert "did not answer" in done[0]["reason"]


@pytest.mark.parametrize(("types", "words"), [([], "no service"), (["a/srv/B"], "neither")])
def test_hardware_that_is_not_there_is_told(types: list[str], words: str) -> None:
    """A service that does not exist, or is of another type, fails at once in words."""
    switched = Switched()
    services = {"/estop": link.Service(types=types)} if types else {}
    switched.scene.platform.view = GraphView(services=services)
    switched.control.say(stop())
    (done,) = switched.done()
    assert (done["ok"], words in done["reason"]) == (False, True)


def test_stop_during_a_resume_wins() -> None:
    """A resume whose hardware answers after somebody stopped the robot again is not carried out."""
    switched = Switched()
    switched.control.say(stop())
    switched.answer(True)
    switched.control.say(resume())
    switched.control.say(stop(4))
    switched.answer(True)
    switched.answer(True)
    assert [(each["id"], each.get("ok", True)) for each in switched.done()] == [(2, True), (3, False)]
    switched.answer(True)
    assert [(each["id"], each.get("ok", True)) for each in switched.done()] == [(4, True)]
    assert switched.scene.daemon.authority.stopped is not None
    assert switched.asked[-1] == b"\0\1\0\0\1"


def test_hardware_that_fails_is_thrown_again_until_it_does_not() -> None:
    """Each second for half a minute, then now and then; a person hears once that it failed, and when it is well."""
    switched = Switched()
    switched.control.say(stop())
    switched.answer(False, "fuse blown")
    ((text, over),) = [(each["text"], each.get("over")) for each in said(switched.control, "alert")]
    assert ("fuse blown" in text, over) == (True, None)
    switched.pass_seconds(LOOKS, good=False)
    assert len(switched.asked) == 1 + LOOKS
    switched.pass_seconds(10 * RARELY, good=False)
    assert len(switched.asked) == 1 + LOOKS + 10
    told = switched.pass_seconds(RARELY, good=True)
    assert told == [("the switch in the hardware is thrown", True)]
    asked = len(switched.asked)
    assert switched.pass_seconds(100) == []
    assert len(switched.asked) == asked
    assert set(switched.asked) == {b"\0\1\0\0\1"}


def test_hardware_that_was_found_is_called_though_it_is_not_seen_now() -> None:
    """What calls it is kept from the start on, and a graph that is told late loses nobody the switch."""
    switched = Switched()
    switched.pass_seconds(2)
    assert switched.scene.platform.prepared == [("/estop", "std_srvs/srv/SetBool")]
    switched.scene.platform.view = GraphView()
    switched.control.say(stop())
    assert switched.asked == [b"\0\1\0\0\1"]


def test_resume_waits_for_hardware_that_is_thrown_again() -> None:
    """Else the one could undo the other; a stop meanwhile is never let go."""
    switched = Switched()
    switched.control.say(stop())
    switched.answer(False)
    switched.pass_seconds(1)
    switched.control.say(resume())
    assert switched.asked == 2 * [b"\0\1\0\0\1"]
    switched.answer(True)
    assert switched.asked[2:] == [b"\0\1\0\0\0"]
    switched.answer(True)
    assert switched.done()[-1] == {"op": "done", "id": 3}
    switched.control.say(stop(4))
    switched.answer(False)
    switched.pass_seconds(1)
    switched.asked.clear()
    switched.control.say(resume(5))
    switched.control.say(stop(6))
    for _ in range(3):
        while switched.answers:
            switched.answer(True)
    assert [(each["id"], each.get("ok", True)) for each in switched.done()] == [(5, False), (6, True)]
    assert set(switched.asked) == {b"\0\1\0\0\1"}
    assert switched.scene.daemon.authority.stopped is not None


def test_resume_ends_the_alert_about_the_hardware() -> None:
    """A switch that is called at stops alone need not work for that."""
    switched = Switched("std_srvs/srv/Trigger")
    switched.control.say(stop())
    switched.answer(False)
    switched.control.heard()
    switched.control.say(resume())
    assert [each["over"] for each in said(switched.control, "alert")] == [True]
    asked = len(switched.asked)
    switched.pass_seconds(5)
    assert len(switched.asked) == asked


def test_resume_waits_for_no_stop_under_way() -> None:
    """While the hardware is being stopped a resume is refused in words."""
    switched = Switched()
    switched.control.say(stop())
    switched.control.say(resume())
    (done,) = switched.done()
    assert (done["id"], done["ok"]) == (3, False)


BEFORE = link.Stopped(by="eve", since=1.0)


def test_daemon_that_starts_stopped_stops_the_hardware_when_it_is_there() -> None:
    """Once, however late the service appears within half a minute; nobody waits for it."""
    switched = Switched(stopped=BEFORE)
    view, switched.scene.platform.view = switched.scene.platform.view, GraphView()
    for _ in range(20):
        switched.scene.clock.advance(1)
        switched.control.say(link.Ping(t=1))
    assert switched.asked == []
    switched.scene.platform.view = view
    for _ in range(20):
        switched.scene.clock.advance(1)
        switched.control.say(link.Ping(t=1))
        if switched.answers:
            switched.answer(True)
    assert switched.asked == [b"\0\1\0\0\1"]
    assert said(switched.control, "alert") == []


@pytest.mark.parametrize("there", [True, False])
def test_hardware_that_can_not_be_stopped_after_a_start_is_an_alert(there: bool) -> None:
    """It refuses, or does not appear in half a minute."""
    switched = Switched(stopped=BEFORE)
    if not there:
        switched.scene.platform.view = GraphView()
    for _ in range(40):
        switched.scene.clock.advance(1)
        switched.control.say(link.Ping(t=1))
        if switched.answers:
            switched.answer(False, "fuse blown")
    (alert,) = said(switched.control, "alert")
    assert ("fuse blown" if there else "no service /estop") in alert["text"]


def test_stop_while_a_daemon_throws_its_switch_again_is_a_whole_stop() -> None:
    """The goals of others are cancelled, and it is confirmed only then."""
    switched = Switched(stopped=BEFORE)
    platform = switched.scene.platform
    cancelled: list[Deferred[bytes]] = []

    def cancel(request: bytes) -> Deferred[bytes]:
        cancelled.append(Deferred())
        return cancelled[-1]

    switched.pass_seconds(2)
    assert len(switched.answers) == 1  # under way since the start
    platform.services[NAVIGATE + CANCEL] = cancel
    actions = {NAVIGATE: link.Service(types=["a/action/B"])}
    platform.view = GraphView(services=platform.view.services, actions=actions)
    switched.control.say(stop())
    assert len(cancelled) == 1
    while switched.answers:
        switched.answer(True)
    assert switched.done() == []
    cancelled[0].callback(NOTHING_LEFT)
    assert switched.done() == [{"op": "done", "id": 2}]


def test_resume_ends_what_a_start_had_yet_to_stop() -> None:
    """A service that appears afterwards is left alone."""
    switched = Switched("std_srvs/srv/Trigger", BEFORE)
    view, switched.scene.platform.view = switched.scene.platform.view, GraphView()
    switched.scene.clock.advance(1)
    switched.scene.platform.view = view
    assert order(switched.control, resume()) == {"op": "done", "id": 3}
    switched.scene.run(5)
    assert switched.asked == []


# --- what nobody gave on this link -------------------------------------------------------------------------


class Acting:
    """A daemon whose graph has two actions, of which one moves the robot; :attr:`asked` are the calls to cancel."""

    def __init__(self, latch: MemoryStopStore | None = None, switches: Switches | None = None) -> None:
        self.scene = Scene(latch, switches)
        self.asked: list[bytes] = []
        self.answers: list[Deferred[bytes]] = []
        """Those to come."""
        self.given_up = 0
        """Calls whose answer nobody waits for any more."""
        self.show(NAVIGATE, "/count")
        self.control = self.scene.register()
        self.control.heard()

    def show(self, *actions: str) -> None:
        """Have these in the graph, and no others."""
        self.scene.platform.view = GraphView(
            actions={each: link.Service(types=["a/action/B"]) for each in actions}
        )
        for each in actions:
            self.scene.platform.services[each + CANCEL] = self._called

    def _called(self, request: bytes) -> Deferred[bytes]:
        def give_up(answer: Deferred[bytes]) -> None:
            self.given_up += 1

        self.asked.append(request)
        self.answers.append(Deferred(give_up))
        return self.answers[-1]

    def answer(self, code: int = 0) -> None:
        """Answer all that still wait."""
        answers, self.answers = self.answers, []
        for each in answers:
            if not each.called:
                each.callback(b"\0\1\0\0" + bytes([code]) + bytes(7))

    def pass_seconds(self, seconds: int, *channels: Line) -> None:
        for _ in range(seconds):
            for line in (self.control, *channels):
                line.say(link.Ping(t=1))
            self.scene.clock.advance(1)

    def pass_zeros(self, times: int) -> None:
        """Let the time pass in which zero is said so often."""
        for _ in range(times):
            self.scene.clock.advance(0.05)
        self.control.say(link.Ping(t=1))

    def heard(self, op: str) -> list[dict[str, Any]]:
        return said(self.control, op)


@pytest.fixture
def acting() -> Acting:
    return Acting()


@pytest.mark.parametrize(("code", "good"), [(0, True), (1, False), (2, True), (3, True)])
def test_stop_cancels_every_goal_of_the_actions_that_move_the_robot(
    acting: Acting, code: int, good: bool
) -> None:
    """Also one of a daemon before this; only an action that refuses makes the answer bad."""
    acting.control.say(stop())
    assert acting.asked == [ALL_GOALS]
    assert acting.heard("done") == []
    acting.answer(code)
    (done,) = acting.heard("done")
    assert done.get("ok", True) is good
    assert good or NAVIGATE in done["reason"]


def test_action_that_does_not_answer_delays_no_stop_for_long(acting: Acting) -> None:
    """After two seconds the relay hears that the robot is stopped but for it, and so does a person."""
    acting.control.say(stop())
    acting.pass_seconds(round(HEARD_WITHIN) - 1)
    assert acting.heard("done") == []
    acting.pass_seconds(1)
    heard = [each for each in acting.control.heard() if isinstance(each, dict)]
    (done,) = [each for each in heard if each["op"] == "done"]
    assert (done["id"], done["ok"], NAVIGATE in done["reason"]) == (2, False, True)
    (alert,) = [each for each in heard if each["op"] == "alert"]
    assert (alert["level"], alert["kind"], NAVIGATE in alert["text"]) == ("error", "stop", True)


def test_action_that_does_not_answer_is_asked_every_second_until_it_does(acting: Acting) -> None:
    """Then a person hears that it has, and what others have it do from then on is theirs."""
    acting.control.say(stop())
    acting.pass_seconds(10)
    assert 9 <= len(acting.asked) <= 11
    acting.control.heard()
    acting.answer()
    asked = len(acting.asked)
    acting.pass_seconds(10)
    assert len(acting.asked) == asked
    (alert,) = acting.heard("alert")
    assert (alert["kind"], alert["over"]) == ("stop", True)


def test_resume_ends_the_asking(acting: Acting) -> None:
    """Who drives again is not cancelled by a stop that is over, nor does the alert outlast it."""
    acting.control.say(stop())
    acting.pass_seconds(3)
    acting.control.heard()
    given_up = acting.given_up
    assert given_up == len(acting.asked) - 1
    acting.control.say(resume())
    assert acting.given_up == given_up + 1
    (alert,) = acting.heard("alert")
    assert alert["over"] is True
    asked = len(acting.asked)
    acting.pass_seconds(5)
    assert len(acting.asked) == asked


def test_action_that_appears_while_the_robot_is_stopped_is_asked_once(acting: Acting) -> None:
    """It was out of reach at the stop, and may pursue what was given before; one that comes back is not asked again."""
    acting.show()
    assert order(acting.control, stop()) == {"op": "done", "id": 2}
    acting.pass_seconds(60)
    acting.show(NAVIGATE)
    acting.pass_seconds(1)
    acting.answer()
    acting.show()
    acting.pass_seconds(2)
    acting.show(NAVIGATE)
    acting.pass_seconds(5)
    assert acting.asked == [ALL_GOALS]
    assert acting.heard("alert") == []


def test_each_stop_asks_anew(acting: Acting) -> None:
    """Others may have given goals since the last one."""
    for id in (2, 3):
        acting.control.say(stop(id))
        acting.answer()
        acting.pass_seconds(3)
    assert acting.asked == 2 * [ALL_GOALS]
    assert acting.heard("done") == [{"op": "done", "id": 2}, {"op": "done", "id": 3}]


def test_stop_that_comes_while_another_is_confirmed_is_a_whole_one() -> None:
    """The switch hangs, and a node of the robot has given its next goal: all are cancelled, and zero is said again."""
    acting = Acting(switches=Switches("/estop"))
    switch = link.Service(types=["std_srvs/srv/Trigger"])
    actions, topics = acting.scene.platform.view.actions, {"/nav_vel": heard_by(TWIST)}
    acting.scene.platform.view = GraphView(actions=actions, topics=topics, services={"/estop": switch})
    acting.scene.platform.services["/estop"] = lambda request: Deferred()
    acting.control.say(stop())
    acting.answer()
    acting.pass_zeros(40)
    assert (len(acting.asked), acting.scene.platform.published) == (1, 20 * [("/nav_vel", ZERO)])
    acting.control.say(stop(4))
    assert acting.asked == 2 * [ALL_GOALS]
    acting.pass_zeros(40)
    assert acting.scene.platform.published == 40 * [("/nav_vel", ZERO)]
    assert acting.heard("done") == []
    acting.pass_seconds(3)
    first, second = acting.heard("done")
    assert [first["id"], second["id"]] == [2, 4]
    assert ("/estop did not answer" in second["reason"], NAVIGATE in second["reason"]) == (True, True)


def test_action_that_is_being_asked_is_asked_again_for_the_next_stop(acting: Acting) -> None:
    """When it has answered, and not before: however often somebody stops the robot, each action has one to answer."""
    for id in (2, 3, 4):
        acting.control.say(stop(id))
    assert acting.asked == [ALL_GOALS]
    acting.answer()
    assert acting.heard("done") == [{"op": "done", "id": 2}]
    assert acting.asked == 2 * [ALL_GOALS]
    acting.answer()
    assert acting.heard("done") == [{"op": "done", "id": 3}, {"op": "done", "id": 4}]
    acting.pass_seconds(5)
    assert len(acting.asked) == 2
    assert acting.heard("alert") == []


def test_stop_after_one_that_nobody_answers_has_its_own_time(acting: Acting) -> None:
    """What it asks anew makes it good; the other was answered for, after two seconds, as it was."""
    acting.control.say(stop())
    acting.scene.clock.advance(0.5)
    acting.control.say(stop(4))
    acting.scene.clock.advance(0.5)
    assert acting.asked == 2 * [ALL_GOALS]
    acting.scene.clock.advance(0.9)
    assert acting.heard("done") == []
    acting.scene.clock.advance(0.1)
    (done,) = acting.heard("done")
    assert (done["id"], done["ok"], NAVIGATE in done["reason"]) == (2, False, True)
    acting.pass_zeros(5)
    acting.scene.daemon.helm.look()
    acting.answer()
    assert acting.heard("done") == [{"op": "done", "id": 4}]


def test_late_refusal_is_an_alert(acting: Acting) -> None:
    """Nobody waits for the answer any more."""
    acting.control.say(stop())
    acting.pass_seconds(3)
    acting.control.heard()
    acting.answer(1)
    acting.pass_seconds(1)
    (alert,) = acting.heard("alert")
    assert f"{NAVIGATE} refuses" in alert["text"]


def test_action_that_refuses_is_asked_every_second_until_it_does_not(acting: Acting) -> None:
    """A person hears once that it refuses, and when its goals are cancelled."""
    acting.control.say(stop())
    acting.answer(1)
    (told,) = acting.heard("alert")
    assert (told["level"], told["kind"]) == ("error", "stop")
    for _ in range(5):
        acting.pass_seconds(1)
        acting.answer(1)
    assert len(acting.asked) == 6
    assert acting.heard("alert") == []
    acting.pass_seconds(1)
    acting.answer()
    acting.pass_seconds(5)
    assert len(acting.asked) == 7
    assert [each["over"] for each in acting.heard("alert")] == [True]


EXECUTING = b"\0\1\0\0\1" + bytes(3 + 24) + b"\2"
ENDED = EXECUTING[:-1] + b"\4"
CANCELING = EXECUTING[:-1] + b"\3"
TWO = b"\0\1\0\0\2" + CANCELING[5:] + bytes(3 + 24) + b"\2"
"""Of one goal that is being cancelled, and one that goes on."""
ACCEPTED = b"\0\1\0\0" + bytes(4) + b"\1" + bytes(3 + 24)
"""An action's answer that it cancels one goal."""


def test_action_that_refuses_without_a_word_is_known_by_what_it_publishes(acting: Acting) -> None:
    """It says that it cancels none, as one does that has none: the stop is confirmed, and then a person is told."""
    acting.control.say(stop())
    acting.answer()
    assert acting.heard("done") == [{"op": "done", "id": 2}]
    for _ in range(3):
        acting.scene.clock.advance(AFTER)
        acting.scene.platform.emit(NAVIGATE + STATUS, EXECUTING)
        acting.pass_seconds(1)
        acting.answer()
    assert len(acting.asked) == 4
    (alert,) = acting.heard("alert")
    assert (alert["kind"], f"{NAVIGATE} refuses" in alert["text"]) == ("stop", True)
    acting.scene.clock.advance(AFTER)
    acting.scene.platform.emit(NAVIGATE + STATUS, ENDED)
    acting.pass_seconds(5)
    assert [each["over"] for each in acting.heard("alert")] == [True]
    assert (len(acting.asked), acting.scene.platform.sources) == (4, [])


def test_action_that_cancels_one_goal_of_two_is_told_and_asked_again(acting: Acting) -> None:
    """One of rclpy leaves out of its answer what it refuses, so what it publishes counts, also of one that cancels."""
    acting.control.say(stop())
    for _ in range(4):
        acting.answers.pop().callback(ACCEPTED)
        acting.scene.clock.advance(AFTER)
        acting.scene.platform.emit(NAVIGATE + STATUS, TWO)
        if not acting.answers:
            acting.pass_seconds(1)
    heard = [each for each in acting.control.heard() if isinstance(each, dict)]
    assert [each for each in heard if each["op"] == "done"] == [{"op": "done", "id": 2}]
    (alert,) = [each for each in heard if each["op"] == "alert"]
    assert (alert["kind"], f"{NAVIGATE} refuses" in alert["text"]) == ("stop", True)
    acting.answers.pop().callback(ACCEPTED)
    acting.scene.clock.advance(AFTER)
    acting.scene.platform.emit(NAVIGATE + STATUS, ENDED)
    acting.pass_seconds(5)
    assert [each["over"] for each in acting.heard("alert")] == [True]
    assert (len(acting.asked), acting.scene.platform.sources) == (5, [])


def test_goal_that_is_accepted_just_after_all_were_cancelled_is_cancelled_at_once(acting: Acting) -> None:
    """It was on its way inside the robot when the stop came."""
    acting.control.say(stop())
    acting.answers.pop().callback(ACCEPTED)
    acting.scene.clock.advance(AFTER)
    acting.scene.platform.emit(NAVIGATE + STATUS, CANCELING)
    acting.scene.clock.advance(0.05)
    assert len(acting.asked) == 1
    acting.scene.platform.emit(NAVIGATE + STATUS, TWO)
    assert acting.asked == 2 * [ALL_GOALS]
    acting.answers.pop().callback(ACCEPTED)
    acting.scene.clock.advance(AFTER)
    acting.scene.platform.emit(NAVIGATE + STATUS, CANCELING)
    acting.pass_seconds(5)
    assert (len(acting.asked), acting.scene.platform.sources) == (2, [])
    assert acting.heard("alert") == []


def test_resume_ends_the_listening(acting: Acting) -> None:
    """Goals that are given then are to go on."""
    acting.control.say(stop())
    acting.answer()
    acting.control.say(resume())
    acting.scene.clock.advance(AFTER)
    assert acting.scene.platform.sources == []
    acting.pass_seconds(3)
    assert len(acting.asked) == 1


def test_goal_of_a_client_that_has_not_ended_is_told(acting: Acting) -> None:
    """The action has said that it cancels it, and goes on: the stop is not confirmed before its end."""
    acting.scene.platform.actions = {NAVIGATE}
    line = acting.scene.driving(acting.control)
    for id in "ab":
        line.say(link.SendActionGoal(id=id, action=NAVIGATE, type="a/action/B", source=DRIVER, cdr=""))
    first, second = acting.scene.platform.goals
    acting.control.heard()
    acting.control.say(stop())
    acting.answer()
    first.result.callback(GoalOutcome(CANCELED, None))
    assert acting.heard("done") == []
    acting.pass_seconds(2)
    (done,) = acting.heard("done")
    assert (done["ok"], NAVIGATE in done["reason"]) == (False, True)
    second.result.callback(GoalOutcome(CANCELED, None))
    acting.pass_seconds(1)
    (alert,) = acting.heard("alert")
    assert (alert["kind"], alert["over"]) == ("stop", True)


def test_stop_is_confirmed_when_the_last_goal_of_a_client_has_ended(acting: Acting) -> None:
    """Not a moment later."""
    acting.scene.platform.actions = {NAVIGATE}
    line = acting.scene.driving(acting.control)
    line.say(link.SendActionGoal(id="g", action=NAVIGATE, type="a/action/B", source=DRIVER, cdr=""))
    acting.control.heard()
    acting.control.say(stop())
    acting.answer()
    acting.scene.platform.goals[0].result.callback(GoalOutcome(CANCELED, None))
    assert acting.heard("done") == [{"op": "done", "id": 2}]


def test_graph_that_can_not_be_read_makes_no_good_stop(
    acting: Acting, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which actions to ask is not known then; they are asked when it can be read."""
    with monkeypatch.context() as broken_for_now:
        broken_for_now.setattr(acting.scene.platform, "graph", broken)
        done = order(acting.control, stop())
    assert (done["ok"], "could not be found out" in done["reason"]) == (False, True)
    acting.pass_seconds(1)
    assert acting.asked == [ALL_GOALS]


def test_stop_that_can_not_read_the_graph_asks_what_was_seen_before(
    acting: Acting, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is known to refuse is no better by that, and what is there may have goals again."""
    acting.control.say(stop())
    acting.answer(1)
    acting.pass_seconds(1)
    acting.answer(1)
    acting.control.heard()
    with monkeypatch.context() as broken_for_now:
        broken_for_now.setattr(acting.scene.platform, "graph", broken)
        asked = len(acting.asked)
        acting.control.say(stop(4))
        assert len(acting.asked) == asked + 1
        acting.answer(1)
        heard = [each for each in acting.control.heard() if isinstance(each, dict)]
    (done,) = [each for each in heard if each["op"] == "done"]
    assert ("could not be found out" in done["reason"], f"{NAVIGATE} refuses" in done["reason"]) == (
        True,
        True,
    )
    assert not any(each.get("over") for each in heard if each["op"] == "alert")


def test_many_silent_actions_are_asked_in_turn(acting: Acting, monkeypatch: pytest.MonkeyPatch) -> None:
    """So many at a time, and each in the end."""
    names = [f"/r{number:03}/spin" for number in range(MAX_ACTIONS + 10)]
    acting.show(*names)
    asked: dict[str, int] = dict.fromkeys(names, 0)

    def call(service: str, type: str, request: bytes, timeout: float) -> Deferred[bytes]:
        asked[service.removesuffix(CANCEL)] += 1
        return Deferred()

    monkeypatch.setattr(acting.scene.platform, "call", call)
    acting.control.say(stop())
    assert sum(asked.values()) == MAX_ACTIONS
    acting.pass_seconds(2)
    assert min(asked.values()) == 1
    (done,) = acting.heard("done")
    assert "/r000/spin" in done["reason"]
    assert f"and {len(names) - MAX_NAMES} more" in done["reason"]


def test_daemon_that_starts_stopped_cancels_the_goals_of_the_one_before() -> None:
    """Until the action has answered, and not again."""
    acting = Acting(MemoryStopStore(BEFORE))
    acting.pass_seconds(40)
    assert len(acting.asked) >= 39
    acting.answer()
    asked = len(acting.asked)
    acting.pass_seconds(40)
    assert set(acting.asked) == {ALL_GOALS}
    assert len(acting.asked) == asked


def test_action_that_can_not_be_called_is_no_good_stop(acting: Acting) -> None:
    """It is in the graph, and may pursue what nobody can cancel now."""
    acting.scene.platform.services.clear()
    acting.control.say(stop())
    acting.pass_seconds(2)
    (done,) = acting.heard("done")
    assert (done["ok"], NAVIGATE in done["reason"]) == (False, True)


def heard_by(*types: str) -> link.Topic:
    return link.Topic(types=list(types), subscribers=["/base"])


@pytest.fixture
def listening(scene: Scene) -> dict[str, link.Topic]:
    """Topics of the graph."""
    topics = {
        "/nav_vel": heard_by(TWIST),
        "/joy": heard_by("sensor_msgs/msg/Joy"),
        "/chat": heard_by("std_msgs/msg/String"),
        "/unheard": link.Topic(types=[TWIST]),
    }
    scene.platform.view = GraphView(topics=topics)
    return topics


def test_stop_says_zero_for_a_second_where_no_client_commands(
    scene: Scene, control: Line, listening: dict[str, link.Topic]
) -> None:
    """On what moves the robot, is heard, and has a zero of its own; then the publisher goes."""
    order(control, stop())
    assert scene.platform.published == [("/nav_vel", ZERO)]
    for _ in range(40):
        scene.clock.advance(0.05)
    assert scene.platform.published == 20 * [("/nav_vel", ZERO)]
    assert scene.platform.sinks == []


def test_zero_of_a_stop_ends_with_it(scene: Scene, control: Line, listening: dict[str, link.Topic]) -> None:
    """A resume within that second leaves the topic to others."""
    order(control, stop())
    order(control, resume())
    scene.run(1)
    assert scene.platform.published == [("/nav_vel", ZERO)]
    assert scene.platform.sinks == []


def test_zero_of_a_stop_is_bounded_and_outlives_a_topic_that_fails(
    scene: Scene, control: Line, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sixteen topics at most; one that can't be published does not keep the others from it."""
    scene.platform.view = GraphView(topics={f"/v{number:02}": heard_by(TWIST) for number in range(50)})
    advertise = scene.platform.advertise

    def picky(topic: str, *args: Any) -> Any:
        if topic == "/v00":
            raise Unavailable("no such thing")
        return advertise(topic, *args)

    monkeypatch.setattr(scene.platform, "advertise", picky)
    assert order(control, stop()) == {"op": "done", "id": 2}
    assert [topic for topic, _ in scene.platform.published] == [f"/v{number:02}" for number in range(1, 16)]


# --- suppress and inhibit ----------------------------------------------------------------------------------


def test_suppression_stops_what_others_move_and_ends_by_itself(scene: Scene, control: Line) -> None:
    """At its beginning the holder's movement ends, at its end the other's; the holder's stream then goes on."""
    line = scene.driving(control)
    done = order(control, link.Suppress(id=4, resource="cmd_vel", sources=[OTHER], ms=100, by="walls"))
    assert done == {"op": "done", "id": 4}
    assert scene.platform.published[-1] == ("/cmd_vel", ZERO)
    scene.command(line, GO)
    assert scene.platform.published[-1] == ("/cmd_vel", ZERO)
    scene.command(line, twist(0.2), OTHER)
    assert scene.platform.published[-1] == ("/cmd_vel", twist(0.2))
    scene.clock.advance(0.099)
    assert scene.platform.published[-1] == ("/cmd_vel", twist(0.2))
    scene.clock.advance(0.001)
    assert scene.platform.published[-1] == ("/cmd_vel", ZERO)
    scene.command(line, twist(0.6))
    assert scene.platform.published[-1] == ("/cmd_vel", twist(0.6))


def test_renewed_suppression_disturbs_nothing(scene: Scene, control: Line) -> None:
    """A new one of the same sources goes on for its own time, and stops nobody."""
    line = scene.driving(control)
    control.say(link.Suppress(id=4, resource="/cmd_vel", sources=[OTHER], ms=100))
    scene.command(line, twist(0.2), OTHER)
    scene.clock.advance(0.09)
    control.say(link.Suppress(id=5, resource="/cmd_vel", sources=[OTHER], ms=100))
    scene.clock.advance(0.09)
    assert scene.platform.published[-1] == ("/cmd_vel", twist(0.2))
    assert order(control, link.Suppress(id=6, resource="/cmd_vel")) == {"op": "done", "id": 6}
    assert scene.platform.published[-1] == ("/cmd_vel", ZERO)


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (link.Suppress(id=4, resource="/chat", ms=100), "does not move the robot"),
        (link.Suppress(id=4, resource="/none", ms=100), "no topic /none"),
        (link.Inhibit(id=4, resource="/none", ms=100), "no topic /none"),
    ],
)
def test_what_makes_no_sense_is_refused_in_words(scene: Scene, message: link.Message, words: str) -> None:
    """A topic that does not exist, or that moves nothing."""
    scene.platform.view = GraphView(topics={"/chat": link.Topic(types=["std_msgs/msg/String"])})
    done = order(scene.register(), message)
    assert (done["ok"], words in done["reason"]) == (False, True)


def test_topic_of_the_graph_can_be_suppressed_before_anybody_commands_it(scene: Scene) -> None:
    """Also one that has appeared in this moment."""
    control = scene.register()
    scene.platform.view = GraphView(topics={"/cmd_vel": link.Topic(types=[TWIST])})
    assert order(control, link.Suppress(id=4, resource="/cmd_vel", ms=100)) == {"op": "done", "id": 4}


class Listening:
    """A topic that a channel of a daemon listens to."""

    def __init__(self, scene: Scene) -> None:
        scene.platform.view = GraphView(topics={"/chat": link.Topic(types=["std_msgs/msg/String"])})
        self.scene = scene
        self.control = scene.register()
        self.line = scene.channel(self.control)
        self.line.say(link.Subscribe(number=1, topic="/chat"))
        self.line.heard()

    def emit(self, body: bytes) -> list[bytes]:
        self.scene.platform.emit("/chat", body)
        self.scene.clock.advance(0)
        return [each.body for each in self.line.heard() if isinstance(each, frames.SampleFrame)]

    def inhibit(self, ms: int, hold: bool = False) -> None:
        assert order(self.control, link.Inhibit(id=4, resource="/chat", ms=ms, hold=hold))["id"] == 4


def test_inhibited_topic_says_nothing_for_its_time(scene: Scene) -> None:
    """No sample leaves, on a link that was there and on one that comes; after its time they do again."""
    listening = Listening(scene)
    assert listening.emit(b"a") == [b"a"]
    listening.inhibit(1000)
    later = scene.channel(listening.control, "c2")
    later.say(link.Subscribe(number=2, topic="/chat"))
    later.heard()
    assert listening.emit(b"b") == []
    assert [each for each in later.heard() if isinstance(each, frames.SampleFrame)] == []
    scene.clock.advance(0.999)
    assert listening.emit(b"c") == []
    scene.clock.advance(0.001)
    assert listening.emit(b"d") == [b"d"]


def test_held_topic_repeats_its_last_value(scene: Scene) -> None:
    """With hold each sample is replaced by the last one that left; where none did, there is none."""
    listening = Listening(scene)
    listening.inhibit(1000, hold=True)
    assert listening.emit(b"a") == []
    listening.inhibit(0)
    assert listening.emit(b"b") == [b"b"]
    listening.inhibit(1000, hold=True)
    assert listening.emit(b"c") == [b"b"]
    assert listening.emit(b"d") == [b"b"]
    listening.inhibit(0)
    assert listening.emit(b"e") == [b"e"]


def test_inhibition_ends_with_the_link_it_was_ordered_by(scene: Scene) -> None:
    """Nobody is left who could end it: a relay that comes back hears of none, and gets samples."""
    listening = Listening(scene)
    listening.inhibit(60_000)
    listening.control.lose()
    scene.run(1)
    control = scene.register()
    (told,) = said(control, "safety")
    assert "inhibited" not in told
    line = scene.channel(control)
    line.say(link.Subscribe(number=1, topic="/chat"))
    line.heard()
    scene.platform.emit("/chat", b"a")
    scene.clock.advance(0)
    assert [each.body for each in line.heard() if isinstance(each, frames.SampleFrame)] == [b"a"]


# --- what is told ------------------------------------------------------------------------------------------


def test_safety_tells_who_moves_the_robot(scene: Scene, control: Line) -> None:
    """Holder, movement, suppression, inhibition and stop, in one word."""
    scene.driving(control)
    scene.clock.advance(TELL_EVERY)
    control.heard()
    control.say(link.Suppress(id=4, resource="/cmd_vel", sources=[DRIVER, 3], ms=200, by="walls"))
    scene.clock.advance(TELL_EVERY)
    told = said(control, "safety")[-1]
    assert (told["holder"], told["moving"]) == (DRIVER, True)
    assert told["suppressed"] == [
        {"resource": "/cmd_vel", "sources": [3, DRIVER], "by": "walls", "ms": told["suppressed"][0]["ms"]}
    ]
    assert 0 < told["suppressed"][0]["ms"] <= 200
    control.say(stop())
    scene.clock.advance(TELL_EVERY)
    told = said(control, "safety")[-1]
    assert "moving" not in told
    assert told["stopped"]["by"] == "eve"


def test_robot_moves_as_long_as_a_goal_that_moves_it_goes_on(scene: Scene, control: Line) -> None:
    """Also where whoever gave it has lost control; other goals count for nothing."""
    scene.platform.actions = {NAVIGATE, "/count"}
    line = scene.driving(control)
    scene.command(line, ZERO)
    for id, action in (("g", NAVIGATE), ("h", "/count")):
        line.say(link.SendActionGoal(id=id, action=action, type="a/action/B", source=DRIVER, cdr=""))
    scene.clock.advance(TELL_EVERY)
    assert said(control, "safety")[-1]["moving"] is True
    control.say(link.Control(id=9))
    scene.run(1)
    assert said(control, "safety")[-1]["moving"] is True
    scene.platform.goals[0].result.callback(GoalOutcome(CANCELED, None))
    scene.clock.advance(TELL_EVERY)
    assert "moving" not in said(control, "safety")[-1]


def test_safety_is_told_at_most_twenty_times_a_second_and_the_last_state_always(
    scene: Scene, control: Line
) -> None:
    """However fast things change."""
    line = scene.driving(control)
    scene.run(1)
    control.heard()
    for _ in range(200):
        scene.clock.advance(0.005)
        scene.command(line, GO)
        scene.command(line, ZERO)
    scene.command(line, GO)
    scene.clock.advance(TELL_EVERY)
    told = said(control, "safety")
    assert 0 < len(told) <= 22
    assert told[-1]["moving"] is True


def test_nothing_is_told_without_a_relay(scene: Scene, control: Line) -> None:
    """What changes while the link is away is told when it is back."""
    scene.driving(control)
    control.lose()
    scene.run(1)
    control = scene.register()
    assert len(said(control, "safety")) == 1


def test_order_that_fails_unforeseen_is_answered(
    scene: Scene, control: Line, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A middleware that throws costs the order, not the link, and its words stay in the log."""
    monkeypatch.setattr(scene.platform, "full_name", broken)
    done = order(control, link.Inhibit(id=4, resource="/chat", ms=100))
    assert done["ok"] is False
    assert "secret" not in done["reason"]


# --- limits and ramps --------------------------------------------------------------------------------------


def test_limits_are_told_and_hold() -> None:
    """By level, the stricter of robot and level; what was made slower is counted."""
    scene = Scene(settings=RobotSettings(limits=LimitSettings(linear=0.8, operator=Speeds(linear=0.5))))
    control = scene.register()
    (told,) = said(control, "safety")
    assert told["limits"] == {"operator": {"linear": 0.5}, "owner": {"linear": 0.8}}
    line = scene.channel(control)
    line.say(link.Advertise(number=5, topic="/cmd_vel", type=TWIST))
    for level in ("operator", "owner"):
        order(control, link.Control(id=9, holder=DRIVER, user="ann", level=level))
        scene.command(line, GO)
    assert scene.platform.published == [("/cmd_vel", twist(0.5)), ("/cmd_vel", twist(0.8))]
    assert scene.daemon._health().limited_commands == 2


def test_who_is_limited_hears_why_a_joystick_moves_nothing() -> None:
    """A person is told once, by an alert that lasts until control changes; where nobody may, advertising is refused."""
    scene = Scene(settings=RobotSettings(limits=LimitSettings(operator=Speeds(linear=0.5))))
    control = scene.register()
    line = scene.channel(control)
    line.say(link.Advertise(number=5, topic="/joy", type=JOY))
    control.say(link.Control(id=8, holder=DRIVER, user="ann", level="operator"))
    control.heard()
    for _ in range(3):
        scene.command(line, GO)
    (alert,) = said(control, "alert")
    assert (alert["kind"], alert["about"], alert.get("over", False)) == ("control", "limits", False)
    assert (
        "commands on /joy (sensor_msgs/msg/Joy) are refused: the speed of the level 'operator'"
        in alert["text"]
    )
    assert scene.platform.published == []
    assert scene.daemon._health().refused_commands == 3
    control.say(link.Control(id=9, holder=DRIVER, user="ann", level="owner"))
    assert [each["over"] for each in said(control, "alert")] == [True]
    scene.command(line, GO)
    assert scene.platform.published == [("/joy", GO)]
    closed = Scene(settings=RobotSettings(limits=LimitSettings(linear=0.5)))
    line = closed.channel(closed.register())
    line.say(link.Advertise(number=5, topic="/joy", type=JOY))
    (failed,) = said(line, "failed")
    assert "how fast sensor_msgs/msg/Joy on /joy moves the robot can't be told" in failed["reason"]
    assert closed.platform.sinks == []


def test_control_is_given_when_the_ramp_of_the_former_holder_is_over() -> None:
    """Not before; a stop does not wait for it."""
    scene = Scene(settings=RobotSettings(safety=SafetySettings(ramp_ms=200)))
    control = scene.register()
    line = scene.driving(control)
    control.heard()
    control.say(link.Control(id=9, holder=OTHER, user="ben"))
    assert said(control, "done") == []
    scene.run(0.3)
    assert ("/cmd_vel", ZERO) in scene.platform.published
    assert said(control, "done") == [{"op": "done", "id": 9}]
    scene.command(line, GO, OTHER)
    control.say(link.Control(id=10))
    assert said(control, "done") == []
    control.say(stop(11))
    assert scene.platform.published[-1] == ("/cmd_vel", ZERO)
    assert [each["id"] for each in said(control, "done")] == [10, 11]
