"""Alerts that the relay raises itself: links, batteries, stops, topics."""

from __future__ import annotations

import pytest

from relay_protocol import link
from relay_server.alerts import types as kinds
from relay_server.alerts.monitors import Monitors, Thresholds
from relay_server.control.actor import Actor
from relay_server.robots.registry import RobotState
from tests.worlds.relay import STRING, TWIST, Person, World, text

THRESHOLDS = Thresholds(silent=6.0, battery_low=0.2, battery_critical=0.1)


class RecordingSink:
    """Records open alerts and all events."""

    def __init__(self) -> None:
        self.reported: list[str] = []
        self.now: dict[tuple[str, str], str] = {}

    def raise_alert(self, robot: RobotState, kind: str, about: str, level: str, text: str) -> None:
        self.now[kind, about] = level
        self.reported.append(f"{kind} {about} {level}".replace("  ", " "))

    def end(self, robot: RobotState, kind: str, about: str = "") -> None:
        if self.now.pop((kind, about), None) is not None:
            self.reported.append(f"{kind} {about} over".replace("  ", " "))

    def level_of(self, robot: RobotState, kind: str, about: str = "") -> str | None:
        return self.now.get((kind, about))

    def ended_since(self, robot: RobotState, kind: str, at: float) -> bool:
        return False

    def parts_of(self, robot: RobotState, kind: str) -> list[str]:
        """Parts with an open alert of this kind."""
        return [about for each, about in self.now if each == kind]


