"""A node of the robot that is killed and started again."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import pytest_twisted
from example_interfaces.action import Fibonacci
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import String
from std_srvs.srv import SetBool

from relay_protocol import link
from relay_protocol.errors import SwitchboardError
from robot_client.modules.readiness import check_ready, ready_endpoints
from robot_client.modules.settings import ModuleSettings
from robot_client.platforms.base import ABORTED, SUCCEEDED, GoalOutcome
from robot_client.platforms.ros2.goals import RosGoal
from robot_client.platforms.ros2.platform import Ros2Platform
from tests.robot_client.ros import Peer, until

SOON = """<?xml version="1.0" encoding="UTF-8" ?>
<profiles xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <participant profile_name="mortal" is_default_profile="true"><rtps><builtin><discovery_config>
    <leaseDuration><sec>3</sec></leaseDuration>
    <leaseAnnouncement><sec>1</sec></leaseAnnouncement>
  </discovery_config></builtin></rtps></participant>
</profiles>
"""
"""Lets a dead node be noticed after 3 s; 20 s is what is usual."""


class Node:
    """A process that can be killed and started again, with the same topic, service and action."""

    def __init__(self, environment: dict[str, str], suffix: str) -> None:
        self._environment = environment
        self.topic, self.service, self.action = (f"/{each}_{suffix}" for each in ("news", "invert", "work"))
        self.start("forever")

    def start(self, kind: str) -> None:
        self.peer = Peer(self._environment)
        self.peer.do("advertise", self.topic)
        self.peer.do("serve", self.service, "invert")
        self.peer.do("act", self.action, kind)


@pytest.fixture(scope="module")
def mortal(environment: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    profile: Path = tmp_path_factory.mktemp("dds") / "profile.xml"
    profile.write_text(SOON)
    return {**environment, "FASTRTPS_DEFAULT_PROFILES_FILE": str(profile)}


@pytest.fixture
def node(mortal: dict[str, str], ros: Ros2Platform) -> Iterator[Node]:
    made = Node(mortal, ros._nodes.kind)
    yield made
    made.peer.close()


async def invert(ros: Ros2Platform, service: str) -> bool:
    """Whether the service answers, given some tries."""
    request = bytes(serialize_message(SetBool.Request(data=False)))
    try:
        answer = await ros.call(service, "std_srvs/srv/SetBool", request, 1.0)
    except SwitchboardError:
        return False
    return bool(deserialize_message(answer, SetBool.Response).success)


def pursue(ros: Ros2Platform, action: str, outcomes: list[GoalOutcome], fed: list[bytes]) -> RosGoal:
    goal = bytes(serialize_message(Fibonacci.Goal(order=4)))
    begun = ros.send_goal(action, "example_interfaces/action/Fibonacci", goal, fed.append)
    begun.result.addCallback(outcomes.append)
    return begun


@pytest_twisted.ensureDeferred
async def test_subscription_and_clients_work_with_a_restarted_node(ros: Ros2Platform, node: Node) -> None:
    """The goal of the killed server ends with a reason."""
    await until(lambda: {node.topic} <= set(ros.graph().topics) and node.action in ros.graph().actions)
    heard: list[bytes] = []
    ros.subscribe(node.topic, "", None, heard.append, lambda: None)
    await until(lambda: node.peer.do("publish", node.topic, "before") or heard)
    assert await invert(ros, node.service)
    lost: list[GoalOutcome] = []
    fed: list[bytes] = []
    pursue(ros, node.action, lost, fed)
    await until(lambda: fed)

    node.peer.kill()
    node.start("count")

    def news() -> bool:
        ros.graph()
        node.peer.do("publish", node.topic, "after")
        return any(deserialize_message(body, String).data == "after" for body in heard)

    await until(news)
    for _ in range(20):
        if await invert(ros, node.service):
            break
    else:
        raise AssertionError("the service that came back was not reached")
    await until(lambda: lost)
    assert (lost[0].status, lost[0].body) == (ABORTED, None)
    assert "disappeared before the goal ended" in lost[0].reason
    ends: list[GoalOutcome] = []
    pursue(ros, node.action, ends, [])
    await until(lambda: ends)
    assert ends[0].status == SUCCEEDED
    there = link.Topic(types=["std_msgs/msg/String"], publishers=["/robot/peer"])
    await until(lambda: ros.graph().topics.get(node.topic) == there)


@pytest_twisted.ensureDeferred
async def test_module_is_ready_by_the_endpoints_of_its_new_process(ros: Ros2Platform, node: Node) -> None:
    """Those of the killed one stay in the graph for a while."""
    by_topic = ModuleSettings(name="a", command=["a"], ready_topic=node.topic)
    by_service = ModuleSettings(name="b", command=["b"], ready_service=node.service)
    first: dict[str, frozenset[bytes]] = {}
    for each in (by_topic, by_service):
        await until(lambda each=each: ready_endpoints(each, ros))
        assert await check_ready(each, ros, frozenset())
        first[each.name] = ready_endpoints(each, ros)

    node.peer.kill()
    for each in (by_topic, by_service):
        assert not await check_ready(each, ros, first[each.name])
    node.start("count")
    for each in (by_topic, by_service):
        await until(lambda each=each: ready_endpoints(each, ros) - first[each.name])
        assert await check_ready(each, ros, first[each.name])
