"""Topics that clients publish to the robot."""

from __future__ import annotations

from typing import Any

import pytest

from relay_protocol import link
from relay_protocol.qos import QoS
from relay_server.channels import publications as module
from tests.worlds.relay import STRING, TRIGGER, TWIST, Person, World, words


def said(world: World) -> list[str]:
    """Strings that the robot received."""
    return [words(body) for _, _, body in world.link.samples]


def test_a_topic_is_advertised_once_and_counted_by_id(world: World) -> None:
    """The publisher ends with the last advertisement."""
    person = world.at_work()
    person.says("advertise", topic="/out", type="std_msgs/String", id="a", latch=True, queue_size=3)
    person.says("advertise", topic="out", type=STRING, id="b")
    (asked,) = world.link.all(link.Advertise)
    assert (asked.topic, asked.type, asked.latch, asked.queue_size) == ("/out", STRING, True, 3)
    person.says("unadvertise", topic="/out", id="a")
    person.says("unadvertise", topic="/out", id="unknown")
    assert not world.link.all(link.Unadvertise)
    person.says("unadvertise", topic="/out", id="b")
    assert world.link.all(link.Unadvertise) == [link.Unadvertise(number=asked.number)]
    assert world.channel.link_state.names_in_use == 0


def test_bounded_qos_reaches_the_robot(world: World) -> None:
    """The options are as the client wrote them; an unlimited queue is refused."""
    person = world.at_work()
    person.says("advertise", topic="/out", type=STRING, queue_size=10**30, qos={"depth": 5})
    (asked,) = world.link.all(link.Advertise)
    assert asked.queue_size == module.QUEUE_SIZE
    assert asked.qos == QoS(depth=5)


@pytest.mark.parametrize("size", [0, -1, -(10**30)])
def test_a_queue_of_nothing_is_the_usual_one(world: World, size: int) -> None:
    """A length below one is no queue and counts as not given."""
    person = world.at_work()
    person.says("advertise", topic="/out", type=STRING, queue_size=size)
    assert world.link.all(link.Advertise)[0].queue_size == module.DEFAULT_QUEUE_SIZE


def test_qos_of_a_first_message_reaches_the_robot(world: World) -> None:
    """As for an advertisement. Later messages, and messages after an advertisement, cannot change it."""
    person = world.at_work()
    person.says("set_level", level="warning")
    wish = {"durability": "transient_local"}
    person.says("publish", topic="/chatter", msg={}, latch=True, queue_size=7, qos=wish)
    person.says("publish", topic="/chatter", msg={}, queue_size=9)
    person.says("advertise", topic="/out", type=STRING, queue_size=3)
    person.says("publish", topic="/out", msg={}, latch=True, queue_size=9)
    first, second = world.link.all(link.Advertise)
    assert (first.latch, first.queue_size, first.qos) == (True, 7, QoS(durability="transient_local"))
    assert (second.latch, second.queue_size, second.qos) == (False, 3, None)
    assert person.reported() == []


def test_options_of_the_first_client_stay(world: World) -> None:
    """They stay when the robot reconnects. A client with other options gets a warning with its id."""
    first, second = world.at_work(), world.person()
    second.says("set_level", level="warning")
    first.says("advertise", topic="/out", type=STRING, queue_size=5, qos={"depth": 2})
    second.says("advertise", topic="/out", type=STRING, id="same")
    assert second.reported() == []
    world.robot_goes()
    second.says("advertise", topic="/out", type=STRING, latch=True, id="latch")
    second.says("advertise", topic="/out", type=STRING, qos={"depth": 3}, id="qos")
    warnings = second.received("status")
    assert [(each["level"], each["id"]) for each in warnings] == [("warning", "latch"), ("warning", "qos")]
    assert warnings[0]["msg"] == "/out is advertised already; its first latch and qos stay"
    world.robot_comes()
    (asked,) = world.robot_joins().all(link.Advertise)
    assert (asked.latch, asked.queue_size, asked.qos) == (False, 5, QoS(depth=2))


