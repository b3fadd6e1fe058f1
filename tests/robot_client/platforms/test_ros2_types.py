"""Types of ROS 2 by name."""

from __future__ import annotations

import itertools

import pytest

from relay_protocol.errors import Invalid
from robot_client.platforms.ros2_types import Types

KINDS = {
    "message": "std_msgs/msg/String",
    "service": "std_srvs/srv/Trigger",
    "action": "example_interfaces/action/Fibonacci",
}


@pytest.mark.parametrize(("kind", "other"), itertools.permutations(KINDS, 2))
def test_a_type_known_as_one_kind_is_no_other(kind: str, other: str) -> None:
    """Its library would end the process where another kind is wanted."""
    types = Types()
    getattr(types, kind)(KINDS[kind])
    with pytest.raises(Invalid, match=f"{KINDS[kind]} is no type of "):
        getattr(types, other)(KINDS[kind])
