"""Topics from the robot: one uplink, many listeners."""

from __future__ import annotations

import cbor2

from relay_protocol import link
from relay_protocol.rights import Level
from relay_server.channels import client_subscription as listener_module
from relay_server.channels import topics as module
from relay_server.channels.subscriptions import LOOK_SECONDS
from tests.relay_server.channel.watching import counting, heard, watching
from tests.relay_server.memory import GRAPH, STRING, World, text


def test_one_uplink_serves_everyone_and_ends_with_the_last(world: World) -> None:
    """The robot sends once, whoever watches."""
    number, people = watching(world, {}, {}, {"topic": "chatter"})
    assert len(world.link.all(link.Subscribe)) == 1
    assert world.link.all(link.GetType) == []
    world.channel.sample(number, text("hi"))
    assert [person.hears("publish")[0]["topic"] for person in people] == ["/chatter", "/chatter", "chatter"]
    people[0].says("unsubscribe", topic="/chatter")
    people[1].session.end()
    assert not world.link.all(link.Unsubscribe)
    people[2].says("unsubscribe", topic="/chatter")
    assert world.link.all(link.Unsubscribe) == [link.Unsubscribe(number=number)]
    world.channel.sample(number, text("on its way already"))
    assert not people[2].hears("publish")


def test_the_robot_throttles_by_the_least_that_satisfies_everyone(world: World) -> None:
    """Changed when clients come, go, or ask for another rate."""
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
    """Who has a throttle and a queue needs every sample; what does not fit is counted as dropped."""
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
    assert person.session.listening.drops() == {"/chatter": 1}
    assert person.session.outbox.dropped == 1
    came = []
    for _ in range(4):
        came.append(heard(person))
        world.clock.advance(0.1)
    assert came == [["a"], ["c"], ["d"], []]


def test_a_throttle_keeps_the_last_of_a_burst(world: World) -> None:
    """The first passes, the newest waits and is sent at the end."""
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
    """What waited under the longer throttle is older than what passes now, and does not come after it."""
    number, (person,) = watching(world, {"throttle_rate": 1000, "id": "a"})
    world.channel.sample(number, text("1"))
    world.channel.sample(number, text("2"))
    person.says("subscribe", topic="/chatter", id="b")
    world.channel.sample(number, text("3"))
    world.clock.advance(5)
    assert heard(person) == ["1", "3"]


def test_a_listener_who_leaves_takes_its_timer_along(world: World) -> None:
    """Nothing is sent late, nothing stays behind."""
    number, (person,) = watching(world, {"throttle_rate": 1000})
    world.channel.sample(number, text("1"))
    world.channel.sample(number, text("2"))
    person.says("unsubscribe", topic="/chatter")
    timers = [call.func for call in world.clock.getDelayedCalls()]
    assert not any(getattr(each, "__name__", "") == "_due" for each in timers)
    world.clock.advance(2)
    assert heard(person) == ["1"]


def test_absurd_numbers_of_one_client_hurt_nobody(world: World) -> None:
    """Throttles and queues are taken within reason, whatever is written."""
    number, (odd, other) = watching(
        world,
        {"throttle_rate": 1e300, "queue_length": -3},
        {"throttle_rate": 1e300, "queue_length": -(10**30)},
    )
    assert world.link.all(link.Subscribe)[0].throttle_ms == listener_module.THROTTLE_SECONDS * 1000
    odd.session.pause()
    other.says("subscribe", topic="/chatter", throttle_rate=-5, id=10**30)
    for word in ("a", "b"):
        world.channel.sample(number, text(word))
    assert heard(other) == ["a", "b"]


def test_subscriptions_of_one_client_to_one_topic_are_bounded(world: World) -> None:
    """By id they could fill the memory; the refused one has no effect."""
    _, (person,) = watching(world, {"throttle_rate": 100, "id": "first"})
    person.says("set_level", level="error")
    for number in range(listener_module.ASKS):
        person.says("subscribe", topic="/chatter", throttle_rate=100, id=number)
    assert "at most 64" in person.hears("status")[0]["msg"]
    assert person.session.listening._listeners["/chatter"].throttle == 0.1