LATCHING = [{"latch": True}, {"qos": {"durability": "transient_local"}}]


@pytest.mark.parametrize("options", LATCHING)
def test_each_client_that_latches_has_a_publisher_of_its_own(world: World, options: dict[str, Any]) -> None:
    """So late subscribers get the last message of each, as of several nodes. The others share one."""
    first, second, third, fourth = (world.at_work(), world.person(), world.person(), world.person())
    second.says("set_level", level="warning")
    first.says("advertise", topic="/tf_static", type=STRING, **options)
    second.says("advertise", topic="/tf_static", type=STRING, **options)
    third.says("advertise", topic="/tf_static", type=STRING)
    fourth.says("publish", topic="/tf_static", msg={"data": "4"})
    world.define()
    asked = world.link.all(link.Advertise)
    assert [each.latch or each.qos is not None for each in asked] == [True, True, False]
    for number, person in enumerate((first, second, third)):
        person.says("publish", topic="/tf_static", msg={"data": str(number)})
    numbers = {words(body): number for number, _, body in world.link.samples}
    assert [numbers[each] for each in ("0", "1", "2", "4")] == [
        asked[0].number,
        asked[1].number,
        asked[2].number,
        asked[2].number,
    ]
    assert second.reported() == []
    second.session.end()
    assert world.link.all(link.Unadvertise) == [link.Unadvertise(number=asked[1].number)]
    world.robot_goes()
    world.robot_comes()
    assert len(world.robot_joins().all(link.Advertise)) == 2
    for person in (first, third, fourth):
        person.session.end()
    assert world.channel.link_state.names_in_use == 0


def test_clients_that_command_motion_share_a_publisher(world: World) -> None:
    """Motion is never latched."""
    first, second = world.at_work(), world.person()
    for person in (first, second):
        person.says("advertise", topic="/cmd_vel", type=TWIST, latch=True)
    assert len(world.link.all(link.Advertise)) == 1


def test_unadvertising_what_was_not_advertised_is_warned_of(world: World) -> None:
    """This covers an unknown topic, an unknown id, and another client's topic, which stays advertised."""
    other, person = world.at_work(), world.person()
    person.says("set_level", level="warning")
    other.says("advertise", topic="/theirs", type=STRING, id="a")
    person.says("advertise", topic="/mine", type=STRING, id="a")
    for topic, id in (("/none", "x"), ("/theirs", "a"), ("/theirs", None), ("/mine", "b")):
        person.says("unadvertise", topic=topic, id=id)
    warnings = person.received("status")
    assert [each["level"] for each in warnings] == ["warning"] * 4
    assert [each.get("id") for each in warnings] == ["x", "a", None, "b"]
    assert warnings[0]["msg"] == "unadvertise /none: you have not advertised it"
    assert warnings[3]["msg"] == "unadvertise /mine: you have not advertised it with this id"
    assert not world.link.all(link.Unadvertise)


def publishes_once(world: World) -> Person:
    """A program that sends one message to a robot that has not opened its link yet."""
    world.robot_comes()
    person = world.person()
    person.says("set_level", level="warning")
    person.says("advertise", topic="/out", type=STRING, id="a")
    person.says("publish", topic="/out", msg={"data": "once"})
    person.says("unadvertise", topic="/out", id="a")
    return person


def test_a_message_that_waits_is_sent_after_unadvertise(world: World) -> None:
    """The publisher ends behind it."""
    person = publishes_once(world)
    world.robot_joins()
    assert not world.link.all(link.Unadvertise)
    world.define()
    assert said(world) == ["once"]
    assert world.link.said[-1] == link.Unadvertise(number=world.link.all(link.Advertise)[0].number)
    assert world.channel.link_state.names_in_use == 0
    assert person.reported() == []


