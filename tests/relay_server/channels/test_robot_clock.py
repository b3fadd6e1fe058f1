"""A robot's own time."""

from __future__ import annotations

import json
import struct

import cbor2
import msgspec
import pytest

from relay_protocol import link
from relay_server.channels.robot_clock import THROTTLE_MS, TYPE, nanoseconds
from tests.worlds.relay import GRAPH, MOTION, STRING, Person, World, text

STAMPED = "a_msgs/msg/Stamped"
STAMPED_TEXT = (
    "std_msgs/Header header\n"
    + "=" * 80
    + "\nMSG: std_msgs/msg/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
)
SIMULATED = msgspec.structs.replace(MOTION, sim_time=True)


def tick(sec: int, nanosec: int, order: str = "<") -> bytes:
    """A rosgraph_msgs/msg/Clock in CDR."""
    return (b"\x00\x01\x00\x00" if order == "<" else b"\x00\x00\x00\x00") + struct.pack(
        f"{order}iI", sec, nanosec
    )


@pytest.fixture
def person(world: World) -> Person:
    """A client on a robot with simulated time."""
    world.robot_comes()
    world.registry.described(world.robot, SIMULATED)
    operator = world.person()
    world.robot_joins()
    return operator


def subscription(world: World) -> link.Subscribe:
    """The relay's confirmed subscription to /clock."""
    (asked,) = [each for each in world.link.all(link.Subscribe) if each.topic == "/clock"]
    world.channel.message(
        link.Subscribed(number=asked.number, topic="/clock", type=TYPE, encoding="cdr", publishers=1)
    )
    return asked


def clock_text(world: World) -> None:
    """The robot sends the type of its clock."""
    for asked in world.link.take(link.GetType):
        if asked.type == TYPE:
            text = "builtin_interfaces/Time clock\n"
            world.channel.message(link.TypeDefinition(type=TYPE, text=text))


def test_the_time_of_a_simulation_is_the_last_clock_message(world: World, person: Person) -> None:
    """It is 0 before the first sample, as in ROS; no client needs to subscribe."""
    assert world.channel.now_ns() == 0
    asked = subscription(world)
    assert asked.type == TYPE
    assert asked.throttle_ms == THROTTLE_MS
    clock_text(world)
    world.channel.sample(asked.number, tick(12, 5), 0)
    assert world.channel.now_ns() == 12 * 10**9 + 5
    world.channel.sample(asked.number, tick(13, 0), 0)
    world.channel.sample(asked.number, tick(14, 0), 0)
    assert world.channel.now_ns() == 14 * 10**9
    world.channel.sample(asked.number, b"nonsense", 0)
    assert world.channel.now_ns() == 14 * 10**9


def test_stamps_that_clients_leave_out_are_the_robots_time(world: World, person: Person) -> None:
    asked = subscription(world)
    clock_text(world)
    world.channel.sample(asked.number, tick(77, 9), 0)
    person.says("advertise", topic="/goal", type=STAMPED)
    person.says("publish", topic="/goal", msg={"header": {"frame_id": "map"}})
    world.channel.message(link.TypeDefinition(type=STAMPED, text=STAMPED_TEXT))
    ((_, _, body),) = world.link.samples
    sent = json.loads(world.robot.types.to_json(STAMPED, body))
    assert sent["header"] == {"stamp": {"sec": 77, "nanosec": 9}, "frame_id": "map"}


def test_raw_samples_carry_the_robots_time(world: World, person: Person) -> None:
    """Simulated time if there is one, otherwise the time at which the sample reached the robot."""
    asked = subscription(world)
    person.says("subscribe", topic="/chatter", compression="cbor-raw")
    (number,) = [each.number for each in world.link.all(link.Subscribe) if each.topic == "/chatter"]
    world.subscribed(number)
    wall = 1_700_000_000 * 10**9 + 7
    world.channel.sample(number, text("early"), wall)
    world.channel.sample(asked.number, tick(77, 9), wall)
    world.channel.sample(number, text("simulated"), wall)
    world.registry.described(world.robot, MOTION)
    world.channel.sample(number, text("real"), wall)
    came = [cbor2.loads(each)["msg"] for each in person.client.sent]
    assert [(each["secs"], each["nsecs"]) for each in came] == [(0, 0), (77, 9), (1_700_000_000, 7)]
    assert [each["bytes"] for each in came] == [text(word) for word in ("early", "simulated", "real")]


