"""Enrolling, and joining a channel: roles of a robot's connection beside the control link."""

from __future__ import annotations

import pytest
import pytest_twisted
from twisted.logger import capturedLogs, formatEvent

from relay_db import queries
from relay_protocol import identity, limits, link
from relay_protocol.errors import Unavailable
from relay_protocol.frames import encode_json, encode_sample
from relay_server.auth import login_limiter, passwords
from relay_server.channels.states import ChannelState
from tests.worlds.relay import STRING, text
from tests.worlds.robot_links import RELAY, Robot, RobotLinkWorld, until

NEW_KEY = bytes(range(32, 64))
PUBLIC = identity.public_half(NEW_KEY)


async def code_for(scene: RobotLinkWorld, robot: str, expires: float = 2000.0) -> str:
    """A new enrolment code; adds the robot if it is missing."""
    record = await scene.store.read(queries.find_robot, robot)
    if record is None:
        record = await scene.store.write(queries.add_robot, robot)
    code = passwords.new_enrolment_code()
    await scene.store.write(queries.issue_enrolment_code, record.id, passwords.code_hash(code), expires)
    return code


async def enrolling(
    scene: RobotLinkWorld, code: str, robot: str = "c-3po", public_key: bytes = PUBLIC
) -> Robot:
    """A connection that has asked to enrol and got an answer."""
    end = scene.dial()
    end.says(link.Enroll(version=1, robot=robot, code=code, public_key=link.to_base64(public_key)))
    await end.answered()
    return end


@pytest_twisted.ensureDeferred
async def test_a_robot_enrolls_by_its_code_and_registers_with_its_key(scene: RobotLinkWorld) -> None:
    """In any spelling of the code; the relay closes the connection, and the event is stored."""
    code = await code_for(scene, "c-3po")
    robot = await enrolling(scene, code.lower().replace("-", " "))
    assert robot.received() == [{"op": "enrolled", "robot": "c-3po", "relay": RELAY}]
    assert not robot.transport.connected
    again = scene.dial()
    again.prove(again.hello("c-3po", identity.fingerprint(PUBLIC)), "c-3po", NEW_KEY)
    await again.answered()
    assert again.received()[0]["op"] == "welcome"
    entry = (await scene.store.read(queries.list_audit))[-1]
    assert (entry.action, entry.target) == ("robot.enrolled", "c-3po")


@pytest_twisted.ensureDeferred
async def test_invalid_codes_get_the_same_answer(scene: RobotLinkWorld) -> None:
    """These are used, expired and unknown codes, and codes of another or an unknown robot."""
    used = await code_for(scene, "used")
    await enrolling(scene, used, "used")
    expired = await code_for(scene, "expired", expires=999.0)
    other = await code_for(scene, "other")
    reasons = set()
    for robot, code in (
        ("used", used),
        ("expired", expired),
        ("used", other),
        ("nobody", other),
        ("used", "?"),
    ):
        end = await enrolling(scene, code, robot)
        reasons.add(end.refusal()["reason"])
    assert len(reasons) == 1
    assert (await enrolling(scene, other, "other")).received()[0]["op"] == "enrolled"


@pytest_twisted.ensureDeferred
async def test_guessing_codes_is_limited_and_a_good_one_makes_good(scene: RobotLinkWorld) -> None:
    """Ten tries for one robot from one network; an enrolled robot may prove its key at once."""
    code = await code_for(scene, "c-3po")
    for _ in range(login_limiter.FAILURES - 1):
        end = await enrolling(scene, "wrong")
        assert "too many" not in end.refusal()["reason"]
    assert (await enrolling(scene, code)).received()[0]["op"] == "enrolled"
    for _ in range(login_limiter.FAILURES):
        await enrolling(scene, "wrong")
    code = await code_for(scene, "c-3po")
    refusal = (await enrolling(scene, code)).refusal()
    assert "too many failures" in refusal["reason"]
    assert refusal["retry_after"] > 0


