"""Clients' messages to the robot's graph: advertise, unadvertise, publish."""

from __future__ import annotations

import base64
import json
import math
import time

from conformance_suite import NO_STATUS, Hand, Server, case
from rosbridge_client import ABSENCE, Client

STRING = "std_msgs/msg/String"
LATE = "its publishers stay for 10 s after the last unadvertise (rosbridge_server, unregister_timeout)"
NO_HEADER = "only a header that is there gets the time (message_conversion.py, _to_object_inst)"
ONE_PUBLISHER = "it has one publisher for all clients of a topic (publishers.py)"
ADVERTISE = "rosbridge v2, 3.3.1 Advertise"
UNADVERTISE = "rosbridge v2, 3.3.2 Unadvertise"
PUBLISH = "rosbridge v2, 3.3.3 Publish"


def graph_knows(client: Client, topic: str, type_name: str) -> None:
    """Waits until the server has seen a topic of the graph."""
    until = time.monotonic() + client.patience
    while client.values("/rosapi/topic_type", {"topic": topic})["type"] != type_name:
        assert time.monotonic() < until, f"the server does not see {topic}"
        time.sleep(0.05)


def ready(client: Client, hand: Hand, topic: str, type_name: str, **fields: object) -> None:
    """The robot subscribes to a topic, which the server knows, and the client has advertised it.

    A server that does not know the subscriber yet loses the first messages.
    """
    hand.listen(topic, type_name)
    graph_knows(client, topic, type_name)
    client.send("advertise", topic=topic, type=type_name, **fields)
    hand.publishers(topic, 1)


def published(client: Client, hand: Hand, topic: str, type_name: str, message: object) -> dict:
    """The message that the robot receives; published repeatedly until both sides have discovered each other."""
    ready(client, hand, topic, type_name)
    until = time.monotonic() + client.patience
    while True:
        client.send("publish", topic=topic, msg=message)
        heard = hand.do("heard", topic, "1", "0.5")
        if heard:
            return json.loads(heard[0])
        assert time.monotonic() < until, f"the robot heard nothing on {topic}"


def refused(reported: Client, hand: Hand, topic: str, type_name: str, message: object) -> str:
    """The error of a refused message, after a check that the robot received nothing of it."""
    ready(reported, hand, topic, type_name)
    reported.send("publish", topic=topic, msg=message, id="bad")
    words = reported.until("status", level="error")["msg"]
    assert hand.do("heard", topic, "1", str(ABSENCE)) == []
    return words


# --- advertise ---


@case("advertise", ADVERTISE)
def test_advertise(client: Client, hand: Hand, topic: str) -> None:
    """An advertised topic is in the robot's graph with its type, before anything is published."""
    client.send("advertise", topic=topic, type=STRING)
    assert hand.publishers(topic, 1)[0]["type"] == STRING


@case("advertise", ADVERTISE)
def test_advertise_publish(client: Client, hand: Hand, topic: str) -> None:
    """What is published on an advertised topic reaches the graph."""
    assert published(client, hand, topic, STRING, {"data": "hello"}) == {"data": "hello"}


@case("advertise", ADVERTISE)
def test_advertise_old_names(client: Client, hand: Hand, topic: str) -> None:
    """A topic without leading slash and a type written pkg/Name are accepted."""
    client.send("advertise", topic=topic.lstrip("/"), type="std_msgs/String")
    assert hand.publishers(topic, 1)[0]["type"] == STRING


@case("advertise", ADVERTISE, suite=NO_STATUS)
def test_advertise_type_conflict(reported: Client, hand: Hand, topic: str) -> None:
    """Advertising a topic with another type than it has is an error in words."""
    hand.topic(topic, STRING)
    graph_knows(reported, topic, STRING)
    reported.send("advertise", topic=topic, type="std_msgs/msg/Int32", id="conflict")
    assert reported.until("status", level="error")["msg"]


