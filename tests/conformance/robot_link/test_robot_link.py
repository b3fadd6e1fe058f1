"""Cases of the robot link: what a robot that dials has to do (protocol/SPEC.md, section 2)."""

from __future__ import annotations

import base64
import contextlib
import hashlib
import json
import struct
import time
from collections.abc import Iterator
from typing import Any

import pytest
from conformance_suite import case, not_offered
from link_relay import ABSENCE, COMMAND_FRAME, HEARTBEAT, JSON, RARE, Link, LinkRelay, Sample, frame, message

TWIST = "geometry_msgs/msg/Twist"
TRIGGER = "std_srvs/srv/Trigger"
FIBONACCI = "example_interfaces/action/Fibonacci"
CDR = b"\0\1\0\0"
STRANGE = {"later": True, "fields": [1, {"more": None}]}


# --- what the robot offers ---


def sensor(relay: LinkRelay) -> tuple[str, str]:
    """A topic it publishes often, and its type."""
    topics = relay.graph["topics"]
    published = [
        name for name, each in topics.items() if each.get("publishers") and not name.endswith("/heard")
    ]
    likely = sorted(
        published, key=lambda name: ("counter" not in name, "rosout" in name, "parameter" in name, name)
    )
    if not likely:
        not_offered("the robot publishes no topic")
    return likely[0], topics[likely[0]]["types"][0]


def wheels(relay: LinkRelay) -> str:
    """The topic of type Twist that moves it and that it reports on as ``…/heard``."""
    topics = relay.graph["topics"]
    for name, each in topics.items():
        if f"{name}/heard" in topics and TWIST in each["types"]:
            return str(name)
    not_offered("no topic of type Twist with a topic …/heard beside it")
    raise AssertionError


def service(relay: LinkRelay) -> str:
    """A service of type Trigger."""
    found = sorted(name for name, each in relay.graph["services"].items() if TRIGGER in each["types"])
    if not found:
        not_offered(f"no service of type {TRIGGER}")
    return str(found[0])


def subscribe(link: Link, relay: LinkRelay, number: int = 7, **fields: Any) -> dict[str, Any]:
    """Subscribe to the sensor; what the robot answers."""
    topic, type_name = sensor(relay)
    link.say("subscribe", number=number, topic=topic, type=type_name, **fields)
    return link.expect("subscribed", number=number)


@pytest.fixture
def channel(relay: LinkRelay) -> Iterator[Link]:
    """A channel link of its own for each case."""
    with relay.channel() as link:
        yield link


# --- enrolment, opening ---


@case("enroll", "SPEC 2.2 enroll")
def test_enroll(relay: LinkRelay) -> None:
    """enroll has version 1, the robot's name, the code, and a public key of 32 bytes."""
    asked = relay.enrolment
    assert asked["version"] == 1
    assert (asked["robot"], len(base64.b64decode(asked["public_key"], validate=True))) == (relay.robot, 32)
    assert "private" not in json.dumps(asked)


@case("hello", "SPEC 2.2 hello")
def test_hello(relay: LinkRelay) -> None:
    """hello has version 1, the robot's name, the key's fingerprint and encodings, cdr or json."""
    hello = relay.control and relay.hello
    assert (hello["version"], hello["robot"]) == (1, relay.robot)
    assert hello["key"] == hashlib.sha256(relay.public_key).hexdigest()[:16]
    assert set(hello["encodings"]) & {"cdr", "json"}


@case("prove", "SPEC 2.2 prove; RFC 8032")
def test_prove(relay: LinkRelay) -> None:
    """The signature fits context, relay, robot and nonce; without that no case would have come so far."""
    assert not relay.control.ended


# --- both links ---


@case("ping", "SPEC 2.3 ping")
def test_ping(relay: LinkRelay) -> None:
    """A ping on the control link is answered with its t and the robot's clock, which goes on."""
    times = []
    for t in (1, 2**62):
        relay.control.say("ping", t=t)
        times.append(relay.control.expect("pong", t=t)["at"])
    assert times[1] > times[0]


@case("ping", "SPEC 2.3 ping")
def test_ping_on_channel(channel: Link) -> None:
    """A ping on the channel link is answered."""
    channel.say("ping", t=5)
    assert isinstance(channel.expect("pong", t=5)["at"], int)


