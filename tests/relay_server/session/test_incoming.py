"""Messages that a client sends in fragments."""

from __future__ import annotations

import json
from typing import Any

import pytest

from relay_protocol import limits, link
from relay_server.sessions import fragments as module
from relay_server.sessions import session
from tests.relay_server.memory import TWIST, Person, World


@pytest.fixture
def person(world: World) -> Person:
    """A client of a robot at work that wants to hear of errors."""
    return world.at_work()


def send(
    person: Person, id: Any, *parts: str, order: list[int] | None = None, total: int | None = None
) -> None:
    """Some or all fragments of a message."""
    for number in order if order is not None else range(len(parts)):
        person.says("fragment", id=id, num=number, total=total or len(parts), data=parts[number])


def unfinished(person: Person) -> tuple[int, int, int]:
    """Messages, fragments and bytes that are kept."""
    kept = person.session.incoming
    return len(kept._unfinished), kept._parts, kept._bytes


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 0, 1], [1, 2, 0]])
def test_fragments_are_joined_in_any_order(person: Person, world: World, order: list[int]) -> None:
    """What they make goes the way of any message, and nothing is left."""
    words = json.dumps({"op": "subscribe", "topic": "/chatter", "id": "naïve 😀"}, ensure_ascii=False)
    send(person, "m", words[:20], words[20:21], words[21:], order=order)
    assert [ask.topic for ask in world.link.all(link.Subscribe)] == ["/chatter"]
    assert unfinished(person) == (0, 0, 0)
    assert not person.told()


def test_a_joined_message_is_obeyed(person: Person, world: World) -> None:
    """Two messages may come at the same time, and ids may be numbers."""
    texts = [json.dumps({"op": "subscribe", "topic": topic}) for topic in ("/chatter", "/secret")]
    for number in range(3):
        for id, words in enumerate(texts):
            parts = [words[:5], words[5:9], words[9:]]
            person.says("fragment", id=id, num=number, total=3, data=parts[number])
    assert [ask.topic for ask in world.link.all(link.Subscribe)] == ["/chatter", "/secret"]


def test_one_fragment_can_be_all(person: Person, world: World) -> None:
    """A message in one fragment is a message."""
    send(person, "m", json.dumps({"op": "subscribe", "topic": "/chatter"}))
    assert world.link.all(link.Subscribe)


def test_clients_do_not_share(person: Person, world: World) -> None:
    """Fragments of two clients with the same id are two messages."""
    other = world.person()
    words = json.dumps({"op": "subscribe", "topic": "/chatter"})
    send(person, "m", words[:5], words[5:], order=[0])
    send(other, "m", words[:5], words[5:], order=[1])
    assert not world.link.all(link.Subscribe)
    assert unfinished(person)[0] == unfinished(other)[0] == 1


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ([{"num": 2, "total": 2}], "'num' must be 0 to 1, not 2"),
        ([{"num": -1, "total": 2}], "'num' must be 0 to 1, not -1"),
        ([{"num": 0, "total": 0}], "'total' must be 1 to 16384, not 0"),
        ([{"num": 0, "total": 10**12}], "'total' must be 1 to 16384, not 1000000000000"),
        ([{"num": 0, "total": 3}, {"num": 1, "total": 4}], "'total' was 3 before and is 4 now"),
        ([{"num": 0, "total": 3}, {"num": 0, "total": 3}], "fragment 0 came twice"),
        ([{"num": 1, "total": 3}, {"num": 1, "total": 3}], "fragment 1 came twice"),
        ([{"num": 0, "total": 3, "data": ""}], "'data' of a fragment must not be empty"),
        ([{"num": 0, "total": 3, "id": "x" * 256}], "'id' of a fragment may have 255 characters"),
    ],
)
def test_fragments_that_make_no_sense(person: Person, parts: list[dict[str, Any]], words: str) -> None:
    """An error in words, and all of the message is let go."""
    for part in parts:
        person.says("fragment", **{"id": "m", "data": "x", **part})
    assert person.told() == [words]
    assert unfinished(person) == (0, 0, 0)


def test_the_rest_of_a_refused_message_is_passed_over(person: Person, world: World) -> None:
    """It is told once, takes no memory, and the message may be sent anew."""
    words = json.dumps({"op": "subscribe", "topic": "/chatter"})
    parts = [words[:5], words[5:9], words[9:20], words[20:]]
    send(person, "m", *parts, order=[0, 1, 1, 2, 3])
    assert person.told() == ["fragment 1 came twice"]
    assert unfinished(person) == (0, 0, 0)
    send(person, "m", *parts)
    assert [ask.topic for ask in world.link.all(link.Subscribe)] == ["/chatter"]


