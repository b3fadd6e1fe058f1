"""What is told of robots."""

from __future__ import annotations

from typing import Any

import pytest
import pytest_twisted

from relay_db import queries
from relay_protocol import link
from relay_protocol.errors import NotFound
from relay_server.robots.link_quality import LinkQuality
from tests.relay_server.front_desk import Desk
from tests.relay_server.memory import MemoryLink


class Measured(MemoryLink):
    """A robot's link with a known round trip."""

    def reading(self) -> LinkQuality:
        """A fifth of a second."""
        return LinkQuality(rtt=0.2, p95=0.25, jitter=0.01, lately=0.2, quality="fair")


@pytest_twisted.ensureDeferred
async def test_who_is_at_a_robot_is_told_to_who_has_a_right_on_it(front: Desk) -> None:
    """Robots without a right and robots that are not there are told in the same words."""
    ann, _ = await front.logged_in()
    nobody = await front.desk.overview.people(ann, "rover")
    assert nobody == {
        "robot": "rover",
        "state": "offline",
        "link": {"rtt_ms": None, "p95_ms": None, "jitter_ms": None, "lost": 0, "quality": "lost"},
        "drops": None,
        "battery": None,
        "people": [],
        "more": 0,
    }
    session, client = await front.opens(ann)
    session.pong(client.pings[-1])
    robot = session.robot
    front.world.registry.registered(robot, Measured())
    robot.health = link.Health(battery=0.5, dropped_samples=3)
    told: dict[str, Any] = await front.desk.overview.people(ann, "rover")
    assert (told["state"], told["drops"], told["battery"]) == ("in_use", 3, 0.5)
    assert (told["link"]["rtt_ms"], told["link"]["quality"]) == (200.0, "fair")
    (person,) = told["people"]
    (connection,) = person["connections"]
    assert (person["user"], person["you"], connection["client"]) == ("ann", True, session.number)
    assert (connection["robot_rtt_ms"], connection["quality"]) == (200.0, "good")
    for name in ("hidden", "nowhere"):
        with pytest.raises(NotFound, match="no such robot, or you have no right"):
            await front.desk.overview.people(ann, name)
    session.end()


@pytest_twisted.ensureDeferred
async def test_the_list_of_robots_tells_how_good_links_are_and_how_many_are_there(front: Desk) -> None:
    """By the median, not by the last ping alone."""
    ann, _ = await front.logged_in()
    session, _ = await front.opens(ann)
    other, _ = await front.opens(ann)
    front.world.registry.registered(session.robot, Measured())
    session.robot.rtt = 7.0
    (shown,) = await front.desk.robots(ann)
    assert (shown["rtt_ms"], shown["quality"], shown["people"]) == (200.0, "fair", 1)
    session.end()
    other.end()
    front.world.registry.lost(session.robot, session.robot.control)  # type: ignore[arg-type]  # it has one
    (shown,) = await front.desk.robots(ann)
    assert (shown["rtt_ms"], shown["quality"], shown["people"]) == (None, "lost", 0)


@pytest_twisted.ensureDeferred
async def test_the_charge_of_a_robot_that_is_away_is_not_told(front: Desk) -> None:
    """To nobody: what it had before it went is not what it has."""
    ann, _ = await front.logged_in()
    session, _ = await front.opens(ann)
    robot = session.robot
    front.world.registry.registered(robot, Measured())
    robot.health = link.Health(battery=0.5)

    async def told() -> list[object]:
        (listed,), people, (shown,) = (
            await front.desk.robots(ann),
            await front.desk.overview.people(ann, "rover"),
            front.desk.status(),
        )
        return [
            listed["battery"],
            people["battery"],
            shown["battery"],
            (shown["health"] or {}).get("battery"),
        ]

    assert await told() == [0.5] * 4
    front.world.registry.lost(robot, robot.control)  # type: ignore[arg-type]  # it has one
    assert await told() == [None] * 4
    session.end()


@pytest_twisted.ensureDeferred
async def test_the_administrator_sees_every_link(front: Desk) -> None:
    """The robot's, and those of its clients, with what was dropped."""
    ann, _ = await front.logged_in()
    session, client = await front.opens(ann)
    front.world.registry.registered(session.robot, Measured())
    front.world.clock.advance(0.02)
    session.pong(client.pings[0])
    (shown,) = front.desk.status()
    assert (shown["link"]["quality"], shown["drops"]) == ("fair", 0)
    (there,) = shown["clients"]
    assert (there["link"]["quality"], there["link"]["rtt_ms"], there["robot_rtt_ms"]) == ("good", 20.0, 220.0)
    assert len(await front.store.read(queries.list_robots)) == 2
    session.end()


@pytest_twisted.ensureDeferred
async def test_who_has_a_hand_on_topics_is_told(front: Desk) -> None:
    """Whom one may not know of a topic of is not told; the administrator is told of all."""
    ann, _ = await front.logged_in()
    session, _ = await front.opens(ann)
    front.world.registry.registered(session.robot, Measured())
    session.robot.safety = link.Safety(
        suppressed=[link.Suppressed(resource="/cmd_vel", sources=[9], by="runaway", ms=100)],
        inhibited=[link.Inhibited(resource="/secret", hold=True, by="olga", ms=900)],
    )
    commands = [{"resource": "/cmd_vel", "by": "runaway", "hold": False}]
    holds = [{"resource": "/secret", "by": "olga", "hold": True}]
    for deny, seen in (((), holds), (("*:/secret",), [])):
        with front.store.database.begin() as s:
            queries.grant_right(s, front.rover.id, "operator", user_id=ann.user_id, deny=deny)
        await front.access.refresh()
        (told,) = await front.desk.overview.robots(ann)
        assert (told["suppressed"], told["inhibited"]) == (commands, seen)
    (known,) = front.desk.overview.status()
    assert (known["suppressed"], known["inhibited"]) == (commands, holds)
    session.end()
