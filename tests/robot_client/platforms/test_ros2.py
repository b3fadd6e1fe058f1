"""The ROS 2 platform in a real graph, against a node in another process."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import pytest_twisted
import rclpy
from geometry_msgs.msg import Twist, TwistStamped
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger
from twisted.internet import reactor, task

from relay_protocol import link
from relay_protocol.errors import Invalid, NotFound, SwitchboardError, Unavailable
from robot_client.motion import MOTION_QOS
from robot_client.platforms.base import GraphView, Motion
from robot_client.platforms.ros2 import LOOK_EVERY, Ros2Platform
from robot_client.platforms.ros2_types import introspected
from robot_client.topics import TypedTopic
from tests.robot_client.ros import Peer, domain

STRING = "std_msgs/msg/String"
TWIST = "geometry_msgs/msg/Twist"
STAMPED = "geometry_msgs/msg/TwistStamped"
TRIGGER = "std_srvs/srv/Trigger"


@pytest.fixture(scope="module")
def environment() -> Iterator[dict[str, str]]:
    with domain() as found:
        yield found


@pytest.fixture(scope="module")
def peer(environment: dict[str, str]) -> Iterator[Peer]:
    made = Peer(environment)
    yield made
    made.close()


@pytest.fixture(params=["events", "single"])
def executor(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def make(executor: str) -> Ros2Platform:
    made = Ros2Platform(reactor, "switchboard_test", guard="switchboard_guard_test", executor=executor)
    made.start()
    return made


@pytest.fixture(scope="module")
def ros(environment: dict[str, str]) -> Iterator[Ros2Platform]:
    made = make("events")
    yield made
    made.stop()


async def until(true: Callable[[], Any], timeout: float = 20.0) -> None:
    deadline = time.monotonic() + timeout
    while not true():
        assert time.monotonic() < deadline, f"waited {timeout} s in vain"
        await task.deferLater(reactor, 0.02)


class Listener:
    def __init__(self, ros: Ros2Platform, topic: str, type: str = "", qos: link.QoS | None = None) -> None:
        self.bodies: list[bytes] = []
        self.changes = 0
        self.source = ros.subscribe(topic, type, qos, self.bodies.append, self.changed)

    def changed(self) -> None:
        self.changes += 1

    @property
    def texts(self) -> list[str]:
        return [deserialize_message(body, String).data for body in self.bodies]


async def seen(ros: Ros2Platform, found: Callable[[GraphView], bool]) -> GraphView:
    await until(lambda: found(ros.graph()))
    return ros.graph()


@pytest_twisted.ensureDeferred
async def test_samples_are_cdr(executor: str, peer: Peer) -> None:
    """With either executor a subscription delivers the CDR bytes of the message that was published."""
    ros = make(executor)
    try:
        topic = f"/raw_{executor}"
        peer.do("advertise", topic)
        await seen(ros, lambda graph: topic in graph.topics)
        listener = Listener(ros, topic)
        await until(lambda: peer.do("publish", topic, "hällo") or listener.bodies)
        assert listener.texts[0] == "hällo"
        # The middleware fills up to four bytes.
        assert listener.bodies[0].startswith(bytes(serialize_message(String(data="hällo"))))
        assert listener.source.type == STRING
    finally:
        ros.stop()


@pytest_twisted.ensureDeferred
async def test_latched_message_reaches_a_late_subscriber(ros: Ros2Platform, peer: Peer) -> None:
    """What a latching publisher said before the subscription was made arrives after it."""
    peer.do("advertise", "/latched", "latched")
    peer.do("publish", "/latched", "kept")
    await seen(ros, lambda graph: "/latched" in graph.topics)
    listener = Listener(ros, "/latched")
    await until(lambda: listener.texts)
    assert listener.texts == ["kept"]
    assert listener.source.latched


@pytest_twisted.ensureDeferred
async def test_best_effort_publisher_is_heard(ros: Ros2Platform, peer: Peer) -> None:
    """A best-effort publisher, which a reliable subscription would never match, is heard."""
    peer.do("advertise", "/lossy", "best_effort")
    await seen(ros, lambda graph: "/lossy" in graph.topics)
    listener = Listener(ros, "/lossy")
    await until(lambda: peer.do("publish", "/lossy", "x") or listener.texts)
    assert not listener.source.latched


@pytest_twisted.ensureDeferred
async def test_publisher_that_changes_its_mind_is_followed(ros: Ros2Platform, peer: Peer) -> None:
    """A node that publishes a topic anew with another quality of service is heard, though the graph looks as before."""
    peer.do("advertise", "/mind", "reliable")
    await seen(ros, lambda graph: "/mind" in graph.topics)
    listener = Listener(ros, "/mind")
    assert not listener.source.latched
    peer.do("unadvertise", "/mind")
    peer.do("advertise", "/mind", "latched")
    peer.do("publish", "/mind", "kept")
    await until(lambda: ros.graph() and listener.source.latched and "kept" in listener.texts)


@pytest_twisted.ensureDeferred
async def test_publishers_are_looked_at_when_there_is_a_reason(
    ros: Ros2Platform, peer: Peer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While the graph stays as it is, what the publishers of a topic offer is asked for in every third look only."""
    peer.do("advertise", "/steady", "reliable")
    await seen(ros, lambda graph: "/steady" in graph.topics)
    listener = Listener(ros, "/steady")
    asked = list[int]()
    monkeypatch.setattr(listener.source, "refresh", lambda: asked.append(1))
    for _ in range(2 * LOOK_EVERY):
        ros.graph()
    assert len(asked) == 2


