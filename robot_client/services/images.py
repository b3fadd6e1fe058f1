"""Camera images from the ROS graph for services, with their camera model."""

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

SILENT_SECONDS = 5.0
"""Seconds without an image after which the input counts as silent."""

_NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)


class ImageRequest(NamedTuple):
    """Camera to subscribe to.

    :ivar topic: of type sensor_msgs/Image, or CompressedImage
    :ivar compressed: whether it is the latter
    :ivar info: topic of the camera's CameraInfo; empty: ``camera_info`` in the namespace of the images
    :ivar view: horizontal field of view in degrees, instead of a CameraInfo; 0 for none
    """

    topic: str
    compressed: bool = False
    info: str = ""
    view: float = 0.0

    @property
    def info_topic(self) -> str:
        """Topic of the CameraInfo."""
        if self.info:
            return self.info
        topic = self.topic.removesuffix("/compressed") if self.compressed else self.topic
        folder, slash, _ = topic.rpartition("/")
        return f"{folder}{slash}camera_info"


class ImageSource:
    """Subscribes to a camera; only the newest image is queued.

    :param node: to subscribe with
    :param on_image: called with each serialised message and its header
    """

    def __init__(self, node: Any, request: ImageRequest, on_image: Callable[[bytes, Header], None]) -> None:
        self._request = request
        self._on_image_message = on_image
        self._info: CameraInfo | None = None
        self._input = InputWatch(request.topic, SILENT_SECONDS, time.monotonic)
        self._problem: str = ""
        kind = CompressedImage if request.compressed else Image
        node.create_subscription(kind, request.topic, self._on_message, _NEWEST, raw=True)
        if not request.view:
            node.create_subscription(CameraInfo, request.info_topic, self._on_camera_info, _NEWEST)

    def pixels(self, message: bytes) -> formats.RawImage:
        """Decode an image.

        :raises Invalid: unsupported or broken
        """
        if self._request.compressed:
            return formats.decode_compressed(formats.compressed_file(message))
        return formats.decode_image(message)

    def file(self, message: bytes) -> bytes:
        """The JPEG or PNG from which the pixels of a message come; empty if they come from none.

        :raises Invalid: broken
        """
        if not self._request.compressed:
            return b""
        found = formats.compressed_file(message)
        return found.file if found.kind in ("jpeg", "png") and not found.encoding else b""

    def camera_model(self, width: int, height: int) -> CameraModel:
        """The camera model for an image size.

        :raises Invalid: not known yet, or not usable
        """
        if self._request.view:
            return of_view(width, height, self._request.view)
        info = self._info
        if info is None:
            raise Invalid(f"no CameraInfo was received on {self._request.info_topic} yet")
        model = calibrated(info.k, info.d, str(info.distortion_model))
        # Some drivers keep the calibration when the image size changes.
        return model.scaled(width / info.width) if info.width else model

    def finding(self) -> ServiceFinding | None:
        """Problem with the images, else ``None``."""
        silent = self._input.problem()
        if silent is not None:
            return silent
        if not self._request.view and self._info is None:
            # Not an error: images often arrive first.
            return ServiceFinding(
                Level.STALE, f"waiting for {self._request.info_topic}; for a camera without one use --view"
            )
        return ServiceFinding(Level.ERROR, self._problem) if self._problem else None

    def _on_message(self, message: bytes) -> None:
        self._input.received()
        try:
            self._on_image_message(message, _header(message))
        except Invalid as error:
            self._problem = str(error)
        else:
            self._problem = ""

    def _on_camera_info(self, info: CameraInfo) -> None:
        self._info = info


def _header(message: bytes) -> Header:
    """The header, with which both types of image begin."""
    try:
        return deserialize_message(message, Header)
    except Exception as error:  # rclpy's errors differ between releases
        raise Invalid(f"an image without a header: {error}") from error
