"""What leaves an event by itself, in whose name, and how much of it."""

from __future__ import annotations

import json
from typing import Any

import pytest
from twisted.internet.task import Clock

from relay_db.queries import AlertRecord, NewStoredEvent
from relay_protocol import link
from relay_server.events.bus import EventBus
from relay_server.events.collector import EventCollector
from relay_server.events.limits import NOTED_AT_ONCE
from relay_server.events.writer import EventWriter
from relay_server.robots.registry import SETTLING_SECONDS, RobotRegistry
from tests.relay_server.memory import FIBONACCI, STRING, TRIGGER, TWIST, Person, Time, World

GO = {"linear": {"x": 0.5}}


class Notes(EventWriter):
    """A writer that keeps what it is given."""

    def __init__(self) -> None:
        store: Any = None
        super().__init__(Clock(), store, lambda: 0.0, lambda events: None)
        self.events: list[NewStoredEvent] = []

    def note(self, event: NewStoredEvent) -> None:
        """Keep it."""
        self.events.append(event)


@pytest.fixture
def notes() -> Notes:
    """Nothing noted yet."""
    return Notes()


@pytest.fixture
def noticing(notes: Notes, time: Time) -> EventCollector:
    """What takes notes; it knows rover."""
    registry = RobotRegistry(time)
    registry.presence(1, "rover", "lab")
    return EventCollector(notes, registry, time, time)


def test_an_event_of_a_robot_is_in_its_name_and_says_who_did_it(
    notes: Notes, noticing: EventCollector
) -> None:
    """In the robot's realm; addresses are for owners, and not everybody who reads is one."""
    noticing.happened(
        "control.taken",
        "user:ann",
        1,
        {"robot": "rover", "user": "ann", "address": "192.0.2.1", "why": "x" * 500},
    )
    (event,) = notes.events
    assert event[:6] == ("lab", 1000.0, "relay:rover", "control.taken", 1, "ann")
    assert json.loads(event.data) == {"why": "x" * 254 + "…"}


def test_an_event_of_a_shared_robot_is_told_in_all_its_realms(time: Time, notes: Notes) -> None:
    """Who did it is a user in his own realm, in the others a full name; what nobody did is the same."""
    registry = RobotRegistry(time)
    registry.share({1: frozenset({"lab2"})})
    assert registry.presence(1, "rover", "lab").realms == {"lab", "lab2"}
    noticing = EventCollector(notes, registry, time, time)
    noticing.happened("control.taken", "user:ann@lab2", 1, {"why": "why not"})
    noticing.happened("control.released", "user:bob", 1, {})
    noticing.happened("robot.offline", "relay", 1, {})
    told = [(each.realm, each.kind, each.user, json.loads(each.data)) for each in notes.events]
    assert told == [
        ("lab", "control.taken", None, {"why": "why not", "by": "ann@lab2"}),
        ("lab2", "control.taken", "ann", {"why": "why not"}),
        ("lab", "control.released", "bob", {}),
        ("lab2", "control.released", None, {"by": "bob@lab"}),
        ("lab", "robot.offline", None, {}),
        ("lab2", "robot.offline", None, {}),
    ]
    assert {each.source for each in notes.events} == {"relay:rover"}


def test_who_is_of_another_realm_takes_no_room_from_what_becomes_of_a_robot(time: Time, notes: Notes) -> None:
    """His share is his own, and what the robot does by itself has another."""
    registry = RobotRegistry(time)
    registry.share({1: frozenset({"lab2"})})
    registry.presence(1, "rover", "lab")
    noticing = EventCollector(notes, registry, time, time)
    for _ in range(NOTED_AT_ONCE + 5):
        noticing.happened("call.begun", "user:ann@lab2", 1, {"service": "/reset"})
    noticing.happened("robot.offline", "relay", 1, {})
    told = [(each.realm, each.kind) for each in notes.events]
    assert told[-2:] == [("lab", "robot.offline"), ("lab2", "robot.offline")]
    assert [kind for _, kind in told].count("call.begun") == NOTED_AT_ONCE


