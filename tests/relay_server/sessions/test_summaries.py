"""Summaries of robots."""

from __future__ import annotations

from typing import Any

import pytest
import pytest_twisted

from relay_db import queries
from relay_protocol import link
from relay_protocol.errors import NotFound
from relay_server.robots.link_quality import LinkQuality
from tests.worlds.relay import MemoryLink
from tests.worlds.session_manager import SessionsWorld


class Measured(MemoryLink):
    """A robot's link with a known round trip."""

    def link_quality(self) -> LinkQuality:
        """200 ms."""
        return LinkQuality(rtt=0.2, p95=0.25, jitter=0.01, recent_rtt=0.2, quality="fair")


@pytest_twisted.ensureDeferred
async def test_users_of_a_robot_are_shown_to_those_with_a_right(front: SessionsWorld) -> None:
    """Robots without a right and missing ones have the same error."""
    ann, _ = await front.logged_in()
    nobody = await front.service.overview.people(ann, "rover")
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
    robot = session.session.client.robot
    front.world.registry.registered(robot, Measured())
    robot.health = link.Health(battery=0.5, dropped_samples=3)
    reported: dict[str, Any] = await front.service.overview.people(ann, "rover")
    assert (reported["state"], reported["drops"], reported["battery"]) == ("in_use", 3, 0.5)
    assert (reported["link"]["rtt_ms"], reported["link"]["quality"]) == (200.0, "fair")
    (person,) = reported["people"]
    (connection,) = person["connections"]
    assert (person["user"], person["you"], connection["client"]) == (
        "ann",
        True,
        session.session.client.number,
    )
    assert (connection["robot_rtt_ms"], connection["quality"]) == (200.0, "good")
    for name in ("hidden", "nowhere"):
        with pytest.raises(NotFound, match="no such robot, or you have no right"):
            await front.service.overview.people(ann, name)
    session.end()


@pytest_twisted.ensureDeferred
async def test_the_list_of_robots_has_link_quality_and_counts(
    front: SessionsWorld,
) -> None:
    """By the median, not by the last ping."""
    ann, _ = await front.logged_in()
    session, _ = await front.opens(ann)
    other, _ = await front.opens(ann)
    front.world.registry.registered(session.session.client.robot, Measured())
    session.session.client.robot.rtt = 7.0
    (shown,) = await front.service.robots(ann)
    assert (shown["rtt_ms"], shown["quality"], shown["people"]) == (200.0, "fair", 1)
    session.end()
    other.end()
    front.world.registry.lost(session.session.client.robot, session.session.client.robot.control_link)  # type: ignore[arg-type]  # it has one
    (shown,) = await front.service.robots(ann)
    assert (shown["rtt_ms"], shown["quality"], shown["people"]) == (None, "lost", 0)


@pytest_twisted.ensureDeferred
async def test_the_charge_of_an_offline_robot_is_not_shown(front: SessionsWorld) -> None:
    """The old value may be wrong."""
    ann, _ = await front.logged_in()
    session, _ = await front.opens(ann)
    robot = session.session.client.robot
    front.world.registry.registered(robot, Measured())
    robot.health = link.Health(battery=0.5)

    async def reported() -> list[object]:
        (listed,), people, (shown,) = (
            await front.service.robots(ann),
            await front.service.overview.people(ann, "rover"),
            front.service.status(),
        )
        return [
            listed["battery"],
            people["battery"],
            shown["battery"],
            (shown["health"] or {}).get("battery"),
        ]

    assert await reported() == [0.5] * 4
    front.world.registry.lost(robot, robot.control_link)  # type: ignore[arg-type]  # it has one
    assert await reported() == [None] * 4
    session.end()


@pytest_twisted.ensureDeferred
async def test_the_administrator_sees_every_link(front: SessionsWorld) -> None:
    """Links of robots and clients, with dropped messages."""
    ann, _ = await front.logged_in()
    session, client = await front.opens(ann)
    front.world.registry.registered(session.session.client.robot, Measured())
    front.world.clock.advance(0.02)
    session.pong(client.pings[0])
    (shown,) = front.service.status()
    assert (shown["link"]["quality"], shown["drops"]) == ("fair", 0)
    (there,) = shown["clients"]
    assert (there["link"]["quality"], there["link"]["rtt_ms"], there["robot_rtt_ms"]) == ("good", 20.0, 220.0)
    assert len(await front.store.read(queries.list_robots)) == 2
    session.end()


@pytest_twisted.ensureDeferred
async def test_overrides_of_topics_are_listed(front: SessionsWorld) -> None:
    """Topics without a right are left out; the administrator sees all."""
    ann, _ = await front.logged_in()
    session, _ = await front.opens(ann)
    front.world.registry.registered(session.session.client.robot, Measured())
    session.session.client.robot.motion_state = link.MotionState(
        suppressed=[link.Suppressed(resource="/cmd_vel", sources=[9], by="runaway", ms=100)],
        inhibited=[link.Inhibited(resource="/secret", hold=True, by="olga", ms=900)],
    )
    commands = [{"resource": "/cmd_vel", "by": "runaway", "hold": False}]
    holds = [{"resource": "/secret", "by": "olga", "hold": True}]
    for deny, seen in (((), holds), (("*:/secret",), [])):
        with front.store.database.begin() as s:
            queries.grant_right(s, front.rover.id, "operator", user_id=ann.user_id, deny=deny)
        await front.access.refresh()
        (reported,) = await front.service.overview.robots(ann)
        assert (reported["suppressed"], reported["inhibited"]) == (commands, seen)
    (known,) = front.service.overview.status()
    assert (known["suppressed"], known["inhibited"]) == (commands, holds)
    session.end()