@case("ping", "SPEC 2.3, each end pings")
def test_robot_pings(relay: LinkRelay, channel: Link) -> None:
    """The robot pings on both links."""
    until = time.monotonic() + 4
    while not (relay.control.pings and channel.pings):
        assert time.monotonic() < until, f"{relay.control.pings} and {channel.pings} pings in 4 s"
        time.sleep(0.01)


@case("frames", "SPEC 2.1 Frames")
def test_frames_in_pieces(relay: LinkRelay) -> None:
    """A frame that comes byte by byte is understood, and two that come in one piece."""
    for byte in message("ping", t=11):
        relay.control.raw(bytes([byte]))
    relay.control.raw(message("ping", t=12) + message("ping", t=13))
    for t in (11, 12, 13):
        relay.control.expect("pong", t=t)


@case("frames", "SPEC 2.2, unknown fields")
def test_unknown_fields(relay: LinkRelay, channel: Link) -> None:
    """Unknown fields are passed over, on both links."""
    relay.control.say("ping", t=21, **STRANGE)
    relay.control.expect("pong", t=21)
    assert subscribe(channel, relay, **STRANGE)


# --- the control link ---


@case("describe", "SPEC 2.4 describe")
def test_describe(relay: LinkRelay) -> None:
    """describe comes after welcome, its fields of the types SPEC says."""
    assert relay.control
    facts = relay.facts()
    texts = [facts.get(name, "") for name in ("host", "platform", "distro", "os", "agent")]
    assert all(isinstance(each, str) and len(each) <= 255 for each in texts)
    motion = facts.get("motion", {})
    assert all(isinstance(each, str) for each in motion.get("types", []) + motion.get("topics", []))
    assert all(0 < motion.get(name, 500) <= 60_000 for name in ("deadline_ms", "stop_within_ms"))


@case("graph", "SPEC 2.4 graph")
def test_graph(relay: LinkRelay) -> None:
    """graph comes after welcome, the first one full; names begin with a slash, types are full."""
    assert relay.control
    relay.facts()
    assert relay.first_graph is not None
    assert relay.first_graph.get("full") is True
    for kind in ("topics", "services", "actions"):
        for name, each in relay.graph[kind].items():
            assert name.startswith("/"), name
            assert all(len(type_name.split("/")) == 3 for type_name in each["types"]), each


@case("open_channel", "SPEC 2.2 join, 2.4 open_channel")
def test_two_channels(relay: LinkRelay) -> None:
    """Two channels at once are joined by two tickets, and serve side by side."""
    with relay.channel() as one, relay.channel() as two:
        for link in (one, two):
            assert subscribe(link, relay)
        one.expect_sample(7)
        two.expect_sample(7)


# --- topics out ---


@case("subscribe", "SPEC 2.5 subscribe, subscribed")
def test_subscribe(relay: LinkRelay, channel: Link) -> None:
    """subscribed tells number, topic, full type and encoding; samples carry the number and the wall clock."""
    topic, type_name = sensor(relay)
    told = subscribe(channel, relay, number=4_000_000_000)
    assert (told["topic"], told["type"]) == (topic, type_name)
    assert told["encoding"] in relay.hello["encodings"]
    sample = channel.expect_sample(4_000_000_000)
    assert abs(sample.stamp / 1e9 - time.time()) < 86_400
    if told["encoding"] == "json":
        assert isinstance(json.loads(sample.body), dict)
    else:
        assert sample.body[:2] in (b"\0\0", b"\0\1")


@case("subscribe", "SPEC 2.5 subscribe, type")
def test_subscribe_without_type(relay: LinkRelay, channel: Link) -> None:
    """Without a type the topic's own is taken."""
    topic, type_name = sensor(relay)
    channel.say("subscribe", number=1, topic=topic)
    assert channel.expect("subscribed", number=1)["type"] == type_name


@case("subscribe", "SPEC 2.5 failed")
def test_subscribe_unknown(relay: LinkRelay, channel: Link) -> None:
    """A topic that does not exist, without a type, is answered by failed: what, ref, and a reason."""
    channel.say("subscribe", number=3, topic="/no/such/topic_of_any_robot")
    failed = channel.expect("failed")
    assert (failed["what"], failed["ref"]) == ("subscribe", "3")
    assert failed["reason"]
    assert subscribe(channel, relay)


