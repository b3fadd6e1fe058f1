"""The daemon uses no shared memory with other nodes, at any discovery range."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import pytest

from relay_protocol.errors import Unavailable
from robot_client.platforms.ros2.transport import profile, without_shared_memory
from tests.worlds.ros_domains import free_domain

FASTRTPS = "rmw_fastrtps_cpp"
CHOICES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE", "FASTDDS_BUILTIN_TRANSPORTS")
RANGES = ("ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_LOCALHOST_ONLY", "ROS_STATIC_PEERS")

LISTENER = """
import rclpy
from rclpy.qos import QoSProfile, DurabilityPolicy
from std_msgs.msg import String
from robot_client.platforms.ros2.transport import without_shared_memory

with without_shared_memory(rclpy.get_rmw_implementation_identifier()):
    rclpy.init()
    node = rclpy.create_node("listener")
heard = []
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
node.create_subscription(String, "/said", heard.append, latched)
while not heard:
    rclpy.spin_once(node, timeout_sec=1)
with open("/proc/self/maps") as maps:
    print(heard[0].data, sum("/dev/shm/fast" in line for line in maps))
"""
SPEAKER = """
import sys
import rclpy
from rclpy.qos import QoSProfile, DurabilityPolicy
from std_msgs.msg import String

rclpy.init()
node = rclpy.create_node("speaker")
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
speaker = node.create_publisher(String, "/said", latched)
speaker.publish(String(data="hello"))
sys.stdin.read()
"""


@pytest.fixture(autouse=True)
def _bare(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Without settings of the robot's owner."""
    for name in CHOICES + RANGES:
        monkeypatch.delenv(name, raising=False)
    yield


@pytest.mark.parametrize(
    "settings",
    [
        {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"},
        {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_STATIC_PEERS": "localhost;127.0.0.2"},
        {"ROS_LOCALHOST_ONLY": "1"},
        {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET", "ROS_STATIC_PEERS": "127.0.0.1"},
    ],
    ids=["localhost", "with peers", "former name", "subnet"],
)
def test_node_without_shared_memory_receives_others(settings: dict[str, str]) -> None:
    environment = {**os.environ, **settings, "ROS_DOMAIN_ID": str(free_domain())}
    with subprocess.Popen([sys.executable, "-c", SPEAKER], env=environment, stdin=subprocess.PIPE) as speaker:
        try:
            listener = _listener(environment)
        finally:
            speaker.communicate()
    assert listener.stdout.split() == ["hello", "0"], listener.stderr


def _listener(environment: dict[str, str]) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", LISTENER]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60, check=False)


def test_environment_is_restored(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    before = dict(os.environ)
    with without_shared_memory(FASTRTPS):
        during = dict(os.environ)
    assert os.environ == before
    assert during["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "SYSTEM_DEFAULT"
    assert "ROS_LOCALHOST_ONLY" not in during
    assert not Path(during["FASTRTPS_DEFAULT_PROFILES_FILE"]).exists()


@pytest.mark.parametrize("name", CHOICES)
def test_settings_of_the_owner_are_not_changed(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(name, "chosen")
    before = dict(os.environ)
    with without_shared_memory(FASTRTPS):
        assert os.environ == before


def test_other_middleware_is_not_changed() -> None:
    before = dict(os.environ)
    with without_shared_memory("rmw_cyclonedds_cpp"):
        assert os.environ == before


def test_static_peers_are_discovered() -> None:
    settings = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_STATIC_PEERS": "127.0.0.3; localhost"}
    reported = ElementTree.fromstring(profile(settings))
    addresses = [each.text for each in reported.iter() if each.tag.endswith("}address")]
    assert addresses == ["127.0.0.1", "127.0.0.3", "127.0.0.1"]


def test_the_last_domain_has_ports_for_a_listener_limited_to_this_machine() -> None:
    environment = {**os.environ, "ROS_DOMAIN_ID": "232", "ROS_LOCALHOST_ONLY": "1"}
    with subprocess.Popen([sys.executable, "-c", SPEAKER], env=environment, stdin=subprocess.PIPE) as speaker:
        try:
            listener = _listener(environment)
        finally:
            speaker.communicate()
    assert listener.stdout.split() == ["hello", "0"], listener.stderr


@pytest.mark.parametrize("domain", ["233", "300", "-1", str(2**32)])
@pytest.mark.parametrize("chosen", [{}, {CHOICES[0]: "chosen"}], ids=["ours", "owner's"])
def test_a_domain_without_ports_is_refused_in_words(
    domain: str, chosen: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in {"ROS_DOMAIN_ID": domain, **chosen}.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(Unavailable, match="from 0 to 232"), without_shared_memory(FASTRTPS):
        raise AssertionError


def test_unknown_peer_is_named_in_the_error() -> None:
    settings = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_STATIC_PEERS": "nobody.invalid"}
    with pytest.raises(Unavailable, match=r"nobody\.invalid"):
        profile(settings)
