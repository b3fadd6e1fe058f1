"""Topics that carry pictures take the right to view them, whenever it shows what they carry."""

from __future__ import annotations

import pytest

from relay_protocol import link
from relay_protocol.rights import Grant, Level, Rules
from relay_server.access import PICTURES, may_subscribe
from tests.relay_server.local.asking import ask
from tests.relay_server.memory import STRING, Person, World

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
INFO = "sensor_msgs/msg/CameraInfo"
PACKED = "/camera/image_raw/compressed"
BLIND = ("view:/camera/*",)
DENIED = f"view on {PACKED} is denied to you by 'view:/camera/*'"


def graph(**types: str) -> link.Graph:
    """Topics below /camera, with ``_`` for ``/``."""
    return link.Graph(
        topics={
            f"/camera/{name.replace('__', '/')}": link.Topic(types=[type], publishers=["/eye"])
            for name, type in types.items()
        }
    )


def blind(world: World) -> Person:
    """Somebody who may view no camera and wants to hear of errors."""
    person = world.person(deny=BLIND)
    person.says("set_level", level="error")
    return person


def asked(world: World) -> list[str]:
    """The topics the robot was asked for."""
    return [each.topic for each in world.link.all(link.Subscribe)]


@pytest.fixture
def world() -> World:
    """A robot with a camera, at work."""
    world = World()
    world.robot_comes()
    world.person(user=6)
    world.robot_joins()
    world.registry.graph(world.robot, graph(image_raw__compressed=COMPRESSED, info=INFO))
    return world


@pytest.mark.parametrize("type_name", sorted(PICTURES))
def test_pictures_take_the_right_to_view_them(type_name: str) -> None:
    """Beside that to subscribe; each is denied in its own words."""
    world = World()
    world.registry.graph(world.robot, graph(x=type_name))
    for denied, reason in (
        ("view:/camera/x", "view on"),
        ("subscribe:/camera/x", "subscribe on"),
        ("view:/y", ""),
    ):
        verdict = may_subscribe(Rules([Grant(Level.VIEWER, deny=(denied,))]).judge, world.robot, "/camera/x")
        assert (verdict.allowed, verdict.reason.startswith(reason)) == (not reason, True)


def test_a_camera_is_one_whatever_its_topic_says(world: World) -> None:
    """The robot knows what its cameras are."""
    rules = Rules([Grant(Level.VIEWER, deny=BLIND)])
    assert may_subscribe(rules.judge, world.robot, "/camera/info").allowed
    world.registry.cameras(world.robot, link.Cameras(cameras=[link.Camera(name="/camera/info", type="x")]))
    assert not may_subscribe(rules.judge, world.robot, "/camera/info").allowed


def test_who_may_not_view_a_camera_does_not_hear_its_topic(world: World) -> None:
    """Whatever type is said; the camera's other topics are heard."""
    person = blind(world)
    for said in ({}, {"type": STRING}, {"type": COMPRESSED}, {"compression": "cbor-raw"}):
        person.says("subscribe", topic=PACKED, **said)
        assert person.told() == [DENIED]
    person.says("subscribe", topic="/camera/info")
    assert person.told() == []
    assert PACKED not in asked(world)


def test_a_topic_of_which_nobody_knows_the_type_may_carry_pictures(world: World) -> None:
    """One that is not there yet is waited for by who says that it carries none."""
    person = blind(world)
    world.robot_goes()
    person.says("subscribe", topic="/camera/later")
    assert "view on /camera/later is denied" in person.told()[0]
    person.says("subscribe", topic="/camera/later", type=IMAGE)
    assert "view on /camera/later is denied" in person.told()[0]
    person.says("subscribe", topic="/camera/later", type=INFO)
    assert person.told() == []


def test_what_another_client_says_of_a_topic_is_believed(world: World) -> None:
    """For whoever leaves the type to others."""
    other, person = world.person(user=8), blind(world)
    other.says("subscribe", topic="/camera/later", type=IMAGE)
    person.says("subscribe", topic="/camera/later")
    assert "view on /camera/later is denied" in person.told()[0]


def test_a_topic_that_turns_out_to_carry_pictures_is_heard_no_more(world: World) -> None:
    """Before the robot is asked for it with the new type."""
    person = blind(world)
    person.says("subscribe", topic="/camera/later", type=INFO)
    person.says("subscribe", topic="/camera/info")
    before = len(asked(world))
    world.registry.graph(world.robot, graph(later=IMAGE, info=IMAGE))
    assert [words.partition(":")[0] for words in person.told()] == [
        "unsubscribed from /camera/later",
        "unsubscribed from /camera/info",
    ]
    assert len(asked(world)) == before


def test_a_topic_that_turns_out_to_be_a_camera_is_heard_no_more(world: World) -> None:
    """By what the robot tells of its cameras."""
    person = blind(world)
    person.says("subscribe", topic="/camera/info")
    world.registry.cameras(world.robot, link.Cameras(cameras=[link.Camera(name="/camera/info", type="x")]))
    assert "unsubscribed from /camera/info: view on" in person.told()[0]


def test_a_right_to_view_that_is_revoked_ends_what_is_heard(world: World) -> None:
    """Also while the robot is away; what carries no pictures goes on."""
    people = [world.person(), world.person()]
    for person in people:
        person.says("set_level", level="error")
        person.says("subscribe", topic=PACKED)
        person.says("subscribe", topic="/camera/info")
    for person in people:
        person.session.permit.rules = Rules([Grant(Level.OPERATOR, deny=BLIND)])
        person.session.permit.on_change()
        assert person.told() == [f"unsubscribed from {PACKED}: {DENIED}"]
        world.robot_goes()


def test_who_may_not_view_a_camera_does_not_find_its_topic(world: World) -> None:
    """In no list, unless he may publish there; and at once when the robot names a camera."""
    viewer = world.person(Level.VIEWER, deny=BLIND)
    everything = world.person(Level.VIEWER)
    assert PACKED not in ask(viewer, "/rosapi/topics")["topics"]
    assert ask(viewer, "/rosapi/topic_type", {"topic": PACKED}) == {"type": ""}
    assert "/camera/info" in ask(viewer, "/rosapi/topics")["topics"]
    assert PACKED in ask(everything, "/rosapi/topics")["topics"]
    world.registry.cameras(world.robot, link.Cameras(cameras=[link.Camera(name="/camera/info", type="x")]))
    assert "/camera/info" not in ask(viewer, "/rosapi/topics")["topics"]
