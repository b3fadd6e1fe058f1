"""Robots as resources: their pages, and their entity tags."""

from __future__ import annotations

from typing import Any, cast

import pytest
import pytest_twisted

from relay_protocol.errors import NotFound
from relay_server.access import Principal
from relay_server.http.router import decode_query
from relay_server.resources.page import PageQuery
from relay_server.resources.robots_http import RobotService, robot_tag, robots_tag

ANN = Principal(1, "ann", "main", False, 1, None)


def robot(name: str, **more: Any) -> dict[str, Any]:
    """A robot in its JSON form."""
    return {"name": name, "state": "online", "rtt_ms": 1.0, "last_seen": 2.0, **more}


class Overview:
    """Has three robots."""

    async def robots(self, principal: Principal) -> list[dict[str, Any]]:
        """In no order."""
        return [robot(each) for each in ("rover", "arm", "rex")]


@pytest_twisted.ensureDeferred
async def test_a_page_is_ordered_by_name_and_has_a_cursor() -> None:
    """Each page has a cursor; shell wildcards filter names."""
    robots = RobotService(Overview())

    async def names(**asked: str) -> tuple[list[str], str]:
        page = await robots.members(ANN, decode_query(asked, PageQuery))
        return [each["name"] for each in page["robots"]], cast(str, page["next"])

    assert await names() == (["arm", "rex", "rover"], "")
    assert await names(name="r*") == (["rex", "rover"], "")
    assert await names(limit="2") == (["arm", "rex"], "rex")
    assert await names(limit="2", after="rex") == (["rover"], "")


@pytest_twisted.ensureDeferred
async def test_entry_is_found_by_its_whole_name() -> None:
    """An address has no wildcards."""
    robots = RobotService(Overview())
    assert (await robots.robot(ANN, "arm"))["name"] == "arm"
    for other in ("a*", "tank"):
        with pytest.raises(NotFound):
            await robots.robot(ANN, other)


def test_a_ping_makes_no_other_robot_of_it() -> None:
    """Any other change changes the tag."""
    known = robot_tag(robot("rover"))
    assert robot_tag(robot("rover", rtt_ms=5.0, last_seen=9.0)) == known
    assert robot_tag(robot("rover", state="offline")) != known
    page = {"robots": [robot("rover")], "next": ""}
    assert robots_tag({**page, "robots": [robot("rover", rtt_ms=None)]}) == robots_tag(page)
    assert robots_tag({**page, "next": "rover"}) != robots_tag(page)
