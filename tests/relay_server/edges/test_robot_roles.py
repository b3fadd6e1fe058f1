"""Enrolling, and joining a channel: what a robot's connection may be besides a control link."""

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
from tests.relay_server.edges.robot_ends import RELAY, Hall, Robot, until
from tests.relay_server.memory import STRING, text

NEW_KEY = bytes(range(32, 64))
PUBLIC = identity.public_half(NEW_KEY)


async def code_for(hall: Hall, robot: str, expires: float = 2000.0) -> str:
    """A fresh enrolment code, the robot added if there is none."""
    record = await hall.store.read(queries.find_robot, robot)
    if record is None:
        record = await hall.store.write(queries.add_robot, robot)
    code = passwords.new_enrolment_code()
    await hall.store.write(queries.issue_enrolment_code, record.id, passwords.code_hash(code), expires)
    return code


async def enrolling(hall: Hall, code: str, robot: str = "c-3po", public_key: bytes = PUBLIC) -> Robot:
    """A robot that has asked to be enrolled and got an answer."""
    end = hall.dial()
    end.says(link.Enroll(version=1, robot=robot, code=code, public_key=link.to_base64(public_key)))
    await end.answered()
    return end


@pytest_twisted.ensureDeferred
async def test_a_robot_enrolls_by_its_code_and_registers_with_its_key(hall: Hall) -> None:
    """However the code was typed; the relay closes, and the event is on record."""
    code = await code_for(hall, "c-3po")
    robot = await enrolling(hall, code.lower().replace("-", " "))
    assert robot.hears() == [{"op": "enrolled", "robot": "c-3po", "relay": RELAY}]
    assert not robot.transport.connected
    again = hall.dial()
    again.prove(again.hello("c-3po", identity.fingerprint(PUBLIC)), "c-3po", NEW_KEY)
    await again.answered()
    assert again.hears()[0]["op"] == "welcome"
    entry = (await hall.store.read(queries.list_audit))[-1]
    assert (entry.action, entry.target) == ("robot.enrolled", "c-3po")


@pytest_twisted.ensureDeferred
async def test_codes_that_are_not_good_are_told_the_same(hall: Hall) -> None:
    """Used, expired, unknown, another robot's, an unknown robot's."""
    used = await code_for(hall, "used")
    await enrolling(hall, used, "used")
    expired = await code_for(hall, "expired", expires=999.0)
    other = await code_for(hall, "other")
    reasons = set()
    for robot, code in (
        ("used", used),
        ("expired", expired),
        ("used", other),
        ("nobody", other),
        ("used", "?"),
    ):
        end = await enrolling(hall, code, robot)
        reasons.add(end.refusal()["reason"])
    assert len(reasons) == 1
    assert (await enrolling(hall, other, "other")).hears()[0]["op"] == "enrolled"


@pytest_twisted.ensureDeferred
async def test_guessing_codes_is_limited_and_a_good_one_makes_good(hall: Hall) -> None:
    """Ten tries for one robot from one network; a robot that enrolls may prove itself at once."""
    code = await code_for(hall, "c-3po")
    for _ in range(login_limiter.FAILURES - 1):
        end = await enrolling(hall, "wrong")
        assert "too many" not in end.refusal()["reason"]
    assert (await enrolling(hall, code)).hears()[0]["op"] == "enrolled"
    for _ in range(login_limiter.FAILURES):
        await enrolling(hall, "wrong")
    code = await code_for(hall, "c-3po")
    refusal = (await enrolling(hall, code)).refusal()
    assert "too many failures" in refusal["reason"]
    assert refusal["retry_after"] > 0