def test_a_client_receives_the_clock_by_the_same_subscription(world: World, person: Person) -> None:
    """The relay and clients share one subscription; it stays when the client leaves."""
    asked = subscription(world)
    clock_text(world)
    person.says("subscribe", topic="/clock")
    world.channel.sample(asked.number, tick(1, 2), 0)
    (heard,) = person.received("publish")
    assert heard["msg"] == {"clock": {"sec": 1, "nanosec": 2}}
    person.says("unsubscribe", topic="/clock")
    assert not world.link.all(link.Unsubscribe)
    world.channel.sample(asked.number, tick(2, 2), 0)
    assert world.channel.now_ns() == 2 * 10**9 + 2


def test_time_starts_again_when_the_robot_returns(world: World, person: Person) -> None:
    """The simulation may have changed, so the clock is subscribed to again."""
    asked = subscription(world)
    world.channel.sample(asked.number, tick(5, 0), 0)
    world.robot_goes()
    world.robot_comes()
    world.robot.description = SIMULATED
    world.robot_joins()
    assert world.channel.now_ns() == 0
    again = subscription(world)
    clock_text(world)
    world.channel.sample(again.number, tick(6, 0), 0)
    assert world.channel.now_ns() == 6 * 10**9


def test_a_robot_may_begin_and_end_to_simulate(world: World) -> None:
    """The subscription follows the robot's new description."""
    world.robot_comes()
    world.person()
    world.robot_joins()
    assert world.channel.now_ns() == world.now_ns() + 10**18
    assert not world.link.all(link.Subscribe)
    world.registry.described(world.robot, SIMULATED)
    subscription(world)
    assert world.channel.now_ns() == 0
    world.registry.described(world.robot, SIMULATED)
    assert len(world.link.all(link.Subscribe)) == 1
    world.registry.described(world.robot, MOTION)
    assert len(world.link.all(link.Unsubscribe)) == 1
    assert world.channel.now_ns() == world.now_ns() + 10**18


def test_a_clock_of_another_type_is_no_clock(world: World) -> None:
    """The time stays 0, and everything else works."""
    graph = msgspec.structs.replace(
        GRAPH, topics={**GRAPH.topics, "/clock": link.Topic(types=[STRING], publishers=["/odd"])}
    )
    world.robot_comes(graph=graph)
    world.registry.described(world.robot, SIMULATED)
    person = world.person()
    world.robot_joins()
    assert world.channel.now_ns() == 0
    person.says("subscribe", topic="/clock")
    person.says("subscribe", topic="/chatter")
    assert "/chatter" in {each.topic for each in world.link.all(link.Subscribe)}


def test_the_channel_closes_though_it_follows_the_clock(world: World, person: Person) -> None:
    subscription(world)
    person.session.end()
    world.clock.advance(6)
    assert world.control.all(link.CloseChannel)


@pytest.mark.parametrize(
    ("body", "reported"),
    [
        (tick(1, 2), 10**9 + 2),
        (tick(1, 2, ">"), 10**9 + 2),
        (tick(-1, 2), None),
        (tick(1, 10**9), None),
        (tick(1, 2)[:8], None),
        (b"", None),
        (b'{"clock":{"sec":1,"nanosec":2}}', 10**9 + 2),
        (b'{"clock":{"sec":99999999999,"nanosec":2}}', None),
        (b'{"clock":{"sec":-1,"nanosec":2}}', None),
        (b'{"clock":{"sec":1.5,"nanosec":2}}', None),
        (b'{"clock":7}', None),
        (b"[" * 10_000, None),
    ],
)
def test_a_tick_is_read_in_both_encodings_and_only_if_it_is_one(body: bytes, reported: int | None) -> None:
    """Robots are not trusted."""
    assert nanoseconds(body) == reported
