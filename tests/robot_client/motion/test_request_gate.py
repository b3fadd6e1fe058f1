"""Which calls and goals may move the robot, and how old they may be."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from twisted.internet.defer import Deferred

from relay_protocol import link
from relay_protocol.errors import Refused
from relay_protocol.link import MotionPolicy
from robot_client.config import RobotSettings, SafetySettings
from robot_client.link.clock_offset import ClockOffset
from robot_client.motion.authority import Suppression
from robot_client.motion.request_gate import MotionRequestGate
from robot_client.platforms.base import GraphView
from tests.worlds import robot_daemon
from tests.worlds.robot_channel import DRIVER, ChannelWorld

MILLI = 1_000_000
CDR = link.to_base64(b"abc")
SERVICES = ("/arm/move", "/navigate_to_pose/_action/send_goal", "/lamp")


@pytest.fixture
def scene() -> ChannelWorld:
    """A robot with services and actions, some of which move it."""
    made = ChannelWorld()
    for service in SERVICES:
        made.platform.services[service] = lambda request: request
    made.platform.actions = {"/navigate_to_pose", "/dock"}
    return made


def call(scene: ChannelWorld, service: str, stamp: int | None) -> link.ServiceResponse:
    """Call a service as the holder."""
    answer = scene.request(
        link.CallService(id="c", service=service, type="t", source=DRIVER, stamp=stamp, cdr=CDR)
    )
    assert isinstance(answer, link.ServiceResponse)
    return answer


def goal(scene: ChannelWorld, action: str, stamp: int | None) -> link.ActionResult | None:
    """Send a goal as the holder; return its result if it never began."""
    before = len(scene.platform.goals)
    message = link.SendActionGoal(id=str(before), action=action, type="t", source=DRIVER, stamp=stamp, cdr="")
    answer = scene.request(message)
    if len(scene.platform.goals) > before:
        return None
    assert isinstance(answer, link.ActionResult)
    return answer


@pytest.mark.parametrize("service", SERVICES[:2])
def test_motion_call_older_than_the_deadline_is_refused_and_counted(
    scene: ChannelWorld, service: str
) -> None:
    """So is a goal by the action's hidden service."""
    assert call(scene, service, scene.now() - 500 * MILLI + 1).result
    assert scene.gate.stale == 0
    answer = call(scene, service, scene.now() - 812 * MILLI)
    assert not answer.result
    assert f"a call of {service} moves the robot: it may be 812 ms old" in answer.reason
    assert "none older than 500 ms" in answer.reason
    assert scene.gate.stale == 1


def test_motion_goal_older_than_the_deadline_is_refused(scene: ChannelWorld) -> None:
    assert goal(scene, "/navigate_to_pose", scene.now() - 500 * MILLI + 1) is None
    end = goal(scene, "navigate_to_pose", scene.now() - 501 * MILLI)
    assert end is not None
    assert (end.status, end.result) == (0, False)
    assert "a goal for /navigate_to_pose moves the robot: it may be 501 ms old" in end.reason
    assert scene.gate.stale == 1


def test_greatest_possible_age_counts(scene: ChannelWorld) -> None:
    """An exchange of 400 ms may hide as much."""
    scene.offset._window.clear()
    now = scene.now()
    scene.offset.add(now - 400 * MILLI, now, now)
    assert goal(scene, "/navigate_to_pose", now - 90 * MILLI) is None
    assert goal(scene, "/navigate_to_pose", now - 110 * MILLI) is not None


@pytest.mark.parametrize(
    ("known", "words"),
    [(True, "its stamp is in the future"), (False, "its age is not known yet")],
)
def test_unknown_age_and_future_stamps_are_refused(scene: ChannelWorld, known: bool, words: str) -> None:
    stamp = scene.now() + 60_000 * MILLI
    if not known:
        scene.offset._window.clear()
    answer, end = call(scene, "/arm/move", stamp), goal(scene, "/navigate_to_pose", stamp)
    assert end is not None
    assert not answer.result
    assert words in answer.reason
    assert words in end.reason
    assert scene.gate.stale == 2


def test_request_without_a_stamp_counts_as_sent_on_arrival(scene: ChannelWorld) -> None:
    assert call(scene, "/arm/move", None).result
    assert goal(scene, "/navigate_to_pose", None) is None
    assert scene.gate.stale == 0


def test_other_requests_have_no_deadline(scene: ChannelWorld) -> None:
    assert call(scene, "/lamp", 1).result
    assert goal(scene, "/dock", 1) is None
    scene.offset._window.clear()
    assert call(scene, "/lamp", 1).result
    assert scene.gate.stale == 0