def test_a_topic_can_be_advertised_again_while_an_earlier_message_waits(world: World) -> None:
    person = publishes_once(world)
    person.says("advertise", topic="/out", type=STRING, latch=True)
    world.robot_joins()
    world.define()
    assert said(world) == ["once"]
    assert [each.latch for each in world.link.all(link.Advertise)] == [True]
    assert not world.link.all(link.Unadvertise)


@pytest.mark.parametrize("end", ["the client leaves", "the robot goes", "the right ends", "no such type"])
def test_a_message_that_waits_after_unadvertise_is_dropped_at_last(world: World, end: str) -> None:
    person = publishes_once(world)
    if end == "the client leaves":
        person.session.end()
    elif end == "the robot goes":
        world.robot_joins()
        world.robot_goes()
        assert "the robot's link was lost" in person.reported()[-1]
        world.robot_comes()
    elif end == "the right ends":
        person.context.permit.rules = world.permit(deny=("publish:/out",)).rules
        person.context.permit.on_change()
    world.robot_joins()
    if end == "no such type":
        world.channel.message(link.Failed(request="get_type", reference=STRING, reason="unknown"))
        assert "unknown" in person.reported()[-1]
    else:
        world.define()
    assert said(world) == []
    assert world.channel.link_state.names_in_use == 0


def test_json_becomes_cdr_when_the_type_is_known(world: World) -> None:
    """Messages before the definition wait for it, in order."""
    person = world.at_work()
    person.says("advertise", topic="/out", type=STRING)
    person.says("publish", topic="/out", msg={"data": "a"})
    person.says("publish", topic="/out", msg={"data": "b"})
    assert not world.link.samples
    world.define()
    person.says("publish", topic="/out", msg={"data": "c"})
    assert said(world) == ["a", "b", "c"]
    assert {number for number, _, _ in world.link.samples} == {world.link.all(link.Advertise)[0].number}


def test_the_stamp_is_the_moment_before_which_it_was_not_sent(world: World) -> None:
    """The command carries the sending time of the latest answered ping."""
    person = world.at_work()
    person.answers_pings()
    pinged = world.now_ns()
    world.clock.advance(0.05)
    person.says("publish", topic="/chatter", msg={"data": "a"})
    world.define()
    assert [stamp for _, stamp, _ in world.link.samples] == [pinged]


def test_publishing_without_advertising_takes_the_graphs_type(world: World) -> None:
    """Or the type given in the message; otherwise it is unknown."""
    person = world.at_work()
    person.says("publish", topic="/chatter", msg={"data": "x"})
    person.says("publish", topic="/new", type="std_msgs/String", msg={"data": "y"})
    person.says("publish", topic="/nobody/knows", msg={})
    assert [ask.topic for ask in world.link.all(link.Advertise)] == ["/chatter", "/new"]
    assert person.reported() == [
        "topic /nobody/knows does not exist and no type was given; advertise it first"
    ]


def test_types_that_can_not_be_are_refused(world: World) -> None:
    """These are conflicting, missing and invalid types."""
    person = world.at_work()
    person.says("advertise", topic="/chatter", type="std_msgs/Bool")
    person.says("advertise", topic="/new", type="")
    person.says("advertise", topic="/new", type="x" * 10_000)
    person.says("advertise", topic="/new", type="std_msgs/msg/../../String")
    first, second, *others = person.reported()
    assert first == f"topic /chatter has the type {STRING}, not std_msgs/msg/Bool"
    assert second == "topic /new does not exist; advertise it with its type"
    assert all("is not a type name" in each for each in others) and len(others) == 2
    assert not world.link.all(link.Advertise)
    assert world.channel.link_state.names_in_use == 0


