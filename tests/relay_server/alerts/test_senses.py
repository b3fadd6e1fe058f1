"""What the relay sees for itself of robots: links, batteries, stops, topics."""

from __future__ import annotations

import pytest

from relay_protocol import link
from relay_server.alerts import types as kinds
from relay_server.alerts.monitors import Monitors, Thresholds
from relay_server.control.audit import Actor
from relay_server.robots.registry import RobotState
from tests.relay_server.memory import STRING, TWIST, Person, World, text

THRESHOLDS = Thresholds(silent=6.0, battery_low=0.2, battery_critical=0.1)


class Ear:
    """Remembers what lasts, and all that was told."""

    def __init__(self) -> None:
        self.told: list[str] = []
        self.now: dict[tuple[str, str], str] = {}

    def tell(self, robot: RobotState, kind: str, about: str, level: str, text: str) -> None:
        """Something is wrong."""
        self.now[kind, about] = level
        self.told.append(f"{kind} {about} {level}".replace("  ", " "))

    def over(self, robot: RobotState, kind: str, about: str = "") -> None:
        """It is well again."""
        if self.now.pop((kind, about), None) is not None:
            self.told.append(f"{kind} {about} over".replace("  ", " "))

    def lasts(self, robot: RobotState, kind: str, about: str = "") -> str | None:
        """Its level."""
        return self.now.get((kind, about))

    def lasting(self, robot: RobotState, kind: str) -> list[str]:
        """What those of a kind are about."""
        return [about for each, about in self.now if each == kind]


