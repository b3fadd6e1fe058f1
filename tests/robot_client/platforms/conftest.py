"""The platform in a domain of its own for each module, with a node in another process."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from twisted.internet import reactor

from robot_client.platforms.ros2.platform import Ros2Platform
from tests.robot_client.ros import Peer


@pytest.fixture(scope="module")
def peer(environment: dict[str, str]) -> Iterator[Peer]:
    made = Peer(environment)
    yield made
    made.close()


@pytest.fixture(scope="module", params=["events", "single"])
def ros(request: pytest.FixtureRequest, environment: dict[str, str]) -> Iterator[Ros2Platform]:
    """The platform, with each of its executors."""
    made = Ros2Platform(reactor, "switchboard_test", guard="switchboard_guard_test", executor=request.param)
    made.start()
    yield made
    made.stop()
