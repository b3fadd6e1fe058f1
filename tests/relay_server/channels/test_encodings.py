"""Samples in every format that clients request."""

from __future__ import annotations

import base64
import io
import json
import struct
from typing import Any

import cbor2
import pytest
from PIL import Image
from twisted.logger import LogLevel, globalLogPublisher

from relay_protocol import link
from relay_server.channels import encodings
from relay_server.channels import samples as module
from relay_server.common import cpu_quota
from tests.worlds.relay import STRING, Person, World, text
from tests.worlds.topic_viewers import counting, heard, watching

STAMP = 1_700_000_000_000_000_007


def last(person: Person) -> dict[str, Any]:
    """The last message, decoded from any format."""
    return opened(person.client.sent[-1])


def opened(payload: bytes) -> dict[str, Any]:
    """A decoded message; fragments are not joined."""
    message = json.loads(payload) if payload.startswith(b"{") else cbor2.loads(payload)
    if message["op"] == "png":
        picture = Image.open(io.BytesIO(base64.b64decode(message["data"])))
        message = json.loads(picture.tobytes())
    return dict(message)


def errors(person: Person) -> list[str]:
    """Texts of the statuses that the client received."""
    return [message["msg"] for message in map(opened, person.client.sent) if message["op"] == "status"]


@pytest.mark.parametrize("compression", ["none", "png", "cbor"])
def test_the_same_in_each_form(world: World, compression: str) -> None:
    """The content does not depend on the format."""
    number, (person,) = watching(world, {"compression": compression})
    world.channel.sample(number, text("häi"), STAMP)
    assert last(person) == {"op": "publish", "topic": "/chatter", "msg": {"data": "häi"}}
    assert person.client.sent[0].startswith(b'{"op":"png"') == (compression == "png")


FORMS: list[dict[str, Any]] = [{}, {"topic": "chatter"}, *({"compression": each} for each in ("png", "cbor"))]


@pytest.mark.parametrize("first", FORMS)
@pytest.mark.parametrize("second", FORMS)
def test_order_of_requests_makes_no_difference(
    world: World, first: dict[str, Any], second: dict[str, Any]
) -> None:
    """A sample rendered for one client suits another one with its own spelling and format."""
    number, (one, other) = watching(world, first, second)
    plain = {"op": "publish", "msg": {"data": "hi"}}
    for word in ("hi", "hi"):
        world.channel.sample(number, text(word))
    for person, ask in ((one, first), (other, second)):
        assert [opened(each) for each in person.client.sent] == [
            {**plain, "topic": ask.get("topic", "/chatter")}
        ] * 2
        assert person.client.sent[0].startswith(b'{"op":"png"') == (ask.get("compression") == "png")


def test_raw_is_what_the_robot_sent(world: World) -> None:
    """The stamp is when the sample reached the robot; the bytes are unchanged."""
    number, (person,) = watching(world, {"compression": "cbor-raw"})
    world.channel.sample(number, text("hi"), STAMP)
    assert last(person)["msg"] == {"secs": 1_700_000_000, "nsecs": 7, "bytes": text("hi")}


def test_raw_needs_no_definition(world: World) -> None:
    """It is sent at once, even if the definition is late or unavailable. Other formats wait for it."""
    world.robot_comes()
    raw, plain = world.person(), world.person()
    world.robot_joins()
    for person, compression in ((raw, "cbor-raw"), (plain, "none")):
        person.says("set_level", level="error")
        person.says("subscribe", topic="/chatter", compression=compression)
    number = world.link.all(link.Subscribe)[0].number
    world.subscribed(number, latched=True, publishers=1)
    world.channel.sample(number, text("a"), STAMP)
    assert last(raw)["msg"]["bytes"] == text("a")
    assert not plain.client.sent
    late = world.person()
    late.says("subscribe", topic="/chatter", compression="cbor-raw")
    assert last(late)["msg"]["bytes"] == text("a")
    late_plain = world.person()
    late_plain.says("subscribe", topic="/chatter")
    world.channel.message(link.Failed(request="get_type", reference=STRING, reason="not installed"))
    assert errors(plain) == ["subscribe /chatter: not installed"]
    assert not errors(raw)
    world.channel.sample(number, text("b"), STAMP)
    assert last(raw)["msg"]["bytes"] == text("b")
    assert not late_plain.client.sent


