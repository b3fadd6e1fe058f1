"""The graph as the ROS 2 platform reads it."""

from __future__ import annotations

from contextlib import ExitStack

import pytest
import pytest_twisted
from std_msgs.msg import String
from std_srvs.srv import Trigger

from relay_protocol import link
from relay_protocol.errors import Invalid
from robot_client.platforms.ros2.platform import Ros2Platform
from tests.robot_client.ros import Peer
from tests.worlds.ros_endpoints import STRING, Listener, node, seen

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


@pytest_twisted.ensureDeferred
async def test_nodes_with_one_full_name_all_have_their_endpoints(ros: Ros2Platform) -> None:
    """Topics, services and parameters of each are in the graph, and their names are taken."""
    with ExitStack() as stack:
        twins = [stack.enter_context(node("twin")) for _ in range(3)]
        for number, each in enumerate(twins):
            each.create_publisher(String, f"/said{number}", 1)
            each.create_subscription(String, f"/heard{number}", lambda message: None, 1)
            each.create_service(Trigger, f"/served{number}", lambda request, response: response)
        graph = await seen(
            ros,
            lambda graph: all(
                {f"/said{each}", f"/heard{each}"} <= graph.topics.keys()
                and f"/served{each}" in graph.services
                for each in range(3)
            ),
        )
        assert "/twin" in graph.nodes
        for number in range(3):
            assert graph.topics[f"/said{number}"] == link.Topic(types=[STRING], publishers=["/twin"])
            assert graph.topics[f"/heard{number}"] == link.Topic(types=[STRING], subscribers=["/twin"])
            assert graph.services[f"/served{number}"] == link.Service(
                types=["std_srvs/srv/Trigger"], providers=["/twin"]
            )
            with pytest.raises(Invalid, match="/twin provides it"):
                ros.advertise_service(f"/served{number}", "std_srvs/srv/Trigger", lambda *call: None)
        assert graph.services["/twin/get_parameters"].providers == ["/twin"]
        assert not [name for name in [*graph.topics, *graph.services] if "switchboard" in name]
    await seen(ros, lambda graph: "/twin" not in graph.nodes)


@pytest_twisted.ensureDeferred
async def test_killed_namesake_does_not_stand_for_the_living_one(
    ros: Ros2Platform, environment: dict[str, str]
) -> None:
    """It stays in the graph until its lease ends."""
    killed = Peer(environment)
    killed.do("advertise", "/of_the_killed")
    await seen(ros, lambda graph: "/of_the_killed" in graph.topics)
    killed.kill()
    living = Peer(environment)
    try:
        living.do("advertise", "/of_the_living")
        living.do("serve", "/served_by_the_living", "hello")
        graph = await seen(
            ros,
            lambda graph: "/of_the_living" in graph.topics and "/served_by_the_living" in graph.services,
        )
        assert graph.topics["/of_the_living"].publishers == ["/robot/peer"]
    finally:
        living.close()
