"""The robot of most tests."""

from __future__ import annotations

import pytest

from tests.worlds.foxglove_client import FoxgloveWorld


@pytest.fixture
def world() -> FoxgloveWorld:
    """A robot that is online."""
    made = FoxgloveWorld()
    made.robot_comes()
    return made
