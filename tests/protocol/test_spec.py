"""The specification agrees with the code."""

from __future__ import annotations

import json
import re
import typing
from pathlib import Path

import msgspec
import pytest

from relay_protocol import PROTOCOL_VERSION, frames, identity, jsontext, limits, link, rosbridge
from relay_protocol.rights import Level, Operation
from relay_server.common import close_codes
from tests.worlds.spec_examples import blocks, compact, values
from tests.worlds.specification import CHAPTERS, PATHS, SPEC, section, unwrapped

FOLDER = Path(__file__).parents[2] / "protocol"
ROBOT_LINK = section("2")
CLIENTS = section("1")
STRUCTS = [
    each
    for each in vars(link).values()
    if isinstance(each, type) and issubclass(each, msgspec.Struct) and each is not link.Message
]
PROOF = json.loads((FOLDER / "vectors" / "proof.json").read_text("utf-8"))


@pytest.mark.parametrize("struct", STRUCTS, ids=lambda struct: struct.__name__)
def test_every_link_message_and_field_is_described(struct: type[msgspec.Struct]) -> None:
    """Section 2 has every op and every field of the robot link."""
    tag = struct.__struct_config__.tag
    if tag is not None:
        assert f"**`{tag}`**" in ROBOT_LINK
    section = SPEC if struct in (link.QoS, link.Thinning) else ROBOT_LINK
    for field in struct.__struct_fields__:
        assert f"`{field}`" in section


_FIELD_TABLE = re.compile(r"^\| Field[^|]* \| Type[^|]* \| Meaning \|\n\|---.*\n((?:\|.*\n)+)", re.MULTILINE)
_OP_ROW = re.compile(r"^\| \*\*`(\w+)`\*\* \| (.*?) \|", re.MULTILINE)


def table_fields(rows: str) -> dict[str, str]:
    """Each field of a table with its type."""
    cells = [row.strip("|").split(" | ") for row in rows.splitlines()]
    return {name: type.strip() for names, type, *_ in cells for name in re.findall(r"`(\w+)`", names)}


@pytest.mark.parametrize(
    "fields",
    [table_fields(rows) for rows in _FIELD_TABLE.findall(ROBOT_LINK)],
    ids=lambda fields: "-".join(fields)[:40],
)
def test_a_table_of_fields_is_that_of_a_message(fields: dict[str, str]) -> None:
    """It has all fields of one message or of an object in one, and their defaults."""
    (struct,) = {each for each in STRUCTS if set(each.__struct_fields__) == set(fields)}
    for info in msgspec.structs.fields(struct):
        default = re.search(r" \((.*)\)$", fields[info.name])
        assert (default is None) is info.required, info.name
        if default is not None:
            real = info.default if info.default_factory is msgspec.NODEFAULT else info.default_factory()
            text = default[1].strip("`")
            shown = text if text.isalpha() and text not in ("true", "false", "null") else json.loads(text)
            assert shown == json.loads(msgspec.json.encode(real)), info.name


def test_there_are_tables_of_fields() -> None:
    assert len(_FIELD_TABLE.findall(ROBOT_LINK)) > 15


@pytest.mark.parametrize(("op", "text"), _OP_ROW.findall(ROBOT_LINK), ids=lambda each: each[:20])
def test_a_row_of_a_message_has_all_its_fields(op: str, text: str) -> None:
    """In the tables that have a message in each row."""
    found = [each for each in STRUCTS if each.__struct_config__.tag == op]
    assert found
    for struct in found:
        assert {*struct.__struct_fields__} <= {*re.findall(r"`(\w+)`", text)}


def test_every_client_op_and_field_is_described() -> None:
    """Section 1 has every op of a client and every field."""
    for struct in typing.get_args(rosbridge.ClientOp):
        assert f"`{struct.__struct_config__.tag}`" in CLIENTS
        for field in struct.__struct_fields__:
            assert f"`{field}`" in CLIENTS


def test_every_file_is_a_chapter_of_the_index() -> None:
    """The index has each file once, in the order of the numbers, which are those of the titles."""
    assert sorted(path.name for path in (FOLDER / "spec").iterdir()) == sorted(
        ["index.md", *(path.name for path in PATHS.values())]
    )
    numbers = [[int(part) for part in number.split(".")] for number in PATHS]
    assert numbers == sorted(numbers)
    for number, text in CHAPTERS.items():
        assert re.match(rf"# {re.escape(number)}\.? \w", text)


_RULE = re.compile(r"^\*\*([\d.]+)-(\d+)\*\* ", re.MULTILINE)
_CITED = re.compile(r"(?<![\w.])(\d(?:\.\d+)?)-(\d+)\b(?!-)")
RULES = [(number, int(rule)) for chapter in CHAPTERS.values() for number, rule in _RULE.findall(chapter)]


def test_every_rule_has_an_id_of_its_own() -> None:
    """The ids of a chapter have its number, or that of a section in it; no id occurs twice."""
    assert len(RULES) == len(set(RULES))
    for number, chapter in CHAPTERS.items():
        for part, _ in _RULE.findall(chapter):
            assert part == number or f"\n## {part} " in chapter


