"""Refused advertisements of services and actions in a real graph, with either executor."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import pytest
import pytest_twisted

from relay_protocol.errors import Invalid, NotFound
from robot_client.platforms.base import AdvertisementHandle
from robot_client.platforms.ros2.platform import Ros2Platform
from tests.robot_client.ros import Peer
from tests.worlds.ros_endpoints import seen


class Kind(NamedTuple):
    """A service or an action: how a node provides one, and how the platform advertises one."""

    name: str
    folder: str
    type: str
    theirs: tuple[str, str]
    offer: Callable[[Ros2Platform, str, str], AdvertisementHandle]


KINDS = [
    Kind(
        "service",
        "srv",
        "example_interfaces/srv/AddTwoInts",
        ("serve", "invert"),
        lambda ros, name, type: ros.advertise_service(name, type, lambda body, answer: None),
    ),
    Kind(
        "action",
        "action",
        "example_interfaces/action/Fibonacci",
        ("act", "count"),
        lambda ros, name, type: ros.advertise_action(name, type, lambda body, goal: None, lambda goal: None),
    ),
]


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
@pytest_twisted.ensureDeferred
async def test_failed_advertisement_has_the_reason(ros: Ros2Platform, peer: Peer, kind: Kind) -> None:
    """A name in use, an invalid name, an unknown type."""
    verb, how = kind.theirs
    taken = f"/taken_{kind.name}_{ros._nodes.kind}"
    peer.do(verb, taken, how)
    await seen(ros, lambda graph: taken in graph.services or taken in graph.actions)
    with pytest.raises(Invalid, match="/robot/peer provides it"):
        kind.offer(ros, taken, kind.type)
    ours = kind.offer(ros, f"/our_{kind.name}", kind.type)
    with pytest.raises(Invalid, match="another client of the relay advertises"):
        kind.offer(ros, f"our_{kind.name}", kind.type)
    ours.close()
    with pytest.raises(Invalid, match=f"not a valid {kind.name} name"):
        kind.offer(ros, "/not a name", kind.type)
    with pytest.raises(NotFound, match=f"no_such/{kind.folder}/Thing"):
        kind.offer(ros, "/free", f"no_such/{kind.folder}/Thing")
    with pytest.raises(Invalid, match=f"not one of the {kind.name}s"):
        kind.offer(ros, "/free", "std_msgs/msg/String")
