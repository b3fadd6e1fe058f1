"""One message with every kind of array in every format, to third-party clients and to a test client."""

from __future__ import annotations

import base64
import io
import json
import math
import subprocess
import time
from pathlib import Path
from typing import Any

import cbor2
import pytest
from PIL import Image

from relay_protocol.ros_types import TypeRegistry
from tests.worlds.sync_client import Client

CLIENTS = Path(__file__).parent / "clients"
ROOT = Path(__file__).parents[2]
NEW = ROOT / "web_client" / "node_modules" / "roslib" / "dist" / "RosLib.js"
OLD = CLIENTS / "node_modules" / "roslib" / "src" / "RosLibNode.js"
TYPE = "switchboard_test_interfaces/msg/Sequences"
TOPIC = "/encodings"

SENT: dict[str, Any] = {
    "flags": [True, False],
    "raws": [0, 7, 255],
    "letters": [65, 200],
    "singles": [0.5, None, -2.0],
    "doubles": [0.1, None],
    "tinies": [-128, 127],
    "smalls": [0, 255],
    "shorts": [-32768, 32767],
    "ports": [0, 65535],
    "wholes": [-(2**31), 2**31 - 1],
    "counts": [0, 2**32 - 1],
    "fars": [-5, 2**40],
    "vasts": [5, 2**41],
    "texts": ["naïve", "😀", "\n\n"],
    "wides": ["ß"],
    "inners": [],
}
BYTES = {"raws", "letters", "smalls"}
AS_JSON = {
    name: base64.b64encode(bytes(value)).decode() if name in BYTES else value for name, value in SENT.items()
}
TYPED = {
    "singles": (85, "f", "Float32Array"),
    "doubles": (86, "d", "Float64Array"),
    "tinies": (72, "b", "Int8Array"),
    "shorts": (77, "h", "Int16Array"),
    "ports": (69, "H", "Uint16Array"),
    "wholes": (78, "i", "Int32Array"),
    "counts": (70, "I", "Uint32Array"),
    "fars": (79, "q", "BigInt64Array"),
    "vasts": (71, "Q", "BigUint64Array"),
}
FORMS = ["none", "png", "cbor", "cbor-raw"]


class Speaker:
    """An operator that publishes the message repeatedly."""

    def __init__(self, client: Client) -> None:
        self._client = client
        client.send(op="advertise", topic=TOPIC, type=TYPE)

    def say(self) -> None:
        """Publishes it once."""
        self._client.send(op="publish", topic=TOPIC, msg=SENT)

    def until(self, done: subprocess.Popen[str]) -> str:
        """Waits until a client has exited with 0; returns its output."""
        try:
            for _ in range(600):
                try:
                    out, err = done.communicate(timeout=0.1)
                except subprocess.TimeoutExpired:
                    self.say()
                    continue
                assert done.returncode == 0, err
                return out
            raise AssertionError("the client did not end")
        finally:
            done.kill()
            done.communicate()


@pytest.fixture
def speaker(world: Any) -> Any:
    """A publisher to the robot; the relay's own subscription receives the message too."""
    with world.relay.connect("rover", world.operator) as client:
        yield Speaker(client)


def roslib(world: Any, speaker: Speaker, module: Path, compression: str, fragment_size: int = 0) -> Any:
    """The message as roslib.js in Node decodes it."""
    command = [str(ROOT / "scripts" / "with-node.sh"), "node", "--no-deprecation"]
    command += [str(CLIENTS / "encodings.mjs"), str(module), world.relay.url("rover"), world.viewer]
    command += [TOPIC, TYPE, compression, str(fragment_size)]
    pipe = subprocess.PIPE
    return json.loads(speaker.until(subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True)))


def checked(message: dict[str, Any], arrays: dict[str, str]) -> None:
    """Checks that roslib.js has decoded a CBOR message unchanged.

    :param arrays: the kind of array of each numeric field
    """
    for name, value in SENT.items():
        got = message[name]
        if name in BYTES:
            assert got == {"array": "Uint8Array", "values": value}
        elif name in TYPED:
            numbers = [str(each) if arrays[name].startswith("Big") else each for each in value]
            numbers = ["NaN" if each is None else each for each in numbers]
            assert got == ({"array": arrays[name], "values": numbers} if arrays[name] else numbers)
        else:
            assert got == value


def of_cdr(body: bytes) -> Any:
    """A serialised message in its JSON form."""
    types = TypeRegistry()
    folder = ROOT / "tests" / "interfaces" / "switchboard_test_interfaces" / "msg"
    text = (folder / "Sequences.msg").read_text()
    inner = (folder / "Inner.msg").read_text()
    types.add(TYPE, f"{text}\n{'=' * 80}\nMSG: switchboard_test_interfaces/msg/Inner\n{inner}")
    return json.loads(types.to_json(TYPE, body))


