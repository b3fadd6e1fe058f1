"""Checks of rights without carrying out the operation."""

from __future__ import annotations

import pytest
import pytest_twisted
from twisted.internet import reactor

from relay_db import queries
from relay_protocol.errors import NotFound, Refused
from relay_protocol.rights import Operation
from relay_server.in_process_sessions.pool import InProcessSessionPool, RobotCaller
from relay_server.resources.representations import ConversionPool
from relay_server.resources.service import RobotResourceService
from tests.worlds.session_manager import HERE, SessionsWorld


@pytest_twisted.ensureDeferred
async def test_rights_are_checked_as_they_are_now(front: SessionsWorld) -> None:
    """The relay's own services are open to all users with a right on the robot."""
    with front.store.database.begin() as session:
        queries.grant_right(session, front.rover.id, "viewer", user_id=front.ann.id)
    clock = front.world.clock
    pool = InProcessSessionPool(clock, front.service)
    # The pool is not started: nothing in these tests takes long.
    service = RobotResourceService(clock, pool, ConversionPool(reactor), front.world.now_ns, front.wall)
    ann = RobotCaller(await front.by_token(front.ann), "rover", HERE)
    for name in ("reset", "/count", "/relays/stop"):
        with pytest.raises(Refused):
            await service.may(ann, Operation.CALL, name)
    for name in ("relay/stop", "/rosapi/topics"):
        await service.may(ann, Operation.CALL, name)
    with pytest.raises(Refused):
        await service.may(ann, Operation.PUBLISH, "/relay/stop")
    with pytest.raises(NotFound):
        await service.may(ann._replace(robot="hidden"), Operation.CALL, "relay/stop")
    assert not list(front.service) and not front.access._permits


@pytest_twisted.ensureDeferred
async def test_images_need_the_right_to_view(front: SessionsWorld) -> None:
    """The type of the topic is not known, so it may be one of images. HEAD of a stream asks this."""
    with front.store.database.begin() as session:
        queries.grant_right(
            session,
            front.rover.id,
            "viewer",
            user_id=front.ann.id,
            deny=["view:/front/**", "subscribe:/secret"],
        )
    pool = InProcessSessionPool(front.world.clock, front.service)
    service = RobotResourceService(
        front.world.clock, pool, ConversionPool(reactor), front.world.now_ns, front.wall
    )
    ann = RobotCaller(await front.by_token(front.ann), "rover", HERE)
    for name in ("front/image", "secret"):
        with pytest.raises(Refused):
            await service.check_may_subscribe(ann, name)
    await service.check_may_subscribe(ann, "chatter")
    with pytest.raises(NotFound):
        await service.check_may_subscribe(ann._replace(robot="hidden"), "chatter")
    assert not list(front.service) and not front.access._permits
