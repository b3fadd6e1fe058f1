"""One client on one robot: every message is judged before anything else sees it."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from relay_protocol import link
from relay_protocol.errors import Invalid, Refused
from relay_protocol.rights import Grant, Level, Rules
from relay_server.access import BadCredentials
from relay_server.channels import subscriptions
from relay_server.common import close_codes
from relay_server.sessions import service_calls, session
from relay_server.sessions import session as module
from relay_server.sessions import subscriptions as listening
from relay_server.sessions.type_names import normal_type
from tests.relay_server.memory import STRING, TEXTS, TWIST, Person, World, text


def told(person: Person, level: str = "error") -> list[str]:
    """The statuses of a level."""
    return [each["msg"] for each in person.hears("status") if each["level"] == level]


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
    """By level, by deny and by allow; what is refused never reaches the robot."""
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
        refused = told(person)
        assert bool(refused) is not right
        assert right or len(world.link.said) == before
        assert person.session.refusals == len(refused)
        person.session.end()


def test_a_refused_call_is_answered_even_to_those_who_asked_for_no_status(world: World) -> None:
    """The caller waits for an answer; the reason is in it."""
    person = world.person(Level.VIEWER)
    person.says("call_service", service="/reset", id="x")
    (reply,) = person.client.take()
    assert (reply["op"], reply["id"], reply["result"]) == ("service_response", "x", False)
    assert reply["values"] == "call on /reset needs the level operator; you are viewer on this robot"


@pytest.mark.parametrize(
    "wrong", [{"timeout": "x"}, {"fragment_size": "big"}, {"compression": 1}, {"type": []}, {"service": 5}]
)
def test_a_call_that_makes_no_sense_is_answered(world: World, wrong: dict[str, Any]) -> None:
    """Nobody may wait in vain for a field of a wrong type; the reason is in the answer."""
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
def test_what_a_request_lacks_is_told(world: World, op: str, name: str, answer: str) -> None:
    """By a status; with an id, which somebody waits for, by an answer too."""
    person = world.person()
    person.says("set_level", level="error")
    person.says(op)
    (status,) = person.client.take()
    assert (status["op"], status["level"]) == ("status", "error")
    assert f"missing required field `{name}`" in status["msg"]
    person.says(op, id="x")
    told, reply = person.client.take()
    assert (told["op"], told["id"], told["msg"]) == ("status", "x", status["msg"])
    assert (reply["op"], reply["id"], reply["result"], reply["values"]) == (answer, "x", False, told["msg"])


def test_calls_that_make_no_sense_are_counted(world: World) -> None:
    """Each is answered, and a hundred in a row cut the client all the same."""
    person = world.person()
    for _ in range(module.MALFORMED):
        assert person.client.closed is None
        person.says("call_service", service="/reset", timeout="x")
    assert person.client.closed is not None
    assert len(person.hears("service_response")) == module.MALFORMED


def test_a_qos_goes_to_the_robot_in_one_form(world: World) -> None:
    """As rosbridge clients write it, the robot hears it in the words of the robot link."""
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
    """Common clients break on an op they don't know; each level includes those above."""
    person = world.person()
    person.says("subscribe", topic="no name!")
    assert not person.client.take()
    heard = {}
    for level in ("info", "warning", "error", "none"):
        person.says("set_level", level=level)
        for kind in ("info", "warning", "error"):
            person.session.tell(kind, "words")
        heard[level] = [each["level"] for each in person.hears("status")]
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
    (status,) = person.hears("status")
    assert status["id"] == "x"
    assert status["msg"] == "level 'loud' is none of info, warning, error, none"


def test_what_is_unknown_is_refused_in_words(world: World) -> None:
    """Unknown operations, and forms of messages."""
    person = world.person()
    person.says("set_level", level="warning")
    person.says("dance")
    person.says("subscribe", topic="/x", type=STRING, compression="zip", fragment_size=1)
    first, second, third = person.hears("status")
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
    """Ninety-nine do not, and a good one starts the count anew."""
    person = world.person()
    for _ in range(module.MALFORMED - 1):
        person.session.message(junk)
    person.says("set_level", level="error")
    for _ in range(module.MALFORMED - 1):
        person.session.message(junk)
    assert person.client.closed is None
    person.session.message(junk)
    assert person.client.closed is not None
    assert person.client.closed[0] == close_codes.TOO_MANY_ERRORS
    assert not world.people


def test_rosauths_message_is_taken_and_not_used(world: World) -> None:
    """Who is here is authenticated already."""
    person = world.person()
    person.says("set_level", level="info")
    person.says("auth", mac="x", client="y", dest="z", rand=1, t=2, level="admin", end=3)
    assert not person.client.take()


# --- motion -----------------------------------------------------------------------------------------------


