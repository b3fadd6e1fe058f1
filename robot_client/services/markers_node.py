"""ROS node of the service ``markers``."""

from __future__ import annotations

from typing import Any

import cv2
import orjson
from builtin_interfaces.msg import Duration
from std_msgs.msg import Header, String
from visualization_msgs.msg import Marker, MarkerArray

from robot_client.services.health import Level, ServiceFinding
from robot_client.services.images import ImageRequest, ImageSource
from robot_client.services.markers import SeenMarker
from robot_client.services.placement import CameraImage, RunOptions, marker_function

LIFETIME_SECONDS = 0.5
"""Lifetime of a marker's display, seconds."""


class Markers:
    """Publishes the markers a camera sees, with their poses.

    :param request: the camera
    :param size: side of the black square, metres
    :param run: where markers are found
    """

    def __init__(
        self, node: Any, request: ImageRequest, dictionary: str, size: float, run: RunOptions
    ) -> None:
        cv2.setNumThreads(1)  # leaves the other cores to other programs
        self._dictionary = dictionary
        self._size = size
        self._run = run
        self._find = marker_function(dictionary, size, run)
        self._seen: list[SeenMarker] = []
        self._array = node.create_publisher(MarkerArray, "markers", 10)
        self._text = node.create_publisher(String, "markers/seen", 10)
        self._images = ImageSource(node, request, self._on_image)

    def finding(self) -> ServiceFinding:
        """The markers seen now."""
        problem = self._images.finding()
        if problem:
            return problem
        values = {f"marker {each.number}": f"{each.distance:.2f} m" for each in self._seen}
        values |= self._find.shown()
        numbers = ", ".join(str(each.number) for each in self._seen)
        return ServiceFinding(Level.OK, f"sees {numbers}" if numbers else "sees no marker", values)

    def close(self) -> None:
        """Close the link to the workers."""
        self._run.client.close()

    def _on_image(self, message: bytes, header: Header) -> None:
        image = self._images.pixels(message)
        model = self._images.camera_model(image.width, image.height)
        self._seen = self._find(CameraImage(image.pixels, self._images.file(message)), model)
        self._array.publish(MarkerArray(markers=[self._marker(each, header) for each in self._seen]))
        self._text.publish(String(data=self._as_json(header)))

    def _marker(self, seen: SeenMarker, header: Header) -> Marker:
        marker = Marker(header=header, ns=self._dictionary, id=seen.number, type=Marker.CUBE)
        marker.action = Marker.ADD
        place, turn = marker.pose.position, marker.pose.orientation
        place.x, place.y, place.z = seen.position
        turn.x, turn.y, turn.z, turn.w = seen.orientation
        marker.scale.x = marker.scale.y = self._size
        marker.scale.z = self._size / 20
        marker.color.g = marker.color.a = 1.0
        marker.text = str(seen.number)
        marker.lifetime = Duration(sec=int(LIFETIME_SECONDS), nanosec=int(LIFETIME_SECONDS % 1 * 1e9))
        return marker

    def _as_json(self, header: Header) -> str:
        """The markers as JSON, with distance and bearing."""
        seen = {
            "stamp": header.stamp.sec + header.stamp.nanosec / 1e9,
            "frame": header.frame_id,
            "markers": [
                {"id": each.number, "distance": round(each.distance, 4), "bearing": round(each.bearing, 5)}
                for each in self._seen
            ],
        }
        return orjson.dumps(seen).decode()
