"""The edge towards robots: bytes on transports in memory, a real database behind."""

from __future__ import annotations

from typing import Any

import pytest
import pytest_twisted

from relay_db import queries
from relay_protocol import identity, limits, link
from relay_protocol.frames import encode_json, encode_sample, encode_video
from relay_server.auth import login_limiter
from relay_server.events.bus import BURST
from relay_server.robots.connection import PINGS, REPLACED_SECONDS
from relay_server.robots.link_roles import FLAPPING_SECONDS, MOST_PATIENCE
from relay_server.robots.registry import REPLACE_SECONDS
from tests.relay_server.edges.robot_ends import FINGERPRINT, KEY, Hall, until

# --- registering ------------------------------------------------------------------------------------------


@pytest_twisted.ensureDeferred
async def test_a_robot_that_proves_its_key_is_registered(hall: Hall) -> None:
    """Welcomed, online, with heartbeats both ways and the large frame limit."""
    robot = hall.dial()
    welcome = await robot.registers()
    assert (welcome["op"], welcome["heartbeat"], welcome["frame_limit"]) == (
        "welcome",
        2.0,
        limits.ROBOT_FRAME,
    )
    assert hall.presence is not None
    assert hall.presence.control is robot.connection
    assert hall.presence.key == FINGERPRINT
    robot.sends(encode_json(b'{"op":"ping","t":7,"x":"' + b"x" * limits.HANDSHAKE_FRAME + b'"}'))
    assert {"op": "pong", "t": 7, "at": hall.world.now_ns()} in robot.hears()
    hall.world.clock.advance(limits.UNPROVEN_SECONDS)
    assert "refused" not in [each["op"] for each in robot.hears()]


@pytest_twisted.ensureDeferred
async def test_unknown_robots_and_wrong_keys_are_told_the_same(hall: Hall) -> None:
    """Both are challenged, and refused in the same words: who is enrolled here is nobody's business."""
    told = []
    other = bytes(reversed(KEY))
    for name, key, signer in (
        ("r2-d2", FINGERPRINT, other),
        ("r2-d2", identity.fingerprint(identity.public_half(other)), other),
        ("unknown", FINGERPRINT, KEY),
        ("r2-d2\x00", FINGERPRINT, KEY),
        ("", "", KEY),
    ):
        robot = hall.dial()
        robot.prove(robot.hello(name, key), name, signer)
        await robot.answered()
        told.append(robot.refusal())
    assert all(each == told[0] for each in told)
    assert told[0]["reason"].startswith("this key is not accepted for this robot")
    assert hall.presence is None


