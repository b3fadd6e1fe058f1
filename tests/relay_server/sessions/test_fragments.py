"""Messages that a client sends in fragments."""

from __future__ import annotations

import json
from typing import Any

import pytest

from relay_protocol import limits, link
from relay_server.sessions import fragments as module
from relay_server.sessions import websocket_port
from tests.worlds.relay import TWIST, Person, World


@pytest.fixture
def person(world: World) -> Person:
    """A client of an online robot that receives errors."""
    return world.at_work()


def send(
    person: Person, id: Any, *parts: str, order: list[int] | None = None, total: int | None = None
) -> None:
    """Sends some or all fragments of a message."""
    for number in order if order is not None else range(len(parts)):
        person.says("fragment", id=id, num=number, total=total or len(parts), data=parts[number])


def unfinished(person: Person) -> tuple[int, int, int]:
    """Numbers of stored messages, fragments and bytes."""
    kept = person.rosbridge._fragments
    if kept is None:
        return 0, 0, 0
    return len(kept._incomplete), kept._parts, kept._bytes


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 0, 1], [1, 2, 0]])
def test_fragments_are_joined_in_any_order(person: Person, world: World, order: list[int]) -> None:
    """The joined message is handled as any other, and no state is left."""
    words = json.dumps({"op": "subscribe", "topic": "/chatter", "id": "naïve 😀"}, ensure_ascii=False)
    send(person, "m", words[:20], words[20:21], words[21:], order=order)
    assert [ask.topic for ask in world.link.all(link.Subscribe)] == ["/chatter"]
    assert unfinished(person) == (0, 0, 0)
    assert not person.reported()


def test_a_joined_message_is_obeyed(person: Person, world: World) -> None:
    """Two messages may arrive interleaved, and ids may be numbers."""
    texts = [json.dumps({"op": "subscribe", "topic": topic}) for topic in ("/chatter", "/secret")]
    for number in range(3):
        for id, words in enumerate(texts):
            parts = [words[:5], words[5:9], words[9:]]
            person.says("fragment", id=id, num=number, total=3, data=parts[number])
    assert [ask.topic for ask in world.link.all(link.Subscribe)] == ["/chatter", "/secret"]


def test_single_fragment_is_a_message(person: Person, world: World) -> None:
    send(person, "m", json.dumps({"op": "subscribe", "topic": "/chatter"}))
    assert world.link.all(link.Subscribe)


def test_clients_do_not_share(person: Person, world: World) -> None:
    """The same id of two clients means two messages."""
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
    """They get an error with a reason, and their message is discarded."""
    for part in parts:
        person.says("fragment", **{"id": "m", "data": "x", **part})
    assert person.reported() == [words]
    assert unfinished(person) == (0, 0, 0)


def test_the_rest_of_a_refused_message_is_passed_over(person: Person, world: World) -> None:
    """It is reported once, takes no memory, and the message may be sent again."""
    words = json.dumps({"op": "subscribe", "topic": "/chatter"})
    parts = [words[:5], words[5:9], words[9:20], words[20:]]
    send(person, "m", *parts, order=[0, 1, 1, 2, 3])
    assert person.reported() == ["fragment 1 came twice"]
    assert unfinished(person) == (0, 0, 0)
    send(person, "m", *parts)
    assert [ask.topic for ask in world.link.all(link.Subscribe)] == ["/chatter"]


def test_messages_at_a_time_are_bounded(person: Person) -> None:
    """A message over the limit is refused; earlier ones stay."""
    for number in range(limits.INCOMPLETE_MESSAGES + 1):
        send(person, number, "x", "y", order=[0])
    assert person.reported() == ["16 messages in fragments are unfinished already"]
    assert unfinished(person) == (16, 16, 16)