@case("advertise", ADVERTISE)
def test_advertise_type_conflict_makes_no_publisher(client: Client, hand: Hand, topic: str) -> None:
    """Advertising with another type makes no publisher, and the connection lives."""
    hand.topic(topic, STRING)
    graph_knows(client, topic, STRING)
    client.send("advertise", topic=topic, type="std_msgs/msg/Int32")
    client.lives()
    assert [each["type"] for each in hand.publishers(topic, 1)] == [STRING]


@case("advertise", ADVERTISE, suite=NO_STATUS)
def test_advertise_unknown_type(reported: Client, topic: str) -> None:
    """Advertising a type that does not exist is an error in words."""
    reported.send("advertise", topic=topic, type="std_msgs/msg/NoSuchThing")
    assert reported.until("status", level="error")["msg"]


@case("advertise", ADVERTISE)
def test_advertise_nonsense_lives(client: Client, topic: str) -> None:
    """Advertising with invalid types has no other effect."""
    for type_name in ("std_msgs/msg/NoSuchThing", "no_such_package/msg/Thing", "", "String", "a/b/c/d"):
        client.send("advertise", topic=topic, type=type_name)
    client.lives()


@case("advertise", "rosbridge v2, 4.3 Latching; SPEC 1.2 advertise")
def test_advertise_latch(client: Client, hand: Hand, topic: str) -> None:
    """With latch, a late subscriber gets the last message."""
    client.send("advertise", topic=topic, type=STRING, latch=True)
    assert hand.publishers(topic, 1)[0]["durability"] == "transient_local"
    for text in ("first", "last"):
        client.send("publish", topic=topic, msg={"data": text}, latch=True)
    client.lives()
    hand.listen(topic, STRING, "latched")
    assert hand.heard(topic, 1)[-1] == {"data": "last"}


@case("advertise", "SPEC 1.2 advertise, qos")
def test_advertise_transient_local(client: Client, hand: Hand, topic: str) -> None:
    """The qos asked for is the qos of the publisher: transient_local."""
    qos = {"durability": "transient_local", "depth": 1, "reliability": "reliable"}
    client.send("advertise", topic=topic, type=STRING, qos=qos)
    assert hand.publishers(topic, 1)[0]["durability"] == "transient_local"


@case("advertise", "SPEC 1.2 advertise, qos")
def test_advertise_best_effort(client: Client, hand: Hand, topic: str) -> None:
    """The qos asked for is the qos of the publisher: best_effort."""
    client.send("advertise", topic=topic, type=STRING, qos={"reliability": "best_effort"})
    assert hand.publishers(topic, 1)[0]["reliability"] == "best_effort"


@case("advertise", "SPEC 1.2 advertise, qos")
def test_advertise_times(client: Client, hand: Hand, topic: str) -> None:
    """The qos asked for is the qos of the publisher: deadline and lifespan, in seconds."""
    client.send("advertise", topic=topic, type=STRING, qos={"deadline": 1.5, "lifespan": 2})
    found = hand.publishers(topic, 1)[0]
    assert (found["deadline"], found["lifespan"]) == (1.5, 2)


@case("advertise", "SPEC 1.2 advertise, qos", suite=NO_STATUS)
def test_advertise_bad_qos(reported: Client, topic: str) -> None:
    """A qos with a value that doesn't exist is an error in words."""
    reported.send("advertise", topic=topic, type=STRING, qos={"reliability": "sometimes"})
    assert reported.until("status", level="error")["msg"]


@case("advertise", "SPEC 1.2 advertise, queue_size")
def test_advertise_queue_size(client: Client, hand: Hand, topic: str) -> None:
    """Fifty messages in one go on a topic with queue_size 100 all arrive, in order."""
    ready(client, hand, topic, "std_msgs/msg/Int32", queue_size=100)
    for number in range(50):
        client.send("publish", topic=topic, msg={"data": number})
    assert [each["data"] for each in hand.heard(topic, 50)] == list(range(50))


