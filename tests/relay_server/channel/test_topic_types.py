"""The type of a topic from the robot: what clients say, what the graph says, and what becomes of who is wrong."""

from __future__ import annotations

from relay_protocol import link
from relay_server.channels import subscriptions as module
from tests.relay_server.channel.watching import heard, watching
from tests.relay_server.memory import STRING, TWIST, Person, World, text


def appears(world: World, *types: str, topic: str = "/later") -> None:
    """The robot's graph tells of a topic's types; none when it is gone."""
    world.registry.graph(
        world.robot, link.Graph(topics={topic: link.Topic(types=list(types)) if types else None})
    )


def waiting(world: World, *types: str) -> list[Person]:
    """A robot at work, and for each type one who waits for ``/later``."""
    world.robot_comes()
    people = [world.person() for _ in types]
    world.robot_joins()
    for person, type_name in zip(people, types, strict=True):
        person.says("set_level", level="error")
        person.says("subscribe", topic="/later", type=type_name)
    return people


WRONG = "subscribe /later: it has the type {}, not {}; subscribe with {} to get it"


def test_a_wrong_guess_binds_nobody(world: World) -> None:
    """When the topic appears those who were right go on, the others are told who is."""
    wrong, right, careless = waiting(world, TWIST, STRING, "")
    (guess,) = world.link.take(link.Subscribe)
    assert (guess.topic, guess.type) == ("/later", TWIST)
    assert not wrong.told() + right.told() + careless.told()
    appears(world, STRING)
    assert world.link.take(link.Unsubscribe) == [link.Unsubscribe(number=guess.number)]
    (ask,) = world.link.take(link.Subscribe)
    assert ask.type == STRING
    assert ask.number != guess.number
    assert wrong.told() == [WRONG.format(STRING, TWIST, STRING)]
    assert not right.told()
    world.subscribed(ask.number)
    world.define()
    world.channel.sample(guess.number, text("of the guess"))
    world.channel.sample(ask.number, text("hi"))
    assert [heard(person) for person in (wrong, right, careless)] == [[], ["hi"], ["hi"]]


def test_who_was_wrong_is_told_with_the_ids(world: World) -> None:
    """Each time the topic appears so; a warning about a guess has the id of who just asked."""
    right, wrong = waiting(world, STRING, STRING)
    for id in ("a", "b"):
        wrong.says("set_level", level="warning")
        wrong.says("subscribe", topic="/later", type=TWIST, id=id)
    assert [each["id"] for each in wrong.hears("status")] == ["a", "b"]
    for _ in range(2):
        appears(world, STRING)
        assert [each.get("id") for each in wrong.hears("status")] == [None, "a", "b"]
        appears(world)
    assert not right.told()


def test_who_was_wrong_may_ask_again(world: World) -> None:
    """With the right type, on the same connection; latched samples come as to any late joiner."""
    wrong, _ = waiting(world, TWIST, STRING)
    appears(world, STRING)
    number = world.link.take(link.Subscribe)[-1].number
    world.subscribed(number, latched=True, publishers=1)
    world.define()
    world.channel.sample(number, text("hi"))
    assert wrong.told() == [WRONG.format(STRING, TWIST, STRING)]
    wrong.says("subscribe", topic="/later", type=STRING)
    assert heard(wrong) == ["hi"]
    world.channel.sample(number, text("ho"))
    assert heard(wrong) == ["ho"]


def test_a_guess_goes_with_those_who_made_it(world: World) -> None:
    """Another client's guess takes its place."""
    first, _ = waiting(world, TWIST, STRING)
    (guess,) = world.link.take(link.Subscribe)
    first.session.end()
    assert world.link.take(link.Unsubscribe) == [link.Unsubscribe(number=guess.number)]
    assert [ask.type for ask in world.link.take(link.Subscribe)] == [STRING]
    assert world.channel.wire.names == 1


def test_who_joins_a_guess_of_another_type_is_warned(world: World) -> None:
    """It may be right; nobody knows yet."""
    (first,) = waiting(world, TWIST)
    second = world.person()
    second.says("set_level", level="warning")
    second.says("subscribe", topic="/later", type=STRING)
    assert second.told() == [
        f"subscribe /later: it does not exist yet, and another client says that its type is {TWIST}; "
        f"messages come if it turns out to be {STRING}"
    ]
    assert not first.told()


def test_nothing_is_subscribed_when_everybody_is_wrong(world: World) -> None:
    """They are told once; when the topic comes back as they say, it goes on."""
    (person,) = waiting(world, TWIST)
    (guess,) = world.link.take(link.Subscribe)
    appears(world, STRING)
    appears(world, STRING)
    assert world.link.take(link.Unsubscribe) == [link.Unsubscribe(number=guess.number)]
    assert not world.link.take(link.Subscribe)
    assert person.told() == [WRONG.format(STRING, TWIST, STRING)]
    appears(world)
    appears(world, TWIST)
    assert [ask.type for ask in world.link.take(link.Subscribe)] == [TWIST]
    assert not person.told()


