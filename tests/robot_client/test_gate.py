"""How old a call or a goal that moves the robot may be."""

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
from robot_client.motion.gate import MotionGate
from robot_client.platforms.base import GraphView
from tests.robot_client import daemon_scene
from tests.robot_client.scene import DRIVER, Scene

MILLI = 1_000_000
CDR = link.to_base64(b"abc")
SERVICES = ("/arm/move", "/navigate_to_pose/_action/send_goal", "/lamp")


@pytest.fixture
def scene() -> Scene:
    """A robot with services and actions, some of which move it."""
    made = Scene()
    for service in SERVICES:
        made.platform.services[service] = lambda request: request
    made.platform.actions = {"/navigate_to_pose", "/dock"}
    return made


def call(scene: Scene, service: str, stamp: int | None) -> link.ServiceResponse:
    """The holder calls a service."""
    answer = scene.ask(
        link.CallService(id="c", service=service, type="t", source=DRIVER, stamp=stamp, cdr=CDR)
    )
    assert isinstance(answer, link.ServiceResponse)
    return answer


def goal(scene: Scene, action: str, stamp: int | None) -> link.ActionResult | None:
    """The holder sends a goal; its end, if it never began."""
    before = len(scene.platform.goals)
    message = link.SendActionGoal(id=str(before), action=action, type="t", source=DRIVER, stamp=stamp, cdr="")
    answer = scene.ask(message)
    if len(scene.platform.goals) > before:
        return None
    assert isinstance(answer, link.ActionResult)
    return answer


@pytest.mark.parametrize("service", SERVICES[:2])
def test_a_call_that_moves_the_robot_must_not_be_older_than_the_deadline(scene: Scene, service: str) -> None:
    """It is made up to that age; beyond, it is refused in words and counted. So is a goal by its hidden service."""
    assert call(scene, service, scene.now() - 500 * MILLI + 1).result
    assert scene.gate.stale == 0
    answer = call(scene, service, scene.now() - 812 * MILLI)
    assert not answer.result
    assert f"a call of {service} moves the robot: it may be 812 ms old" in answer.reason
    assert "none older than 500 ms" in answer.reason
    assert scene.gate.stale == 1


def test_a_goal_that_moves_the_robot_must_not_be_older_than_the_deadline(scene: Scene) -> None:
    """It is pursued up to that age; beyond, it never begins."""
    assert goal(scene, "/navigate_to_pose", scene.now() - 500 * MILLI + 1) is None
    end = goal(scene, "navigate_to_pose", scene.now() - 501 * MILLI)
    assert end is not None
    assert (end.status, end.result) == (0, False)
    assert "a goal for /navigate_to_pose moves the robot: it may be 501 ms old" in end.reason
    assert scene.gate.stale == 1


def test_the_age_is_the_greatest_possible(scene: Scene) -> None:
    """A link whose only exchange took 400 ms may hide as much of it."""
    scene.offset._window.clear()
    now = scene.now()
    scene.offset.add(now - 400 * MILLI, now, now)
    assert goal(scene, "/navigate_to_pose", now - 90 * MILLI) is None
    assert goal(scene, "/navigate_to_pose", now - 110 * MILLI) is not None


@pytest.mark.parametrize(
    ("known", "words"),
    [(True, "by its stamp it comes from the future"), (False, "how old it is can't be told yet")],
)
def test_what_has_no_age_is_refused(scene: Scene, known: bool, words: str) -> None:
    """A stamp that the relay's clock can't have shown, and one of a clock that nobody has asked."""
    stamp = scene.now() + 60_000 * MILLI
    if not known:
        scene.offset._window.clear()
    answer, end = call(scene, "/arm/move", stamp), goal(scene, "/navigate_to_pose", stamp)
    assert end is not None
    assert not answer.result
    assert words in answer.reason
    assert words in end.reason
    assert scene.gate.stale == 2


def test_without_a_stamp_it_counts_as_sent_when_it_comes(scene: Scene) -> None:
    """So it was before there were stamps."""
    assert call(scene, "/arm/move", None).result
    assert goal(scene, "/navigate_to_pose", None) is None
    assert scene.gate.stale == 0


def test_what_moves_nothing_is_done_however_old_it_is(scene: Scene) -> None:
    """Other services and actions know no deadline, nor a clock."""
    assert call(scene, "/lamp", 1).result
    assert goal(scene, "/dock", 1) is None
    scene.offset._window.clear()
    assert call(scene, "/lamp", 1).result
    assert scene.gate.stale == 0