@pytest_twisted.ensureDeferred
async def test_an_enrolment_that_can_not_be_put_on_record_does_not_spend_the_code(
    scene: RobotLinkWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both are in one transaction."""
    code = await code_for(scene, "c-3po")

    def full(*_: object, **__: object) -> None:
        raise Unavailable("the disk is full")

    with monkeypatch.context() as patch:
        patch.setattr(queries, "append_audit", full)
        refusal = (await enrolling(scene, code)).refusal()
    assert (refusal["code"], refusal["retry_after"]) == ("unavailable", 5)
    assert (await enrolling(scene, code)).received()[0]["op"] == "enrolled"


@pytest.mark.parametrize(
    ("robot", "public_key", "words"),
    [
        ("c-3po", "", "32 bytes"),
        ("c-3po", link.to_base64(PUBLIC + b"x"), "32 bytes"),
        ("c-3po", "no base64", "base64"),
        ("C-3PO!", link.to_base64(PUBLIC), "a robot's name"),
        ("x" * 64, link.to_base64(PUBLIC), "a robot's name"),
    ],
)
@pytest_twisted.ensureDeferred
async def test_failed_enrolment_does_not_spend_the_code(
    scene: RobotLinkWorld, robot: str, public_key: str, words: str
) -> None:
    """Keys of the wrong length and invalid names are refused with a reason."""
    code = await code_for(scene, "c-3po")
    end = scene.dial()
    end.says(link.Enroll(version=1, robot=robot, code=code, public_key=public_key))
    await end.answered()
    assert words in end.refusal()["reason"]
    assert (await enrolling(scene, code)).received()[0]["op"] == "enrolled"


# --- channels ---------------------------------------------------------------------------------------------


class Member:
    """A member of a channel."""

    def notify(self, level: str, text: str, id: object = None) -> None:
        """Ignores it."""


async def asked_to_join(scene: RobotLinkWorld) -> tuple[Robot, str]:
    """A registered robot with a client, and its ticket."""
    robot = await scene.registered()
    assert scene.presence is not None
    scene.world.channels.of(scene.presence).attach(Member())
    scene.world.clock.advance(0)
    (ask,) = [each for each in robot.received() if each["op"] == "open_channel"]
    return robot, ask["ticket"]


@pytest_twisted.ensureDeferred
async def test_a_robot_joins_its_channel_and_samples_flow(scene: RobotLinkWorld) -> None:
    """``joined`` has the relay's time; samples on the link reach the channel."""
    _, ticket = await asked_to_join(scene)
    end = scene.dial()
    end.says(link.Join(version=1, ticket=ticket))
    assert scene.presence is not None
    channel = scene.world.channels.of(scene.presence)
    joined = end.received()[0]
    assert joined == {"op": "joined", "channel": channel.name, "at": scene.world.now_ns()}
    assert channel.state is ChannelState.OPEN
    got: list[tuple[int, bytes]] = []
    channel.sample = lambda number, body, stamp=0: got.append((number, body))  # type: ignore[method-assign]
    end.sends(encode_sample(7, 1, text("hi")))
    end.sends(encode_sample(8, 1, bytes(limits.HANDSHAKE_FRAME)))
    assert [number for number, _ in got] == [7, 8]
    end.says(link.Ping(t=5))
    assert {"op": "pong", "t": 5, "at": scene.world.now_ns()} in end.received()
    end.says(link.Bye(reason="restarting"))
    assert channel.state is ChannelState.OPENING


@pytest_twisted.ensureDeferred
async def test_a_ticket_that_is_not_good_opens_nothing(scene: RobotLinkWorld) -> None:
    """It is used, invented or empty; the channel is not affected."""
    _, ticket = await asked_to_join(scene)
    scene.dial().says(link.Join(version=1, ticket=ticket))
    for bad in (ticket, "invented", ""):
        end = scene.dial()
        end.says(link.Join(version=1, ticket=bad))
        assert end.refusal()["reason"] == "the channel ticket is unknown, used or too old"
        end.breaks()
    assert scene.presence is not None
    assert scene.world.channels.of(scene.presence).state is ChannelState.OPEN


@pytest.mark.parametrize(
    ("body", "taken"),
    [
        (
            b'{"op":"service_response","id":"1","result":true,"cdr":"' + b"AAAA" * limits.JSON_BODY + b'"}',
            True,
        ),
        (
            b'{"op":"service_response","id":"1","result":true,"values":['
            + b"[]," * limits.JSON_BODY
            + b"1]}",
            False,
        ),
        (b'{"op":"ping","t":1,"x":[' + b"{}," * limits.JSON_BODY + b"1]}", False),
        (b'{"op":"ping","t":1' + b',"":1' * limits.JSON_BODY + b"}", False),
    ],
    ids=["cdr", "values", "ping", "keys"],
)
@pytest_twisted.ensureDeferred
async def test_large_json_is_taken_only_for_its_cdr(scene: RobotLinkWorld, body: bytes, taken: bool) -> None:
    """Millions of brackets or keys would block the relay; base64 does not."""
    _, ticket = await asked_to_join(scene)
    end = scene.dial()
    end.says(link.Join(version=1, ticket=ticket))
    end.received()
    end.sends(encode_json(body))
    assert end.transport.connected is taken
    if not taken:
        assert "as base64 in 'cdr'" in end.refusal()["reason"]


@pytest_twisted.ensureDeferred
async def test_losing_the_control_link_ends_the_channel_link(scene: RobotLinkWorld) -> None:
    """If only the channel link is lost, the robot is asked to join again."""
    control, ticket = await asked_to_join(scene)
    end = scene.dial()
    end.says(link.Join(version=1, ticket=ticket))
    end.breaks()
    scene.world.clock.advance(0.5)
    (ask,) = [each for each in control.received() if each["op"] == "open_channel"]
    end = scene.dial()
    end.says(link.Join(version=1, ticket=ask["ticket"]))
    control.breaks()
    assert end.received()[-1]["op"] == "bye"
    assert not end.transport.connected
    assert scene.presence is not None
    assert scene.world.channels.of(scene.presence).state is ChannelState.WAITING


@pytest_twisted.ensureDeferred
async def test_a_slow_robot_gets_the_newest_samples_and_every_message(scene: RobotLinkWorld) -> None:
    """Samples to robots may be dropped; control messages may not."""
    _, ticket = await asked_to_join(scene)
    end = scene.dial()
    end.says(link.Join(version=1, ticket=ticket))
    end.received()
    producer = end.transport.producer
    assert producer is not None
    producer.pauseProducing()
    for number in range(300):
        end.connection.message_sender(1, commands=False)(number, 0, text(str(number)))
    end.connection.send(link.GetType(type=STRING))
    assert end.received() == []
    producer.resumeProducing()
    first, *samples = end.frames()
    assert b"get_type" in first.body
    assert [frame.stamp for frame in samples] == list(range(300 - 128, 300))


@pytest_twisted.ensureDeferred
async def test_a_link_closed_by_the_relay_is_dropped_if_the_robot_does_not_close_it(
    scene: RobotLinkWorld,
) -> None:
    """The robot has a short time for the close message, then the connection is aborted; a closed one leaves
    no timer.
    """
    robot = await scene.registered()
    robot.transport.loseConnection = lambda: None  # type: ignore[method-assign]
    robot.connection.close("going down")
    robot.connection.close("again")
    assert [each["op"] for each in robot.received()].count("bye") == 1
    assert not robot.transport.aborted
    scene.world.clock.advance(2)
    assert robot.transport.aborted
    await until(lambda: not scene.world.clock.getDelayedCalls())


@pytest_twisted.ensureDeferred
async def test_failures_of_others_in_its_network_lock_no_robot_out(scene: RobotLinkWorld) -> None:
    """Failures with the robot's name, or with other names and keys, count only for the attacker."""
    for number in range(login_limiter.FAILURES + 1):
        stranger = scene.dial()
        stranger.prove(stranger.hello("r2-d2", f"{number:064x}"), key=NEW_KEY)
        await stranger.answered()
        assert "not accepted" in stranger.refusal()["reason"]
    await scene.registered()


@pytest_twisted.ensureDeferred
async def test_the_log_names_the_realm_of_a_robot_with_an_error(
    scene: RobotLinkWorld,
) -> None:
    """Robots of several realms may have the same name."""
    robot = await scene.registered()
    assert scene.presence is not None
    scene.presence.realm = "lab1"
    with capturedLogs() as logs:
        robot.says(link.Alert(level="warning", text="too hot"))
    assert "robot r2-d2@lab1: warning: too hot" in [formatEvent(each) for each in logs]


@pytest_twisted.ensureDeferred
async def test_a_channel_carries_any_number_of_commands(scene: RobotLinkWorld) -> None:
    """Bytes in flight are measured by pings, which do not count themselves."""
    _, ticket = await asked_to_join(scene)
    end = scene.dial()
    end.says(link.Join(version=1, ticket=ticket))
    end.pongs()
    for number in range(3000):
        end.connection.message_sender(1, commands=True)(number, 7, bytes(60))
        if not number % 50:
            end.pongs()
    assert not end.connection.ended
    assert not end.connection._send_queue.dropped
