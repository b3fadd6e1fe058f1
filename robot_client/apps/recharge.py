"""Drives a robot whose battery is low to its charger: ``python -m robot_client.apps.recharge``.

When the battery is low, it takes control, turns until the service ``markers`` sees the charger's marker, drives there,
stops, and releases control. It never takes control from others: while another client holds control or the robot is
stopped, it waits, and it releases control on request. It stops for obstacles, a lost marker, a silent scanner and a
robot that does not answer.
"""

from __future__ import annotations

import enum
import json
import math
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import click

from relay_protocol.clocks import now as seconds_since_boot
from relay_protocol.command_output import OutputCommand
from robot_client.apps.connection import RosbridgeConnection, access_token, errors_as_click
from robot_client.apps.driver import ZERO_VELOCITY, Driver, StopRequest, VelocityCommand
from robot_client.apps.program import ExitSignal, StatusLine, driving, run_connected
from robot_client.command_line import Number

HALF_WIDTH = 0.25
"""Half the width of the robot's path, metres."""
FRONT = math.radians(60)
"""Half the angle of the scanner that counts as ahead, radians."""

SPEED_GAIN = 0.6
"""m/s for each metre of remaining distance."""
MIN_SPEED = 0.05
"""Least speed towards the marker, m/s."""
TURN_GAIN = 1.5
"""rad/s for each radian of bearing."""
TURN_FIRST_ANGLE = math.radians(25)
"""With a larger bearing the robot only turns."""

CHARGING, FULL = 1, 4
UNKNOWN = 0
"""Numbers of sensor_msgs/BatteryState's ``power_supply_status``."""


class DockingTopics(NamedTuple):
    """Topics.

    :ivar battery: BatteryState
    :ivar markers: String, of the service ``markers``
    :ivar scan: LaserScan
    """

    battery: str
    markers: str
    scan: str

    def with_types(self) -> list[tuple[str, str]]:
        """Each topic with its type."""
        return [
            (self.battery, "sensor_msgs/msg/BatteryState"),
            (self.markers, "std_msgs/msg/String"),
            (self.scan, "sensor_msgs/msg/LaserScan"),
        ]


class Charge(NamedTuple):
    """State of a battery.

    :ivar level: 0 to 1
    :ivar status: as in sensor_msgs/BatteryState
    """

    level: float
    status: int

    @property
    def charging(self) -> bool:
        """Whether it reports that a charger is connected."""
        return self.status in (CHARGING, FULL)


def parse_battery(message: dict[str, Any]) -> Charge | None:
    """Parse a ``sensor_msgs/BatteryState``; ``None`` without a charge from 0 to 1."""
    share, status = message.get("percentage"), message.get("power_supply_status")
    if not isinstance(share, (int, float)) or not 0.0 <= share <= 1.0:
        return None
    return Charge(float(share), status if isinstance(status, int) else UNKNOWN)


class ChargeNeed:
    """Whether a battery needs charging: from low until enough, with hysteresis.

    :param low: charge, 0 to 1, below which it is low
    :param enough: charge from which it is enough
    :ivar urgent: whether it needs charging
    """

    def __init__(self, low: float, enough: float) -> None:
        self._low = low
        self._enough = enough
        self.urgent = False

    def update(self, seen: Charge) -> None:
        """Take the current state."""
        if seen.level >= self._enough or seen.status == FULL:
            self.urgent = False
        elif seen.level < self._low:
            self.urgent = True


class Sighting(NamedTuple):
    """Position of a marker.

    :ivar distance: metres
    :ivar bearing: radians from straight ahead, to the left
    """

    distance: float
    bearing: float