@case("subscribe", "SPEC 2.5 subscribe, throttle_ms")
def test_throttle(relay: LinkRelay, channel: Link) -> None:
    """With throttle_ms samples come no closer than that on average."""
    subscribe(channel, relay, number=1)
    fast = [channel.expect_sample(1).stamp for _ in range(4)]
    if (fast[-1] - fast[0]) / 3 > 150e6:
        not_offered("a topic that comes more often than every 150 ms")
    subscribe(channel, relay, number=2, throttle_ms=300)
    slow = [channel.expect_sample(2).stamp for _ in range(4)]
    # The first may be one that was kept for late joiners.
    assert (slow[-1] - slow[1]) / 2 > 250e6


@case("subscribe", "SPEC 2.5 subscribe, again with a known number")
def test_throttle_changes(relay: LinkRelay, channel: Link) -> None:
    """subscribe again with a known number changes the throttle, here from once an hour to all."""
    subscribe(channel, relay, throttle_ms=3_600_000)
    # The latest there was, and the first since.
    time.sleep(ABSENCE)
    early = 0
    with contextlib.suppress(AssertionError):
        while True:
            channel.expect_sample(7, 0.0)
            early += 1
    assert early <= 2
    subscribe(channel, relay, throttle_ms=0)
    for _ in range(3):
        channel.expect_sample(7)


@case("unsubscribe", "SPEC 2.5 unsubscribe")
def test_unsubscribe(relay: LinkRelay, channel: Link) -> None:
    """After unsubscribe no sample of this number comes, and the other number goes on."""
    for number in (1, 2):
        subscribe(channel, relay, number=number)
        channel.expect_sample(number)
    channel.say("unsubscribe", number=1)
    channel.no_sample(1)
    channel.expect_sample(2)


@case("unsubscribe", "SPEC 2.5 unsubscribe")
def test_unsubscribe_unknown(channel: Link) -> None:
    """unsubscribe and unadvertise of numbers nobody knows harm nobody."""
    channel.say("unsubscribe", number=999)
    channel.say("unadvertise", number=999)
    channel.say("ping", t=1)
    channel.expect("pong", t=1)


@case("subscribe", "SPEC 2.1, samples in parts")
def test_large_sample(relay: LinkRelay, channel: Link) -> None:
    """A sample of 1 MB, whole or in parts, comes byte by byte, and pings are answered meanwhile."""
    topics = relay.graph["topics"]
    large = next((name for name in topics if name.endswith("/large")), None)
    if large is None:
        not_offered("no topic …/large with samples of 1 MB")
    channel.say("subscribe", number=1, topic=large, type=topics[large]["types"][0])
    assert channel.expect("subscribed", number=1)["latched"] is True
    channel.say("ping", t=1)
    sample = channel.expect_sample(1)
    assert sample.body[-1_000_000:] == bytes(number % 251 for number in range(1_000_000))
    channel.expect("pong", t=1)


# --- topics in ---


@case("advertise", "SPEC 2.5 failed")
def test_advertise_nonsense(channel: Link) -> None:
    """A type that does not exist is answered by failed: what, ref, and a reason."""
    channel.say("advertise", number=9, topic="/no/such_topic", type="no_such_package/msg/Thing")
    failed = channel.expect("failed")
    assert (failed["what"], failed["ref"]) == ("advertise", "9")
    assert failed["reason"]


@case("advertise", "SPEC 2.5, samples of numbers nobody knows")
def test_sample_unknown(channel: Link) -> None:
    """A sample of a number that was never advertised is let go."""
    channel.sample(12345, CDR)
    channel.say("ping", t=1)
    channel.expect("pong", t=1)


@case("advertise", "SPEC 2.5 advertise")
def test_publish(relay: LinkRelay, channel: Link) -> None:
    """What is published on …/in of type String comes out of …/out, where the robot has such a pair."""
    topics = relay.graph["topics"]
    echo = next((name for name in topics if name.endswith("/in") and f"{name[:-2]}out" in topics), None)
    if echo is None:
        not_offered("no topic …/in with a topic …/out that echoes it")
    channel.say("subscribe", number=1, topic=f"{echo[:-2]}out", type="std_msgs/msg/String")
    channel.expect("subscribed", number=1)
    channel.say("advertise", number=2, topic=echo, type="std_msgs/msg/String")
    told = channel.expect("advertised", number=2)
    assert not told.get("motion")
    body = b'{"data": "echo"}' if told["encoding"] == "json" else CDR + struct.pack("<I", 5) + b"echo\0"
    until = time.monotonic() + 8
    heard = b""
    while b"echo" not in heard:
        assert time.monotonic() < until, "no echo came"
        # Of any age: only motion is judged by it.
        channel.sample(2, body, age=3600)
        with contextlib.suppress(AssertionError):
            heard = channel.expect_sample(1, 0.2).body