@pytest_twisted.ensureDeferred
async def test_an_enrolment_that_can_not_be_put_on_record_does_not_spend_the_code(
    hall: Hall, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both or neither."""
    code = await code_for(hall, "c-3po")

    def full(*_: object, **__: object) -> None:
        raise Unavailable("the disk is full")

    with monkeypatch.context() as patch:
        patch.setattr(queries, "append_audit", full)
        refusal = (await enrolling(hall, code)).refusal()
    assert (refusal["code"], refusal["retry_after"]) == ("unavailable", 5)
    assert (await enrolling(hall, code)).hears()[0]["op"] == "enrolled"


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
async def test_what_can_not_be_enrolled_does_not_spend_the_code(
    hall: Hall, robot: str, public_key: str, words: str
) -> None:
    """Keys of the wrong length and impossible names are refused in words."""
    code = await code_for(hall, "c-3po")
    end = hall.dial()
    end.says(link.Enroll(version=1, robot=robot, code=code, public_key=public_key))
    await end.answered()
    assert words in end.refusal()["reason"]
    assert (await enrolling(hall, code)).hears()[0]["op"] == "enrolled"


# --- channels ---------------------------------------------------------------------------------------------


class Member:
    """Somebody who is there."""

    def tell(self, level: str, text: str, id: object = None) -> None:
        """Not asked."""


async def asked_to_join(hall: Hall) -> tuple[Robot, str]:
    """A registered robot in use, and the ticket it was given."""
    robot = await hall.registered()
    assert hall.presence is not None
    hall.world.channels.of(hall.presence).attach(Member())
    hall.world.clock.advance(0)
    (ask,) = [each for each in robot.hears() if each["op"] == "open_channel"]
    return robot, ask["ticket"]


@pytest_twisted.ensureDeferred
async def test_a_robot_joins_its_channel_and_samples_flow(hall: Hall) -> None:
    """``joined`` tells the relay's clock; what comes over the link reaches the channel."""
    _, ticket = await asked_to_join(hall)
    end = hall.dial()
    end.says(link.Join(version=1, ticket=ticket))
    assert hall.presence is not None
    channel = hall.world.channels.of(hall.presence)
    joined = end.hears()[0]
    assert joined == {"op": "joined", "channel": channel.name, "at": hall.world.now_ns()}
    assert channel.state is ChannelState.OPEN
    got: list[tuple[int, bytes]] = []
    channel.subscriptions.sample = lambda number, body, time, stamp: got.append((number, body))  # type: ignore[method-assign]
    end.sends(encode_sample(7, 1, text("hi")))
    end.sends(encode_sample(8, 1, bytes(limits.HANDSHAKE_FRAME)))
    assert [number for number, _ in got] == [7, 8]
    end.says(link.Ping(t=5))
    assert {"op": "pong", "t": 5, "at": hall.world.now_ns()} in end.hears()
    end.says(link.Bye(reason="restarting"))
    assert channel.state is ChannelState.OPENING


@pytest_twisted.ensureDeferred
async def test_a_ticket_that_is_not_good_opens_nothing(hall: Hall) -> None:
    """Used, invented or empty; the channel goes on waiting or working."""
    _, ticket = await asked_to_join(hall)
    hall.dial().says(link.Join(version=1, ticket=ticket))
    for bad in (ticket, "invented", ""):
        end = hall.dial()
        end.says(link.Join(version=1, ticket=bad))
        assert end.refusal()["reason"] == "the channel ticket is unknown, used or too old"
        end.breaks()
    assert hall.presence is not None
    assert hall.world.channels.of(hall.presence).state is ChannelState.OPEN


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
async def test_large_json_is_taken_only_for_its_cdr(hall: Hall, body: bytes, taken: bool) -> None:
    """Millions of brackets or keys would stall everyone; base64 does not."""
    _, ticket = await asked_to_join(hall)
    end = hall.dial()
    end.says(link.Join(version=1, ticket=ticket))
    end.hears()
    end.sends(encode_json(body))
    assert end.transport.connected is taken
    if not taken:
        assert "as base64 in 'cdr'" in end.refusal()["reason"]


@pytest_twisted.ensureDeferred
async def test_losing_the_control_link_ends_the_channel_link(hall: Hall) -> None:
    """And the other way round the channel is asked for anew."""
    control, ticket = await asked_to_join(hall)
    end = hall.dial()
    end.says(link.Join(version=1, ticket=ticket))
    end.breaks()
    hall.world.clock.advance(0.5)
    (ask,) = [each for each in control.hears() if each["op"] == "open_channel"]
    end = hall.dial()
    end.says(link.Join(version=1, ticket=ask["ticket"]))
    control.breaks()
    assert end.hears()[-1]["op"] == "bye"
    assert not end.transport.connected
    assert hall.presence is not None
    assert hall.world.channels.of(hall.presence).state is ChannelState.WAITING


@pytest_twisted.ensureDeferred
async def test_a_slow_robot_gets_the_newest_samples_and_every_message(hall: Hall) -> None:
    """Towards robots too data gives way and control does not."""
    _, ticket = await asked_to_join(hall)
    end = hall.dial()
    end.says(link.Join(version=1, ticket=ticket))
    end.hears()
    producer = end.transport.producer
    assert producer is not None
    producer.pauseProducing()
    for number in range(300):
        end.connection.sample(1, number, text(str(number)))
    end.connection.send(link.GetType(type=STRING))
    assert end.hears() == []
    producer.resumeProducing()
    first, *samples = end.frames()
    assert b"get_type" in first.body
    assert [frame.stamp for frame in samples] == list(range(300 - 128, 300))


@pytest_twisted.ensureDeferred
async def test_a_link_closed_by_the_relay_is_dropped_if_the_robot_does_not_close_it(hall: Hall) -> None:
    """A moment for the farewell, then the connection is aborted; a closed one leaves no timer."""
    robot = await hall.registered()
    robot.transport.loseConnection = lambda: None  # type: ignore[method-assign]
    robot.connection.close("going down")
    robot.connection.close("again")
    assert [each["op"] for each in robot.hears()].count("bye") == 1
    assert not robot.transport.aborted
    hall.world.clock.advance(2)
    assert robot.transport.aborted
    await until(lambda: not hall.world.clock.getDelayedCalls())


@pytest_twisted.ensureDeferred
async def test_a_stranger_in_its_network_locks_no_robot_out(hall: Hall) -> None:
    """He fails with the robot's name, or another's, and keys of his own."""
    for number in range(login_limiter.FAILURES + 1):
        stranger = hall.dial()
        stranger.prove(stranger.hello("r2-d2", f"{number:064x}"), key=NEW_KEY)
        await stranger.answered()
        assert "not accepted" in stranger.refusal()["reason"]
    await hall.registered()


@pytest_twisted.ensureDeferred
async def test_the_log_says_of_which_realm_a_robot_is_that_tells_of_something_wrong(hall: Hall) -> None:
    """Robots of several realms may have one name; events of a realm have no others in them."""
    robot = await hall.registered()
    assert hall.presence is not None
    hall.presence.realm = "lab1"
    with capturedLogs() as logs:
        robot.says(link.Alert(level="warning", text="too hot"))
    assert "robot r2-d2@lab1: warning: too hot" in [formatEvent(each) for each in logs]
    await until(lambda: hall.journal._waiting == 0)
    (event,) = await hall.store.read(queries.list_events, kind="robot.alert")
    assert event.source == "robot:r2-d2"


@pytest_twisted.ensureDeferred
async def test_a_channel_carries_any_number_of_commands(hall: Hall) -> None:
    """What is on its way is measured by pings, which do not count themselves."""
    _, ticket = await asked_to_join(hall)
    end = hall.dial()
    end.says(link.Join(version=1, ticket=ticket))
    end.pongs()
    for number in range(3000):
        end.connection.command(1, number, 7, bytes(60))
        if not number % 50:
            end.pongs()
    assert not end.connection.ended
    assert not end.connection._outbox.dropped