def test_sample_waiting_for_its_type_comes_once(world: World) -> None:
    """Each waiting client gets the sample once, when the definition arrives."""
    world.robot_comes()
    raw, plain = world.person(), world.person()
    world.robot_joins()
    for person, compression in ((raw, "cbor-raw"), (plain, "none")):
        person.says("subscribe", topic="/chatter", compression=compression)
    number = world.link.all(link.Subscribe)[0].number
    world.subscribed(number)
    world.channel.sample(number, text("a"))
    world.define()
    assert heard(plain) == ["a"]
    assert len(raw.client.sent) == 1


def test_raw_of_a_robot_that_speaks_json(world: World) -> None:
    """The client gets one error, and plain JSON."""
    world.robot_comes(encodings=["json"])
    person = world.person()
    world.robot_joins()
    person.says("set_level", level="error")
    person.says("subscribe", topic="/chatter", compression="cbor-raw")
    number = world.link.all(link.Subscribe)[0].number
    world.subscribed(number, encoding="json")
    for word in ("a", "b"):
        world.channel.sample(number, json.dumps({"data": word}).encode())
    reported, first, second = map(opened, person.client.sent)
    assert reported["level"] == "error" and "not CDR" in reported["msg"]
    assert (first["msg"], second["msg"]) == ({"data": "a"}, {"data": "b"})


def test_an_encoding_that_is_unavailable_is_reported_with_the_ids(world: World) -> None:
    """All subscriptions of the client to the topic are listed, each once."""
    world.robot_comes(encodings=["json"])
    person = world.person()
    world.robot_joins()
    person.says("set_level", level="error")
    for id in ("a", 2):
        person.says("subscribe", topic="/chatter", compression="cbor-raw", id=id)
    number = world.link.all(link.Subscribe)[0].number
    world.subscribed(number, encoding="json")
    for _ in range(2):
        world.channel.sample(number, b'{"data": "a"}')
    assert [each["id"] for each in person.received("status")] == ["a", 2]


def test_cbor_of_a_robot_that_speaks_json(world: World) -> None:
    """The content of the JSON, in a binary message."""
    world.robot_comes(encodings=["json"])
    person = world.person()
    world.robot_joins()
    person.says("subscribe", topic="/chatter", compression="cbor")
    number = world.link.all(link.Subscribe)[0].number
    world.subscribed(number, encoding="json")
    world.channel.sample(number, b'{"data": [1, 2.5, null]}')
    assert not person.client.sent[-1].startswith(b"{")
    assert last(person)["msg"] == {"data": [1, 2.5, None]}


def test_nan_stays_nan_in_cbor(world: World) -> None:
    """JSON cannot express it; CBOR can."""
    world.robot.types.add("test/msg/Ranges", "float32[] ranges\n")
    cdr = b"\x00\x01\x00\x00" + struct.pack("<Iff", 2, float("nan"), 1.5)
    sample = module.Sample(cdr, 0, module.Converter(world.robot.types, "test/msg/Ranges", "cdr", print))
    person = world.person()
    for compression in ("none", "cbor"):
        person.says("subscribe", topic="/chatter", compression=compression)
        listener = person.session.subscriptions._by_topic["/chatter"]
        person.context.deliver(listener, sample)
    plain, typed = map(opened, person.client.sent)
    assert plain["msg"] == {"ranges": [None, 1.5]}
    assert typed["msg"]["ranges"] == cbor2.CBORTag(85, cdr[8:])