# --- services ---


@case("call_service", "SPEC 2.5 call_service")
def test_call(relay: LinkRelay, channel: Link) -> None:
    """A call is answered by one service_response with its id, in the encoding of the call."""
    name = service(relay)
    cdr = "cdr" in relay.hello["encodings"]
    args = {"cdr": base64.b64encode(CDR + b"\0").decode()} if cdr else {"args": {}}
    channel.say("call_service", id="one", service=name, type=TRIGGER, timeout=5, **args)
    answer = channel.expect("service_response", id="one")
    assert answer["result"] is True
    if cdr:
        assert base64.b64decode(answer["cdr"], validate=True)[4] in (0, 1)
    else:
        assert isinstance(answer["values"]["success"], bool)


@case("call_service", "SPEC 2.5 service_response, reason")
def test_call_unknown(channel: Link) -> None:
    """A service that does not exist is answered with result false and a reason."""
    args = {"cdr": base64.b64encode(CDR + b"\0").decode(), "args": {}}
    channel.say("call_service", id="two", service="/no/such_service", type=TRIGGER, timeout=0.5, **args)
    answer = channel.expect("service_response", id="two")
    assert answer["result"] is False
    assert answer["reason"]


@case("advertise_service", "SPEC 2.5 advertise_service")
def test_offer_service(relay: LinkRelay) -> None:
    """A service the relay offers is called from the robot's graph, here by another channel, and answered."""
    name = f"/conformance_offer_{time.monotonic_ns()}"
    with relay.channel() as offering, relay.channel() as calling:
        offering.say("advertise_service", service=name, type=TRIGGER, source="a case")
        if not stands(offering, "advertise_service", "advertised_service"):
            not_offered("services of clients in its graph")
        request = {"cdr": base64.b64encode(CDR + b"\0").decode()}
        calling.say("call_service", id="mine", service=name, type=TRIGGER, timeout=8, **request)
        asked = offering.expect("call_service", service=name)
        assert asked["type"] == TRIGGER
        answer = base64.b64encode(CDR + b"\1\0\0\0" + struct.pack("<I", 5) + b"here\0").decode()
        offering.say("service_response", id=asked["id"], result=True, cdr=answer)
        told = calling.expect("service_response", id="mine")
        assert told["result"] is True
        assert b"here" in base64.b64decode(told["cdr"])
        offering.say("unadvertise_service", service=name)
        calling.say("call_service", id="gone", service=name, type=TRIGGER, timeout=0.5, **request)
        assert calling.expect("service_response", id="gone")["result"] is False


def stands(link: Link, asked: str, answer: str) -> bool:
    """Whether what was asked for stands; ``failed`` otherwise."""
    told = link.take(
        f"'{answer}' or 'failed'", lambda each: isinstance(each, dict) and each["op"] in (answer, "failed")
    )
    assert told["op"] == answer or told["what"] == asked
    return bool(told["op"] == answer)


# --- types ---


@case("get_type", "SPEC 2.5 get_type")
def test_get_type(relay: LinkRelay, channel: Link) -> None:
    """type_definition has the text of the type, and of every type in it after 80 = and MSG: name."""
    if "cdr" not in relay.hello["encodings"]:
        not_offered("encodings json only: nobody needs its types")
    channel.say("get_type", type=TWIST)
    told = channel.expect("type_definition", type=TWIST)
    main, _, rest = told["text"].partition("\n" + "=" * 80 + "\n")
    assert "Vector3" in main
    assert rest.startswith(("MSG: geometry_msgs/msg/Vector3", "MSG: geometry_msgs/Vector3"))
    assert "float64 x" in rest


@case("get_type", "SPEC 2.5 failed")
def test_get_type_unknown(channel: Link) -> None:
    """A type that does not exist is answered by failed: what, ref, and a reason."""
    channel.say("get_type", type="no_such_package/msg/Thing")
    failed = channel.expect("failed")
    assert (failed["what"], failed["ref"]) == ("get_type", "no_such_package/msg/Thing")
    assert failed["reason"]