def test_a_recording_is_told_at_home_without_what_is_in_it(time: Time, notes: Notes) -> None:
    """Its realm is that of who recorded; why it ended may name what not everybody of the robot may see."""
    registry = RobotRegistry(time)
    registry.share({1: frozenset({"lab2"})})
    registry.presence(1, "rover", "lab")
    noticing = EventCollector(notes, registry, time, time)
    noticing.happened("recording.started", "user:ann@lab2", 1, {"recording": "r1", "address": "192.0.2.1"})
    ended = {"recording": "r1", "state": "complete", "reason": "you may not view /eye", "bytes": 5}
    noticing.happened("recording.ended", "user:ann@lab2", 1, ended)
    told = [(each.realm, each.kind, each.user, json.loads(each.data)) for each in notes.events]
    assert told == [
        ("lab2", "recording.started", "ann", {"recording": "r1"}),
        ("lab2", "recording.ended", "ann", {"recording": "r1", "state": "complete"}),
    ]


def test_nodes_that_come_and_go_are_told_once(world: World, notes: Notes) -> None:
    """While the robot is there and has told of those that it had when it came, however it tells of them."""
    noticing = EventCollector(notes, world.registry, world.clock.seconds, world.clock.seconds)
    world.registry.on_modules(noticing.modules)

    def told(**graph: Any) -> list[tuple[str, str]]:
        notes.events.clear()
        world.registry.graph(world.robot, link.Graph(**graph))
        return [(each.kind, json.loads(each.data)["module"]) for each in notes.events]

    world.robot_comes()
    assert told(nodes={"/late": {}}) == []
    world.wait(SETTLING_SECONDS)
    assert told(nodes={"/arm": {}, "/_hidden": {}}) == [("module.up", "/arm")]
    assert told(nodes={"/arm": {}}) == told(topics={"/x": link.Topic(types=[])}) == []
    assert told(nodes={"/arm": None, "/nobody": None}) == [("module.down", "/arm")]
    assert told(full=True, nodes={"/late": {}, "/eye": {}})[:2] == [
        ("module.up", "/eye"),
        ("module.down", "/base"),
    ]
    notes.events.clear()
    world.robot_goes()
    world.wait(60.0)
    world.robot_comes()
    assert notes.events == []


def test_nodes_that_flutter_take_no_room_from_what_becomes_of_the_robot(
    notes: Notes, noticing: EventCollector, time: Time
) -> None:
    """They have a share of their own."""
    rover = RobotRegistry(time).presence(1, "rover", "lab")
    noticing.modules(rover, [f"/n{each}" for each in range(NOTED_AT_ONCE + 5)], [])
    noticing.happened("robot.stopped", "relay", 1, {})
    assert (len(notes.events), notes.dropped) == (NOTED_AT_ONCE + 1, 5)
    assert notes.events[0][2:6] == ("relay:rover", "module.up", 1, None)


def test_a_refused_login_is_told_in_full(notes: Notes, noticing: EventCollector) -> None:
    """Only administrators read it."""
    data = {"user": "ann", "address": "192.0.2.1", "reason": "bad_credentials"}
    noticing.happened("login.refused", "relay", None, data)
    (event,) = notes.events
    assert (event.realm, event.source, event.user, json.loads(event.data)) == ("default", "relay", None, data)


def test_a_refused_login_is_told_in_the_realm_that_was_named(notes: Notes, noticing: EventCollector) -> None:
    """Whether there is such a realm or not; which it is belongs to the event, and not to what it says."""
    noticing.happened("login.refused", "relay", None, {"user": "ann@LAB", "realm": "lab"})
    assert [(each.realm, json.loads(each.data)) for each in notes.events] == [("lab", {"user": "ann@LAB"})]


@pytest.mark.parametrize("realm", [None, ""])
def test_a_refused_login_of_no_realm_is_told_to_nobody(
    notes: Notes, noticing: EventCollector, realm: str | None
) -> None:
    """A program that nobody has, or a realm that can't be; the journal has it all the same."""
    noticing.happened("login.refused", "relay", None, {"program": "swp_1", "realm": realm})
    assert (notes.events, notes.dropped) == ([], 0)


