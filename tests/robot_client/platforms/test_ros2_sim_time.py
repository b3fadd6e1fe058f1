"""A robot with simulated time: stamps follow it, safety does not."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator

import pytest
import pytest_twisted
from geometry_msgs.msg import Twist, TwistStamped
from rclpy.serialization import deserialize_message, serialize_message
from twisted.internet import reactor

from relay_protocol.clocks import now_ns
from relay_protocol.link import MotionPolicy
from robot_client.link.clock_offset import ClockOffset
from robot_client.motion.authority import Authority
from robot_client.motion.guard_port import NoGuard
from robot_client.motion.motion_control import MOTION_QOS, MotionControl
from robot_client.motion.typed_topic import TypedTopic
from robot_client.platforms.ros2.platform import Ros2Platform
from tests.robot_client.ros import Peer, until

TWIST = "geometry_msgs/msg/Twist"
STAMPED = "geometry_msgs/msg/TwistStamped"


@pytest.fixture(scope="module", params=["events", "single"])
def ros(request: pytest.FixtureRequest, environment: dict[str, str]) -> Iterator[Ros2Platform]:
    made = Ros2Platform(reactor, "switchboard_test", executor=request.param, sim_time=True)
    made.start()
    yield made
    made.stop()


def stamp(ros: Ros2Platform) -> float:
    zero = deserialize_message(ros.zero_command(STAMPED), TwistStamped).header.stamp
    return zero.sec + zero.nanosec / 1e9


@pytest_twisted.ensureDeferred
async def test_stamps_follow_simulated_time(ros: Ros2Platform, peer: Peer) -> None:
    assert ros.facts().sim_time
    for seconds in (12.5, 3.25):
        await until(lambda seconds=seconds: peer.do("clock", seconds) or stamp(ros) == seconds)


@pytest_twisted.ensureDeferred
async def test_paused_simulation_is_no_stuck_executor(ros: Ros2Platform) -> None:
    served = ros._nodes.main._last_callback
    await until(lambda: ros._nodes.main._last_callback > served)
    assert ros.fault() is None


@pytest_twisted.ensureDeferred
async def test_robot_stops_during_a_paused_simulation(ros: Ros2Platform, peer: Peer) -> None:
    topic = f"/cmd_{ros._nodes.kind}"
    peer.do("clock", 5.0)
    peer.do("listen", topic, "twist")
    authority = Authority()
    authority.grant_control(1, "ann", "operator", now_ns())
    motion = MotionControl(MotionPolicy(types=[TWIST]), ros, reactor, now_ns, NoGuard(), authority)
    on, offset = TypedTopic(topic, TWIST), ClockOffset()
    offset.add(now_ns(), now_ns(), now_ns())
    motion.open("driver", on, ros.advertise(topic, TWIST, False, MOTION_QOS))
    command = Twist()
    command.linear.x = 0.5
    body = bytes(serialize_message(command))

    def drive() -> bool:
        motion.command("driver", body, now_ns(), offset, 1)
        return bool(peer.heard(topic))

    await until(drive)
    await until(lambda: peer.heard(topic)[-1]["x"] == 0.0)
    assert motion.watchdog_stops >= 1
    assert not motion.command("driver", body, now_ns() - 10**9, offset, 1)
    assert motion.stale_commands == 1
    motion.close("driver")


def test_guard_leaves_stamps_at_zero_with_simulated_time(environment: dict[str, str]) -> None:
    """Controllers treat that as now."""
    program = f"""
from robot_client.motion.guard import RosStopOutputs
from robot_client.motion.typed_topic import TypedTopic
from geometry_msgs.msg import TwistStamped
from rclpy.serialization import deserialize_message
for simulated in (True, False):
    outputs = RosStopOutputs("switchboard_guard_test", simulated)
    class Publisher:
        def publish(self, body): print(deserialize_message(body, TwistStamped).header.stamp.sec > 0)
        def get_subscription_count(self): return 1
    outputs._publishers[TypedTopic("/cmd", "{STAMPED}")] = [(Publisher(), None)]
    outputs.zero(TypedTopic("/cmd", "{STAMPED}"), b"")
    import rclpy; rclpy.shutdown()
"""
    done = subprocess.run(
        [sys.executable, "-c", program],
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert done.stdout.split() == ["False", "True"]
