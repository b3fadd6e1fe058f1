"""The relay as a node: ``/relay/ping`` and ``/relay/status``."""

from __future__ import annotations

from typing import Any, NamedTuple

import pytest

from relay_protocol import link
from relay_protocol.rights import Grant, Level, Rules
from relay_server.relay_node.interfaces import MODULES, SERVICES, STATUS, TYPES
from tests.worlds.relay import STRING, Person, World, text
from tests.worlds.relay_node_calls import ask
from tests.worlds.viewers import CAMERA, Watcher


def test_ping_is_answered_at_once_or_after_a_round_trip(world: World, viewer: Person) -> None:
    """The robot's round trip is the latest heartbeat's, or measured now."""
    world.robot.rtt = 0.0123
    assert ask(viewer, "/relay/ping")["robot_rtt_ms"] == 12.3
    viewer.says("call_service", service="/relay/ping", args={"robot": True})
    assert not viewer.received("service_response")
    world.link.pings[-1].callback(0.5)
    (reply,) = viewer.received("service_response")
    assert reply["values"]["robot_rtt_ms"] == 500
    TYPES.from_json(f"{SERVICES['/relay/ping'].type}_Response", reply["values"], 0)
    world.robot_goes()
    assert ask(viewer, "/relay/ping", {"robot": True}) == "robot rover is offline"


def test_the_relays_status_is_published_every_second_while_subscribed(world: World, viewer: Person) -> None:
    """At once, then each second, under the name that the client wrote; the robot receives no request."""
    viewer.says("subscribe", topic="relay/status", id="a")
    viewer.says("subscribe", topic="relay/status", id="b")
    (status,) = viewer.received("publish")
    assert status["topic"] == "relay/status"
    assert status["msg"]["robot"] == "rover"
    assert status["msg"]["level"] == "viewer"
    assert status["msg"]["clients"] == [{"user": "ann", "since": 1.7e9, "camera": ""}]
    assert status["msg"]["motion"]["deadline_ms"] == 500
    world.clock.pump([0.5] * 4)
    assert len(viewer.received("publish")) == 2
    viewer.says("unsubscribe", topic="/relay/status", id="a")
    world.clock.pump([0.5] * 2)
    assert len(viewer.received("publish")) == 1
    viewer.says("unsubscribe", topic="/relay/status", id="b")
    world.clock.pump([0.5] * 4)
    assert not viewer.received("publish")
    assert not world.link.all(link.Subscribe)
    viewer.says("subscribe", topic="/relay/status")
    assert len(viewer.received("publish")) == 1


def test_a_throttle_makes_the_relays_periodic_topics_rarer(world: World, viewer: Person) -> None:
    viewer.says("subscribe", topic="/relay/status", throttle_rate=3000)
    assert len(viewer.received("publish")) == 1
    world.clock.pump([0.5] * 5)
    assert not viewer.received("publish")
    world.clock.pump([0.5] * 2)
    assert len(viewer.received("publish")) == 1


def test_modules_have_the_fields_of_their_type(world: World, viewer: Person) -> None:
    world.modules.of(world.robot).modules = (link.ModuleInfo(name="base", kind="command", state="running"),)
    world.module_service._latest_orders[world.robot.robot_id] = []  # as the database has none
    owner = world.person(Level.OWNER)
    owner.says("subscribe", topic="/relay/modules")
    (found,) = owner.received("publish")
    TYPES.from_json(MODULES, found["msg"], 0)
    assert set(found["msg"]) == {"robot", "online", "current", "reported_at", "modules"}
    (base,) = found["msg"]["modules"]
    assert (base["name"], base["pending"]) == ("base", {"action": "", "by": "", "at": 0.0})


def test_processes_of_a_robot_that_is_offline_are_marked(world: World, viewer: Person) -> None:
    modules = world.modules.of(world.robot)
    modules.message_received(link.Modules())
    owner = world.person(Level.OWNER)
    owner.says("subscribe", topic="/relay/processes")
    world.clock.advance(0)
    (measure,) = world.control.take(link.MeasureProcesses)
    row = link.ProcessInfo(pid=7, parent=1, name="python3", part="base", state="running")
    modules.message_received(link.Processes(request=measure.request, at=5.0, processes=[row]))
    world.clock.pump([0.5] * 2)
    latest = owner.received("publish")[-1]["msg"]
    assert (latest["at"], len(latest["processes"]), latest["error"]) == (5.0, 1, "")
    world.robot_goes()
    world.clock.pump([0.5] * 2)
    stale = owner.received("publish")[-1]["msg"]
    assert (stale["at"], stale["processes"], "is offline" in stale["error"]) == (
        5.0,
        latest["processes"],
        True,
    )


