"""ROS messages of the navigator: read and built, not published."""

from __future__ import annotations

import array
import math
from typing import Any

import numpy as np
import numpy.typing as npt
from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import PoseStamped
from geometry_msgs.msg import Twist as TwistMessage
from nav2_msgs.action import NavigateToPose
from nav_msgs.msg import OccupancyGrid, Path
from sensor_msgs.msg import CameraInfo, Image, LaserScan
from std_msgs.msg import Header

from relay_protocol.errors import Invalid
from robot_client.camera.images import ImageMessage
from robot_client.navigation.costmap import OccupancyMap, SensorView
from robot_client.navigation.grid import Floats, GridGeometry, Pose2D
from robot_client.navigation.navigator import NavigationProgress
from robot_client.navigation.outcome import NavigationOutcome
from robot_client.navigation.pursuit import DriveCommand
from robot_client.navigation.sensors import SHORTEST_DEPTH, view_of_depth, view_of_scan
from robot_client.navigation.transforms import matrix_of
from robot_client.services import camera_model, obstacles

MOST_CELLS = 16_000_000
_LEVEL = math.sin(math.radians(5))
"""Most tilt of a depth camera, as a sine."""


def read_map(message: OccupancyGrid) -> OccupancyMap:
    """:raises Invalid: it has no cells, too many, or is turned"""
    info = message.info
    rows, columns = info.height, info.width
    if rows * columns > MOST_CELLS:
        raise Invalid(
            f"a map of {columns}×{rows} cells is too large: at most {MOST_CELLS:,} cells; make its cells larger"
        )
    if not (rows * columns > 0 and info.resolution > 0 and len(message.data) == rows * columns):
        raise Invalid(f"a map of {columns}×{rows} cells of {info.resolution} m is invalid")
    if abs(info.origin.orientation.z) > 1e-6:
        raise Invalid("the map is turned in its frame, which is not supported")
    origin = info.origin.position
    geometry = GridGeometry(origin.x, origin.y, info.resolution, rows, columns)
    occupancy = np.frombuffer(message.data, dtype=np.int8).reshape(rows, columns)
    return OccupancyMap(message.header.frame_id, geometry, occupancy)


def read_transform(message: Any) -> Floats:
    """The matrix of a geometry_msgs/TransformStamped.

    :raises Unavailable: it is invalid
    """
    shift, turn = message.transform.translation, message.transform.rotation
    return matrix_of((shift.x, shift.y, shift.z), (turn.x, turn.y, turn.z, turn.w))


def read_pose(message: PoseStamped, to_map: Floats) -> Pose2D:
    """A pose in the map.

    :param to_map: matrix from the pose's frame to the map
    :raises Unavailable: it is invalid
    """
    place, turn = message.pose.position, message.pose.orientation
    return pose_of(to_map @ matrix_of((place.x, place.y, place.z), (turn.x, turn.y, turn.z, turn.w)))


def pose_of(matrix: Floats) -> Pose2D:
    """Place and direction of a frame whose x axis looks ahead."""
    return Pose2D(float(matrix[0, 3]), float(matrix[1, 3]), math.atan2(matrix[1, 0], matrix[0, 0]))


def scan_view(message: LaserScan, to_map: Floats) -> SensorView:
    """What a scanner sees; ``to_map`` is the matrix from its frame to the map."""
    ranges = np.frombuffer(message.ranges, dtype=np.float32).astype(np.float64)
    angles = message.angle_min + message.angle_increment * np.arange(len(ranges))
    return view_of_scan(pose_of(to_map), ranges, angles, message.range_max)


def depth_view(
    message: Image, info: CameraInfo, to_map: Floats, shortest: float = SHORTEST_DEPTH
) -> SensorView:
    """What a depth camera sees.

    :param to_map: the matrix from its optical frame (REP 103) to the map
    :param shortest: metres, its shortest range
    :raises Invalid: the image is broken, or the camera is not level
    """
    ahead, down = to_map[:3, 2], to_map[:3, 1]
    if abs(ahead[2]) > _LEVEL or down[2] > -math.cos(math.radians(5)):
        raise Invalid("the depth camera is not level, which is not supported")
    image = ImageMessage(
        message.encoding,
        message.width,
        message.height,
        bool(message.is_bigendian),
        message.step,
        memoryview(message.data).cast("B"),
    )
    model = camera_model.calibrated(info.k, info.d, str(info.distortion_model))
    if info.width:
        model = model.scaled(message.width / info.width)
    pose = Pose2D(float(to_map[0, 3]), float(to_map[1, 3]), math.atan2(ahead[1], ahead[0]))
    return view_of_depth(pose, obstacles.metres(image), model, float(to_map[2, 3]), shortest)


def pose_message(header: Header, pose: Pose2D) -> PoseStamped:
    """A pose in the map."""
    message = PoseStamped(header=header)
    message.pose.position.x, message.pose.position.y = float(pose.x), float(pose.y)
    message.pose.orientation.z = math.sin(pose.heading / 2)
    message.pose.orientation.w = math.cos(pose.heading / 2)
    return message


def path_message(header: Header, path: Floats) -> Path:
    """A path; each pose looks to the next."""
    ahead = np.diff(path, axis=0)
    headings = np.arctan2(ahead[:, 1], ahead[:, 0]).tolist() if len(ahead) else []
    headings.append(headings[-1] if headings else 0.0)
    poses = [Pose2D(x, y, heading) for (x, y), heading in zip(path.tolist(), headings, strict=True)]
    return Path(header=header, poses=[pose_message(header, each) for each in poses])


def grid_message(header: Header, geometry: GridGeometry, cells: npt.NDArray[np.int8]) -> OccupancyGrid:
    """A costmap."""
    message = OccupancyGrid(header=header)
    message.info.map_load_time = header.stamp
    message.info.resolution = geometry.resolution
    message.info.width, message.info.height = geometry.columns, geometry.rows
    message.info.origin.position.x, message.info.origin.position.y = geometry.x, geometry.y
    message.data = array.array("b", cells.tobytes())
    return message


def twist_message(command: DriveCommand) -> TwistMessage:
    """A command of velocity."""
    message = TwistMessage()
    message.linear.x, message.angular.z = float(command.speed), float(command.turn)
    return message


def feedback_message(progress: NavigationProgress, pose: PoseStamped) -> Any:
    """Feedback of NavigateToPose."""
    message = NavigateToPose.Feedback(current_pose=pose)
    message.navigation_time = _duration(progress.seconds)
    message.estimated_time_remaining = _duration(progress.seconds_left)
    message.number_of_recoveries = progress.recoveries
    message.distance_remaining = float(progress.distance_left)
    return message


def result_message(outcome: NavigationOutcome) -> Any:
    """Result of NavigateToPose; releases after Jazzy have a sentence in it, too."""
    message = NavigateToPose.Result(error_code=int(outcome.code))
    if hasattr(message, "error_msg"):
        message.error_msg = outcome.message
    return message


def seconds_of(stamp: Time) -> float:
    """A stamp in seconds."""
    return float(stamp.sec + stamp.nanosec / 1e9)


def _duration(seconds: float) -> Duration:
    whole = int(seconds)
    return Duration(sec=whole, nanosec=int((seconds - whole) * 1e9))
