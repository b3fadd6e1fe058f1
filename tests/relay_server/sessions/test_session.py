"""One client on one robot: the rights of every message are checked first."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from relay_protocol import link
from relay_protocol.errors import Invalid, Refused
from relay_protocol.rights import Grant, Level, Rules
from relay_server.access import BadCredentials
from relay_server.channels import subscriptions
from relay_server.channels.names import normal_type
from relay_server.common import close_codes
from relay_server.sessions import service_calls, session, websocket_port
from relay_server.sessions import subscriptions as listening
from tests.worlds.relay import STRING, TEXTS, TWIST, Person, World, text
from tests.worlds.robot_channel_link import RobotLink


def reported(person: Person, level: str = "error") -> list[str]:
    """Statuses of this level."""
    return [each["msg"] for each in person.received("status") if each["level"] == level]


@pytest.mark.parametrize(
    ("op", "fields", "needs"),
    [
        ("subscribe", {"topic": "/chatter"}, Level.VIEWER),
        ("publish", {"topic": "/chatter", "msg": {}}, Level.OPERATOR),
        ("advertise", {"topic": "/chatter", "type": STRING}, Level.OPERATOR),
        ("call_service", {"service": "/reset"}, Level.OPERATOR),
    ],
)
def test_every_operation_is_judged(world: World, op: str, fields: dict[str, Any], needs: Level) -> None:
    """By level, deny and allow patterns; refused operations do not reach the robot."""
    world.robot_comes()
    may = {"subscribe": "subscribe", "call_service": "call"}.get(op, "publish")
    viewer = world.person(Level.VIEWER)
    denied = world.person(Level.OWNER, deny=(f"{may}:/*",))
    allowed = world.person(Level.VIEWER, allow=(f"{may}:/*",))
    world.robot_joins()
    for person, right in ((viewer, needs is Level.VIEWER), (denied, False), (allowed, True)):
        before = len(world.link.said)
        person.says("set_level", level="error")
        person.says(op, id="x", **fields)
        refused = reported(person)
        assert bool(refused) is not right
        assert right or len(world.link.said) == before
        assert person.context.refusals == len(refused)
        person.session.end()


def test_a_refused_call_is_answered_even_at_status_level_none(world: World) -> None:
    """The caller waits for an answer, which has the reason."""
    person = world.person(Level.VIEWER)
    person.says("call_service", service="/reset", id="x")
    (reply,) = person.client.take()
    assert (reply["op"], reply["id"], reply["result"]) == ("service_response", "x", False)
    assert reply["values"] == "call on /reset needs the level operator; you are viewer on this robot"


@pytest.mark.parametrize(
    "wrong", [{"timeout": "x"}, {"fragment_size": "big"}, {"compression": 1}, {"type": []}, {"service": 5}]
)
def test_a_call_that_makes_no_sense_is_answered(world: World, wrong: dict[str, Any]) -> None:
    """A wrong type of a field gives an answer with the reason."""
    person = world.person()
    person.says("call_service", **{"service": "/reset", "id": "x", **wrong})
    (reply,) = person.client.take()
    assert (reply["op"], reply["id"], reply["result"]) == ("service_response", "x", False)
    assert reply["service"] == ("" if "service" in wrong else "/reset")
    assert f"$.{next(iter(wrong))}" in reply["values"]


@pytest.mark.parametrize(
    ("op", "name", "answer"),
    [("call_service", "service", "service_response"), ("send_action_goal", "action", "action_result")],
)
def test_missing_field_is_named(world: World, op: str, name: str, answer: str) -> None:
    """By a status, and with an id also by an answer."""
    person = world.person()
    person.says("set_level", level="error")
    person.says(op)
    (status,) = person.client.take()
    assert (status["op"], status["level"]) == ("status", "error")
    assert f"missing required field `{name}`" in status["msg"]
    person.says(op, id="x")
    reported, reply = person.client.take()
    assert (reported["op"], reported["id"], reported["msg"]) == ("status", "x", status["msg"])
    assert (reply["op"], reply["id"], reply["result"], reply["values"]) == (
        answer,
        "x",
        False,
        reported["msg"],
    )


def test_calls_that_make_no_sense_are_counted(world: World) -> None:
    """Each is answered, and a hundred in a row disconnect the client."""
    person = world.person()
    for _ in range(websocket_port.MAX_MALFORMED):
        assert person.client.closed is None
        person.says("call_service", service="/reset", timeout="x")
    assert person.client.closed is not None
    assert len(person.received("service_response")) == websocket_port.MAX_MALFORMED


def test_a_qos_goes_to_the_robot_in_one_form(world: World) -> None:
    """rosbridge clients write several forms; the robot gets that of the robot link."""
    world.robot_comes()
    person = world.person()
    world.robot_joins()
    qos = {
        "reliability": "BEST_EFFORT",
        "deadline": {"secs": 1, "nsecs": 0},
        "lifespan": "infinite",
        "depth": 3.0,
    }
    person.says("subscribe", topic="/chatter", qos=qos)
    (asked,) = world.link.all(link.Subscribe)
    assert msgspec.to_builtins(asked.qos) == {"reliability": "best_effort", "depth": 3, "deadline": 1}


def test_status_comes_only_when_asked_for(world: World) -> None:
    """Common clients break on an unknown op; each level includes the more severe ones."""
    person = world.person()
    person.says("subscribe", topic="no name!")
    assert not person.client.take()
    heard = {}
    for level in ("info", "warning", "error", "none"):
        person.says("set_level", level=level)
        for kind in ("info", "warning", "error"):
            person.context.notify(kind, "words")
        heard[level] = [each["level"] for each in person.received("status")]
    assert heard == {
        "info": ["info", "warning", "error"],
        "warning": ["warning", "error"],
        "error": ["error"],
        "none": [],
    }


def test_an_unknown_level_is_refused(world: World) -> None:
    """The old one stays."""
    person = world.person()
    person.says("set_level", level="error")
    person.says("set_level", level="loud", id="x")
    (status,) = person.received("status")
    assert status["id"] == "x"
    assert status["msg"] == "level 'loud' is none of info, warning, error, none"


def test_unknown_value_is_refused_with_a_reason(world: World) -> None:
    """Unknown operations and malformed messages."""
    person = world.person()
    person.says("set_level", level="warning")
    person.says("dance")
    person.says("subscribe", topic="/x", type=STRING, compression="zip", fragment_size=1)
    first, second, third = person.received("status")
    assert first["msg"].startswith("unknown op 'dance'")
    assert (second["level"], second["msg"]) == (
        "error",
        "compression 'zip' is none of none, png, cbor, cbor-raw; plain JSON is sent",
    )
    assert (third["level"], third["msg"]) == ("warning", "fragments of 1 bytes are too small; they have 64")


@pytest.mark.parametrize(
    "junk",
    [b"", b"{}", b"[1]", b"\xff", b'{"op":"publish"}', b'{"op":"subscribe","topic":7}', b"[" * 500, b"NaN"],
)
def test_a_hundred_messages_in_a_row_that_are_no_rosbridge_cut_the_client(world: World, junk: bytes) -> None:
    """Ninety-nine do not, and a valid one resets the count."""
    person = world.person()
    for _ in range(websocket_port.MAX_MALFORMED - 1):
        person.rosbridge.message(junk)
    person.says("set_level", level="error")
    for _ in range(websocket_port.MAX_MALFORMED - 1):
        person.rosbridge.message(junk)
    assert person.client.closed is None
    person.rosbridge.message(junk)
    assert person.client.closed is not None
    assert person.client.closed[0] == close_codes.TOO_MANY_ERRORS
    assert not world.people


def test_rosauths_message_is_taken_and_not_used(world: World) -> None:
    """The client is authenticated already."""
    person = world.person()
    person.says("set_level", level="info")
    person.says("auth", mac="x", client="y", dest="z", rand=1, t=2, level="admin", end=3)
    assert not person.client.take()


# --- motion -----------------------------------------------------------------------------------------------


def test_a_motion_command_that_may_be_too_old_is_dropped_counted_and_reported(world: World) -> None:
    """Without a pong the maximum age is too high; after one it passes."""
    world.robot_comes()
    person = world.person()
    world.robot_joins()
    person.says("set_level", level="warning")
    world.clock.advance(0.6)
    person.says("publish", topic="/cmd_vel", msg={}, id="c")
    assert "may be 600 ms old" in reported(person, "warning")[0]
    assert person.context.stale_commands == 1
    person.answers_pings()
    person.says("publish", topic="/cmd_vel", msg={})
    world.define()
    assert len(world.link.samples) == 1
    assert not reported(person, "warning")


def test_the_robot_defines_motion_and_its_deadline(world: World) -> None:
    """By type or topic, with its own deadline; other topics have no age limit."""
    world.robot_comes()
    person = world.person()
    world.robot_joins()
    world.robot.description = link.Describe(motion=link.MotionPolicy(topics=["/chatter"], deadline_ms=2000))
    for name in (STRING, TWIST):
        world.robot.types.add(name, TEXTS[name])
    for advance, topic, stale in ((1.0, "/cmd_vel", 0), (0.9, "/chatter", 0), (0.2, "/chatter", 1)):
        world.clock.advance(advance)
        person.says("publish", topic=topic, msg={})
        assert person.context.stale_commands == stale
    assert len(world.link.samples) == 2


def test_operators_are_pinged_more_often_than_viewers(world: World) -> None:
    """Ten times per second instead of every 2 s; a change of rights changes the rate."""
    driver, viewer = world.person(Level.OPERATOR), world.person(Level.VIEWER)
    allowed = world.person(Level.VIEWER, allow=("publish:/cmd_vel",))
    world.clock.pump([0.1] * 10)
    assert [len(each.client.pings) for each in (driver, viewer, allowed)] == [11, 1, 11]
    driver.context.permit.rules = Rules([Grant(Level.VIEWER)])
    driver.context.permit.on_change()
    world.clock.pump([0.1] * 10)
    assert len(driver.client.pings) <= 13


# --- slow and silent clients ------------------------------------------------------------------------------


def test_a_client_that_takes_nothing_is_cut_after_the_stall_limit(world: World) -> None:
    """With a reason; a client that reads in between is not."""
    person, other = world.person(), world.person()
    for each in (person, other):
        each.rosbridge.pause()
    for second in range(6):
        for _ in range(10):
            world.clock.advance(0.1)
            person.answers_pings()
            other.answers_pings()
        if second == 3:
            other.rosbridge.resume()
            other.rosbridge.pause()
    assert person.client.closed == (close_codes.TOO_SLOW, "nothing was taken for 5 s")
    assert other.client.closed is None


def test_a_client_that_answers_no_ping_is_cut(world: World) -> None:
    """A half-open connection is not kept."""
    person = world.person()
    world.clock.pump([0.1] * 59)
    assert person.client.closed is None
    world.clock.pump([0.1] * 3)
    assert person.client.closed is not None
    assert person.client.closed[0] == close_codes.TOO_SLOW


def test_a_client_whose_replies_pile_up_is_cut(world: World) -> None:
    """Other clients are not affected."""
    person, other = world.person(), world.person()
    person.rosbridge.pause()
    for number in range(1100):
        person.says("call_service", service="/relay/ping", id=number)
    assert person.client.closed == (
        close_codes.TOO_SLOW,
        "too many answers wait for this client; read faster",
    )
    assert world.people == [other.context]


def test_a_slow_client_loses_samples_and_no_other_does(world: World) -> None:
    """The newest samples are kept by the client's queue length; dropped ones are counted."""
    slow, quick = world.person(), world.person()
    world.working()
    for person in (slow, quick):
        person.says("subscribe", topic="/chatter", queue_length=2)
    number = world.link.all(link.Subscribe)[0].number
    world.subscribed(number)
    world.define()
    slow.rosbridge.pause()
    for word in "abcde":
        world.channel.sample(number, text(word))
    slow.rosbridge.resume()
    assert [each["msg"]["data"] for each in slow.received("publish")] == ["d", "e"]
    assert [each["msg"]["data"] for each in quick.received("publish")] == list("abcde")
    assert (slow.rosbridge.send_queue.dropped, quick.rosbridge.send_queue.dropped) == (3, 0)