def test_messages_of_the_wrong_type_are_reported_and_not_sent(world: World) -> None:
    """The error names topic and field."""
    person = world.at_work()
    person.says("advertise", topic="/out", type=STRING)
    world.define()
    for body in ({"data": 7}, {"dat": "x"}, [1], "text", None):
        person.says("publish", topic="/out", msg=body)
    errors = person.reported()
    assert len(errors) == 5
    assert all(each.startswith("publish /out: ") for each in errors)
    assert "data must be a string" in errors[0]
    assert not world.link.samples


def test_queued_order_is_not_done_when_the_robot_returns(world: World) -> None:
    """This holds whether or not its link was open before."""
    person = world.at_work()
    person.says("publish", topic="/chatter", msg={"data": "before the type"})
    world.robot_goes()
    world.robot_comes()
    person.says("publish", topic="/chatter", msg={"data": "before the link"})
    world.robot_goes()
    world.working()
    world.define()
    assert said(world) == []


def test_command_held_too_long_is_dropped_and_reported(world: World) -> None:
    """A robot whose channel opens late must not receive old commands."""
    world.robot_comes()
    person = world.person()
    person.says("set_level", level="error")
    person.says("publish", topic="/chatter", msg={"data": "old"}, id="p1")
    world.clock.advance(module.QUEUED_SECONDS)
    person.says("publish", topic="/chatter", msg={"data": "new"})
    world.clock.advance(0.5)
    world.robot_joins()
    world.define()
    assert said(world) == ["new"]
    (error,) = person.received("status")
    assert error["id"] == "p1"
    assert "could not be reached in time" in error["msg"]


def test_offline_robot_has_no_queue(world: World) -> None:
    """The publisher gets an error at once."""
    person = world.person()
    person.says("set_level", level="error")
    person.says("advertise", topic="/cmd_vel", type="geometry_msgs/Twist")
    person.says("publish", topic="/cmd_vel", msg={})
    assert person.reported() == ["robot rover is offline; the message was dropped"]
    world.working()
    assert not world.link.samples


def test_a_failed_advertisement_is_reported_to_all_waiting_clients(world: World) -> None:
    """Later messages are refused, and advertising again retries."""
    person = world.at_work()
    person.says("advertise", topic="/out", type=STRING)
    number = world.link.all(link.Advertise)[0].number
    world.channel.message(link.Failed(request="advertise", reference=str(number), reason="no such type"))
    person.says("publish", topic="/out", msg={})
    assert person.reported() == [
        "advertise /out: no such type",
        "the robot could not advertise /out; the message was dropped",
    ]
    person.says("advertise", topic="/out", type=STRING, id="again")
    assert len(world.link.all(link.Advertise)) == 2


def refuse(world: World, reason: str) -> None:
    """The robot refuses the last request."""
    number = world.link.take(link.Advertise)[-1].number
    world.channel.message(link.Failed(request="advertise", reference=str(number), reason=reason))


def graph(world: World, **topics: link.Topic) -> None:
    """Topics of the robot's graph change."""
    changes = {"/" + name: topic for name, topic in topics.items()}
    world.registry.graph(world.robot, link.Graph(topics=changes))


def test_a_failure_is_reported_once_for_each_advertisement_with_its_id(world: World) -> None:
    """The robot is asked again when the topic changes; only a new reason is reported."""
    person, other = world.at_work(), world.person()
    other.says("set_level", level="error")
    person.says("advertise", topic="/out", type=STRING, id="a")
    person.says("advertise", topic="/out", type=STRING, id="b")
    other.says("advertise", topic="/out", type=STRING)
    refuse(world, "no room")
    assert [each["id"] for each in person.received("status")] == ["a", "b"]
    assert other.reported() == ["advertise /out: no room"]
    graph(world, elsewhere=link.Topic(types=[STRING], publishers=["/talker"]))
    assert not world.link.all(link.Advertise)
    graph(world, out=link.Topic(types=[STRING], subscribers=["/base"]))
    refuse(world, "no room")
    assert person.reported() == other.reported() == []
    graph(world, out=link.Topic(types=[STRING], subscribers=["/base", "/logger"]))
    refuse(world, "no memory")
    assert person.reported() == ["advertise /out: no memory"] * 2
    assert other.reported() == ["advertise /out: no memory"]


