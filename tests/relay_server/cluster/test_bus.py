"""The bus between relays: the same tests for the bus of a single relay and for a real NATS cluster of three."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import pytest_twisted
from nats.js.errors import NotFoundError
from twisted.internet import reactor
from twisted.internet.defer import Deferred

from relay_protocol.errors import Invalid, Refused, Unavailable
from relay_server.cluster.bus import (
    LARGEST,
    ClusterBus,
    LeaseUnavailable,
    LocalBus,
    NoResponder,
    RequestRefused,
)
from relay_server.cluster.nats_bus import BUCKET, NatsBus
from tests.worlds.nats_servers import NatsServer, nats_cluster, nats_server
from tests.worlds.waiting import PATIENCE, eventually

LEASE_SECONDS = 2.0


@pytest.fixture(scope="module")
def servers(tmp_path_factory: pytest.TempPathFactory) -> Iterator[list[NatsServer]]:
    with nats_cluster(tmp_path_factory.mktemp("nats")) as servers:
        yield servers


@dataclass
class Buses:
    """The buses of two relays; a single relay has the same bus twice."""

    first: ClusterBus
    second: ClusterBus
    seen: list[tuple[str, bytes]] = field(default_factory=list)

    def see(self, subject: str, body: bytes) -> None:
        """Stores a message."""
        self.seen.append((subject, body))


@pytest_twisted.async_yield_fixture(params=["local", "nats"])
async def buses(request: pytest.FixtureRequest) -> Any:
    if request.param == "local":
        bus = LocalBus(reactor)
        yield Buses(bus, bus)
        return
    addresses = [each.url for each in request.getfixturevalue("servers")]
    buses = Buses(*(NatsBus(reactor, addresses, replicas=3, lease_seconds=LEASE_SECONDS) for _ in range(2)))
    for each in (buses.first, buses.second):
        await each.start()
        await eventually("it is connected", lambda each=each: each.connected)
    await _ready(buses)
    yield buses
    for each in (buses.first, buses.second):
        await each.stop()


async def _ready(buses: Buses) -> None:
    """Waits until subscriptions of the first relay reach the second, and until leases can be written."""
    for bus, other in ((buses.first, buses.second), (buses.second, buses.first)):
        end = bus.subscribe("ready", lambda subject, body: body)
        await _until_it_responds(other, "ready")
        end()
    await _until_it_leases(buses.first)


async def _until_it_leases(bus: ClusterBus) -> None:
    while True:
        try:
            lease = await bus.lease("ready.now", b"")
        except Unavailable:
            continue
        await lease.release()
        return


async def _until_it_responds(bus: ClusterBus, subject: str) -> None:
    while True:
        try:
            await bus.request(subject, b"", 1.0)
        except Unavailable:
            continue
        return


@pytest_twisted.ensureDeferred
async def test_messages_arrive_in_order(buses: Buses) -> None:
    buses.second.subscribe("robots.*.moved", buses.see)
    buses.second.subscribe("ready", lambda subject, body: body)
    await _until_it_responds(buses.first, "ready")
    for number in range(100):
        buses.first.publish("robots.7.moved", b"%d" % number)
        buses.first.publish("robots.7.other", b"x")
    await eventually("all have come", lambda: len(buses.seen) == 100)
    assert buses.seen == [("robots.7.moved", b"%d" % number) for number in range(100)]


@pytest.mark.parametrize(
    ("pattern", "subject", "received"),
    [
        ("a", "a", True),
        ("a", "a.b", False),
        ("a.*", "a.b", True),
        ("a.*", "a", False),
        ("a.*", "a.b.c", False),
        ("a.>", "a.b.c", True),
        ("a.>", "a", False),
        ("*.b", "a.b", True),
    ],
)
@pytest_twisted.ensureDeferred
async def test_patterns(buses: Buses, pattern: str, subject: str, received: bool) -> None:
    buses.second.subscribe(pattern, lambda subject, body: b"yes")
    buses.second.subscribe("last", lambda subject, body: b"")
    await _until_it_responds(buses.first, "last")
    try:
        reply = await buses.first.request(subject, b"", PATIENCE)
    except NoResponder:
        reply = b"no"
    assert (reply == b"yes") is received


@pytest_twisted.ensureDeferred
async def test_a_subscription_ends(buses: Buses) -> None:
    end = buses.second.subscribe("topic", lambda subject, body: body)
    await _until_it_responds(buses.first, "topic")
    end()
    end()

    async def refused() -> bool:
        try:
            await buses.first.request("topic", b"", 0.2)
        except NoResponder:
            return True
        except Unavailable:
            return False
        return False

    while not await refused():
        pass


@pytest_twisted.ensureDeferred
async def test_a_queue_delivers_each_message_once(buses: Buses) -> None:
    for bus in (buses.first, buses.second):
        bus.subscribe("work", buses.see, queue="workers")
        bus.subscribe("ready", lambda subject, body: b"", queue="workers")
        await _until_it_responds(buses.second, "ready")
    for number in range(20):
        buses.first.publish("work", b"%d" % number)
    buses.first.publish("work", b"last")
    await eventually("all have come", lambda: len(buses.seen) == 21)
    assert sorted(body for _, body in buses.seen[:21]) == sorted([b"%d" % n for n in range(20)] + [b"last"])


@pytest_twisted.ensureDeferred
async def test_requests_are_replied_to_later(buses: Buses) -> None:
    replies: list[Deferred[bytes]] = []

    def receive(subject: str, body: bytes) -> Deferred[bytes]:
        reply: Deferred[bytes] = Deferred()
        replies.append(reply)
        return reply

    buses.second.subscribe("ready", lambda subject, body: body)
    buses.second.subscribe("later", receive)
    await _until_it_responds(buses.first, "ready")
    waiting = [Deferred.fromCoroutine(buses.first.request("later", b"", PATIENCE)) for _ in range(3)]
    await eventually("all have come", lambda: len(replies) == 3)
    for number, reply in enumerate(replies):
        reply.callback(b"%d" % number)
    assert sorted([await each for each in waiting]) == [b"0", b"1", b"2"]


@pytest_twisted.ensureDeferred
async def test_a_refusal_reaches_the_sender_with_its_reason(buses: Buses) -> None:
    def receive(subject: str, body: bytes) -> bytes:
        raise Refused("toad may not stop mobile")

    buses.second.subscribe("stop", receive)
    buses.second.subscribe("ready", lambda subject, body: body)
    await _until_it_responds(buses.first, "ready")
    with pytest.raises(RequestRefused, match=r"^toad may not stop mobile$"):
        await buses.first.request("stop", b"", PATIENCE)


@pytest_twisted.ensureDeferred
async def test_a_request_without_reply_ends(buses: Buses) -> None:
    with pytest.raises(NoResponder, match="no relay responds to nobody"):
        await buses.first.request("nobody", b"", PATIENCE)
    buses.second.subscribe("silent", lambda subject, body: Deferred())
    buses.second.subscribe("ready", lambda subject, body: body)
    await _until_it_responds(buses.first, "ready")
    with pytest.raises(Unavailable, match=r"no reply to silent within 0\.05 s"):
        await buses.first.request("silent", b"", 0.05)


@pytest_twisted.ensureDeferred
async def test_single_relay_has_a_lease(buses: Buses) -> None:
    lease = await buses.first.lease("relays.one", b"10.0.0.1:9092")
    assert await buses.second.leases("relays") == {"relays.one": b"10.0.0.1:9092"}
    with pytest.raises(LeaseUnavailable, match=r"another relay has the lease relays\.one"):
        await buses.second.lease("relays.one", b"10.0.0.2:9092")
    await lease.release()
    await lease.release()
    assert await buses.second.leases("relays") == {}
    taken = await buses.second.lease("relays.one", b"10.0.0.2:9092")
    assert await buses.first.leases("relays") == {"relays.one": b"10.0.0.2:9092"}
    assert await buses.first.leases("relay") == {}
    await taken.release()


@pytest.mark.parametrize(
    "subject", ["", ".", "a.", "a b", "a.*", ">", "a\n", "ü", "a" * 65, ".".join("abcdefghi")]
)
@pytest_twisted.ensureDeferred
async def test_subjects_are_checked(buses: Buses, subject: str) -> None:
    with pytest.raises(Invalid, match="is not a subject"):
        buses.first.publish(subject, b"")
    with pytest.raises(Invalid):
        await buses.first.request(subject, b"", PATIENCE)
    with pytest.raises(Invalid):
        await buses.first.lease(subject, b"")


def test_patterns_and_sizes_are_checked() -> None:
    bus = LocalBus(reactor)
    for pattern in ("", ">", "a.>.b", "a*", "a..b"):
        with pytest.raises(Invalid, match="is not a pattern"):
            bus.subscribe(pattern, lambda subject, body: None)
    with pytest.raises(Invalid, match="too long for the bus"):
        bus.publish("a", b"x" * (LARGEST + 1))


# --- NATS only -------------------------------------------------------------------------------------------


@pytest_twisted.ensureDeferred
async def test_a_lease_outlasts_its_duration_and_ends_with_its_relay(servers: list[NatsServer]) -> None:
    buses = [NatsBus(reactor, [servers[0].url], replicas=3, lease_seconds=LEASE_SECONDS) for _ in range(2)]
    for each in buses:
        await each.start()
        await eventually("it is connected", lambda each=each: each.connected)
    await _ready(Buses(*buses))
    lost: list[str] = []
    lease = await buses[0].lease("relays.dies", b"here")
    lease.on_lost = lambda: lost.append("lost")
    renewed = lease._revision
    await eventually("it is renewed for longer than it lasts", lambda: lease._revision > renewed + 4)
    assert await buses[1].leases("relays") == {"relays.dies": b"here"}
    # The relay's reactor hangs, so leases are not renewed.
    lease._loop.stop()
    while await buses[1].leases("relays"):
        pass
    lease._loop.start(0.1)
    await eventually("the first relay notices", lambda: lost == ["lost"])
    for each in buses:
        await each.stop()


@pytest_twisted.ensureDeferred
async def test_a_lost_server_is_replaced_by_another(servers: list[NatsServer]) -> None:
    bus = NatsBus(reactor, [each.url for each in servers], replicas=3)
    states: list[bool] = []
    bus.on_state(states.append)
    await bus.start()
    await eventually("it is connected", lambda: bus.connected)
    bus.subscribe("echo", lambda subject, body: body)
    await _until_it_responds(bus, "echo")
    connected = next(each for each in servers if each.url == bus._client.connected_url.geturl())
    connected.kill()
    await eventually("it notices, and connects to another", lambda: states[:3] == [True, False, True])
    await _until_it_responds(bus, "echo")
    connected.start()
    await eventually("the server is back", connected.listens)
    await bus.stop()


@pytest_twisted.ensureDeferred
async def test_without_servers_everything_is_refused_with_a_reason(tmp_path: Path) -> None:
    with nats_cluster(tmp_path) as servers:
        address = servers[0].url
    bus = NatsBus(reactor, [address.replace("nats://", "nats://relay:secret@")])
    await bus.start()
    assert not bus.connected
    bus.publish("a", b"lost")
    for work in (bus.request("a", b"", 1.0), bus.lease("a", b""), bus.leases("a")):
        with pytest.raises(Unavailable, match="the bus between the relays is disconnected") as caught:
            await work
        assert "secret" not in str(caught.value)
    await bus.stop()


@pytest_twisted.ensureDeferred
async def test_a_relay_leaves_a_bus_whose_server_stands_still(tmp_path: Path) -> None:
    with nats_server(tmp_path) as server:
        bus = NatsBus(reactor, [server.url])
        await bus.start()
        assert bus.connected
        server.freeze()
        try:
            await bus.stop()
        finally:
            server.thaw()
    assert not bus._thread.is_alive()


@pytest_twisted.ensureDeferred
async def test_leases_are_stored_by_three_servers_also_if_one_address_is_given(
    servers: list[NatsServer],
) -> None:
    """Those that were stored by one before get more copies."""

    async def answered(bus: NatsBus, ask: Callable[[Any], Any]) -> Any:
        """The servers' answer; they may be electing a leader."""
        while True:
            try:
                return await bus._deferred(ask(bus._client.jetstream()))
            except TimeoutError:
                continue

    before = NatsBus(reactor, [servers[0].url])
    await before.start()
    await _until_it_leases(before)
    with suppress(NotFoundError):
        await answered(before, lambda stream: stream.delete_key_value(BUCKET))
    await before.stop()
    for replicas, expected in ((1, 1), (None, 3)):
        bus = NatsBus(reactor, [servers[0].url], replicas=replicas)
        await bus.start()
        await _until_it_leases(bus)
        info = await answered(bus, lambda stream: stream.stream_info(f"KV_{BUCKET}"))
        assert info.config.num_replicas == expected
        await bus.stop()