def test_a_motion_command_that_may_be_too_old_is_dropped_counted_and_told(world: World) -> None:
    """Without a pong its age is not known to be less; after one it goes through."""
    world.robot_comes()
    person = world.person()
    world.robot_joins()
    person.says("set_level", level="warning")
    world.clock.advance(0.6)
    person.says("publish", topic="/cmd_vel", msg={}, id="c")
    assert "may be 600 ms old" in told(person, "warning")[0]
    assert person.session.stale_commands == 1
    person.answers_pings()
    person.says("publish", topic="/cmd_vel", msg={})
    world.define()
    assert len(world.link.samples) == 1
    assert not told(person, "warning")


def test_the_robot_says_what_is_motion_and_how_old_it_may_be(world: World) -> None:
    """By type or by topic, with its own deadline; other topics are not judged by age."""
    world.robot_comes()
    person = world.person()
    world.robot_joins()
    world.robot.description = link.Describe(motion=link.MotionPolicy(topics=["/chatter"], deadline_ms=2000))
    for name in (STRING, TWIST):
        world.robot.types.add(name, TEXTS[name])
    for advance, topic, stale in ((1.0, "/cmd_vel", 0), (0.9, "/chatter", 0), (0.2, "/chatter", 1)):
        world.clock.advance(advance)
        person.says("publish", topic=topic, msg={})
        assert person.session.stale_commands == stale
    assert len(world.link.samples) == 2


def test_who_may_drive_is_pinged_more_often_than_who_watches(world: World) -> None:
    """Ten times a second against every two seconds; a change of rights changes that too."""
    driver, viewer = world.person(Level.OPERATOR), world.person(Level.VIEWER)
    allowed = world.person(Level.VIEWER, allow=("publish:/cmd_vel",))
    world.clock.pump([0.1] * 10)
    assert [len(each.client.pings) for each in (driver, viewer, allowed)] == [11, 1, 11]
    driver.session.permit.rules = Rules([Grant(Level.VIEWER)])
    driver.session.permit.on_change()
    world.clock.pump([0.1] * 10)
    assert len(driver.client.pings) <= 13


# --- slow and silent clients ------------------------------------------------------------------------------


def test_a_client_that_takes_nothing_is_cut_after_the_stall_limit(world: World) -> None:
    """With words; one that takes something in between is not."""
    person, other = world.person(), world.person()
    for each in (person, other):
        each.session.pause()
    for second in range(6):
        for _ in range(10):
            world.clock.advance(0.1)
            person.answers_pings()
            other.answers_pings()
        if second == 3:
            other.session.resume()
            other.session.pause()
    assert person.client.closed == (close_codes.TOO_SLOW, "nothing was taken for 5 s")
    assert other.client.closed is None


def test_a_client_that_answers_no_ping_is_cut(world: World) -> None:
    """A half-open connection is not kept for ever."""
    person = world.person()
    world.clock.pump([0.1] * 59)
    assert person.client.closed is None
    world.clock.pump([0.1] * 3)
    assert person.client.closed is not None
    assert person.client.closed[0] == close_codes.TOO_SLOW


def test_a_client_whose_replies_pile_up_is_cut(world: World) -> None:
    """While other clients go on."""
    person, other = world.person(), world.person()
    person.session.pause()
    for number in range(1100):
        person.says("call_service", service="/relay/ping", id=number)
    assert person.client.closed == (close_codes.TOO_SLOW, "replies pile up; read faster")
    assert world.people == [other.session]


def test_a_slow_client_loses_samples_and_no_other_does(world: World) -> None:
    """Newest win, drops are counted, by the queue length the client asked for."""
    slow, quick = world.person(), world.person()
    world.working()
    for person in (slow, quick):
        person.says("subscribe", topic="/chatter", queue_length=2)
    number = world.link.all(link.Subscribe)[0].number
    world.subscribed(number)
    world.define()
    slow.session.pause()
    for word in "abcde":
        world.channel.sample(number, text(word))
    slow.session.resume()
    assert [each["msg"]["data"] for each in slow.hears("publish")] == ["d", "e"]
    assert [each["msg"]["data"] for each in quick.hears("publish")] == list("abcde")
    assert (slow.session.outbox.dropped, quick.session.outbox.dropped) == (3, 0)


def test_what_waits_of_a_topic_unsubscribed_is_not_sent(world: World) -> None:
    """Nobody wants it any more."""
    person = world.person()
    world.working()
    person.says("subscribe", topic="/chatter")
    number = world.link.all(link.Subscribe)[0].number
    world.subscribed(number)
    world.define()
    person.session.pause()
    world.channel.sample(number, text("late"))
    person.says("unsubscribe", topic="/chatter")
    person.session.resume()
    assert not person.hears("publish")


# --- rights that change -----------------------------------------------------------------------------------


