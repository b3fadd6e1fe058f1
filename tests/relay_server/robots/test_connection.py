"""Connections of robots: bytes on transports in memory, with a real database."""

from __future__ import annotations

import tracemalloc
from typing import Any

import pytest
import pytest_twisted
from twisted.logger import capturedLogs

from relay_db import queries
from relay_protocol import identity, limits, link
from relay_protocol.frames import JSON_NUMBER, encode_json, encode_part, encode_sample, encode_video
from relay_server.auth import login_limiter
from relay_server.robots import link_handlers
from relay_server.robots.connection import PINGS, REPLACED_SECONDS
from relay_server.robots.link_handlers import (
    BUSY,
    BUSY_SECONDS,
    FLAPPING_SECONDS,
    LOGGED_ALERTS_AT_ONCE,
    LONGEST_REPLACE_SECONDS,
)
from relay_server.robots.registry import REPLACE_SECONDS
from tests.worlds.robot_links import FINGERPRINT, KEY, Robot, RobotLinkWorld

# --- registration -----------------------------------------------------------------------------------------


@pytest_twisted.ensureDeferred
async def test_a_robot_that_proves_its_key_is_registered(scene: RobotLinkWorld) -> None:
    """It gets ``welcome``, is online, and has heartbeats both ways and the large frame limit."""
    robot = scene.dial()
    welcome = await robot.registers()
    assert (welcome["op"], welcome["heartbeat"], welcome["frame_limit"]) == (
        "welcome",
        2.0,
        limits.ROBOT_FRAME,
    )
    assert scene.presence is not None
    assert scene.presence.control_link is robot.connection
    assert scene.presence.key == FINGERPRINT
    robot.sends(encode_json(b'{"op":"ping","t":7,"x":"' + b"x" * limits.HANDSHAKE_FRAME + b'"}'))
    assert {"op": "pong", "t": 7, "at": scene.world.now_ns()} in robot.received()
    scene.world.clock.advance(limits.UNAUTHENTICATED_SECONDS)
    assert "refused" not in [each["op"] for each in robot.received()]


@pytest_twisted.ensureDeferred
async def test_unknown_robots_and_wrong_keys_get_the_same_answer(scene: RobotLinkWorld) -> None:
    """Both are challenged and refused in the same words, so enrolled names are not disclosed."""
    reported = []
    other = bytes(reversed(KEY))
    for name, key, signer in (
        ("r2-d2", FINGERPRINT, other),
        ("r2-d2", identity.fingerprint(identity.public_half(other)), other),
        ("unknown", FINGERPRINT, KEY),
        ("r2-d2\x00", FINGERPRINT, KEY),
        ("", "", KEY),
    ):
        robot = scene.dial()
        robot.prove(robot.hello(name, key), name, signer)
        await robot.answered()
        reported.append(robot.refusal())
    assert all(each == reported[0] for each in reported)
    assert reported[0]["reason"].startswith("this key is not accepted for this robot")
    assert scene.presence is None


