"""The additions of a robot with Nav2: a map, transforms, a costmap, a path, ``navigate_to_pose`` and
``follow_waypoints``.

The map's frame is rotated by 90° against the odometry's, so that a page that omits a transform is noticed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

Json = dict[str, Any]

ACTIONS = {
    "/navigate_to_pose": "nav2_msgs/action/NavigateToPose",
    "/follow_waypoints": "nav2_msgs/action/FollowWaypoints",
}
TOPICS = {
    "/global_costmap/costmap": "nav_msgs/msg/OccupancyGrid",
    "/map": "nav_msgs/msg/OccupancyGrid",
    "/plan": "nav_msgs/msg/Path",
    "/tf_static": "tf2_msgs/msg/TFMessage",
}
LATCHED = ("/global_costmap/costmap", "/map", "/tf_static")
ODOM_IN_MAP = (10.0, 5.0, math.pi / 2)
SPEED = 0.8
RESOLUTION = 0.05
MARGIN = 1.0
SUCCEEDED, CANCELED, ABORTED = 4, 5, 6


def pose(x: float, y: float, heading: float) -> Json:
    return {
        "position": {"x": x, "y": y, "z": 0.0},
        "orientation": {"x": 0.0, "y": 0.0, "z": math.sin(heading / 2), "w": math.cos(heading / 2)},
    }


def to_odom(x: float, y: float) -> tuple[float, float]:
    """A point of the map's frame in the odometry's."""
    tx, ty, turn = ODOM_IN_MAP
    c, s = math.cos(-turn), math.sin(-turn)
    return c * (x - tx) - s * (y - ty), s * (x - tx) + c * (y - ty)


class Navigation:
    """For one robot, which drives to a goal in a straight line.

    :param world: the robot (``fake_relay.World``)
    :param header: of a message, by its frame
    """

    def __init__(self, world: Any, header: Callable[[str], Json], hall: tuple[float, float]) -> None:
        self.world, self.header, self.hall = world, header, hall
        self.goal: Json | None = None
        self.reached = 0
        """Waypoints of the goal that are behind it."""
        self.send: Callable[[Json], None] = lambda message: None
        self.refuses = False
        self.waits: int | None = None

    # --- topics -----------------------------------------------------------------------------------------------

    def latched(self, topic: str) -> Json:
        if topic == "/tf_static":
            return {"transforms": [self.transform("base_link", "laser", 0.0, 0.0, 0.0)]}
        return self.grid(walls=1 if topic == "/map" else 8)

    def grid(self, walls: int) -> Json:
        """The room within unknown cells, with walls this many cells thick; it is rotated like the odometry's
        frame.
        """
        width, height = (round(2 * (side + MARGIN) / RESOLUTION) for side in self.hall)
        cells = np.full((height, width), -1, np.int8)
        edge = round(MARGIN / RESOLUTION)
        cells[edge:-edge, edge:-edge] = 100
        cells[edge + walls : -edge - walls, edge + walls : -edge - walls] = 0
        corner = (-self.hall[0] - MARGIN, -self.hall[1] - MARGIN)
        return {
            "header": self.header("map"),
            "info": {
                "resolution": RESOLUTION,
                "width": width,
                "height": height,
                "origin": pose(*self.in_map(*corner)),
            },
            "data": cells.ravel().tolist(),
        }

    def in_map(self, x: float, y: float, heading: float = 0.0) -> tuple[float, float, float]:
        tx, ty, turn = ODOM_IN_MAP
        c, s = math.cos(turn), math.sin(turn)
        return tx + c * x - s * y, ty + s * x + c * y, heading + turn

    def transforms(self) -> Json:
        world = self.world
        return {
            "transforms": [
                self.transform("map", "odom", *ODOM_IN_MAP),
                self.transform("odom", "base_link", world.x, world.y, world.heading),
            ]
        }

    def transform(self, parent: str, child: str, x: float, y: float, heading: float) -> Json:
        at = pose(x, y, heading)
        return {
            "header": self.header(parent),
            "child_frame_id": child,
            "transform": {"translation": at["position"], "rotation": at["orientation"]},
        }

    def plan(self) -> Json | None:
        """The line to the goal, if there is one."""
        if self.goal is None:
            return None
        target = self.target["pose"]
        here = pose(*self.in_map(self.world.x, self.world.y))
        poses = [{"header": self.header("map"), "pose": each} for each in (here, target)]
        return {"header": self.header("map"), "poses": poses}

    # --- the actions ------------------------------------------------------------------------------------------

    @property
    def target(self) -> Json:
        """The pose of its goal."""
        assert self.goal is not None
        args = self.goal["args"]
        pose: Json = args["poses"][self.reached] if "poses" in args else args["pose"]
        return pose

    def begin(self, goal: Json, send: Callable[[Json], None]) -> None:
        if self.goal is not None:
            self.end(ABORTED)
        self.goal, self.send, self.reached = goal, send, 0
        if self.refuses:
            self.end(ABORTED, {"error_code": 208, "error_msg": ""})

    def end(self, status: int, values: Json | None = None) -> None:
        if self.goal is None:
            return
        goal, self.goal = self.goal, None
        self.world.speed = 0.0
        answer = {"op": "action_result", "action": goal["action"], "id": goal["id"], "status": status}
        self.send(answer | {"result": True, "values": values or {"error_code": 0, "error_msg": ""}})

    def step(self, span: float, stopped: bool) -> None:
        """Drives on for this many seconds."""
        if self.goal is None:
            return
        if stopped:
            self.end(CANCELED)
            return
        world, target = self.world, self.target["pose"]["position"]
        x, y = to_odom(target["x"], target["y"])
        left = math.hypot(x - world.x, y - world.y)
        if left < 0.05:
            self.reached += 1
            if self.reached >= len(self.goal["args"].get("poses", "1")):
                self.end(SUCCEEDED)
            return
        share = min(1.0, SPEED * span / left) if self.reached != self.waits else 0.0
        world.heading = math.atan2(y - world.y, x - world.x)
        world.x, world.y = world.x + (x - world.x) * share, world.y + (y - world.y) * share
        self.send(
            {
                "op": "action_feedback",
                "action": self.goal["action"],
                "id": self.goal["id"],
                "values": {
                    "current_waypoint": self.reached,
                    "distance_remaining": left,
                    "navigation_time": {"sec": 3, "nanosec": 0},
                    "estimated_time_remaining": {"sec": round(left / SPEED), "nanosec": 0},
                    "number_of_recoveries": 1,
                },
            }
        )
