"""Foxglove clients and a real ROS 2 graph that changes: meshes, nodes, types of topics, and simulated time."""

from __future__ import annotations

import itertools
import os
import re
import struct
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tests.worlds.chaos_proxy import ChaosProxy
from tests.worlds.foxglove_connection import FoxgloveConnection, opened
from tests.worlds.processes import Process, ros_environment, running
from tests.worlds.relay_process import Relay
from tests.worlds.robot_process import Robot

CLIENTS = Path(__file__).parent / "clients"
STRING, BOOL = "std_msgs/msg/String", "std_msgs/msg/Bool"
EMPTY_STRING, FALSE = b"\x00\x01\x00\x00\x01\x00\x00\x00\x00", b"\x00\x01\x00\x00\x00"
"""Messages of these types in CDR, without padding."""
HEADED = "switchboard_test_interfaces/msg/Headed"
BASE, HAND, STOLEN = (bytes(range(256)) * count for count in (4, 1024, 3))
URDF = """<robot name="arm">
  <link name="base"><visual><geometry><mesh filename="package://arm_description/meshes/base.stl"/></geometry></visual></link>
  <link name="hand"><visual><geometry><mesh filename="package://arm_description/meshes/hand.stl"/></geometry></visual></link>
  <link name="odd"><visual><geometry><mesh filename="package://arm_description/meshes/odd.stl"/></geometry></visual></link>
</robot>"""

Peer = Callable[..., AbstractContextManager[Process]]


@dataclass
class Lab:
    """A relay, a robot with simulated time and its own workspace, and a viewer."""

    relay: Relay
    robot: Robot
    network: ChaosProxy
    viewer: str

    def client(self) -> AbstractContextManager[FoxgloveConnection]:
        """The viewer's connection."""
        return opened(self.relay.url("arm"), self.viewer)


def install(workspace: Path) -> tuple[Path, Path]:
    """Installs packages as ``colcon build --symlink-install`` does.

    One mesh is a file, one a link to the package's sources, one a link to elsewhere. Another package refers to a type
    of a package that is not installed.

    :returns: the prefix, and the directory of sources
    """
    prefix, source = workspace / "install", workspace / "src"
    meshes, elsewhere = source / "arm_description/meshes", workspace / "elsewhere"
    for folder in (meshes, elsewhere):
        folder.mkdir(parents=True)
    index = prefix / "share/ament_index/resource_index/packages"
    share, interfaces = prefix / "share/arm_description/meshes", prefix / "share" / HEADED.rpartition("/")[0]
    for folder in (index, share, interfaces):
        folder.mkdir(parents=True)
    (source / "arm_description/marker").touch()
    (index / "arm_description").symlink_to(source / "arm_description/marker")
    (share / "base.stl").write_bytes(BASE)
    (meshes / "hand.stl").write_bytes(HAND)
    (share / "hand.stl").symlink_to(meshes / "hand.stl")
    (elsewhere / "odd.stl").write_bytes(STOLEN)
    (share / "odd.stl").symlink_to(elsewhere / "odd.stl")
    (interfaces / "Headed.msg").write_text("nowhere_msgs/Thing thing\n")
    return prefix, source


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    """The robot ``arm``."""
    relay = Relay(tmp_path_factory.mktemp("lab"))
    network = ChaosProxy(relay.robots_port)
    with running(relay), closing(network):
        prefix, source = install(relay.folder / "workspace")
        paths = os.pathsep.join(filter(None, [str(prefix), os.environ.get("AMENT_PREFIX_PATH")]))
        robot = Robot(
            relay,
            "arm",
            port=network.port,
            daemon_env={"AMENT_PREFIX_PATH": paths},
            settings=f'[ros]\nuse_sim_time = true\n[assets]\nroots = ["{source}"]\n',
        )
        with running(robot):
            viewer = relay.user("viewer")
            relay.cli("right", "grant", "viewer", "arm", "viewer")
            yield Lab(relay, robot, network, viewer)


@pytest.fixture
def peer(lab: Lab, tmp_path: Path) -> Peer:
    """Starts a node in the robot's graph: one of the programs in ``clients``, with arguments."""
    numbers = itertools.count()

    @contextmanager
    def start(program: str, *arguments: object) -> Iterator[Process]:
        command = [sys.executable, str(CLIENTS / program), *map(str, arguments)]
        name = f"peer{next(numbers)}"
        node = Process(command, tmp_path, name, ros_environment(lab.robot.domain))
        with running(node):
            node.wait_to_say("READY")
            yield node

    return start


