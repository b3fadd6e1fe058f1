"""Robots as resources: pages of them, and when one is another than it was."""

from __future__ import annotations

from typing import Any, cast

import pytest
import pytest_twisted

from relay_protocol.errors import NotFound
from relay_server.access import Principal
from relay_server.resources.page import PageQuery
from relay_server.resources.robots import RobotService, robot_tag, robots_tag

ANN = Principal(1, "ann", "main", False, 1, None)


def robot(name: str, **more: Any) -> dict[str, Any]:
    """What is told of a robot."""
    return {"name": name, "state": "online", "rtt_ms": 1.0, "last_seen": 2.0, **more}


class Overview:
    """Knows three robots."""

    async def robots(self, principal: Principal) -> list[dict[str, Any]]:
        """In no order."""
        return [robot(each) for each in ("rover", "arm", "rex")]


@pytest_twisted.ensureDeferred
async def test_a_page_is_in_the_order_of_names_and_says_where_the_next_begins() -> None:
    """Shell wildcards name what is meant."""
    desk = RobotService(Overview())

    async def names(**asked: str) -> tuple[list[str], str]:
        page = await desk.members(ANN, PageQuery.of(asked, typed=False))
        return [each["name"] for each in page["robots"]], cast(str, page["next"])

    assert await names() == (["arm", "rex", "rover"], "")
    assert await names(name="r*") == (["rex", "rover"], "")
    assert await names(limit="2") == (["arm", "rex"], "rex")
    assert await names(limit="2", after="rex") == (["rover"], "")


@pytest_twisted.ensureDeferred
async def test_one_is_found_by_its_whole_name() -> None:
    """There are no wildcards in an address."""
    desk = RobotService(Overview())
    assert (await desk.robot(ANN, "arm"))["name"] == "arm"
    for other in ("a*", "tank"):
        with pytest.raises(NotFound):
            await desk.robot(ANN, other)


def test_a_ping_makes_no_other_robot_of_it() -> None:
    """Whatever else is told of it does."""
    known = robot_tag(robot("rover"))
    assert robot_tag(robot("rover", rtt_ms=5.0, last_seen=9.0)) == known
    assert robot_tag(robot("rover", state="offline")) != known
    page = {"robots": [robot("rover")], "next": ""}
    assert robots_tag({**page, "robots": [robot("rover", rtt_ms=None)]}) == robots_tag(page)
    assert robots_tag({**page, "next": "rover"}) != robots_tag(page)
