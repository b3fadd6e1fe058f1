"""Other formats of the same messages: fragments in both directions, PNG, CBOR, raw CBOR."""

from __future__ import annotations

import base64
import json
import math
import time
import zlib

import cbor2
import pytest
from conformance_suite import NO_STATUS, Hand, Server, case
from rosbridge_client import Client, png_text, strict_json

STRING = "std_msgs/msg/String"
COUNTER = "/conformance/counter"
FRAGMENTATION = "rosbridge v2, 3.1.1 Fragmentation"
PNG = "rosbridge v2, 3.1.2 PNG compression"
CBOR = "rosbridge v2, 3.1.3 CBOR encoding"
RAW = "rosbridge v2, 3.1.4 CBOR-RAW encoding"
NO_COMPRESSION_OF_CALLS = "answers of services and actions are never compressed (call_service.py; issue 1091)"
SIZE_OF_CLIENT = (
    "fragment_size is the connection's, set by whichever message named one last (protocol.py, incoming)"
)
SAME_ID = "fragments of all messages have the id 0 (protocol.py, send; fragmentation.py)"
IN_ORDER_OF_ARRIVAL = "fragments are joined in the order in which they come (defragmentation.py)"
RAW_FOR_ALL = "all clients of a topic get it raw or decoded, as the first one asked (subscribers.py)"
LONG = "0123456789abcdefghijklmnopqrstuvwxyzäöü🤖" * 30


def subscribed(
    client: Client, hand: Hand, topic: str, type_name: str, message: object, **fields: object
) -> None:
    """The robot publishes one message on a topic that the client has subscribed in some format."""
    hand.topic(topic, type_name)
    client.send("subscribe", topic=topic, type=type_name, **fields)
    if fields.get("compression") == "png" or (
        "fragment_size" in fields and not str(fields.get("compression")).startswith("cbor")
    ):
        client.formed(lambda: hand.publish(topic, message))
    else:
        hand.publish(topic, message)