def test_a_client_gets_a_latched_sample_of_each_publisher(world: World) -> None:
    """However slowly it reads, and whatever depth it requests, as no publisher sends another."""
    person = world.at_work()
    person.says("subscribe", topic="/chatter", queue_length=1)
    number = world.link.all(link.Subscribe)[0].number
    world.subscribed(number, latched=True, publishers=10)
    world.define()
    person.rosbridge.pause()
    for each in range(10):
        world.channel.sample(number, text(str(each) * 500_000), each + 1)
        world.clock.advance(0.2)
    person.rosbridge.resume()
    assert [message["msg"]["data"][0] for message in person.received("publish")] == list("0123456789")
    assert person.rosbridge.send_queue.dropped == 0


def test_a_client_gets_all_latched_samples_of_one_publisher(world: World) -> None:
    """A publisher may keep ten of them. A client that comes first, or later, gets them however slowly it reads."""
    robot = RobotLink(world)
    first, late = world.person(), world.person()
    robot.joins()
    first.says("subscribe", topic="/chatter", queue_length=1)
    number = robot.subscribed("/chatter", latched=True, publishers=1, replays="memory")
    first.rosbridge.pause()
    for each in range(10):
        robot.sample(number, text(str(each) * 500_000), each + 1)
    world.clock.advance(2)
    first.rosbridge.resume()
    assert [message["msg"]["data"][0] for message in first.received("publish")] == list("0123456789")
    late.says("subscribe", topic="/chatter", queue_length=1)
    late.rosbridge.pause()
    robot.subscribed("/chatter", latched=True, publishers=1, replays="memory")
    for each in range(10):
        robot.sample(number, b"", each + 1)
    robot.sample(number, b"", 0)
    world.clock.advance(2)
    late.rosbridge.resume()
    assert [message["msg"]["data"][0] for message in late.received("publish")] == list("0123456789")


