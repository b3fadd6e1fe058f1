"""Messages of /tf and /tf_static, and the robot's pose from them."""

from __future__ import annotations

import math
from collections import deque
from typing import Any, NamedTuple

from rclpy.serialization import deserialize_message
from tf2_msgs.msg import TFMessage

from relay_protocol.errors import Unavailable
from robot_client.navigation import messages
from robot_client.navigation.grid import Floats, Pose2D
from robot_client.navigation.transforms import TransformTree

_MOST_UNREAD = 200


class LocatedPose(NamedTuple):
    """The robot's pose in the map, and when its transforms came.

    :ivar odometry_at: seconds, of the oldest transform of the chain but the localiser's
    :ivar localiser_at: seconds, of the transform that touches the map; ``inf`` if it is static
    """

    pose: Pose2D
    odometry_at: float
    localiser_at: float


class TransformBuffer:
    """Transforms by frame. Messages of /tf are read when they are needed: they come often and are seldom needed."""

    def __init__(self) -> None:
        self._tree = TransformTree()
        self._unread: deque[tuple[bytes, float]] = deque()

    def add(self, message: bytes, now: float) -> None:
        """Take a message of /tf.

        :param message: serialized
        :param now: monotonic seconds
        """
        self._unread.append((message, now))
        if len(self._unread) >= _MOST_UNREAD:
            self._read()

    def add_static(self, message: TFMessage) -> None:
        """A message of /tf_static."""
        self._set(message, math.inf)

    def lookup(self, target: str, source: str, stamp: float | None = None) -> Floats:
        """As :meth:`TransformTree.lookup`.

        :raises Unavailable: the frames are not connected
        """
        self._read()
        return self._tree.lookup(target, source, stamp)

    def locate(self, map_frame: str, base_frame: str) -> LocatedPose:
        """The robot's pose.

        If no transform but the one that touches the map is dynamic, that is the odometry's, too.

        :raises Unavailable: the frames are not connected, or only by static transforms: no robot moves by those
        """
        matrix = self.lookup(map_frame, base_frame)
        *inner, localiser = self._tree.arrivals(map_frame, base_frame) or [math.inf]
        odometry = min(inner, default=math.inf)
        if math.isinf(odometry):
            odometry = localiser
        if math.isinf(odometry):
            raise Unavailable(f"no transform on /tf moves '{base_frame}' in '{map_frame}'")
        return LocatedPose(messages.pose_of(matrix), odometry, localiser)

    def _read(self) -> None:
        while self._unread:
            body, at = self._unread.popleft()
            self._set(deserialize_message(body, TFMessage), at)

    def _set(self, message: Any, at: float) -> None:
        for each in message.transforms:
            try:
                matrix = messages.read_transform(each)
            except Unavailable:
                continue
            stamp = messages.seconds_of(each.header.stamp)
            self._tree.set(each.header.frame_id, each.child_frame_id, stamp, matrix, at)
