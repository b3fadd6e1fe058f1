"""A relay's side of robot links, for tests of connections."""

from __future__ import annotations

import pytest

from relay_db import queries
from relay_protocol import identity
from relay_server.auth import passwords
from relay_server.common.database import AsyncDatabase
from tests.worlds.robot_links import FINGERPRINT, KEY, RobotLinkWorld


@pytest.fixture
def scene(store: AsyncDatabase) -> RobotLinkWorld:
    """A relay's side of robot links; its database has the key of r2-d2."""
    with store.database.begin() as session:
        robot = queries.add_robot(session, "r2-d2")
        code = passwords.token_hash(passwords.normalise_code("ABCD"))
        queries.issue_enrolment_code(session, robot.id, code, 2000.0)
        public = identity.public_half(KEY)
        queries.redeem_enrolment_code(session, "r2-d2", code, public, FINGERPRINT, "test", 1000.0)
    return RobotLinkWorld(store)