def test_of_a_latched_topic_that_goes_on_a_slow_client_gets_what_is_new(world: World) -> None:
    """Its publisher keeps one sample, so that those before are of no use."""
    robot = RobotLink(world)
    person = world.person()
    robot.joins()
    person.says("subscribe", topic="/chatter")
    number = robot.subscribed("/chatter", latched=True, publishers=1, replays="memory")
    robot.sample(number, text("0"), 1)
    world.clock.advance(1)
    person.rosbridge.pause()
    for each in range(1, 20):
        robot.sample(number, text(f"{each}"), each + 1)
        world.clock.advance(0.1)
    person.rosbridge.resume()
    got = [message["msg"]["data"] for message in person.received("publish")]
    assert (got[0], got[-1]) == ("0", "19")
    assert len(got) < 12


def test_queued_samples_of_an_unsubscribed_topic_are_dropped(world: World) -> None:
    person = world.person()
    world.working()
    person.says("subscribe", topic="/chatter")
    number = world.link.all(link.Subscribe)[0].number
    world.subscribed(number)
    world.define()
    person.rosbridge.pause()
    world.channel.sample(number, text("late"))
    person.says("unsubscribe", topic="/chatter")
    person.rosbridge.resume()
    assert not person.received("publish")


# --- changed rights ---------------------------------------------------------------------------------------


