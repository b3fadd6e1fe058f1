"""Calls of services by the ROS 2 platform in a real graph."""

from __future__ import annotations

from typing import Any

import pytest
import pytest_twisted
from rclpy.client import Client
from rclpy.serialization import deserialize_message, serialize_message
from std_srvs.srv import SetBool, Trigger
from twisted.internet import reactor, task

from relay_protocol.errors import Invalid, NotFound, Refused, SwitchboardError, Unavailable
from robot_client.platforms.ros2 import service_calls
from robot_client.platforms.ros2.platform import Ros2Platform
from tests.robot_client.ros import Peer
from tests.worlds.ros_endpoints import seen

TRIGGER = "std_srvs/srv/Trigger"

pytestmark = pytest.mark.parametrize("ros", ["events"], indirect=True, scope="module")


async def failure(call: Any) -> SwitchboardError:
    try:
        await call
    except SwitchboardError as error:
        return error
    raise AssertionError("the call was answered")


@pytest_twisted.ensureDeferred
async def test_service_is_called(ros: Ros2Platform, peer: Peer) -> None:
    peer.do("serve", "/invert", "invert")
    await seen(ros, lambda graph: "/invert" in graph.services)
    request = bytes(serialize_message(SetBool.Request(data=True)))
    answer = deserialize_message(await ros.call("/invert", "std_srvs/SetBool", request, 10), SetBool.Response)
    assert (answer.success, answer.message) == (False, "inverted")


@pytest_twisted.ensureDeferred
async def test_failed_calls_have_the_reason(ros: Ros2Platform, peer: Peer) -> None:
    """No such service, another type, invalid arguments, no response in time."""
    peer.do("serve", "/slow", "slow")
    peer.do("serve", "/invert2", "invert")
    await seen(ros, lambda graph: "/slow" in graph.services and "/invert2" in graph.services)
    empty = bytes(serialize_message(Trigger.Request()))
    assert isinstance(await failure(ros.call("/nowhere", TRIGGER, empty, 30)), NotFound)
    assert "std_srvs/srv/SetBool" in str(await failure(ros.call("/invert2", TRIGGER, empty, 30)))
    assert isinstance(await failure(ros.call("/invert2", "std_srvs/srv/SetBool", b"", 30)), Invalid)
    assert isinstance(await failure(ros.call("bad name", TRIGGER, empty, 30)), Invalid)
    late = await failure(ros.call("/slow", TRIGGER, empty, 0.3))
    assert isinstance(late, Unavailable)
    assert "0.3 s" in str(late)


@pytest_twisted.ensureDeferred
async def test_check_runs_when_the_service_is_found(
    ros: Ros2Platform, peer: Peer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A refused request is not sent."""
    peer.do("serve", "/hidden", "invert")
    await seen(ros, lambda graph: "/hidden" in graph.services)
    before = len(peer.reported("inverted", True))
    found: list[bool] = []
    stopped: list[bool] = []

    def check() -> None:
        if stopped:
            raise Refused("the robot is stopped")

    def call(data: bool) -> Any:
        request = bytes(serialize_message(SetBool.Request(data=data)))
        return ros.call("/hidden", "std_srvs/srv/SetBool", request, 10, check)

    monkeypatch.setattr(Client, "service_is_ready", lambda client: bool(found))
    refused = call(True)
    stopped.append(True)
    found.append(True)
    assert "the robot is stopped" in str(await failure(refused))
    monkeypatch.undo()
    stopped.clear()
    assert await call(False)
    assert len(peer.reported("inverted", True)) == before


@pytest_twisted.ensureDeferred
async def test_call_ends_when_its_service_disappears(ros: Ros2Platform, peer: Peer) -> None:
    """Long before the timeout."""
    peer.do("serve", "/doomed", "slow")
    await seen(ros, lambda graph: "/doomed" in graph.services)
    call = ros.call("/doomed", TRIGGER, bytes(serialize_message(Trigger.Request())), 600)
    await task.deferLater(reactor, 0.3)
    peer.do("unserve", "/doomed")
    assert isinstance(await failure(call), SwitchboardError)


@pytest_twisted.ensureDeferred
async def test_prepared_service_needs_no_discovery(
    ros: Ros2Platform, peer: Peer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service_calls, "IDLE_SECONDS", -1.0)
    peer.do("serve", "/switch", "invert")
    await seen(ros, lambda graph: "/switch" in graph.services)
    ros.prepare_call("/switch", "std_srvs/srv/SetBool")
    request = bytes(serialize_message(SetBool.Request(data=True)))
    await ros.call("/switch", "std_srvs/srv/SetBool", request, 10)
    ros.graph()
    monkeypatch.setattr(service_calls, "DISCOVERY_SECONDS", -1.0)
    assert await ros.call("/switch", "std_srvs/srv/SetBool", request, 10)
    peer.do("unserve", "/switch")
    await seen(ros, lambda graph: "/switch" not in graph.services)
    assert isinstance(await failure(ros.call("/switch", "std_srvs/srv/SetBool", request, 10)), NotFound)