def parse_marker(text: Any, number: int) -> Sighting | None:
    """Find a marker in a message of the service ``markers``.

    :param text: ``data`` of ``markers/seen``
    :param number: the marker's
    :returns: ``None`` when it is not seen or the data is invalid
    """
    try:
        for each in json.loads(text)["markers"]:
            if each["id"] == number:
                found = Sighting(float(each["distance"]), float(each["bearing"]))
                return found if all(map(math.isfinite, found)) and found.distance > 0.0 else None
    except (ValueError, TypeError, KeyError):
        pass
    return None


def clearance_ahead(message: dict[str, Any]) -> float | None:
    """Metres to the nearest obstacle ahead, infinite when there is none.

    :param message: ``sensor_msgs/LaserScan`` of a scanner that looks ahead, in the middle of the robot
    :returns: ``None`` when the scan is invalid or no ray has a measurement
    """
    try:
        ranges, begin, step = (
            message["ranges"],
            float(message["angle_min"]),
            float(message["angle_increment"]),
        )
        nearest, measured = math.inf, False
        for number, distance in enumerate(ranges):
            # JSON has null for infinity and NaN.
            if distance is None or not distance > 0.0:
                continue
            measured = True
            angle = math.remainder(begin + number * step, math.tau)
            if abs(angle) <= FRONT and abs(distance * math.sin(angle)) <= HALF_WIDTH:
                nearest = min(nearest, distance * math.cos(angle))
    except (TypeError, KeyError, ValueError):
        return None
    return nearest if measured else None


class Approach(NamedTuple):
    """Drives towards a marker.

    :ivar distance: from the marker at the goal, metres
    :ivar speed: maximum, m/s
    :ivar turn: maximum, rad/s
    """

    distance: float
    speed: float
    turn: float

    def arrived(self, seen: Sighting) -> bool:
        """Whether the goal is reached."""
        return seen.distance <= self.distance

    def command(self, seen: Sighting) -> VelocityCommand:
        """The command towards the marker."""
        if self.arrived(seen):
            return ZERO_VELOCITY
        turn = max(-self.turn, min(self.turn, TURN_GAIN * seen.bearing))
        if abs(seen.bearing) > TURN_FIRST_ANGLE:
            return VelocityCommand(0.0, turn)
        speed = max(MIN_SPEED, SPEED_GAIN * (seen.distance - self.distance))
        return VelocityCommand(min(self.speed, speed), turn)


NAME = "recharge"
POLL_SECONDS = COMMAND_SECONDS = 0.05
"""Interval of commands."""

SEEKING_TURN = 0.4
"""Maximum turn rate of the search, rad/s."""
SLOWEST_TURN = 0.05  # what is counted with where a robot is allowed less
SEARCH_ANGLE = 1.5 * math.tau
"""Radians turned before the search fails."""

SIGHTING_SECONDS = 0.3
"""Seconds for which a sighting is used. With slow images the robot moves step by step."""
RELEASE_SECONDS = 0.7
"""Seconds without a command that count as a release (SPEC 2.5: half a second)."""
SCAN_TIMEOUT = 0.5
"""Seconds without a scan after which it stops."""
CONFIRM_SECONDS = 1.0
"""Seconds within which a marker must be seen in two images. After the first the robot waits."""
MARKER_LOST_SECONDS = 3.0
"""Seconds without a sighting after which the search starts again."""
BACK_OFF_SECONDS = 5.0
"""Seconds to wait after another client held or requested control, or the robot was stopped."""
RETRY_SECONDS = 60.0
"""Seconds from a failure to the next attempt."""
BLOCKED_SECONDS = 30.0
"""Seconds to wait for an obstacle to go."""


class RechargePhase(enum.Enum):
    """What the program does."""

    WATCHING = "watching"
    WAITING = "waiting"
    SEEKING = "seeking"
    DRIVING = "driving"
    DOCKED = "docked"


