"""What SPEC.md says is what the code does."""

from __future__ import annotations

import json
import re
import typing
from pathlib import Path

import msgspec
import pytest

from relay_protocol import PROTOCOL_VERSION, frames, identity, jsontext, limits, link, rosbridge
from relay_protocol.rights import Level, Operation

FOLDER = Path(__file__).parents[2] / "protocol"
SPEC = (FOLDER / "SPEC.md").read_text("utf-8")
ROBOT_LINK = SPEC[SPEC.index("## 2. ") : SPEC.index("## 3. ")]
CLIENTS = SPEC[SPEC.index("## 1. ") : SPEC.index("## 2. ")]
STRUCTS = [
    each
    for each in vars(link).values()
    if isinstance(each, type) and issubclass(each, msgspec.Struct) and each is not link.Message
]
PROOF = json.loads((FOLDER / "vectors" / "proof.json").read_text("utf-8"))


@pytest.mark.parametrize("struct", STRUCTS, ids=lambda struct: struct.__name__)
def test_every_link_message_and_field_is_described(struct: type[msgspec.Struct]) -> None:
    """No op and no field of the robot link is missing from section 2."""
    tag = struct.__struct_config__.tag
    if tag is not None:
        assert f"**`{tag}`**" in ROBOT_LINK
    section = SPEC if struct is link.QoS else ROBOT_LINK
    for field in struct.__struct_fields__:
        assert f"`{field}`" in section


def test_every_client_op_and_field_is_described() -> None:
    """No op of a client and no field of it is missing from section 1."""
    for struct in typing.get_args(rosbridge.ClientOp):
        assert f"`{struct.__struct_config__.tag}`" in CLIENTS
        for field in struct.__struct_fields__:
            assert f"`{field}`" in CLIENTS


def test_the_version_and_the_words_of_rights_are_the_codes() -> None:
    """Title and table of rights follow the code."""
    assert SPEC.startswith(f"# The Switchboard protocol, version {PROTOCOL_VERSION}\n")
    assert all(f"| `{operation}` |" in SPEC for operation in Operation)
    assert " < ".join(map(str, Level)) in SPEC


@pytest.mark.parametrize(
    ("row", "value"),
    [
        (f"frame before the proof | {limits.HANDSHAKE_FRAME // limits.KIB} KiB", 16),
        (f"robot on its control link | {limits.CONTROL_FRAME // limits.MIB} MiB", 1),
        (f"robot on a channel link | {limits.ROBOT_FRAME // limits.MIB} MiB", 16),
        (f"JSON text from a robot | {limits.JSON_BODY // limits.MIB} MiB", 1),
        (f"all type definitions of a robot | {limits.TYPE_TEXTS // limits.MIB} MiB", 16),
        (f"mirror of a robot's graph | {limits.GRAPH_BYTES // limits.MIB} MiB", 8),
        (f"providers of one name | {limits.GRAPH_ENDS} each", 1024),
        (f"`service_response`'s `id` | {limits.LABEL} characters", 255),
        (f"`encodings` | {limits.FACTS}", 64),
        (f"`text` of an alert), `ref` | {limits.WORDS} characters", 4096),
        (f"names of types in `interfaces` | {limits.INTERFACES}", 8192),
        (f"a video link | {limits.PICTURE_FRAME // limits.MIB} MiB", 4),
        (f"height of a picture | {limits.PICTURE_SIDE}", 8192),
        (f"cameras of a robot | {limits.CAMERAS}", 256),
        (f"one link, unfinished | {limits.PARTS_BYTES // limits.MIB} MiB", 32),
        (
            f"one client, unfinished | {limits.FRAGMENTS}, {limits.CLIENT_MESSAGE // 10**6} MB together, "
            f"{limits.FRAGMENT_SECONDS:g} s",
            10,
        ),
        (f"JSON message to a robot | {limits.COMMAND_FRAME // limits.MIB} MiB", 4),
        (f"sample or command to a robot | {limits.ROBOT_MESSAGE // limits.MIB} MiB", 16),
        (f"sample from a robot | {limits.ROBOT_SAMPLE // limits.MIB} MiB", 64),
        (f"1 to {limits.MOST_SAMPLE // limits.MIB} MiB", 1024),
        (f"message and frame from a client | {limits.CLIENT_MESSAGE // 10**6} MB", 10),
        (f"{limits.UNPROVEN_SECONDS:g} s, {limits.UNPROVEN_BYTES // limits.KIB} KiB", 64),
        (f"nesting of JSON | {limits.JSON_DEPTH}", 64),
        (f"all it contains | {limits.TYPE_DEFINITION // limits.KIB} KiB", 256),
        (f"type or node | {limits.NAME} characters", 255),
        (f"name of a robot | {limits.ROBOT_NAME} characters", 63),
        (f"enrolment code | one use, {limits.ENROLMENT_SECONDS // 60} min", 15),
        (f"ticket in an address | one use, {limits.TICKET_SECONDS} s", 60),
        (f"ticket for a channel | one use, {limits.CHANNEL_TICKET_SECONDS} s", 30),
        (f"heartbeat | {limits.HEARTBEAT_SECONDS:g} s; three missed", limits.HEARTBEATS_MISSED),
        (f"age of a motion command | {limits.COMMAND_DEADLINE_MS} ms", 500),
        (f"standstill after the last motion command | {limits.STOP_WITHIN_MS} ms", 500),
        (f"closed after {limits.LINGER_SECONDS:g} s", 5),
        (f"without timeout | {limits.CALL_SECONDS:g} s", 30),
        (f"{limits.LEAST_SAMPLE // limits.MIB} to {limits.MOST_SAMPLE // limits.MIB} MiB", 1),
        (f"a suppression | {limits.SUPPRESS_MS[0]} to {limits.SUPPRESS_MS[1]} ms", 200),
        (f"an inhibition | at most {limits.INHIBIT_MS // 1000} s", 60),
        (f"connections of a suppression | {limits.SOURCES}", 256),
        (f"as it is sent | {limits.NAME_BYTES} bytes", 256),
    ],
)
def test_limits_are_those_of_the_code(row: str, value: int) -> None:
    """A limit that is changed in the code must be changed in the text."""
    assert row in SPEC
    assert value


