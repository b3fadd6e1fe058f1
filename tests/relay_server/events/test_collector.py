"""Which occurrences become events, their source, and their rate limits."""

from __future__ import annotations

import json
from typing import Any

import pytest
from twisted.internet.task import Clock

from relay_db.queries import AlertRecord, NewStoredEvent
from relay_protocol import link
from relay_server.events.bus import BusEvent
from relay_server.events.collector import EventCollector
from relay_server.events.limits import RECORDED_AT_ONCE
from relay_server.events.writer import EventWriter
from relay_server.robots.registry import SETTLING_SECONDS, RobotRegistry
from tests.worlds.relay import FIBONACCI, STRING, TRIGGER, TWIST, Person, Time, World

GO = {"linear": {"x": 0.5}}


class Notes(EventWriter):
    """A writer that stores events in a list."""

    def __init__(self) -> None:
        store: Any = None
        super().__init__(Clock(), store, lambda: 0.0, lambda events: None)
        self.events: list[NewStoredEvent] = []

    def append(self, event: NewStoredEvent) -> None:
        """Stores the event."""
        self.events.append(event)


@pytest.fixture
def notes() -> Notes:
    """An empty writer."""
    return Notes()


@pytest.fixture
def collector(notes: Notes, time: Time) -> EventCollector:
    """An event collector that knows rover."""
    registry = RobotRegistry(time)
    registry.robot(1, "rover", "lab")
    return EventCollector(notes, registry, time, time)


def happened(
    collector: EventCollector, kind: str, source: str, robot_id: int | None, data: dict[str, Any]
) -> None:
    """An event of the bus."""
    collector.on_bus_event(BusEvent(kind, robot_id, source, data))


def test_an_event_about_a_robot_has_its_source_and_the_user(notes: Notes, collector: EventCollector) -> None:
    happened(
        collector,
        "control.taken",
        "user:ann",
        1,
        {"robot": "rover", "user": "ann", "address": "192.0.2.1", "why": "x" * 500},
    )
    (event,) = notes.events
    assert event[:6] == ("lab", 1000.0, "relay:rover", "control.taken", 1, "ann")
    assert json.loads(event.data) == {"why": "x" * 254 + "…"}


def test_an_event_of_a_shared_robot_is_stored_in_all_its_realms(time: Time, notes: Notes) -> None:
    registry = RobotRegistry(time)
    registry.share({1: frozenset({"lab2"})})
    assert registry.robot(1, "rover", "lab").realms == {"lab", "lab2"}
    collector = EventCollector(notes, registry, time, time)
    happened(collector, "control.taken", "user:ann@lab2", 1, {"why": "why not"})
    happened(collector, "control.released", "user:bob", 1, {})
    happened(collector, "robot.offline", "relay", 1, {})
    reported = [(each.realm, each.kind, each.user, json.loads(each.data)) for each in notes.events]
    assert reported == [
        ("lab", "control.taken", None, {"why": "why not", "by": "ann@lab2"}),
        ("lab2", "control.taken", "ann", {"why": "why not"}),
        ("lab", "control.released", "bob", {}),
        ("lab2", "control.released", None, {"by": "bob@lab"}),
        ("lab", "robot.offline", None, {}),
        ("lab2", "robot.offline", None, {}),
    ]
    assert {each.source for each in notes.events} == {"relay:rover"}


def test_users_of_other_realms_have_a_rate_limit_of_their_own(time: Time, notes: Notes) -> None:
    registry = RobotRegistry(time)
    registry.share({1: frozenset({"lab2"})})
    registry.robot(1, "rover", "lab")
    collector = EventCollector(notes, registry, time, time)
    for _ in range(RECORDED_AT_ONCE + 5):
        happened(collector, "call.begun", "user:ann@lab2", 1, {"service": "/reset"})
    happened(collector, "robot.offline", "relay", 1, {})
    reported = [(each.realm, each.kind) for each in notes.events]
    assert reported[-2:] == [("lab", "robot.offline"), ("lab2", "robot.offline")]
    assert [kind for _, kind in reported].count("call.begun") == RECORDED_AT_ONCE