class Recharge:
    """Watches the battery, searches the charger, and drives there.

    :param topics: of battery, markers and scanner
    :param command: topic of the commands
    :param marker: number of the charger's marker
    :param need: decides when to charge
    :param approach: how to drive to the marker; the robot's own limits apply too
    :param clear: stop for obstacles ahead that are nearer, metres
    :param report: takes the state, and details that change all the time
    :param clock: seconds, including suspends
    """

    def __init__(
        self,
        topics: DockingTopics,
        command: str,
        marker: int,
        need: ChargeNeed,
        approach: Approach,
        clear: float,
        report: Callable[[str, str], None],
        clock: Callable[[], float] = seconds_since_boot,
    ) -> None:
        self._topics = topics
        self._command = command
        self._marker = marker
        self._need = need
        self._approach = approach
        self._clear = clear
        self._report = report
        self._clock = clock
        self._driver: Driver
        self._stop = StopRequest()
        self._reset()
        self._do = {
            RechargePhase.WATCHING: self._watch,
            RechargePhase.WAITING: self._wait,
            RechargePhase.SEEKING: self._seek,
            RechargePhase.DRIVING: self._drive_to_charger,
            RechargePhase.DOCKED: self._stay_docked,
        }

    def _reset(self) -> None:
        """Forget all state."""
        self.phase = RechargePhase.WATCHING
        self._charge: Charge | None = None
        self._seen: Sighting | None = None
        self._seen_at = self._first_seen_at = self._scanned_at = self._sent = -math.inf
        self._ahead: float | None = None
        self._not_before = -math.inf
        self._since = 0.0
        """Start of the phase, or of the wait in it."""
        self._side = 1.0
        self._failed = ""
        """Why the last attempt failed; empty after the next one begins."""

    def begin(self, connection: RosbridgeConnection) -> None:
        """A connection was made; start again."""
        self._reset()
        self._driver = Driver(connection, self._command, NAME, self._clock, self._stop, self._on_topic)
        for topic, kind in self._topics.with_types():
            connection.send(op="subscribe", topic=topic, type=kind, queue_length=1)
        self._report("waiting for the battery state", "")

    def step(self) -> bool:
        """Receive one message, and act on it."""
        self._driver.poll(POLL_SECONDS)
        now = self._clock()
        if self.phase in (RechargePhase.SEEKING, RechargePhase.DRIVING):
            why_not = self._why_not(now) or ("" if self._driver.in_control else "control is lost")
            if why_not or not self._wanted():
                self._release(now, why_not or "the battery needs no charging any more")
            elif self._driver.refusal:
                self._pause(now)
        self._do[self.phase](now)
        return True

    def leave(self) -> None:
        """Stop the robot and release control."""
        self._driver.release_control()

    def lost(self, why: str, seconds: float) -> None:
        """Report it. The robot stops by itself."""
        self._report(f"{why}; again in {seconds:.1f} s", "")

    def _on_topic(self, topic: str, message: dict[str, Any]) -> None:
        now = self._clock()
        if topic == self._topics.battery:
            self._charge = parse_battery(message)
            if self._charge is not None:
                self._need.update(self._charge)
        elif topic == self._topics.markers:
            if (seen := parse_marker(message.get("data"), self._marker)) is not None:
                # A single sighting may be a false detection.
                if now - self._first_seen_at <= CONFIRM_SECONDS:
                    self._seen, self._seen_at = seen, now
                self._first_seen_at = now
        elif topic == self._topics.scan:
            self._ahead = clearance_ahead(message)
            if self._ahead is not None:
                self._scanned_at = now

    def _wanted(self) -> bool:
        return self._need.urgent and self._charge is not None and not self._charge.charging

    def _why_not(self, now: float) -> str:
        """Why the robot must not be driven now; empty when it may."""
        driver = self._driver
        others = driver.blocked_by or (driver.requested_by and f"{driver.requested_by} asks for control")
        if others:
            self._not_before, self._failed = max(self._not_before, now + BACK_OFF_SECONDS), ""
            return others
        if driver.suppressed:
            return "another program suppresses its commands"
        if driver.unresponsive:
            return "the robot does not answer"
        if now - self._scanned_at > SCAN_TIMEOUT:
            why = driver.refusal or "obstacles would not be seen"
            return f"nothing is received on {self._topics.scan}: {why}"
        return ""

    def _release(self, now: float, why: str) -> None:
        """Stop, release control, and wait."""
        self._driver.release_control()
        self._enter(RechargePhase.WAITING, now)
        self._report(f"control released: {why}", "")

    def _pause(self, now: float) -> None:
        """A command was refused: pause, so that it counts as a release."""
        self._report(f"refused: {self._driver.refusal}", "")
        self._driver.refusal = ""
        self._driver.halt()
        self._sent = now + RELEASE_SECONDS

    def _fail(self, now: float, why: str) -> None:
        self._failed, self._not_before = why, now + RETRY_SECONDS
        self._release(now, f"{why}; again in {RETRY_SECONDS:.0f} s")

    def _enter(self, phase: RechargePhase, now: float) -> None:
        self.phase, self._since = phase, now

    def _percent(self) -> str:
        return "battery" if self._charge is None else f"battery {self._charge.level * 100:.0f} %"

    def _watch(self, now: float) -> None:
        if self._wanted():
            self._enter(RechargePhase.WAITING, now)
        elif self._charge is not None:
            self._report("charging" if self._charge.charging else "watching the battery", self._percent())
        elif self._driver.refusal:
            self._report(f"refused: {self._driver.refusal}", "")

    def _wait(self, now: float) -> None:
        driver = self._driver
        if not self._wanted():
            self._enter(RechargePhase.WATCHING, now)
            return
        why_not = self._why_not(now)
        if driver.in_control and not why_not and now >= self._not_before:
            # After a lost connection the commands must pause first (SPEC 2.5).
            driver.drive(ZERO_VELOCITY)
            self._sent = now + RELEASE_SECONDS
            self._enter(RechargePhase.SEEKING, now)
            self._report(f"looking for marker {self._marker}", self._percent())
            return
        if not why_not and driver.refusal and not driver.in_control:
            # Another client took control at the same time; withdraw the request.
            self._failed, driver.refusal = driver.refusal, ""
            driver.withdraw_request()
            self._not_before = now + BACK_OFF_SECONDS
        if driver.in_control or why_not or now < self._not_before:
            why = why_not or self._failed or "another client used the robot recently"
            self._report(f"battery low, waiting: {why}", self._percent())
            driver.release_control()
        else:
            self._failed = ""
            driver.request_control()

    def _seek(self, now: float) -> None:
        turn = min(SEEKING_TURN, self._approach.turn, self._driver.limits.turn)
        if now - self._seen_at <= SIGHTING_SECONDS:
            self._enter(RechargePhase.DRIVING, now)
            self._report(f"driving to marker {self._marker}", self._percent())
        elif now - self._since > SEARCH_ANGLE / max(turn, SLOWEST_TURN):
            self._fail(now, f"marker {self._marker} was not found")
        elif now - self._first_seen_at <= CONFIRM_SECONDS:
            self._driver.halt()
        else:
            self._drive(VelocityCommand(0.0, self._side * turn), now)

    def _drive_to_charger(self, now: float) -> None:
        assert self._seen is not None
        missing = now - self._seen_at
        if missing > MARKER_LOST_SECONDS:
            self._side = math.copysign(1.0, self._seen.bearing)
            self._enter(RechargePhase.SEEKING, now)
            self._report(f"marker {self._marker} is lost: looking for it", self._percent())
        elif missing > SIGHTING_SECONDS:
            self._driver.halt()
        elif self._approach.arrived(self._seen):
            self._driver.release_control()
            self._enter(RechargePhase.DOCKED, now)
        elif self._ahead is not None and self._ahead < self._clear:
            self._stand_before(now)
        else:
            self._since = now
            self._report(f"driving to marker {self._marker}", f"{self._seen.distance:.2f} m")
            self._drive(self._approach.command(self._seen), now)

    def _stand_before(self, now: float) -> None:
        self._driver.halt()
        self._report("stopped: obstacle ahead", f"{self._ahead:.2f} m")
        if now - self._since > BLOCKED_SECONDS:
            self._fail(now, "an obstacle is ahead")

    def _stay_docked(self, now: float) -> None:
        if not self._need.urgent:
            self._enter(RechargePhase.WATCHING, now)
        elif self._charge is not None and self._charge.charging:
            self._since = now
            self._report("charging", self._percent())
        elif self._charge is not None and self._charge.status == UNKNOWN:
            self._report(f"stands at marker {self._marker}", self._percent())
        else:
            self._report(
                f"stands at marker {self._marker}, and the battery does not charge yet", self._percent()
            )
            if now - self._since > RETRY_SECONDS:
                self._enter(RechargePhase.WAITING, now)

    def _drive(self, command: VelocityCommand, now: float) -> None:
        if now - self._sent >= COMMAND_SECONDS:
            self._sent = now
            self._driver.drive(command)