def test_repeated_advertise_is_answered_and_may_change_options(world: World) -> None:
    """Refused options are not kept, and a new attempt is answered. Each client gets each error once."""
    person, other = world.at_work(), world.person()
    other.says("set_level", level="error")
    person.says("advertise", topic="/out", type=STRING, id="a", qos={"history": "keep_all"})
    other.says("advertise", topic="/out", type=STRING)
    refuse(world, "not keep_all")
    assert other.reported() == person.reported()
    person.says("advertise", topic="/out", type=STRING, id="a", qos={"depth": 4})
    assert world.link.all(link.Advertise)[0].qos == QoS(depth=4)
    refuse(world, "not keep_all")
    assert person.reported() == ["advertise /out: not keep_all"]
    assert other.reported() == []


def test_a_change_that_comes_before_the_refusal_counts(world: World) -> None:
    """The robot may have decided before it saw the change, so it is asked once more."""
    person = world.at_work()
    person.says("advertise", topic="/out", type=STRING)
    asked = world.link.take(link.Advertise)[0]
    graph(world, out=link.Topic(types=[STRING], subscribers=["/base"]))
    world.channel.message(
        link.Failed(request="advertise", reference=str(asked.number), reason="another type")
    )
    refuse(world, "another type")
    assert person.reported() == ["advertise /out: another type"]
    assert not world.link.all(link.Advertise)


def test_failure_after_success_is_reported(world: World) -> None:
    """Even with the same reason as before."""
    person = world.at_work()
    person.says("advertise", topic="/out", type=STRING)
    refuse(world, "no room")
    graph(world, out=link.Topic(types=[STRING], subscribers=["/base"]))
    (asked,) = world.link.all(link.Advertise)
    world.channel.message(link.Advertised(number=asked.number, topic="/out", type=STRING, encoding="cdr"))
    world.robot_goes()
    world.robot_comes()
    world.robot_joins()
    refuse(world, "no room")
    assert person.reported() == ["advertise /out: no room"] * 2


def test_failed_request_is_retried_with_its_type(world: World) -> None:
    """Any client may have made the type known; two refusals of one attempt are reported once."""
    person = world.at_work()
    person.says("advertise", topic="/out", type=STRING)
    world.link.take(link.GetType)
    world.channel.message(link.Failed(request="get_type", reference=STRING, reason="not installed"))
    refuse(world, "no such type")
    assert person.reported() == ["advertise /out: not installed"]
    person.says("subscribe", topic="/chatter")
    world.subscribed(world.link.all(link.Subscribe)[0].number)
    world.define(STRING)
    assert len(world.link.all(link.Advertise)) == 1


def test_a_type_without_definition_fails_its_topics(world: World) -> None:
    """Messages that waited for it are discarded."""
    person = world.at_work()
    person.says("publish", topic="/cmd_vel", msg={})
    world.channel.message(link.Failed(request="get_type", reference=TWIST, reason="not installed"))
    assert person.reported() == ["publish /cmd_vel: not installed", "advertise /cmd_vel: not installed"]
    assert not any(each.queued for each in world.channel.publications._topics["/cmd_vel"])


def test_a_robot_of_json_is_sent_json(world: World) -> None:
    world.robot_comes(encodings=["json"])
    person = world.person()
    world.robot_joins()
    person.says("publish", topic="/chatter", msg={"data": "x"})
    assert [body for _, _, body in world.link.samples] == [b'{"data":"x"}']
    assert not world.link.all(link.GetType)