def test_a_recording_is_stored_in_the_users_realm_without_topics(time: Time, notes: Notes) -> None:
    registry = RobotRegistry(time)
    registry.share({1: frozenset({"lab2"})})
    registry.robot(1, "rover", "lab")
    collector = EventCollector(notes, registry, time, time)
    happened(collector, "recording.started", "user:ann@lab2", 1, {"recording": "r1", "address": "192.0.2.1"})
    ended = {"recording": "r1", "state": "complete", "reason": "you may not view /eye", "bytes": 5}
    happened(collector, "recording.ended", "user:ann@lab2", 1, ended)
    reported = [(each.realm, each.kind, each.user, json.loads(each.data)) for each in notes.events]
    assert reported == [
        ("lab2", "recording.started", "ann", {"recording": "r1"}),
        ("lab2", "recording.ended", "ann", {"recording": "r1", "state": "complete"}),
    ]


def test_change_of_nodes_is_one_event(world: World, notes: Notes) -> None:
    collector = EventCollector(notes, world.registry, world.clock.seconds, world.clock.seconds)
    world.registry.on_nodes(collector.on_nodes_changed)

    def reported(**graph: Any) -> list[tuple[str, str]]:
        notes.events.clear()
        world.registry.graph(world.robot, link.Graph(**graph))
        return [(each.kind, json.loads(each.data)["node"]) for each in notes.events]

    world.robot_comes()
    assert reported(nodes={"/late": {}}) == []
    world.wait(SETTLING_SECONDS)
    assert reported(nodes={"/arm": {}, "/_hidden": {}}) == [("node.up", "/arm")]
    assert reported(nodes={"/arm": {}}) == reported(topics={"/x": link.Topic(types=[])}) == []
    assert reported(nodes={"/arm": None, "/nobody": None}) == [("node.down", "/arm")]
    assert reported(full=True, nodes={"/late": {}, "/eye": {}})[:2] == [
        ("node.up", "/eye"),
        ("node.down", "/base"),
    ]
    notes.events.clear()
    world.robot_goes()
    world.wait(60.0)
    world.robot_comes()
    assert notes.events == []


def test_flapping_nodes_have_a_rate_limit_of_their_own(
    notes: Notes, collector: EventCollector, time: Time
) -> None:
    rover = RobotRegistry(time).robot(1, "rover", "lab")
    collector.on_nodes_changed(rover, [f"/n{each}" for each in range(RECORDED_AT_ONCE + 5)], [])
    happened(collector, "robot.stopped", "relay", 1, {})
    assert (len(notes.events), notes.dropped) == (RECORDED_AT_ONCE + 1, 5)
    assert notes.events[0][2:6] == ("relay:rover", "node.up", 1, None)


def test_a_refused_login_is_stored_in_full(notes: Notes, collector: EventCollector) -> None:
    data = {"user": "ann", "address": "192.0.2.1", "reason": "bad_credentials"}
    happened(collector, "login.refused", "relay", None, data)
    (event,) = notes.events
    assert (event.realm, event.source, event.user, json.loads(event.data)) == ("default", "relay", None, data)


def test_a_refused_login_is_stored_in_the_named_realm(notes: Notes, collector: EventCollector) -> None:
    """Even if the realm does not exist. The realm belongs to the event, not to its data."""
    happened(collector, "login.refused", "relay", None, {"user": "ann@LAB", "realm": "lab"})
    assert [(each.realm, json.loads(each.data)) for each in notes.events] == [("lab", {"user": "ann@LAB"})]


@pytest.mark.parametrize("realm", [None, ""])
def test_a_refused_login_without_a_realm_is_not_stored(
    notes: Notes, collector: EventCollector, realm: str | None
) -> None:
    """The OAuth client is unknown, or the realm's name is invalid."""
    happened(collector, "login.refused", "relay", None, {"client_id": "swc_1", "realm": realm})
    assert (notes.events, notes.dropped) == ([], 0)


def test_a_flood_in_one_realm_leaves_room_in_others(notes: Notes, collector: EventCollector) -> None:
    notes.set_realms(["lab", "plant"])

    def refused(realm: str) -> int:
        before = len(notes.events)
        happened(collector, "login.refused", "relay", None, {"user": "x", "realm": realm})
        return len(notes.events) - before

    assert sum(refused("lab") for _ in range(RECORDED_AT_ONCE + 5)) == RECORDED_AT_ONCE
    assert refused("plant") == refused("default") == 1
    assert sum(refused(f"nowhere{each}") for each in range(RECORDED_AT_ONCE + 5)) == RECORDED_AT_ONCE
    assert refused("plant") == 1
    notes.events.clear()
    for realm in ("lab", "plant"):
        event = NewStoredEvent(realm, 5.0, "directory", "registered", None, "ann", "{}")
        for _ in range(RECORDED_AT_ONCE + 5):
            collector.record(event)
    assert [each.realm for each in notes.events] == ["lab"] * RECORDED_AT_ONCE + ["plant"] * RECORDED_AT_ONCE