@pytest_twisted.ensureDeferred
async def test_topic_that_comes_later_is_followed(ros: Ros2Platform, peer: Peer) -> None:
    """A topic subscribed before it exists is delivered when it appears, with the quality its publisher has."""
    listener = Listener(ros, "/later", STRING)
    assert listener.source.publishers == 0
    peer.do("advertise", "/later", "latched")
    peer.do("publish", "/later", "kept")
    await until(lambda: ros.graph() and listener.texts)
    assert listener.texts == ["kept"]
    assert listener.source.latched
    assert listener.changes > 0


@pytest_twisted.ensureDeferred
async def test_closed_subscription_is_silent(ros: Ros2Platform, peer: Peer) -> None:
    """After its end a subscription delivers nothing, whatever was under way."""
    peer.do("advertise", "/ending")
    await seen(ros, lambda graph: "/ending" in graph.topics)
    listener = Listener(ros, "/ending")
    await until(lambda: peer.do("publish", "/ending", "x") or listener.texts)
    listener.source.close()
    count = len(listener.bodies)
    peer.do("publish", "/ending", "y")
    await task.deferLater(reactor, 0.2)
    assert len(listener.bodies) == count


@pytest_twisted.ensureDeferred
async def test_published_bytes_arrive(ros: Ros2Platform, peer: Peer) -> None:
    """CDR bytes published as they are reach another node as the message they are."""
    peer.do("listen", "/cmd_vel", "twist")
    sink = ros.advertise("/cmd_vel", TWIST, False, None)
    command = Twist()
    command.linear.x = 0.25
    await until(lambda: sink.publish(bytes(serialize_message(command))) or peer.heard("/cmd_vel"))
    assert peer.heard("/cmd_vel")[0]["x"] == 0.25
    sink.close()


@pytest_twisted.ensureDeferred
async def test_last_message_survives_its_publisher(ros: Ros2Platform, peer: Peer) -> None:
    """What was published just before the publisher was taken away still arrives: it may be a stop."""
    peer.do("listen", "/farewell", "twist")
    sink = ros.advertise("/farewell", TWIST, False, None)
    command = Twist()
    command.linear.x = 1.0
    await until(lambda: sink.publish(bytes(serialize_message(command))) or peer.heard("/farewell"))
    sink.publish(ros.zero(TWIST))
    sink.close()
    await until(lambda: peer.heard("/farewell")[-1]["x"] == 0.0)