def test_who_may_not_move_the_robot_is_told_so_first(scene: Scene) -> None:
    """What is refused for its source is not counted for its age."""
    scene.authority.hold(DRIVER + 1, "bob", "operator", scene.now())
    assert "only who holds control" in call(scene, "/arm/move", 1).reason
    assert scene.gate.stale == 0


def test_the_relays_clock_of_the_very_link_counts(scene: Scene) -> None:
    """Its stamps are far from the robot's own clock."""
    ahead = 10**15
    other = ClockOffset()
    other.add(scene.now(), scene.now() + ahead, scene.now())
    scene.gate.goal("/navigate_to_pose", DRIVER, scene.now() + ahead, other)
    assert goal(scene, "/navigate_to_pose", scene.now() + ahead) is not None


def suppress(scene: Scene, *sources: int) -> None:
    """Some sources have the wheels for themselves, for 200 ms from now."""
    until = scene.now() + 200 * MILLI
    scene.authority.suppress("/cmd_vel", Suppression(frozenset(sources), until, "eve"))


def test_no_goal_or_call_that_moves_the_robot_begins_while_others_suppress(scene: Scene) -> None:
    """It would drive past it, and is refused in words; what moves nothing is done, and afterwards all is."""
    suppress(scene, DRIVER + 1)
    end, answer = goal(scene, "/navigate_to_pose", None), call(scene, "/arm/move", None)
    assert end is not None
    assert not answer.result
    for words in (end.reason, answer.reason):
        assert "moves the robot: others suppress a topic that moves it" in words
    assert goal(scene, "/dock", None) is None
    assert call(scene, "/lamp", None).result
    scene.run(0.2)
    assert goal(scene, "/navigate_to_pose", None) is None
    assert call(scene, "/arm/move", None).result


def test_a_goal_under_way_outlasts_a_suppression(scene: Scene) -> None:
    """It is not cancelled: the program that suppresses may stop the robot."""
    assert goal(scene, "/navigate_to_pose", None) is None
    suppress(scene, DRIVER + 1)
    scene.run(0.3)
    assert [each.cancelled for each in scene.platform.goals] == [False]


# --- what a stop or a change of control has overtaken ------------------------------------------------------


def stop(scene: Scene) -> None:
    """Stop the robot, 100 ms after and before something else."""
    scene.run(0.1)
    scene.authority.stop(link.Stopped(by="eve", since=1.0), scene.now())
    scene.run(0.1)


def stop_and_resume(scene: Scene) -> None:
    """Stop the robot, let it go again, and wait 100 ms."""
    stop(scene)
    scene.authority.resume(scene.now())
    scene.run(0.1)


def hand_over(scene: Scene) -> None:
    """Somebody else has control now."""
    scene.authority.hold(DRIVER + 1, "bob", "operator", scene.now())


def hand_over_and_back(scene: Scene) -> None:
    """Somebody else had control."""
    scene.run(0.1)
    hand_over(scene)
    scene.run(0.1)
    scene.authority.hold(DRIVER, "ann", "operator", scene.now())


@pytest.mark.parametrize("age", [250, 150])
def test_what_was_held_up_through_a_stop_is_refused_after_the_resume(scene: Scene, age: int) -> None:
    """A goal or a call that was sent before the one or the other comes in time, and in vain; the next is obeyed."""
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
        (stop, "stopped until somebody resumes it"),
        (stop_and_resume, "sent before the robot was stopped or resumed"),
        (hand_over, "only who holds control"),
        (hand_over_and_back, "or control was lost"),
        (lambda scene: suppress(scene, DRIVER + 1), "others suppress a topic"),
        (lambda scene: scene.run(0.6), "it may be 60"),
    ],
    ids=["stop", "resume", "control", "control again", "suppression", "age"],
)
def test_a_call_is_judged_once_more_when_its_service_is_found(
    scene: Scene, event: Callable[[Scene], None], words: str, stamped: bool
) -> None:
    """Looking for it may take a second; what has happened meanwhile counts, and the service is not called."""
    asked: list[bytes] = []

    def move(request: bytes) -> bytes:
        asked.append(request)
        return request

    scene.platform.services["/arm/move"] = move
    looking: list[Deferred[None]] = []
    scene.platform.looking = looking
    stamp = scene.now() if stamped else None
    scene.ask(link.CallService(id="c", service="/arm/move", type="t", source=DRIVER, stamp=stamp, cdr=CDR))
    event(scene)
    looking.pop().callback(None)
    (answer,) = scene.wire.said
    assert not answer.result
    assert "a call of /arm/move moves the robot" in answer.reason
    assert words in answer.reason
    assert asked == []


