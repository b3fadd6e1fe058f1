"""The relay as a node: ``/relay/ping`` and ``/relay/status``."""

from __future__ import annotations

from typing import Any, NamedTuple

import pytest

from relay_protocol import link
from relay_protocol.rights import Grant, Level, Rules
from relay_server.relay_node.interfaces import SERVICES, STATUS, TYPES
from tests.relay_server.local.asking import ask
from tests.relay_server.memory import STRING, Person, World, text
from tests.relay_server.video.watching import CAMERA, Watcher


def test_ping_is_answered_at_once_or_after_a_round_trip(world: World, viewer: Person) -> None:
    """The robot's round trip is the latest heartbeat's, or measured now."""
    world.robot.rtt = 0.0123
    assert ask(viewer, "/relay/ping")["robot_rtt_ms"] == 12.3
    viewer.says("call_service", service="/relay/ping", args={"robot": True})
    assert not viewer.hears("service_response")
    world.link.pings[-1].callback(0.5)
    (reply,) = viewer.hears("service_response")
    assert reply["values"]["robot_rtt_ms"] == 500
    TYPES.from_json(f"{SERVICES['/relay/ping'].type}_Response", reply["values"], 0)
    world.robot_goes()
    assert ask(viewer, "/relay/ping", {"robot": True}) == "robot rover is offline"


def test_the_relays_status_comes_every_second_while_it_is_wanted(world: World, viewer: Person) -> None:
    """At once, then each second, under the name the client wrote; the robot is never asked."""
    viewer.says("subscribe", topic="relay/status", id="a")
    viewer.says("subscribe", topic="relay/status", id="b")
    (status,) = viewer.hears("publish")
    assert status["topic"] == "relay/status"
    assert status["msg"]["robot"] == "rover"
    assert status["msg"]["level"] == "viewer"
    assert status["msg"]["clients"] == [{"user": "ann", "since": 1.7e9, "camera": ""}]
    assert status["msg"]["motion"]["deadline_ms"] == 500
    world.clock.pump([0.5] * 4)
    assert len(viewer.hears("publish")) == 2
    viewer.says("unsubscribe", topic="/relay/status", id="a")
    world.clock.pump([0.5] * 2)
    assert len(viewer.hears("publish")) == 1
    viewer.says("unsubscribe", topic="/relay/status", id="b")
    world.clock.pump([0.5] * 4)
    assert not viewer.hears("publish")
    assert not world.link.all(link.Subscribe)
    viewer.says("subscribe", topic="/relay/status")
    assert len(viewer.hears("publish")) == 1


def test_status_has_the_fields_of_its_type(world: World, viewer: Person) -> None:
    """Neither more nor less, down to the last."""
    viewer.says("subscribe", topic="/relay/status")
    (told,) = viewer.hears("publish")
    TYPES.from_json(STATUS, told["msg"], 0)
    typedefs = {each["type"]: each for each in TYPES.typedefs(STATUS)}

    def compare(value: Any, type_name: str) -> None:
        known = typedefs[type_name]
        assert set(value) == set(known["fieldnames"]), type_name
        for field, kind in zip(known["fieldnames"], known["fieldtypes"], strict=True):
            inner = value[field]
            for each in inner if isinstance(inner, list) else [inner]:
                if "/" in kind:
                    compare(each, kind)

    compare(told["msg"], "switchboard_msgs/Status")


def test_status_tells_of_the_uplink(world: World, viewer: Person, operator: Person) -> None:
    """What the robot sends and takes for all clients together."""
    operator.says("advertise", topic="/plan", type=STRING)
    operator.says("subscribe", topic="/chatter")
    (advertised,), (wanted,) = world.link.take(link.Advertise), world.link.take(link.Subscribe)
    world.channel.message(
        link.Advertised(number=advertised.number, topic="/plan", type=STRING, encoding="cdr")
    )
    world.subscribed(wanted.number)
    viewer.says("subscribe", topic="/relay/status")
    (told,) = viewer.hears("publish")
    assert told["msg"]["uplink"] == {"state": "open", "subscribed": 1, "published": 1, "sim_time": False}


def test_status_tells_of_the_streams_one_may_view(world: World, viewer: Person) -> None:
    """Who watches, and what the robot sends for them; cameras one may not view are left out."""
    watcher = Watcher()
    stream = watcher.watch(world, link.VideoSettings(width=320))
    Watcher(8).watch(world, camera="/vault/image")
    stream.message(link.Playing(width=320, height=240, quality=55, fps=15.0, reduced=0.4, delay_ms=41.5))
    viewer.says("subscribe", topic="/relay/status")
    (told,) = viewer.hears("publish")
    assert told["msg"]["video"] == [
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
        }
    ]
    TYPES.from_json(STATUS, told["msg"], 0)


class Onlooker(NamedTuple):
    """Somebody who watches."""

    name: str
    camera: str
    address: str = "192.0.2.9"


def test_status_tells_who_watches_what_one_may_view(world: World, viewer: Person) -> None:
    """Beside those who work with the robot."""
    for name, camera in (("bob", CAMERA), ("eve", "/vault/image")):
        world.registry.looks_on(world.robot, Onlooker(name, camera))
    viewer.says("subscribe", topic="/relay/status")
    (told,) = viewer.hears("publish")
    assert [(each["user"], each["camera"]) for each in told["msg"]["clients"]] == [
        ("ann", ""),
        ("bob", CAMERA),
    ]
    TYPES.from_json(STATUS, told["msg"], 0)


def test_status_tells_of_which_topics_the_client_took_too_little(world: World, viewer: Person) -> None:
    """Counted from the subscription on."""
    viewer.says("subscribe", topic="/chatter", queue_length=1)
    viewer.says("subscribe", topic="/cmd_vel")
    viewer.says("subscribe", topic="/relay/status")
    chatter = next(each for each in world.link.all(link.Subscribe) if each.topic == "/chatter")
    world.define()
    world.subscribed(chatter.number)
    viewer.session.pause()
    for words in "abc":
        world.channel.sample(chatter.number, text(words), 0)
    viewer.session.resume()
    viewer.client.take()
    world.clock.advance(1.0)
    (told,) = viewer.hears("publish")
    assert told["msg"]["drops"] == 2
    assert told["msg"]["topic_drops"] == [{"topic": "/chatter", "drops": 2}]
    viewer.says("unsubscribe", topic="/chatter")
    viewer.says("subscribe", topic="/chatter")
    viewer.client.take()
    world.clock.advance(1.0)
    assert viewer.hears("publish")[-1]["msg"]["topic_drops"] == []


def test_status_can_be_denied(viewer: Person) -> None:
    """It is a topic like any other to the judge."""
    viewer.session.permit.rules = Rules([Grant(Level.VIEWER, deny=("subscribe:/relay/*",))])
    viewer.says("set_level", level="error")
    viewer.says("subscribe", topic="/relay/status")
    assert "is denied to you" in viewer.hears("status")[0]["msg"]
    assert ask(viewer, "/rosapi/topic_type", {"topic": "/relay/status"}) == {"type": ""}


def test_a_handler_of_ours_that_breaks_is_answered_without_internals(
    viewer: Person, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The caller does not wait for ever, and learns nothing of our insides."""

    async def broken(session: Any, args: Any) -> Any:
        raise RuntimeError("the secret of our insides")

    monkeypatch.setitem(viewer.session.calling._local._services, "/relay/ping", broken)  # type: ignore[attr-defined]
    assert ask(viewer, "/relay/ping") == "the relay failed on this call; its log tells more"