def test_status_has_the_fields_of_its_type(world: World, viewer: Person) -> None:
    """Exactly these, at all levels."""
    viewer.says("subscribe", topic="/relay/status")
    (reported,) = viewer.received("publish")
    TYPES.from_json(STATUS, reported["msg"], 0)
    typedefs = {each["type"]: each for each in TYPES.typedefs(STATUS)}

    def compare(value: Any, type_name: str) -> None:
        known = typedefs[type_name]
        assert set(value) == set(known["fieldnames"]), type_name
        for field, kind in zip(known["fieldnames"], known["fieldtypes"], strict=True):
            inner = value[field]
            for each in inner if isinstance(inner, list) else [inner]:
                if "/" in kind:
                    compare(each, kind)

    compare(reported["msg"], "switchboard_msgs/Status")


def test_status_has_the_uplink(world: World, viewer: Person, operator: Person) -> None:
    """It has the rates between robot and relay for all clients together."""
    operator.says("advertise", topic="/plan", type=STRING)
    operator.says("subscribe", topic="/chatter")
    (advertised,), (wanted,) = world.link.take(link.Advertise), world.link.take(link.Subscribe)
    world.channel.message(
        link.Advertised(number=advertised.number, topic="/plan", type=STRING, encoding="cdr")
    )
    world.subscribed(wanted.number)
    viewer.says("subscribe", topic="/relay/status")
    (reported,) = viewer.received("publish")
    assert reported["msg"]["uplink"] == {"state": "open", "subscribed": 1, "published": 1, "sim_time": False}


def test_status_has_the_streams_that_the_user_may_view(world: World, viewer: Person) -> None:
    """It has viewers and the robot's streams; cameras without the right are left out."""
    watcher = Watcher()
    stream = watcher.watch(world, link.VideoSettings(width=320))
    Watcher(8).watch(world, camera="/vault/image")
    stream.message_received(
        link.StreamStatus(width=320, height=240, quality=55, fps=15.0, reduced=0.4, delay_ms=41.5)
    )
    viewer.says("subscribe", topic="/relay/status")
    (reported,) = viewer.received("publish")
    assert reported["msg"]["video"] == [
        {
            "camera": CAMERA,
            "codec": "jpeg",
            "state": stream.state.value,
            "viewers": 1,
            "width": 320,
            "height": 240,
            "quality": 55,
            "fps": 15.0,
            "reduced": 0.4,
            "delay_ms": 41.5,
            "damaged": 0,
        }
    ]
    TYPES.from_json(STATUS, reported["msg"], 0)


class Viewer(NamedTuple):
    """A camera viewer."""

    name: str
    camera: str
    address: str = "192.0.2.9"


def test_status_has_the_viewers_of_visible_streams(world: World, viewer: Person) -> None:
    """Beside the clients of the robot."""
    for name, camera in (("bob", CAMERA), ("eve", "/vault/image")):
        world.registry.viewer_joined(world.robot, Viewer(name, camera))
    viewer.says("subscribe", topic="/relay/status")
    (reported,) = viewer.received("publish")
    assert [(each["user"], each["camera"]) for each in reported["msg"]["clients"]] == [
        ("ann", ""),
        ("bob", CAMERA),
    ]
    TYPES.from_json(STATUS, reported["msg"], 0)


def test_status_has_the_topics_that_the_client_reads_too_slowly(world: World, viewer: Person) -> None:
    """Counted from the subscription on."""
    viewer.says("subscribe", topic="/chatter", queue_length=1)
    viewer.says("subscribe", topic="/cmd_vel")
    viewer.says("subscribe", topic="/relay/status")
    chatter = next(each for each in world.link.all(link.Subscribe) if each.topic == "/chatter")
    world.define()
    world.subscribed(chatter.number)
    viewer.rosbridge.pause()
    for words in "abc":
        world.channel.sample(chatter.number, text(words), 0)
    viewer.rosbridge.resume()
    viewer.client.take()
    world.clock.advance(1.0)
    (reported,) = viewer.received("publish")
    assert reported["msg"]["drops"] == 2
    assert reported["msg"]["topic_drops"] == [{"topic": "/chatter", "drops": 2}]
    viewer.says("unsubscribe", topic="/chatter")
    viewer.says("subscribe", topic="/chatter")
    viewer.client.take()
    world.clock.advance(1.0)
    assert viewer.received("publish")[-1]["msg"]["topic_drops"] == []


def test_status_can_be_denied(viewer: Person) -> None:
    """It has rights like any other topic."""
    viewer.context.permit.rules = Rules([Grant(Level.VIEWER, deny=("subscribe:/relay/*",))])
    viewer.says("set_level", level="error")
    viewer.says("subscribe", topic="/relay/status")
    assert "is denied to you" in viewer.received("status")[0]["msg"]
    assert ask(viewer, "/rosapi/topic_type", {"topic": "/relay/status"}) == {"type": ""}


def test_a_handler_of_ours_that_breaks_is_answered_without_internals(
    viewer: Person, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The caller gets an error without internal details."""

    async def broken(session: Any, args: Any) -> Any:
        raise RuntimeError("the secret of our insides")

    monkeypatch.setitem(viewer.session.service_calls._local._services, "/relay/ping", broken)  # type: ignore[attr-defined]
    assert ask(viewer, "/relay/ping") == "the relay failed on this call; see its log"
