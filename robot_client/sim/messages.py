"""Builds ROS 2 messages from the simulated robot's state; publishes nothing."""

from __future__ import annotations

import array
import math
import sys

import numpy as np
import numpy.typing as npt
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Quaternion, TransformStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from sensor_msgs.msg import BatteryState, CameraInfo, CompressedImage, Image, LaserScan
from std_msgs.msg import Header

from robot_client.sim import robot as scanner
from robot_client.sim.depth_camera import FOCAL
from robot_client.sim.drive import Twist
from robot_client.sim.floor_plan import FloorPlan
from robot_client.sim.health import PartFinding
from robot_client.sim.robot import CAPACITY_AH, SimBattery
from robot_client.sim.world import Pose

LASER_HEIGHT = 0.18
_POSITION_VARIANCE = 1e-4
_VELOCITY_VARIANCE = 1e-4
_UNUSED_VARIANCE = 1e6
_COVARIANCE_DIAGONAL = tuple(range(0, 36, 7))


class Frames:
    """Names of the coordinate frames; robots that share a graph have their namespace before them."""

    def __init__(self, namespace: str) -> None:
        prefix = namespace.strip("/")
        prefix = f"{prefix}/" if prefix else ""
        self.map = f"{prefix}map"
        self.odom = f"{prefix}odom"
        self.base = f"{prefix}base_link"
        self.laser = f"{prefix}laser"
        self.camera = f"{prefix}camera"
        self.depth = f"{prefix}camera_depth_optical_frame"


def odometry(stamp: Time, frames: Frames, pose: Pose, velocity: Twist) -> Odometry:
    """Pose relative to the world's origin, velocity in the body's frame."""
    message = Odometry(header=Header(stamp=stamp, frame_id=frames.odom))
    message.child_frame_id = frames.base
    message.pose.pose.position.x = pose.x
    message.pose.pose.position.y = pose.y
    message.pose.pose.orientation = _yaw(pose.heading)
    message.twist.twist.linear.x = velocity.speed
    message.twist.twist.angular.z = velocity.turn
    message.pose.covariance = _covariance(_POSITION_VARIANCE)
    message.twist.covariance = _covariance(_VELOCITY_VARIANCE)
    return message


def transform(stamp: Time, frames: Frames, pose: Pose) -> TransformStamped:
    """odom → base_link."""
    return _transform(stamp, frames.odom, frames.base, pose, 0.0)


def static_transforms(stamp: Time, frames: Frames, camera_height: float) -> list[TransformStamped]:
    """map → odom, which is exact; base_link → laser and cameras, which sit in the middle of the robot.

    :param camera_height: metres over the floor
    """
    middle = Pose(0.0, 0.0, 0.0)
    depth = _transform(stamp, frames.base, frames.depth, middle, camera_height)
    # REP 103: z ahead, x to the right, y down.
    depth.transform.rotation = Quaternion(x=-0.5, y=0.5, z=-0.5, w=0.5)
    return [
        depth,
        _transform(stamp, frames.map, frames.odom, middle, 0.0),
        _transform(stamp, frames.base, frames.laser, middle, LASER_HEIGHT),
        _transform(stamp, frames.base, frames.camera, middle, camera_height),
    ]


def scan(stamp: Time, frames: Frames, ranges: npt.NDArray[np.float32], period: float) -> LaserScan:
    """:param ranges: metres per ray; :param period: seconds from one scan to the next"""
    message = LaserScan(header=Header(stamp=stamp, frame_id=frames.laser))
    message.angle_min = scanner.SCAN_BEGIN
    message.angle_max = scanner.SCAN_BEGIN + scanner.SCAN_STEP * (len(ranges) - 1)
    message.angle_increment = scanner.SCAN_STEP
    message.scan_time = period
    message.time_increment = period / len(ranges)
    message.range_min = scanner.SCAN_NEAREST
    message.range_max = scanner.SCAN_FARTHEST
    message.ranges = array.array("f", ranges.tobytes())
    return message


def image(stamp: Time, frames: Frames, pixels: npt.NDArray[np.uint8]) -> Image:
    """:param pixels: R, G, B, shape (height, width, 3)"""
    message = Image(header=Header(stamp=stamp, frame_id=frames.camera))
    message.height, message.width = pixels.shape[:2]
    message.step = message.width * 3
    message.encoding = "rgb8"
    message.data.frombytes(pixels.data)
    return message


