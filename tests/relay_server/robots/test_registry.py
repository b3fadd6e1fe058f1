"""The robot registry, and the copy of a robot's graph."""

from __future__ import annotations

import pytest

from relay_protocol import limits, link
from relay_protocol.errors import MalformedMessage
from relay_server.http.relay_status import RelayCollector, registry_of
from relay_server.robots import registry as graph_module
from relay_server.robots.registry import Availability, GraphMirror
from tests.worlds import viewers
from tests.worlds.relay import STRING, MemoryLink, World


class Watcher:
    """An observer of a robot."""

    def __init__(self) -> None:
        self.saw: list[str] = []

    def robot_online(self) -> None:
        """Records the event."""
        self.saw.append("online")

    def robot_offline(self) -> None:
        """Records the event."""
        self.saw.append("offline")

    def graph_changed(self) -> None:
        """Records the event."""
        self.saw.append("graph")

    def described(self) -> None:
        """Records the event."""
        self.saw.append("described")


def test_a_robot_is_offline_online_or_in_use(world: World) -> None:
    """In use means that it has clients."""
    assert world.robot.state is Availability.OFFLINE
    world.robot_comes()
    assert world.robot.state is Availability.ONLINE
    world.robot.users = 1
    assert world.robot.state is Availability.IN_USE
    world.robot_goes()
    assert world.robot.state is Availability.OFFLINE


def test_a_new_link_replaces_the_old_one_and_starts_afresh(world: World) -> None:
    """Observers see it leave and join; graph, types and health of the old link are discarded."""
    world.robot_comes()
    world.robot.types.add(STRING, "string data\n")
    world.robot.health = link.Health(battery=0.5)
    world.registry.cameras(world.robot, link.Cameras(cameras=[link.Camera(name="/camera")]))
    watcher = Watcher()
    world.robot.observers.append(watcher)
    former, newer = world.control, MemoryLink()
    world.registry.registered(world.robot, newer)
    assert watcher.saw == ["offline", "online"]
    assert former.closed == "the robot has connected again"
    assert not world.robot.graph.topics
    assert not world.robot.types.knows(STRING)
    assert world.robot.health.battery is None
    assert world.robot.cameras == ()


def test_observers_are_notified_of_cameras(world: World) -> None:
    """Each time, and also while the robot is offline."""
    world.robot_comes()
    watcher = Watcher()
    world.robot.observers.append(watcher)
    changes: list[None] = []
    world.registry.on_change(lambda: changes.append(None))
    camera = link.Camera(name="/camera")
    world.registry.cameras(world.robot, link.Cameras(cameras=[camera]))
    assert (watcher.saw, len(changes)) == (["described"], 1)
    world.robot_goes()
    assert world.robot.cameras == (camera,)


def test_the_end_of_a_replaced_link_changes_nothing(world: World) -> None:
    """The robot stays online by the new one."""
    world.robot_comes()
    former = world.control
    world.robot_comes()
    world.registry.lost(world.robot, former)
    assert world.robot.state is Availability.ONLINE
    world.registry.lost(world.robot, world.control)
    assert world.robot.state is Availability.OFFLINE
    assert not world.robot.graph.nodes


def test_observers_are_notified_of_changes_until_they_leave(world: World) -> None:
    """An observer may leave during a notification."""
    heard: list[str] = []
    stop_first = world.registry.on_change(lambda: (heard.append("first"), stop_first()))  # type: ignore[func-returns-value]
    world.registry.on_change(lambda: heard.append("second"))
    world.registry.changed()
    world.registry.changed()
    assert heard == ["first", "second", "second"]


def test_a_removed_robot_is_notified_and_forgotten(world: World) -> None:
    """Its link is closed; a second removal does nothing."""
    world.robot_comes()
    world.registry.forget(1)
    world.registry.forget(1)
    assert world.control.closed == "this robot was removed from the relay"
    assert world.registry.find(1) is None