@pytest.mark.parametrize(
    "body",
    [b"1e999", b"[1]", b'"{"', b"null", b'{"a":-1e999}', b'{"a":[%s]}' % (b"9" * 400), b'{"a":1.8e308}'],
)
def test_a_robot_of_json_gets_objects_with_numbers_that_are_finite(world: World, body: bytes) -> None:
    """Overlong numbers that a parser would read as infinity are refused, although the rest is not decoded."""
    world.robot_comes(encodings=["json"])
    person = world.person()
    person.says("set_level", level="error")
    world.robot_joins()
    person.rosbridge.message(b'{"op":"publish","topic":"/own","type":"a/Own","msg":%s}' % body)
    assert not world.link.samples
    (error,) = person.reported()
    assert error.startswith("publish /own: ")
    person.rosbridge.message(b'{"op":"publish","topic":"/own","type":"a/Own","msg":  {"a" : 1e308}  }')
    assert [sent for _, _, sent in world.link.samples] == [b'{"a" : 1e308}']


OWN = "vendor_msgs/msg/Own"
OWN_TEXT = "int64 whole\nfloat64[] many\nfloat32 one\nuint8[] raw\nstring text\nstd_msgs/Header header\n" + (
    "=" * 80 + "\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
)


@pytest.mark.parametrize(
    ("topic", "type_name", "msg", "reason"),
    [
        ("/cmd_vel", TWIST, '{"linear":{"x":true}}', "linear.x must be a number, not a boolean"),
        ("/cmd_vel", TWIST, '{"linear":{"x":"1"}}', "linear.x must be a number, not a string"),
        ("/cmd_vel", TWIST, '"1"', "must be an object, not a string"),
        ("/cmd_vel", TWIST, "[1]", "must be an object, not an array"),
        ("/cmd_vel", TWIST, '{"linear":{"w":1}}', "linear.w is no field of geometry_msgs/msg/Vector3"),
        ("/own", OWN, '{"whole":9223372036854775808}', "whole is out of range for int64"),
        ("/own", OWN, '{"whole":0.5}', "whole must be an integer, not a fraction"),
        ("/own", OWN, '{"whole":NaN}', "whole must be an integer, not NaN"),
        ("/own", OWN, '{"raw":"?"}', "raw is a string that is not base64"),
        ("/own", OWN, '{"one":1e39}', "one is out of range for float32"),
    ],
)  # fmt: skip
def test_a_robot_of_json_is_sent_nothing_that_is_not_of_the_type(
    world: World, topic: str, type_name: str, msg: str, reason: str
) -> None:
    """Messages are checked by the robot's definition, or by the relay's own of a common type."""
    person = json_robot(world)
    text = f'{{"op":"publish","id":"p","topic":"{topic}","type":"{type_name}","msg":{msg}}}'
    person.rosbridge.message(text.encode())
    tells(world)
    assert person.reported() == [
        f"publish {topic}: {type_name}{'' if reason.startswith('must') else ':'} {reason}"
    ]
    assert not world.link.samples


def test_a_command_is_no_null(world: World) -> None:
    """It is refused before it acquires control."""
    person = json_robot(world)
    person.rosbridge.message(
        f'{{"op":"publish","id":"p","topic":"/cmd_vel","type":"{TWIST}","msg":null}}'.encode()
    )
    tells(world)
    assert person.reported() == ["publish /cmd_vel: the message must be an object, not null"]
    assert not world.link.samples


@pytest.mark.parametrize(
    ("msg", "sent"),
    [
        ('{"whole":9007199254740993, "many":[0.1,1e300,5,1E2]}', None),
        ('{"whole": -9223372036854775808}', None),
        ('{"header":{"stamp":{"secs":1}}, "raw":[1,2]}', None),
        ('{"many":[NaN, -Infinity,1],"one":Infinity,"text":"NaN\\""}',
         '{"many":[null, null,1],"one":null,"text":"NaN\\""}'),
        ("{}", None),
    ],
)  # fmt: skip
def test_a_robot_of_json_is_sent_the_clients_own_words(world: World, msg: str, sent: str | None) -> None:
    """Numbers keep all their digits; NaN and infinity become null, since strict JSON lacks them."""
    person = json_robot(world)
    person.rosbridge.message(f'{{"op":"publish","topic":"/own","type":"{OWN}","msg":{msg}}}'.encode())
    tells(world)
    assert person.reported() == []
    assert [body.decode() for _, _, body in world.link.samples] == [sent or msg]


