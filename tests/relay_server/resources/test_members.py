"""One member of a collection is told as its page tells of it, to who may use it."""

from __future__ import annotations

import pytest
import pytest_twisted
from msgspec import structs
from twisted.internet import reactor

from relay_db import queries
from relay_protocol import link
from relay_protocol.errors import NotFound, Unavailable
from relay_server.http.negotiation import ConversionPool
from relay_server.http_sessions.pool import SessionPool
from relay_server.resources.page import PageQuery
from relay_server.resources.service import RequestOrigin, RobotResourceService
from tests.relay_server.front_desk import HERE, Desk
from tests.relay_server.memory import GRAPH


async def asking(front: Desk, *deny: str) -> tuple[RobotResourceService, RequestOrigin]:
    """A desk, and ann who asks there about her rover.

    :param deny: what she may not
    """
    with front.store.database.begin() as session:
        queries.grant_right(session, front.rover.id, "operator", deny=deny, user_id=front.ann.id)
    guests = SessionPool(front.world.clock, front.desk, front.world.now_ns)
    # Not started: nothing of this takes long.
    desk = RobotResourceService(
        front.world.clock, guests, ConversionPool(reactor), front.world.now_ns, front.wall
    )
    return desk, RequestOrigin(await front.by_token(front.ann), "rover", HERE)


@pytest_twisted.ensureDeferred
async def test_members_are_told_as_they_are_listed(front: Desk) -> None:
    """All of them, with and without their first slash."""
    counts = link.Service(types=["example_interfaces/action/Fibonacci"], providers=["/base"])
    front.world.robot_comes(graph=structs.replace(GRAPH, actions={"/counts": counts}))
    desk, ann = await asking(front)
    for kind in ("topics", "services", "actions"):
        listed = (await desk.members(ann, kind, PageQuery(limit=1000)))[kind]
        assert listed, kind
        for each in listed:
            assert await desk.member(ann, kind, each["name"]) == each
            assert await desk.member(ann, kind, each["name"][1:]) == each


@pytest_twisted.ensureDeferred
async def test_what_may_not_be_used_is_like_what_there_is_not(front: Desk) -> None:
    """In the same words; of a robot that is away nobody knows, but of the relay's own services."""
    front.world.robot_comes()
    desk, ann = await asking(front, "*:/reset")
    said = []
    for name in ("/reset", "/nowhere"):
        with pytest.raises(NotFound) as caught:
            await desk.member(ann, "services", name)
        said.append(str(caught.value).replace(name, "it"))
    assert said[0] == said[1] == "there is no service it on robot rover, or you have no right on it"
    with pytest.raises(NotFound):
        await desk.see(ann._replace(robot="hidden"))
    await desk.see(ann)
    front.world.robot_goes()
    with pytest.raises(Unavailable):
        await desk.member(ann, "services", "/nowhere")
    assert (await desk.member(ann, "services", "/relay/stop"))["types"] == ["switchboard_msgs/srv/Stop"]
