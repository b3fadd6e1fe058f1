"""The type of a topic from the robot: guesses of clients, the graph, and the effect of a wrong guess."""

from __future__ import annotations

from relay_protocol import link
from relay_server.channels import subscriptions as module
from tests.worlds.relay import STRING, TWIST, Person, World, text
from tests.worlds.topic_viewers import heard, watching


def appears(world: World, *types: str, topic: str = "/later") -> None:
    """The robot's graph lists these types of a topic; none means the topic is gone."""
    world.registry.graph(
        world.robot, link.Graph(topics={topic: link.Topic(types=list(types)) if types else None})
    )


def waiting(world: World, *types: str) -> list[Person]:
    """A robot that is online, and for each type a client that waits for ``/later``."""
    world.robot_comes()
    people = [world.person() for _ in types]
    world.robot_joins()
    for person, type_name in zip(people, types, strict=True):
        person.says("set_level", level="error")
        person.says("subscribe", topic="/later", type=type_name)
    return people


WRONG = "subscribe /later: it has the type {}, not {}; subscribe with {} to get it"


def test_a_wrong_guess_of_a_type_binds_no_other_client(world: World) -> None:
    """When the topic appears, clients with the right type go on, and the others get an error."""
    wrong, right, careless = waiting(world, TWIST, STRING, "")
    (guess,) = world.link.take(link.Subscribe)
    assert (guess.topic, guess.type) == ("/later", TWIST)
    assert not wrong.reported() + right.reported() + careless.reported()
    appears(world, STRING)
    assert world.link.take(link.Unsubscribe) == [link.Unsubscribe(number=guess.number)]
    (ask,) = world.link.take(link.Subscribe)
    assert ask.type == STRING
    assert ask.number != guess.number
    assert wrong.reported() == [WRONG.format(STRING, TWIST, STRING)]
    assert not right.reported()
    world.subscribed(ask.number)
    world.define()
    world.channel.sample(guess.number, text("of the guess"))
    world.channel.sample(ask.number, text("hi"))
    assert [heard(person) for person in (wrong, right, careless)] == [[], ["hi"], ["hi"]]


def test_early_subscriber_with_the_wrong_type_is_notified_with_the_ids(world: World) -> None:
    """This happens each time the topic appears; a warning about a guess has the id of the latest request."""
    right, wrong = waiting(world, STRING, STRING)
    for id in ("a", "b"):
        wrong.says("set_level", level="warning")
        wrong.says("subscribe", topic="/later", type=TWIST, id=id)
    assert [each["id"] for each in wrong.received("status")] == ["a", "b"]
    for _ in range(2):
        appears(world, STRING)
        assert [each.get("id") for each in wrong.received("status")] == [None, "a", "b"]
        appears(world)
    assert not right.reported()


def test_early_subscriber_with_the_wrong_type_may_retry(world: World) -> None:
    """It retries on the same connection and gets latched samples like any late subscriber."""
    wrong, _ = waiting(world, TWIST, STRING)
    appears(world, STRING)
    number = world.link.take(link.Subscribe)[-1].number
    world.subscribed(number, latched=True, publishers=1)
    world.define()
    world.channel.sample(number, text("hi"))
    assert wrong.reported() == [WRONG.format(STRING, TWIST, STRING)]
    wrong.says("subscribe", topic="/later", type=STRING)
    assert heard(wrong) == ["hi"]
    world.channel.sample(number, text("ho"))
    assert heard(wrong) == ["ho"]


def test_a_guess_of_a_type_ends_with_its_clients(world: World) -> None:
    """Another client's guess takes its place."""
    first, _ = waiting(world, TWIST, STRING)
    (guess,) = world.link.take(link.Subscribe)
    first.session.end()
    assert world.link.take(link.Unsubscribe) == [link.Unsubscribe(number=guess.number)]
    assert [ask.type for ask in world.link.take(link.Subscribe)] == [STRING]
    assert world.channel.link_state.names_in_use == 1


def test_subscriber_of_another_guessed_type_is_warned(world: World) -> None:
    """It may be right; the type is still unknown."""
    (first,) = waiting(world, TWIST)
    second = world.person()
    second.says("set_level", level="warning")
    second.says("subscribe", topic="/later", type=STRING)
    assert second.reported() == [
        f"subscribe /later: it does not exist yet, and another client says that its type is {TWIST}; "
        f"messages come if it turns out to be {STRING}"
    ]
    assert not first.reported()