@pytest_twisted.ensureDeferred
async def test_a_robot_that_fails_too_often_is_refused_before_the_database_is_asked(
    scene: RobotLinkWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ten failures of one robot from one network; the right key must wait there, but not elsewhere."""
    for _ in range(login_limiter.FAILURES):
        robot = scene.dial()
        robot.prove(robot.hello(), key=bytes(reversed(KEY)))
        await robot.answered()
        assert "not accepted" in robot.refusal()["reason"]
    with monkeypatch.context() as patch:
        patch.setattr(scene.store, "read", None)
        robot = scene.dial()
        robot.prove(robot.hello())
        await robot.answered()
    refusal = robot.refusal()
    assert "too many failures" in refusal["reason"]
    assert refusal["retry_after"] == login_limiter.WINDOW
    other = scene.dial()
    other.connection.address = "198.51.100.1"
    assert (await other.registers())["op"] == "welcome"
    assert [kind for kind, _ in scene.reported].count("robot.refused") == login_limiter.FAILURES


@pytest_twisted.ensureDeferred
async def test_a_key_revoked_while_its_proof_is_judged_does_not_stay(
    scene: RobotLinkWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The check for revoked keys may run between reading the key and registering."""
    read = scene.store.read

    async def read_and_revoke(query: Any, *args: Any) -> Any:
        found = await read(query, *args)
        if found is not None:
            await scene.store.write(queries.revoke_key, found.robot_id, FINGERPRINT, 1000.0)
        return found

    monkeypatch.setattr(scene.store, "read", read_and_revoke)
    robot = scene.dial()
    robot.prove(robot.hello())
    await robot.answered()
    assert robot.received()[-1] == {"op": "bye", "reason": "the robot's key is not accepted any more"}
    assert not robot.transport.connected
    assert not scene.online


@pytest_twisted.ensureDeferred
async def test_a_robots_flood_of_alerts_does_not_reach_the_log(scene: RobotLinkWorld) -> None:
    """Alerts over the limit are not logged; the connection stays."""
    robot = await scene.registered()
    with capturedLogs() as logs:
        for number in range(5000):
            robot.says(link.Alert(level="error", text=str(number)))
    assert len(logs) == LOGGED_ALERTS_AT_ONCE
    assert robot.transport.connected
    robot.breaks()
    assert [kind for kind, _ in scene.reported].count("robot.offline") == 1


@pytest_twisted.ensureDeferred
async def test_a_recorded_signature_is_worthless(scene: RobotLinkWorld) -> None:
    """It is valid for one nonce of one connection, and for one try."""
    first, second = scene.dial(), scene.dial()
    nonce = first.hello()
    second.hello()
    second.prove(nonce)
    await second.answered()
    assert "not accepted" in second.refusal()["reason"]
    first.prove(nonce)
    first.prove(nonce)
    await first.answered()
    assert not scene.online


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
    scene: RobotLinkWorld, messages: list[link.Message], words: str
) -> None:
    """The robot gets ``refused``, and the connection ends."""
    robot = scene.dial()
    for message in messages:
        robot.says(message)
    refusal = robot.refusal()
    assert words in refusal["reason"]
    assert refusal["code"] == "malformed"


def test_only_the_proof_may_follow_hello(scene: RobotLinkWorld) -> None:
    """Neither another hello nor a join."""
    for message in (
        link.Hello(version=1, robot="x", key="", encodings=[]),
        link.Join(version=1, ticket="x"),
        link.Enroll(version=1, robot="x", code="", public_key=""),
    ):
        robot = scene.dial()
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
def test_hostile_bytes_are_refused_with_a_reason(scene: RobotLinkWorld, data: bytes) -> None:
    """Frames of 4 GiB, other protocols, invalid bytes, and samples before the proof: nothing is stored."""
    robot = scene.dial()
    robot.sends(data)
    assert robot.refusal()["code"] in ("malformed", "frame_too_large")
    robot.sends(data)
    assert robot.received() == []
    assert not [call for call in scene.world.clock.getDelayedCalls() if call.active()]


def test_a_robot_that_speaks_tls_is_refused_with_that_reason(scene: RobotLinkWorld) -> None:
    robot = scene.dial()
    robot.sends(b"\x16\x03\x01\x02\x00\x01\x00")
    assert robot.refusal()["reason"] == "it speaks TLS, and this port was started without"
    assert not robot.transport.connected


def test_a_trickle_is_cut_by_an_absolute_deadline(scene: RobotLinkWorld) -> None:
    """Further bytes do not extend it."""
    robot = scene.dial()
    robot.sends(b"\x00\x00\x10\x00")
    for _ in range(99):
        scene.world.clock.advance(0.1)
        robot.sends(b"x")
    assert robot.transport.connected
    scene.world.clock.advance(0.11)
    refusal = robot.refusal()
    assert "within 10 s" in refusal["reason"]
    assert refusal["retry_after"] == 5


