"""Samples from the robot's graph to clients: subscribe, unsubscribe."""

from __future__ import annotations

import base64
import json

from conformance_suite import NO_STATUS, Hand, Server, case, fresh_name
from rosbridge_client import ABSENCE, Client

STRING = "std_msgs/msg/String"
INT = "std_msgs/msg/Int64"
COUNTER = "/conformance/counter"
THROTTLE_DROPS = "what comes within the throttle is dropped, the last too (subscription_modifiers.py)"
FIRST_TWICE = (
    "after a client's second subscription the next sample comes twice (subscribers.py, _new_sub_callback)"
)
SUBSCRIBE = "rosbridge v2, 3.3.4 Subscribe"
UNSUBSCRIBE = "rosbridge v2, 3.3.5 Unsubscribe"
ENCODING = "rosbridge v2, 4.6 Data Type Encoding"


def seen(client: Client, hand: Hand, topic: str, type_name: str, message: object) -> dict:
    """What a subscriber gets of a message that the robot publishes."""
    hand.topic(topic, type_name)
    client.send("subscribe", topic=topic, type=type_name)
    hand.publish(topic, message)
    return client.until("publish", topic=topic)["msg"]


# --- subscribe ---


@case("subscribe", SUBSCRIBE)
def test_subscribe(client: Client) -> None:
    """A sample comes as op, topic and msg, and nothing else."""
    client.send("subscribe", topic=COUNTER, type=INT, id="mine")
    sample = client.until("publish")
    assert set(sample) == {"op", "topic", "msg"}
    assert sample["topic"] == COUNTER
    assert set(sample["msg"]) == {"data"}


@case("subscribe", SUBSCRIBE)
def test_subscribe_without_type(client: Client) -> None:
    """The type of a topic that exists need not be given."""
    client.send("subscribe", topic=COUNTER)
    assert isinstance(client.until("publish", topic=COUNTER)["msg"]["data"], int)


@case("subscribe", "SPEC 1.2, names and types")
def test_subscribe_old_names(client: Client) -> None:
    """Samples carry the topic as the client wrote it, here without leading slash, its type written pkg/Name."""
    client.send("subscribe", topic=COUNTER.lstrip("/"), type="std_msgs/Int64")
    assert client.until("publish")["topic"] == COUNTER.lstrip("/")


@case("subscribe", SUBSCRIBE)
def test_subscribe_in_order(client: Client, hand: Hand, topic: str) -> None:
    """Samples come in order, each once."""
    hand.topic(topic, INT)
    client.send("subscribe", topic=topic, type=INT, queue_length=20)
    hand.publish(topic, *({"data": number} for number in range(10)))
    assert [client.until("publish")["msg"]["data"] for _ in range(10)] == list(range(10))
    client.none("publish")


@case("subscribe", "SPEC 1.2 subscribe, pending")
def test_subscribe_pending(client: Client, hand: Hand, topic: str) -> None:
    """A topic that does not exist yet can be subscribed with its type; samples come when it appears."""
    client.send("subscribe", topic=topic, type=STRING)
    client.lives()
    hand.topic(topic, STRING)
    hand.publish(topic, {"data": "here I am"})
    assert client.until("publish", topic=topic)["msg"] == {"data": "here I am"}


@case("subscribe", SUBSCRIBE, suite=NO_STATUS)
def test_subscribe_nothing_known(reported: Client, topic: str) -> None:
    """Subscribing to what does not exist without a type is an error in words."""
    reported.send("subscribe", topic=topic)
    assert reported.until("status", level="error")["msg"]


@case("subscribe", SUBSCRIBE, suite=NO_STATUS)
def test_subscribe_type_mismatch(reported: Client) -> None:
    """Subscribing with another type than the topic has is an error in words."""
    reported.send("subscribe", topic=COUNTER, type=STRING)
    assert reported.until("status", level="error")["msg"]


@case("subscribe", SUBSCRIBE)
def test_subscribe_type_mismatch_lives(client: Client) -> None:
    """Subscribing with another type than the topic has gives no samples, and has no other effect."""
    client.send("subscribe", topic=COUNTER, type=STRING)
    client.none("publish", topic=COUNTER)
    client.lives()


@case("subscribe", "SPEC 1.2 subscribe, under both names")
def test_subscribe_both_names(client: Client, hand: Hand, topic: str) -> None:
    """Subscribed with and without leading slash, each sample comes under both names."""
    hand.topic(topic, STRING)
    for name in (topic, topic.lstrip("/")):
        client.send("subscribe", topic=name, type=STRING)
    client.lives()
    hand.publish(topic, {"data": "twice"})
    for name in (topic, topic.lstrip("/")):
        assert client.until("publish", topic=name)["msg"] == {"data": "twice"}
    client.none("publish")