@case("get_interfaces", "SPEC 2.5 get_interfaces")
def test_get_interfaces(channel: Link) -> None:
    """get_interfaces is answered by full names, or by failed."""
    channel.say("get_interfaces")
    until = time.monotonic() + 8
    while time.monotonic() < until:
        with contextlib.suppress(AssertionError):
            channel.expect("failed", 0.1, what="get_interfaces")
            not_offered("the names of its types")
        with contextlib.suppress(AssertionError):
            types = channel.expect("interfaces", 0.1)["types"]
            assert all(len(each.split("/")) == 3 for each in types)
            return
    raise AssertionError("neither 'interfaces' nor 'failed' came")


# --- actions ---


@case("send_action_goal", "SPEC 2.5 send_action_goal, 0: it never began")
def test_goal_unknown(channel: Link) -> None:
    """A goal on an action that does not exist is answered with status 0, result false and a reason."""
    goal = {"cdr": base64.b64encode(CDR + bytes(4)).decode(), "args": {}}
    channel.say(
        "send_action_goal",
        id="g",
        action="/no/such_action",
        type="example_interfaces/action/Fibonacci",
        **goal,
    )
    result = channel.expect("action_result", id="g")
    assert (result["status"], result["result"]) == (0, False)
    assert result["reason"]


@case("advertise_action", "SPEC 2.5 advertise_action")
def test_offer_action(relay: LinkRelay) -> None:
    """An action the relay offers is pursued from the robot's graph, here by another channel, to its result."""
    name = f"/conformance_offer_{time.monotonic_ns()}"
    with relay.channel() as offering, relay.channel() as asking:
        offering.say("advertise_action", action=name, type=FIBONACCI, source="a case")
        if not stands(offering, "advertise_action", "advertised_action"):
            not_offered("actions of clients in its graph")
        goal = base64.b64encode(CDR + struct.pack("<i", 7)).decode()
        asking.say("send_action_goal", id="mine", action=name, type=FIBONACCI, feedback=True, cdr=goal)
        asked = offering.expect("send_action_goal", action=name)
        assert base64.b64decode(asked["cdr"])[4:8] == struct.pack("<i", 7)
        sequence = base64.b64encode(CDR + struct.pack("<2i", 1, 42)).decode()
        offering.say("action_feedback", id=asked["id"], cdr=sequence)
        assert base64.b64decode(asking.expect("action_feedback", id="mine")["cdr"])[4:] == struct.pack(
            "<2i", 1, 42
        )
        offering.say("action_result", id=asked["id"], status=4, result=True, cdr=sequence)
        result = asking.expect("action_result", id="mine")
        assert (result["status"], result["result"]) == (4, True)
        assert base64.b64decode(result["cdr"])[4:] == struct.pack("<2i", 1, 42)


def fibonacci(relay: LinkRelay, link: Link, order: int, **fields: Any) -> None:
    """Send a goal, id ``g``, to an action of type Fibonacci."""
    actions = relay.graph["actions"]
    found = sorted(name for name, each in actions.items() if FIBONACCI in each["types"])
    if not found:
        not_offered(f"no action of type {FIBONACCI}")
    goal = base64.b64encode(CDR + struct.pack("<i", order)).decode()
    link.say("send_action_goal", id="g", action=found[0], type=FIBONACCI, cdr=goal, **fields)


@case("send_action_goal", "SPEC 2.5 send_action_goal")
def test_goal(relay: LinkRelay, channel: Link) -> None:
    """A goal is answered by feedback, where it is wanted, and one result of status 4."""
    fibonacci(relay, channel, 4, feedback=True)
    assert base64.b64decode(channel.expect("action_feedback", id="g")["cdr"])
    result = channel.expect("action_result", id="g")
    assert (result["status"], result["result"]) == (4, True)
    assert base64.b64decode(result["cdr"])[4:] == struct.pack("<6i", 5, 0, 1, 1, 2, 3)


@case("cancel_action_goal", "SPEC 2.5 cancel_action_goal")
def test_cancel(relay: LinkRelay, channel: Link) -> None:
    """A goal that is cancelled ends with a result of status 5."""
    fibonacci(relay, channel, 200, feedback=True)
    channel.expect("action_feedback", id="g")
    channel.say("cancel_action_goal", id="g")
    assert channel.expect("action_result", id="g")["status"] == 5


@case("cancel_action_goal", "SPEC 2.5 cancel_action_goal")
def test_cancel_unknown(channel: Link) -> None:
    """Cancelling a goal nobody knows harms nobody."""
    channel.say("cancel_action_goal", id="never")
    channel.say("ping", t=1)
    channel.expect("pong", t=1)


