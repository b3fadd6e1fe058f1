"""Subscriptions and publishers of the ROS 2 platform in a real graph."""

from __future__ import annotations

from typing import Any

import pytest
import pytest_twisted
from geometry_msgs.msg import Twist, TwistStamped
from rclpy.serialization import serialize_message
from std_msgs.msg import String
from twisted.internet import reactor, task

from relay_protocol import link
from relay_protocol.errors import Invalid, NotFound
from robot_client.motion.motion import MOTION_QOS
from robot_client.motion.typed_topic import TypedTopic
from robot_client.platforms.ros2.platform import LOOK_EVERY, Ros2Platform
from robot_client.platforms.ros2.topics import RosSink
from tests.robot_client.platforms.ends import STAMPED, STRING, TWIST, Listener, node, seen
from tests.robot_client.ros import Peer, until

pytestmark = pytest.mark.parametrize("ros", ["events"], indirect=True, scope="module")


@pytest_twisted.ensureDeferred
async def test_latched_message_reaches_a_late_subscriber(ros: Ros2Platform, peer: Peer) -> None:
    """What a latching publisher said before the subscription was made arrives after it."""
    peer.do("advertise", "/latched", "latched")
    peer.do("publish", "/latched", "kept")
    await seen(ros, lambda graph: "/latched" in graph.topics)
    listener = Listener(ros, "/latched")
    await until(lambda: listener.texts)
    assert listener.texts == ["kept"]
    assert listener.source.latched


@pytest_twisted.ensureDeferred
async def test_best_effort_publisher_is_heard(ros: Ros2Platform, peer: Peer) -> None:
    """A best-effort publisher, which a reliable subscription would never match, is heard."""
    peer.do("advertise", "/lossy", "best_effort")
    await seen(ros, lambda graph: "/lossy" in graph.topics)
    listener = Listener(ros, "/lossy")
    await until(lambda: peer.do("publish", "/lossy", "x") or listener.texts)
    assert not listener.source.latched


@pytest_twisted.ensureDeferred
async def test_publisher_that_changes_its_mind_is_followed(ros: Ros2Platform, peer: Peer) -> None:
    """A node that publishes a topic anew with another quality of service is heard, though the graph looks as before."""
    peer.do("advertise", "/mind", "reliable")
    await seen(ros, lambda graph: "/mind" in graph.topics)
    listener = Listener(ros, "/mind")
    assert not listener.source.latched
    peer.do("unadvertise", "/mind")
    peer.do("advertise", "/mind", "latched")
    peer.do("publish", "/mind", "kept")
    await until(lambda: ros.graph() and listener.source.latched and "kept" in listener.texts)