def test_a_graph_is_taken_whole_or_as_what_changed() -> None:
    """``null`` removes a name; a full graph replaces everything."""
    mirror = GraphMirror()
    topic, service = link.Topic(types=[STRING]), link.Service(types=["a/srv/B"])
    mirror.apply(
        link.Graph(
            full=True,
            topics={"/a": topic},
            services={"/s": service},
            actions={"/x": service},
            nodes={"/n": {}},
        )
    )
    mirror.apply(link.Graph(topics={"/b": topic, "/a": None}, nodes={"/n": None, "/m": {}}))
    assert set(mirror.topics) == {"/b"}
    assert mirror.nodes == {"/m"}
    assert mirror.topic_type("/b") == STRING
    assert mirror.topic_type("/a") is None
    assert mirror.service_type("/s") == "a/srv/B"
    assert mirror.service_type("/none") is None
    mirror.apply(link.Graph(full=True, topics={"/c": link.Topic(types=[])}))
    assert mirror.topic_type("/c") is None
    assert (set(mirror.topics), mirror.services, mirror.actions, mirror.nodes) == ({"/c"}, {}, {}, set())


def test_a_robot_can_not_fill_the_memory_with_names() -> None:
    """Names over the limit are ignored; known names still change."""
    mirror = GraphMirror()
    mirror.apply(link.Graph(topics={"/t0": link.Topic(types=["a/msg/A"])}))
    for first in range(0, graph_module.NAMES + 5000, 5000):
        mirror.apply(link.Graph(nodes={f"/n{number}": {} for number in range(first, first + 5000)}))
    assert len(mirror.nodes) == graph_module.NAMES
    mirror.apply(link.Graph(topics={"/t0": link.Topic(types=[STRING])}))
    assert mirror.topic_type("/t0") == STRING


def _long_topic(letter: str) -> link.Topic:
    names = [f"/{letter * 200}{number}" for number in range(limits.GRAPH_NODES)]
    return link.Topic(types=[STRING], publishers=names, subscribers=names)


def test_a_graph_that_takes_too_much_memory_is_refused_with_a_reason() -> None:
    """At once or step by step; removed and replaced parts do not count."""
    mirror = GraphMirror()
    for letter in "abcdefgh" * 10:
        mirror.apply(link.Graph(topics={"/same": _long_topic(letter)}))
        mirror.apply(link.Graph(topics={"/gone": _long_topic(letter)}))
        mirror.apply(link.Graph(topics={"/gone": None}, nodes={"/n": {}, "/m": None}))
    with pytest.raises(MalformedMessage, match="graph takes more than 8 MiB"):
        for number in range(20):
            mirror.apply(link.Graph(topics={f"/t{number}": _long_topic("x")}))
    assert not mirror.topics


def test_metrics_count_robots_by_state_clients_channels_and_streams(world: World) -> None:
    """The values are computed for each request."""
    figures = registry_of(RelayCollector(world.registry, world.channels, world.videos, lambda: world.people))
    assert figures.get_sample_value("switchboard_robots", {"state": "offline"}) == 1
    world.robot_comes()
    person = world.person()
    person.rosbridge.pause()
    person.says("call_service", service="/relay/ping")
    assert figures.get_sample_value("switchboard_robots", {"state": "online"}) == 1
    assert figures.get_sample_value("switchboard_robots", {"state": "offline"}) == 0
    assert figures.get_sample_value("switchboard_clients") == 1
    assert figures.get_sample_value("switchboard_channels") == 1
    assert (
        figures.get_sample_value("switchboard_client_waiting_bytes")
        == person.rosbridge.send_queue.waiting_bytes
    )
    assert person.rosbridge.send_queue.waiting_bytes > 0
    for watcher in (viewers.Watcher(), viewers.Watcher()):
        watcher.watch(world)
    assert figures.get_sample_value("switchboard_video_streams") == 1
    assert figures.get_sample_value("switchboard_video_viewers") == 2