# --- motion ---


class Wheels:
    """Drives the robot by one channel link, and watches by another what it was told."""

    def __init__(self, relay: LinkRelay, driving: Link, watching: Link) -> None:
        topic = wheels(relay)
        policy = relay.facts().get("motion", {})
        self.deadline = policy.get("deadline_ms", 500) / 1000
        self.stop_within = policy.get("stop_within_ms", 500) / 1000
        self.driving, self.watching = driving, watching
        watching.say("subscribe", number=1, topic=f"{topic}/heard", type=TWIST)
        self._heard_encoding = watching.expect("subscribed", number=1)["encoding"]
        self.topic = topic
        self.advertise()
        # What the case before has left moving stops by itself.
        while self.next_speed(self.stop_within + 0.1):
            pass

    def advertise(self) -> None:
        """Announce commands."""
        self.driving.say("advertise", number=2, topic=self.topic, type=TWIST)
        self.told = self.driving.expect("advertised", number=2)

    def command(self, speed: float, age: float = 0.0) -> None:
        """One command."""
        if self.told["encoding"] == "json":
            twist = {"linear": {"x": speed, "y": 0, "z": 0}, "angular": {"x": 0, "y": 0, "z": 0}}
            body = json.dumps(twist).encode()
        else:
            body = CDR + struct.pack("<6d", speed, 0, 0, 0, 0, 0)
        self.driving.sample(2, body, age)

    def not_finite(self) -> None:
        """Commands whose speed is no finite number."""
        for speed in (float("nan"), float("inf"), float("-inf")):
            self.command(speed)
        if self.told["encoding"] == "json":
            for text in (b"null", b"1e999", b"-1e999"):
                self.driving.sample(2, b'{"linear": {"x": ' + text + b'}, "angular": {}}')

    def speed(self, sample: Sample) -> float:
        """The forward speed of a report."""
        if self._heard_encoding == "json":
            return float(json.loads(sample.body)["linear"]["x"])
        return float(struct.unpack_from("<d" if sample.body[1] & 1 else ">d", sample.body, 4)[0])

    def next_speed(self, seconds: float) -> float | None:
        """The next report, if one comes."""
        with contextlib.suppress(AssertionError):
            return self.speed(self.watching.expect_sample(1, seconds))
        return None

    def start(self) -> Sample:
        """Command until it moves; the first report of it."""
        until = time.monotonic() + 10
        while True:
            assert time.monotonic() < until, "commands, sent again and again, did not move the robot"
            self.command(0.2)
            with contextlib.suppress(AssertionError):
                report = self.watching.expect_sample(1, 0.05)
                if self.speed(report) == 0.2:
                    return report

    def stands(self, moving: Sample) -> float:
        """Wait until it stands; seconds from the last report of moving, no earlier than ``moving``, to that."""
        while True:
            report = self.watching.expect_sample(1, 3)
            if self.speed(report) == 0:
                return (report.stamp - moving.stamp) / 1e9
            moving = report

    def never_moves(self, seconds: float = ABSENCE) -> None:
        """Nothing but standing is reported within this time."""
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0:
            assert not self.next_speed(left), "it moves"


@pytest.fixture
def drive(relay: LinkRelay) -> Iterator[Wheels]:
    """A robot that can be driven."""
    with relay.channel() as watching, relay.channel() as driving:
        yield Wheels(relay, driving, watching)


@case("motion", "SPEC 2.5 advertised, motion")
def test_motion_is_known(drive: Wheels) -> None:
    """The robot says of the topic that it moves it."""
    assert drive.told["motion"] is True


@case("motion", "SPEC 2.5, Clocks and deadline, 3")
def test_fresh_commands(drive: Wheels) -> None:
    """Fresh commands are obeyed, and a command of zero stops."""
    moving = drive.start()
    drive.command(0.0)
    drive.stands(moving)


@case("motion", "SPEC 2.5, Clocks and deadline, 7")
def test_stops_when_commands_cease(drive: Wheels) -> None:
    """When commands cease the robot stands still within stop_within_ms, while its links live."""
    moving = drive.start()
    for _ in range(3):
        drive.command(0.2)
    took = drive.stands(moving)
    assert took <= drive.stop_within + 0.25, f"it took {took * 1000:.0f} ms"


@case("motion", "SPEC 2.5, Clocks and deadline, 6")
def test_says_zero_again(drive: Wheels) -> None:
    """Zero is said several times, because a best-effort subscriber may miss the first."""
    drive.stands(drive.start())
    if drive.next_speed(0.5) is None:
        not_offered("zero is said once only (SHOULD)")