def depth_image(stamp: Time, frames: Frames, depth: npt.NDArray[np.uint16]) -> Image:
    """:param depth: millimetres, shape (height, width)"""
    message = Image(header=Header(stamp=stamp, frame_id=frames.depth))
    message.height, message.width = depth.shape
    message.step = message.width * 2
    message.encoding = "16UC1"
    message.is_bigendian = sys.byteorder == "big"
    message.data.frombytes(depth.tobytes())
    return message


def depth_camera_info(stamp: Time, frames: Frames, width: int, height: int) -> CameraInfo:
    """The model of the depth camera, without distortion."""
    message = CameraInfo(header=Header(stamp=stamp, frame_id=frames.depth), width=width, height=height)
    across, down = (width - 1) / 2, (height - 1) / 2
    message.distortion_model, message.d = "plumb_bob", [0.0] * 5
    message.k = np.array((FOCAL, 0, across, 0, FOCAL, down, 0, 0, 1), dtype=np.float64)
    message.r = np.eye(3).ravel()
    message.p = np.array((FOCAL, 0, across, 0, 0, FOCAL, down, 0, 0, 0, 1, 0), dtype=np.float64)
    return message


def occupancy_grid(stamp: Time, frames: Frames, plan: FloorPlan) -> OccupancyGrid:
    """The map."""
    message = OccupancyGrid(header=Header(stamp=stamp, frame_id=frames.map))
    message.info.map_load_time = stamp
    message.info.resolution = plan.resolution
    message.info.height, message.info.width = plan.cells.shape
    message.info.origin.position.x, message.info.origin.position.y = plan.x, plan.y
    message.data = array.array("b", plan.cells.tobytes())
    return message


def compressed(stamp: Time, frames: Frames, jpeg: bytes) -> CompressedImage:
    """:param jpeg: a JPEG file"""
    message = CompressedImage(header=Header(stamp=stamp, frame_id=frames.camera))
    message.format = "rgb8; jpeg compressed bgr8"
    message.data = array.array("B", jpeg)
    return message


def battery(stamp: Time, frames: Frames, pack: SimBattery) -> BatteryState:
    """The state of the battery; values that are not measured are NaN, as the message's definition requires."""
    message = BatteryState(header=Header(stamp=stamp, frame_id=frames.base))
    message.voltage = pack.voltage
    message.current = -pack.current
    message.charge = pack.charge * CAPACITY_AH
    message.capacity = message.design_capacity = CAPACITY_AH
    message.percentage = pack.charge
    message.temperature = math.nan
    message.power_supply_status = _supply_status(pack)
    message.power_supply_health = BatteryState.POWER_SUPPLY_HEALTH_GOOD
    message.power_supply_technology = BatteryState.POWER_SUPPLY_TECHNOLOGY_LION
    message.present = True
    return message


def _supply_status(pack: SimBattery) -> int:
    if not pack.charging:
        return int(BatteryState.POWER_SUPPLY_STATUS_DISCHARGING)
    full = pack.charge >= 1.0
    return int(BatteryState.POWER_SUPPLY_STATUS_FULL if full else BatteryState.POWER_SUPPLY_STATUS_CHARGING)


def diagnostics(stamp: Time, robot: str, findings: list[PartFinding]) -> DiagnosticArray:
    """:param robot: the name before that of each part"""
    message = DiagnosticArray(header=Header(stamp=stamp))
    message.status = [
        DiagnosticStatus(
            level=bytes((finding.severity,)),
            name=f"{robot}: {finding.part}",
            message=finding.message,
            hardware_id=robot,
            values=[KeyValue(key=key, value=value) for key, value in finding.values.items()],
        )
        for finding in findings
    ]
    return message


def _transform(stamp: Time, parent: str, child: str, pose: Pose, height: float) -> TransformStamped:
    message = TransformStamped(header=Header(stamp=stamp, frame_id=parent))
    message.child_frame_id = child
    message.transform.translation.x = pose.x
    message.transform.translation.y = pose.y
    message.transform.translation.z = height
    message.transform.rotation = _yaw(pose.heading)
    return message


def _yaw(heading: float) -> Quaternion:
    return Quaternion(x=0.0, y=0.0, z=math.sin(heading / 2), w=math.cos(heading / 2))


def _covariance(variance: float) -> npt.NDArray[np.float64]:
    """6 × 6, row by row: x, y and yaw are known, the other three are not."""
    matrix = np.zeros(36)
    matrix[list(_COVARIANCE_DIAGONAL)] = _UNUSED_VARIANCE
    matrix[[0, 7, 35]] = variance
    return matrix
