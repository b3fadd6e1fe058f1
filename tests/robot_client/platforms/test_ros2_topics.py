"""Subscriptions and publishers of the ROS 2 platform in a real graph."""

from __future__ import annotations

import time
from typing import Any

import pytest
import pytest_twisted
from geometry_msgs.msg import Twist, TwistStamped
from rclpy.serialization import serialize_message
from std_msgs.msg import String
from twisted.internet import reactor, task

from relay_protocol import link
from relay_protocol.errors import Invalid, NotFound
from robot_client.motion.motion_control import MOTION_QOS
from robot_client.motion.typed_topic import TypedTopic
from robot_client.platforms.ros2 import executor
from robot_client.platforms.ros2.platform import REFRESH_ALL_EVERY, Ros2Platform
from robot_client.platforms.ros2.topics import LINGER, LONGEST_LINGER, LingeringPublishers, RosPublisher
from tests.robot_client.ros import Peer, until
from tests.worlds.ros_endpoints import STAMPED, STRING, TWIST, Listener, node, seen

pytestmark = pytest.mark.parametrize("ros", ["events"], indirect=True, scope="module")


@pytest_twisted.ensureDeferred
async def test_latched_message_reaches_a_late_subscriber(ros: Ros2Platform, peer: Peer) -> None:
    peer.do("advertise", "/latched", "latched")
    peer.do("publish", "/latched", "kept")
    await seen(ros, lambda graph: "/latched" in graph.topics)
    listener = Listener(ros, "/latched")
    await until(lambda: listener.texts)
    assert listener.texts == ["kept"]
    assert listener.source.latched


@pytest_twisted.ensureDeferred
async def test_best_effort_publisher_is_received(ros: Ros2Platform, peer: Peer) -> None:
    peer.do("advertise", "/lossy", "best_effort")
    await seen(ros, lambda graph: "/lossy" in graph.topics)
    listener = Listener(ros, "/lossy")
    await until(lambda: peer.do("publish", "/lossy", "x") or listener.texts)
    assert not listener.source.latched


@pytest_twisted.ensureDeferred
async def test_changed_quality_of_a_publisher_is_followed(ros: Ros2Platform, peer: Peer) -> None:
    """Although the graph looks the same."""
    peer.do("advertise", "/mind", "reliable")
    await seen(ros, lambda graph: "/mind" in graph.topics)
    listener = Listener(ros, "/mind")
    assert not listener.source.latched
    peer.do("unadvertise", "/mind")
    peer.do("advertise", "/mind", "latched")
    peer.do("publish", "/mind", "kept")
    await until(lambda: ros.graph() and listener.source.latched and "kept" in listener.texts)


@pytest_twisted.ensureDeferred
async def test_unchanged_topics_are_refreshed_every_third_read(
    ros: Ros2Platform, peer: Peer, monkeypatch: pytest.MonkeyPatch
) -> None:
    peer.do("advertise", "/steady", "reliable")
    await seen(ros, lambda graph: "/steady" in graph.topics)
    listener = Listener(ros, "/steady")
    asked = list[int]()
    monkeypatch.setattr(listener.source, "refresh", lambda: asked.append(1))
    for _ in range(2 * REFRESH_ALL_EVERY):
        ros.graph()
    assert len(asked) == 2


@pytest_twisted.ensureDeferred
async def test_later_topic_is_received(ros: Ros2Platform, peer: Peer) -> None:
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
    peer.do("advertise", "/ending")
    await seen(ros, lambda graph: "/ending" in graph.topics)
    listener = Listener(ros, "/ending")
    await until(lambda: peer.do("publish", "/ending", "x") or listener.texts)
    listener.source.close()
    count = len(listener.bodies)
    peer.do("publish", "/ending", "y")
    await task.deferLater(reactor, 0.2)
    assert len(listener.bodies) == count


