"""The cases of ``protocol/vectors``, which hold for every implementation of the contract."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cbor2
import msgspec
import pytest

from relay_protocol import frames, identity, jsontext, link, rosbridge
from relay_protocol.errors import Invalid, MalformedMessage, PeerError
from relay_protocol.rights import Grant, Level, Operation, Rules, parse_pattern
from relay_protocol.ros_types import TypeRegistry
from tests.worlds.link_decoders import KEEPALIVE, LINKS, ops_of

FOLDER = Path(__file__).parents[2] / "protocol" / "vectors"
VECTORS = {path.stem: json.loads(path.read_text("utf-8")) for path in FOLDER.glob("*.json")}
TYPES = TypeRegistry()
for type_name, definition in VECTORS["cdr"]["types"].items():
    TYPES.add(type_name, definition)


def cases(file: str, part: str = "cases") -> pytest.MarkDecorator:
    """One test per case, under its name."""
    return pytest.mark.parametrize(
        "case", [pytest.param(case, id=case["name"]) for case in VECTORS[file][part]]
    )


def text_of(case: Any) -> bytes:
    """The bytes of a case."""
    if isinstance(case, str):
        return case.encode()
    if "hex" in case:
        return bytes.fromhex(case["hex"])
    if "repeat" in case:
        return f"{case.get('before', '')}{case['repeat'] * case['times']}{case.get('after', '')}".encode()
    return str(case["text"]).encode()


def as_vector(frame: frames.Frame) -> dict[str, Any]:
    """A frame in the form of the vectors."""
    if isinstance(frame, frames.JsonFrame):
        return {"kind": frames.JSON, "body": frame.body.hex()}
    numbered = {"number": frame.number, "stamp": str(frame.stamp), "body": frame.body.hex()}
    if isinstance(frame, frames.VideoFramePart):
        return {"kind": frames.VIDEO_PART, "total": frame.total, "offset": frame.offset, **numbered}
    if isinstance(frame, frames.CommandFrame):
        return {"kind": frames.COMMAND, "source": frame.source, **numbered}
    return {"kind": frames.SAMPLE if isinstance(frame, frames.SampleFrame) else frames.VIDEO, **numbered}


def test_every_file_is_run() -> None:
    """A new file of cases needs a test here."""
    assert set(VECTORS) == {"frames", "proof", "link", "rosbridge", "json", "rights", "cdr"}


@cases("frames")
@pytest.mark.parametrize("size", [1, 3, 5000])
def test_frames(case: dict[str, Any], size: int) -> None:
    """A stream gives these frames or this error, in pieces of any size."""
    decoder, stream = frames.FrameDecoder(VECTORS["frames"]["limit"]), bytes.fromhex(case["stream"])
    got: list[frames.Frame] = []
    error = None
    try:
        for start in range(0, len(stream), size):
            got += decoder.feed(stream[start : start + size])
    except PeerError as caught:
        error = caught.code
    assert error == case.get("error")
    if error is None:
        assert [as_vector(frame) for frame in got] == case["frames"]
        assert decoder.buffered == case.get("left", 0)


@cases("proof")
def test_proof(case: dict[str, Any]) -> None:
    """Text and signature are exact, and a wrong signature is refused."""
    vectors = VECTORS["proof"]
    key, public = bytes.fromhex(vectors["private_key"]), bytes.fromhex(vectors["public_key"])
    nonce, signature = bytes.fromhex(case["nonce"]), bytes.fromhex(case["signature"])
    assert identity.public_half(key) == public
    assert identity.fingerprint(public) == vectors["fingerprint"]
    assert identity.proof_text(case["relay"], case["robot"], nonce).hex() == case["text"]
    assert identity.verify(public, case["relay"], case["robot"], nonce, signature) is case["good"]
    assert (identity.sign(key, case["relay"], case["robot"], nonce) == signature) is case["good"]


def test_robot_names() -> None:
    """Valid and invalid names."""
    for name in VECTORS["proof"]["robot_names"]["good"]:
        assert identity.check_robot_name(name) == name
    for name in VECTORS["proof"]["robot_names"]["bad"]:
        with pytest.raises(Invalid):
            identity.check_robot_name(name)


@cases("link")
def test_link(case: dict[str, Any]) -> None:
    """A message decodes to these values, or gives this error."""
    decoder = getattr(link, f"{case['link']}_decoder")
    if "error" in case:
        with pytest.raises(MalformedMessage) as caught:
            jsontext.decode(decoder, text_of(case))
        assert case["error"] in str(caught.value)
    else:
        wanted = case["text"] if case.get("same") else case["becomes"]
        assert jsontext.encode(jsontext.decode(decoder, text_of(case))) == wanted.encode()


@pytest.mark.parametrize("name", LINKS)
def test_every_link_message_has_a_case(name: str) -> None:
    """One that is decoded."""
    good = [case for case in VECTORS["link"]["cases"] if case["link"] == name and "error" not in case]
    assert ops_of(name) - KEEPALIVE <= {json.loads(case["text"])["op"] for case in good}


@cases("rosbridge")
def test_rosbridge(case: dict[str, Any]) -> None:
    """A client's message has these fields, or ends with this error."""
    if "error" in case:
        with pytest.raises(MalformedMessage) as caught:
            rosbridge.decode(text_of(case))
        assert case["error"] in str(caught.value)
        return
    message = rosbridge.decode(text_of(case))
    assert message.__struct_config__.tag == case["op"]
    for name, wanted in case["fields"].items():
        value = getattr(message, name)
        if isinstance(value, msgspec.Struct):
            value = msgspec.to_builtins(value)
        assert (bytes(value).decode() if isinstance(value, msgspec.Raw) else value) == wanted


