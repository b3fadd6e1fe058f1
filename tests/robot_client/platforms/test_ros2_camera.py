"""The camera process's node, and publishers of images in the same graph."""

from __future__ import annotations

import queue
import time
from collections.abc import Iterator
from typing import Any

import pytest
import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CompressedImage, Image

from robot_client.camera import formats
from robot_client.platforms.ros2.camera import RosCameras
from robot_client.platforms.ros2.transport import without_shared_memory

PATIENCE = 60.0
BEST_EFFORT = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
RELIABLE = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Scene:
    def __init__(self) -> None:
        self.context = rclpy.Context()
        with without_shared_memory(rclpy.get_rmw_implementation_identifier()):
            rclpy.init(context=self.context)
            self.node: Any = rclpy.create_node("driver", context=self.context)
        self.cameras = RosCameras("switchboard_test_camera")
        self.got: queue.Queue[bytes] = queue.Queue()

    def close(self) -> None:
        self.cameras.close()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)

    def shown(self, publisher: Any, message: Any) -> bytes:
        """Publish until an image arrives."""
        until = time.monotonic() + PATIENCE
        while time.monotonic() < until:
            publisher.publish(message)
            try:
                return self.got.get(timeout=0.1)
            except queue.Empty:
                continue
        raise AssertionError("no picture came")

    def offered(self, topic: str) -> Any:
        """The quality of service of the only subscription."""
        (found,) = self.node.get_subscriptions_info_by_topic(topic)
        return found.qos_profile


@pytest.fixture
def scene(environment: dict[str, str]) -> Iterator[Scene]:
    made = Scene()
    yield made
    made.close()


def grey(level: int) -> Image:
    return Image(height=2, width=2, step=2, encoding="mono8", data=bytes([level]) * 4)


@pytest.mark.parametrize(
    ("theirs", "asked", "reliable"),
    [
        (BEST_EFFORT, "", False),
        (RELIABLE, "", True),
        (LATCHED, "", True),
        (RELIABLE, "sensor_data", False),
        (RELIABLE, "default", True),
    ],
)
def test_images_arrive_by_a_matching_quality_of_service(
    scene: Scene, theirs: QoSProfile, asked: str, reliable: bool
) -> None:
    """The publisher's, or a named one."""
    publisher = scene.node.create_publisher(Image, "/grey", theirs)
    scene.cameras.subscribe("/grey", False, asked, scene.got.put)
    assert formats.decode_image(scene.shown(publisher, grey(7))).pixels.tolist() == [[7, 7], [7, 7]]
    until = time.monotonic() + PATIENCE
    while (scene.offered("/grey").reliability == ReliabilityPolicy.RELIABLE) != reliable:
        assert time.monotonic() < until
        scene.shown(publisher, grey(7))


def test_later_publishers_are_matched(scene: Scene) -> None:
    """Also after a change of their quality of service."""
    scene.cameras.subscribe("/grey", False, "", scene.got.put)
    first = scene.node.create_publisher(Image, "/grey", RELIABLE)
    scene.shown(first, grey(1))
    scene.node.destroy_publisher(first)
    second = scene.node.create_publisher(Image, "/grey", BEST_EFFORT)
    until = time.monotonic() + PATIENCE
    while formats.decode_image(scene.shown(second, grey(2))).pixels[0, 0] != 2:
        assert time.monotonic() < until


def test_latched_image_arrives_after_the_subscription(scene: Scene) -> None:
    publisher = scene.node.create_publisher(Image, "/map", LATCHED)
    publisher.publish(grey(3))
    for _ in range(2):
        subscribed = scene.cameras.subscribe("/map", False, "", scene.got.put)
        assert formats.decode_image(scene.got.get(timeout=PATIENCE)).pixels[0, 0] == 3
        assert subscribed.latched
    publisher.publish(grey(4))
    assert formats.decode_image(scene.got.get(timeout=PATIENCE)).pixels[0, 0] == 4


def test_latched_image_of_a_later_publisher_arrives_once(scene: Scene) -> None:
    subscribed = scene.cameras.subscribe("/map", False, "", scene.got.put)
    publisher = scene.node.create_publisher(Image, "/map", LATCHED)
    publisher.publish(grey(3))
    until = time.monotonic() + PATIENCE
    while not subscribed.latched:
        assert time.monotonic() < until
        time.sleep(0.02)  # publishers are looked at once a second
    assert formats.decode_image(scene.got.get(timeout=PATIENCE)).pixels[0, 0] == 3
    with pytest.raises(queue.Empty):
        scene.got.get(timeout=0.5)  # to prove its absence
    publisher.publish(grey(3))
    assert scene.got.get(timeout=PATIENCE)


def test_volatile_publishers_are_received_beside_a_latched_one(scene: Scene) -> None:
    latched = scene.node.create_publisher(Image, "/grey", LATCHED)
    volatile = scene.node.create_publisher(Image, "/grey", BEST_EFFORT)
    subscribed = scene.cameras.subscribe("/grey", False, "", scene.got.put)
    seen: set[int] = set()
    until = time.monotonic() + PATIENCE
    while seen != {1, 2}:
        assert time.monotonic() < until
        for level, publisher in ((1, latched), (2, volatile)):
            seen.add(int(formats.decode_image(scene.shown(publisher, grey(level))).pixels[0, 0]))
    assert not subscribed.latched


@pytest.mark.parametrize("asked", ["default", "sensor_data"])
def test_named_profiles_are_volatile(scene: Scene, asked: str) -> None:
    scene.node.create_publisher(Image, "/map", LATCHED)
    scene.cameras.subscribe("/map", False, asked, scene.got.put)
    until = time.monotonic() + PATIENCE
    while not scene.node.get_subscriptions_info_by_topic("/map"):
        assert time.monotonic() < until
        time.sleep(0.02)  # the middleware takes it up by and by
    assert scene.offered("/map").durability == DurabilityPolicy.VOLATILE


def test_compressed_images_are_unchanged(scene: Scene) -> None:
    publisher = scene.node.create_publisher(CompressedImage, "/files", BEST_EFFORT)
    scene.cameras.subscribe("/files", True, "", scene.got.put)
    assert b"some bytes" in scene.shown(publisher, CompressedImage(format="jpeg", data=b"some bytes"))


def test_closed_subscription_leaves_the_graph(scene: Scene) -> None:
    publisher = scene.node.create_publisher(Image, "/grey", BEST_EFFORT)
    subscribed = scene.cameras.subscribe("/grey", False, "", scene.got.put)
    scene.shown(publisher, grey(1))
    subscribed.close()
    until = time.monotonic() + PATIENCE
    while scene.node.count_subscribers("/grey"):
        assert time.monotonic() < until
        time.sleep(0.02)  # the middleware takes it down by and by
    while not scene.got.empty():
        scene.got.get()
    publisher.publish(grey(2))
    with pytest.raises(queue.Empty):
        scene.got.get(timeout=0.3)  # to prove its absence