def test_every_limit_is_in_the_text() -> None:
    """A limit that is new in the code must be told: each has a row above."""
    above = set(re.findall(r"limits\.([A-Z_]+)", Path(__file__).read_text()))
    assert {each for each in vars(limits) if each.isupper()} - above == set()


def hex_blocks() -> list[bytes]:
    """The indented hex of the worked example, in order."""
    example = SPEC[SPEC.index("## 6. ") :]
    return [bytes.fromhex(block) for block in re.findall(r"(?:^ {4}[0-9a-f]+\n)+", example, re.MULTILINE)]


def test_the_worked_example_is_true() -> None:
    """Keys, frames, the text that is signed and the signature are what the code makes."""
    public, hello, challenge, text, signature, prove = hex_blocks()
    case = PROOF["cases"][0]
    assert public.hex() == PROOF["public_key"]
    assert identity.public_half(bytes(range(32))) == public
    assert text == identity.proof_text("lab relay", "r2-d2", bytes(range(0x64, 0x84)))
    assert text.hex() == case["text"]
    assert signature.hex() == case["signature"]
    assert identity.sign(bytes(range(32)), "lab relay", "r2-d2", bytes(range(0x64, 0x84))) == signature
    decoder = frames.FrameDecoder(limits.HANDSHAKE_FRAME)
    first, second, third = (frame.body for frame in decoder.feed(hello + challenge + prove))
    said = jsontext.decode(link.opening_decoder, first)
    assert isinstance(said, link.Hello)
    assert said.key == identity.fingerprint(public)
    assert first.decode() in SPEC
    asked = jsontext.decode(link.opening_reply_decoder, second)
    assert isinstance(asked, link.Challenge)
    assert link.from_base64(asked.nonce, "nonce") == bytes(range(0x64, 0x84))
    assert jsontext.decode(link.opening_decoder, third) == link.Prove(signature=link.to_base64(signature))


def test_the_numbers_of_the_example_are_true() -> None:
    """Lengths that the text names are the lengths of the bytes."""
    _, hello, _, text, signature, _ = hex_blocks()
    assert f"a frame of {len(hello) - 4} bytes" in SPEC
    assert f"The text to sign, {len(text)} bytes" in SPEC
    assert f"The signature, {len(signature)} bytes" in SPEC