def test_rights_taken_away_while_open_take_back_what_they_gave(world: World) -> None:
    """Subscriptions and advertisements without the right end with a reason; others continue."""
    person = world.person()
    world.working()
    person.says("set_level", level="error")
    person.says("subscribe", topic="/chatter")
    person.says("subscribe", topic="/secret")
    person.says("advertise", topic="/cmd_vel", type=TWIST)
    person.context.permit.rules = Rules([Grant(Level.VIEWER, deny=("subscribe:/secret",))])
    person.context.permit.on_change()
    assert reported(person) == [
        "unsubscribed from /secret: subscribe on /secret is denied to you by 'subscribe:/secret'",
        "unadvertised /cmd_vel: publish on /cmd_vel needs the level operator; you are viewer on this robot",
    ]
    assert len(world.link.all(link.Unsubscribe)) == len(world.link.all(link.Unadvertise)) == 1
    assert world.channel.link_state.names_in_use == 1
    person.says("publish", topic="/cmd_vel", msg={})
    assert reported(person)


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (Refused("your right on this robot was revoked"), close_codes.FORBIDDEN),
        (BadCredentials("your account was disabled"), close_codes.UNAUTHENTICATED),
    ],
)
def test_a_revoked_client_is_cut_with_the_reason(world: World, error: Refused, code: int) -> None:
    """The close code says whether a new login helps."""
    person = world.person()
    person.context.permit.on_revoke(error)
    assert person.client.closed == (code, str(error))
    assert not world.channel.members


# --- the end ----------------------------------------------------------------------------------------------