def test_a_flood_in_one_realm_leaves_room_in_others(notes: Notes, noticing: EventCollector) -> None:
    """Of logins, and of what users of the same name do; what strangers name for realms has one share together."""
    notes.exist(["lab", "plant"])

    def refused(realm: str) -> int:
        before = len(notes.events)
        noticing.happened("login.refused", "relay", None, {"user": "x", "realm": realm})
        return len(notes.events) - before

    assert sum(refused("lab") for _ in range(NOTED_AT_ONCE + 5)) == NOTED_AT_ONCE
    assert refused("plant") == refused("default") == 1
    assert sum(refused(f"nowhere{each}") for each in range(NOTED_AT_ONCE + 5)) == NOTED_AT_ONCE
    assert refused("plant") == 1
    notes.events.clear()
    for realm in ("lab", "plant"):
        event = NewStoredEvent(realm, 5.0, "directory", "registered", None, "ann", "{}")
        for _ in range(NOTED_AT_ONCE + 5):
            noticing.note(event)
    assert [each.realm for each in notes.events] == ["lab"] * NOTED_AT_ONCE + ["plant"] * NOTED_AT_ONCE


def test_what_is_not_for_the_memory_leaves_nothing(notes: Notes, noticing: EventCollector) -> None:
    """Nor does what is about a robot that is gone."""
    noticing.happened("client.refused", "user:ann", 1, {})
    for kind in ("video.joined", "video.left"):
        noticing.happened(kind, "user:ann", 1, {"camera": "/eye", "snapshot": True})
    noticing.happened("robot.online", "relay", 2, {})
    assert notes.events == []


def test_what_comes_too_often_is_counted(notes: Notes, noticing: EventCollector, time: Time) -> None:
    """Of one user on one robot; others are not concerned."""
    for _ in range(NOTED_AT_ONCE + 50):
        noticing.happened("call.begun", "user:ann", 1, {"service": "/x"})
    assert (len(notes.events), notes.dropped) == (NOTED_AT_ONCE, 50)
    noticing.happened("call.begun", "user:bob", 1, {"service": "/x"})
    time.now += 1
    noticing.happened("call.begun", "user:ann", 1, {"service": "/x"})
    assert len(notes.events) == NOTED_AT_ONCE + 2


def test_data_that_is_too_large_is_left_out(notes: Notes, noticing: EventCollector) -> None:
    """The event is not."""
    noticing.happened("goal.begun", "user:ann", 1, {f"field{n}": "\N{GRINNING FACE}" * 255 for n in range(3)})
    assert set(json.loads(notes.events[0].data)) == {"left_out"}


@pytest.mark.parametrize(("kind", "told"), [("battery", True), ("stale", False), ("diagnostics", False)])
def test_words_of_an_alert_are_told_where_they_take_no_further_right(
    notes: Notes, noticing: EventCollector, kind: str, told: bool
) -> None:
    """That there is one is told in any case."""
    alert = AlertRecord(
        "a1", 1, "rover", "default", kind, "part", "error", "words", 1.0, 2.0, 1, 1, None, None, None
    )
    noticing.alert("begun", alert)
    (event,) = notes.events
    words = {"about": "part", "text": "words"} if told else {}
    assert (event.kind, event.source) == ("alert.begun", "relay:rover")
    assert json.loads(event.data) == {"alert": "a1", "alert_kind": kind, "level": "error", **words}


