"""The ROS 2 platform in a real graph, against a node in another process, with either executor."""

from __future__ import annotations

import time

import pytest
import pytest_twisted
from geometry_msgs.msg import TwistStamped
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import String
from twisted.internet import reactor, task

from robot_client.platforms.base import CommandEffect
from robot_client.platforms.ros2.platform import Ros2Platform
from tests.robot_client.ros import Peer, until
from tests.worlds.ros_endpoints import STAMPED, STRING, Listener, seen


@pytest_twisted.ensureDeferred
async def test_samples_are_cdr(ros: Ros2Platform, peer: Peer) -> None:
    topic = f"/raw_{ros._nodes.kind}"
    peer.do("advertise", topic)
    await seen(ros, lambda graph: topic in graph.topics)
    listener = Listener(ros, topic)
    await until(lambda: peer.do("publish", topic, "hällo") or listener.bodies)
    assert listener.texts[0] == "hällo"
    # The middleware fills up to four bytes.
    assert listener.bodies[0].startswith(bytes(serialize_message(String(data="hällo"))))
    assert listener.source.type == STRING
    listener.source.close()


def test_zero_is_stamped_now(ros: Ros2Platform) -> None:
    before = time.time()
    zero = deserialize_message(ros.zero_command(STAMPED), TwistStamped)
    assert before - 1 <= zero.header.stamp.sec <= time.time()
    assert ros.classify_command(STAMPED, ros.zero_command(STAMPED)) is CommandEffect.STILL


@pytest_twisted.ensureDeferred
async def test_stuck_executor_is_reported(ros: Ros2Platform, monkeypatch: pytest.MonkeyPatch) -> None:
    await task.deferLater(reactor, 1.2)
    assert ros.fault() is None
    monkeypatch.setattr(ros._nodes.main, "_clock", lambda: time.monotonic() + 60)
    assert "run no callback" in str(ros.fault())


def test_facts_name_the_distribution(ros: Ros2Platform) -> None:
    facts = ros.facts()
    assert facts.platform == "ros2"
    assert facts.distro
    assert facts.extra["rmw"].startswith("rmw_")
