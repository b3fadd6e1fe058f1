"""Driving to a marker: what battery, markers and scanner tell, and what follows from it. Pure."""

from __future__ import annotations

import json
import math
from typing import Any, NamedTuple

from robot_client.apps.driver import STILL, VelocityCommand

HALF = 0.25
"""Metres to either side of the way ahead in which something is in the way."""
FRONT = math.radians(60)
"""To either side of straight ahead; what is beside the robot is not in its way."""

NEARER = 0.6
"""1/s: how fast it drives for each metre that is left."""
SLOWEST = 0.05
"""Metres per second at which it still arrives."""
TURNING = 1.5
"""1/s: how fast it turns for each radian that the marker is to the side."""
ASIDE = math.radians(25)
"""A marker that is more to the side is turned to first."""

CHARGING, FULL = 1, 4
UNKNOWN = 0
"""Numbers of sensor_msgs/BatteryState's ``power_supply_status``."""


class DockingTopics(NamedTuple):
    """Where is heard of what.

    :ivar battery: BatteryState
    :ivar markers: String, of the service ``markers``
    :ivar scan: LaserScan
    """

    battery: str
    markers: str
    scan: str

    def kinds(self) -> list[tuple[str, str]]:
        """Each with its type."""
        return [
            (self.battery, "sensor_msgs/msg/BatteryState"),
            (self.markers, "std_msgs/msg/String"),
            (self.scan, "sensor_msgs/msg/LaserScan"),
        ]


class Charge(NamedTuple):
    """What is known of a battery.

    :ivar share: 0 to 1
    :ivar status: as in sensor_msgs/BatteryState
    """

    share: float
    status: int

    @property
    def fed(self) -> bool:
        """Whether it hangs on a charger, as far as it tells."""
        return self.status in (CHARGING, FULL)


def charge(message: dict[str, Any]) -> Charge | None:
    """What a ``sensor_msgs/BatteryState`` tells; ``None`` when it tells no charge from 0 to 1."""
    share, status = message.get("percentage"), message.get("power_supply_status")
    if not isinstance(share, (int, float)) or not 0.0 <= share <= 1.0:
        return None
    return Charge(float(share), status if isinstance(status, int) else UNKNOWN)


class Need:
    """Whether a battery needs charging: from when it is low until it has enough.

    :param low: share, 0 to 1, below which it is low
    :param enough: share from which it has enough
    :ivar urgent: whether it does
    """

    def __init__(self, low: float, enough: float) -> None:
        self._low = low
        self._enough = enough
        self.urgent = False

    def see(self, seen: Charge) -> None:
        """What the battery tells now."""
        if seen.share >= self._enough or seen.status == FULL:
            self.urgent = False
        elif seen.share < self._low:
            self.urgent = True


class Sighting(NamedTuple):
    """Where a marker is.

    :ivar distance: metres
    :ivar bearing: radians from straight ahead, to the left
    """

    distance: float
    bearing: float


def sighting(text: Any, number: int) -> Sighting | None:
    """Where a marker is by what the service ``markers`` tells.

    :param text: ``data`` of ``markers/seen``
    :param number: the marker's
    :returns: ``None`` when it is not seen, or what is told makes no sense
    """
    try:
        for each in json.loads(text)["markers"]:
            if each["id"] == number:
                found = Sighting(float(each["distance"]), float(each["bearing"]))
                return found if all(map(math.isfinite, found)) and found.distance > 0.0 else None
    except (ValueError, TypeError, KeyError):
        pass
    return None


def way_ahead(message: dict[str, Any]) -> float | None:
    """Metres to the nearest thing in the way ahead, infinite when there is none.

    :param message: ``sensor_msgs/LaserScan`` of a scanner that looks ahead, in the middle of the robot
    :returns: ``None`` when it makes no sense, or no ray has measured anything
    """
    try:
        ranges, begin, step = (
            message["ranges"],
            float(message["angle_min"]),
            float(message["angle_increment"]),
        )
        nearest, measured = math.inf, False
        for number, distance in enumerate(ranges):
            # Nothing there, and what is no number, are null in JSON.
            if distance is None or not distance > 0.0:
                continue
            measured = True
            angle = math.remainder(begin + number * step, math.tau)
            if abs(angle) <= FRONT and abs(distance * math.sin(angle)) <= HALF:
                nearest = min(nearest, distance * math.cos(angle))
    except (TypeError, KeyError, ValueError):
        return None
    return nearest if measured else None


class Approach(NamedTuple):
    """How it drives there.

    :ivar distance: metres from the marker at which it is there
    :ivar speed: metres per second, the fastest
    :ivar turn: radians per second, the fastest
    """

    distance: float
    speed: float
    turn: float

    def arrived(self, seen: Sighting) -> bool:
        """Whether it is there."""
        return seen.distance <= self.distance

    def command(self, seen: Sighting) -> VelocityCommand:
        """What brings it nearer."""
        if self.arrived(seen):
            return STILL
        turn = max(-self.turn, min(self.turn, TURNING * seen.bearing))
        if abs(seen.bearing) > ASIDE:
            return VelocityCommand(0.0, turn)
        speed = max(SLOWEST, NEARER * (seen.distance - self.distance))
        return VelocityCommand(min(self.speed, speed), turn)
