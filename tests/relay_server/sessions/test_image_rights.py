"""Topics that carry images need the right to view, as soon as their type is known."""

from __future__ import annotations

import pytest

from relay_protocol import link
from relay_protocol.rights import Grant, Level, Rules
from relay_server.access import may_subscribe
from relay_server.robots.message_types import IMAGE_TYPES
from tests.worlds.relay import STRING, Person, World
from tests.worlds.relay_node_calls import ask

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
    """A client without the right to view that receives errors."""
    person = world.person(deny=BLIND)
    person.says("set_level", level="error")
    return person


def asked(world: World) -> list[str]:
    """Topics that the robot was asked for."""
    return [each.topic for each in world.link.all(link.Subscribe)]


@pytest.fixture
def world() -> World:
    """A robot with a camera, online."""
    world = World()
    world.robot_comes()
    world.person(user=6)
    world.robot_joins()
    world.registry.graph(world.robot, graph(image_raw__compressed=COMPRESSED, info=INFO))
    return world


@pytest.mark.parametrize("type_name", sorted(IMAGE_TYPES))
def test_images_take_the_right_to_view_them(type_name: str) -> None:
    """Beside the right to subscribe; each has its own error."""
    world = World()
    world.registry.graph(world.robot, graph(x=type_name))
    for denied, reason in (
        ("view:/camera/x", "view on"),
        ("subscribe:/camera/x", "subscribe on"),
        ("view:/y", ""),
    ):
        decision = may_subscribe(
            Rules([Grant(Level.VIEWER, deny=(denied,))]).decide, world.robot, "/camera/x"
        )
        assert (decision.allowed, decision.reason.startswith(reason)) == (not reason, True)


def test_a_listed_camera_counts_for_any_topic_type(world: World) -> None:
    """The robot's list of cameras counts."""
    rules = Rules([Grant(Level.VIEWER, deny=BLIND)])
    assert may_subscribe(rules.decide, world.robot, "/camera/info").allowed
    world.registry.cameras(world.robot, link.Cameras(cameras=[link.Camera(name="/camera/info", type="x")]))
    assert not may_subscribe(rules.decide, world.robot, "/camera/info").allowed


def test_image_topic_is_not_received_without_the_right_to_view(world: World) -> None:
    """For any given type; the camera's other topics are received."""
    person = blind(world)
    for said in ({}, {"type": STRING}, {"type": COMPRESSED}, {"compression": "cbor-raw"}):
        person.says("subscribe", topic=PACKED, **said)
        assert person.reported() == [DENIED]
    person.says("subscribe", topic="/camera/info")
    assert person.reported() == []
    assert PACKED not in asked(world)


def test_a_topic_of_unknown_type_may_carry_images(world: World) -> None:
    """A client may wait for a topic that is not there yet with a type that is not an image."""
    person = blind(world)
    world.robot_goes()
    person.says("subscribe", topic="/camera/later")
    assert "view on /camera/later is denied" in person.reported()[0]
    person.says("subscribe", topic="/camera/later", type=IMAGE)
    assert "view on /camera/later is denied" in person.reported()[0]
    person.says("subscribe", topic="/camera/later", type=INFO)
    assert person.reported() == []


def test_type_given_by_another_client_is_used(world: World) -> None:
    """For clients that give no type."""
    other, person = world.person(user=8), blind(world)
    other.says("subscribe", topic="/camera/later", type=IMAGE)
    person.says("subscribe", topic="/camera/later")
    assert "view on /camera/later is denied" in person.reported()[0]


def test_a_topic_that_turns_out_to_carry_images_is_unsubscribed(world: World) -> None:
    """Before the robot is asked for it with the new type."""
    person = blind(world)
    person.says("subscribe", topic="/camera/later", type=INFO)
    person.says("subscribe", topic="/camera/info")
    before = len(asked(world))
    world.registry.graph(world.robot, graph(later=IMAGE, info=IMAGE))
    assert [words.partition(":")[0] for words in person.reported()] == [
        "unsubscribed from /camera/later",
        "unsubscribed from /camera/info",
    ]
    assert len(asked(world)) == before


def test_a_topic_that_turns_out_to_be_a_camera_is_unsubscribed(world: World) -> None:
    """By the robot's list of cameras."""
    person = blind(world)
    person.says("subscribe", topic="/camera/info")
    world.registry.cameras(world.robot, link.Cameras(cameras=[link.Camera(name="/camera/info", type="x")]))
    assert "unsubscribed from /camera/info: view on" in person.reported()[0]


def test_a_revoked_right_to_view_ends_the_subscription(world: World) -> None:
    """This includes an offline robot; topics without images continue."""
    people = [world.person(), world.person()]
    for person in people:
        person.says("set_level", level="error")
        person.says("subscribe", topic=PACKED)
        person.says("subscribe", topic="/camera/info")
    for person in people:
        person.context.permit.rules = Rules([Grant(Level.OPERATOR, deny=BLIND)])
        person.context.permit.on_change()
        assert person.reported() == [f"unsubscribed from {PACKED}: {DENIED}"]
        world.robot_goes()


def test_image_topic_is_not_found_without_the_right_to_view(world: World) -> None:
    """It is in no list, unless the client may publish there. This applies as soon as the robot lists a
    camera.
    """
    viewer = world.person(Level.VIEWER, deny=BLIND)
    everything = world.person(Level.VIEWER)
    assert PACKED not in ask(viewer, "/rosapi/topics")["topics"]
    assert ask(viewer, "/rosapi/topic_type", {"topic": PACKED}) == {"type": ""}
    assert "/camera/info" in ask(viewer, "/rosapi/topics")["topics"]
    assert PACKED in ask(everything, "/rosapi/topics")["topics"]
    world.registry.cameras(world.robot, link.Cameras(cameras=[link.Camera(name="/camera/info", type="x")]))
    assert "/camera/info" not in ask(viewer, "/rosapi/topics")["topics"]