@case("motion", "SPEC 2.5, Clocks and deadline, 3")
def test_old_commands(drive: Wheels) -> None:
    """Commands older than deadline_ms are dropped."""
    drive.stands(drive.start())
    for _ in range(5):
        drive.command(0.2, age=drive.deadline + 0.05)
    drive.never_moves()
    drive.start()


@case("motion", "SPEC 2.5, Clocks and deadline, 3")
def test_old_commands_do_not_keep_it_moving(drive: Wheels) -> None:
    """Commands that are too old don't keep the robot moving."""
    drive.start()
    until = time.monotonic() + drive.stop_within + 1
    while time.monotonic() < until:
        drive.command(0.3, age=drive.deadline + 0.5)
        assert drive.next_speed(0.05) != 0.3
    drive.command(0.0)
    drive.never_moves()


@case("motion", "SPEC 2.5, Clocks and deadline, 3")
def test_commands_of_the_future(drive: Wheels) -> None:
    """Commands that lie in the future are dropped."""
    drive.stands(drive.start())
    for _ in range(5):
        drive.command(0.2, age=-60)
    drive.never_moves()


@case("motion", "SPEC 2.5, Clocks and deadline, 4")
def test_no_number(drive: Wheels) -> None:
    """A command with what is no finite number is dropped, and the next one is obeyed."""
    drive.stands(drive.start())
    for _ in range(3):
        drive.not_finite()
    drive.never_moves()
    drive.start()


@case("motion", "SPEC 2.5, Clocks and deadline")
def test_nonsense_for_a_command(drive: Wheels) -> None:
    """Bytes that are no command are dropped, and the next command is obeyed."""
    for body in (b"", b"{", b"\0", b"[]", b"null", b'{"linear": 5}', CDR, CDR + b"x" * 47):
        drive.driving.sample(2, body)
    drive.never_moves()
    drive.start()


@case("motion", "SPEC 2.5 unadvertise")
def test_unadvertise_stops(drive: Wheels) -> None:
    """unadvertise stops what this publisher left moving, without waiting for the watchdog."""
    took = []
    for _ in range(4):
        moving = drive.start()
        drive.driving.say("unadvertise", number=2)
        took.append(drive.stands(moving))
        drive.never_moves()
        drive.advertise()
    assert min(took) < 0.6 * drive.stop_within, f"it took {[f'{each * 1000:.0f}' for each in took]} ms"


@case("motion", "SPEC 2.5, Clocks and deadline, 7")
def test_cut_channel_stops(drive: Wheels) -> None:
    """When the channel link that drives is cut the robot stands still within stop_within_ms."""
    moving = drive.start()
    drive.driving.cut()
    took = drive.stands(moving)
    assert took <= drive.stop_within + 0.25, f"it took {took * 1000:.0f} ms"


@case("motion", "SPEC 2.5, Clocks and deadline, 7")
def test_other_samples_are_no_commands(drive: Wheels) -> None:
    """Samples of another number and pings are no commands: they don't keep it moving."""
    drive.start()
    until = time.monotonic() + 3
    while drive.next_speed(0.05) != 0:
        assert time.monotonic() < until, "it goes on"
        drive.driving.sample(3, b"{}")
        drive.driving.say("ping", t=1)


@case("motion", "SPEC 2.4, losing the control link; 2.5, a new link never resumes motion")
def test_cut_control_stops(relay: LinkRelay, drive: Wheels) -> None:
    """When the control link is cut channels end, and the robot that comes back stands still."""
    drive.start()
    relay.control.cut()
    drive.watching.wait_end()
    drive.driving.wait_end()
    with relay.channel() as watching, relay.channel() as driving:
        again = Wheels(relay, driving, watching)
        # What it reports first is the latest there was, because …/heard is kept for late joiners.
        assert again.next_speed(2) in (0, None)
        again.never_moves()
        again.start()


# --- endings; each costs the robot its link ---


@case("bye", "SPEC 2.3 bye")
def test_bye(relay: LinkRelay) -> None:
    """After bye the robot hangs up, and dials again."""
    link = relay.control
    link.say("bye", reason="a case of the conformance suite")
    link.wait_end()
    assert not relay.control.ended


