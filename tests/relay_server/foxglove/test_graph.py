"""The connection graph of Foxglove clients, by websocket bytes."""

from __future__ import annotations

from relay_protocol import link
from tests.worlds.foxglove_client import FoxgloveWorld
from tests.worlds.relay import GRAPH


def test_the_graph_comes_whole_and_then_as_differences(world: FoxgloveWorld) -> None:
    client = world.client(deny=("subscribe:/secret", "publish:/secret"))
    client.sends("subscribeConnectionGraph")
    (whole,) = client.took("connectionGraphUpdate")
    published = {each["name"]: each["publisherIds"] for each in whole["publishedTopics"]}
    assert published["/chatter"] == ["/talker"]
    assert "/secret" not in published
    assert {"name": "/cmd_vel", "subscriberIds": ["/base"]} in whole["subscribedTopics"]
    assert {"name": "/reset", "providerIds": ["/base"]} in whole["advertisedServices"]
    assert whole["removedTopics"] == whole["removedServices"] == []
    change = link.Graph(
        topics={
            "/chatter": link.Topic(types=["std_msgs/msg/String"], subscribers=["/logger"]),
            "/cmd_vel": None,
        },
        services={"/reset": None},
    )
    world.registry.graph(world.robot, change)
    (difference,) = client.took("connectionGraphUpdate")
    assert difference == {
        "op": "connectionGraphUpdate",
        "publishedTopics": [{"name": "/chatter", "publisherIds": []}],
        "subscribedTopics": [],
        "advertisedServices": [],
        "removedTopics": ["/cmd_vel"],
        "removedServices": ["/reset"],
    }
    client.sends("unsubscribeConnectionGraph")
    world.registry.graph(world.robot, GRAPH)
    assert not client.took("connectionGraphUpdate")


def test_hidden_nodes_are_left_out_of_the_graph(world: FoxgloveWorld) -> None:
    ends = ["/_ros2cli", "/talker"]
    world.registry.graph(
        world.robot,
        link.Graph(
            topics={
                "/chatter": link.Topic(types=["std_msgs/msg/String"], publishers=ends, subscribers=ends[:1]),
                "/peeped": link.Topic(types=["std_msgs/msg/String"], publishers=ends[:1]),
            },
            services={"/reset": link.Service(types=["std_srvs/srv/Trigger"], providers=ends)},
        ),
    )
    client = world.client()
    client.sends("subscribeConnectionGraph")
    (whole,) = client.took("connectionGraphUpdate")
    assert {"name": "/chatter", "publisherIds": ["/talker"]} in whole["publishedTopics"]
    assert {"name": "/reset", "providerIds": ["/talker"]} in whole["advertisedServices"]
    assert "_ros2cli" not in str(whole)
    assert "/peeped" not in str(whole)