def test_too_much_before_the_proof_is_cut(scene: RobotLinkWorld) -> None:
    """64 KiB in total, in pieces of any size."""
    robot = scene.dial()
    message = encode_json(b'{"op":"hello","pad":"' + b"x" * 1000 + b'"')
    robot.sends(b"".join([message[:-1]] * 1))
    for _ in range(70):
        if robot.transport.connected:
            robot.sends(b"x" * 1000)
    assert not robot.transport.connected


@pytest_twisted.ensureDeferred
async def test_a_robot_that_leaves_while_the_database_is_asked_leaves_no_ghost(scene: RobotLinkWorld) -> None:
    """It is not registered on a closed connection, and may register again at once."""
    robot = scene.dial()
    robot.prove(robot.hello())
    robot.breaks()
    await robot.answered()
    assert not scene.online
    assert not [call for call in scene.world.clock.getDelayedCalls() if call.active()]
    assert (await scene.dial().registers())["op"] == "welcome"


@pytest_twisted.ensureDeferred
async def test_what_an_ended_link_sent_is_gone_with_it(scene: RobotLinkWorld) -> None:
    """A part of a frame, and parts of a sample, even while something still refers to the connection."""
    robot = await scene.registered()
    tracemalloc.start()
    try:
        robot.sends(encode_part(7, 1, limits.MIB // 2, 0, bytes(limits.MIB // 4)))
        robot.sends(encode_json(bytes(limits.MIB // 4))[:-1])
        assert tracemalloc.get_traced_memory()[0] >= limits.MIB // 2
        robot.breaks()
        assert tracemalloc.get_traced_memory()[0] < limits.MIB // 8
    finally:
        tracemalloc.stop()


@pytest_twisted.ensureDeferred
async def test_a_sample_whose_parts_stop_is_dropped_and_the_link_stays(scene: RobotLinkWorld) -> None:
    """60 s after its last part. Further parts of it are passed over until a sample begins."""
    robot = await scene.registered()
    decoder = robot.connection._decoder
    robot.sends(encode_part(7, 1, 100, 0, b"x") + encode_part(8, 1, 100, 0, b"x"))
    await passes(scene, robot, 50)
    robot.sends(encode_part(8, 1, 100, 1, b"x"))
    await passes(scene, robot, 20)
    assert decoder.buffered == 2
    robot.sends(encode_part(7, 1, 100, 1, b"x") + encode_part(8, 1, 100, 2, b"x"))
    assert decoder.buffered == 3
    robot.sends(encode_part(7, 2, 100, 0, b"x") + encode_part(7, 2, 100, 1, b"x"))
    assert decoder.buffered == 5
    assert robot.transport.connected


@pytest_twisted.ensureDeferred
async def test_a_message_whose_parts_stop_ends_the_link(scene: RobotLinkWorld) -> None:
    """It must not be lost without notice."""
    robot = await scene.registered()
    robot.sends(encode_part(JSON_NUMBER, 0, 100, 0, b"x"))
    await passes(scene, robot, 70)
    assert not robot.transport.connected


async def passes(scene: RobotLinkWorld, robot: Robot, seconds: int) -> None:
    """Time passes while the robot is alive."""
    for _ in range(seconds):
        scene.world.clock.advance(1)
        if robot.transport.connected:
            robot.says(link.Ping(t=1))


def test_connections_of_one_address_are_capped(scene: RobotLinkWorld) -> None:
    """A refused connection gets an error to retry; closed ones make room."""
    robots = [scene.dial() for _ in range(3)]
    one_more = scene.dial()
    refusal = one_more.refusal()
    assert "too many connections" in refusal["reason"]
    assert refusal["retry_after"] == 10
    robots[0].breaks()
    assert scene.dial().transport.connected


@pytest_twisted.ensureDeferred
async def test_unauthenticated_robots_are_limited_over_all_addresses(scene: RobotLinkWorld) -> None:
    """A refused connection gets an error to retry; a robot that proves its key makes room, and so does one
    that leaves.
    """
    scene.cap._free_slots = 2
    first, second = scene.dial(), scene.dial()
    refusal = scene.dial().refusal()
    assert "too many robots" in refusal["reason"]
    assert refusal["retry_after"] == 10
    assert (await first.registers())["op"] == "welcome"
    assert scene.dial().transport.connected
    first.breaks()
    assert not scene.dial().transport.connected
    second.breaks()
    assert scene.dial().transport.connected


# --- registered robots ------------------------------------------------------------------------------------


@pytest_twisted.ensureDeferred
async def test_description_of_a_robot_is_stored(scene: RobotLinkWorld) -> None:
    """Description, graph and health."""
    robot = await scene.registered()
    robot.says(link.Describe(host="shed"))
    robot.says(link.Graph(full=True, nodes={"/n": {}}))
    robot.says(link.Health(battery=0.5))
    robot.says(link.Alert(level="warning", text="\x1b[2J" + "x" * 10_000))
    presence = scene.presence
    assert presence is not None
    assert (presence.description.host, presence.graph.nodes, presence.health.battery) == ("shed", {"/n"}, 0.5)


@pytest.mark.parametrize("charge", [57.0, -1.0, 1.01])
@pytest_twisted.ensureDeferred
async def test_a_charge_that_is_not_from_0_to_1_counts_as_unknown(
    scene: RobotLinkWorld, charge: float
) -> None:
    robot = await scene.registered()
    robot.says(link.Health(battery=charge, cpu=0.5))
    presence = scene.presence
    assert presence is not None
    assert (presence.health.battery, presence.health.cpu) == (None, 0.5)
    assert presence.impossible_charge == charge
    robot.says(link.Health(battery=1.0))
    assert (presence.health.battery, presence.impossible_charge) == (1.0, None)


@pytest.mark.parametrize("op", ["graph", "alert"])
@pytest_twisted.ensureDeferred
async def test_a_control_link_takes_no_large_frame(scene: RobotLinkWorld, op: str) -> None:
    """A frame that could stall the relay is refused by its length before it is received."""
    robot = await scene.registered()
    robot.sends((limits.CONTROL_FRAME + 1).to_bytes(4, "big") + b'\x00{"op":"' + op.encode())
    assert robot.refusal()["code"] == "frame_too_large"
    assert not scene.online


@pytest_twisted.ensureDeferred
async def test_a_graph_without_end_is_refused_with_a_reason(scene: RobotLinkWorld) -> None:
    """The robot is disconnected, and its graph is discarded."""
    robot = await scene.registered()
    ends = ["/" + "n" * 200 + str(number) for number in range(limits.GRAPH_NODES)]
    for number in range(40):
        robot.says(link.Graph(topics={f"/t{number}": link.Topic(types=["a/msg/B"], publishers=ends)}))
    assert "graph takes more than 8 MiB" in robot.refusal()["reason"]
    assert scene.presence is not None
    assert not scene.presence.graph.topics


@pytest_twisted.ensureDeferred
async def test_a_silent_robot_is_cut_after_three_heartbeats(scene: RobotLinkWorld) -> None:
    """It is pinged meanwhile; a robot that answers stays, and its round trip is known."""
    robot = await scene.registered()
    for _ in range(4):
        scene.world.clock.advance(2)
        for each in robot.received():
            scene.world.clock.advance(0.01)
            robot.says(link.Pong(t=each["t"], at=0))
    assert scene.presence is not None
    assert scene.presence.rtt == pytest.approx(0.01)
    scene.world.clock.pump([2.0] * 3)
    assert scene.presence.control_link is not None
    scene.world.clock.pump([2.0] * 1)
    assert robot.transport.aborted
    assert scene.presence.control_link is None
    assert not [call for call in scene.world.clock.getDelayedCalls() if call.active()]


@pytest_twisted.ensureDeferred
async def test_a_relay_that_was_busy_does_not_take_robots_for_silent(scene: RobotLinkWorld) -> None:
    """It has not read what they sent meanwhile. A robot that is silent after that is cut."""
    robot = await scene.registered()
    assert scene.presence is not None
    scene.world.clock.advance(30)
    assert scene.presence.control_link is not None
    robot.pongs()
    scene.world.clock.advance(30)
    scene.world.clock.advance(2)
    assert robot.transport.aborted
    assert scene.presence.control_link is None


@pytest_twisted.ensureDeferred
async def test_robots_that_dial_all_at_once_are_let_in_little_by_little(
    scene: RobotLinkWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The others learn when to come again, at different times; one that has come in makes room."""
    monkeypatch.setattr(link_handlers, "MOST_PROVING", 2)
    robots = [scene.dial(f"192.168.{number}.1") for number in range(4)]
    for robot in robots:
        robot.prove(robot.hello())
    refusals = [robot.refusal() for robot in robots[2:]]
    assert [each["reason"] for each in refusals] == [BUSY] * 2
    least, most = BUSY_SECONDS
    assert all(least <= each["retry_after"] <= most for each in refusals)
    assert refusals[0]["retry_after"] != refusals[1]["retry_after"]
    for robot in robots[:2]:
        await robot.answered()
    assert not scene.scene.proving
    # One robot dialled all the time here, which is refused for that.
    assert (await scene.dial().registers()).get("reason") != BUSY


@pytest_twisted.ensureDeferred
async def test_a_robot_that_never_pongs_fills_no_memory(scene: RobotLinkWorld) -> None:
    """It sends other messages, so it stays connected; the number of pending pings is limited."""
    robot = await scene.registered()
    trips: list[Any] = []
    robot.connection.round_trip().addErrback(lambda failure: trips.append(str(failure.value)))
    for _ in range(PINGS + 50):
        scene.world.clock.advance(2)
        robot.says(link.Health())
    assert len(robot.connection._pings) <= PINGS
    assert trips == ["the robot did not answer, or lost its connection"]


@pytest_twisted.ensureDeferred
async def test_a_newer_link_replaces_the_older_but_not_at_once(scene: RobotLinkWorld) -> None:
    """Otherwise two daemons with one key would replace each other all the time."""
    first = await scene.registered()
    second = scene.dial()
    second.prove(second.hello())
    await second.answered()
    refusal = second.refusal()
    assert "is its key used twice?" in refusal["reason"]
    assert refusal["retry_after"] == REPLACE_SECONDS
    assert first.transport.connected
    scene.world.clock.advance(REPLACE_SECONDS)
    third = await scene.registered()
    assert [each for each in first.received() if each["op"] == "bye"] == [
        {"op": "bye", "reason": "the robot has connected again"}
    ]
    scene.world.clock.advance(REPLACED_SECONDS)
    assert not first.transport.connected
    assert scene.presence is not None
    assert scene.presence.control_link is third.connection
    assert told_twice(scene) == []


def told_twice(scene: RobotLinkWorld) -> list[str]:
    """Reports about keys in use twice, since the last call."""
    reported, scene.reported = scene.reported, []
    return [data["addresses"] for kind, data in reported if kind == "robot.key_used_twice"]


@pytest_twisted.ensureDeferred
async def test_a_second_daemon_is_reported_while_the_first_answers(
    scene: RobotLinkWorld,
) -> None:
    """Whether the newer one is refused or replaces the other; the report has both addresses."""
    first = await scene.registered(address="192.0.2.1")
    first.pongs()
    second = scene.dial("192.0.2.2")
    assert (await second.registers())["op"] == "refused"
    assert told_twice(scene) == []
    first.pongs()
    assert told_twice(scene) == ["192.0.2.1, 192.0.2.2"]
    scene.world.clock.advance(REPLACE_SECONDS)
    await scene.registered(address="192.0.2.3")
    assert told_twice(scene) == []
    assert [each["op"] for each in first.pongs()] == ["bye"]
    assert told_twice(scene) == ["192.0.2.1, 192.0.2.3"]
    assert not first.transport.connected


@pytest_twisted.ensureDeferred
async def test_a_robot_that_comes_back_is_no_second_daemon(scene: RobotLinkWorld) -> None:
    """Bytes on its old connection may be older than the new one; only an answer to a later ping counts."""
    first = await scene.registered()
    scene.world.clock.advance(REPLACE_SECONDS)
    owed = [each for each in first.received() if each["op"] == "ping"]
    await scene.registered()
    for each in owed:
        first.says(link.Pong(t=each["t"], at=1))
    first.says(link.Health())
    first.says(link.Bye(reason="the network has changed"))
    scene.world.clock.advance(REPLACED_SECONDS)
    assert told_twice(scene) == []
    assert not first.transport.connected
    assert not [each for each in scene.world.clock.getDelayedCalls() if "hang_up" in str(each.func)]


@pytest_twisted.ensureDeferred
async def test_two_daemons_with_one_key_flap_ever_more_slowly(scene: RobotLinkWorld) -> None:
    """Each replacement doubles the wait up to a minute and is reported; a quiet time resets it."""
    current = await scene.registered()
    waits: list[int] = []
    for _ in range(7):
        waits.append(round((await scene.dial().registers())["retry_after"]))
        for _ in range(waits[-1]):
            scene.world.clock.advance(1)
            current.pongs()
        former, current = current, scene.dial()
        assert (await current.registers())["op"] == "welcome"
        former.pongs()
    assert waits == [3, 6, 12, 24, 48, 60, 60]
    assert len(told_twice(scene)) == 2 * len(waits)
    assert scene.presence is not None
    assert scene.presence.replace_after == LONGEST_REPLACE_SECONDS
    scene.presence.registered_at -= FLAPPING_SECONDS
    assert (await scene.dial().registers())["op"] == "welcome"
    assert scene.presence.replace_after == REPLACE_SECONDS


@pytest.mark.parametrize(
    "data", [encode_sample(1, 2, b"x"), encode_video(1, 2, b"x"), encode_json(b'{"op":"hello"}')]
)
@pytest_twisted.ensureDeferred
async def test_wrong_message_ends_the_control_link(scene: RobotLinkWorld, data: bytes) -> None:
    """The robot is offline then."""
    robot = await scene.registered()
    robot.sends(data)
    assert robot.refusal()["code"] == "malformed"
    assert not scene.online


@pytest_twisted.ensureDeferred
async def test_a_robot_that_takes_no_commands_is_cut(scene: RobotLinkWorld) -> None:
    """Messages that must not be lost are queued up to a limit."""
    robot = await scene.registered()
    robot.connection._send_queue.pause()
    for _ in range(1100):
        robot.connection.send(link.Ping(t=1))
    assert robot.transport.aborted
    assert not scene.online


@pytest_twisted.ensureDeferred
async def test_of_feedback_a_slow_robot_gets_the_newest(scene: RobotLinkWorld) -> None:
    """More feedback of a client than the link takes does not close the link."""
    robot = await scene.registered()
    robot.connection._send_queue.pause()
    for number in range(5000):
        for goal in ("a", "b"):
            robot.connection.send_newest(goal, link.ActionFeedback(id=goal, cdr=str(number)))
    robot.received()
    robot.connection._send_queue.resume()
    assert [(each["id"], each["cdr"]) for each in robot.received()] == [("a", "4999"), ("b", "4999")]


@pytest_twisted.ensureDeferred
async def test_the_control_link_is_measured_every_second(scene: RobotLinkWorld) -> None:
    """This includes the time between heartbeats. Unanswered pings are seen, and a link without answers is
    lost.
    """
    robot = await scene.registered()
    assert scene.presence is not None
    for _ in range(5):
        for each in robot.received():
            if each["op"] == "ping":
                scene.world.clock.advance(0.12)
                robot.says(link.Pong(t=each["t"], at=0))
        scene.world.clock.advance(0.88)
    reading = scene.presence.link_quality()
    assert reading.rtt == pytest.approx(0.12)
    assert (reading.lost, reading.quality) == (0, "fair"), (
        "the ping it passed over, its first, is not waited for"
    )
    scene.world.clock.pump([1.0] * 3)
    assert scene.presence.link_quality().quality == "bad"
    scene.world.clock.pump([1.0] * 1)
    assert scene.presence.link_quality().quality == "lost"
    robot.breaks()
    assert scene.presence.link_quality().quality == "lost"