def test_topic_of_wrong_type_is_not_subscribed(world: World) -> None:
    """Clients get one error; when the topic returns with their type, it goes on."""
    (person,) = waiting(world, TWIST)
    (guess,) = world.link.take(link.Subscribe)
    appears(world, STRING)
    appears(world, STRING)
    assert world.link.take(link.Unsubscribe) == [link.Unsubscribe(number=guess.number)]
    assert not world.link.take(link.Subscribe)
    assert person.reported() == [WRONG.format(STRING, TWIST, STRING)]
    appears(world)
    appears(world, TWIST)
    assert [ask.type for ask in world.link.take(link.Subscribe)] == [TWIST]
    assert not person.reported()


def test_publishers_that_come_back_with_another_type_are_followed(world: World) -> None:
    """Clients without a type follow; samples of the former type are no longer sent."""
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
    (moved,) = careless.received("publish")
    assert moved["msg"]["linear"] == {"x": 0.0, "y": 0.0, "z": 0.0}
    assert exact.reported() == [
        f"subscribe /chatter: it has the type {TWIST}, not {STRING}; subscribe with {TWIST} to get it"
    ]
    late = world.person()
    late.says("subscribe", topic="/chatter")
    assert len(late.received("publish")) == 1


def test_publishers_that_come_back_with_another_qos_are_followed(world: World) -> None:
    """The robot reports the QoS it matches now; new latched samples are kept for late subscribers."""
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
    """The first client chooses one of them; another one is an error."""
    world.robot_comes()
    people = [world.person() for _ in range(3)]
    world.robot_joins()
    appears(world, STRING, TWIST)
    for person, type_name in zip(people, (TWIST, STRING, TWIST), strict=True):
        person.says("set_level", level="error")
        person.says("subscribe", topic="/later", type=type_name)
    assert [ask.type for ask in world.link.take(link.Subscribe)] == [TWIST]
    assert [person.reported() for person in people] == [
        [],
        [f"topic /later has several types; it is subscribed as {TWIST} now"],
        [],
    ]
    appears(world, STRING, TWIST)
    assert not world.link.take(link.Subscribe)


def test_another_definition_of_a_type_is_taken(world: World) -> None:
    """A robot that was rebuilt sends its new definitions."""
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
    assert [message["msg"] for message in person.received("publish")] == [
        {"words": "early"},
        {"words": "late"},
    ]


def test_a_topic_that_is_there_is_asked_for_again(world: World) -> None:
    """The pauses grow, the same error is not repeated, and retries end when it succeeds or no client needs
    it.
    """
    number, (person,) = watching(world, {})
    person.says("set_level", level="error")
    world.link.take(link.Subscribe)
    refusal = link.Failed(request="subscribe", reference=str(number), reason="not now")
    pauses = []
    for _ in range(10):
        world.channel.message(refusal)
        before = world.clock.seconds()
        while not world.link.take(link.Subscribe):
            world.clock.advance(0.25)
            person.answers_pings()
        pauses.append(world.clock.seconds() - before)
    assert pauses == [0.25, 0.5, 1, 2, 4, 8, 16, 30, 30, 30]
    assert person.reported() == ["subscribe /chatter: not now"]
    world.subscribed(number)
    world.channel.message(refusal)
    assert person.reported() == ["subscribe /chatter: not now"]
    person.says("unsubscribe", topic="/chatter")
    world.clock.advance(2)
    assert not world.link.take(link.Subscribe)


def test_a_robot_may_need_a_moment_for_another_type(world: World) -> None:
    """Some middleware releases the former type late, so only a lasting error is reported."""
    number, (person,) = watching(world, {})
    person.says("set_level", level="error")
    appears(world, topic="/chatter")
    appears(world, TWIST, topic="/chatter")
    for _ in range(module.SILENT_REFUSALS + 1):
        assert not person.reported()
        ask = world.link.take(link.Subscribe)[-1]
        assert ask.number != number
        world.channel.message(link.Failed(request="subscribe", reference=str(ask.number), reason="not yet"))
        world.clock.advance(2)
        person.answers_pings()
    assert person.reported() == ["subscribe /chatter: not yet"]