def test_a_witness_of_the_journal_hears_who_says_so(time: Time, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also of what is not kept there."""
    store: Any = None
    journal = EventBus(store, time)
    monkeypatch.setattr(journal, "_write", lambda *_: None)
    heard: list[Any] = []
    journal.witness(lambda *what: heard.append(what))
    journal.event("x", "user:ann", cause="a", robot_id=1, n=1)
    journal.tell("y", 1, "user:bob", n=2)
    journal.tell("z", 2)
    assert heard == [("x", "user:ann", 1, {"n": 1}), ("y", "user:bob", 1, {"n": 2}), ("z", "relay", 2, {})]


# --- what clients do ---------------------------------------------------------------------------------------


def noticed(person: Person) -> list[tuple[str, dict[str, Any]]]:
    """What is noted of a client from now on."""
    notes: list[tuple[str, dict[str, Any]]] = []
    person.session.notice = lambda kind, **data: notes.append((kind, data))
    return notes


def drive(person: Person, msg: Any = GO) -> None:
    """A fresh command."""
    person.session._pinging.ping()
    person.answers_pings()
    person.says("publish", topic="/cmd_vel", msg=msg)


def test_the_first_command_that_moves_is_noted_once_for_each_time_of_control(world: World) -> None:
    """Zeros are not, nor what follows."""
    world.robot_comes(encodings=["json"])
    ann = world.person()
    world.robot_joins()
    world.registry.described(world.robot, link.Describe(motion=link.MotionPolicy(types=[TWIST])))
    ann.says("advertise", topic="/cmd_vel", type=TWIST)
    notes, begun = noticed(ann), ("motion.begun", {"topic": "/cmd_vel"})
    drive(ann, {"linear": {"x": 0.0}})
    assert notes == []
    for _ in range(20):
        drive(ann)
        world.wait(0.1, ann)
    assert notes == [begun]
    ann.says("call_service", id="r", service="/relay/release_control")
    world.wait(1.0, ann)
    drive(ann)
    world.wait(0.5, ann)
    drive(ann)
    assert notes == [begun, begun]


def test_the_first_message_to_a_topic_is_noted(world: World) -> None:
    """Not the next ones, also when something has changed meanwhile; not to one that moves the robot."""
    world.robot_comes(encodings=["json"])
    ann = world.person()
    world.robot_joins()
    world.registry.described(world.robot, link.Describe(motion=link.MotionPolicy(types=[TWIST])))
    notes = noticed(ann)
    for topic in ("/chatter", "chatter", "/other", "/chatter"):
        ann.says("publish", topic=topic, type=STRING, msg={"data": "x"})
    ann.says("publish", topic="/cmd_vel", type=TWIST, msg={})
    world.registry.described(world.robot, link.Describe(motion=link.MotionPolicy(types=[TWIST])))
    ann.says("publish", topic="/chatter", type=STRING, msg={"data": "x"})
    assert notes == [("publication.begun", {"topic": each}) for each in ("/chatter", "/other")]


def test_a_call_of_the_robot_is_noted_when_it_begins_and_ends(world: World) -> None:
    """With whether it was answered; the relay's own services are not the robot's."""
    world.robot_comes()
    ann = world.person()
    world.robot_joins()
    notes = noticed(ann)
    ann.says("call_service", id="1", service="/relay/ping")
    ann.says("call_service", id="2", service="/reset", type=TRIGGER)
    assert notes == [("call.begun", {"service": "/reset"})]
    world.wait(60.0, ann)
    ann.says("call_service", id="3", service="/reset", type=TRIGGER)
    ann.session.end()
    ended = ("call.ended", {"service": "/reset", "ok": False})
    assert notes == [notes[0], ended, notes[0], ended]


def test_a_goal_is_noted_when_it_begins_and_ends(world: World) -> None:
    """Also by its client's end; one that is refused never began."""
    world.robot_comes()
    ann = world.person()
    world.robot_joins()
    notes = noticed(ann)
    for id in ("g", "g", "h"):
        ann.says("send_action_goal", id=id, action="count", action_type=FIBONACCI, args={"order": 3})
    ann.says("cancel_action_goal", id="g", action="count")
    world.wait(60.0, ann)
    kinds = [(kind, data["goal"]) for kind, data in notes]
    assert sorted(kinds) == [
        ("goal.begun", "g"),
        ("goal.begun", "h"),
        ("goal.ended", "g"),
        ("goal.ended", "h"),
    ]
    ann.says("send_action_goal", id="i", action="count", action_type=FIBONACCI, args={"order": 3})
    ann.session.end()
    assert notes[-2:] == [
        ("goal.begun", {"action": "/count", "goal": "i"}),
        ("goal.ended", {"action": "/count", "goal": "i", "status": 5}),
    ]


def test_what_is_put_together_elsewhere_is_kept_as_it_is(notes: Notes, noticing: EventCollector) -> None:
    """As much as of anything else."""
    event = NewStoredEvent("lab", 5.0, "relay:rover", "registered", 1, "ann", "{}")
    for _ in range(NOTED_AT_ONCE + 1):
        noticing.note(event)
    assert notes.events == [event] * NOTED_AT_ONCE and notes.dropped == 1
