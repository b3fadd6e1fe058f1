"""Pictures of the graph for services that look at them, with the lens they were made by."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header

from relay_protocol.errors import Invalid
from robot_client.camera import formats
from robot_client.services.camera_model import CameraModel, calibrated, of_view
from robot_client.services.health import InputWatch, Level, ServiceFinding

SILENT = 5.0
"""Seconds without a picture after which a service says so."""

_NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)


class ImageRequest(NamedTuple):
    """Which pictures.

    :ivar topic: of type sensor_msgs/Image, or CompressedImage
    :ivar compressed: whether it is the latter
    :ivar info: topic of the camera's CameraInfo; empty: ``camera_info`` beside the pictures
    :ivar view: degrees from the left edge to the right, taken instead of a CameraInfo; 0 for none
    """

    topic: str
    compressed: bool = False
    info: str = ""
    view: float = 0.0

    @property
    def info_topic(self) -> str:
        """Where the CameraInfo comes."""
        if self.info:
            return self.info
        topic = self.topic.removesuffix("/compressed") if self.compressed else self.topic
        folder, slash, _ = topic.rpartition("/")
        return f"{folder}{slash}camera_info"


class ImageSource:
    """Subscribes to a camera; only the newest picture waits.

    :param node: to subscribe with
    :param on_picture: called with each message as it was serialised, and its header
    """

    def __init__(self, node: Any, asked: ImageRequest, on_picture: Callable[[bytes, Header], None]) -> None:
        self._asked = asked
        self._on_picture = on_picture
        self._info: CameraInfo | None = None
        self._fresh = InputWatch(asked.topic, SILENT, time.monotonic)
        self._trouble: str = ""
        kind = CompressedImage if asked.compressed else Image
        node.create_subscription(kind, asked.topic, self._came, _NEWEST, raw=True)
        if not asked.view:
            node.create_subscription(CameraInfo, asked.info_topic, self._informed, _NEWEST)

    def pixels(self, message: bytes) -> formats.Raw:
        """What a picture shows.

        :raises Invalid: it can't be shown, or is broken
        """
        if self._asked.compressed:
            return formats.unpacked(formats.compressed(message))
        return formats.image(message)

    def lens(self, width: int, height: int) -> CameraModel:
        """The lens of a picture of this size.

        :raises Invalid: nothing is known of it yet, or it can't be used
        """
        if self._asked.view:
            return of_view(width, height, self._asked.view)
        info = self._info
        if info is None:
            raise Invalid(f"no CameraInfo has come on {self._asked.info_topic} yet")
        lens = calibrated(info.k, info.d, str(info.distortion_model))
        # Drivers that were told another size sometimes keep the calibration of the first.
        return lens.scaled(width / info.width) if info.width else lens

    def finding(self) -> ServiceFinding | None:
        """What is wrong with the pictures, else ``None``."""
        silent = self._fresh.trouble()
        if silent is not None:
            return silent
        if not self._asked.view and self._info is None:
            # No error: pictures often come before it.
            return ServiceFinding(
                Level.STALE, f"waiting for {self._asked.info_topic}; for a camera without one give --view"
            )
        return ServiceFinding(Level.ERROR, self._trouble) if self._trouble else None

    def _came(self, message: bytes) -> None:
        self._fresh.came()
        try:
            self._on_picture(message, _header(message))
        except Invalid as error:
            self._trouble = str(error)
        else:
            self._trouble = ""

    def _informed(self, info: CameraInfo) -> None:
        self._info = info


def _header(message: bytes) -> Header:
    """Both kinds of picture begin with it."""
    try:
        return deserialize_message(message, Header)
    except Exception as error:  # rclpy's errors differ between releases
        raise Invalid(f"a picture without a header: {error}") from error