@case("advertise", "SPEC 1.2 advertise, queue_size")
def test_advertise_queue_size_negative(client: Client, hand: Hand, topic: str) -> None:
    """A queue_size below one counts as left out: what is published arrives."""
    ready(client, hand, topic, STRING, queue_size=-5)
    client.send("publish", topic=topic, msg={"data": "here"})
    assert hand.heard(topic, 1) == [{"data": "here"}]


@case("advertise", "SPEC 1.2-6, a client that latches has its own publisher", suite=ONE_PUBLISHER)
def test_advertise_other_latch(client: Client, server: Server, hand: Hand, topic: str) -> None:
    """A client that latches keeps its last message for late subscribers, beside one that does not."""
    with server.connect() as first:
        ready(first, hand, topic, STRING)
        client.send("advertise", topic=topic, type=STRING, latch=True)
        found = {each["durability"] for each in hand.publishers(topic, 2)}
        assert found == {"volatile", "transient_local"}


@case("advertise", "SPEC 1.2 advertise, told once with its id", suite=NO_STATUS)
def test_advertise_failure_names_the_id(reported: Client, topic: str) -> None:
    """A type that is not available is an error with the id of its advertise."""
    reported.send("advertise", topic=topic, type="no_such_package/msg/Thing", id="which")
    assert reported.until("status", level="error", id="which")["msg"]


# --- unadvertise ---


@case("unadvertise", UNADVERTISE)
def test_unadvertise_one_of_two(client: Client, hand: Hand, topic: str) -> None:
    """Advertisements are counted by id: while one is left the publisher stays."""
    ready(client, hand, topic, STRING, id="one")
    client.send("advertise", topic=topic, type=STRING, id="two")
    client.send("unadvertise", topic=topic, id="one")
    client.send("publish", topic=topic, msg={"data": "still here"})
    assert hand.heard(topic, 1) == [{"data": "still here"}]


@case("unadvertise", UNADVERTISE, suite=LATE)
def test_unadvertise_last(client: Client, hand: Hand, topic: str) -> None:
    """The publisher goes with the last advertisement."""
    ready(client, hand, topic, STRING, id="one")
    client.send("advertise", topic=topic, type=STRING, id="two")
    client.send("unadvertise", topic=topic, id="one")
    client.send("unadvertise", topic=topic, id="two")
    hand.publishers(topic, 0)


@case("unadvertise", UNADVERTISE, suite=LATE)
def test_unadvertise_all(client: Client, hand: Hand, topic: str) -> None:
    """Without an id all of the client's advertisements of the topic go."""
    ready(client, hand, topic, STRING, id="one")
    client.send("advertise", topic=topic, type=STRING, id="two")
    client.send("unadvertise", topic=topic)
    hand.publishers(topic, 0)


@case("unadvertise", UNADVERTISE)
def test_unadvertise_other_client(client: Client, server: Server, hand: Hand, topic: str) -> None:
    """While another client advertises the topic the publisher stays."""
    ready(client, hand, topic, STRING)
    with server.connect() as other:
        other.send("advertise", topic=topic, type=STRING)
        other.lives()
        client.send("unadvertise", topic=topic)
        client.lives()
        other.send("publish", topic=topic, msg={"data": "from the other"})
        assert hand.heard(topic, 1) == [{"data": "from the other"}]


@case("unadvertise", UNADVERTISE, suite=LATE)
def test_unadvertise_by_leaving(server: Server, hand: Hand, topic: str) -> None:
    """A client that leaves ends its publishers."""
    with server.connect() as leaving:
        ready(leaving, hand, topic, STRING)
    hand.publishers(topic, 0)


@case("unadvertise", UNADVERTISE)
def test_unadvertise_unknown(client: Client, topic: str) -> None:
    """Unadvertising what was never advertised has no other effect."""
    client.send("unadvertise", topic=topic)
    client.send("unadvertise", topic=topic, id="never")
    client.lives()