@case("reconnect", "SPEC 2.3, dials again, for ever")
def test_cut(relay: LinkRelay) -> None:
    """After the link was cut the robot dials again, proves itself anew, and tells all of itself again."""
    relay.control.cut()
    assert not relay.control.ended
    assert relay.first_graph is not None
    with relay.channel() as link:
        subscribe(link, relay)
        link.expect_sample(7)


@case("reconnect", "SPEC 2.3, nothing for three heartbeats")
def test_silent_relay(relay: LinkRelay) -> None:
    """A relay that is silent for three heartbeats is left, and dialled again."""
    link = relay.control_with(HEARTBEAT)
    link.answers_pings = False
    link.wait_end()
    assert not relay.control.ended


@case("reconnect", "SPEC 2.3, with growing random delays")
def test_backoff(relay: LinkRelay) -> None:
    """A relay that hangs up at once is dialled again, but not in a tight loop."""
    relay.control.cut()
    before, until = relay.dials, time.monotonic() + 1.5
    while time.monotonic() < until:
        with contextlib.suppress(AssertionError):
            relay.dialled("hello", 0.05)[0].cut()
    assert relay.dials - before < 20
    assert not relay.control.ended


@case("refused", "SPEC 2.2 refused, retry_after")
def test_refused(relay: LinkRelay) -> None:
    """A robot that is refused with retry_after hangs up, and dials again."""
    relay.control.cut()
    link, _ = relay.dialled("hello", 30)
    link.say("refused", reason="a case of the conformance suite", code="unavailable", retry_after=0.2)
    link.wait_end()
    assert not relay.control.ended


def breaks(link: Link, data: bytes, seconds: float = 8.0) -> None:
    """After these bytes the robot says so, or says nothing, and hangs up, earlier than for silence."""
    link.raw(data)
    link.wait_end(seconds)


@case("frames", "SPEC 2.1, a length over the limit")
def test_oversized_frame(relay: LinkRelay) -> None:
    """A frame over 4 MiB is refused when its length is there, and the robot dials again."""
    breaks(relay.control_with(RARE), struct.pack("!IB", COMMAND_FRAME + 1, JSON))
    assert not relay.control.ended


@case("frames", "SPEC 2.1, 16 KiB until the robot is proved")
def test_oversized_before_proof(relay: LinkRelay) -> None:
    """Before the proof a frame over 16 KiB is refused."""
    relay.control.cut()
    link, _ = relay.dialled("hello", 30)
    # Before it is told another heartbeat, a robot waits 6 s in silence.
    breaks(link, struct.pack("!IB", 16 * 1024 + 1, JSON), 4)
    assert not relay.control.ended


@case("frames", "SPEC 2.1, breaks the contract")
@pytest.mark.parametrize(
    "data",
    [struct.pack("!I", 0), frame(77, b"?"), frame(JSON, b"no JSON"), frame(JSON, b"[]"), frame(1, b"short")],
    ids=["length 0", "unknown kind", "no JSON", "no object", "a sample on the control link"],
)
def test_broken_frames(relay: LinkRelay, data: bytes) -> None:
    """What breaks the contract ends the link, and the robot dials again."""
    breaks(relay.control_with(RARE), data + b"\0\0")
    assert not relay.control.ended


@case("frames", "SPEC 2.2, an unknown op")
def test_unknown_op(relay: LinkRelay) -> None:
    """An unknown op on the control link ends it, and the robot dials again."""
    breaks(relay.control_with(RARE), message("make_coffee"))
    assert not relay.control.ended


@case("frames", "SPEC 2.2, an unknown op")
def test_unknown_op_on_channel(relay: LinkRelay) -> None:
    """An unknown op on a channel link is told in words or ends it; the control link lives."""
    control = relay.control
    with relay.channel() as link:
        link.say("make_coffee")
        with contextlib.suppress(AssertionError):
            assert link.expect("failed", 1)["reason"]
            return
        link.wait_end()
    control.say("ping", t=1)
    control.expect("pong", t=1)


@case("challenge", "SPEC 2.2 challenge")
def test_another_relay(relay: LinkRelay) -> None:
    """A relay of another name than the robot was enrolled with gets no signature."""
    # The last case: nobody says when a robot has to try again after that.
    relay.control.cut()
    link, _ = relay.dialled("hello", 30)
    relay.challenge(link, "another relay")
    link.wait_end()
    with contextlib.suppress(AssertionError):
        link.expect("prove", 0.0)
        raise RuntimeError("it signed for a relay it does not know")
