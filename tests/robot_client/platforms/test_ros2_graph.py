"""The graph as the ROS 2 platform reads it."""

from __future__ import annotations

import pytest
import pytest_twisted

from relay_protocol import link
from robot_client.platforms.ros2.platform import Ros2Platform
from tests.robot_client.ros import Peer
from tests.worlds.ros_endpoints import STRING, Listener, seen

pytestmark = pytest.mark.parametrize("ros", ["events"], indirect=True, scope="module")


@pytest_twisted.ensureDeferred
async def test_graph_has_other_nodes_only(ros: Ros2Platform, peer: Peer) -> None:
    peer.do("advertise", "/theirs")
    Listener(ros, "/ours", STRING)
    Listener(ros, "/theirs", STRING)
    graph = await seen(ros, lambda graph: "/theirs" in graph.topics)
    assert graph.topics["/theirs"] == link.Topic(types=[STRING], publishers=["/robot/peer"])
    assert "/ours" not in graph.topics
    assert graph.nodes == {"/robot/peer"}
    providers = graph.services["/robot/peer/list_parameters"].providers
    assert providers == ["/robot/peer"]
    assert not [name for name in [*graph.topics, *graph.services] if "switchboard" in name or "/_" in name]


@pytest_twisted.ensureDeferred
async def test_topics_without_endpoints_leave_the_graph(ros: Ros2Platform, peer: Peer) -> None:
    peer.do("advertise", "/brief")
    await seen(ros, lambda graph: "/brief" in graph.topics)
    peer.do("unadvertise", "/brief")
    await seen(ros, lambda graph: "/brief" not in graph.topics)
