"""The examples of the specification are true: each is decoded, encoded again, or played with a relay in memory."""

from __future__ import annotations

import json
import re
import typing
from typing import Any

import msgspec
import pytest
from twisted.internet.task import Clock

from relay_protocol import frames, function_link, jsontext, limits, link, rosbridge
from relay_protocol.ros_types import TypeRegistry
from relay_server.access import Principal
from relay_server.fleet import order as fleet_order
from relay_server.icpi import messages as icpi_messages
from relay_server.icpi.programs import ProgramRegistry
from relay_server.icpi.session import IcpiServices, IcpiSession
from relay_server.video import websocket as video_websocket
from relay_server.video.frames import VideoFrameInfo
from tests.worlds.link_decoders import KEEPALIVE, LINKS, ops_of
from tests.worlds.relay import TEXTS, messages_in
from tests.worlds.spec_examples import BLOCKS, Block, Exchange, blocks, compact, lines, values
from tests.worlds.specification import CHAPTERS

CLIENT_OPS = [each.__struct_config__.tag for each in typing.get_args(rosbridge.ClientOp)]
RELAY_OPS = {
    "action_feedback",
    "action_result",
    "call_service",
    "cancel_action_goal",
    "fragment",
    "png",
    "publish",
    "send_action_goal",
    "service_response",
    "status",
}
"""Operations of the relay to a client."""

OTHER = {
    "json client",
    "json fleet",
    "json video_relay",
    "json video_viewer",
    "text exchange",
    "text frames",
    "text cdr",
    "text icpi",
    "text function_request",
    "text function_reply",
    "sh ",
}
"""Further examples; those of a shell are run with those of the guides."""


def named(found: list[Block]) -> pytest.MarkDecorator:
    """One test for each block."""
    return pytest.mark.parametrize(
        "block", [pytest.param(each, id=f"{each.chapter}-{number}") for number, each in enumerate(found)]
    )


def pairs(kind: str) -> list[tuple[str, str]]:
    """The hexadecimal lines of the blocks of one kind, joined, with the indented line below that says what it is."""
    text = "\n".join(each.text for each in blocks(kind))
    found = re.findall(r"^((?:[0-9a-f]+\n)+) +(\S.*)$", text, re.MULTILINE)
    return [("".join(data.split()), said) for data, said in found]


def test_every_block_has_a_test() -> None:
    assert {f"{each.language} {each.kind}" for each in BLOCKS} == {f"json {each}" for each in LINKS} | OTHER


@pytest.mark.parametrize("chapter", CHAPTERS)
def test_json_in_the_text_is_json(chapter: str) -> None:
    """An object between backquotes can be decoded."""
    for text in re.findall(r'`(\{"[^`]*)`', CHAPTERS[chapter]):
        jsontext.decode_any(text.encode())


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        pytest.param(kind, message, id=f"{kind}-{message['op']}-{number}")
        for kind in LINKS
        for number, message in enumerate(value for block in blocks(kind) for value in values(block.text))
    ],
)
def test_a_message_of_the_link(kind: str, message: Any) -> None:
    """It is decoded, and encoded again it has the same fields: none is misspelled, or has its default."""
    decoder = getattr(link, f"{kind}_decoder")
    assert jsontext.encode(jsontext.decode(decoder, compact(message).encode())).decode() == compact(message)


@pytest.mark.parametrize("kind", LINKS)
def test_every_message_of_the_link_has_an_example(kind: str) -> None:
    """In the chapter of its link."""
    shown = {value["op"] for block in blocks(kind) for value in values(block.text)}
    assert shown | KEEPALIVE == ops_of(kind) | KEEPALIVE


def test_keepalive_has_examples() -> None:
    """In a chapter of its own, since every link has these messages."""
    assert {
        value["op"] for each in BLOCKS if each.chapter == "2.3" for value in values(each.text)
    } == KEEPALIVE