def test_a_json_robot_without_definitions_gets_messages_unchecked(world: World) -> None:
    """Two seconds later any object is accepted, and no other value."""
    person = json_robot(world)
    person.says("publish", topic="/own", type=OWN, msg={"any": 1})
    assert not world.link.samples
    world.clock.advance(2)
    person.says("publish", topic="/own", type=OWN, msg=[1])
    assert [body for _, _, body in world.link.samples] == [b'{"any": 1}']
    assert person.reported() == ["publish /own: 'msg' must be an object"]


def json_robot(world: World) -> Person:
    """A robot that speaks JSON and sends definitions on request; a client that receives errors."""
    world.robot_comes(encodings=["json"])
    person = world.person()
    person.says("set_level", level="error")
    world.robot_joins(tells_types=True)
    return person


def tells(world: World) -> None:
    """The robot answers with the definition."""
    for asked in world.link.take(link.GetType):
        world.channel.message(link.TypeDefinition(type=asked.type, text={OWN: OWN_TEXT}[asked.type]))


def test_a_robot_that_comes_back_with_another_definition_is_sent_that(world: World) -> None:
    """The former conversion is not used again."""
    person = world.at_work()
    person.says("publish", topic="/chatter", msg={"data": "a"})
    world.define()
    assert said(world) == ["a"]
    world.robot_goes()
    world.robot_comes()
    world.robot_joins()
    for asked in world.link.take(link.GetType):
        world.channel.message(link.TypeDefinition(type=asked.type, text="string text\n"))
    person.says("publish", topic="/chatter", msg={"data": "b"})
    person.says("publish", topic="/chatter", msg={"text": "c"})
    assert said(world) == ["c"]


def test_a_robot_that_comes_back_speaking_otherwise_is_sent_that(world: World) -> None:
    """From CDR to JSON."""
    person = world.at_work()
    person.says("publish", topic="/chatter", msg={"data": "a"})
    world.define()
    assert said(world) == ["a"]
    world.robot_goes()
    world.robot_comes(encodings=["json"])
    world.robot_joins()
    person.says("publish", topic="/chatter", msg={"data": "b"})
    assert [body for _, _, body in world.link.samples] == [b'{"data":"b"}']


def test_advertisements_of_one_client_are_bounded(world: World, monkeypatch: Any) -> None:
    """By topic and by id, so that no client takes the names of all others."""
    monkeypatch.setattr(module, "ADVERTISEMENTS", 5)
    person, other = world.at_work(), world.person()
    for number in range(4):
        person.says("advertise", topic=f"/t{number}", type=STRING)
    for number in range(4):
        person.says("advertise", topic="/t0", type=STRING, id=number)
    assert person.reported() == ["at most 5 advertisements can be held on one connection"] * 3
    assert world.channel.link_state.names_in_use == 4
    other.says("advertise", topic="/mine", type=STRING)
    assert world.channel.link_state.names_in_use == 5


def test_a_command_is_not_held_longer_than_it_is_good(world: World) -> None:
    """The time it waits for a definition counts; an expired command is dropped and reported."""
    person = world.at_work()
    world.robot.description = link.Describe(motion=link.MotionPolicy(types=[TWIST], deadline_ms=500))
    person.says("publish", topic="/cmd_vel", msg={})
    world.clock.advance(0.6)
    world.define(TWIST)
    assert world.link.samples == []
    assert "in time" in person.reported()[0]


