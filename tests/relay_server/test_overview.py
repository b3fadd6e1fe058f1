"""What is told of robots."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import pytest_twisted

from relay_db import queries
from relay_protocol import link
from relay_protocol.errors import NotFound
from relay_server.linkmeter import Reading
from relay_server.store import Store
from tests.relay_server.memory import MemoryLink
from tests.relay_server.test_frontdesk import Desk


class Measured(MemoryLink):
    """A robot's link with a known round trip."""

    def reading(self) -> Reading:
        """A fifth of a second."""
        return Reading(rtt=0.2, p95=0.25, jitter=0.01, lately=0.2, quality="fair")


@pytest.fixture
def front(store: Store) -> Iterator[Desk]:
    """A desk with ann, who operates rover and knows nothing of hidden."""
    made = Desk(store)
    yield made
    made.auth.stop()


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
