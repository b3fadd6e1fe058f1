"""Assets of Foxglove clients, by websocket bytes."""

from __future__ import annotations

import struct
from typing import Any

from relay_protocol import link
from relay_protocol.rights import Level
from relay_server.common.byte_budget import ByteBudget
from tests.worlds.foxglove_client import Foxglove, FoxgloveWorld
from tests.worlds.relay import STRING, text

MESH_BYTES = 1_500_000


def test_an_asset_is_fetched_from_the_robot(world: FoxgloveWorld) -> None:
    client = world.client()
    world.settle(client)
    client.take()
    client.sends("fetchAsset", uri="package://rover/mesh.stl", requestId=5)
    (asked,) = world.link.take(link.GetAsset)
    world.channel.message(link.AssetPart(number=asked.number, offset=0, size=4, data=b"mesh"))
    client.run()
    assert client.take() == [struct.pack("<BIBI", 4, 5, 0, 0) + b"mesh"]


def test_a_client_that_reads_slowly_gets_every_mesh_it_fetches(world: FoxgloveWorld) -> None:
    """Also when it requests all at once, as Lichtblick does."""
    client = world.client()
    world.settle(client)
    client.take()
    queue = world.people[0].port.send_queue
    for number in range(60):
        client.sends("fetchAsset", uri=f"package://rover/{number}.stl", requestId=number)
    answers: list[Any] = []
    # One turn for each, and one until it is known that it was read.
    for _ in range(2 * 60):
        queue.pause()
        _send_meshes(world)
        assert queue.waiting_bytes < 2 * MESH_BYTES
        queue.resume()
        answers += client.take()
    assert {each for each in answers if isinstance(each, bytes)} == {
        struct.pack("<BIBI", 4, number, 0, 0) + bytes(MESH_BYTES) for number in range(60)
    }


def test_meshes_that_a_user_does_not_read_are_bounded_over_connections(world: FoxgloveWorld) -> None:
    """Those of other connections wait for the memory, and all come in the end."""
    budget = world.gate.asset_budget = ByteBudget(1_000_000, 1_500_000)
    world.gate.person("ann", Level.OPERATOR)
    clients = [Foxglove(world.gate, "ann") for _ in range(4)]
    other = world.client(name="bob")
    world.settle(*clients, other)
    ports = [each.port for each in world.people]
    for port in ports[:-1]:
        port.send_queue.pause()
    for n, client in enumerate([*clients, other]):
        for number in range(4):
            client.sends("fetchAsset", uri=f"package://rover/{n}-{number}.stl", requestId=number)
    for _ in range(20):
        _send_parts(world, 400_000)
        other.run()
        assert budget.reserved <= 1_500_000
        assert sum(port.waiting_bytes for port in ports[:-1]) <= 1_000_000
    assert len(_assets(other)) == 4
    clients[0].transport.abortConnection()
    got = []
    for _ in range(40):
        for port, client in zip(ports[1:-1], clients[1:], strict=True):
            port.send_queue.resume()
            client.run()
        _send_parts(world, 400_000)
        assert budget.reserved <= 1_000_000
    for client in clients[1:]:
        got += _assets(client)
    assert [len(each) for each in got] == 12 * [400_010]
    assert budget.reserved == 0


def test_a_mesh_that_was_sent_counts_until_it_is_read(world: FoxgloveWorld) -> None:
    budget = world.gate.asset_budget
    client = world.client()
    world.settle(client)
    queue, written = world.people[0].port.send_queue, list[int]()

    def fill(frame: bytes) -> None:
        written.append(len(frame))
        queue.pause()

    queue.write = fill
    client.sends("fetchAsset", uri="package://rover/mesh.stl", requestId=5)
    _send_parts(world, 400_000)
    _send_parts(world, 400_000)
    assert [size for size in written if size > 400_000]
    world.clock.advance(0)
    assert budget.reserved == world.people[0].port.waiting_bytes == 400_000
    queue.resume()
    world.clock.advance(0)
    assert budget.reserved == world.people[0].port.waiting_bytes == 0


def _send_parts(world: FoxgloveWorld, size: int) -> None:
    """The robot sends a part of each mesh that is requested: first a small one."""
    for asked in world.link.take(link.GetAsset):
        data = bytes(size - asked.offset if asked.offset else 1000)
        world.channel.message(link.AssetPart(number=asked.number, offset=asked.offset, size=size, data=data))
    world.clock.advance(0)


def _assets(client: Foxglove) -> list[bytes]:
    return [each for each in client.take() if isinstance(each, bytes) and each[0] == 4]


def test_a_mesh_waits_for_a_slow_client_beside_large_messages(world: FoxgloveWorld) -> None:
    """Neither displaces the other, however much waits."""
    topics = {f"/cloud{n}": link.Topic(types=[STRING], publishers=["/lidar"]) for n in range(3)}
    world.registry.graph(world.robot, link.Graph(topics=topics))
    client = world.client()
    world.settle(client)
    channels = client.channels()
    numbers = []
    for id, topic in enumerate(topics):
        client.sends("subscribe", subscriptions=[{"id": id, "channelId": channels[topic]["id"]}])
        numbers.append(world.link.take(link.Subscribe)[-1].number)
        world.subscribed(numbers[-1])
    world.people[0].port.send_queue.pause()
    client.sends("fetchAsset", uri="package://rover/mesh.stl", requestId=5)
    for stamp in (1, 2):
        for number in numbers:
            world.channel.sample(number, text("x" * 900_000), stamp)
        _send_meshes(world, 5_000_000)
    world.people[0].port.send_queue.resume()
    answers = [each for each in client.take() if isinstance(each, bytes)]
    assert struct.pack("<BIBI", 4, 5, 0, 0) + bytes(5_000_000) in answers
    received = [struct.unpack_from("<IQ", each, 1) for each in answers if each[0] == 1]
    assert sorted(received) == [(id, 2) for id in range(3)]


def _send_meshes(world: FoxgloveWorld, size: int = MESH_BYTES) -> None:
    """The robot sends the meshes that are requested."""
    for asked in world.link.take(link.GetAsset):
        data = bytes(size)
        world.channel.message(link.AssetPart(number=asked.number, offset=0, size=len(data), data=data))
    world.clock.advance(0)


def test_assets_need_the_right_to_the_robots_description(world: FoxgloveWorld) -> None:
    client = world.client(deny=("subscribe:/robot_description",))
    world.settle(client)
    client.take()
    client.sends("fetchAsset", uri="package://rover/mesh.stl", requestId=5)
    (answer,) = client.take()
    assert isinstance(answer, bytes)
    assert b"/robot_description" in answer
    assert world.link.take(link.GetAsset) == []


def test_an_asset_that_can_not_be_fetched_is_refused_with_a_reason(world: FoxgloveWorld) -> None:
    client = world.client()
    world.settle(client)
    client.take()
    client.sends("fetchAsset", uri="package://rover/mesh.stl", requestId=5)
    (asked,) = world.link.take(link.GetAsset)
    world.channel.message(
        link.Failed(request="get_asset", reference=str(asked.number), reason="no such file")
    )
    client.run()
    (answer,) = client.take()
    assert isinstance(answer, bytes)
    length = len(answer) - 10
    assert answer[:10] == struct.pack("<BIBI", 4, 5, 1, length)
    assert b"package://rover/mesh.stl" in answer