@pytest.mark.parametrize("number", [number for number in CHAPTERS if number != "6"])
def test_every_paragraph_has_an_id(number: str) -> None:
    """Not those of the examples, lists, tables and what says which end sends the messages below."""
    text = re.sub(
        r"^```.*?^```$", "", CHAPTERS[number].partition("\n## Examples\n")[0], flags=re.DOTALL | re.MULTILINE
    )
    for paragraph in re.split(r"\n\s*\n", text):
        if paragraph.strip() and not paragraph.startswith(("#", "|", "- ", "    ")):
            assert _RULE.match(paragraph) or paragraph.strip() in ("Robot to relay:", "Relay to robot:")


def test_cited_rules_and_chapters_exist() -> None:
    """In the specification itself, and as ``SPEC 2.5-23`` or ``SPEC 2.5`` in code, tests and documents."""
    for chapter in CHAPTERS.values():
        text = re.sub(r"`[^`]*`", "", chapter.partition("\n## Examples\n")[0])
        for number, rule in _CITED.findall(text):
            assert number not in CHAPTERS or (number, int(rule)) in RULES, f"{number}-{rule}"
    sections = {*CHAPTERS, *(number for number, _ in RULES)}
    found = 0
    for path in cited_in():
        for number, rule in re.findall(
            r"SPEC (?:section )?(\d(?:\.\d+)?)(?:-(\d+))?(?![\w.]*\d)", path.read_text("utf-8")
        ):
            found += 1
            assert number in sections, f"{path}: {number}"
            assert not rule or (number, int(rule)) in RULES, f"{path}: {number}-{rule}"
    assert found > 200


def cited_in() -> list[Path]:
    """Files of the repository that may cite the specification."""
    root = FOLDER.parent
    kinds = {".py", ".md", ".ts", ".svelte", ".json"}
    folders = (
        "bench",
        "db",
        "docs",
        "protocol",
        "relay_server",
        "robot_client",
        "scripts",
        "tests",
        "web_client/src",
    )
    return [
        path
        for folder in folders
        for path in (root / folder).rglob("*")
        if path.suffix in kinds and "node_modules" not in path.parts and "portal" not in path.parts
    ]


def test_close_codes_are_those_of_the_relay() -> None:
    """1.4 has a row for each, and for the one of RFC 6455 that the websocket library sends."""
    rows = {int(code) for code in re.findall(r"^\| (\d{4}) \|", CHAPTERS["1.4"], re.MULTILINE)}
    assert rows == {value for name, value in vars(close_codes).items() if name.isupper()} | {1002}


def test_the_version_and_the_words_of_rights_are_the_codes() -> None:
    """Title and table of rights agree with the code."""
    assert SPEC.startswith(f"# The Switchboard protocol, version {PROTOCOL_VERSION}\n")
    assert all(f"| `{operation}` |" in SPEC for operation in Operation)
    assert " < ".join(map(str, Level)) in SPEC


