"""The service ``faces`` in the graph."""

from __future__ import annotations

import time
from typing import Any

import cv2
import orjson
from builtin_interfaces.msg import Duration
from std_msgs.msg import Header, String
from visualization_msgs.msg import Marker, MarkerArray

from robot_client.services.faces import FACE, Finder, KnownFaces, SeenFace, look
from robot_client.services.health import Level, ServiceFinding
from robot_client.services.pictures import ImageRequest, ImageSource

STAYS = 1.0
"""Seconds a face is shown after the picture it was seen in."""


class Faces:
    """Says which faces a camera sees, where and whose.

    :param asked: the camera
    :param finder: finds them
    :param people: who is known
    :param rate: pictures per second that are looked at, at most
    """

    def __init__(
        self, node: Any, asked: ImageRequest, finder: Finder, people: KnownFaces, rate: float
    ) -> None:
        cv2.setNumThreads(1)  # a robot's other cores have other work
        self._finder = finder
        self._people = people
        self._period = 1 / rate
        self._next = 0.0
        self._took = 0.0
        self._seen: list[SeenFace] = []
        self._array = node.create_publisher(MarkerArray, "faces", 10)
        self._text = node.create_publisher(String, "faces/seen", 10)
        self._pictures = ImageSource(node, asked, self._saw)

    def finding(self) -> ServiceFinding:
        """Whom it sees."""
        trouble = self._pictures.finding()
        if trouble:
            return trouble
        values = {"people": str(len(self._people.names)), "look_ms": f"{self._took * 1000:.0f}"}
        names = ", ".join(each.name or "a face" for each in self._seen)
        return ServiceFinding(Level.OK, f"sees {names}" if names else "sees no face", values)

    def close(self) -> None:
        """Nothing is left to do."""

    def _saw(self, message: bytes, header: Header) -> None:
        began = time.monotonic()
        if began < self._next:
            return
        picture = self._pictures.pixels(message)
        lens = self._pictures.lens(picture.width, picture.height)
        self._seen = look(picture.pixels, lens, self._finder, self._people)
        ended = time.monotonic()
        self._took = ended - began
        # However long a look takes, half of a core is left.
        self._next = max(began + self._period, ended + self._took)
        self._array.publish(
            MarkerArray(markers=[self._marker(*each, header) for each in enumerate(self._seen)])
        )
        self._text.publish(String(data=self._told(header)))

    def _marker(self, number: int, seen: SeenFace, header: Header) -> Marker:
        marker = Marker(header=header, ns="faces", id=number, type=Marker.SPHERE)
        marker.action = Marker.ADD
        place = marker.pose.position
        place.x, place.y, place.z = seen.position
        marker.pose.orientation.w = 1.0
        marker.scale.x = marker.scale.y = marker.scale.z = FACE
        marker.color.a = 1.0
        # Who is known is green, others are yellow.
        marker.color.g, marker.color.r = 1.0, 0.0 if seen.name else 1.0
        marker.text = seen.name or ""
        marker.lifetime = Duration(sec=int(STAYS), nanosec=int(STAYS % 1 * 1e9))
        return marker

    def _told(self, header: Header) -> str:
        """The same for programs that greet somebody."""
        told = {
            "stamp": header.stamp.sec + header.stamp.nanosec / 1e9,
            "frame": header.frame_id,
            "faces": [
                {
                    "name": each.name,
                    "alike": round(each.alike, 3),
                    "distance": round(each.distance, 2),
                    "bearing": round(each.bearing, 3),
                    "box": list(each.box),
                }
                for each in self._seen
            ],
        }
        return orjson.dumps(told).decode()