def cut(message: dict, parts: int, name: str) -> list[dict]:
    """A message as fragments."""
    text = json.dumps(message)
    size = -(-len(text) // parts)
    pieces = [text[at : at + size] for at in range(0, len(text), size)]
    return [
        {"op": "fragment", "id": name, "data": piece, "num": number, "total": len(pieces)}
        for number, piece in enumerate(pieces)
    ]


def invert(call_id: str) -> dict:
    """A call whose answer shows that it arrived."""
    return {"op": "call_service", "id": call_id, "service": "/conformance/invert", "args": {"data": True}}


# --- fragment, out ---


@case("fragment", FRAGMENTATION)
def test_fragment_of_samples(client: Client, hand: Hand, topic: str) -> None:
    """With fragment_size a longer sample comes in fragments that joined are the message."""
    subscribed(client, hand, topic, STRING, {"data": LONG}, fragment_size=200)
    parts = client.fragments()
    assert len(parts) > 1
    assert [part["num"] for part in parts] == list(range(parts[0]["total"]))
    assert all(type(part["total"]) is int and part["total"] == len(parts) for part in parts)
    whole = strict_json("".join(part["data"] for part in parts))
    assert whole == {"op": "publish", "topic": topic, "msg": {"data": LONG}}


@case("fragment", FRAGMENTATION)
def test_fragment_size(client: Client, hand: Hand, topic: str) -> None:
    """No fragment's data is longer than fragment_size."""
    subscribed(client, hand, topic, STRING, {"data": "x" * 2000}, fragment_size=128)
    assert max(len(part["data"].encode()) for part in client.fragments()) <= 128


@case("fragment", FRAGMENTATION)
def test_fragment_short_is_whole(client: Client) -> None:
    """A sample that is not longer than fragment_size comes whole."""
    client.send("subscribe", topic=COUNTER, type="std_msgs/msg/Int64", fragment_size=1000)
    client.until("publish", topic=COUNTER)
    client.none("fragment", 0.1)


@case("fragment", FRAGMENTATION, suite=SAME_ID)
def test_fragment_ids_differ(client: Client, hand: Hand, topic: str) -> None:
    """Fragments of two messages have two ids."""
    subscribed(client, hand, topic, STRING, {"data": LONG}, fragment_size=400)
    first = client.fragments()[0]["id"]
    client.formed(lambda: hand.publish(topic, {"data": LONG}))
    assert client.fragments()[0]["id"] != first


@case("fragment", "rosbridge v2, 3.3.4 Subscribe, several subscriptions", suite=SIZE_OF_CLIENT)
@pytest.mark.parametrize("sizes", [(100_000, 256), (256, 100_000)], ids=["least last", "least first"])
def test_fragment_least_size(client: Client, hand: Hand, topic: str, sizes: tuple[int, int]) -> None:
    """Of several subscriptions of one client the least fragment_size counts, in whatever order they come."""
    client.send("subscribe", topic=topic, type=STRING, id="first", fragment_size=sizes[0])
    subscribed(client, hand, topic, STRING, {"data": "x" * 1000}, id="second", fragment_size=sizes[1])
    assert max(len(part["data"]) for part in client.fragments()) <= 256


@case("fragment", "rosbridge v2, 3.3.8 Call Service, fragment_size", suite=SIZE_OF_CLIENT)
def test_fragment_of_answers(client: Client) -> None:
    """With fragment_size a longer service_response comes in fragments, and the next call without it whole."""
    call = {"service": "/rosapi/services", "args": {}}
    client.formed(lambda: client.send("call_service", id="cut", fragment_size=128, **call))
    parts = client.fragments()
    assert len(parts) > 1
    answer = strict_json("".join(part["data"] for part in parts))
    assert (answer["op"], answer["id"], answer["result"]) == ("service_response", "cut", True)
    client.send("call_service", id="whole", **call)
    assert client.until("service_response", id="whole")["values"] == answer["values"]


# --- fragment, in ---


@case("fragment", FRAGMENTATION)
def test_fragment_in(client: Client) -> None:
    """A client's message in fragments is joined."""
    for part in cut(invert("joined"), 4, "f1"):
        client.send(**part)
    assert client.until("service_response", id="joined")["result"] is True


@case("fragment", FRAGMENTATION, suite=IN_ORDER_OF_ARRIVAL)
def test_fragment_in_any_order(client: Client) -> None:
    """A client's fragments are joined by their num, in whatever order they come."""
    for part in reversed(cut(invert("shuffled"), 5, "f2")):
        client.send(**part)
    assert client.until("service_response", id="shuffled")["result"] is True


@case("fragment", FRAGMENTATION)
def test_fragment_in_mixed(client: Client) -> None:
    """Fragments of two messages may be mixed, and other messages come in between."""
    one, two = cut(invert("one"), 3, "f3"), cut(invert("two"), 3, "f4")
    for first, second in zip(one, two, strict=True):
        client.send(**first)
        client.lives()
        client.send(**second)
    for name in ("one", "two"):
        assert client.until("service_response", id=name)["result"] is True


@case("fragment", FRAGMENTATION)
def test_fragment_in_unfinished(client: Client) -> None:
    """A message that lacks a fragment is not executed."""
    for part in cut(invert("unfinished"), 3, "f5")[:2]:
        client.send(**part)
    client.none("service_response", id="unfinished")
    client.lives()


@case("fragment", "SPEC 1.6, of one client")
def test_fragment_in_of_two_clients(client: Client, server: Server) -> None:
    """Fragments of two clients with the same id are not mixed up."""
    with server.connect() as other:
        mine, others = cut(invert("mine"), 2, "same"), cut(invert("others"), 2, "same")
        client.send(**mine[0])
        client.lives()
        other.send(**others[0])
        other.lives()
        client.send(**mine[1])
        other.send(**others[1])
        assert client.until("service_response", id="mine")["result"] is True
        assert other.until("service_response", id="others")["result"] is True


BAD = {
    "num is total": [{"data": "{}", "num": 2, "total": 2}],
    "num below 0": [{"data": "{}", "num": -1, "total": 2}],
    "total 0": [{"data": "{}", "num": 0, "total": 0}],
    "total no number": [{"data": "{}", "num": 0, "total": "two"}],
    "no data": [{"data": "", "num": 0, "total": 2}],
    "text that is no message": [{"data": "no JSON", "num": 0, "total": 1}],
    "total changes": [{"data": "{", "num": 0, "total": 2}, {"data": "}", "num": 1, "total": 3}],
    "a num twice": [{"data": "{", "num": 0, "total": 3}, {"data": "{", "num": 0, "total": 3}],
    "a fragment inside": [
        {"data": '{"op":"fragment","id":"in","data":"{}","num":0,"total":1}', "num": 0, "total": 1}
    ],
}


@case("fragment", "SPEC 1.6 and 1.3", suite=NO_STATUS)
@pytest.mark.parametrize("what", BAD)
def test_fragment_in_nonsense(reported: Client, what: str) -> None:
    """Fragments that make no sense are refused in words, and the connection lives."""
    for fields in BAD[what]:
        reported.send("fragment", id="nonsense", **fields)
    assert reported.until("status", level="error")["msg"]
    reported.lives()


@case("fragment", "SPEC 1.6, dropped until num 0")
def test_fragment_in_again(client: Client) -> None:
    """After a message in fragments that made no sense one with the same id is joined."""
    client.send("fragment", id="again", data="{", num=0, total=2)
    client.send("fragment", id="again", data="}", num=1, total=3)
    for part in cut(invert("sense"), 3, "again"):
        client.send(**part)
    assert client.until("service_response", id="sense")["result"] is True


@case("fragment", "SPEC 1.6, less than 64 counts as 64")
def test_fragment_size_tiny(server: Server, hand: Hand, topic: str) -> None:
    """A fragment_size below 64 counts as 64, with a warning."""
    with server.connect() as client:
        client.send("set_level", level="warning")
        subscribed(client, hand, topic, STRING, {"data": "x" * 500}, fragment_size=1)
        assert client.until("status", level="warning")["msg"]
        parts = client.fragments()
        assert max(len(part["data"]) for part in parts) == 64


@case("fragment", "SPEC 1.6, 16 messages at a time")
def test_fragment_in_too_many(reported: Client) -> None:
    """More than 16 unfinished messages at a time are refused in words, and the connection lives."""
    for number in range(17):
        reported.send("fragment", id=f"open-{number}", data="{", num=0, total=2)
    assert reported.until("status", level="error")["msg"]
    reported.lives()


@case("fragment", "SPEC 1.6, 10 MB together")
def test_fragment_in_too_large(reported: Client) -> None:
    """Unfinished messages of more than 10 MB together are refused in words, and the connection lives."""
    for number in range(3):
        reported.send("fragment", id="large", data="x" * 4_000_000, num=number, total=4)
    assert reported.until("status", level="error")["msg"]
    reported.lives()


# --- large samples ---


@case("subscribe", "SPEC 2.1, samples in parts; SPEC 4, base64")
def test_large_sample(client: Client) -> None:
    """A sample of 1 MB comes whole, byte by byte."""
    client.send("subscribe", topic="/conformance/large", type="std_msgs/msg/UInt8MultiArray")
    data = base64.b64decode(client.until("publish")["msg"]["data"], validate=True)
    assert data == bytes(number % 251 for number in range(1_000_000))


@case("cbor", "SPEC 2.1, samples in parts; SPEC 1.6")
def test_large_sample_in_cbor(client: Client) -> None:
    """A sample of 1 MB comes whole in CBOR too."""
    client.send(
        "subscribe", topic="/conformance/large", type="std_msgs/msg/UInt8MultiArray", compression="cbor"
    )
    data = client.until("publish")["msg"]["data"]
    data = data.value if isinstance(data, cbor2.CBORTag) else data
    assert data == bytes(number % 251 for number in range(1_000_000))


# --- png ---


@case("png", PNG)
def test_png_of_samples(client: Client, hand: Hand, topic: str) -> None:
    """With compression png a sample comes as the pixels of a PNG in base64."""
    subscribed(client, hand, topic, STRING, {"data": LONG}, compression="png")
    message = client.until("png")
    whole = strict_json(png_text(message["data"]))
    assert whole == {"op": "publish", "topic": topic, "msg": {"data": LONG}}


@case("png", "SPEC 1.6, png")
def test_png_plain(client: Client, hand: Hand, topic: str) -> None:
    """The picture is about square, has no chunk that is not needed, and its JSON is ASCII."""
    subscribed(client, hand, topic, STRING, {"data": LONG}, compression="png")
    data = client.until("png")["data"]
    png = base64.b64decode(data)
    kinds, at = [], 8
    while at < len(png):
        kinds.append(png[at + 4 : at + 8])
        at += 12 + int.from_bytes(png[at : at + 4], "big")
    assert set(kinds) == {b"IHDR", b"IDAT", b"IEND"}
    width, height = int.from_bytes(png[16:20], "big"), int.from_bytes(png[20:24], "big")
    assert width == math.isqrt(len(png_text(data).encode()) // 3)
    assert height >= width
    assert png_text(data).isascii()


@case("png", PNG)
def test_png_small(client: Client) -> None:
    """A short sample comes as PNG too."""
    client.send("subscribe", topic=COUNTER, type="std_msgs/msg/Int64", compression="png")
    assert strict_json(png_text(client.until("png")["data"]))["topic"] == COUNTER


@case("png", "rosbridge v2, 3.3.8 Call Service, compression", suite=NO_COMPRESSION_OF_CALLS)
def test_png_of_answers(client: Client) -> None:
    """With compression png the service_response comes as PNG."""
    call = {"service": "/conformance/invert", "args": {"data": False}}
    client.formed(lambda: client.send("call_service", id="pixels", compression="png", **call))
    answer = strict_json(png_text(client.until("png")["data"]))
    assert (answer["op"], answer["id"], answer["result"]) == ("service_response", "pixels", True)


@case("png", "SPEC 1.6, text messages that are longer")
def test_png_in_fragments(client: Client, hand: Hand, topic: str) -> None:
    """PNG and fragment_size together: what joined is the png message."""
    noise = "".join(chr(33 + (number * 7919) % 90) for number in range(3000))
    subscribed(client, hand, topic, STRING, {"data": noise}, compression="png", fragment_size=300)
    png = strict_json("".join(part["data"] for part in client.fragments()))
    assert strict_json(png_text(png["data"]))["msg"] == {"data": noise}


# --- cbor ---


@case("cbor", CBOR)
def test_cbor_of_samples(client: Client, hand: Hand, topic: str) -> None:
    """With compression cbor a sample is a binary message, and decoded the same object."""
    subscribed(client, hand, topic, STRING, {"data": LONG}, compression="cbor")
    data = client.receive_raw()
    assert isinstance(data, bytes)
    assert cbor2.loads(data) == {"op": "publish", "topic": topic, "msg": {"data": LONG}}


@case("cbor", CBOR + "; RFC 8746, 2.1")
def test_cbor_typed_arrays(client: Client, hand: Hand) -> None:
    """Arrays of numbers are typed arrays, little endian, each with the tag of its type."""
    arrays = {"UInt16": (69, 2), "UInt32": (70, 4), "UInt64": (71, 8), "Int8": (72, 1), "Int16": (77, 2)}
    arrays |= {"Int32": (78, 4), "Int64": (79, 8), "Float32": (85, 4), "Float64": (86, 8)}
    for name, (tag, size) in arrays.items():
        topic = f"/conformance/cbor_{name.lower()}_{time.monotonic_ns()}"
        values = [1.0, 2.0] if name.startswith("Float") else [1, 2]
        subscribed(
            client, hand, topic, f"std_msgs/msg/{name}MultiArray", {"data": values}, compression="cbor"
        )
        data = client.until("publish", topic=topic)["msg"]["data"]
        assert isinstance(data, cbor2.CBORTag), name
        assert (data.tag, len(data.value)) == (tag, 2 * size), name
        if not name.startswith("Float"):
            assert data.value[0] == 1, f"{name} is not little endian"


@case("cbor", "SPEC 1.6; RFC 8746, 2.1", suite="uint8[] is a byte string without tag (cbor_conversion.py)")
def test_cbor_bytes(client: Client, hand: Hand, topic: str) -> None:
    """uint8[] is a typed array too, tag 64, and not base64."""
    message = {"width": 4, "data": [0, 1, 254, 255]}
    subscribed(client, hand, topic, "sensor_msgs/msg/Image", message, compression="cbor")
    data = client.until("publish")["msg"]["data"]
    assert isinstance(data, cbor2.CBORTag)
    assert (data.tag, data.value) == (64, bytes([0, 1, 254, 255]))


@case("cbor", "SPEC 1.6; RFC 8949, 3.3")
def test_cbor_not_finite(client: Client, hand: Hand, topic: str) -> None:
    """NaN and infinity stay what they are."""
    message = {"x": float("nan"), "y": float("inf"), "z": float("-inf")}
    subscribed(client, hand, topic, "geometry_msgs/msg/Vector3", message, compression="cbor")
    vector = client.until("publish")["msg"]
    assert math.isnan(vector["x"])
    assert (vector["y"], vector["z"]) == (math.inf, -math.inf)


@case("cbor", CBOR)
def test_cbor_shapes(client: Client, hand: Hand, topic: str) -> None:
    """Text, lists of text and nested messages are as in JSON."""
    message = {"header": {"frame_id": "arm"}, "name": ["a", "b"]}
    subscribed(client, hand, topic, "sensor_msgs/msg/JointState", message, compression="cbor")
    heard = client.until("publish")["msg"]
    assert heard["header"]["frame_id"] == "arm"
    assert heard["header"]["stamp"] == {"sec": 0, "nanosec": 0}
    assert heard["name"] == ["a", "b"]


@case("cbor", "SPEC 1.6, compression of call_service", suite=NO_COMPRESSION_OF_CALLS)
def test_cbor_of_answers(client: Client) -> None:
    """With compression cbor the service_response is a binary message."""
    call = {"service": "/conformance/invert", "args": {"data": False}}
    client.send("call_service", id="binary", compression="cbor", **call)
    data = client.receive_raw()
    assert isinstance(data, bytes)
    answer = cbor2.loads(data)
    assert (answer["op"], answer["id"], answer["result"]) == ("service_response", "binary", True)
    assert answer["values"] == {"success": True, "message": "inverted"}


@case("cbor", "SPEC 1.6, binary messages come whole")
def test_cbor_whole(client: Client, hand: Hand, topic: str) -> None:
    """Binary messages come whole, whatever fragment_size says."""
    fields = {"compression": "cbor", "fragment_size": 64}
    subscribed(client, hand, topic, STRING, {"data": "x" * 1000}, **fields)
    assert client.until("publish")["msg"] == {"data": "x" * 1000}


@case("cbor", "SPEC 1.2 subscribe, the latest compression")
def test_cbor_latest(client: Client, hand: Hand, topic: str) -> None:
    """Of several subscriptions of one client the latest compression counts."""
    client.send("subscribe", topic=topic, type=STRING, id="plain")
    subscribed(client, hand, topic, STRING, {"data": "x"}, id="binary", compression="cbor")
    assert isinstance(client.receive_raw(), bytes)


# --- cbor-raw ---


@case("cbor-raw", RAW)
def test_raw_of_samples(client: Client, hand: Hand, topic: str) -> None:
    """With compression cbor-raw msg is when it came and the bytes as ROS serialised them, with their header."""
    before = int(time.time()) - 86_400
    subscribed(client, hand, topic, "std_msgs/msg/UInt32", {"data": 0x01020304}, compression="cbor-raw")
    data = client.receive_raw()
    assert isinstance(data, bytes)
    sample = cbor2.loads(data)
    assert (sample["op"], sample["topic"]) == ("publish", topic)
    assert set(sample["msg"]) == {"secs", "nsecs", "bytes"}
    assert sample["msg"]["bytes"] == bytes.fromhex("0001000004030201")
    assert sample["msg"]["secs"] > before
    assert 0 <= sample["msg"]["nsecs"] < 10**9


@case("cbor-raw", "SPEC 1.6, for answers it counts as cbor", suite=NO_COMPRESSION_OF_CALLS)
def test_raw_of_answers(client: Client) -> None:
    """For a service cbor-raw counts as cbor."""
    call = {"service": "/conformance/invert", "args": {"data": False}}
    client.send("call_service", id="raw", compression="cbor-raw", **call)
    data = client.receive_raw()
    assert isinstance(data, bytes)
    assert cbor2.loads(data)["values"] == {"success": True, "message": "inverted"}


@case("cbor-raw", "rosbridge v2, 3.3.4 Subscribe, compression", suite=RAW_FOR_ALL)
def test_every_client_its_own_form(server: Server, hand: Hand, topic: str) -> None:
    """Five clients on one topic each get it in their requested format."""
    forms = (
        {},
        {"compression": "png"},
        {"compression": "cbor"},
        {"compression": "cbor-raw"},
        {"fragment_size": 100},
    )
    clients = [server.connect() for _ in forms]
    try:
        hand.topic(topic, STRING)
        for each, form in zip(clients, forms, strict=True):
            each.send("subscribe", topic=topic, type=STRING, **form)
            each.lives()
        hand.publish(topic, {"data": LONG})
        plain, png, cbor, raw, parts = clients
        whole = {"op": "publish", "topic": topic, "msg": {"data": LONG}}
        assert plain.until("publish") == whole
        assert strict_json(png_text(png.until("png")["data"])) == whole
        assert cbor.until("publish") == whole
        assert LONG.encode() in raw.until("publish")["msg"]["bytes"]
        assert strict_json("".join(part["data"] for part in parts.fragments())) == whole
    finally:
        for each in clients:
            each.close()


@case("png", "RFC 2083, 3; RFC 4648, 4")
def test_png_reader() -> None:
    """The suite's own PNG reader reads the output of a plain writer."""
    text = b'{"op": "publish"}\n'
    rows = b"".join(b"\0" + text[at : at + 9] for at in range(0, 18, 9))

    def chunk(kind: bytes, body: bytes) -> bytes:
        return len(body).to_bytes(4, "big") + kind + body + zlib.crc32(kind + body).to_bytes(4, "big")

    head = (3).to_bytes(4, "big") + (2).to_bytes(4, "big") + bytes([8, 2, 0, 0, 0])
    png = (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", head)
        + chunk(b"IDAT", zlib.compress(rows))
        + chunk(b"IEND", b"")
    )
    assert png_text(base64.b64encode(png).decode()) == '{"op": "publish"}'