NOT_FINITE = {
    '{"linear":{"x":NaN}}': "linear.x must be finite in a command that moves the robot, not NaN",
    '{"angular":{"z":-Infinity}}': "angular.z must be finite in a command that moves the robot, not -Infinity",
    '{"linear":{"x":null}}': "linear.x must be finite in a command that moves the robot, not null",
    '{"linear":{"x":0.1,"y":"\\u0000\\u004eaN"}}': "linear.y must be finite in a command that moves the robot, not NaN",
}


@pytest.mark.parametrize("msg", NOT_FINITE)
@pytest.mark.parametrize("robot", ["cdr", "json", "json without types"])
def test_a_command_has_only_finite_numbers(world: World, robot: str, msg: str) -> None:
    """For every kind of robot; one that speaks JSON would get ``null``, which its code may read as 0."""
    world.robot_comes(encodings=["cdr", "json"] if robot == "cdr" else ["json"])
    person = world.person()
    person.says("set_level", level="error")
    world.robot_joins(tells_types=robot == "json")
    person.says("advertise", topic="/cmd_vel", type=TWIST)
    (asked,) = world.link.all(link.Advertise)
    world.define()
    world.channel.message(
        link.Advertised(
            number=asked.number, topic="/cmd_vel", type=TWIST, encoding=robot.split()[0], motion=True
        )
    )
    person.answers_pings()
    person.rosbridge.message(f'{{"op":"publish","topic":"/cmd_vel","msg":{msg}}}'.encode())
    assert person.reported() == [f"publish /cmd_vel: {NOT_FINITE[msg]}"]
    assert not world.link.commands
    person.rosbridge.message(b'{"op":"publish","topic":"/cmd_vel","msg":{"linear":{"x":0.25}}}')
    assert person.reported() == []
    assert len(world.link.commands) == 1


def test_commands_of_an_unknown_type_are_finite_too(world: World) -> None:
    """Also where only the robot's answer says that the topic moves it; text is no number."""
    world.robot_comes(encodings=["json"])
    world.robot.description = link.Describe()
    person = world.person()
    person.says("set_level", level="error")
    world.robot_joins()
    person.says("advertise", topic="/own", type="a/Own")
    (asked,) = world.link.all(link.Advertise)
    world.channel.message(
        link.Advertised(number=asked.number, topic="/own", type="a/Own", encoding="json", motion=True)
    )
    person.says("publish", topic="/own", msg={"speeds": [{"at": 1}, {"at": None}]})
    assert person.reported() == [
        "publish /own: speeds[1].at must be finite in a command that moves the robot, not null"
    ]
    assert not world.link.commands
    person.says("publish", topic="/own", msg={"frame": "null"})
    assert [body for *_, body in world.link.commands] == [b'{"frame": "null"}']


def test_memory_per_client_is_bounded(world: World) -> None:
    """For any number of topics; further messages are dropped and reported."""
    person = world.at_work()
    for number in range(5):
        person.says("advertise", topic=f"/t{number}", type=STRING)
        person.says("publish", topic=f"/t{number}", msg={"data": "x" * 300_000})
    held = [len(each.queued) for each in world.channel.publications._by_number.values()]
    assert sum(held) == 3
    assert len([words for words in person.reported() if "too much waits" in words]) == 2
    person.session.end()
    assert world.channel.publications._topics == {}


def test_a_service_type_in_place_of_a_topic_type_does_no_harm(world: World) -> None:
    """The robot's link stays open, and the publisher gets an error."""
    graph = link.Graph(full=True, topics={"/odd": link.Topic(types=[TRIGGER], subscribers=["/base"])})
    world.robot_comes(graph=graph)
    person = world.person()
    world.robot_joins()
    person.says("set_level", level="error")
    person.says("publish", topic="/odd", msg={})
    world.define()
    assert "is not known" in person.received("status")[0]["msg"]
    assert world.link.closed is None