@pytest.mark.parametrize("module", [NEW, OLD], ids=["roslib 2", "roslib 1"])
@pytest.mark.parametrize("compression", ["none", "png"])
def test_roslib_js_in_json_and_png(world: Any, speaker: Speaker, module: Path, compression: str) -> None:
    """The same message, with bytes as base64 and NaN as null."""
    assert roslib(world, speaker, module, compression) == AS_JSON


def test_roslib_js_in_cbor(world: Any, speaker: Speaker) -> None:
    """Arrays of numbers are JavaScript's typed arrays."""
    message = roslib(world, speaker, NEW, "cbor")
    checked(message, {name: array for name, (_, _, array) in TYPED.items()})


def test_roslib_js_1_in_cbor(world: Any, speaker: Speaker) -> None:
    """It makes plain arrays of 64-bit integers."""
    message = roslib(world, speaker, OLD, "cbor")
    checked(message, {name: "" if "Big" in array else array for name, (_, _, array) in TYPED.items()})


@pytest.mark.parametrize("module", [NEW, OLD], ids=["roslib 2", "roslib 1"])
def test_roslib_js_in_raw_cbor(world: Any, speaker: Speaker, module: Path) -> None:
    """It has the time of arrival at the robot, and the bytes of ROS 2."""
    message = roslib(world, speaker, module, "cbor-raw")
    assert abs(message["secs"] - time.time()) < 3600
    assert 0 <= message["nsecs"] < 10**9
    assert message["bytes"]["array"] == "Uint8Array"
    assert of_cdr(bytes(message["bytes"]["values"])) == AS_JSON


@pytest.mark.parametrize("compression", ["none", "png"])
def test_roslib_js_in_fragments(world: Any, speaker: Speaker, compression: str) -> None:
    """It joins them, those of a PNG too."""
    assert roslib(world, speaker, NEW, compression, 100) == AS_JSON


def received(world: Any, speaker: Speaker, **ask: Any) -> list[str | bytes]:
    """The raw websocket messages of one sample."""
    with world.relay.connect("rover", world.viewer) as client:
        client.send(op="subscribe", topic=TOPIC, type=TYPE, **ask)
        until = time.monotonic() + 30
        while time.monotonic() < until:
            speaker.say()
            try:
                first = client.connection.recv(timeout=0.2)
            except TimeoutError:
                continue
            total = json.loads(first).get("total", 1) if isinstance(first, str) else 1
            return [first] + [client.connection.recv(timeout=10) for _ in range(total - 1)]
    raise AssertionError("nothing came")


@pytest.mark.parametrize("fragment_size", [None, 64, 300])
@pytest.mark.parametrize("compression", FORMS)
def test_every_encoding_without_a_library(
    world: Any, speaker: Speaker, compression: str, fragment_size: int | None
) -> None:
    """By SPEC 1.6, read with other libraries than the relay and its clients use."""
    messages = received(world, speaker, compression=compression, fragment_size=fragment_size)
    if compression.startswith("cbor"):
        (binary,) = messages
        assert isinstance(binary, bytes)
        message = cbor2.loads(binary)
    else:
        text = [json.loads(each) for each in messages]
        assert (len(text) > 1) == (fragment_size is not None)
        if fragment_size:
            assert [each["num"] for each in text] == list(range(len(text)))
            assert max(len(each["data"].encode()) for each in text) <= fragment_size
            text = [json.loads("".join(each["data"] for each in text))]
        (message,) = text
    if compression == "png":
        picture = Image.open(io.BytesIO(base64.b64decode(message["data"])))
        assert picture.mode == "RGB"
        message = json.loads(picture.tobytes())
    assert (message["op"], message["topic"]) == ("publish", TOPIC)
    if compression == "cbor-raw":
        assert set(message["msg"]) == {"secs", "nsecs", "bytes"}
        assert of_cdr(message["msg"]["bytes"]) == AS_JSON
    elif compression == "cbor":
        by_hand(message["msg"])
    else:
        assert message["msg"] == AS_JSON


def by_hand(message: dict[str, Any]) -> None:
    """Checks that a CBOR message is unchanged, tag by tag (RFC 8746)."""
    for name, value in SENT.items():
        got = message[name]
        if name in BYTES:
            assert (got.tag, list(got.value)) == (64, value)
        elif name in TYPED:
            tag, letter, _ = TYPED[name]
            numbers = memoryview(got.value).cast(letter).tolist()
            assert got.tag == tag
            assert [None if math.isnan(each) else each for each in numbers] == value
        else:
            assert got == value
