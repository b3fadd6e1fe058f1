"""Services that the platform advertises in a real graph, with either executor."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import pytest_twisted
from example_interfaces.srv import AddTwoInts
from rclpy.serialization import deserialize_message, serialize_message
from twisted.internet import reactor, task

from relay_protocol.errors import Invalid
from robot_client.platforms.base import AdvertisementHandle
from robot_client.platforms.ros2.platform import Ros2Platform
from tests.robot_client.ros import Peer, until
from tests.worlds.ros_endpoints import node

ADD = "example_interfaces/srv/AddTwoInts"


class Client:
    """A client of the relay that responds, now or later."""

    def __init__(self, ros: Ros2Platform, service: str, type: str = ADD) -> None:
        self.calls: list[tuple[AddTwoInts.Request, Callable[[bytes], None]]] = []
        self.offer: AdvertisementHandle = ros.advertise_service(service, type, self.take)

    def take(self, body: bytes, answer: Callable[[bytes], None]) -> None:
        self.calls.append((deserialize_message(body, AddTwoInts.Request), answer))

    def answer(self, number: int) -> None:
        request, answer = self.calls[number]
        answer(bytes(serialize_message(AddTwoInts.Response(sum=request.a + request.b))))


async def called(ros: Ros2Platform, peer: Peer, service: str, a: int, b: int) -> Client:
    """A client that offers a service, once a node's call has come to it."""
    client = Client(ros, service)
    peer.record.clear()
    peer.do("call", service, a, b)
    await until(lambda: client.calls)
    return client


@pytest_twisted.ensureDeferred
async def test_call_is_answered_by_the_client(ros: Ros2Platform, peer: Peer) -> None:
    client = await called(ros, peer, "/sum", 2, 3)
    client.answer(0)
    await until(lambda: peer.reported("answer", "/sum"))
    assert peer.reported("answer", "/sum")[0]["sum"] == 5
    client.offer.close()


def test_full_type_of_a_service_is_reported(ros: Ros2Platform) -> None:
    client = Client(ros, "/spelled", "example_interfaces/AddTwoInts")
    assert client.offer.type == ADD
    client.offer.close()


@pytest_twisted.ensureDeferred
async def test_pending_call_does_not_block_others(ros: Ros2Platform, peer: Peer) -> None:
    slow, quick = Client(ros, "/slow_sum"), Client(ros, "/quick_sum")
    peer.record.clear()
    for a in range(5):
        peer.do("call", "/slow_sum", a, 0)
    peer.do("call", "/quick_sum", 1, 1)
    await until(lambda: len(slow.calls) == 5 and quick.calls)
    quick.answer(0)
    await until(lambda: peer.reported("answer", "/quick_sum"))
    assert peer.reported("answer", "/slow_sum") == []
    by_a = {request.a: number for number, (request, _) in enumerate(slow.calls)}
    for a in (4, 0, 2, 1, 3):
        slow.answer(by_a[a])
        await until(lambda a=a: [each for each in peer.reported("answer", "/slow_sum") if each["a"] == a])
    assert [each["sum"] for each in peer.reported("answer", "/slow_sum")] == [4, 0, 2, 1, 3]
    assert ros.fault() is None
    for client in (slow, quick):
        client.offer.close()


@pytest_twisted.ensureDeferred
async def test_pending_call_causes_no_load(ros: Ros2Platform, peer: Peer) -> None:
    client = await called(ros, peer, "/idle_sum", 1, 1)
    turns = 0
    once = ros._nodes.main._executor.spin_once

    class Counted:
        """An executor whose turns are counted."""

        def spin_once(self, timeout_sec: float) -> None:
            nonlocal turns
            turns += 1
            once(timeout_sec=timeout_sec)

        def __getattr__(self, name: str) -> Any:
            return getattr(executor, name)

    executor, ros._nodes.main._executor = ros._nodes.main._executor, Counted()
    await task.deferLater(reactor, 0.5)
    ros._nodes.main._executor = executor
    assert turns < 200
    client.offer.close()


@pytest_twisted.ensureDeferred
async def test_invalid_responses_are_refused(ros: Ros2Platform, peer: Peer) -> None:
    client = await called(ros, peer, "/odd_sum", 1, 2)
    with pytest.raises(Invalid, match="no response of type example_interfaces/srv/AddTwoInts"):
        client.calls[0][1](b"\0\1")
    client.answer(0)
    await until(lambda: peer.reported("answer", "/odd_sum"))
    client.offer.close()


@pytest_twisted.ensureDeferred
async def test_withdrawn_service_can_be_advertised_again(ros: Ros2Platform, peer: Peer) -> None:
    """Late responses are dropped."""
    client = await called(ros, peer, "/brief_sum", 1, 1)
    client.offer.close()
    client.answer(0)
    again = Client(ros, "/brief_sum")
    while not again.calls:
        # A request to the withdrawn server is lost while ROS still lists it.
        peer.do("call", "/brief_sum", 7, 1)
        await task.deferLater(reactor, 0.2)
    again.answer(0)
    await until(lambda: peer.reported("answer", "/brief_sum"))
    assert {each["a"] for each in peer.reported("answer", "/brief_sum")} == {7}
    again.offer.close()
    served = ros._node.get_service_names_and_types_by_node
    await until(lambda: "/brief_sum" not in dict(served("switchboard_test", "/")))


@pytest_twisted.ensureDeferred
async def test_client_of_a_service_does_not_block_its_advertisement(ros: Ros2Platform, peer: Peer) -> None:
    with node("waiting") as waiting:
        waiting.create_client(AddTwoInts, "/awaited_sum")
        known = ros._node.get_service_names_and_types
        await until(lambda: "/awaited_sum" in dict(known()))
        Client(ros, "/awaited_sum").offer.close()