def test_a_call_whose_service_takes_its_time_is_made(scene: Scene) -> None:
    """When nothing has happened meanwhile; and one that moves nothing, whatever has."""
    looking: list[Deferred[None]] = []
    scene.platform.looking = looking
    for id, service in (("c", "/arm/move"), ("d", "/lamp")):
        message = link.CallService(
            id=id, service=service, type="t", source=DRIVER, stamp=scene.now(), cdr=CDR
        )
        scene.ask(message)
    scene.run(0.4)
    looking[0].callback(None)
    stop(scene)
    looking[1].callback(None)
    assert [(each.id, each.result) for each in scene.wire.said] == [("c", True), ("d", True)]


# --- the switch in the hardware ----------------------------------------------------------------------------


def armed(settings: SafetySettings) -> tuple[daemon_scene.Line, daemon_scene.Line, list[bytes]]:
    """A daemon with that switch, control link and channel; what its service is asked."""
    made = daemon_scene.Scene(settings=RobotSettings(safety=settings), switches=settings.switches)
    asked: list[bytes] = []

    def thrown(request: bytes) -> bytes:
        asked.append(request)
        return b"\0\1\0\0\1\0\0\0\1\0\0\0\0"

    made.platform.view = GraphView(services={"/estop": link.Service(types=["std_srvs/srv/SetBool"])})
    made.platform.services |= {"/estop": thrown, "estop": thrown}
    control = made.register()
    control.say(link.Control(id=1, holder=DRIVER, user="ann", level="owner"))
    channel = made.channel(control)
    channel.heard()
    return control, channel, asked


@pytest.mark.parametrize("stopped", [True, False])
@pytest.mark.parametrize("source", [0, DRIVER, DRIVER + 1])
@pytest.mark.parametrize("service", ["/estop", "estop"])
@pytest.mark.parametrize(
    "settings",
    [
        SafetySettings(stop_call="estop"),
        SafetySettings(stop_call="/estop", motion_services=["*"], motion_actions=[]),
    ],
    ids=["plain", "motion"],
)
def test_no_client_calls_the_switch_in_the_hardware(
    settings: SafetySettings, service: str, source: int, stopped: bool
) -> None:
    """Stopped or not, who holds control as little as others, however it is spelled and whatever else it is."""
    control, channel, asked = armed(settings)
    if stopped:
        control.say(link.Stop(id=2, by="eve"))
    thrown = list(asked)
    channel.say(link.CallService(id="c", service=service, type="t", source=source, cdr=CDR))
    (answer,) = [each for each in channel.heard() if each["op"] == "service_response"]
    assert not answer["result"]
    assert "/estop is the switch in the robot's hardware, which no client may call" in answer["reason"]
    assert "/relay/stop" in answer["reason"]
    assert "/relay/resume" in answer["reason"]
    assert asked == thrown
    assert len(thrown) == stopped


def test_the_robot_itself_throws_the_switch() -> None:
    """At a stop and at a resume."""
    control, _, asked = armed(SafetySettings(stop_call="/estop"))
    control.say(link.Stop(id=2, by="eve"), link.Resume(id=3, by="eve"))
    assert [request[4] for request in asked] == [1, 0]


def test_no_goal_throws_the_switch(scene: Scene) -> None:
    """Not even where it bears the name of an action's own service."""
    gate = MotionGate(MotionPolicy(), scene.platform, scene.authority, scene.now, "/dock/_action/send_goal")
    with pytest.raises(Refused, match="no client may call"):
        gate.goal("dock", DRIVER, None, scene.offset)
    with pytest.raises(Refused, match="no client may call"):
        gate.call("/dock/_action/send_goal", DRIVER, None, scene.offset)
    assert not gate.goal("/dock2", DRIVER, None, scene.offset)


def test_no_client_stands_in_for_the_switch() -> None:
    """Whoever offered a service of its name could answer a stop that stopped nothing."""
    _, channel, _ = armed(SafetySettings(stop_call="/estop"))
    channel.say(link.AdvertiseService(service="estop", type="std_srvs/srv/SetBool"))
    channel.say(link.AdvertiseService(service="/lamp", type="std_srvs/srv/SetBool"))
    failed, offered = channel.heard()
    assert (failed["op"], failed["ref"]) == ("failed", "estop")
    assert "no client may offer" in failed["reason"]
    assert offered["op"] == "advertised_service"