@pytest_twisted.ensureDeferred
async def test_latching_publisher_is_heard_late(ros: Ros2Platform, peer: Peer) -> None:
    """What a client publishes with latch waits for later subscribers that want it."""
    sink = ros.advertise("/from_client", STRING, True, None)
    sink.publish(bytes(serialize_message(String(data="kept"))))
    peer.do("advertise", "/marker")
    await seen(ros, lambda graph: "/marker" in graph.topics)
    listener = Listener(
        ros, "/from_client", STRING, link.QoS(durability="transient_local", reliability="reliable")
    )
    await until(lambda: listener.texts)
    assert listener.texts == ["kept"]


@pytest_twisted.ensureDeferred
async def test_service_is_called(ros: Ros2Platform, peer: Peer) -> None:
    """A call carries its request there and its answer back."""
    peer.do("serve", "/invert", "invert")
    await seen(ros, lambda graph: "/invert" in graph.services)
    request = bytes(serialize_message(SetBool.Request(data=True)))
    answer = deserialize_message(await ros.call("/invert", "std_srvs/SetBool", request, 10), SetBool.Response)
    assert (answer.success, answer.message) == (False, "inverted")


async def failure(call: Any) -> SwitchboardError:
    try:
        await call
    except SwitchboardError as error:
        return error
    raise AssertionError("the call was answered")


@pytest_twisted.ensureDeferred
async def test_calls_that_can_not_be_answered_end_in_words(ros: Ros2Platform, peer: Peer) -> None:
    """No such service, another type, senseless arguments, no answer in time: each is told in words, soon."""
    peer.do("serve", "/slow", "slow")
    peer.do("serve", "/invert2", "invert")
    await seen(ros, lambda graph: "/slow" in graph.services and "/invert2" in graph.services)
    empty = bytes(serialize_message(Trigger.Request()))
    assert isinstance(await failure(ros.call("/nowhere", TRIGGER, empty, 30)), NotFound)
    assert "std_srvs/srv/SetBool" in str(await failure(ros.call("/invert2", TRIGGER, empty, 30)))
    assert isinstance(await failure(ros.call("/invert2", "std_srvs/srv/SetBool", b"", 30)), Invalid)
    assert isinstance(await failure(ros.call("bad name", TRIGGER, empty, 30)), Invalid)
    late = await failure(ros.call("/slow", TRIGGER, empty, 0.3))
    assert isinstance(late, Unavailable)
    assert "0.3 s" in str(late)


@pytest_twisted.ensureDeferred
async def test_service_that_vanishes_is_not_waited_for(ros: Ros2Platform, peer: Peer) -> None:
    """A call under way to a service that is taken away ends long before its timeout."""
    peer.do("serve", "/doomed", "slow")
    await seen(ros, lambda graph: "/doomed" in graph.services)
    call = ros.call("/doomed", TRIGGER, bytes(serialize_message(Trigger.Request())), 600)
    await task.deferLater(reactor, 0.3)
    peer.do("unserve", "/doomed")
    assert isinstance(await failure(call), SwitchboardError)


@pytest_twisted.ensureDeferred
async def test_what_is_not_there_is_said(ros: Ros2Platform, peer: Peer) -> None:
    """Unknown topics, types and names, and a second type for a topic, are refused in words."""
    peer.do("advertise", "/typed")
    await seen(ros, lambda graph: "/typed" in graph.topics)
    with pytest.raises(NotFound, match="/nothing"):
        Listener(ros, "/nothing")
    with pytest.raises(NotFound, match="no_such_pkg"):
        Listener(ros, "/new", "no_such_pkg/msg/Thing")
    with pytest.raises(Invalid, match=r"std_msgs/msg/String.*not geometry_msgs"):
        Listener(ros, "/typed", TWIST)
    with pytest.raises(Invalid, match=r"std_msgs/msg/String.*not geometry_msgs"):
        ros.advertise("/typed", TWIST, False, None)
    with pytest.raises(Invalid, match="no topic name"):
        ros.advertise("/not a name", TWIST, False, None)
    with pytest.raises(Invalid, match="reliability"):
        Listener(ros, "/typed", STRING, link.QoS(reliability="somewhat"))
    with pytest.raises(NotFound, match="std_msgs/msg/Nothing"):
        ros.definition("std_msgs/msg/Nothing")


def publishers(ros: Ros2Platform, topic: str) -> list[str]:
    return [each.node_name for each in ros._node.get_publishers_info_by_topic(topic)]


