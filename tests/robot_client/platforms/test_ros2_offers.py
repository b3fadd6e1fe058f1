"""What the platform offers to a real graph, and what it can't, with either executor."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import pytest
import pytest_twisted

from relay_protocol.errors import Invalid, NotFound
from robot_client.platforms.base import AdvertisementHandle
from robot_client.platforms.ros2.platform import Ros2Platform
from tests.robot_client.platforms.ends import seen
from tests.robot_client.ros import Peer


class Kind(NamedTuple):
    """A service or an action: how a node offers one, and how we do."""

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
        lambda ros, name, type: ros.serve(name, type, lambda body, answer: None),
    ),
    Kind(
        "action",
        "action",
        "example_interfaces/action/Fibonacci",
        ("act", "count"),
        lambda ros, name, type: ros.act(name, type, lambda body, goal: None, lambda goal: None),
    ),
]


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
@pytest_twisted.ensureDeferred
async def test_what_can_not_be_offered_is_said(ros: Ros2Platform, peer: Peer, kind: Kind) -> None:
    """What another node has, what is offered already, a bad name and an unknown type are refused in words."""
    verb, how = kind.theirs
    taken = f"/taken_{kind.name}_{ros._nodes.kind}"
    peer.do(verb, taken, how)
    await seen(ros, lambda graph: taken in graph.services or taken in graph.actions)
    with pytest.raises(Invalid, match="/robot/peer offers it"):
        kind.offer(ros, taken, kind.type)
    ours = kind.offer(ros, f"/our_{kind.name}", kind.type)
    with pytest.raises(Invalid, match="somebody at the relay offers"):
        kind.offer(ros, f"our_{kind.name}", kind.type)
    ours.close()
    with pytest.raises(Invalid, match=f"no {kind.name} name"):
        kind.offer(ros, "/not a name", kind.type)
    with pytest.raises(NotFound, match=f"no_such/{kind.folder}/Thing"):
        kind.offer(ros, "/free", f"no_such/{kind.folder}/Thing")
    with pytest.raises(Invalid, match=f"no type of {kind.name}s"):
        kind.offer(ros, "/free", "std_msgs/msg/String")