def test_an_ended_session_does_nothing_more(world: World) -> None:
    """Messages, samples, pings, answers and a second end have no effect, and no timer is left."""
    person = world.person()
    world.working()
    person.says("subscribe", topic="/chatter", throttle_rate=100)
    person.says("subscribe", topic="/relay/status")
    person.says("call_service", service="/reset")
    number = world.link.all(link.Subscribe)[0].number
    world.subscribed(number)
    world.define()
    world.channel.sample(number, text("a"))
    world.channel.sample(number, text("waits"))
    person.client.take()
    person.session.close(close_codes.GOING_AWAY, "the relay is going down")
    person.session.end()
    person.session.close(close_codes.GOING_AWAY, "again")
    person.says("subscribe", topic="/secret")
    person.rosbridge.resume()
    world.channel.sample(number, text("b"))
    world.robot_goes()
    assert not person.client.sent
    assert not world.people
    world.clock.advance(5.1)
    assert not [call for call in world.clock.getDelayedCalls() if call.active()]


def test_types_in_the_habit_of_ros_1_are_understood() -> None:
    """``pkg/Name`` is a message or a service; an empty type stays empty."""
    assert normal_type("std_msgs/String") == STRING
    assert normal_type("std_srvs/Trigger", "srv") == "std_srvs/srv/Trigger"
    assert normal_type(STRING) == STRING
    assert normal_type(None) == normal_type("") == ""


def test_a_type_of_another_kind_is_refused_at_once() -> None:
    """A topic cannot have a service's type; the messages and services of an action are allowed."""
    with pytest.raises(Invalid, match="std_srvs/srv/Trigger is no message type"):
        normal_type("std_srvs/srv/Trigger")
    with pytest.raises(Invalid, match="is no action type"):
        normal_type(STRING, "action")
    feedback = "example_interfaces/action/Fibonacci_FeedbackMessage"
    assert normal_type(feedback) == feedback


def test_the_number_of_topics_of_one_client_is_bounded(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """Existing ones continue."""
    monkeypatch.setattr(listening, "SUBSCRIPTIONS", 2)
    person = world.person()
    person.says("set_level", level="error")
    for topic in ("/a", "/b", "/c", "/a"):
        person.says("subscribe", topic=topic, type=STRING)
    assert reported(person) == ["at most 2 topics can be subscribed on one connection"]
    assert world.channel.link_state.names_in_use == 2


def test_topics_of_a_robot_are_limited_per_user(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """For all connections of a user together."""
    monkeypatch.setattr(subscriptions, "USER_TOPICS", 3)
    people = [world.person(), world.person()]
    for number, person in enumerate(people):
        person.says("set_level", level="error")
        for topic in ("a", "b"):
            person.says("subscribe", topic=f"/{topic}{number}", type=STRING)
    assert reported(people[0]) == []
    assert reported(people[1]) == ["you have 3 topics of this robot subscribed, the most one user may have"]


def test_changes_faster_than_any_program_needs_are_refused(world: World) -> None:
    """A loop of subscribe and unsubscribe does not reach the robot; a second later changes are accepted."""
    person = world.person()
    person.says("set_level", level="error")
    for _ in range(int(session.CHANGES_AT_ONCE) + 1):
        person.says("subscribe", topic="/chatter", type=STRING)
        person.says("unsubscribe", topic="/chatter")
    assert "too many changes at once" in reported(person)[0]
    world.clock.advance(1)
    person.says("subscribe", topic="/secret", type=STRING)
    assert reported(person) == []


def test_what_withdraws_is_carried_out_after_too_many_changes(world: World) -> None:
    person = world.at_work()
    person.says("subscribe", topic="/chatter", type=STRING)
    person.says("advertise", topic="/words", type=STRING)
    for _ in range(int(session.CHANGES_AT_ONCE)):
        person.says("subscribe", topic="/chatter", type=STRING, id="again")
    assert any("too many changes at once" in each for each in reported(person))
    person.says("unsubscribe", topic="/chatter")
    person.says("unadvertise", topic="/words")
    assert world.link.all(link.Unsubscribe)
    assert world.link.all(link.Unadvertise)


def test_arguments_of_calls_that_wait_are_bounded(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """Their memory is released when they end."""
    monkeypatch.setattr(service_calls, "CALL_BYTES", 100)
    person = world.at_work()
    for _ in range(2):
        person.says("call_service", service="/reset", args={"x": "y" * 60})
    assert "too large together" in reported(person)[0]
    person.session.end()
    assert person.session.service_calls._bytes == 0