@pytest.mark.parametrize(
    ("row", "value"),
    [
        (f"frame before the proof | {limits.HANDSHAKE_FRAME // limits.KIB} KiB", 16),
        (f"robot on its control link | {limits.CONTROL_FRAME // limits.MIB} MiB", 1),
        (f"robot on a channel link | {limits.ROBOT_FRAME // limits.MIB} MiB", 16),
        (f"a call of a function (1.23) {limits.FUNCTION_BODY // limits.MIB} MiB", 24),
        (f"of an upload (1.22) {limits.FILE_BODY // limits.MIB} MiB", 8),
        (f"function, as MessagePack | {limits.FUNCTION_BYTES // limits.MIB} MiB each", 16),
        (f"JSON text from a robot | {limits.JSON_BODY // limits.MIB} MiB", 1),
        (f"all type definitions of a robot | {limits.TYPE_TEXTS // limits.MIB} MiB", 16),
        (f"mirror of a robot's graph | {limits.GRAPH_BYTES // limits.MIB} MiB", 8),
        (f"providers of one name | {limits.GRAPH_NODES} each", 1024),
        (f"`service_response`'s `id` | {limits.LABEL_LENGTH} characters", 255),
        (f"`encodings` | {limits.LIST_ITEMS}", 64),
        (f"`text` of an alert), `ref` | {limits.TEXT_LENGTH} characters", 4096),
        (f"request about control (1.7) | {limits.REASON_LENGTH} characters", 500),
        (f"id of a stop (`stop_id`, 1.7) | {limits.STOP_ID_LENGTH} characters", 64),
        (f"names of types in `interfaces` | {limits.INTERFACES}", 8192),
        (f"a video link | {limits.VIDEO_FRAME // limits.MIB} MiB", 4),
        (f"height of a picture | {limits.IMAGE_SIDE}", 8192),
        (f"cameras of a robot | {limits.CAMERAS}", 256),
        (f"modules of a robot | {limits.MODULES}", 64),
        (f"file of a robot | {limits.FILE_NAME} bytes", 1024),
        (f"part of a file | {limits.FILE_PART // limits.KIB} KiB", 16),
        (f"one link, not confirmed | {limits.FILE_UNCONFIRMED // limits.KIB} KiB", 512),
        (f"uploaded at a time | {limits.FILE_UPLOADS}", 16),
        (f"in one measurement | {limits.PROCESSES}", 512),
        (f"log | {limits.LOG_LINES} lines, {limits.LOG_BYTES // limits.KIB} KiB", 256),
        (f"line of a log | {limits.LOG_WAIT_SECONDS:g} s", 30),
        (f"one link, unfinished | {limits.INCOMPLETE_SAMPLE_BYTES // limits.MIB} MiB", 32),
        (
            f"one client, unfinished | {limits.INCOMPLETE_MESSAGES}, {limits.CLIENT_MESSAGE // 10**6} MB together, "
            f"{limits.FRAGMENT_SECONDS:g} s",
            10,
        ),
        (
            f"over all connections | {limits.UNFINISHED_MESSAGES} times the largest message "
            f"({limits.UNFINISHED_MESSAGES * limits.CLIENT_MESSAGE // 10**6} MB)",
            40,
        ),
        (
            f"finish a message | {limits.MESSAGE_SECONDS:g} s, and 1 s for each "
            f"{limits.MESSAGE_RATE // limits.KIB} KiB",
            16,
        ),
        (f"two parts of a sample | {limits.PART_SECONDS:g} s", 60),
        (f"JSON message to a robot | {limits.RELAY_JSON_FRAME // limits.MIB} MiB", 4),
        (f"sample or command to a robot | {limits.RELAY_FRAME // limits.MIB} MiB", 16),
        (f"stride of a point cloud | {limits.STRIDE}", 1000),
        (f"voxel of a point cloud | {limits.VOXEL:g} m", 1000),
        (f"asset of a robot | {limits.ASSET // limits.MIB} MiB", 64),
        (f"part of an asset | {limits.ASSET_PART // limits.KIB} KiB", 128),
        (f"URI of an asset | {limits.ASSET_URI} characters", 1024),
        (f"sample from a robot | {limits.ROBOT_SAMPLE // limits.MIB} MiB", 64),
        (f"1 to {limits.MAX_SAMPLE // limits.MIB} MiB", 1024),
        (f"message and frame from a client | {limits.CLIENT_MESSAGE // 10**6} MB", 10),
        (f"{limits.UNAUTHENTICATED_SECONDS:g} s, {limits.UNAUTHENTICATED_BYTES // limits.KIB} KiB", 64),
        (f"body of a request | {limits.HTTP_BODY // limits.KIB} KiB", 48),
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
        (f"{limits.MIN_SAMPLE // limits.MIB} to {limits.MAX_SAMPLE // limits.MIB} MiB", 1),
        (f"a suppression | {limits.SUPPRESS_MS[0]} to {limits.SUPPRESS_MS[1]} ms", 200),
        (f"an inhibition | at most {limits.INHIBIT_MS // 1000} s", 60),
        (f"connections of a suppression | {limits.SOURCES}", 256),
        (f"as it is sent | {limits.NAME_BYTES} bytes", 256),
    ],
)
def test_limits_are_those_of_the_code(row: str, value: int) -> None:
    """A limit that changes in the code must change in the text."""
    assert row in unwrapped(SPEC)
    assert value


def test_every_limit_is_in_the_text() -> None:
    """A new limit in the code must be in the text: each has a row above."""
    above = set(re.findall(r"limits\.([A-Z_]+)", Path(__file__).read_text()))
    assert {each for each in vars(limits) if each.isupper()} - above == set()


def hex_blocks() -> list[bytes]:
    """The indented hex of the worked example, in order."""
    return [
        bytes.fromhex(block) for block in re.findall(r"(?:^ {4}[0-9a-f]+\n)+", CHAPTERS["6"], re.MULTILINE)
    ]


def test_the_worked_example_is_true() -> None:
    """The code makes the same keys, frames, signed text and signature."""
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
    said = jsontext.decode(link.handshake_request_decoder, first)
    assert isinstance(said, link.Hello)
    assert said.key == identity.fingerprint(public)
    shown = [
        compact(value)
        for block in blocks("handshake_request") + blocks("handshake_reply")
        for value in values(block.text)
    ]
    assert [body.decode() in shown for body in (first, second, third)] == [True, True, True]
    asked = jsontext.decode(link.handshake_reply_decoder, second)
    assert isinstance(asked, link.Challenge)
    assert link.from_base64(asked.nonce, "nonce") == bytes(range(0x64, 0x84))
    assert jsontext.decode(link.handshake_request_decoder, third) == link.Prove(
        signature=link.to_base64(signature)
    )


def test_the_numbers_of_the_example_are_true() -> None:
    """Lengths in the text are those of the bytes."""
    _, hello, _, text, signature, _ = hex_blocks()
    example = unwrapped(CHAPTERS["6"])
    assert f"a frame of {len(hello) - 4} bytes" in example
    assert f"The text to sign, {len(text)} bytes" in example
    assert f"The signature, {len(signature)} bytes" in example