@named(blocks("exchange"))
def test_an_exchange(block: Block) -> None:
    """Every message of the relay is as shown, in this order, and there are no others."""
    Exchange().play(block.text)


@pytest.mark.parametrize(
    "change",
    [
        ('"data":"hi"', '"data":"ho"'),
        ('robot<  {"op":"unsubscribe","number":1}\n', ""),
        ('robot<  {"op":"unsubscribe","number":1}', 'robot<  {"op":"unsubscribe","number":2}'),
        ('client< {"op":"publish"', 'client< {"op":"publish","more":1'),
    ],
)
def test_a_wrong_exchange_is_found(change: tuple[str, str]) -> None:
    """A field that differs, and a message that is missing."""
    text = blocks("exchange")[0].text
    assert change[0] in text
    with pytest.raises(AssertionError):
        Exchange().play(text.replace(*change))


def exchanged(direction: str) -> list[dict[str, Any]]:
    """All JSON messages of clients in exchanges."""
    said = [step for block in blocks("exchange") for step in lines(block.text)]
    return [
        json.loads(text) for party, text in said if party == f"client{direction}" and text.startswith("{")
    ]


def test_every_operation_of_a_client_has_an_example() -> None:
    """In an exchange; ``auth`` comes before there is a session."""
    shown = [*exchanged(">"), *(value for block in blocks("client") for value in values(block.text))]
    assert {each["op"] for each in shown} == set(CLIENT_OPS)


def test_a_client_sends_only_known_fields() -> None:
    """Unknown fields would be ignored, so that a misspelled one could stand in an example."""
    fields = {
        each.__struct_config__.tag: set(each.__struct_fields__) | {"op"}
        for each in typing.get_args(rosbridge.ClientOp)
    }
    shown = [*exchanged(">"), *(value for block in blocks("client") for value in values(block.text))]
    for each in shown:
        rosbridge.decode(compact(each).encode())
        assert set(each) <= fields[each["op"]]


def test_every_operation_of_the_relay_has_an_example() -> None:
    assert {each["op"] for each in exchanged("<")} == RELAY_OPS


def shown_frame(frame: frames.Frame) -> str:
    """A frame as the specification shows it."""
    if isinstance(frame, frames.JsonFrame):
        return f"json {frame.body.decode()}"
    kinds = {
        frames.SampleFrame: "sample",
        frames.CommandFrame: "command",
        frames.VideoFrame: "picture",
        frames.VideoFramePart: "part of a picture",
        frames.FilePart: "part of a file",
    }
    named = (f"{field} {getattr(frame, field)}" for field in frame.__struct_fields__[:-1])
    return f"{kinds[type(frame)]}: {', '.join(named)}, body {frame.body.hex()}"


def test_frames() -> None:
    """The bytes of each kind are these; both parts of a sample are one sample."""
    shown = pairs("frames")
    decoder = frames.FrameDecoder(limits.ROBOT_FRAME)
    for data, text in shown:
        got = decoder.feed(bytes.fromhex(data))
        assert [shown_frame(each) for each in got] == ([] if text == "part of a sample" else [text])
    assert {int(data[8:10], 16) for data, _ in shown} == {
        frames.JSON,
        frames.SAMPLE,
        frames.VIDEO,
        frames.PART,
        frames.VIDEO_PART,
        frames.COMMAND,
        frames.FILE_PART,
    }


@named(blocks("cdr"))
def test_cdr(block: Block) -> None:
    """The bytes are this JSON, and the JSON these bytes."""
    type_name, *rest = block.text.splitlines()
    cdr = "".join(line for line in rest if not line.startswith(" "))
    text = "".join(line.strip() for line in rest if line.startswith(" "))
    types = TypeRegistry()
    types.add(type_name, TEXTS[type_name])
    assert json.loads(types.to_json(type_name, bytes.fromhex(cdr))) == json.loads(text)
    assert types.from_json(type_name, json.loads(text), 0).hex() == cdr