class Scene:
    """A world that is looked at twice a second."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.ear = Ear()
        self.senses = Monitors(world.registry, world.channels, world.desks, THRESHOLDS, self.ear)
        self.number = 0
        self.mute = False
        self.wall_step = 0.0
        self.people: list[Person] = []

    def goes_on(self, seconds: float, samples: int = 0) -> None:
        """Time passes, and so many samples come in each second of it."""
        for _ in range(int(seconds)):
            for _ in range(samples):
                self.world.channel.sample(self.number, text("x"))
            self.world.wait(1, *self.people)
            if self.world.robot.control is not None and not self.mute:
                self.world.registry.seen(self.world.robot)
            now = self.world.clock.seconds()
            self.senses.look(now, 1.7e9 + now + self.wall_step)
            self.senses.look_at_topics(now)

    def listens(self, topic: str = "/chatter", type: str = STRING, **more: object) -> None:
        """Somebody subscribes to a topic, and the robot confirms it."""
        self.person = self.world.at_work()
        self.people.append(self.person)
        self.person.says("subscribe", topic=topic, type=type, **more)
        asked = self.world.link.take(link.Subscribe)[-1]
        self.number = asked.number
        self.world.subscribed(self.number, type)


@pytest.fixture
def scene(world: World) -> Scene:
    """One robot, offline since ever."""
    return Scene(world)


# --- links ------------------------------------------------------------------------------------------------


def test_a_robot_without_a_link_is_offline_when_it_was_silent_for_three_heartbeats(scene: Scene) -> None:
    """Once; and it is over when it is back."""
    scene.world.robot_comes()
    scene.goes_on(2)
    scene.world.robot_goes()
    scene.goes_on(5)
    assert scene.ear.told == []
    scene.goes_on(60)
    assert scene.ear.told == ["offline error"]
    scene.world.robot_comes()
    scene.goes_on(1)
    assert scene.ear.told == ["offline error", "offline over"]


def test_a_robot_that_is_back_in_time_is_nothing_to_tell(scene: Scene) -> None:
    """Networks hiccup."""
    for _ in range(5):
        scene.world.robot_comes()
        scene.goes_on(3)
        scene.world.robot_goes()
        scene.goes_on(5)
    assert scene.ear.told == []


def test_a_robot_that_says_nothing_is_offline_though_it_has_a_link(scene: Scene) -> None:
    """The link is about to be closed; what comes by it ends the alert."""
    scene.world.robot_comes()
    scene.goes_on(10)
    scene.mute = True
    scene.goes_on(5)
    assert scene.ear.told == []
    scene.goes_on(2)
    assert scene.ear.told == ["offline error"]
    scene.mute = False
    scene.goes_on(1)
    assert scene.ear.told == ["offline error", "offline over"]


@pytest.mark.parametrize("step", [3600.0, -3600.0])
def test_a_wall_clock_that_is_set_makes_nobody_offline(scene: Scene, step: float) -> None:
    """Nor keeps anybody from being."""
    scene.world.robot_comes()
    scene.goes_on(10)
    scene.wall_step = step
    scene.mute = True
    scene.goes_on(4)
    assert scene.ear.told == []
    scene.goes_on(4)
    assert scene.ear.told == ["offline error"]


@pytest.mark.parametrize("cut", [False, True])
def test_a_relay_that_stood_still_takes_nobody_for_offline(scene: Scene, cut: bool) -> None:
    """What robots said meanwhile is not read yet, or their links were cut at once; who stays silent is told."""
    scene.world.robot_comes()
    scene.goes_on(3)
    scene.mute = True
    scene.world.clock.advance(30)
    if cut:
        scene.world.robot_goes()
    scene.goes_on(1)
    assert scene.ear.told == []
    scene.goes_on(4)
    assert scene.ear.told == []
    scene.goes_on(3)
    assert scene.ear.told == ["offline error"]


def test_a_robot_nobody_has_seen_is_not_missed(scene: Scene) -> None:
    """It may have been asked for only."""
    scene.goes_on(60)
    assert scene.ear.told == []


# --- batteries --------------------------------------------------------------------------------------------


def test_a_battery_is_low_critical_and_well_again_with_room_between(scene: Scene) -> None:
    """A charge that wavers at a threshold tells nothing again."""
    scene.world.robot_comes()
    for charge in (0.5, 0.21, 0.2, 0.21, 0.19, 0.22, 0.1, 0.11, 0.05, 0.24, 0.2499, 0.25, 0.24, None, 0.2):
        scene.world.robot.health = link.Health(battery=charge)
        scene.goes_on(1)
    assert scene.ear.told == ["battery warning", "battery error", "battery over", "battery warning"]


def test_batteries_are_not_looked_at_where_that_is_switched_off(scene: Scene) -> None:
    """Not even an empty one is told."""
    scene.senses = Monitors(
        scene.world.registry, scene.world.channels, scene.world.desks, Thresholds(6.0, 0.0, 0.0), scene.ear
    )
    scene.world.robot_comes()
    scene.world.robot.health = link.Health(battery=0.0)
    scene.goes_on(3)
    assert scene.ear.told == []


# --- stops ------------------------------------------------------------------------------------------------


def test_a_robot_that_says_it_is_stopped_is_told_also_when_nobody_saw_it_happen(scene: Scene) -> None:
    """It may have been while the relay was away; and it is over when the robot says no more of it."""
    scene.world.robot_comes()
    scene.goes_on(1)
    scene.world.robot.safety = link.Safety(stopped=link.Stopped(by="ann", since=1.0, why="smoke"))
    scene.goes_on(3)
    assert scene.ear.told == ["stop warning"]
    scene.world.robot.safety = link.Safety()
    scene.goes_on(10)
    assert scene.ear.told == ["stop warning", "stop over"]


def test_a_stop_is_not_over_because_the_robot_has_not_spoken_yet(scene: Scene) -> None:
    """It is given some seconds after it came, and is not asked while it is away."""
    scene.ear.now["stop", ""] = "warning"
    scene.goes_on(60)
    scene.world.robot_comes()
    scene.goes_on(5)
    assert scene.ear.told == []


def test_a_stop_is_not_over_while_the_robot_has_yet_to_confirm_it(scene: Scene) -> None:
    """Whoever looks between the order and the robot's word sees a robot that is being stopped."""
    scene.world.robot_comes()
    scene.goes_on(30)
    scene.ear.now["stop", ""] = "warning"
    scene.world.control.obeys = None
    scene.world.desks.of(scene.world.robot).stopping.stop(Actor("ann", "user:ann", 7), "")
    scene.goes_on(2)
    assert scene.ear.told == []