@pytest_twisted.ensureDeferred
async def test_samples_that_a_busy_daemon_drops_are_counted_by_subscription(
    ros: Ros2Platform, peer: Peer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(executor, "MAX_BACKLOG", 1)
    peer.do("advertise", "/flood")
    await seen(ros, lambda graph: "/flood" in graph.topics)
    listener, other, dropped = Listener(ros, "/flood"), Listener(ros, "/calm", STRING), list[int]()
    listener.source.on_dropped = dropped.append
    other.source.on_dropped = lambda count: pytest.fail("no sample of this topic was dropped")

    def flood() -> None:
        """Publishes more than may wait while the reactor is busy."""
        for _ in range(5):
            peer.do("publish", "/flood", "x")
        time.sleep(0.05)

    await until(lambda: flood() or dropped)
    assert listener.texts


async def driving(ros: Ros2Platform, peer: Peer, topic: str, speed: float) -> RosPublisher:
    """A publisher whose command a node has received."""
    peer.do("listen", topic, "twist")
    sink = ros.advertise(topic, TWIST, False, None)
    command = Twist()
    command.linear.x = speed
    await until(lambda: sink.publish(bytes(serialize_message(command))) or peer.heard(topic))
    return sink


@pytest_twisted.ensureDeferred
async def test_published_bytes_arrive(ros: Ros2Platform, peer: Peer) -> None:
    sink = await driving(ros, peer, "/cmd_vel", 0.25)
    assert peer.heard("/cmd_vel")[0]["x"] == 0.25
    sink.close()


@pytest_twisted.ensureDeferred
async def test_last_message_arrives_after_its_publisher_was_closed(ros: Ros2Platform, peer: Peer) -> None:
    """It may be zero."""
    sink = await driving(ros, peer, "/farewell", 1.0)
    sink.publish(ros.zero_command(TWIST))
    sink.close()
    await until(lambda: peer.heard("/farewell")[-1]["x"] == 0.0)


@pytest_twisted.ensureDeferred
async def test_latched_message_of_a_client_reaches_late_subscribers(ros: Ros2Platform, peer: Peer) -> None:
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
async def test_unknown_topics_types_and_names_are_refused(ros: Ros2Platform, peer: Peer) -> None:
    """So is a second type."""
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
    with pytest.raises(Invalid, match="not a valid topic name"):
        ros.advertise("/not a name", TWIST, False, None)
    with pytest.raises(Invalid, match="reliability"):
        Listener(ros, "/typed", STRING, link.QoS(reliability="somewhat"))
    with pytest.raises(NotFound, match="std_msgs/msg/Nothing"):
        ros.definition("std_msgs/msg/Nothing")


def publishers(ros: Ros2Platform, topic: str) -> list[str]:
    return [each.node_name for each in ros._node.get_publishers_info_by_topic(topic)]


@pytest_twisted.ensureDeferred
async def test_own_publishers_and_the_guards_do_not_decide_the_type(ros: Ros2Platform, peer: Peer) -> None:
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
        await until(lambda: right.publish(ros.zero_command(TWIST)) or peer.heard("/base"))
        with pytest.raises(Invalid, match=r"geometry_msgs/msg/Twist on this robot"):
            ros.advertise("/base", STAMPED, False, None)
        right.close()


def test_publisher_with_keep_all_is_refused(ros: Ros2Platform) -> None:
    """It could block the daemon."""
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
def test_queue_size_of_a_publisher_is_the_requested_one(
    ros: Ros2Platform, queue_size: int, latch: bool, qos: link.QoS | None, depth: int
) -> None:
    """Within bounds; a depth in the quality of service has priority."""
    sink = ros.advertise("/queue", STRING, latch, qos, queue_size)
    assert sink.publisher.qos_profile.depth == depth
    sink.close()


def test_errors_of_ros_have_no_source_location(ros: Ros2Platform, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*args: Any, **more: Any) -> None:
        raise RuntimeError("incompatible type, at /project/src/rcl/publisher.cpp:145")

    monkeypatch.setattr(ros._node, "create_publisher", refuse)
    with pytest.raises(Invalid, match=r"as std_msgs/msg/String: incompatible type$"):
        ros.advertise("/refused", STRING, False, None)


class SlowSubscriber:
    """A publisher of rclpy whose subscriber confirms messages after some looks, and its node.

    :param looks: at which it has confirmed them
    """

    def __init__(self, looks: int) -> None:
        self.looks = looks
        self.destroyed: list[object] = []

    def wait_for_all_acked(self, timeout: Any) -> bool:
        self.looks -= 1
        return self.looks <= 0

    def destroy_publisher(self, publisher: object) -> None:
        self.destroyed.append(publisher)


@pytest.mark.parametrize(("looks", "seconds"), [(1, LINGER), (3, 3 * LINGER), (1000, LONGEST_LINGER)])
def test_a_publisher_lives_until_its_subscribers_have_its_messages(
    ros: Ros2Platform, looks: int, seconds: float
) -> None:
    """A subscriber that has not discovered it yet would never get them. It does not live for ever."""
    clock, publisher = task.Clock(), SlowSubscriber(looks)
    LingeringPublishers(publisher, clock).add(publisher)
    clock.pump([LINGER / 2] * round(2 * (seconds / LINGER) - 1))
    assert not publisher.destroyed
    clock.advance(LINGER / 2)
    assert publisher.destroyed == [publisher]
    assert not clock.getDelayedCalls()