# --- meshes -----------------------------------------------------------------------------------------------


def test_meshes_of_the_robots_description_are_fetched_also_through_links(
    lab: Lab, peer: Peer, tmp_path: Path
) -> None:
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(URDF)
    with peer("described.py", urdf), lab.client() as client:
        body = client.sample(client.subscribe("/robot_description"))
        base, hand, odd = re.findall(r'filename="([^"]+)"', body[8:].decode())
        assert client.fetch(base) == BASE
        assert client.fetch(hand) == HAND
        refused = client.fetch(odd)
        assert isinstance(refused, str)
        assert refused.startswith(odd)
        assert "to 'roots' in [assets] of the robot's settings" in refused
        assert str(lab.relay.folder) not in refused


# --- nodes and topics -------------------------------------------------------------------------------------


def test_differences_of_the_graph_come_as_nodes_come_and_go(lab: Lab, peer: Peer) -> None:
    with lab.client() as client:
        client.send("subscribeConnectionGraph")
        graph = Graph(client)
        graph.until("the simulator is known", lambda: "/switchboard_sim" in graph.publishers("/odom"))
        assert "/moving" not in graph.published
        with peer("graph_peer.py", "first", f"/moving={STRING}", f"/stays={STRING}"):
            graph.until("the first node is known", lambda: graph.publishers("/moving") == ["/first"])
            graph.until("with both topics", lambda: graph.publishers("/stays") == ["/first"])
            with peer("graph_peer.py", "second", f"/moving={STRING}"):
                graph.until("both nodes", lambda: graph.publishers("/moving") == ["/first", "/second"])
            graph.until("one node", lambda: graph.publishers("/moving") == ["/first"])
            assert graph.publishers("/stays") == ["/first"]
            assert not {"/moving", "/stays"} & set(graph.removed)
        graph.until("no node", lambda: not {"/moving", "/stays"} & graph.published.keys())
        assert sorted(set(graph.removed) & {"/moving", "/stays"}) == ["/moving", "/stays"]
        # What has not changed was sent once.
        assert graph.times_sent["/odom"] == 1


class Graph:
    """The publishers that a client knows by the updates of the graph."""

    def __init__(self, client: FoxgloveConnection) -> None:
        self._client = client
        self.published: dict[str, list[str]] = {}
        self.removed: list[str] = []
        self.times_sent: dict[str, int] = {}

    def publishers(self, topic: str) -> list[str]:
        """Full names of the nodes that publish a topic."""
        return sorted(self.published.get(topic, []))

    def until(self, what: str, condition: Callable[[], Any]) -> None:
        """Takes updates until the condition is met."""
        while not condition():
            update = self._client.next("connectionGraphUpdate")
            for each in update["publishedTopics"]:
                self.published[each["name"]] = each["publisherIds"]
                self.times_sent[each["name"]] = self.times_sent.get(each["name"], 0) + 1
            for name in update["removedTopics"]:
                self.published.pop(name, None)
                self.removed.append(name)


def test_a_topic_that_changes_its_type_is_withdrawn_and_advertised_again(lab: Lab, peer: Peer) -> None:
    with lab.client() as client:
        with peer("graph_peer.py", "talker", f"/changing={STRING}"):
            subscription = client.subscribe("/changing")
            old = client.channels["/changing"]
            assert client.sample(subscription).startswith(EMPTY_STRING)
        with peer("graph_peer.py", "talker", f"/changing={BOOL}"):
            order: list[str] = []

            def is_advertised(message: Any) -> bool:
                if isinstance(message, bytes):
                    return False
                if message["op"] == "unadvertise" and old in message["channelIds"]:
                    order.append("withdrawn")
                return any(each["topic"] == "/changing" for each in message.get("channels", ()))

            found = client.until(is_advertised, "the topic is advertised again")
            (channel,) = [each for each in found["channels"] if each["topic"] == "/changing"]
            assert order == ["withdrawn"]
            assert (channel["schemaName"], channel["schemaEncoding"]) == (BOOL, "ros2msg")
            assert re.search(r"^bool data$", channel["schema"], re.MULTILINE)
            assert channel["id"] != old
            assert client.sample(client.subscribe("/changing")).startswith(FALSE)


