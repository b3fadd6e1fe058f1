"""ROS node of the service ``faces``."""

from __future__ import annotations

import time
from typing import Any

import cv2
import orjson
from builtin_interfaces.msg import Duration
from std_msgs.msg import Header, String
from visualization_msgs.msg import Marker, MarkerArray

from robot_client.services.faces import FACE, FaceFinder, KnownFaces, SeenFace, grey_of, recognise_faces
from robot_client.services.health import Level, ServiceFinding
from robot_client.services.images import ImageRequest, ImageSource
from robot_client.services.placement import CameraImage, RunOptions, face_function

LIFETIME_SECONDS = 1.0
"""Lifetime of a face's marker, seconds."""


class Faces:
    """Publishes the faces a camera sees, with position and name.

    :param request: the camera
    :param finder: detector
    :param people: known persons
    :param rate: most images per second to process
    :param run: where faces are found; they are recognised here
    """

    def __init__(
        self,
        node: Any,
        request: ImageRequest,
        finder: FaceFinder,
        people: KnownFaces,
        rate: float,
        run: RunOptions,
    ) -> None:
        cv2.setNumThreads(1)  # leaves the other cores to other programs
        self._run = run
        self._find = face_function(finder, run)
        self._people = people
        self._period = 1 / rate
        self._next = 0.0
        self._processing_seconds = 0.0
        self._seen: list[SeenFace] = []
        self._array = node.create_publisher(MarkerArray, "faces", 10)
        self._text = node.create_publisher(String, "faces/seen", 10)
        self._images = ImageSource(node, request, self._on_image)

    def finding(self) -> ServiceFinding:
        """The faces seen now."""
        problem = self._images.finding()
        if problem:
            return problem
        values = {
            "people": str(len(self._people.names)),
            "processing_ms": f"{self._processing_seconds * 1000:.0f}",
            **self._find.shown(),
        }
        names = ", ".join(each.name or "a face" for each in self._seen)
        return ServiceFinding(Level.OK, f"sees {names}" if names else "sees no face", values)

    def close(self) -> None:
        """Close the link to the workers."""
        self._run.client.close()

    def _on_image(self, message: bytes, header: Header) -> None:
        began = time.monotonic()
        if began < self._next:
            return
        image = self._images.pixels(message)
        model = self._images.camera_model(image.width, image.height)
        boxes = self._find(CameraImage(image.pixels, self._images.file(message)))
        self._seen = recognise_faces(grey_of(image.pixels), boxes, model, self._people)
        ended = time.monotonic()
        self._processing_seconds = ended - began
        # Half of a core stays free, however long an image takes.
        busy = 0.0 if self._find.ran_away else self._processing_seconds
        self._next = max(began + self._period, ended + busy)
        self._array.publish(
            MarkerArray(
                markers=[self._marker(number, seen, header) for number, seen in enumerate(self._seen)]
            )
        )
        self._text.publish(String(data=self._as_json(header)))

    def _marker(self, number: int, seen: SeenFace, header: Header) -> Marker:
        marker = Marker(header=header, ns="faces", id=number, type=Marker.SPHERE)
        marker.action = Marker.ADD
        place = marker.pose.position
        place.x, place.y, place.z = seen.position
        marker.pose.orientation.w = 1.0
        marker.scale.x = marker.scale.y = marker.scale.z = FACE
        marker.color.a = 1.0
        # Recognised faces are green, others yellow.
        marker.color.g, marker.color.r = 1.0, 0.0 if seen.name else 1.0
        marker.text = seen.name or ""
        marker.lifetime = Duration(sec=int(LIFETIME_SECONDS), nanosec=int(LIFETIME_SECONDS % 1 * 1e9))
        return marker

    def _as_json(self, header: Header) -> str:
        """The faces as JSON, for other programs."""
        seen = {
            "stamp": header.stamp.sec + header.stamp.nanosec / 1e9,
            "frame": header.frame_id,
            "faces": [
                {
                    "name": each.name,
                    "similarity": round(each.similarity, 3),
                    "distance": round(each.distance, 2),
                    "bearing": round(each.bearing, 3),
                    "box": list(each.box),
                }
                for each in self._seen
            ],
        }
        return orjson.dumps(seen).decode()