@pytest_twisted.ensureDeferred
async def test_own_publishers_and_the_guards_do_not_decide_the_type(ros: Ros2Platform, peer: Peer) -> None:
    """What a client advertised with the wrong type, and its guard with it, does not keep the right one out."""
    context = rclpy.Context()
    rclpy.init(context=context)
    guard = rclpy.create_node("switchboard_guard_test", context=context)
    try:
        sink = ros.advertise("/base", STAMPED, False, None)
        assert ros.resolve("/base", "") == TypedTopic("/base", STAMPED)
        guard.create_publisher(TwistStamped, "/base", 10)
        await until(lambda: "switchboard_guard_test" in publishers(ros, "/base"))
        sink.close()
        peer.do("listen", "/base", "twist")
        await until(lambda: ros._node.get_subscriptions_info_by_topic("/base"))
        assert ros.resolve("base", "geometry_msgs/Twist") == TypedTopic("/base", TWIST)
        right = ros.advertise("/base", TWIST, False, None)
        await until(lambda: right.publish(ros.zero(TWIST)) or peer.heard("/base"))
        with pytest.raises(Invalid, match=r"geometry_msgs/msg/Twist on this robot"):
            ros.advertise("/base", STAMPED, False, None)
        right.close()
    finally:
        guard.destroy_node()
        rclpy.try_shutdown(context=context)


def test_publisher_that_could_block_is_refused(ros: Ros2Platform) -> None:
    """A publisher that keeps all would make the daemon wait for its slowest subscriber; it is refused in words."""
    with pytest.raises(Invalid, match="keep_last"):
        ros.advertise("/all", STRING, False, link.QoS(history="keep_all"))


@pytest.mark.parametrize(
    ("queue_size", "latch", "qos", "depth"),
    [
        (0, False, None, 100),
        (-3, False, None, 100),
        (1, False, None, 1),
        (250, False, None, 250),
        (10**30, False, None, 10_000),
        (250, False, link.QoS(depth=7), 7),
        (250, True, None, 1),
        (250, True, link.QoS(depth=7), 7),
        (250, False, MOTION_QOS, 1),
    ],
)
def test_queue_of_a_publisher_is_as_deep_as_asked(
    ros: Ros2Platform, queue_size: int, latch: bool, qos: link.QoS | None, depth: int
) -> None:
    """Within bounds; a depth in the quality of service counts more, and what is latched is the last one alone."""
    sink = ros.advertise("/queue", STRING, latch, qos, queue_size)
    assert sink.publisher.qos_profile.depth == depth
    sink.close()


def test_refusal_of_ros_names_no_file(ros: Ros2Platform, monkeypatch: pytest.MonkeyPatch) -> None:
    """The reason is told, without where ROS was built."""

    def refuse(*args: Any, **more: Any) -> None:
        raise RuntimeError("incompatible type, at /project/src/rcl/publisher.cpp:145")

    monkeypatch.setattr(ros._node, "create_publisher", refuse)
    with pytest.raises(Invalid, match=r"as std_msgs/msg/String: incompatible type$"):
        ros.advertise("/refused", STRING, False, None)


@pytest_twisted.ensureDeferred
async def test_graph_has_others_and_not_us(ros: Ros2Platform, peer: Peer) -> None:
    """The graph names the ends of every topic and service, without our own node and what it alone made."""
    peer.do("advertise", "/theirs")
    Listener(ros, "/ours", STRING)
    Listener(ros, "/theirs", STRING)
    graph = await seen(ros, lambda graph: "/theirs" in graph.topics)
    assert graph.topics["/theirs"] == link.Topic(types=[STRING], publishers=["/robot/peer"])
    assert "/ours" not in graph.topics
    assert graph.nodes == {"/robot/peer"}
    providers = graph.services["/robot/peer/list_parameters"].providers
    assert providers == ["/robot/peer"]
    assert not [name for name in [*graph.topics, *graph.services] if "switchboard" in name or "/_" in name]