def test_hidden_topics_services_and_nodes_are_left_out(lab: Lab, peer: Peer) -> None:
    """Those of actions and of the introspection of services are hidden too."""
    with (
        peer("introspected.py"),
        peer("graph_peer.py", "_secret", f"/shown={STRING}", f"/lab/_unseen={STRING}"),
        peer("graph_peer.py", "open", f"/shown={STRING}"),
        lab.client() as client,
    ):
        # The relay knows the hidden ones: a client that names one gets its messages.
        with lab.relay.connect("arm", lab.viewer) as rosbridge:
            for topic in ("/lab/_unseen", "/lab/_whisper"):
                rosbridge.send(op="subscribe", topic=topic, type=STRING)
                rosbridge.until(op="publish", topic=topic)
        client.channel("/shown")
        client.send("subscribeConnectionGraph")
        whole = client.next("connectionGraphUpdate")
        graph = Graph(client)
        graph.published = {each["name"]: each["publisherIds"] for each in whole["publishedTopics"]}
        graph.until("the listed node is known", lambda: graph.publishers("/shown") == ["/open"])
        assert not [each for each in (*client.channels, *client.services) if "/_" in each]
        assert "/_" not in str(whole)
        assert "/_" not in str(graph.published)


def test_a_topic_without_a_definition_is_named_and_the_others_are_advertised(lab: Lab, peer: Peer) -> None:
    """Its definition names a type of a package that the robot has not."""
    with lab.client() as client, peer("graph_peer.py", "odd", f"/undefined={HEADED}", f"/defined={STRING}"):
        said = client.next("status", lambda each: "nowhere_msgs" in each["message"])
        assert said["message"].startswith("left out, as they have no definition:")
        assert HEADED in said["message"]
        assert client.sample(client.subscribe("/defined"))
        assert "/undefined" not in client.channels


# --- simulated time ---------------------------------------------------------------------------------------


def seconds(message: Any) -> float:
    """Of a ``time`` message; 0 for others."""
    found = isinstance(message, bytes) and message[0] == 2
    return float(struct.unpack_from("<Q", message, 1)[0] / 1e9) if found else 0.0


def times_from(client: FoxgloveConnection, begin: int, end: int) -> list[float]:
    """The next ten times, which go on from ``begin`` and stay below ``end``."""
    found = [seconds(client.until(lambda each: begin <= seconds(each) < end, "a time")) for _ in range(10)]
    assert found == sorted(set(found))
    return found


def test_time_goes_on_from_an_earlier_one_when_the_simulation_starts_again(lab: Lab, peer: Peer) -> None:
    with lab.client() as client:
        first = client.next("serverInfo")
        assert "time" in first["capabilities"]
        with peer("ticking.py", 100_000):
            times_from(client, 100_000, 200_000)
        with peer("ticking.py", 10):
            client.next("serverInfo", lambda each: each["sessionId"] != first["sessionId"])
            following = client.until(lambda each: seconds(each) > 0, "the time after the jump")
            assert 10 <= seconds(following) < 100_000
            times_from(client, 10, 100_000)
            # Samples have the new time too.
            with peer("graph_peer.py", "talker", f"/stamped={STRING}"):
                id = client.subscribe("/stamped")
                head = struct.pack("<BI", 1, id)
                sample = client.until(
                    lambda each: isinstance(each, bytes) and each.startswith(head), "a sample"
                )
                assert 10 <= struct.unpack_from("<Q", sample, 5)[0] / 1e9 < 100_000


def test_time_goes_on_from_an_earlier_one_after_the_link_was_lost(lab: Lab, peer: Peer) -> None:
    """The simulation starts again meanwhile; the robot's daemon runs on, and so does the client's connection."""
    with lab.client() as client:
        first = client.next("serverInfo")
        with peer("ticking.py", 500_000):
            times_from(client, 500_000, 600_000)
            lab.network.black_hole()
            lab.network.reset()
            client.next("status", lambda each: each["message"].endswith("arm is offline"))
        with peer("ticking.py", 20):
            lab.network.heal()
            client.next("serverInfo", lambda each: each["sessionId"] != first["sessionId"])
            times_from(client, 20, 500_000)