def test_publishers_that_come_back_with_another_type_are_followed(world: World) -> None:
    """By those who left the type to the graph; nothing of the former type comes any more."""
    number, (careless, exact) = watching(world, {"type": ""}, {"type": STRING})
    exact.says("set_level", level="error")
    world.subscribed(number, latched=True, publishers=1)
    world.channel.sample(number, text("old"))
    assert heard(careless) == heard(exact) == ["old"]
    appears(world, topic="/chatter")
    appears(world, TWIST, topic="/chatter")
    assert world.link.take(link.Unsubscribe) == [link.Unsubscribe(number=number)]
    ask = world.link.take(link.Subscribe)[-1]
    assert ask.type == TWIST
    world.define()
    world.subscribed(ask.number, TWIST, latched=True, publishers=1)
    world.channel.sample(number, text("under way"))
    world.channel.sample(ask.number, bytes((0, 1, 0, 0)) + bytes(48))
    (moved,) = careless.hears("publish")
    assert moved["msg"]["linear"] == {"x": 0.0, "y": 0.0, "z": 0.0}
    assert exact.told() == [
        f"subscribe /chatter: it has the type {TWIST}, not {STRING}; subscribe with {TWIST} to get it"
    ]
    late = world.person()
    late.says("subscribe", topic="/chatter")
    assert len(late.hears("publish")) == 1


def test_publishers_that_come_back_with_another_qos_are_followed(world: World) -> None:
    """The robot says what it matches now: samples that are latched now are kept for late joiners."""
    number, (first,) = watching(world, {})
    world.subscribed(number, latched=False, publishers=1)
    world.channel.sample(number, text("volatile"))
    world.subscribed(number, latched=True, publishers=1)
    world.channel.sample(number, text("latched"))
    late = world.person()
    late.says("subscribe", topic="/chatter")
    assert heard(first) == ["volatile", "latched"]
    assert heard(late) == ["latched"]


def test_a_topic_of_several_types_is_shown_with_one(world: World) -> None:
    """Any of them, as the first client says; another one is an error in words."""
    world.robot_comes()
    people = [world.person() for _ in range(3)]
    world.robot_joins()
    appears(world, STRING, TWIST)
    for person, type_name in zip(people, (TWIST, STRING, TWIST), strict=True):
        person.says("set_level", level="error")
        person.says("subscribe", topic="/later", type=type_name)
    assert [ask.type for ask in world.link.take(link.Subscribe)] == [TWIST]
    assert [person.told() for person in people] == [
        [],
        [f"topic /later has several types; it is subscribed as {TWIST} now"],
        [],
    ]
    appears(world, STRING, TWIST)
    assert not world.link.take(link.Subscribe)


def test_another_definition_of_a_type_is_taken(world: World) -> None:
    """A robot that was rebuilt while it was away says what its messages look like now."""
    _, (person,) = watching(world, {})
    world.robot_goes()
    world.robot_comes()
    world.robot_joins()
    number = world.link.take(link.Subscribe)[-1].number
    world.subscribed(number)
    world.channel.sample(number, text("early"))
    for asked in world.link.take(link.GetType):
        world.channel.message(link.TypeDefinition(type=asked.type, text="string words\n"))
    world.channel.sample(number, text("late"))
    assert [message["msg"] for message in person.hears("publish")] == [{"words": "early"}, {"words": "late"}]


def test_a_topic_that_is_there_is_asked_for_again(world: World) -> None:
    """After growing pauses, without telling the same again, until it is had or nobody wants it."""
    number, (person,) = watching(world, {})
    person.says("set_level", level="error")
    world.link.take(link.Subscribe)
    refusal = link.Failed(what="subscribe", ref=str(number), reason="not now")
    pauses = []
    for _ in range(10):
        world.channel.message(refusal)
        before = world.clock.seconds()
        while not world.link.take(link.Subscribe):
            world.clock.advance(0.25)
            person.answers_pings()
        pauses.append(world.clock.seconds() - before)
    assert pauses == [0.25, 0.5, 1, 2, 4, 8, 16, 30, 30, 30]
    assert person.told() == ["subscribe /chatter: not now"]
    world.subscribed(number)
    world.channel.message(refusal)
    assert person.told() == ["subscribe /chatter: not now"]
    person.says("unsubscribe", topic="/chatter")
    world.clock.advance(2)
    assert not world.link.take(link.Subscribe)


def test_a_robot_may_need_a_moment_for_another_type(world: World) -> None:
    """Some middleware lets go of the former type late: that is told only if it lasts."""
    number, (person,) = watching(world, {})
    person.says("set_level", level="error")
    appears(world, topic="/chatter")
    appears(world, TWIST, topic="/chatter")
    for _ in range(module.PATIENCE + 1):
        assert not person.told()
        ask = world.link.take(link.Subscribe)[-1]
        assert ask.number != number
        world.channel.message(link.Failed(what="subscribe", ref=str(ask.number), reason="not yet"))
        world.clock.advance(2)
        person.answers_pings()
    assert person.told() == ["subscribe /chatter: not yet"]