@case("unadvertise", UNADVERTISE, suite=NO_STATUS)
def test_unadvertise_unknown_is_warned_of(reported: Client, topic: str) -> None:
    """Unadvertising what was never advertised is a warning in words."""
    reported.send("set_level", level="warning")
    reported.send("unadvertise", topic=topic, id="never")
    assert reported.until("status", level="warning", id="never")["msg"]


# --- publish ---


@case("publish", PUBLISH)
def test_publish_infers(client: Client, hand: Hand, topic: str) -> None:
    """Publishing without advertise takes the type from the graph."""
    hand.listen(topic, STRING)
    graph_knows(client, topic, STRING)
    # rosbridge does not guarantee that the first one arrives: the publisher has to be discovered.
    until = time.monotonic() + client.patience
    while not hand.do("heard", topic, "1", "0.1"):
        assert time.monotonic() < until, "nothing arrived"
        client.send("publish", topic=topic, msg={"data": "unannounced"})
    assert hand.heard(topic, 1)[0] == {"data": "unannounced"}


@case("publish", PUBLISH, suite=NO_STATUS)
def test_publish_unknown_topic(reported: Client, topic: str) -> None:
    """Publishing on an unknown topic is an error in words."""
    reported.send("publish", topic=topic, msg={"data": "where to?"})
    assert reported.until("status", level="error")["msg"]


@case("publish", "SPEC 1.2 publish, type")
def test_publish_with_type(client: Client, hand: Hand, topic: str) -> None:
    """Publishing without advertise takes the type from the message's own type field."""
    client.send("publish", topic=topic, type=STRING, msg={"data": "typed"})
    assert hand.publishers(topic, 1)[0]["type"] == STRING


@case("publish", "SPEC 1.2 publish, latch and qos without advertise")
def test_publish_latch_without_advertise(client: Client, hand: Hand, topic: str) -> None:
    """A first message with latch makes a latching publisher: a late subscriber gets it."""
    client.send("publish", topic=topic, type=STRING, msg={"data": "kept"}, latch=True)
    assert hand.publishers(topic, 1)[0]["durability"] == "transient_local"
    client.lives()
    hand.listen(topic, STRING, "latched")
    assert hand.heard(topic, 1)[-1] == {"data": "kept"}


@case("publish", PUBLISH)
def test_publish_defaults(client: Client, hand: Hand, topic: str) -> None:
    """Missing fields take their defaults."""
    heard = published(client, hand, topic, "geometry_msgs/msg/Pose", {"position": {"x": 1.5}})
    assert heard["position"] == {"x": 1.5, "y": 0.0, "z": 0.0}
    assert heard["orientation"]["w"] == 1.0


@case("publish", PUBLISH)
def test_publish_empty(client: Client, hand: Hand, topic: str) -> None:
    """A message without any field is all defaults."""
    assert published(client, hand, topic, STRING, {}) == {"data": ""}


@case("publish", PUBLISH, suite=NO_HEADER)
def test_publish_header_now(client: Client, hand: Hand, topic: str) -> None:
    """A header that is left out gets the present time."""
    message = {"vector": {"x": 1}}
    stamp = published(client, hand, topic, "geometry_msgs/msg/Vector3Stamped", message)["header"]["stamp"]
    assert stamp["sec"] > 1_600_000_000


@case("publish", PUBLISH)
def test_publish_stamp_now(client: Client, hand: Hand, topic: str) -> None:
    """A stamp that is left out gets the present time, and the frame_id stays."""
    message = {"header": {"frame_id": "map"}}
    header = published(client, hand, topic, "geometry_msgs/msg/Vector3Stamped", message)["header"]
    assert header["stamp"]["sec"] > 1_600_000_000
    assert header["frame_id"] == "map"