@click.command(cls=OutputCommand, context_settings={"help_option_names": ["-h", "--help"]})
@driving
@click.option("--battery", default="/battery_state", show_default=True, metavar="TOPIC")
@click.option(
    "--markers",
    default="/markers/seen",
    show_default=True,
    metavar="TOPIC",
    help="Topic of the service 'markers'.",
)
@click.option("--scan", default="/scan", show_default=True, metavar="TOPIC", help="Topic of the scanner.")
@click.option(
    "--marker", type=click.IntRange(0), default=7, show_default=True, help="Number of the charger's marker."
)
@click.option(
    "--low",
    type=Number(0, 100),
    default=20.0,
    show_default=True,
    metavar="PERCENT",
    help="Charge below which it drives to the charger.",
)
@click.option(
    "--enough",
    type=Number(0, 100),
    default=80.0,
    show_default=True,
    metavar="PERCENT",
    help="Charge from which the battery counts as charged.",
)
@click.option(
    "--distance",
    type=Number(0.1, 10),
    default=0.45,
    show_default=True,
    metavar="M",
    help="Distance of camera and marker at the charger.",
)
@click.option(
    "--clear",
    type=Number(0.05, 10),
    default=0.3,
    show_default=True,
    metavar="M",
    help="Stop for obstacles nearer to the scanner.",
)
def main(
    url: str,
    topic: str,
    speed: float,
    turn: float,
    battery: str,
    markers: str,
    scan: str,
    marker: int,
    low: float,
    enough: float,
    distance: float,
    clear: float,
) -> None:
    """Drive the robot at URL (ws://relay/robots/NAME) to its charger when its battery is low.

    Camera and scanner must point ahead from the middle of the robot, and the service 'markers' must run. The access
    token is read from SWITCHBOARD_TOKEN. SIGINT and SIGTERM end the program.

    \b
    Examples:
      ROBOT=ws://127.0.0.1:9090/robots/robot-one
      python -m robot_client.apps.recharge $ROBOT --low 99 --enough 99.5 --speed 0.2
    """
    if enough <= low:
        raise click.BadParameter(f"--enough ({enough:g}) must be more than --low ({low:g})")
    if clear >= distance:
        raise click.BadParameter(f"--clear ({clear:g}) must be less than --distance ({distance:g})")
    access_token()
    exit_signal = ExitSignal()
    status = StatusLine(sys.stdout, time.monotonic)
    program = Recharge(
        DockingTopics(battery, markers, scan),
        topic,
        marker,
        ChargeNeed(low / 100, enough / 100),
        Approach(distance, speed, turn),
        clear,
        status.show,
    )
    with errors_as_click():
        run_connected(url, program, exit_signal)
    status.finish("ended")


if __name__ == "__main__":
    main()