def test_refusal_by_source_is_not_counted_as_stale(scene: ChannelWorld) -> None:
    scene.authority.grant_control(DRIVER + 1, "bob", "operator", scene.now())
    assert "only the holder of control" in call(scene, "/arm/move", 1).reason
    assert scene.gate.stale == 0


def test_clock_offset_of_the_link_counts(scene: ChannelWorld) -> None:
    ahead = 10**15
    other = ClockOffset()
    other.add(scene.now(), scene.now() + ahead, scene.now())
    scene.gate.check_goal("/navigate_to_pose", DRIVER, scene.now() + ahead, other)
    assert goal(scene, "/navigate_to_pose", scene.now() + ahead) is not None


def suppress(scene: ChannelWorld, *sources: int) -> None:
    """Suppress the wheels for 200 ms, except for these sources."""
    until = scene.now() + 200 * MILLI
    scene.authority.suppress("/cmd_vel", Suppression(frozenset(sources), until, "eve"))


def test_motion_requests_are_refused_while_others_suppress(scene: ChannelWorld) -> None:
    suppress(scene, DRIVER + 1)
    end, answer = goal(scene, "/navigate_to_pose", None), call(scene, "/arm/move", None)
    assert end is not None
    assert not answer.result
    for words in (end.reason, answer.reason):
        assert "moves the robot: other sources suppress a topic that moves" in words
    assert goal(scene, "/dock", None) is None
    assert call(scene, "/lamp", None).result
    scene.run(0.2)
    assert goal(scene, "/navigate_to_pose", None) is None
    assert call(scene, "/arm/move", None).result


def test_suppression_does_not_cancel_an_active_goal(scene: ChannelWorld) -> None:
    assert goal(scene, "/navigate_to_pose", None) is None
    suppress(scene, DRIVER + 1)
    scene.run(0.3)
    assert [each.cancelled for each in scene.platform.goals] == [False]


# --- overtaken by a stop or a change of control -----------------------------------------------------------


def stop(scene: ChannelWorld) -> None:
    """Stops the robot, 100 ms before and after other events."""
    scene.run(0.1)
    scene.authority.stop(link.Stopped(by="eve", since=1.0), scene.now())
    scene.run(0.1)


def stop_and_resume(scene: ChannelWorld) -> None:
    """Stops and resumes the robot, and waits 100 ms."""
    stop(scene)
    scene.authority.resume(scene.now())
    scene.run(0.1)


def hand_over(scene: ChannelWorld) -> None:
    """Grants control to another source."""
    scene.authority.grant_control(DRIVER + 1, "bob", "operator", scene.now())


def hand_over_and_back(scene: ChannelWorld) -> None:
    """Grants control to another source and back."""
    scene.run(0.1)
    hand_over(scene)
    scene.run(0.1)
    scene.authority.grant_control(DRIVER, "ann", "operator", scene.now())


@pytest.mark.parametrize("age", [250, 150])
def test_request_delayed_through_a_stop_is_refused_after_the_resume(scene: ChannelWorld, age: int) -> None:
    """The next one passes."""
    stop_and_resume(scene)
    stamp = scene.now() - age * MILLI
    end, answer = goal(scene, "/navigate_to_pose", stamp), call(scene, "/arm/move", stamp)
    assert end is not None
    assert not answer.result
    for words in (end.reason, answer.reason):
        assert "it may have been sent before the robot was stopped or resumed" in words
    assert scene.authority.refused == 2
    assert goal(scene, "/navigate_to_pose", scene.now()) is None
    assert call(scene, "/arm/move", scene.now()).result


@pytest.mark.parametrize("stamped", [True, False])
@pytest.mark.parametrize(
    ("event", "words"),
    [
        (stop, "stopped until it is resumed"),
        (stop_and_resume, "sent before the robot was stopped or resumed"),
        (hand_over, "only the holder of control"),
        (hand_over_and_back, "or control was lost"),
        (lambda scene: suppress(scene, DRIVER + 1), "other sources suppress a topic"),
        (lambda scene: scene.run(0.6), "it may be 60"),
    ],
    ids=["stop", "resume", "control", "control again", "suppression", "age"],
)
def test_call_is_judged_again_when_its_service_is_found(
    scene: ChannelWorld, event: Callable[[ChannelWorld], None], words: str, stamped: bool
) -> None:
    """That may take a second."""
    asked: list[bytes] = []

    def move(request: bytes) -> bytes:
        asked.append(request)
        return request

    scene.platform.services["/arm/move"] = move
    looking: list[Deferred[None]] = []
    scene.platform.pending_discovery = looking
    stamp = scene.now() if stamped else None
    scene.request(
        link.CallService(id="c", service="/arm/move", type="t", source=DRIVER, stamp=stamp, cdr=CDR)
    )
    event(scene)
    looking.pop().callback(None)
    (answer,) = scene.writer.sent
    assert not answer.result
    assert "a call of /arm/move moves the robot" in answer.reason
    assert words in answer.reason
    assert asked == []