@pytest_twisted.ensureDeferred
async def test_graph_forgets_what_is_gone(ros: Ros2Platform, peer: Peer) -> None:
    """A topic whose last end went is out of the graph."""
    peer.do("advertise", "/brief")
    await seen(ros, lambda graph: "/brief" in graph.topics)
    peer.do("unadvertise", "/brief")
    await seen(ros, lambda graph: "/brief" not in graph.topics)


@pytest_twisted.ensureDeferred
async def test_battery_is_found(ros: Ros2Platform, peer: Peer) -> None:
    """The first battery topic of the graph gives the charge."""
    assert ros.battery() is None
    peer.do("battery", "/battery_state", 0.75)
    await until(lambda: ros.graph() and ros.battery() is not None)
    assert ros.battery() == pytest.approx(0.75)


def test_malformed_battery_sample_is_no_charge(ros: Ros2Platform, monkeypatch: pytest.MonkeyPatch) -> None:
    """A battery message that is none is passed over."""
    monkeypatch.setattr(ros._battery, "_sample", b"\0\1\0\0\xff")
    assert ros.battery() is None


def test_definition_has_all_parts_and_hash(ros: Ros2Platform) -> None:
    """A definition from the installed files holds every contained type, and the distribution's hash."""
    found = ros.definition(STAMPED)
    for part in (
        "std_msgs/Header",
        "builtin_interfaces/Time",
        "geometry_msgs/Twist",
        "geometry_msgs/Vector3",
    ):
        assert f"MSG: {part}\n" in found.text
    assert found.hash.startswith("RIHS01_")
    assert ros.definition(TRIGGER).text.startswith("---\nbool success")


def test_introspection_says_the_same_as_the_file(ros: Ros2Platform) -> None:
    """Where a robot has no .msg files, the class gives the same fields in the same order."""
    from rcl_interfaces.msg import ParameterDescriptor
    from sensor_msgs.msg import BatteryState, Image

    assert introspected(Twist, "msg") == "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n"
    assert "uint8[] data\n" in introspected(Image, "msg")
    assert "POWER_SUPPLY_STATUS_FULL=4\n" in introspected(BatteryState, "msg")
    assert "rcl_interfaces/FloatingPointRange[<=1] floating_point_range\n" in introspected(
        ParameterDescriptor, "msg"
    )
    assert introspected(Trigger, "srv") == "---\nbool success\nstring message\n"


def test_commands_are_judged(ros: Ros2Platform) -> None:
    """Zero stands, anything else moves, NaN and garbage are no commands; a header does not move."""
    moving, nan, stamped = Twist(), Twist(), TwistStamped()
    moving.angular.z = -0.1
    nan.linear.x = float("nan")
    stamped.header.stamp.sec = 5
    stamped.header.frame_id = "base"
    assert ros.judge(TWIST, bytes(serialize_message(Twist()))) is Motion.STILL
    assert ros.judge(TWIST, bytes(serialize_message(moving))) is Motion.MOVING
    assert ros.judge(TWIST, bytes(serialize_message(nan))) is Motion.INVALID
    assert ros.judge(TWIST, b"garbage") is Motion.INVALID
    assert ros.judge(STAMPED, bytes(serialize_message(stamped))) is Motion.STILL


def test_zero_is_stamped_now(ros: Ros2Platform) -> None:
    """The stop of a stamped command has the present in its header."""
    zero = deserialize_message(ros.zero(STAMPED), TwistStamped)
    assert abs(zero.header.stamp.sec - time.time()) < 5
    assert ros.judge(STAMPED, ros.zero(STAMPED)) is Motion.STILL


@pytest_twisted.ensureDeferred
async def test_stuck_executor_is_noticed(ros: Ros2Platform, monkeypatch: pytest.MonkeyPatch) -> None:
    """An executor that serves no callbacks is told in words; one that does is no trouble."""
    await task.deferLater(reactor, 1.2)
    assert ros.trouble() is None
    monkeypatch.setattr(ros._nodes.main, "_clock", lambda: time.monotonic() + 60)
    assert "served nothing" in str(ros.trouble())


def test_facts_name_the_distribution(ros: Ros2Platform) -> None:
    """The description names platform and distribution."""
    facts = ros.facts()
    assert facts.platform == "ros2"
    assert facts.distro
    assert facts.extra["rmw"].startswith("rmw_")