@pytest_twisted.ensureDeferred
async def test_publishers_are_looked_at_when_there_is_a_reason(
    ros: Ros2Platform, peer: Peer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While the graph stays as it is, what the publishers of a topic offer is asked for in every third look only."""
    peer.do("advertise", "/steady", "reliable")
    await seen(ros, lambda graph: "/steady" in graph.topics)
    listener = Listener(ros, "/steady")
    asked = list[int]()
    monkeypatch.setattr(listener.source, "refresh", lambda: asked.append(1))
    for _ in range(2 * LOOK_EVERY):
        ros.graph()
    assert len(asked) == 2


@pytest_twisted.ensureDeferred
async def test_topic_that_comes_later_is_followed(ros: Ros2Platform, peer: Peer) -> None:
    """A topic subscribed before it exists is delivered when it appears, with the quality its publisher has."""
    listener = Listener(ros, "/later", STRING)
    assert listener.source.publishers == 0
    peer.do("advertise", "/later", "latched")
    peer.do("publish", "/later", "kept")
    await until(lambda: ros.graph() and listener.texts)
    assert listener.texts == ["kept"]
    assert listener.source.latched
    assert listener.changes > 0


@pytest_twisted.ensureDeferred
async def test_closed_subscription_is_silent(ros: Ros2Platform, peer: Peer) -> None:
    """After its end a subscription delivers nothing, whatever was under way."""
    peer.do("advertise", "/ending")
    await seen(ros, lambda graph: "/ending" in graph.topics)
    listener = Listener(ros, "/ending")
    await until(lambda: peer.do("publish", "/ending", "x") or listener.texts)
    listener.source.close()
    count = len(listener.bodies)
    peer.do("publish", "/ending", "y")
    await task.deferLater(reactor, 0.2)
    assert len(listener.bodies) == count


async def driving(ros: Ros2Platform, peer: Peer, topic: str, speed: float) -> RosSink:
    """A publisher whose command a node has heard."""
    peer.do("listen", topic, "twist")
    sink = ros.advertise(topic, TWIST, False, None)
    command = Twist()
    command.linear.x = speed
    await until(lambda: sink.publish(bytes(serialize_message(command))) or peer.heard(topic))
    return sink


@pytest_twisted.ensureDeferred
async def test_published_bytes_arrive(ros: Ros2Platform, peer: Peer) -> None:
    """CDR bytes published as they are reach another node as the message they are."""
    sink = await driving(ros, peer, "/cmd_vel", 0.25)
    assert peer.heard("/cmd_vel")[0]["x"] == 0.25
    sink.close()


@pytest_twisted.ensureDeferred
async def test_last_message_survives_its_publisher(ros: Ros2Platform, peer: Peer) -> None:
    """What was published just before the publisher was taken away still arrives: it may be a stop."""
    sink = await driving(ros, peer, "/farewell", 1.0)
    sink.publish(ros.zero(TWIST))
    sink.close()
    await until(lambda: peer.heard("/farewell")[-1]["x"] == 0.0)


@pytest_twisted.ensureDeferred
async def test_latching_publisher_is_heard_late(ros: Ros2Platform, peer: Peer) -> None:
    """What a client publishes with latch waits for later subscribers that want it."""
    sink = ros.advertise("/from_client", STRING, True, None)
    sink.publish(bytes(serialize_message(String(data="kept"))))
    peer.do("advertise", "/marker")
    await seen(ros, lambda graph: "/marker" in graph.topics)
    listener = Listener(
        ros, "/from_client", STRING, link.QoS(durability="transient_local", reliability="reliable")
    )
    await until(lambda: listener.texts)
    assert listener.texts == ["kept"]


@pytest_twisted.ensureDeferred
async def test_what_is_not_there_is_said(ros: Ros2Platform, peer: Peer) -> None:
    """Unknown topics, types and names, and a second type for a topic, are refused in words."""
    peer.do("advertise", "/typed")
    await seen(ros, lambda graph: "/typed" in graph.topics)
    with pytest.raises(NotFound, match="/nothing"):
        Listener(ros, "/nothing")
    with pytest.raises(NotFound, match="no_such_pkg"):
        Listener(ros, "/new", "no_such_pkg/msg/Thing")
    with pytest.raises(Invalid, match=r"std_msgs/msg/String.*not geometry_msgs"):
        Listener(ros, "/typed", TWIST)
    with pytest.raises(Invalid, match=r"std_msgs/msg/String.*not geometry_msgs"):
        ros.advertise("/typed", TWIST, False, None)
    with pytest.raises(Invalid, match="no topic name"):
        ros.advertise("/not a name", TWIST, False, None)
    with pytest.raises(Invalid, match="reliability"):
        Listener(ros, "/typed", STRING, link.QoS(reliability="somewhat"))
    with pytest.raises(NotFound, match="std_msgs/msg/Nothing"):
        ros.definition("std_msgs/msg/Nothing")


def publishers(ros: Ros2Platform, topic: str) -> list[str]:
    return [each.node_name for each in ros._node.get_publishers_info_by_topic(topic)]


@pytest_twisted.ensureDeferred
async def test_own_publishers_and_the_guards_do_not_decide_the_type(ros: Ros2Platform, peer: Peer) -> None:
    """What a client advertised with the wrong type, and its guard with it, does not keep the right one out."""
    with node("switchboard_guard_test") as guard:
        sink = ros.advertise("/base", STAMPED, False, None)
        assert ros.resolve("/base", "") == TypedTopic("/base", STAMPED)
        guard.create_publisher(TwistStamped, "/base", 10)
        await until(lambda: "switchboard_guard_test" in publishers(ros, "/base"))
        sink.close()
        peer.do("listen", "/base", "twist")
        await until(lambda: ros._node.get_subscriptions_info_by_topic("/base"))
        assert ros.resolve("base", "geometry_msgs/Twist") == TypedTopic("/base", TWIST)
        right = ros.advertise("/base", TWIST, False, None)
        await until(lambda: right.publish(ros.zero(TWIST)) or peer.heard("/base"))
        with pytest.raises(Invalid, match=r"geometry_msgs/msg/Twist on this robot"):
            ros.advertise("/base", STAMPED, False, None)
        right.close()


def test_publisher_that_could_block_is_refused(ros: Ros2Platform) -> None:
    """A publisher that keeps all would make the daemon wait for its slowest subscriber; it is refused in words."""
    with pytest.raises(Invalid, match="keep_last"):
        ros.advertise("/all", STRING, False, link.QoS(history="keep_all"))


@pytest.mark.parametrize(
    ("queue_size", "latch", "qos", "depth"),
    [
        (0, False, None, 100),
        (-3, False, None, 100),
        (1, False, None, 1),
        (250, False, None, 250),
        (10**30, False, None, 10_000),
        (250, False, link.QoS(depth=7), 7),
        (250, True, None, 1),
        (250, True, link.QoS(depth=7), 7),
        (250, False, MOTION_QOS, 1),
    ],
)
def test_queue_of_a_publisher_is_as_deep_as_asked(
    ros: Ros2Platform, queue_size: int, latch: bool, qos: link.QoS | None, depth: int
) -> None:
    """Within bounds; a depth in the quality of service counts more, and what is latched is the last one alone."""
    sink = ros.advertise("/queue", STRING, latch, qos, queue_size)
    assert sink.publisher.qos_profile.depth == depth
    sink.close()


def test_refusal_of_ros_names_no_file(ros: Ros2Platform, monkeypatch: pytest.MonkeyPatch) -> None:
    """The reason is told, without where ROS was built."""

    def refuse(*args: Any, **more: Any) -> None:
        raise RuntimeError("incompatible type, at /project/src/rcl/publisher.cpp:145")

    monkeypatch.setattr(ros._node, "create_publisher", refuse)
    with pytest.raises(Invalid, match=r"as std_msgs/msg/String: incompatible type$"):
        ros.advertise("/refused", STRING, False, None)
