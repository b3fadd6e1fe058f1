"""The platform leaves the graph and joins it again, as after a change of the machine's addresses."""

from __future__ import annotations

import pytest
import pytest_twisted
from rclpy.serialization import deserialize_message
from std_srvs.srv import SetBool

from robot_client.platforms.ros2.platform import Ros2Platform
from tests.robot_client.ros import Peer, until
from tests.worlds.ros_endpoints import STRING, Listener, seen


@pytest_twisted.ensureDeferred
async def test_renewed_platform_has_the_whole_graph_again(ros: Ros2Platform, peer: Peer) -> None:
    """Topics, prepared calls and the battery work as before; its former node is not taken for another one."""
    peer.do("advertise", "/before")
    peer.do("serve", "/hello", "hello")
    peer.do("battery", "/battery_state", 0.5)
    before = Listener(ros, "/before", STRING)
    await seen(ros, lambda graph: "/before" in graph.topics and "/hello" in graph.services)
    await until(lambda: ros.graph() and ros.battery() is not None)
    ros.prepare_call("/hello", "std_srvs/srv/SetBool")
    ros._battery._sample = None  # type: ignore[union-attr]  # else the former one would count
    for _ in range(2):
        ros.renew()
        assert ros.fault() is None
        peer.do("listen", "/ours", "string")
        graph = await seen(
            ros, lambda graph: {"/before", "/ours"} <= graph.topics.keys() and "/hello" in graph.services
        )
        assert graph.nodes == {"/robot/peer"}
        assert ros._calls.is_prepared("/hello", "std_srvs/srv/SetBool")
    after = Listener(ros, "/before", STRING)

    def arrived() -> bool:
        peer.do("publish", "/before", "again")
        return bool(after.texts)

    await until(arrived)
    assert before.texts == []
    before.source.close()
    answer = await ros.call("/hello", "std_srvs/srv/SetBool", b"\0\1\0\0\1", 20.0)
    assert deserialize_message(answer, SetBool.Response).message == "Hello, world!"
    await until(lambda: ros.graph() and ros.battery() is not None)
    assert ros.battery() == pytest.approx(0.5)


def test_only_a_graph_of_several_machines_depends_on_addresses(
    ros: Ros2Platform, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert not ros.depends_on_addresses()
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET")
    assert ros.depends_on_addresses()