@cases("json")
def test_json(case: dict[str, Any]) -> None:
    """A text has this value, or ends with this error."""
    if "error" in case:
        with pytest.raises(MalformedMessage) as caught:
            jsontext.decode_any(text_of(case))
        assert case["error"] in str(caught.value)
        return
    value = jsontext.decode_any(text_of(case))
    if "deep" in case:
        for _ in range(case["deep"] - 1):
            (value,) = value
        assert value == []
    elif "value_length" in case:
        assert len(value) == case["value_length"]
    else:
        assert value == case["value"]


@cases("rights")
def test_rights(case: dict[str, Any]) -> None:
    """The decision and the reason are these."""
    grants = [
        Grant(Level(each["level"]), tuple(each["allow"]), tuple(each["deny"])) for each in case["grants"]
    ]
    decision = Rules(grants).decide(Operation(case["operation"]), case["resource"])
    assert decision == (case["allowed"], case["reason"])


def test_patterns() -> None:
    """Valid and invalid patterns."""
    for text in VECTORS["rights"]["patterns"]["good"]:
        assert parse_pattern(text) == text
    for text in VECTORS["rights"]["patterns"]["bad"]:
        with pytest.raises(Invalid):
            parse_pattern(text)


@cases("cdr", "both")
def test_cdr_in_both_directions(case: dict[str, Any]) -> None:
    """These bytes are this JSON."""
    assert json.loads(TYPES.to_json(case["type"], bytes.fromhex(case["cdr"]))) == case["json"]
    assert TYPES.from_json(case["type"], case["json"], 0).hex() == case["cdr"]


@cases("cdr", "read")
def test_cdr_to_json(case: dict[str, Any]) -> None:
    """These bytes are read as this JSON."""
    assert json.loads(TYPES.to_json(case["type"], bytes.fromhex(case["cdr"]))) == case["json"]


@cases("cdr", "cbor")
def test_cdr_to_cbor(case: dict[str, Any]) -> None:
    """These bytes are read as these values in CBOR, typed arrays and all."""
    wanted = cbor2.loads(bytes.fromhex(case["cbor"]))
    assert cbor2.loads(TYPES.to_cbor(case["type"], bytes.fromhex(case["cdr"]))) == wanted


@cases("cdr", "write")
def test_json_to_cdr(case: dict[str, Any]) -> None:
    """This text is written as these bytes."""
    now = int(VECTORS["cdr"]["now_ns"])
    assert TYPES.from_json(case["type"], text_of(case["json"]), now).hex() == case["cdr"]


@cases("cdr", "bad_read")
def test_bad_cdr(case: dict[str, Any]) -> None:
    """These bytes are refused."""
    with pytest.raises(Invalid):
        TYPES.to_json(case["type"], bytes.fromhex(case["cdr"]))


@cases("cdr", "bad_write")
def test_bad_values(case: dict[str, Any]) -> None:
    """This text is refused, and why."""
    with pytest.raises(Invalid) as caught:
        TYPES.from_json(case["type"], text_of(case["json"]), 0)
    assert case["error"] in str(caught.value)


@cases("cdr", "bad_definitions")
def test_bad_definitions(case: dict[str, Any]) -> None:
    """This definition is refused, and why."""
    with pytest.raises(Invalid) as caught:
        TypeRegistry().add(case["type"], case["text"])
    assert case["error"] in str(caught.value)