def test_late_joiners_get_the_latched_samples_of_every_publisher(world: World) -> None:
    """As many as publish; samples that are not latched are not repeated."""
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
    """Then they get the latched sample they have missed, once; with its last value held it comes at once."""
    number, (first,) = watching(world, {})
    world.subscribed(number, latched=True, publishers=1)
    world.channel.sample(number, text("a"))
    assert heard(first) == ["a"]
    silent = link.Inhibited(resource="/chatter", ms=900, by="olga")
    world.robot.safety = link.Safety(inhibited=[silent])
    late, gone, third = world.person(), world.person(), world.person()
    for each in (late, gone):
        each.says("subscribe", topic="/chatter")
    world.clock.advance(LOOK_SECONDS)
    assert heard(late) == []
    gone.says("unsubscribe", topic="/chatter")
    world.robot.safety = link.Safety()
    world.clock.advance(LOOK_SECONDS)
    assert [heard(each) for each in (first, late, gone)] == [[], ["a"], []]
    world.robot.safety = link.Safety(inhibited=[silent])
    third.says("subscribe", topic="/chatter")
    world.robot.safety = link.Safety()
    world.channel.sample(number, text("b"))
    world.clock.advance(LOOK_SECONDS)
    assert [heard(each) for each in (late, third)] == [["b"], ["a", "b"]]
    world.robot.safety = link.Safety(inhibited=[link.Inhibited(resource="/chatter", ms=900, hold=True)])
    held = world.person()
    held.says("subscribe", topic="/chatter")
    assert heard(held) == ["b"]


def test_latched_samples_do_not_outlive_the_link(world: World) -> None:
    """What a robot said before it was lost is not what it says now."""
    number, _ = watching(world, {})
    world.subscribed(number, latched=True, publishers=1)
    world.channel.sample(number, text("old"))
    world.robot_goes()
    world.working()
    late = world.person()
    late.says("subscribe", topic="/chatter")
    assert heard(late) == []


