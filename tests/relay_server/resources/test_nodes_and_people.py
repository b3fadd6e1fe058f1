"""A single member equals its entry on the page, for clients with the right."""

from __future__ import annotations

import pytest
import pytest_twisted
from msgspec import structs
from twisted.internet import reactor

from relay_db import queries
from relay_protocol import link
from relay_protocol.errors import NotFound, Unavailable
from relay_server.in_process_sessions.pool import InProcessSessionPool, RobotCaller
from relay_server.resources.page import TypedPageQuery
from relay_server.resources.representations import ConversionPool
from relay_server.resources.service import RobotResourceService
from tests.worlds.relay import GRAPH
from tests.worlds.session_manager import HERE, SessionsWorld


async def asking(front: SessionsWorld, *deny: str) -> tuple[RobotResourceService, RobotCaller]:
    """A resource service, and ann's requests about her rover.

    :param deny: names that she may not use
    """
    with front.store.database.begin() as session:
        queries.grant_right(session, front.rover.id, "operator", deny=deny, user_id=front.ann.id)
    pool = InProcessSessionPool(front.world.clock, front.service)
    # The pool is not started: nothing in these tests takes long.
    service = RobotResourceService(
        front.world.clock, pool, ConversionPool(reactor), front.world.now_ns, front.wall
    )
    return service, RobotCaller(await front.by_token(front.ann), "rover", HERE)


@pytest_twisted.ensureDeferred
async def test_members_are_described_as_they_are_listed(front: SessionsWorld) -> None:
    """All of them, with and without their leading slash."""
    counts = link.Service(types=["example_interfaces/action/Fibonacci"], providers=["/base"])
    front.world.robot_comes(graph=structs.replace(GRAPH, actions={"/counts": counts}))
    service, ann = await asking(front)
    for kind in ("topics", "services", "actions"):
        listed = (await service.members(ann, kind, TypedPageQuery(limit=1000)))[kind]
        assert listed, kind
        for each in listed:
            assert await service.member(ann, kind, each["name"]) == each
            assert await service.member(ann, kind, each["name"][1:]) == each


@pytest_twisted.ensureDeferred
async def test_forbidden_resource_is_like_a_missing_one(front: SessionsWorld) -> None:
    """The errors are equal; an offline robot has only the relay's own services."""
    front.world.robot_comes()
    service, ann = await asking(front, "*:/reset")
    said = []
    for name in ("/reset", "/nowhere"):
        with pytest.raises(NotFound) as caught:
            await service.member(ann, "services", name)
        said.append(str(caught.value).replace(name, "it"))
    assert said[0] == said[1] == "there is no service it on robot rover, or you have no right on it"
    with pytest.raises(NotFound):
        await service.check_may_know(ann._replace(robot="hidden"))
    await service.check_may_know(ann)
    front.world.robot_goes()
    with pytest.raises(Unavailable):
        await service.member(ann, "services", "/nowhere")
    assert (await service.member(ann, "services", "/relay/stop"))["types"] == ["switchboard_msgs/srv/Stop"]