def test_late_service_is_called_if_nothing_has_changed(scene: ChannelWorld) -> None:
    """A call that moves nothing is made in any case."""
    looking: list[Deferred[None]] = []
    scene.platform.pending_discovery = looking
    for id, service in (("c", "/arm/move"), ("d", "/lamp")):
        message = link.CallService(
            id=id, service=service, type="t", source=DRIVER, stamp=scene.now(), cdr=CDR
        )
        scene.request(message)
    scene.run(0.4)
    looking[0].callback(None)
    stop(scene)
    looking[1].callback(None)
    assert [(each.id, each.result) for each in scene.writer.sent] == [("c", True), ("d", True)]


# --- the switch in the hardware ----------------------------------------------------------------------------


def armed(settings: SafetySettings) -> tuple[robot_daemon.RelayEnd, robot_daemon.RelayEnd, list[bytes]]:
    """A daemon with that switch, control link and channel, with the requests to its service."""
    made = robot_daemon.Scene(settings=RobotSettings(safety=settings), switches=settings.switches)
    asked: list[bytes] = []

    def thrown(request: bytes) -> bytes:
        asked.append(request)
        return b"\0\1\0\0\1\0\0\0\1\0\0\0\0"

    made.platform.view = GraphView(services={"/estop": link.Service(types=["std_srvs/srv/SetBool"])})
    made.platform.services |= {"/estop": thrown, "estop": thrown}
    control = made.register()
    control.send(link.ControlGrant(id=1, holder=DRIVER, user="ann", level="owner"))
    channel = made.channel(control)
    channel.received()
    return control, channel, asked


@pytest.mark.parametrize("stopped", [True, False])
@pytest.mark.parametrize("source", [0, DRIVER, DRIVER + 1])
@pytest.mark.parametrize("service", ["/estop", "estop"])
@pytest.mark.parametrize(
    "settings",
    [
        SafetySettings(stop_service="estop"),
        SafetySettings(stop_service="/estop", motion_services=["*"], motion_actions=[]),
    ],
    ids=["plain", "motion"],
)
def test_no_client_may_call_the_hardware_switch(
    settings: SafetySettings, service: str, source: int, stopped: bool
) -> None:
    """However its name is spelled."""
    control, channel, asked = armed(settings)
    if stopped:
        control.send(link.Stop(id=2, by="eve"))
    thrown = list(asked)
    channel.send(link.CallService(id="c", service=service, type="t", source=source, cdr=CDR))
    (answer,) = [each for each in channel.received() if each["op"] == "service_response"]
    assert not answer["result"]
    assert "/estop is the robot's hardware switch, which no client may call" in answer["reason"]
    assert "/relay/stop" in answer["reason"]
    assert "/relay/resume" in answer["reason"]
    assert asked == thrown
    assert len(thrown) == stopped


def test_daemon_itself_calls_the_switch() -> None:
    """At a stop and at a resume."""
    control, _, asked = armed(SafetySettings(stop_service="/estop"))
    control.send(link.Stop(id=2, by="eve"), link.Resume(id=3, by="eve"))
    assert [request[4] for request in asked] == [1, 0]


def test_no_goal_may_call_the_switch(scene: ChannelWorld) -> None:
    """By the hidden service of an action of its name."""
    gate = MotionRequestGate(
        MotionPolicy(), scene.platform, scene.authority, scene.now, "/dock/_action/send_goal"
    )
    with pytest.raises(Refused, match="no client may call"):
        gate.check_goal("dock", DRIVER, None, scene.offset)
    with pytest.raises(Refused, match="no client may call"):
        gate.check_call("/dock/_action/send_goal", DRIVER, None, scene.offset)
    assert not gate.check_goal("/dock2", DRIVER, None, scene.offset)


def test_no_client_may_advertise_the_switch() -> None:
    """It could answer a stop that stopped nothing."""
    _, channel, _ = armed(SafetySettings(stop_service="/estop"))
    channel.send(link.AdvertiseService(service="estop", type="std_srvs/srv/SetBool"))
    channel.send(link.AdvertiseService(service="/lamp", type="std_srvs/srv/SetBool"))
    failed, offered = channel.received()
    assert (failed["op"], failed["reference"]) == ("failed", "estop")
    assert "no client may advertise" in failed["reason"]
    assert offered["op"] == "advertised_service"