def test_long_samples_come_in_fragments(world: World) -> None:
    """Only long text messages are divided, and each is sent completely before the next."""
    number, (parts, binary) = watching(
        world, {"fragment_size": 100}, {"fragment_size": 100, "compression": "cbor"}
    )
    world.channel.sample(number, text("x" * 300))
    world.channel.sample(number, text("short"))
    *fragments, short = [opened(payload) for payload in parts.client.sent]
    assert [each["num"] for each in fragments] == [0, 1, 2, 3]
    joined = json.loads("".join(each["data"] for each in fragments))
    assert joined["msg"]["data"] == "x" * 300
    assert short["msg"]["data"] == "short"
    assert [opened(payload)["op"] for payload in binary.client.sent] == ["publish", "publish"]


def test_a_png_that_would_take_long_comes_plain(world: World) -> None:
    """The client gets one warning."""
    number, (person,) = watching(world, {"compression": "png"})
    person.says("set_level", level="warning")
    for _ in range(2):
        world.channel.sample(number, text("x" * encodings.MAX_PNG))
    reported, first, second = map(json.loads, person.client.sent)
    assert (reported["op"], reported["level"]) == ("status", "warning")
    assert str(encodings.MAX_PNG) in reported["msg"]
    assert first["op"] == second["op"] == "publish"