@case("subscribe", "SPEC 1.2 subscribe, with another type", suite=NO_STATUS)
def test_subscribe_pending_other_type(reported: Client, hand: Hand, topic: str) -> None:
    """A subscriber whose topic appears with another type gets an error and no samples."""
    reported.send("subscribe", topic=topic, type="std_msgs/msg/Int32")
    reported.lives()
    hand.topic(topic, STRING)
    assert reported.until("status", level="error")["msg"]
    reported.none("publish")


@case("subscribe", SUBSCRIBE)
def test_subscribe_comes_back(client: Client, hand: Hand, topic: str) -> None:
    """A topic that ends and appears again continues."""
    assert seen(client, hand, topic, STRING, {"data": "before"}) == {"data": "before"}
    hand.vanish(topic)
    hand.topic(topic, STRING)
    hand.publish(topic, {"data": "after"})
    assert client.until("publish", topic=topic)["msg"] == {"data": "after"}


@case("subscribe", SUBSCRIBE + ", throttle_rate")
def test_subscribe_throttle(client: Client) -> None:
    """With throttle_rate, samples of a fast topic come no closer than that on average."""
    client.send("subscribe", topic=COUNTER, type=INT, throttle_rate=300)
    stamps = [client.until("publish")["msg"]["data"] for _ in range(5)]
    assert (stamps[-1] - stamps[0]) / 4 > 250


@case("subscribe", "SPEC 1.2 subscribe, the newest waits", suite=THROTTLE_DROPS)
def test_subscribe_last_of_burst(client: Client, hand: Hand, topic: str) -> None:
    """With throttle_rate, the last of a burst is not lost but comes at its end."""
    hand.topic(topic, INT)
    client.send("subscribe", topic=topic, type=INT, throttle_rate=400)
    hand.publish(topic, *({"data": number} for number in range(10)))
    assert client.until("publish", msg={"data": 9})


@case("subscribe", "rosbridge v2, 3.3.4 Subscribe, queue_length")
def test_subscribe_queue(client: Client, hand: Hand, topic: str) -> None:
    """With throttle_rate and queue_length, samples within the throttle are queued and sent; the oldest are
    dropped.
    """
    hand.topic(topic, INT)
    client.send("subscribe", topic=topic, type=INT, throttle_rate=200, queue_length=5)
    client.lives()
    hand.publish(topic, *({"data": number} for number in range(10)))
    numbers = []
    while not numbers or numbers[-1] < 9:
        numbers.append(client.until("publish", topic=topic)["msg"]["data"])
    assert numbers == sorted(set(numbers))
    assert numbers[-5:] == [5, 6, 7, 8, 9]


@case("subscribe", SUBSCRIBE + ", several subscriptions", suite=FIRST_TWICE)
def test_subscribe_least_throttle(client: Client) -> None:
    """Of several subscriptions of one client the least throttle_rate counts, and samples come once."""
    client.send("subscribe", topic=COUNTER, type=INT, id="slow", throttle_rate=60_000)
    client.send("subscribe", topic=COUNTER, type=INT, id="fast", throttle_rate=0)
    stamps = [client.until("publish")["msg"]["data"] for _ in range(8)]
    assert len(set(stamps)) == len(stamps)


@case("subscribe", SUBSCRIBE + ", several subscriptions")
def test_subscribe_throttle_remains(client: Client) -> None:
    """When the subscription with the least throttle_rate ends, the other's counts again."""
    client.send("subscribe", topic=COUNTER, type=INT, id="slow", throttle_rate=60_000)
    client.send("subscribe", topic=COUNTER, type=INT, id="fast", throttle_rate=0)
    for _ in range(3):
        client.until("publish")
    client.send("unsubscribe", topic=COUNTER, id="fast")
    client.lives()
    client.all_within("publish", 0.05)
    client.none("publish")


@case("subscribe", "rosbridge v2, 4.3 Latching; SPEC 1.2 subscribe")
def test_subscribe_latched(server: Server) -> None:
    """Every subscriber of a latched topic gets its last sample, not only the first."""
    with server.connect() as first, server.connect() as second:
        for each in (first, second):
            each.send("subscribe", topic="/conformance/latched", type=STRING)
            assert each.until("publish")["msg"] == {"data": "still here"}


@case("subscribe", "SPEC 1.2 subscribe, qos")
def test_subscribe_transient_local(client: Client, hand: Hand, topic: str) -> None:
    """A subscription with durability transient_local gets what was published before it."""
    hand.topic(topic, STRING, "latched")
    hand.do("latch", topic, json.dumps({"data": "early"}))
    qos = {"durability": "transient_local", "reliability": "reliable", "depth": 1}
    client.send("subscribe", topic=topic, type=STRING, qos=qos)
    assert client.until("publish")["msg"] == {"data": "early"}


