"""Publishers that follow the requests of subscribers, in a real graph."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import pytest
import pytest_twisted
from hypothesis import given
from hypothesis import strategies as st
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from std_msgs.msg import String

from relay_protocol import link
from robot_client.motion.motion_control import MOTION_QOS
from robot_client.platforms.ros2 import qos as ros2_qos
from robot_client.platforms.ros2.platform import Ros2Platform
from tests.robot_client.ros import until
from tests.worlds.ros_endpoints import STRING, node

with_events = pytest.mark.parametrize("ros", ["events"], indirect=True, scope="module")


@pytest.fixture
def other(environment: dict[str, str]) -> Iterator[Any]:
    """Another node; it never spins."""
    with ExitStack() as stack:
        yield stack.enter_context(node("strict"))


def text(words: str) -> bytes:
    return bytes(serialize_message(String(data=words)))


@with_events
@pytest_twisted.ensureDeferred
async def test_publisher_is_replaced_for_a_stricter_subscriber(ros: Ros2Platform, other: Any) -> None:
    """Latched messages are copied."""
    topic = "/renewed"
    changes: list[bool] = []
    sink = ros.advertise(topic, STRING, True, None, on_change=lambda: changes.append(True))
    sink.publish(text("kept"))
    first = sink.publisher
    profile = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL, deadline=Duration(seconds=1))
    subscription = other.create_subscription(String, topic, print, profile)
    await until(lambda: ros.graph() and sink.publisher is not first)
    assert sink.publisher.qos_profile.deadline == Duration(seconds=1)
    await until(lambda: subscription.handle.take_message(String, False))
    assert (sink.unmatched, changes) == ([], [])
    sink.close()


@with_events
@pytest_twisted.ensureDeferred
async def test_no_message_is_lost_or_doubled_during_a_replacement(ros: Ros2Platform, other: Any) -> None:
    topic = "/going_on"
    plain = other.create_subscription(String, topic, print, QoSProfile(depth=1000))
    sink = ros.advertise(topic, STRING, False, None)
    await until(lambda: sink.publisher.get_subscription_count())
    first, heard, sent = sink.publisher, list[int](), list[int]()
    other.create_subscription(String, topic, print, QoSProfile(depth=1, deadline=Duration(seconds=1)))

    def publish() -> bool:
        ros.graph()
        sent.append(len(sent))
        sink.publish(text(str(sent[-1])))
        while message := plain.handle.take_message(String, False):
            heard.append(int(message[0].data))
        return sink.publisher is not first

    await until(publish)
    after = len(sent)
    await until(lambda: publish() and heard and heard[-1] > after + 10)
    assert heard == list(range(heard[0], heard[-1] + 1))
    sink.close()


@with_events
@pytest_twisted.ensureDeferred
async def test_unmatched_subscribers_are_reported(ros: Ros2Platform, other: Any) -> None:
    """The publisher is not replaced without need."""
    topic = "/unserved"
    changes: list[bool] = []
    sinks = [
        ros.advertise(topic, STRING, False, qos, on_change=lambda: changes.append(True))
        for qos in (MOTION_QOS, link.QoS(reliability="best_effort"))
    ]
    publishers = [sink.publisher for sink in sinks]
    durable = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    subscription = other.create_subscription(String, topic, print, durable)
    await until(lambda: ros.graph() and all("/strict" in str(sink.unmatched) for sink in sinks))
    assert sinks[0].unmatched == ["/strict: Volatile publisher and transient local subscription"]
    assert sinks[1].unmatched[0].startswith("/strict: Best effort publisher and reliable subscription")
    assert sinks[0].publisher is publishers[0]
    other.destroy_subscription(subscription)
    await until(lambda: ros.graph() and not any(sink.unmatched for sink in sinks))
    assert len(changes) >= 4
    for sink in sinks:
        sink.close()


@with_events
@pytest_twisted.ensureDeferred
async def test_own_subscriptions_make_no_publisher_durable(ros: Ros2Platform) -> None:
    topic = "/own"
    latched = ros.advertise(topic, STRING, True, None)
    source = ros.subscribe(topic, STRING, None, lambda body: None, lambda: None)
    source.request_latched(lambda stamp, body: None, lambda: None)
    await until(lambda: latched.publisher.get_subscription_count() >= 2)
    plain = ros.advertise(topic, STRING, False, None)
    assert plain.publisher.qos_profile.durability == DurabilityPolicy.VOLATILE
    for each in (source, plain, latched):
        each.close()


TIMES = st.none() | st.integers(1, 10**10).map(lambda nanoseconds: Duration(nanoseconds=nanoseconds))
SUBSCRIBERS = st.builds(
    lambda reliable, durable, manual, deadline, lease: QoSProfile(
        depth=1,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if durable else DurabilityPolicy.VOLATILE,
        liveliness=LivelinessPolicy.MANUAL_BY_TOPIC if manual else LivelinessPolicy.AUTOMATIC,
        **({"deadline": deadline} if deadline else {}),
        **({"liveliness_lease_duration": lease} if lease else {}),
    ),
    st.booleans(), st.booleans(), st.booleans(), TIMES, TIMES,
)  # fmt: skip


@given(st.lists(SUBSCRIBERS, max_size=6), st.booleans())
def test_every_subscriber_is_matched_by_the_middlewares_rules(
    subscribers: list[QoSProfile], latch: bool
) -> None:
    offered = ros2_qos.for_publisher(subscribers, latch, None)
    assert [ros2_qos.mismatch(offered, each) for each in subscribers] == [""] * len(subscribers)


@given(st.lists(SUBSCRIBERS, max_size=6))
def test_every_publisher_is_matched_by_the_middlewares_rules(publishers: list[QoSProfile]) -> None:
    asked = ros2_qos.for_subscription(ros2_qos.match(publishers), None)
    assert [ros2_qos.mismatch(each, asked) for each in publishers] == [""] * len(publishers)