def test_fifty_clients_cost_one_conversion_a_form(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """JSON, CBOR and PNG are each made once for all clients."""
    asks: list[dict[str, Any]] = [
        {"compression": compression, "fragment_size": size}
        for compression in ("none", "png", "cbor", "cbor-raw", "none")
        for size in (0, 64, 100, 1000, 5000)
    ] * 2
    number, people = watching(world, *asks)
    pictures: list[bytes] = []
    encode = encodings.png
    monkeypatch.setattr(encodings, "png", lambda message: pictures.append(message) or encode(message))
    converted = counting(world, number)
    world.channel.sample(number, text("x" * 500))
    assert sorted(converted) == ["cbor", "json"]
    assert len(pictures) == 1
    assert all(person.client.sent for person in people)


COSTLY: list[dict[str, Any]] = [
    {"compression": "png"},
    {"fragment_size": 64},
    {"compression": "png", "fragment_size": 64},
]


def op(payload: bytes) -> str:
    """The operation of a text message."""
    return str(json.loads(payload)["op"])


@pytest.mark.parametrize("ask", COSTLY)
def test_exhausted_quota_gives_plain_json(world: World, ask: dict[str, Any]) -> None:
    """The client gets a warning from time to time until the quota refills. Another user's format still works
    and is shared.
    """
    number, (person,) = watching(world, ask)
    person.says("set_level", level="warning")
    body = text("x" * 500)
    world.channel.sample(number, body)
    (in_form, *_) = person.client.sent
    assert op(in_form) != "publish"
    person.client.sent.clear()
    spend_encodings(world, person)
    for _ in range(3):
        world.channel.sample(number, body)
    assert [op(each) for each in person.client.sent] == ["status", "publish", "publish", "publish"]
    assert "your share is used up" in errors(person)[0]
    assert person.context.plain_instead == 3
    world.clock.advance(1.0)
    person.client.sent.clear()
    world.channel.sample(number, body)
    assert op(person.client.sent[0]) == op(in_form)


def spend_encodings(world: World, person: Person) -> None:
    """Uses up the user's quota, while the quota of all users has some left."""
    with person.context.quota.user.encoding():
        world.worked += cpu_quota.ENCODINGS_RESERVE + 0.05
    world.clock.advance(0.3)
    assert not person.context.quota.user.may_encode
    assert world.budgets.of(99).may_encode


def test_encoding_shared_with_others_costs_nothing(world: World) -> None:
    """Only the user whose request comes first is charged; the others share the PNG."""
    number, (poor,) = watching(world, {"compression": "png"})
    rich, later = world.person(user=8), world.person(user=7)
    for each in (rich, later):
        each.says("subscribe", topic="/chatter", compression="png")
    spend_encodings(world, poor)
    world.channel.sample(number, text("x"))
    assert [op(each.client.sent[-1]) for each in (poor, rich, later)] == ["publish", "png", "png"]
    assert (poor.context.plain_instead, later.context.plain_instead) == (1, 0)


def test_answers_are_plain_json_when_the_quota_is_used_up(world: World) -> None:
    """The client is warned. CBOR answers are made from JSON."""
    (person,) = watching(world, {})[1]
    person.says("set_level", level="warning")
    spend_encodings(world, person)
    for compression in ("png", "cbor"):
        person.client.sent.clear()
        person.says("call_service", service="/rosapi/topics", compression=compression)
        reported, reply = map(json.loads, person.client.sent)
        assert (reported["op"], reported["level"], reply["op"]) == ("status", "warning", "service_response")
    assert person.context.plain_instead == 2


def test_json_that_is_too_long_for_cbor_comes_plain(world: World) -> None:
    """This applies where CBOR is made from JSON; the client gets one warning."""
    number, (person,) = watching(world, {"compression": "cbor"})
    person.says("set_level", level="warning")
    world.subscribed(number, encoding="json")
    for _ in range(2):
        world.channel.sample(number, b'{"data":"' + b"x" * encodings.MAX_CBOR + b'"}')
    assert [op(each) for each in person.client.sent] == ["status", "publish", "publish"]


def test_samples_are_not_converted_while_all_are_paused(world: World) -> None:
    """Replaced samples are not converted either. The first receiver that continues causes one conversion."""
    number, people = watching(world, {"compression": "cbor"}, {"queue_length": 1}, {"queue_length": 1})
    converted = counting(world, number)
    for person in people:
        person.rosbridge.pause()
    for word in ("a", "b", "c"):
        world.channel.sample(number, text(word))
    assert converted == []
    people[1].rosbridge.resume()
    people[2].rosbridge.resume()
    assert converted == ["json"]
    assert [heard(person) for person in people[1:]] == [["c"], ["c"]]


def test_renderings_of_a_sample_are_bounded(world: World) -> None:
    """A latched sample is kept for long, so its number of formats is limited."""
    number, (person,) = watching(world, {})
    world.subscribed(number, latched=True, publishers=1)
    world.channel.sample(number, text("x" * 100_000))
    (kept,) = world.channel.subscriptions.by_number[number].latched_samples._samples.values()
    for size in range(1000, 1100):
        person.says("subscribe", topic="/chatter", fragment_size=size)
        listener = person.session.subscriptions._by_topic["/chatter"]
        person.context.deliver(listener, kept)
    assert kept.plain and kept._cached is not None
    others = sum(len(each.frames or b"") for each in kept._cached.values())
    assert len(kept.plain) + others == kept._cached_bytes
    assert kept._cached_bytes <= 4 * kept.size + module._SPARE_BYTES


def test_a_failure_is_logged_once_and_reported_once(world: World) -> None:
    """Each client with the failed format gets a reason; clients with raw bytes still get them."""
    number, people = watching(world, {}, {"compression": "cbor"}, {"compression": "cbor-raw"})
    for person in people:
        person.says("set_level", level="error")
    logged: list[Any] = []
    globalLogPublisher.addObserver(logged.append)
    try:
        for _ in range(3):
            world.channel.sample(number, b"\x00\x01\x00\x00\xff\xff\xff\x7f")
    finally:
        globalLogPublisher.removeObserver(logged.append)
    assert len([event for event in logged if event["log_level"] is LogLevel.warn]) == 1
    for person in people[:2]:
        (reported,) = errors(person)
        assert reported.startswith("/chatter: a message can't be converted: std_msgs/msg/String")
    assert len(people[2].client.sent) == 3
    assert not errors(people[2])


def test_a_failure_is_reported_again_after_a_new_request(world: World) -> None:
    number, (person,) = watching(world, {})
    person.says("set_level", level="error")
    world.channel.sample(number, b"")
    person.says("subscribe", topic="/chatter")
    world.channel.sample(number, b"")
    assert len(errors(person)) == 2