@pytest_twisted.ensureDeferred
async def test_a_robot_that_fails_too_often_is_refused_before_the_database_is_asked(
    hall: Hall, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ten failures of one robot from one network; the right key must wait then, from elsewhere it need not."""
    for _ in range(login_limiter.FAILURES):
        robot = hall.dial()
        robot.prove(robot.hello(), key=bytes(reversed(KEY)))
        await robot.answered()
        assert "not accepted" in robot.refusal()["reason"]
    with monkeypatch.context() as patch:
        patch.setattr(hall.store, "read", None)
        robot = hall.dial()
        robot.prove(robot.hello())
        await robot.answered()
    refusal = robot.refusal()
    assert "too many failures" in refusal["reason"]
    assert refusal["retry_after"] == login_limiter.WINDOW
    other = hall.dial()
    other.connection.address = "198.51.100.1"
    assert (await other.registers())["op"] == "welcome"
    await until(lambda: hall.journal._waiting == 0)
    assert len(await hall.store.read(queries.list_events, kind="robot.refused")) == login_limiter.FAILURES


@pytest_twisted.ensureDeferred
async def test_a_key_revoked_while_its_proof_is_judged_does_not_stay(
    hall: Hall, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The look for robots to cut may go by between reading the key and registering."""
    read = hall.store.read

    async def read_and_revoke(query: Any, *args: Any) -> Any:
        found = await read(query, *args)
        if found is not None:
            await hall.store.write(queries.revoke_key, found.robot_id, FINGERPRINT, 1000.0)
        return found

    monkeypatch.setattr(hall.store, "read", read_and_revoke)
    robot = hall.dial()
    robot.prove(robot.hello())
    await robot.answered()
    assert robot.hears()[-1] == {"op": "bye", "reason": "the robot's key is not accepted any more"}
    assert not robot.transport.connected
    assert not hall.online


@pytest_twisted.ensureDeferred
async def test_a_robots_flood_of_alerts_does_not_reach_the_database(hall: Hall) -> None:
    """Some are kept, the rest is counted; another robot's events are kept meanwhile, and that this one goes."""
    robot = await hall.registered()
    for number in range(5000):
        robot.says(link.Alert(level="error", text=str(number)))
    assert robot.transport.connected
    assert hall.journal.event("robot.online", "relay", cause="robot:other")
    await until(lambda: hall.journal._waiting == 0)
    kept = await hall.store.read(queries.list_events, kind="robot.alert")
    assert len(kept) == BURST
    robot.breaks()
    await until(lambda: not hall.online and hall.journal._waiting == 0)
    assert len(await hall.store.read(queries.list_events, kind="robot.offline")) == 1


@pytest_twisted.ensureDeferred
async def test_a_recorded_signature_is_worthless(hall: Hall) -> None:
    """It is good for one nonce of one connection, and for one try."""
    first, second = hall.dial(), hall.dial()
    nonce = first.hello()
    second.hello()
    second.prove(nonce)
    await second.answered()
    assert "not accepted" in second.refusal()["reason"]
    first.prove(nonce)
    first.prove(nonce)
    await first.answered()
    assert not hall.online


@pytest.mark.parametrize(
    ("messages", "words"),
    [
        ([link.Prove(signature="")], "'prove' came before 'hello'"),
        ([link.Hello(version=2, robot="x", key="", encodings=[])], "speaks version 1"),
        ([link.Enroll(version=9, robot="x", code="", public_key="")], "speaks version 1"),
        ([link.Join(version=0, ticket="x")], "speaks version 1"),
        ([link.Ping(t=1)], "unknown op 'ping'"),
        ([link.Welcome(session="", heartbeat=1, frame_limit=1)], "unknown op 'welcome'"),
    ],
)
def test_messages_out_of_place_break_the_contract(
    hall: Hall, messages: list[link.Message], words: str
) -> None:
    """Said by ``refused``, and the connection ends."""
    robot = hall.dial()
    for message in messages:
        robot.says(message)
    refusal = robot.refusal()
    assert words in refusal["reason"]
    assert refusal["code"] == "malformed"


def test_nothing_but_the_proof_comes_after_hello(hall: Hall) -> None:
    """Neither another hello nor a join."""
    for message in (
        link.Hello(version=1, robot="x", key="", encodings=[]),
        link.Join(version=1, ticket="x"),
        link.Enroll(version=1, robot="x", code="", public_key=""),
    ):
        robot = hall.dial()
        robot.hello()
        robot.says(message)
        assert "can't come after 'hello'" in robot.refusal()["reason"]


@pytest.mark.parametrize(
    "data",
    [
        b"\xff\xff\xff\xff",
        b"GET / HTTP/1.1\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",
        b"\x00\x00\x00\x00",
        b"\x00\x00\x00\x02\x09x",
        b"\x00\x00\x00\x02\x01x",
        encode_json(b"{"),
        encode_json(b"\xff\xff"),
        encode_json(b"[" * 1000),
        encode_sample(1, 2, b"x"),
        encode_video(1, 2, b"x"),
        encode_json(b"x" * limits.HANDSHAKE_FRAME),
    ],
)
def test_hostile_bytes_are_refused_in_words(hall: Hall, data: bytes) -> None:
    """Frames of 4 GiB, other protocols, junk, bulk before the proof: nothing is kept, nothing breaks."""
    robot = hall.dial()
    robot.sends(data)
    assert robot.refusal()["code"] in ("malformed", "frame_too_large")
    robot.sends(data)
    assert robot.hears() == []
    assert not [call for call in hall.world.clock.getDelayedCalls() if call.active()]


def test_a_trickle_is_cut_by_an_absolute_deadline(hall: Hall) -> None:
    """Each byte buys no time."""
    robot = hall.dial()
    robot.sends(b"\x00\x00\x10\x00")
    for _ in range(99):
        hall.world.clock.advance(0.1)
        robot.sends(b"x")
    assert robot.transport.connected
    hall.world.clock.advance(0.11)
    refusal = robot.refusal()
    assert "within 10 s" in refusal["reason"]
    assert refusal["retry_after"] == 5


def test_too_much_before_the_proof_is_cut(hall: Hall) -> None:
    """64 KiB in all, in however small pieces."""
    robot = hall.dial()
    message = encode_json(b'{"op":"hello","pad":"' + b"x" * 1000 + b'"')
    robot.sends(b"".join([message[:-1]] * 1))
    for _ in range(70):
        if robot.transport.connected:
            robot.sends(b"x" * 1000)
    assert not robot.transport.connected


@pytest_twisted.ensureDeferred
async def test_a_robot_that_leaves_while_the_database_is_asked_leaves_no_ghost(hall: Hall) -> None:
    """It is not registered on a connection that is gone, and may register again at once."""
    robot = hall.dial()
    robot.prove(robot.hello())
    robot.breaks()
    await robot.answered()
    assert not hall.online
    assert not [call for call in hall.world.clock.getDelayedCalls() if call.active()]
    assert (await hall.dial().registers())["op"] == "welcome"


def test_connections_of_one_address_are_capped(hall: Hall) -> None:
    """The one too many is told to come back; places are given back."""
    robots = [hall.dial() for _ in range(3)]
    one_more = hall.dial()
    refusal = one_more.refusal()
    assert "too many connections" in refusal["reason"]
    assert refusal["retry_after"] == 10
    robots[0].breaks()
    assert hall.dial().transport.connected


@pytest_twisted.ensureDeferred
async def test_strangers_are_capped_whatever_their_addresses(hall: Hall) -> None:
    """The one too many is told to come back; a robot that proves itself makes room, one that leaves too."""
    hall.cap._strangers = 2
    first, second = hall.dial(), hall.dial()
    refusal = hall.dial().refusal()
    assert "too many robots" in refusal["reason"]
    assert refusal["retry_after"] == 10
    assert (await first.registers())["op"] == "welcome"
    assert hall.dial().transport.connected
    first.breaks()
    assert not hall.dial().transport.connected
    second.breaks()
    assert hall.dial().transport.connected


# --- registered -------------------------------------------------------------------------------------------


@pytest_twisted.ensureDeferred
async def test_what_a_robot_tells_of_itself_is_kept(hall: Hall) -> None:
    """Facts, graph and health."""
    robot = await hall.registered()
    robot.says(link.Describe(host="shed"))
    robot.says(link.Graph(full=True, nodes={"/n": {}}))
    robot.says(link.Health(battery=0.5))
    robot.says(link.Alert(level="warning", text="\x1b[2J" + "x" * 10_000))
    presence = hall.presence
    assert presence is not None
    assert (presence.description.host, presence.graph.nodes, presence.health.battery) == ("shed", {"/n"}, 0.5)


@pytest.mark.parametrize("op", ["graph", "alert"])
@pytest_twisted.ensureDeferred
async def test_a_control_link_takes_no_large_frame(hall: Hall, op: str) -> None:
    """What could stall the relay is refused by its length, before it is there."""
    robot = await hall.registered()
    robot.sends((limits.CONTROL_FRAME + 1).to_bytes(4, "big") + b'\x00{"op":"' + op.encode())
    assert robot.refusal()["code"] == "frame_too_large"
    assert not hall.online


@pytest_twisted.ensureDeferred
async def test_a_graph_without_end_is_refused_in_words(hall: Hall) -> None:
    """The robot is cut and what it told is forgotten."""
    robot = await hall.registered()
    ends = ["/" + "n" * 200 + str(number) for number in range(limits.GRAPH_ENDS)]
    for number in range(40):
        robot.says(link.Graph(topics={f"/t{number}": link.Topic(types=["a/msg/B"], publishers=ends)}))
    assert "graph takes more than 8 MiB" in robot.refusal()["reason"]
    assert hall.presence is not None
    assert not hall.presence.graph.topics


@pytest_twisted.ensureDeferred
async def test_a_silent_robot_is_cut_after_three_heartbeats(hall: Hall) -> None:
    """It is pinged meanwhile; one that answers stays, and its round trip is known."""
    robot = await hall.registered()
    for _ in range(4):
        hall.world.clock.advance(2)
        for each in robot.hears():
            hall.world.clock.advance(0.01)
            robot.says(link.Pong(t=each["t"], at=0))
    assert hall.presence is not None
    assert hall.presence.rtt == pytest.approx(0.01)
    hall.world.clock.pump([2.0] * 3)
    assert hall.presence.control is not None
    hall.world.clock.pump([2.0] * 1)
    assert robot.transport.aborted
    assert hall.presence.control is None
    assert not [call for call in hall.world.clock.getDelayedCalls() if call.active()]


@pytest_twisted.ensureDeferred
async def test_a_robot_that_never_pongs_fills_no_memory(hall: Hall) -> None:
    """It sends other things, so it is not cut; what it owes is bounded."""
    robot = await hall.registered()
    trips: list[Any] = []
    robot.connection.round_trip().addErrback(lambda failure: trips.append(str(failure.value)))
    for _ in range(PINGS + 50):
        hall.world.clock.advance(2)
        robot.says(link.Health())
    assert len(robot.connection._pings) <= PINGS
    assert trips == ["the robot did not answer, or lost its connection"]


@pytest_twisted.ensureDeferred
async def test_a_newer_link_replaces_the_older_but_not_at_once(hall: Hall) -> None:
    """Two daemons with one key do not replace each other for ever."""
    first = await hall.registered()
    second = hall.dial()
    second.prove(second.hello())
    await second.answered()
    refusal = second.refusal()
    assert "is its key used twice?" in refusal["reason"]
    assert refusal["retry_after"] == REPLACE_SECONDS
    assert first.transport.connected
    hall.world.clock.advance(REPLACE_SECONDS)
    third = await hall.registered()
    assert [each for each in first.hears() if each["op"] == "bye"] == [
        {"op": "bye", "reason": "the robot has connected anew"}
    ]
    hall.world.clock.advance(REPLACED_SECONDS)
    assert not first.transport.connected
    assert hall.presence is not None
    assert hall.presence.control is third.connection
    assert told_twice(hall) == []


def told_twice(hall: Hall) -> list[str]:
    """What was told of keys that are used twice, since the last time."""
    told, hall.told = hall.told, []
    return [data["addresses"] for kind, data in told if kind == "robot.key_used_twice"]


@pytest_twisted.ensureDeferred
async def test_a_daemon_that_still_answers_when_another_comes_is_told_of_at_once(hall: Hall) -> None:
    """Whether the newer one is refused or takes its place, with both addresses."""
    first = await hall.registered(address="192.0.2.1")
    first.pongs()
    second = hall.dial("192.0.2.2")
    assert (await second.registers())["op"] == "refused"
    assert told_twice(hall) == []
    first.pongs()
    assert told_twice(hall) == ["192.0.2.1, 192.0.2.2"]
    hall.world.clock.advance(REPLACE_SECONDS)
    await hall.registered(address="192.0.2.3")
    assert told_twice(hall) == []
    assert [each["op"] for each in first.pongs()] == ["bye"]
    assert told_twice(hall) == ["192.0.2.1, 192.0.2.3"]
    assert not first.transport.connected


@pytest_twisted.ensureDeferred
async def test_a_robot_that_comes_back_is_no_second_daemon(hall: Hall) -> None:
    """What its old connection still brings is older than the newer one; only an answer to a later ping counts."""
    first = await hall.registered()
    hall.world.clock.advance(REPLACE_SECONDS)
    owed = [each for each in first.hears() if each["op"] == "ping"]
    await hall.registered()
    for each in owed:
        first.says(link.Pong(t=each["t"], at=1))
    first.says(link.Health())
    first.says(link.Bye(reason="the network has changed"))
    hall.world.clock.advance(REPLACED_SECONDS)
    assert told_twice(hall) == []
    assert not first.transport.connected
    assert not [each for each in hall.world.clock.getDelayedCalls() if "hang_up" in str(each.func)]


@pytest_twisted.ensureDeferred
async def test_two_daemons_with_one_key_flap_ever_more_slowly(hall: Hall) -> None:
    """Each replacement doubles the wait up to a minute, and is told; a quiet time makes it short again."""
    current = await hall.registered()
    waits: list[int] = []
    for _ in range(7):
        waits.append(round((await hall.dial().registers())["retry_after"]))
        for _ in range(waits[-1]):
            hall.world.clock.advance(1)
            current.pongs()
        former, current = current, hall.dial()
        assert (await current.registers())["op"] == "welcome"
        former.pongs()
    assert waits == [3, 6, 12, 24, 48, 60, 60]
    assert len(told_twice(hall)) == 2 * len(waits)
    assert hall.presence is not None
    assert hall.presence.patience == MOST_PATIENCE
    hall.presence.registered_at -= FLAPPING_SECONDS
    assert (await hall.dial().registers())["op"] == "welcome"
    assert hall.presence.patience == REPLACE_SECONDS


@pytest.mark.parametrize(
    "data", [encode_sample(1, 2, b"x"), encode_video(1, 2, b"x"), encode_json(b'{"op":"hello"}')]
)
@pytest_twisted.ensureDeferred
async def test_what_has_no_place_on_a_control_link_ends_it(hall: Hall, data: bytes) -> None:
    """The robot is offline then."""
    robot = await hall.registered()
    robot.sends(data)
    assert robot.refusal()["code"] == "malformed"
    assert not hall.online


@pytest_twisted.ensureDeferred
async def test_a_robot_that_takes_no_commands_is_cut(hall: Hall) -> None:
    """What may not be lost piles up only so far."""
    robot = await hall.registered()
    robot.connection._outbox.pause()
    for _ in range(1100):
        robot.connection.send(link.Ping(t=1))
    assert robot.transport.aborted
    assert not hall.online


@pytest_twisted.ensureDeferred
async def test_of_feedback_a_slow_robot_gets_the_newest(hall: Hall) -> None:
    """A client that tells more than the link takes does not have it cut."""
    robot = await hall.registered()
    robot.connection._outbox.pause()
    for number in range(5000):
        for goal in ("a", "b"):
            robot.connection.newest(goal, link.ActionFeedback(id=goal, cdr=str(number)))
    robot.hears()
    robot.connection._outbox.resume()
    assert [(each["id"], each["cdr"]) for each in robot.hears()] == [("a", "4999"), ("b", "4999")]


@pytest_twisted.ensureDeferred
async def test_the_control_link_is_measured_every_second(hall: Hall) -> None:
    """Also between heartbeats; what is not answered is seen, and a link that is gone is lost."""
    robot = await hall.registered()
    assert hall.presence is not None
    for _ in range(5):
        for each in robot.hears():
            if each["op"] == "ping":
                hall.world.clock.advance(0.12)
                robot.says(link.Pong(t=each["t"], at=0))
        hall.world.clock.advance(0.88)
    reading = hall.presence.reading()
    assert reading.rtt == pytest.approx(0.12)
    assert (reading.lost, reading.quality) == (0, "fair"), (
        "the ping it passed over, its first, is not waited for"
    )
    hall.world.clock.pump([1.0] * 3)
    assert hall.presence.reading().quality == "bad"
    hall.world.clock.pump([1.0] * 1)
    assert hall.presence.reading().quality == "lost"
    robot.breaks()
    assert hall.presence.reading().quality == "lost"