def test_what_is_kept_of_one_topic_is_bounded_in_bytes(world: World) -> None:
    """Large latched samples, and samples whose type never comes, cost a bounded memory."""
    world.robot_comes()
    person = world.person()
    world.robot_joins()
    person.says("subscribe", topic="/chatter")
    number = world.link.all(link.Subscribe)[0].number
    world.subscribed(number, latched=True, publishers=64)
    uplink = world.channel.subscriptions._numbers[number]
    for _ in range(5):
        world.channel.sample(number, bytes(module.KEPT_BYTES // 3))
    assert 0 < sum(each.size for each in uplink._untyped) <= module.KEPT_BYTES
    world.define()
    for _ in range(5):
        world.channel.sample(number, text("x" * (module.KEPT_BYTES // 3)))
    assert 0 < uplink.kept.size <= module.KEPT_BYTES


def test_samples_that_come_before_their_type_are_handed_on_after_it(world: World) -> None:
    """In order, and the type is asked for once, whoever wants it."""
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
    """Its samples are written anew, so that only well-formed JSON goes out."""
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
    assert [message["msg"] for message in person.hears("publish")] == [{"data": "hi"}]


def test_a_sample_that_can_not_be_converted_is_let_go(world: World) -> None:
    """Junk from the robot reaches nobody, and what comes after it does."""
    number, (person,) = watching(world, {})
    for body in (b"", b"\x00\x01\x00\x00\xff\xff\xff\x7f", b"\x99" * 50):
        world.channel.sample(number, body)
    world.channel.sample(number, text("fine"))
    assert heard(person) == ["fine"]


def test_a_sample_nobody_takes_is_not_converted(world: World) -> None:
    """Under a throttle only what is sent costs anything."""
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
    """Another one is an error in words; ROS 1 spelling is the same type."""
    _, (person,) = watching(world, {"type": "std_msgs/String"})
    person.says("set_level", level="error")
    person.says("subscribe", topic="/chatter", type="std_msgs/Bool", id="x")
    (told,) = person.hears("status")
    assert told["msg"] == f"topic /chatter has the type {STRING}, not std_msgs/msg/Bool"
    assert told["id"] == "x"


def test_a_topic_to_come_needs_a_type(world: World) -> None:
    """With one the robot is asked at once; without, the error says what to do."""
    _, (person,) = watching(world, {})
    person.says("set_level", level="error")
    person.says("subscribe", topic="/later")
    assert person.hears("status")[0]["msg"] == "topic /later does not exist; give its type to wait for it"
    person.says("subscribe", topic="/later", type="std_msgs/String")
    assert world.link.all(link.Subscribe)[-1].topic == "/later"
    assert world.channel.wire.names == 2


def test_while_the_robot_is_away_types_may_come_later(world: World) -> None:
    """A subscription waits for the graph, and goes on when the topic appears."""
    person = world.person()
    person.says("subscribe", topic="/later")
    world.working()
    assert not world.link.all(link.Subscribe)
    world.registry.graph(world.robot, link.Graph(topics={"/later": link.Topic(types=[STRING])}))
    assert [(ask.topic, ask.type) for ask in world.link.all(link.Subscribe)] == [("/later", STRING)]


def test_failures_are_told_and_tried_again_when_the_graph_changes(world: World) -> None:
    """To everyone who waits for the topic."""
    number, (person,) = watching(world, {})
    person.says("set_level", level="error")
    world.channel.message(link.Failed(what="subscribe", ref=str(number), reason="no such type here"))
    assert person.hears("status")[0]["msg"] == "subscribe /chatter: no such type here"
    world.registry.graph(world.robot, GRAPH)
    assert len(world.link.all(link.Subscribe)) == 2


def test_a_type_the_robot_can_not_define_is_told(world: World) -> None:
    """In the robot's words."""
    person = world.at_work()
    person.says("subscribe", topic="/chatter")
    world.channel.message(link.Failed(what="get_type", ref=STRING, reason="not installed"))
    assert person.hears("status")[0]["msg"] == "subscribe /chatter: not installed"


def test_a_failure_is_told_once_for_each_subscription(world: World) -> None:
    """With its id: not again when the robot refuses the topic besides its type, but to who asks later or anew."""
    number, (person,) = watching(world, {"topic": "/chatter", "id": "a"})
    person.says("set_level", level="error")
    person.says("subscribe", topic="/chatter", id="b")

    def failing() -> list[tuple[str, str]]:
        world.channel.message(link.Failed(what="get_type", ref=STRING, reason="not installed"))
        world.channel.message(link.Failed(what="subscribe", ref=str(number), reason="no such type"))
        return [(each["msg"], each["id"]) for each in person.hears("status")]

    words = "subscribe /chatter: not installed"
    assert failing() == [(words, "a"), (words, "b")]
    world.registry.graph(world.robot, GRAPH)
    assert failing() == []
    person.says("subscribe", topic="/chatter", id="c")
    person.says("subscribe", topic="/chatter", id="a")
    assert sorted(failing()) == [(words, "a"), (words, "c")]
    world.subscribed(number)
    world.channel.message(link.Failed(what="get_type", ref=STRING, reason="not installed"))
    assert not person.told()
    person.says("subscribe", topic="/chatter", id=4)
    assert [each["id"] for each in person.hears("status")] == [4]


def test_a_failure_after_the_robot_was_away_is_news(world: World) -> None:
    """It is told again, once."""
    number, (person,) = watching(world, {"id": "a"})
    person.says("set_level", level="error")
    for _ in range(2):
        for _ in range(2):
            world.channel.message(link.Failed(what="subscribe", ref=str(number), reason="no"))
        assert person.told() == ["subscribe /chatter: no"]
        world.robot_goes()
        person.hears("status")
        world.robot_comes()
        world.robot_joins()


def test_answers_of_the_robot_to_nothing_are_let_go(world: World) -> None:
    """Unknown numbers, ids and types do no harm."""
    watching(world, {})
    for message in (
        link.Subscribed(number=99, topic="/x", type=STRING, encoding="cdr"),
        link.Advertised(number=99, topic="/x", type=STRING, encoding="cdr"),
        link.ServiceResponse(id="99", result=True),
        link.TypeDefinition(type="a/msg/B", text="not asked for"),
        link.Failed(what="subscribe", ref="99", reason="?"),
        link.Failed(what="advertise", ref="one", reason="?"),
        link.Failed(what="dance", ref="1", reason="?"),
    ):
        world.channel.message(message)
    world.channel.sample(99, b"?")
    assert not world.robot.types.knows("a/msg/B")


def test_a_topic_comes_under_every_spelling(world: World) -> None:
    """Clients dispatch by the name they subscribed with; the robot sends once."""
    number, (person,) = watching(world, {"topic": "chatter", "id": "a"})
    person.says("subscribe", topic="/chatter", id="b")
    world.channel.sample(number, text("x"))
    assert [message["topic"] for message in person.hears("publish")] == ["chatter", "/chatter"]
    person.says("unsubscribe", topic="chatter", id="a")
    world.channel.sample(number, text("y"))
    assert [message["topic"] for message in person.hears("publish")] == ["/chatter"]
    person.says("unsubscribe", topic="chatter")
    assert len(world.link.all(link.Unsubscribe)) == len(world.link.all(link.Subscribe)) == 1


def test_a_change_of_form_counts_for_what_waits_already(world: World) -> None:
    """The latest compression holds from now on."""
    number, (person,) = watching(world, {"id": "a"})
    person.session.pause()
    world.channel.sample(number, text("x"))
    person.says("subscribe", topic="/chatter", id="b", compression="cbor")
    person.session.resume()
    assert cbor2.loads(person.client.sent.pop())["msg"] == {"data": "x"}
    person.says("unsubscribe", topic="/chatter", id="b")
    world.channel.sample(number, text("y"))
    assert heard(person) == ["y"]