@case("subscribe", "SPEC 1.2 subscribe, qos")
def test_subscribe_best_effort_unasked(client: Client, hand: Hand, topic: str) -> None:
    """Without qos a subscription matches a publisher that is best_effort."""
    hand.topic(topic, STRING, "best_effort")
    client.send("subscribe", topic=topic, type=STRING)
    hand.publish(topic, {"data": "maybe"})
    assert client.until("publish")["msg"] == {"data": "maybe"}


@case("subscribe", "SPEC 1.2 subscribe, qos")
def test_subscribe_best_effort(client: Client, hand: Hand, topic: str) -> None:
    """A subscription that asks for best_effort matches a reliable publisher."""
    hand.topic(topic, STRING, "reliable")
    client.send("subscribe", topic=topic, type=STRING, qos={"reliability": "best_effort"})
    hand.publish(topic, {"data": "surely"})
    assert client.until("publish")["msg"] == {"data": "surely"}


@case("subscribe", "SPEC 1.2 subscribe, qos", suite=NO_STATUS)
def test_subscribe_bad_qos(reported: Client, topic: str) -> None:
    """A qos with a value that doesn't exist is an error in words."""
    reported.send("subscribe", topic=topic, type=STRING, qos={"durability": "eternal"})
    assert reported.until("status", level="error")["msg"]


@case("subscribe", "RFC 8259, 6 Numbers; SPEC 4")
def test_subscribe_not_finite(client: Client, hand: Hand, topic: str) -> None:
    """NaN and infinity come as null."""
    hand.topic(topic, "std_msgs/msg/Float64MultiArray")
    client.send("subscribe", topic=topic, type="std_msgs/msg/Float64MultiArray")
    hand.publish(topic, {"data": [1.5, float("nan"), float("inf"), float("-inf")]})
    assert client.until("publish")["msg"]["data"] == [1.5, None, None, None]


@case("subscribe", "RFC 8259, 6 Numbers; SPEC 4")
def test_subscribe_not_finite_single(client: Client, hand: Hand, topic: str) -> None:
    """NaN in a single field comes as null."""
    assert seen(client, hand, topic, "geometry_msgs/msg/Vector3", {"y": float("nan")}) == {
        "x": 0,
        "y": None,
        "z": 0,
    }


@case("subscribe", ENCODING)
def test_subscribe_bytes(client: Client, hand: Hand, topic: str) -> None:
    """uint8[] comes as a base64 string."""
    message = {"height": 2, "width": 2, "step": 2, "encoding": "mono8", "data": [0, 1, 254, 255]}
    data = seen(client, hand, topic, "sensor_msgs/msg/Image", message)["data"]
    assert base64.b64decode(data, validate=True) == bytes([0, 1, 254, 255])


@case("subscribe", ENCODING)
def test_subscribe_no_bytes(client: Client, hand: Hand, topic: str) -> None:
    """An empty uint8[] comes as an empty string."""
    assert seen(client, hand, topic, "sensor_msgs/msg/Image", {"height": 1})["data"] == ""