@case("publish", PUBLISH)
def test_publish_stamp_given(client: Client, hand: Hand, topic: str) -> None:
    """A given stamp is kept."""
    message = {"header": {"stamp": {"sec": 12, "nanosec": 34}}}
    header = published(client, hand, topic, "geometry_msgs/msg/Vector3Stamped", message)["header"]
    assert header["stamp"] == {"sec": 12, "nanosec": 34}


@case("publish", "SPEC 4, secs and nsecs")
def test_publish_stamp_ros1(client: Client, hand: Hand, topic: str) -> None:
    """secs and nsecs of older clients count as sec and nanosec."""
    message = {"header": {"stamp": {"secs": 12, "nsecs": 34}}}
    header = published(client, hand, topic, "geometry_msgs/msg/Vector3Stamped", message)["header"]
    assert header["stamp"] == {"sec": 12, "nanosec": 34}


@case("publish", "rosbridge v2, 4.6 Data Type Encoding")
def test_publish_base64(client: Client, hand: Hand, topic: str) -> None:
    """uint8[] may come as a base64 string."""
    data = base64.b64encode(bytes([0, 1, 254, 255])).decode()
    assert published(client, hand, topic, "std_msgs/msg/UInt8MultiArray", {"data": data})["data"] == [
        0,
        1,
        254,
        255,
    ]


@case("publish", "rosbridge v2, 4.6 Data Type Encoding")
def test_publish_list_of_bytes(client: Client, hand: Hand, topic: str) -> None:
    """uint8[] may come as a list of numbers."""
    heard = published(client, hand, topic, "std_msgs/msg/UInt8MultiArray", {"data": [0, 1, 254, 255]})
    assert heard["data"] == [0, 1, 254, 255]


@case("publish", "rosbridge v2, 4.6 Data Type Encoding")
def test_publish_image(client: Client, hand: Hand, topic: str) -> None:
    """A picture of 48 KB in base64 arrives byte by byte."""
    data = bytes(number % 251 for number in range(48_000))
    message = {
        "height": 120,
        "width": 400,
        "encoding": "mono8",
        "step": 400,
        "data": base64.b64encode(data).decode(),
    }
    assert bytes(published(client, hand, topic, "sensor_msgs/msg/Image", message)["data"]) == data


@case("publish", PUBLISH)
def test_publish_64_bits(client: Client, hand: Hand, topic: str) -> None:
    """Integers of 64 bits arrive exactly."""
    assert published(client, hand, topic, "std_msgs/msg/Int64", {"data": -(2**63)}) == {"data": -(2**63)}


@case("publish", PUBLISH)
def test_publish_int_for_float(client: Client, hand: Hand, topic: str) -> None:
    """An integer is accepted for a float, as JavaScript writes 1.0 as 1."""
    assert published(client, hand, topic, "std_msgs/msg/Float64", {"data": 3}) == {"data": 3.0}


@case("publish", "SPEC 4, null is NaN")
def test_publish_null(client: Client, hand: Hand, topic: str) -> None:
    """null for a float is NaN."""
    assert math.isnan(published(client, hand, topic, "std_msgs/msg/Float64", {"data": None})["data"])


@case("publish", "RFC 8259, 7 Strings")
def test_publish_unicode(client: Client, hand: Hand, topic: str) -> None:
    """Text of any script arrives as it is, escaped or not."""
    text = 'Grüße, 机器人, 🤖, "quotes", back\\slash, new\nline'
    ready(client, hand, topic, STRING)
    client.send_raw(json.dumps({"op": "publish", "topic": topic, "msg": {"data": text}}, ensure_ascii=False))
    client.send("publish", topic=topic, msg={"data": text})
    assert hand.heard(topic, 2) == [{"data": text}] * 2


@case("publish", PUBLISH)
def test_publish_nested(client: Client, hand: Hand, topic: str) -> None:
    """Lists of messages arrive."""
    layout = {"dim": [{"label": "rows", "size": 2, "stride": 2}, {"label": "columns", "size": 1}]}
    message = {"layout": layout, "data": [0.5, -2]}
    heard = published(client, hand, topic, "std_msgs/msg/Float64MultiArray", message)
    assert heard["data"] == [0.5, -2.0]
    assert [each["label"] for each in heard["layout"]["dim"]] == ["rows", "columns"]


