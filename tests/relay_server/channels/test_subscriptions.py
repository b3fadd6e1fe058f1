"""Topics from the robot: one robot subscription, many client subscriptions."""

from __future__ import annotations

import cbor2

from relay_protocol import link
from relay_protocol.rights import Level
from relay_server.channels import client_subscription as listener_module
from relay_server.channels import robot_subscription as module
from relay_server.channels.subscriptions import INHIBITED_CHECK_SECONDS
from tests.worlds.relay import GRAPH, STRING, World, text
from tests.worlds.topic_viewers import counting, heard, watching


def test_uplink_serves_all_and_ends_with_the_last(world: World) -> None:
    """The robot sends each sample once for all clients."""
    number, people = watching(world, {}, {}, {"topic": "chatter"})
    assert len(world.link.all(link.Subscribe)) == 1
    assert world.link.all(link.GetType) == []
    world.channel.sample(number, text("hi"))
    assert [person.received("publish")[0]["topic"] for person in people] == [
        "/chatter",
        "/chatter",
        "chatter",
    ]
    people[0].says("unsubscribe", topic="/chatter")
    people[1].session.end()
    assert not world.link.all(link.Unsubscribe)
    people[2].says("unsubscribe", topic="/chatter")
    assert world.link.all(link.Unsubscribe) == [link.Unsubscribe(number=number)]
    world.channel.sample(number, text("on its way already"))
    assert not people[2].received("publish")


def test_the_robot_throttles_by_the_least_that_satisfies_everyone(world: World) -> None:
    """The throttle changes when clients join, leave or ask for another rate."""
    number, (slow, quick) = watching(world, {"throttle_rate": 1000}, {"throttle_rate": 200, "id": "a"})
    answer = link.Subscribed(number=number, topic="/chatter", type=STRING, encoding="cdr")
    world.channel.message(answer)
    quick.says("subscribe", topic="/chatter", throttle_rate=50, id="b")
    world.channel.message(answer)
    quick.says("unsubscribe", topic="/chatter", id="b")
    world.channel.message(answer)
    quick.says("unsubscribe", topic="/chatter")
    world.channel.message(answer)
    slow.says("subscribe", topic="/chatter", throttle_rate=0, id="c")
    assert [ask.throttle_ms for ask in world.link.all(link.Subscribe)] == [1000, 200, 50, 200, 1000, 0]
    assert len({ask.number for ask in world.link.all(link.Subscribe)}) == 1


def test_the_robot_does_not_thin_out_what_is_to_be_queued(world: World) -> None:
    """A client with a throttle and a queue needs every sample; those beyond the queue are counted as dropped."""
    ask = {"throttle_rate": 100, "queue_length": 2, "id": "queue"}
    number, (person,) = watching(world, {"throttle_rate": 100})
    person.says("subscribe", topic="/chatter", **ask)
    world.subscribed(number)
    person.says("unsubscribe", topic="/chatter", id="queue")
    world.subscribed(number)
    person.says("subscribe", topic="/chatter", **ask)
    assert [each.throttle_ms for each in world.link.all(link.Subscribe)] == [100, 0, 100, 0]
    for word in ("a", "b", "c", "d"):
        world.channel.sample(number, text(word))
    assert person.context.port.drops_by_topic == {"/chatter": 1}
    assert person.rosbridge.send_queue.dropped == 1
    came = []
    for _ in range(4):
        came.append(heard(person))
        world.clock.advance(0.1)
    assert came == [["a"], ["c"], ["d"], []]


def test_a_throttle_keeps_the_last_of_a_burst(world: World) -> None:
    """The first sample passes; the newest waits and is sent at the end."""
    number, (person,) = watching(world, {"throttle_rate": 100})
    for word in ("a", "b", "c"):
        world.channel.sample(number, text(word))
    assert heard(person) == ["a"]
    world.clock.advance(0.1)
    assert heard(person) == ["c"]
    world.clock.advance(1)
    assert heard(person) == []
    world.channel.sample(number, text("d"))
    assert heard(person) == ["d"]


def test_no_sample_overtakes_another_when_the_throttle_is_lifted(world: World) -> None:
    """The waiting sample is older than the one that passes now and is discarded."""
    number, (person,) = watching(world, {"throttle_rate": 1000, "id": "a"})
    world.channel.sample(number, text("1"))
    world.channel.sample(number, text("2"))
    person.says("subscribe", topic="/chatter", id="b")
    world.channel.sample(number, text("3"))
    world.clock.advance(5)
    assert heard(person) == ["1", "3"]