@case("subscribe", "SPEC 4 ROS messages as JSON")
def test_subscribe_shapes(client: Client, hand: Hand, topic: str) -> None:
    """Headers, nested messages, lists of text and of numbers keep their shape."""
    message = {"header": {"frame_id": "arm"}, "name": ["a", "b"], "position": [1.0, -0.5]}
    heard = seen(client, hand, topic, "sensor_msgs/msg/JointState", message)
    assert heard["header"] == {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": "arm"}
    assert (heard["name"], heard["position"], heard["velocity"]) == (["a", "b"], [1, -0.5], [])


@case("subscribe", "SPEC 4 ROS messages as JSON")
def test_subscribe_64_bits(client: Client, hand: Hand, topic: str) -> None:
    """Integers of 64 bits come exactly."""
    assert seen(client, hand, topic, INT, {"data": 2**63 - 1}) == {"data": 2**63 - 1}


@case("subscribe", "SPEC 4 ROS messages as JSON")
def test_subscribe_small_types(client: Client, hand: Hand) -> None:
    """bool comes as true and false, text of any script as it is."""
    assert seen(client, hand, fresh_name(), "std_msgs/msg/Bool", {"data": True}) == {"data": True}
    text = 'Grüße, 机器人, 🤖, "quotes", \\'
    assert seen(client, hand, fresh_name(), STRING, {"data": text}) == {"data": text}


@case("subscribe", "SPEC 1.2 subscribe")
def test_subscribe_three_clients(server: Server, hand: Hand, topic: str) -> None:
    """Three clients on one topic each get every sample, and a robot of ours has one subscription for them."""
    with server.connect() as one, server.connect() as two, server.connect() as three:
        hand.topic(topic, INT)
        for each in (one, two, three):
            each.send("subscribe", topic=topic, type=INT)
            each.lives()
        hand.publish(topic, {"data": 1}, {"data": 2})
        for each in (one, two, three):
            assert [each.until("publish")["msg"]["data"] for _ in range(2)] == [1, 2]


@case("subscribe", "SPEC 1.2 subscribe, compression", suite=NO_STATUS)
def test_subscribe_unknown_compression(reported: Client) -> None:
    """An unknown compression is an error and counts as none."""
    reported.send("subscribe", topic=COUNTER, type=INT, compression="zip")
    assert reported.until("status", level="error")["msg"]
    assert isinstance(reported.until("publish")["msg"]["data"], int)


@case("subscribe", "SPEC 1.2, /relay/status")
def test_subscribe_relay_status(client: Client) -> None:
    """The relay's own topic /relay/status can be subscribed like any other."""
    client.send("subscribe", topic="/relay/status")
    assert client.until("publish", topic="/relay/status")["msg"]["clients"]


# --- unsubscribe ---


def subscribe_twice(client: Client) -> None:
    """Two subscriptions to the counter, with the ids ``one`` and ``two``."""
    for name in ("one", "two"):
        client.send("subscribe", topic=COUNTER, type=INT, id=name)
    client.until("publish")


@case("unsubscribe", UNSUBSCRIBE)
def test_unsubscribe_by_id(client: Client) -> None:
    """With an id only that subscription ends."""
    subscribe_twice(client)
    client.send("unsubscribe", topic=COUNTER, id="one")
    client.lives()
    client.all_within("publish", 0.05)
    client.until("publish")


@case("unsubscribe", UNSUBSCRIBE)
def test_unsubscribe_last_id(client: Client) -> None:
    """With the last id samples end."""
    subscribe_twice(client)
    for name in ("one", "two"):
        client.send("unsubscribe", topic=COUNTER, id=name)
    client.lives()
    client.all_within("publish", 0.05)
    client.none("publish")


@case("unsubscribe", UNSUBSCRIBE)
def test_unsubscribe_all(client: Client) -> None:
    """Without an id all of the client's subscriptions to the topic end."""
    subscribe_twice(client)
    client.send("unsubscribe", topic=COUNTER)
    client.lives()
    client.all_within("publish", 0.05)
    client.none("publish")


@case("unsubscribe", UNSUBSCRIBE)
def test_unsubscribe_other_client(server: Server, client: Client) -> None:
    """Another client's subscription to the same topic goes on."""
    with server.connect() as other:
        for each in (client, other):
            each.send("subscribe", topic=COUNTER, type=INT)
            each.until("publish")
        other.send("unsubscribe", topic=COUNTER)
        other.lives()
        client.all_within("publish", 0.05)
        client.until("publish")


@case("unsubscribe", "SPEC 1.2 unsubscribe")
def test_unsubscribe_frees_the_robot(client: Client, hand: Hand, topic: str) -> None:
    """After the last client's end the robot has no subscription any more."""
    seen(client, hand, topic, STRING, {"data": "x"})
    client.send("unsubscribe", topic=topic)
    assert hand.do("subscribers", topic, "0") == ["0"]


@case("unsubscribe", "SPEC 1.2 unsubscribe")
def test_unsubscribe_by_leaving(server: Server, hand: Hand, topic: str) -> None:
    """A client that leaves ends its subscriptions."""
    with server.connect() as leaving:
        seen(leaving, hand, topic, STRING, {"data": "x"})
    assert hand.do("subscribers", topic, "0") == ["0"]


@case("unsubscribe", UNSUBSCRIBE)
def test_unsubscribe_unknown(client: Client, topic: str) -> None:
    """Ending what was never subscribed has no effect."""
    client.send("unsubscribe", topic=topic)
    client.send("unsubscribe", topic=topic, id="never")
    client.lives()


@case("unsubscribe", UNSUBSCRIBE)
def test_unsubscribe_and_again(client: Client, hand: Hand, topic: str) -> None:
    """A topic can be subscribed again after unsubscribe."""
    assert seen(client, hand, topic, STRING, {"data": "one"})
    client.send("unsubscribe", topic=topic)
    client.lives()
    client.send("subscribe", topic=topic, type=STRING)
    client.lives()
    hand.do("subscribers", topic, "1")
    client.none("publish", ABSENCE / 3)
    hand.publish(topic, {"data": "two"})
    assert client.until("publish")["msg"] == {"data": "two"}
