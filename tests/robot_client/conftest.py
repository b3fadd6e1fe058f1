"""Settings for these tests, and a ROS domain of its own for each module that wants one."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from hypothesis import settings

from tests.robot_client.ros import domain

# A machine that is busy with something else must not fail a test.
settings.register_profile("unhurried", deadline=None)
settings.load_profile("unhurried")


@pytest.fixture(scope="module")
def environment() -> Iterator[dict[str, str]]:
    with domain() as found:
        yield found
