"""The camera process's node, and publishers of pictures in the same graph."""

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
        """Publish until it arrives."""
        until = time.monotonic() + PATIENCE
        while time.monotonic() < until:
            publisher.publish(message)
            try:
                return self.got.get(timeout=0.1)
            except queue.Empty:
                continue
        raise AssertionError("no picture came")

    def offered(self, topic: str) -> Any:
        """How the one subscription there wants it."""
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
def test_pictures_come_by_the_quality_of_service_that_fits(
    scene: Scene, theirs: QoSProfile, asked: str, reliable: bool
) -> None:
    """The publisher's own, or the one asked for by name."""
    publisher = scene.node.create_publisher(Image, "/grey", theirs)
    scene.cameras.subscribe("/grey", False, asked, scene.got.put)
    assert formats.image(scene.shown(publisher, grey(7))).pixels.tolist() == [[7, 7], [7, 7]]
    until = time.monotonic() + PATIENCE
    while (scene.offered("/grey").reliability == ReliabilityPolicy.RELIABLE) != reliable:
        assert time.monotonic() < until
        scene.shown(publisher, grey(7))


def test_camera_that_comes_later_is_found_whatever_it_offers(scene: Scene) -> None:
    """Subscribed before anybody publishes, and published anew with another quality of service."""
    scene.cameras.subscribe("/grey", False, "", scene.got.put)
    first = scene.node.create_publisher(Image, "/grey", RELIABLE)
    scene.shown(first, grey(1))
    scene.node.destroy_publisher(first)
    second = scene.node.create_publisher(Image, "/grey", BEST_EFFORT)
    until = time.monotonic() + PATIENCE
    while formats.image(scene.shown(second, grey(2))).pixels[0, 0] != 2:
        assert time.monotonic() < until


def test_picture_that_was_published_once_is_shown(scene: Scene) -> None:
    """To who subscribes when it was published long ago, and the next one to who is there."""
    publisher = scene.node.create_publisher(Image, "/map", LATCHED)
    publisher.publish(grey(3))
    for _ in range(2):
        subscribed = scene.cameras.subscribe("/map", False, "", scene.got.put)
        assert formats.image(scene.got.get(timeout=PATIENCE)).pixels[0, 0] == 3
        assert subscribed.latched
    publisher.publish(grey(4))
    assert formats.image(scene.got.get(timeout=PATIENCE)).pixels[0, 0] == 4


def test_picture_of_a_camera_that_comes_later_is_shown_once(scene: Scene) -> None:
    """Subscribed anew for its publisher's sake it would come again."""
    subscribed = scene.cameras.subscribe("/map", False, "", scene.got.put)
    publisher = scene.node.create_publisher(Image, "/map", LATCHED)
    publisher.publish(grey(3))
    until = time.monotonic() + PATIENCE
    while not subscribed.latched:
        assert time.monotonic() < until
        time.sleep(0.02)  # publishers are looked at once a second
    assert formats.image(scene.got.get(timeout=PATIENCE)).pixels[0, 0] == 3
    with pytest.raises(queue.Empty):
        scene.got.get(timeout=0.5)  # to prove its absence
    publisher.publish(grey(3))
    assert scene.got.get(timeout=PATIENCE)


def test_publishers_that_keep_nothing_are_heard_beside_one_that_does(scene: Scene) -> None:
    """Who asks for kept pictures gets none of theirs."""
    latched = scene.node.create_publisher(Image, "/grey", LATCHED)
    volatile = scene.node.create_publisher(Image, "/grey", BEST_EFFORT)
    subscribed = scene.cameras.subscribe("/grey", False, "", scene.got.put)
    seen: set[int] = set()
    until = time.monotonic() + PATIENCE
    while seen != {1, 2}:
        assert time.monotonic() < until
        for level, publisher in ((1, latched), (2, volatile)):
            seen.add(int(formats.image(scene.shown(publisher, grey(level))).pixels[0, 0]))
    assert not subscribed.latched


@pytest.mark.parametrize("asked", ["default", "sensor_data"])
def test_profile_asked_for_by_name_keeps_nothing(scene: Scene, asked: str) -> None:
    """As ROS has it by that name."""
    scene.node.create_publisher(Image, "/map", LATCHED)
    scene.cameras.subscribe("/map", False, asked, scene.got.put)
    until = time.monotonic() + PATIENCE
    while not scene.node.get_subscriptions_info_by_topic("/map"):
        assert time.monotonic() < until
        time.sleep(0.02)  # the middleware takes it up by and by
    assert scene.offered("/map").durability == DurabilityPolicy.VOLATILE


def test_compressed_pictures_come_as_they_are(scene: Scene) -> None:
    """Byte for byte."""
    publisher = scene.node.create_publisher(CompressedImage, "/files", BEST_EFFORT)
    scene.cameras.subscribe("/files", True, "", scene.got.put)
    assert b"some bytes" in scene.shown(publisher, CompressedImage(format="jpeg", data=b"some bytes"))


def test_closed_subscription_leaves_the_graph(scene: Scene) -> None:
    """And passes on nothing any more."""
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