def test_messages_at_a_time_are_bounded(person: Person) -> None:
    """One more than the limit is refused; those that were there stay."""
    for number in range(limits.FRAGMENTS + 1):
        send(person, number, "x", "y", order=[0])
    assert person.told() == ["16 messages in fragments are unfinished already"]
    assert unfinished(person) == (16, 16, 16)


def test_bytes_are_bounded(person: Person) -> None:
    """Over all messages together, by what came and not by what is announced."""
    send(person, "small", "x" * 100, total=module.PARTS)
    assert unfinished(person) == (1, 1, 100)
    third = "é" * (limits.CLIENT_MESSAGE // 6 + 1)
    for number in range(3):
        person.says("fragment", id="large", num=number, total=4, data=third)
    assert person.told() == ["messages in fragments have more than 10000000 bytes together"]
    assert unfinished(person) == (1, 1, 100)


def test_fragments_are_bounded(person: Person, monkeypatch: pytest.MonkeyPatch) -> None:
    """Over all messages together: also the smallest takes memory."""
    monkeypatch.setattr(module, "PARTS", 5)
    send(person, "a", "x", "x", "x", "x", order=[0, 1, 2])
    send(person, "b", "x", "x", "x", "x", order=[0, 1, 2])
    assert person.told() == ["messages in fragments have more than 5 fragments together"]
    assert unfinished(person) == (1, 3, 3)


def test_a_message_that_does_not_go_on_is_given_up(person: Person, world: World) -> None:
    """Ten seconds after the last fragment of it; one that goes on is not."""
    send(person, "stays", "x", "y", "z", order=[0])
    send(person, "goes on", "x", "y", "z", order=[0])
    world.clock.advance(6)
    person.answers_pings()
    send(person, "goes on", "x", "y", "z", order=[1])
    world.clock.advance(5)
    person.answers_pings()
    (status,) = person.hears("status")
    assert status["id"] == "stays"
    assert status["msg"] == "a message in fragments is given up: 1 of 3 came, and then nothing for 10 s"
    assert unfinished(person) == (1, 2, 2)
    world.clock.advance(5)
    assert len(person.told()) == 1
    assert unfinished(person) == (0, 0, 0)


def test_nothing_is_left_of_a_client_that_went(person: Person, world: World) -> None:
    """No memory, no timer."""
    send(person, "m", "x", "y", order=[0])
    person.session.end()
    assert not any(
        getattr(call.func, "__self__", None) is person.session.incoming
        for call in world.clock.getDelayedCalls()
    )


def test_fragments_in_fragments_are_refused(person: Person) -> None:
    """Nobody needs them."""
    inner = json.dumps({"op": "fragment", "id": "n", "num": 0, "total": 1, "data": "{}"})
    send(person, "m", inner[:9], inner[9:])
    assert person.told() == ["a message in fragments can't be a fragment itself"]
    assert unfinished(person) == (0, 0, 0)


def test_junk_in_fragments_is_counted(person: Person) -> None:
    """A hundred messages that are no rosbridge cut the client, also when they come in fragments."""
    for _ in range(session.MALFORMED - 1):
        send(person, "m", "{", "}")
    assert person.client.closed is None
    send(person, "m", "no", " JSON")
    assert person.client.closed is not None


def motion(person: Person, world: World) -> bytes:
    """A robot that moves, and a command for it."""
    world.robot.description = link.Describe(motion=link.MotionPolicy(types=[TWIST]))
    person.says("advertise", topic="/cmd_vel", type=TWIST)
    number = world.link.all(link.Advertise)[0].number
    world.define()
    world.channel.message(link.Advertised(number=number, topic="/cmd_vel", type=TWIST, encoding="cdr"))
    person.answers_pings()
    return json.dumps({"op": "publish", "topic": "/cmd_vel", "msg": {}}).encode()


def test_a_command_is_as_old_as_its_first_fragment(person: Person, world: World) -> None:
    """What was begun long ago moves no robot, however late its end was sent; the next one in one piece does."""
    command = motion(person, world).decode()
    send(person, "m", command[:9], command[9:], order=[0])
    for _ in range(10):
        world.clock.advance(0.1)
        person.answers_pings()
    send(person, "m", command[:9], command[9:], order=[1])
    assert not world.link.samples
    assert person.session.stale_commands == 1
    send(person, "m", command[:9], command[9:])
    assert len(world.link.samples) == 1


def test_a_command_in_frames_is_as_old_as_its_first_frame(person: Person, world: World) -> None:
    """The websocket may have brought pongs between its frames; what comes after them is as young as they say."""
    command = motion(person, world)
    begun = person.session.not_before
    for _ in range(10):
        world.clock.advance(0.1)
        person.answers_pings()
    person.session.message(command, since=begun)
    assert not world.link.samples
    assert person.session.stale_commands == 1
    person.session.message(command, since=person.session.not_before)
    person.session.message(command)
    assert len(world.link.samples) == 2