def test_other_kinds_are_not_stored(notes: Notes, collector: EventCollector) -> None:
    happened(collector, "robot.alert", "robot:rover", 1, {})
    for kind in ("video.joined", "video.left"):
        happened(collector, kind, "user:ann", 1, {"camera": "/eye", "snapshot": True})
    happened(collector, "robot.online", "relay", 2, {})
    assert notes.events == []


def test_refusals_have_a_source_and_a_share_of_their_own(notes: Notes, collector: EventCollector) -> None:
    """Many refusals displace no other events of the user or the realm; only administrators read them."""
    notes.set_realms(["lab"])
    for _ in range(RECORDED_AT_ONCE + 5):
        happened(collector, "client.refused", "user:ann", None, {"realm": "lab", "robot": "tank"})
    happened(collector, "fleet.done", "user:ann", None, {"realm": "lab", "robots": 1})
    assert notes.events[0][:6] == ("lab", 1000.0, "relay.refused", "client.refused", None, "ann")
    assert notes.events[-1][2:6] == ("relay", "fleet.done", None, "ann")
    assert (len(notes.events), notes.dropped) == (RECORDED_AT_ONCE + 1, 5)


def test_events_over_the_rate_limit_are_counted(notes: Notes, collector: EventCollector, time: Time) -> None:
    for _ in range(RECORDED_AT_ONCE + 50):
        happened(collector, "call.begun", "user:ann", 1, {"service": "/x"})
    assert (len(notes.events), notes.dropped) == (RECORDED_AT_ONCE, 50)
    happened(collector, "call.begun", "user:bob", 1, {"service": "/x"})
    time.now += 1
    happened(collector, "call.begun", "user:ann", 1, {"service": "/x"})
    assert len(notes.events) == RECORDED_AT_ONCE + 2


def test_data_that_is_too_large_is_left_out(notes: Notes, collector: EventCollector) -> None:
    """The event is stored."""
    happened(
        collector, "goal.begun", "user:ann", 1, {f"field{n}": "\N{GRINNING FACE}" * 255 for n in range(3)}
    )
    assert set(json.loads(notes.events[0].data)) == {"left_out"}


@pytest.mark.parametrize(("kind", "reported"), [("battery", True), ("stale", False), ("diagnostics", False)])
def test_texts_of_alerts_are_stored_unless_they_need_further_rights(
    notes: Notes, collector: EventCollector, kind: str, reported: bool
) -> None:
    alert = AlertRecord(
        "a1", 1, "rover", "default", kind, "part", "error", "words", 1.0, 2.0, 1, 1, None, None, None
    )
    collector.on_alert("begun", alert)
    (event,) = notes.events
    words = {"about": "part", "text": "words"} if reported else {}
    assert (event.kind, event.source) == ("alert.begun", "relay:rover")
    assert json.loads(event.data) == {"alert": "a1", "alert_kind": kind, "level": "error", **words}


# --- operations of clients --------------------------------------------------------------------------------


def noticed(person: Person) -> list[tuple[str, dict[str, Any]]]:
    """Events of a client from now on."""
    notes: list[tuple[str, dict[str, Any]]] = []
    person.context.activity = lambda kind, **data: notes.append((kind, data))
    return notes


def drive(person: Person, msg: Any = GO) -> None:
    """Sends a fresh command."""
    person.rosbridge.ping()
    person.answers_pings()
    person.says("publish", topic="/cmd_vel", msg=msg)


def test_the_first_command_that_moves_is_noted_once_for_each_time_of_control(world: World) -> None:
    """Zero commands and later commands are not stored."""
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
    """The end says whether it was answered; the relay's own services do not count."""
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


def test_events_of_other_parts_are_stored_unchanged(notes: Notes, collector: EventCollector) -> None:
    event = NewStoredEvent("lab", 5.0, "relay:rover", "registered", 1, "ann", "{}")
    for _ in range(RECORDED_AT_ONCE + 1):
        collector.record(event)
    assert notes.events == [event] * RECORDED_AT_ONCE and notes.dropped == 1