def test_bytes_are_bounded(person: Person) -> None:
    """Over all messages together, by received bytes and not by announced ones."""
    send(person, "small", "x" * 100, total=module.PARTS)
    assert unfinished(person) == (1, 1, 100)
    third = "é" * (limits.CLIENT_MESSAGE // 6 + 1)
    for number in range(3):
        person.says("fragment", id="large", num=number, total=4, data=third)
    assert person.reported() == ["messages in fragments have more than 10000000 bytes together"]
    assert unfinished(person) == (1, 1, 100)


def test_fragments_are_bounded(person: Person, monkeypatch: pytest.MonkeyPatch) -> None:
    """Over all messages together, because small fragments take memory too."""
    monkeypatch.setattr(module, "PARTS", 5)
    send(person, "a", "x", "x", "x", "x", order=[0, 1, 2])
    send(person, "b", "x", "x", "x", "x", order=[0, 1, 2])
    assert person.reported() == ["messages in fragments have more than 5 fragments together"]
    assert unfinished(person) == (1, 3, 3)


def test_a_message_that_does_not_go_on_is_given_up(person: Person, world: World) -> None:
    """10 s after its last fragment."""
    send(person, "stays", "x", "y", "z", order=[0])
    send(person, "goes on", "x", "y", "z", order=[0])
    world.clock.advance(6)
    person.answers_pings()
    send(person, "goes on", "x", "y", "z", order=[1])
    world.clock.advance(5)
    person.answers_pings()
    (status,) = person.received("status")
    assert status["id"] == "stays"
    assert status["msg"] == "a message in fragments is dropped: 1 of 3 came, and then none for 10 s"
    assert unfinished(person) == (1, 2, 2)
    world.clock.advance(5)
    assert len(person.reported()) == 1
    assert unfinished(person) == (0, 0, 0)


def test_a_message_that_comes_too_slowly_is_given_up(person: Person, world: World) -> None:
    """30 s after its first fragment, though fragments still come; later ones of it are passed over."""
    person.says("fragment", id="slow", num=0, total=100, data="x")
    for number in range(1, 6):
        world.clock.advance(5)
        person.answers_pings()
        person.says("fragment", id="slow", num=number, total=100, data="x")
    assert not person.reported()
    world.clock.advance(6)
    person.answers_pings()
    assert person.reported() == ["a message in fragments is dropped: 6 of 100 came in 31 s"]
    assert unfinished(person) == (0, 0, 0)


def test_fragments_count_against_the_user(person: Person) -> None:
    """Over all connections, with what they take beside their bytes; an ended connection gives all back."""
    user_bytes = person.client.unfinished
    assert user_bytes.take(4 * limits.CLIENT_MESSAGE - 500)
    for number in range(4):
        person.says("fragment", id=number, num=0, total=2, data="x" * 100)
    assert person.reported() == [
        "unfinished messages of one user have at most 40000000 bytes, over all connections"
    ]
    assert unfinished(person) == (3, 3, 300)
    person.says("fragment", id=0, num=1, total=2, data="x")
    person.session.end()
    assert user_bytes.held == 4 * limits.CLIENT_MESSAGE - 500


def test_disconnected_client_leaves_no_state(person: Person, world: World) -> None:
    """Neither memory nor a timer."""
    send(person, "m", "x", "y", order=[0])
    person.session.end()
    assert not any(
        getattr(call.func, "__self__", None) is person.rosbridge._fragments
        for call in world.clock.getDelayedCalls()
    )


def test_fragments_in_fragments_are_refused(person: Person) -> None:
    """No client needs them."""
    inner = json.dumps({"op": "fragment", "id": "n", "num": 0, "total": 1, "data": "{}"})
    send(person, "m", inner[:9], inner[9:])
    assert person.reported() == ["a message in fragments can't be a fragment itself"]
    assert unfinished(person) == (0, 0, 0)


def test_junk_in_fragments_is_counted(person: Person) -> None:
    """A hundred invalid messages disconnect the client, with and without fragments."""
    for _ in range(websocket_port.MAX_MALFORMED - 1):
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
    """However late the rest was sent, an old command does not move the robot; the next undivided one does."""
    command = motion(person, world).decode()
    send(person, "m", command[:9], command[9:], order=[0])
    for _ in range(10):
        world.clock.advance(0.1)
        person.answers_pings()
    send(person, "m", command[:9], command[9:], order=[1])
    assert not world.link.samples
    assert person.context.stale_commands == 1
    send(person, "m", command[:9], command[9:])
    assert len(world.link.samples) == 1


def test_a_command_in_frames_is_as_old_as_its_first_frame(person: Person, world: World) -> None:
    """Pongs may arrive between the frames; messages after them have the age that they prove."""
    command = motion(person, world)
    begun = person.context.earliest_sent
    for _ in range(10):
        world.clock.advance(0.1)
        person.answers_pings()
    person.rosbridge.message(command, earliest_sent=begun)
    assert not world.link.samples
    assert person.context.stale_commands == 1
    person.rosbridge.message(command, earliest_sent=person.context.earliest_sent)
    person.rosbridge.message(command)
    assert len(world.link.samples) == 2
