"""What may be done is found out without doing it."""

from __future__ import annotations

import pytest
import pytest_twisted
from twisted.internet import reactor

from relay_db import queries
from relay_protocol.errors import NotFound, Refused
from relay_protocol.rights import Operation
from relay_server.http.negotiation import ConversionPool
from relay_server.http_sessions.pool import SessionPool
from relay_server.resources.service import RequestOrigin, RobotResourceService
from tests.relay_server.front_desk import HERE, Desk


@pytest_twisted.ensureDeferred
async def test_what_may_be_done_is_judged_as_it_is_now(front: Desk) -> None:
    """The relay's own services are open to all who have a right on the robot."""
    with front.store.database.begin() as session:
        queries.grant_right(session, front.rover.id, "viewer", user_id=front.ann.id)
    clock = front.world.clock
    guests = SessionPool(clock, front.desk, front.world.now_ns)
    # Not started: nothing of this takes long.
    desk = RobotResourceService(clock, guests, ConversionPool(reactor), front.world.now_ns, front.wall)
    ann = RequestOrigin(await front.by_token(front.ann), "rover", HERE)
    for name in ("reset", "/count", "/relays/stop"):
        with pytest.raises(Refused):
            await desk.may(ann, Operation.CALL, name)
    for name in ("relay/stop", "/rosapi/topics"):
        await desk.may(ann, Operation.CALL, name)
    with pytest.raises(Refused):
        await desk.may(ann, Operation.PUBLISH, "/relay/stop")
    with pytest.raises(NotFound):
        await desk.may(ann._replace(robot="hidden"), Operation.CALL, "relay/stop")
    assert not list(front.desk) and not front.access._permits