# --- topics -----------------------------------------------------------------------------------------------


def test_a_topic_that_ceases_is_stale_until_it_comes_again(scene: Scene) -> None:
    """By name."""
    scene.listens()
    scene.goes_on(20, samples=10)
    scene.goes_on(3)
    assert scene.ear.told == []
    scene.goes_on(60)
    assert scene.ear.told == ["stale /chatter warning"]
    scene.goes_on(1, samples=1)
    assert scene.ear.told == ["stale /chatter warning", "stale /chatter over"]


def test_a_topic_nobody_listens_to_any_more_is_not_stale(scene: Scene) -> None:
    """Its alert is over as well."""
    scene.listens()
    scene.goes_on(20, samples=10)
    scene.goes_on(10)
    scene.person.says("unsubscribe", topic="/chatter")
    scene.goes_on(1)
    assert scene.ear.told == ["stale /chatter warning", "stale /chatter over"]
    scene.goes_on(60)
    assert len(scene.ear.told) == 2


def test_the_topics_of_a_robot_that_is_away_are_not_stale(scene: Scene) -> None:
    """That it is offline says it all; what was stale stays so until more is known."""
    scene.listens()
    scene.goes_on(20, samples=10)
    scene.world.robot_goes()
    scene.goes_on(60)
    assert scene.ear.told == ["offline error"]
    scene.ear.now["stale", "/chatter"] = "warning"
    scene.goes_on(10)
    assert scene.ear.told == ["offline error"]


def test_while_the_link_is_silent_no_topic_is_stale(scene: Scene) -> None:
    """The robot may be away, and then that is what there is to tell."""
    scene.listens()
    scene.goes_on(20, samples=10)
    scene.mute = True
    scene.goes_on(30)
    assert scene.ear.told == ["offline error"]
    scene.mute = False
    scene.goes_on(3)
    assert scene.ear.told == ["offline error", "offline over"]
    scene.goes_on(1)
    assert scene.ear.told == ["offline error", "offline over", "stale /chatter warning"]


def test_a_relay_that_stood_still_takes_no_topic_for_stale(scene: Scene) -> None:
    """What came meanwhile is not read yet; what does not come then is."""
    scene.listens()
    scene.goes_on(20, samples=10)
    scene.world.wait(10, *scene.people)
    scene.goes_on(3)
    assert scene.ear.told == []
    scene.goes_on(2)
    assert scene.ear.told == ["stale /chatter warning"]


def test_a_link_that_was_silent_for_a_moment_makes_no_topic_stale(scene: Scene) -> None:
    """What comes again with it never ceased."""
    scene.listens()
    scene.goes_on(20, samples=10)
    scene.mute = True
    scene.goes_on(5)
    scene.mute = False
    scene.goes_on(2)
    scene.goes_on(20, samples=10)
    assert scene.ear.told == []


@pytest.mark.parametrize("how", ["latched", "throttled", "motion", "inhibited", "ours", "log"])
def test_what_may_pause_is_never_stale(scene: Scene, how: str) -> None:
    """Latched, thinned out, commands, what is inhibited, what clients say themselves, logs."""
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
        scene.world.robot.safety = link.Safety(inhibited=[link.Inhibited(resource="/chatter", ms=60000)])
    scene.goes_on(20, samples=10)
    scene.goes_on(30)
    assert scene.ear.told == []
    assert kinds.STALE not in {kind for kind, _ in scene.ear.now}