def test_rights_taken_away_while_open_take_back_what_they_gave(world: World) -> None:
    """Subscriptions and advertisements end, with the reason; the rest goes on."""
    person = world.person()
    world.working()
    person.says("set_level", level="error")
    person.says("subscribe", topic="/chatter")
    person.says("subscribe", topic="/secret")
    person.says("advertise", topic="/cmd_vel", type=TWIST)
    person.session.permit.rules = Rules([Grant(Level.VIEWER, deny=("subscribe:/secret",))])
    person.session.permit.on_change()
    assert told(person) == [
        "unsubscribed from /secret: subscribe on /secret is denied to you by 'subscribe:/secret'",
        "unadvertised /cmd_vel: publish on /cmd_vel needs the level operator; you are viewer on this robot",
    ]
    assert len(world.link.all(link.Unsubscribe)) == len(world.link.all(link.Unadvertise)) == 1
    assert world.channel.wire.names == 1
    person.says("publish", topic="/cmd_vel", msg={})
    assert told(person)


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (Refused("your right on this robot was revoked"), close_codes.FORBIDDEN),
        (BadCredentials("your account was disabled"), close_codes.UNAUTHENTICATED),
    ],
)
def test_a_revoked_client_is_cut_with_the_reason(world: World, error: Refused, code: int) -> None:
    """The code tells whether logging in again helps."""
    person = world.person()
    person.session.permit.on_revoke(error)
    assert person.client.closed == (code, str(error))
    assert not world.channel.members


# --- the end ----------------------------------------------------------------------------------------------


def test_an_ended_session_does_nothing_more(world: World) -> None:
    """No message, sample, ping, answer or second end has any effect, and no timer is left."""
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
    person.session.resume()
    world.channel.sample(number, text("b"))
    world.robot_goes()
    assert not person.client.sent
    assert not world.people
    world.clock.advance(5.1)
    assert not [call for call in world.clock.getDelayedCalls() if call.active()]


def test_types_in_the_habit_of_ros_1_are_understood() -> None:
    """``pkg/Name`` is a message or a service; nothing stays nothing."""
    assert normal_type("std_msgs/String") == STRING
    assert normal_type("std_srvs/Trigger", "srv") == "std_srvs/srv/Trigger"
    assert normal_type(STRING) == STRING
    assert normal_type(None) == normal_type("") == ""


def test_a_type_of_another_kind_is_told_at_once() -> None:
    """A topic of a service's type can't be; what an action is made of are messages and services all the same."""
    with pytest.raises(Invalid, match="std_srvs/srv/Trigger is no message type"):
        normal_type("std_srvs/srv/Trigger")
    with pytest.raises(Invalid, match="is no action type"):
        normal_type(STRING, "action")
    feedback = "example_interfaces/action/Fibonacci_FeedbackMessage"
    assert normal_type(feedback) == feedback


def test_the_number_of_topics_of_one_client_is_bounded(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """What it has goes on."""
    monkeypatch.setattr(listening, "SUBSCRIPTIONS", 2)
    person = world.person()
    person.says("set_level", level="error")
    for topic in ("/a", "/b", "/c", "/a"):
        person.says("subscribe", topic=topic, type=STRING)
    assert told(person) == ["at most 2 topics can be subscribed on one connection"]
    assert world.channel.wire.names == 2


def test_one_user_can_not_take_all_topics_of_a_robot(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is bounded is the person, over all connections: opening more of them gives no more."""
    monkeypatch.setattr(subscriptions, "USER_TOPICS", 3)
    people = [world.person(), world.person()]
    for number, person in enumerate(people):
        person.says("set_level", level="error")
        for topic in ("a", "b"):
            person.says("subscribe", topic=f"/{topic}{number}", type=STRING)
    assert told(people[0]) == []
    assert told(people[1]) == ["you have 3 topics of this robot subscribed, the most one user may have"]


def test_changes_faster_than_any_program_needs_are_refused(world: World) -> None:
    """A loop of subscribe and unsubscribe does not reach the robot; a second later changes are followed again."""
    person = world.person()
    person.says("set_level", level="error")
    for _ in range(int(session.CHANGES_AT_ONCE)):
        person.says("subscribe", topic="/chatter", type=STRING)
        person.says("unsubscribe", topic="/chatter")
    assert "too many changes at once" in told(person)[0]
    world.clock.advance(1)
    person.says("subscribe", topic="/secret", type=STRING)
    assert told(person) == []


def test_arguments_of_calls_that_wait_are_bounded(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """What calls keep in memory is given back when they end."""
    monkeypatch.setattr(service_calls, "CALL_BYTES", 100)
    person = world.at_work()
    for _ in range(2):
        person.says("call_service", service="/reset", args={"x": "y" * 60})
    assert "too large together" in told(person)[0]
    person.session.end()
    assert person.session.calling._bytes == 0