def test_the_timer_of_a_subscription_ends_with_it(world: World) -> None:
    number, (person,) = watching(world, {"throttle_rate": 1000})
    world.channel.sample(number, text("1"))
    world.channel.sample(number, text("2"))
    person.says("unsubscribe", topic="/chatter")
    timers = [call.func for call in world.clock.getDelayedCalls()]
    assert not any(getattr(each, "__name__", "") == "_due" for each in timers)
    world.clock.advance(2)
    assert heard(person) == ["1"]


def test_absurd_numbers_of_one_client_harm_no_other(world: World) -> None:
    """Throttles and queue lengths are clamped."""
    number, (odd, other) = watching(
        world,
        {"throttle_rate": 1e300, "queue_length": -3},
        {"throttle_rate": 1e300, "queue_length": -(10**30)},
    )
    assert world.link.all(link.Subscribe)[0].throttle_ms == listener_module.THROTTLE_SECONDS * 1000
    odd.rosbridge.pause()
    other.says("subscribe", topic="/chatter", throttle_rate=-5, id=10**30)
    for word in ("a", "b"):
        world.channel.sample(number, text(word))
    assert heard(other) == ["a", "b"]


def test_subscriptions_of_one_client_to_one_topic_are_bounded(world: World) -> None:
    """Each id costs memory, so there is a limit; the refused subscription has no effect."""
    _, (person,) = watching(world, {"throttle_rate": 100, "id": "first"})
    person.says("set_level", level="error")
    for number in range(listener_module.MAX_REQUESTS):
        person.says("subscribe", topic="/chatter", throttle_rate=100, id=number)
    assert "at most 64" in person.received("status")[0]["msg"]
    assert person.session.subscriptions._by_topic["/chatter"].throttle == 0.1


def test_late_joiners_get_the_latched_samples_of_every_publisher(world: World) -> None:
    """One per publisher; other samples are not repeated."""
    number, (first,) = watching(world, {})
    world.subscribed(number, latched=True, publishers=2)
    for word in ("a", "b", "c"):
        world.channel.sample(number, text(word))
    assert heard(first) == ["a", "b", "c"]
    late = world.person(Level.VIEWER)
    late.says("subscribe", topic="/chatter", throttle_rate=10_000)
    assert heard(late) == ["b", "c"]
    late.says("subscribe", topic="/chatter", id="again")
    assert heard(late) == ["b", "c"]
    late.says("unsubscribe", topic="/chatter", id="again")
    assert heard(late) == []


def test_late_joiners_get_nothing_of_what_is_inhibited_before_that_ends(world: World) -> None:
    """Then they get the missed latched sample once; with ``hold`` they get it at once."""
    number, (first,) = watching(world, {})
    world.subscribed(number, latched=True, publishers=1)
    world.channel.sample(number, text("a"))
    assert heard(first) == ["a"]
    silent = link.Inhibited(resource="/chatter", ms=900, by="olga")
    world.robot.motion_state = link.MotionState(inhibited=[silent])
    late, gone, third = world.person(), world.person(), world.person()
    for each in (late, gone):
        each.says("subscribe", topic="/chatter")
    world.clock.advance(INHIBITED_CHECK_SECONDS)
    assert heard(late) == []
    gone.says("unsubscribe", topic="/chatter")
    world.robot.motion_state = link.MotionState()
    world.clock.advance(INHIBITED_CHECK_SECONDS)
    assert [heard(each) for each in (first, late, gone)] == [[], ["a"], []]
    world.robot.motion_state = link.MotionState(inhibited=[silent])
    third.says("subscribe", topic="/chatter")
    world.robot.motion_state = link.MotionState()
    world.channel.sample(number, text("b"))
    world.clock.advance(INHIBITED_CHECK_SECONDS)
    assert [heard(each) for each in (late, third)] == [["b"], ["a", "b"]]
    world.robot.motion_state = link.MotionState(
        inhibited=[link.Inhibited(resource="/chatter", ms=900, hold=True)]
    )
    held = world.person()
    held.says("subscribe", topic="/chatter")
    assert heard(held) == ["b"]


def test_latched_samples_do_not_outlive_the_link(world: World) -> None:
    """The robot's state may have changed since."""
    number, _ = watching(world, {})
    world.subscribed(number, latched=True, publishers=1)
    world.channel.sample(number, text("old"))
    world.robot_goes()
    world.working()
    late = world.person()
    late.says("subscribe", topic="/chatter")
    assert heard(late) == []