def test_requests_of_a_function_link() -> None:
    """Each is MessagePack of these fields, and each op has one."""
    shown = pairs("function_request")
    for data, text in shown:
        fields = msgspec.msgpack.decode(bytes.fromhex(data))
        decoded = function_link.decode_request(bytes.fromhex(data))
        assert compact(msgspec.to_builtins(fields)) == text
        assert set(fields) <= {"op", *decoded.__struct_fields__}
    assert {json.loads(text)["op"] for _, text in shown} == {
        each.__struct_config__.tag for each in typing.get_args(function_link.FunctionRequest)
    }


def test_replies_of_a_function_link() -> None:
    """Each is MessagePack of these fields."""
    shown = pairs("function_reply")
    assert shown
    for data, text in shown:
        reply = function_link.decode_reply(bytes.fromhex(data))
        assert msgspec.msgpack.encode(reply).hex() == data
        assert compact(msgspec.to_builtins(reply)) == text


def test_messages_to_a_viewer_of_a_camera() -> None:
    """They are what the relay makes of such a frame, and of such a status."""
    head, status = (value for block in blocks("video_relay") for value in values(block.text))
    image = b"\0" * head["size"]
    fields = {name: value for name, value in head.items() if name not in ("op", "size")}
    frame = VideoFrameInfo(body=image, good_until=0.0, **fields)
    (_, text), (_, binary) = messages_in(video_websocket.frame_message(frame))
    assert (text.decode(), binary) == (compact(head), image)
    instead = tuple((status["instead"] or {}).items())
    reported = {name: value for name, value in status.items() if name not in ("op", "instead")}
    ((_, text),) = messages_in(video_websocket.status_message(link.StreamStatus(**reported), instead))
    assert text.decode() == compact(status)


def test_messages_of_a_viewer() -> None:
    (shown,) = (value for block in blocks("video_viewer") for value in values(block.text))
    decoded = msgspec.json.decode(compact(shown), type=video_websocket.FrameAcknowledged)
    assert jsontext.encode(decoded).decode() == compact(shown)


def test_lines_of_a_fleet_order() -> None:
    """The first and the last one, and one for each robot between them, have all fields and no others."""
    first, *results, last = (value for block in blocks("fleet") for value in values(block.text))
    kinds = [
        fleet_order.FleetOrderStart,
        *[fleet_order.FleetRobotResult] * len(results),
        fleet_order.FleetOrderEnd,
    ]
    for kind, value in zip(kinds, [first, *results, last], strict=True):
        assert jsontext.encode(msgspec.convert(value, kind)).decode() == compact(value)
    assert (first["robots"], last["robots"]) == ([each["robot"] for each in results], len(results))
    assert (last["ok"], last["failed"]) == (
        sum(each["ok"] for each in results),
        sum(not each["ok"] for each in results),
    )


class ProgramTransport:
    """Stores messages to a program."""

    def __init__(self) -> None:
        self.received: list[str] = []

    def send(self, data: bytes) -> None:
        self.received += [payload.decode() for _, payload in messages_in(data)]


@named(blocks("icpi"))
def test_icpi(block: Block) -> None:
    """Programs of one user say this, and get these answers."""
    principal = Principal(1, "ann", "default", False, 1, None)

    async def authenticate(_: str) -> Principal:
        return principal

    unused: Any = None
    clock: Any = Clock()
    services = IcpiServices(clock, ProgramRegistry(), unused, unused, authenticate, lambda: 0)
    programs: dict[str, tuple[IcpiSession, ProgramTransport]] = {}
    for party, said in lines(block.text):
        name = party[:-1]
        if name not in programs:
            transport: Any = ProgramTransport()
            session = IcpiSession(services, transport, principal, "token", "here", lambda _: None)
            programs[name] = (session, transport)
        session, transport = programs[name]
        assert icpi_messages.write(icpi_messages.parse(said)) == said
        if party.endswith(">"):
            session.message(said.encode())
        else:
            assert transport.received.pop(0) == said
    assert [transport.received for _, transport in programs.values()] == [[]] * len(programs)