@case("publish", PUBLISH, suite=NO_STATUS)
def test_publish_wrong_type(reported: Client, hand: Hand, topic: str) -> None:
    """A field of the wrong type is refused in words, and nothing is published."""
    assert "data" in refused(reported, hand, topic, "std_msgs/msg/Int32", {"data": "seven"})


@case("publish", PUBLISH, suite=NO_STATUS)
def test_publish_unknown_field(reported: Client, hand: Hand, topic: str) -> None:
    """A field the type does not have is refused in words, and nothing is published."""
    assert "colour" in refused(reported, hand, topic, STRING, {"data": "x", "colour": "red"})


@case("publish", "SPEC 4, numbers out of range", suite=NO_STATUS)
def test_publish_out_of_range(reported: Client, hand: Hand, topic: str) -> None:
    """A number out of the field's range is refused in words, and nothing is published."""
    assert "data" in refused(reported, hand, topic, "std_msgs/msg/UInt8", {"data": 256})


@case("publish", "SPEC 4, an error names the path", suite=NO_STATUS)
def test_publish_names_the_path(reported: Client, hand: Hand, topic: str) -> None:
    """The refusal of a wrong value names its path."""
    words = refused(reported, hand, topic, "geometry_msgs/msg/Pose", {"position": {"x": "left"}})
    assert "position.x" in words


@case("publish", PUBLISH)
def test_publish_wrong_then_right(client: Client, hand: Hand, topic: str) -> None:
    """Of wrong messages and a right one only the right one is published."""
    ready(client, hand, topic, "std_msgs/msg/Int32")
    for wrong in ("seven", 2**40, [1], {"a": 1}, "x"):
        client.send("publish", topic=topic, msg={"data": wrong})
    client.send("publish", topic=topic, msg=[1])
    client.send("publish", topic=topic, msg={"nodata": 1})
    client.send("publish", topic=topic, msg={"data": 7})
    assert hand.heard(topic, 1) == [{"data": 7}]


@case("publish", PUBLISH)
def test_publish_order(client: Client, hand: Hand) -> None:
    """Messages to the robot and back keep their order."""
    client.send("subscribe", topic="/conformance/echo/out", type=STRING)
    client.send("advertise", topic="/conformance/echo/in", type=STRING)
    until = time.monotonic() + client.patience
    while True:
        client.send("publish", topic="/conformance/echo/in", msg={"data": "ready?"})
        if client.all_within("publish", 0.2):
            break
        assert time.monotonic() < until, "no echo"
    client.send("publish", topic="/conformance/echo/in", msg={"data": "go"})
    for number in range(8):
        client.send("publish", topic="/conformance/echo/in", msg={"data": str(number)})
    client.until("publish", msg={"data": "go"})
    assert [client.until("publish")["msg"]["data"] for _ in range(8)] == [str(number) for number in range(8)]


@case("publish", "SPEC 2.5 Clocks and deadline")
def test_publish_motion(client: Client, hand: Hand, topic: str) -> None:
    """Commands to a motion topic, sent again and again, arrive."""
    # Not by the number of publishers: a robot may have its own one there, to stop it.
    hand.listen(topic, "geometry_msgs/msg/Twist")
    client.send("advertise", topic=topic, type="geometry_msgs/msg/Twist")
    until = time.monotonic() + client.patience
    moving = 0.0
    while moving != 0.25:
        assert time.monotonic() < until, "no command arrived"
        client.send("publish", topic=topic, msg={"linear": {"x": 0.25}})
        heard = hand.do("heard", topic, "1", "0.05")
        moving = max((json.loads(each)["linear"]["x"] for each in heard), default=0.0)
    client.send("publish", topic=topic, msg={})