def test_latched_samples_of_a_topic_are_bounded_in_bytes(world: World) -> None:
    """Large latched samples, and samples whose type never arrives, have a limit."""
    world.robot_comes()
    person = world.person()
    world.robot_joins()
    person.says("subscribe", topic="/chatter")
    number = world.link.all(link.Subscribe)[0].number
    world.subscribed(number, latched=True, publishers=64)
    uplink = world.channel.subscriptions.by_number[number]
    for _ in range(5):
        world.channel.sample(number, bytes(module.LATCHED_BYTES // 3))
    assert 0 < sum(each.size for each in uplink._untyped) <= module.LATCHED_BYTES
    world.define()
    for _ in range(5):
        world.channel.sample(number, text("x" * (module.LATCHED_BYTES // 3)))
    assert 0 < uplink.latched_samples.size <= module.LATCHED_BYTES


def test_samples_that_come_before_their_type_are_handed_on_after_it(world: World) -> None:
    """They stay in order, and the type is requested once for all clients."""
    world.robot_comes()
    people = [world.person(), world.person()]
    world.robot_joins()
    people[0].says("subscribe", topic="/chatter")
    people[1].says("subscribe", topic="/secret")
    first, second = (ask.number for ask in world.link.all(link.Subscribe))
    world.subscribed(first)
    world.subscribed(second)
    world.channel.sample(first, text("a"))
    world.channel.sample(first, text("b"))
    world.channel.sample(second, text("c"))
    assert world.link.all(link.GetType) == [link.GetType(type=STRING)]
    world.define()
    assert [heard(person) for person in people] == [["a", "b"], ["c"]]


def test_a_robot_that_speaks_json_needs_no_types(world: World) -> None:
    """Its samples are decoded and encoded again, so that only valid JSON is sent."""
    world.robot_comes(encodings=["json"])
    person = world.person()
    world.robot_joins()
    person.says("subscribe", topic="/chatter")
    number = world.link.all(link.Subscribe)[0].number
    world.subscribed(number, encoding="json")
    assert not world.link.all(link.GetType)
    for body in (
        b'{"data": "hi"}',
        b'{"data": NaN}',
        b"\xff",
        b'{"data":"x"},"op":"status"',
        b"[" * 100,
        b" " * 2**20 + b"1",
    ):
        world.channel.sample(number, body)
    assert [message["msg"] for message in person.received("publish")] == [{"data": "hi"}]


def test_a_sample_that_can_not_be_converted_is_dropped(world: World) -> None:
    """Later samples are delivered."""
    number, (person,) = watching(world, {})
    for body in (b"", b"\x00\x01\x00\x00\xff\xff\xff\x7f", b"\x99" * 50):
        world.channel.sample(number, body)
    world.channel.sample(number, text("fine"))
    assert heard(person) == ["fine"]


def test_a_sample_without_a_receiver_is_not_converted(world: World) -> None:
    """With a throttle only samples that are sent cost time."""
    number, (person,) = watching(world, {"throttle_rate": 1000})
    converted = counting(world, number)
    world.channel.sample(number, text("sent"))
    world.channel.sample(number, text("gives way"))
    world.channel.sample(number, text("waits"))
    assert converted == ["json"]
    world.clock.advance(1)
    assert heard(person) == ["sent", "waits"]
    assert converted == ["json", "json"]


def test_a_topic_has_one_type(world: World) -> None:
    """Another type is an error; the ROS 1 spelling is the same type."""
    _, (person,) = watching(world, {"type": "std_msgs/String"})
    person.says("set_level", level="error")
    person.says("subscribe", topic="/chatter", type="std_msgs/Bool", id="x")
    (reported,) = person.received("status")
    assert reported["msg"] == f"topic /chatter has the type {STRING}, not std_msgs/msg/Bool"
    assert reported["id"] == "x"


def test_a_topic_to_come_needs_a_type(world: World) -> None:
    """With a type the robot is asked at once; without one the error says what to do."""
    _, (person,) = watching(world, {})
    person.says("set_level", level="error")
    person.says("subscribe", topic="/later")
    assert person.received("status")[0]["msg"] == "topic /later does not exist; give its type to wait for it"
    person.says("subscribe", topic="/later", type="std_msgs/String")
    assert world.link.all(link.Subscribe)[-1].topic == "/later"
    assert world.channel.link_state.names_in_use == 2


def test_while_the_robot_is_away_types_may_come_later(world: World) -> None:
    """The subscription waits for the graph."""
    person = world.person()
    person.says("subscribe", topic="/later")
    world.working()
    assert not world.link.all(link.Subscribe)
    world.registry.graph(world.robot, link.Graph(topics={"/later": link.Topic(types=[STRING])}))
    assert [(ask.topic, ask.type) for ask in world.link.all(link.Subscribe)] == [("/later", STRING)]


def test_failures_are_reported_and_retried_when_the_graph_changes(world: World) -> None:
    """Every client that waits for the topic is notified."""
    number, (person,) = watching(world, {})
    person.says("set_level", level="error")
    world.channel.message(link.Failed(request="subscribe", reference=str(number), reason="no such type here"))
    assert person.received("status")[0]["msg"] == "subscribe /chatter: no such type here"
    world.registry.graph(world.robot, GRAPH)
    assert len(world.link.all(link.Subscribe)) == 2


def test_a_type_the_robot_can_not_define_is_reported(world: World) -> None:
    person = world.at_work()
    person.says("subscribe", topic="/chatter")
    world.channel.message(link.Failed(request="get_type", reference=STRING, reason="not installed"))
    assert person.received("status")[0]["msg"] == "subscribe /chatter: not installed"


def test_a_failure_is_reported_once_for_each_subscription(world: World) -> None:
    """The error carries the id. Another reason of the robot is not repeated, but later and repeated requests
    get it.
    """
    number, (person,) = watching(world, {"topic": "/chatter", "id": "a"})
    person.says("set_level", level="error")
    person.says("subscribe", topic="/chatter", id="b")

    def failing() -> list[tuple[str, str]]:
        world.channel.message(link.Failed(request="get_type", reference=STRING, reason="not installed"))
        world.channel.message(link.Failed(request="subscribe", reference=str(number), reason="no such type"))
        return [(each["msg"], each["id"]) for each in person.received("status")]

    words = "subscribe /chatter: not installed"
    assert failing() == [(words, "a"), (words, "b")]
    world.registry.graph(world.robot, GRAPH)
    assert failing() == []
    person.says("subscribe", topic="/chatter", id="c")
    person.says("subscribe", topic="/chatter", id="a")
    assert sorted(failing()) == [(words, "a"), (words, "c")]
    world.subscribed(number)
    world.channel.message(link.Failed(request="get_type", reference=STRING, reason="not installed"))
    assert not person.reported()
    person.says("subscribe", topic="/chatter", id=4)
    assert [each["id"] for each in person.received("status")] == [4]


def test_a_failure_after_the_robot_was_away_is_news(world: World) -> None:
    """The error is reported again, once."""
    number, (person,) = watching(world, {"id": "a"})
    person.says("set_level", level="error")
    for _ in range(2):
        for _ in range(2):
            world.channel.message(link.Failed(request="subscribe", reference=str(number), reason="no"))
        assert person.reported() == ["subscribe /chatter: no"]
        world.robot_goes()
        person.received("status")
        world.robot_comes()
        world.robot_joins()


def test_answers_of_the_robot_without_a_request_are_dropped(world: World) -> None:
    """Unknown numbers, ids and types have no effect."""
    watching(world, {})
    for message in (
        link.Subscribed(number=99, topic="/x", type=STRING, encoding="cdr"),
        link.Advertised(number=99, topic="/x", type=STRING, encoding="cdr"),
        link.ServiceResponse(id="99", result=True),
        link.TypeDefinition(type="a/msg/B", text="not asked for"),
        link.Failed(request="subscribe", reference="99", reason="?"),
        link.Failed(request="advertise", reference="one", reason="?"),
        link.Failed(request="dance", reference="1", reason="?"),
    ):
        world.channel.message(message)
    world.channel.sample(99, b"?")
    assert not world.robot.types.knows("a/msg/B")


def test_a_topic_comes_under_every_spelling(world: World) -> None:
    """Clients dispatch by the name they subscribed with; the robot sends once."""
    number, (person,) = watching(world, {"topic": "chatter", "id": "a"})
    person.says("subscribe", topic="/chatter", id="b")
    world.channel.sample(number, text("x"))
    assert [message["topic"] for message in person.received("publish")] == ["chatter", "/chatter"]
    person.says("unsubscribe", topic="chatter", id="a")
    world.channel.sample(number, text("y"))
    assert [message["topic"] for message in person.received("publish")] == ["/chatter"]
    person.says("unsubscribe", topic="chatter")
    assert len(world.link.all(link.Unsubscribe)) == len(world.link.all(link.Subscribe)) == 1


def test_a_change_of_form_counts_for_what_waits_already(world: World) -> None:
    """The latest compression also applies to samples that wait."""
    number, (person,) = watching(world, {"id": "a"})
    person.rosbridge.pause()
    world.channel.sample(number, text("x"))
    person.says("subscribe", topic="/chatter", id="b", compression="cbor")
    person.rosbridge.resume()
    assert cbor2.loads(person.client.sent.pop())["msg"] == {"data": "x"}
    person.says("unsubscribe", topic="/chatter", id="b")
    world.channel.sample(number, text("y"))
    assert heard(person) == ["y"]