class Scene:
    """A registry that the monitors check twice a second."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.sink = RecordingSink()
        self.monitors = Monitors(world.registry, world.channels, world.controllers, THRESHOLDS, self.sink)
        self.number = 0
        self.mute = False
        self.wall_step = 0.0
        self.people: list[Person] = []

    def goes_on(self, seconds: float, samples: int = 0) -> None:
        """Lets time pass, with this number of samples in each second."""
        for _ in range(int(seconds)):
            for _ in range(samples):
                self.world.channel.sample(self.number, text("x"))
            self.world.wait(1, *self.people)
            if self.world.robot.control_link is not None and not self.mute:
                self.world.registry.seen(self.world.robot)
            now = self.world.clock.seconds()
            self.monitors.check(now, 1.7e9 + now + self.wall_step)
            self.monitors.check_topics(now)

    def listens(self, topic: str = "/chatter", type: str = STRING, **more: object) -> None:
        """A client subscribes to a topic, and the robot confirms it."""
        self.person = self.world.at_work()
        self.people.append(self.person)
        self.person.says("subscribe", topic=topic, type=type, **more)
        asked = self.world.link.take(link.Subscribe)[-1]
        self.number = asked.number
        self.world.subscribed(self.number, type)


@pytest.fixture
def scene(world: World) -> Scene:
    """One robot that was never online."""
    return Scene(world)


# --- links ------------------------------------------------------------------------------------------------


def test_a_robot_without_a_link_is_offline_when_it_was_silent_for_three_heartbeats(scene: Scene) -> None:
    """The alert is raised once, and ends when the robot is back."""
    scene.world.robot_comes()
    scene.goes_on(2)
    scene.world.robot_goes()
    scene.goes_on(5)
    assert scene.sink.reported == []
    scene.goes_on(60)
    assert scene.sink.reported == ["offline error"]
    scene.world.robot_comes()
    scene.goes_on(1)
    assert scene.sink.reported == ["offline error", "offline over"]


def test_a_short_absence_raises_no_alert(scene: Scene) -> None:
    for _ in range(5):
        scene.world.robot_comes()
        scene.goes_on(3)
        scene.world.robot_goes()
        scene.goes_on(5)
    assert scene.sink.reported == []


def test_a_silent_robot_is_offline_though_it_has_a_link(scene: Scene) -> None:
    """Its link will be closed soon; the next message on it ends the alert."""
    scene.world.robot_comes()
    scene.goes_on(10)
    scene.mute = True
    scene.goes_on(5)
    assert scene.sink.reported == []
    scene.goes_on(2)
    assert scene.sink.reported == ["offline error"]
    scene.mute = False
    scene.goes_on(1)
    assert scene.sink.reported == ["offline error", "offline over"]


@pytest.mark.parametrize("step", [3600.0, -3600.0])
def test_setting_the_wall_clock_makes_no_robot_offline(scene: Scene, step: float) -> None:
    scene.world.robot_comes()
    scene.goes_on(10)
    scene.wall_step = step
    scene.mute = True
    scene.goes_on(4)
    assert scene.sink.reported == []
    scene.goes_on(4)
    assert scene.sink.reported == ["offline error"]


@pytest.mark.parametrize("cut", [False, True])
def test_a_stalled_relay_makes_no_robot_offline(scene: Scene, cut: bool) -> None:
    scene.world.robot_comes()
    scene.goes_on(3)
    scene.mute = True
    scene.world.clock.advance(30)
    if cut:
        scene.world.robot_goes()
    scene.goes_on(1)
    assert scene.sink.reported == []
    scene.goes_on(4)
    assert scene.sink.reported == []
    scene.goes_on(3)
    assert scene.sink.reported == ["offline error"]


def test_a_robot_that_was_never_online_raises_no_alert(scene: Scene) -> None:
    """It may only have been named in a request."""
    scene.goes_on(60)
    assert scene.sink.reported == []


# --- batteries --------------------------------------------------------------------------------------------


def test_the_last_that_a_robot_reported_of_its_battery_counts(scene: Scene) -> None:
    """It is empty when the link ends, before the next check."""
    scene.world.robot_comes()
    scene.goes_on(1)
    scene.world.robot.health = link.Health(battery=0.03)
    scene.world.robot_goes()
    scene.goes_on(1)
    assert scene.sink.reported == ["battery error"]


def test_a_battery_is_low_critical_and_well_again_with_hysteresis(scene: Scene) -> None:
    scene.world.robot_comes()
    for charge in (0.5, 0.21, 0.2, 0.21, 0.19, 0.22, 0.1, 0.11, 0.05, 0.24, 0.2499, 0.25, 0.24, None, 0.2):
        scene.world.robot.health = link.Health(battery=charge)
        scene.goes_on(1)
    assert scene.sink.reported == ["battery warning", "battery error", "battery over", "battery warning"]


def test_a_charge_that_is_none_raises_one_alert_until_there_is_a_right_one(scene: Scene) -> None:
    scene.world.robot_comes()
    scene.world.robot.impossible_charge = 57.0
    scene.goes_on(3)
    assert scene.sink.reported == ["battery warning"]
    scene.world.robot.impossible_charge = None
    scene.world.robot.health = link.Health(battery=0.57)
    scene.goes_on(1)
    assert scene.sink.reported == ["battery warning", "battery over"]


def test_batteries_are_not_looked_at_where_that_is_switched_off(scene: Scene) -> None:
    scene.monitors = Monitors(
        scene.world.registry,
        scene.world.channels,
        scene.world.controllers,
        Thresholds(6.0, 0.0, 0.0),
        scene.sink,
    )
    scene.world.robot_comes()
    scene.world.robot.health = link.Health(battery=0.0)
    scene.world.robot.impossible_charge = -1.0
    scene.goes_on(3)
    assert scene.sink.reported == []


# --- stops ------------------------------------------------------------------------------------------------


def test_a_reported_stop_raises_an_alert_without_an_event(scene: Scene) -> None:
    """The stop may have begun while the relay was away. The alert ends when the robot reports it no more."""
    scene.world.robot_comes()
    scene.goes_on(1)
    scene.world.robot.motion_state = link.MotionState(stopped=link.Stopped(by="ann", since=1.0, why="smoke"))
    scene.goes_on(3)
    assert scene.sink.reported == ["stop warning"]
    scene.world.robot.motion_state = link.MotionState()
    scene.goes_on(10)
    assert scene.sink.reported == ["stop warning", "stop over"]


def test_a_stop_is_not_over_because_the_robot_has_not_spoken_yet(scene: Scene) -> None:
    """The robot has some seconds after it registers, and is not asked while it is offline."""
    scene.sink.now["stop", ""] = "warning"
    scene.goes_on(60)
    scene.world.robot_comes()
    scene.goes_on(5)
    assert scene.sink.reported == []


def test_a_stop_is_not_over_while_the_robot_has_yet_to_confirm_it(scene: Scene) -> None:
    scene.world.robot_comes()
    scene.goes_on(30)
    scene.sink.now["stop", ""] = "warning"
    scene.world.control.obeys = None
    scene.world.controllers.of(scene.world.robot).stopping.stop(Actor("ann", "user:ann", 7), "")
    scene.goes_on(2)
    assert scene.sink.reported == []


# --- topics -----------------------------------------------------------------------------------------------


def test_a_topic_that_ceases_is_stale_until_it_comes_again(scene: Scene) -> None:
    scene.listens()
    scene.goes_on(20, samples=10)
    scene.goes_on(3)
    assert scene.sink.reported == []
    scene.goes_on(60)
    assert scene.sink.reported == ["stale /chatter warning"]
    scene.goes_on(1, samples=1)
    assert scene.sink.reported == ["stale /chatter warning", "stale /chatter over"]


def test_a_topic_without_subscribers_is_not_stale(scene: Scene) -> None:
    """Its alert ends as well."""
    scene.listens()
    scene.goes_on(20, samples=10)
    scene.goes_on(10)
    scene.person.says("unsubscribe", topic="/chatter")
    scene.goes_on(1)
    assert scene.sink.reported == ["stale /chatter warning", "stale /chatter over"]
    scene.goes_on(60)
    assert len(scene.sink.reported) == 2


def test_the_topics_of_a_robot_that_is_away_are_not_stale(scene: Scene) -> None:
    scene.listens()
    scene.goes_on(20, samples=10)
    scene.world.robot_goes()
    scene.goes_on(60)
    assert scene.sink.reported == ["offline error"]
    scene.sink.now["stale", "/chatter"] = "warning"
    scene.goes_on(10)
    assert scene.sink.reported == ["offline error"]


def test_while_the_link_is_silent_no_topic_is_stale(scene: Scene) -> None:
    scene.listens()
    scene.goes_on(20, samples=10)
    scene.mute = True
    scene.goes_on(30)
    assert scene.sink.reported == ["offline error"]
    scene.mute = False
    scene.goes_on(3)
    assert scene.sink.reported == ["offline error", "offline over"]
    scene.goes_on(1)
    assert scene.sink.reported == ["offline error", "offline over", "stale /chatter warning"]


def test_a_relay_that_stood_still_takes_no_topic_for_stale(scene: Scene) -> None:
    scene.listens()
    scene.goes_on(20, samples=10)
    scene.world.wait(10, *scene.people)
    scene.goes_on(3)
    assert scene.sink.reported == []
    scene.goes_on(2)
    assert scene.sink.reported == ["stale /chatter warning"]


def test_a_link_that_was_silent_for_a_moment_makes_no_topic_stale(scene: Scene) -> None:
    scene.listens()
    scene.goes_on(20, samples=10)
    scene.mute = True
    scene.goes_on(5)
    scene.mute = False
    scene.goes_on(2)
    scene.goes_on(20, samples=10)
    assert scene.sink.reported == []


@pytest.mark.parametrize("how", ["latched", "throttled", "motion", "inhibited", "ours", "log"])
def test_topics_that_may_pause_are_never_stale(scene: Scene, how: str) -> None:
    """These are latched, throttled, inhibited, command and log topics, and topics that clients publish."""
    topic, type_name = {"motion": ("/cmd_vel", TWIST), "log": ("/rosout", STRING)}.get(
        how, ("/chatter", STRING)
    )
    scene.listens(topic, type_name, **({"throttle_rate": 900} if how == "throttled" else {}))
    if how == "latched":
        scene.world.subscribed(scene.number, latched=True)
    if how == "ours":
        scene.person.says("advertise", topic="/chatter", type=STRING)
        number = scene.world.link.take(link.Advertise)[-1].number
        scene.world.channel.message(
            link.Advertised(number=number, topic="/chatter", type=STRING, encoding="cdr")
        )
    if how == "inhibited":
        scene.world.robot.motion_state = link.MotionState(
            inhibited=[link.Inhibited(resource="/chatter", ms=60000)]
        )
    scene.goes_on(20, samples=10)
    scene.goes_on(30)
    assert scene.sink.reported == []
    assert kinds.STALE not in {kind for kind, _ in scene.sink.now}


def test_a_robot_at_another_relay_is_not_offline(scene: Scene) -> None:
    """It has moved to that relay. When it is at no relay, the leading relay raises the alert."""
    robot = scene.world.robot
    robot.control_link, robot.elsewhere = None, True
    scene.goes_on(20)
    assert scene.sink.reported == []
    leads: list[bool] = []
    robot.elsewhere = False
    scene.monitors = Monitors(
        scene.world.registry,
        scene.world.channels,
        scene.world.controllers,
        THRESHOLDS,
        scene.sink,
        lambda: bool(leads),
    )
    scene.goes_on(20)
    assert scene.sink.reported == []
    leads.append(True)
    scene.goes_on(20)
    assert any("offline" in each for each in scene.sink.reported)
