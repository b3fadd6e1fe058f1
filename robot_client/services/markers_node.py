"""The service ``markers`` in the graph."""

from __future__ import annotations

from typing import Any

import cv2
import orjson
from builtin_interfaces.msg import Duration
from std_msgs.msg import Header, String
from visualization_msgs.msg import Marker, MarkerArray

from robot_client.services.health import Level, ServiceFinding
from robot_client.services.markers import Detector, SeenMarker
from robot_client.services.pictures import ImageRequest, ImageSource

STAYS = 0.5
"""Seconds a marker is shown after the picture it was seen in."""


class Markers:
    """Says which markers a camera sees, and where.

    :param asked: the camera
    :param size: metres, of the black square's side
    """

    def __init__(self, node: Any, asked: ImageRequest, dictionary: str, size: float) -> None:
        cv2.setNumThreads(1)  # a robot's other cores have other work
        self._dictionary = dictionary
        self._size = size
        self._detector = Detector(dictionary, size)
        self._seen: list[SeenMarker] = []
        self._array = node.create_publisher(MarkerArray, "markers", 10)
        self._text = node.create_publisher(String, "markers/seen", 10)
        self._pictures = ImageSource(node, asked, self._saw)

    def finding(self) -> ServiceFinding:
        """What it sees."""
        trouble = self._pictures.finding()
        if trouble:
            return trouble
        values = {f"marker {each.number}": f"{each.distance:.2f} m" for each in self._seen}
        numbers = ", ".join(str(each.number) for each in self._seen)
        return ServiceFinding(Level.OK, f"sees {numbers}" if numbers else "sees no marker", values)

    def close(self) -> None:
        """Nothing is left to do."""

    def _saw(self, message: bytes, header: Header) -> None:
        picture = self._pictures.pixels(message)
        lens = self._pictures.lens(picture.width, picture.height)
        self._seen = self._detector.find(picture.pixels, lens)
        self._array.publish(MarkerArray(markers=[self._marker(each, header) for each in self._seen]))
        self._text.publish(String(data=self._told(header)))

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
        marker.lifetime = Duration(sec=int(STAYS), nanosec=int(STAYS % 1 * 1e9))
        return marker

    def _told(self, header: Header) -> str:
        """The same for programs that drive somewhere: nothing to compute any more."""
        told = {
            "stamp": header.stamp.sec + header.stamp.nanosec / 1e9,
            "frame": header.frame_id,
            "markers": [
                {"id": each.number, "distance": round(each.distance, 4), "bearing": round(each.bearing, 5)}
                for each in self._seen
            ],
        }
        return orjson.dumps(told).decode()
