"""Keeps a robot away from obstacles while others drive it: ``python -m robot_client.apps.collision_avoidance``.

It reads the scanner. When an obstacle ahead is near, it suppresses the driver's commands, turns the robot away, moves
it off, and ends the suppression. The driver's program is not involved. This is the behaviour *runaway* of R. Brooks's
subsumption architecture, by suppression of an input as in SOM4R.

Each ray exerts a repulsive force, with the inverse square of the distance; the sum decides. The program needs the
rights to subscribe to the scanner's topic, and to suppress the topic of the commands.
"""

from __future__ import annotations

import enum
import math
import sys
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import click

from relay_protocol.clocks import now as seconds_since_boot
from relay_protocol.command_output import OutputCommand
from robot_client.apps.connection import (
    LivenessMonitor,
    Refused,
    RosbridgeConnection,
    access_token,
    errors_as_click,
)
from robot_client.apps.driver import LOST_SECONDS, ZERO_VELOCITY, VelocityCommand, twist
from robot_client.apps.program import ExitSignal, StatusLine, run_connected
from robot_client.command_line import Number

RANGE = 1.5
"""Metres; farther obstacles exert no force."""
MIN_DISTANCE = 0.05
"""Metres; nearer obstacles exert the force of this distance."""
WALL_FORCE = 4 / 3
"""The force of a flat wall at one metre: the integral of the cube of the cosine over half a circle."""
SCAN_TIMEOUT = 0.5
"""Seconds without a scan after which the suppression ends."""
RENEWAL_SECONDS = 0.1
"""Seconds between two suppressions."""
SUPPRESS_MS = 200
SCANS, COMMANDS = "scans", "commands"
"""Ids by which the relay reports refusals."""
PING_SECONDS = 1.0
"""Interval of pings to the relay."""
FACING_AWAY = math.cos(math.radians(60))
"""Cosine of the angle between heading and force at which the robot moves off."""


class ScanReading(NamedTuple):
    """One laser scan.

    :ivar ranges: metres by ray; a value that is not finite means no obstacle
    :ivar begin: radians of the first ray from straight ahead, counter-clockwise
    :ivar step: radians from one ray to the next
    """

    ranges: Sequence[float | None]
    begin: float
    step: float


class Force(NamedTuple):
    """Repulsive force, ahead and to the left."""

    ahead: float
    left: float

    @property
    def strength(self) -> float:
        """Magnitude."""
        return math.hypot(self.ahead, self.left)


class AvoidanceConfig(NamedTuple):
    """Settings.

    :ivar near: metres from a flat wall ahead at which avoidance begins
    :ivar clear: metres from a flat wall at which avoidance ends
    :ivar speed: metres per second at which it moves off
    :ivar turn: radians per second at which it turns away
    """

    near: float = 0.5
    clear: float = 0.55
    speed: float = 0.2
    turn: float = 1.2


def repulsion(scan: ScanReading) -> Force:
    """The sum of the forces of all rays."""
    ahead = left = 0.0
    for number, distance in enumerate(scan.ranges):
        if distance is None or not 0.0 < distance < RANGE:  # NaN is not in between either
            continue
        angle = scan.begin + number * scan.step
        push = scan.step / max(distance, MIN_DISTANCE) ** 2
        ahead -= push * math.cos(angle)
        left -= push * math.sin(angle)
    return Force(ahead, left)


class AvoidancePhase(enum.Enum):
    """What the avoidance does."""

    WATCHING = "watching"
    TURNING = "turning"
    LEAVING = "leaving"


class CollisionAvoidance:
    """Decides the motion from scans."""

    def __init__(self, config: AvoidanceConfig) -> None:
        self.phase = AvoidancePhase.WATCHING
        self._config = config
        self._near = WALL_FORCE / config.near**2
        self._clear = WALL_FORCE / config.clear**2
        self._side = 1.0

    def update(self, scan: ScanReading) -> VelocityCommand | None:
        """The command for the robot; ``None`` to leave it to its driver."""
        force = repulsion(scan)
        if self.phase is AvoidancePhase.WATCHING and force.strength > self._near and force.ahead < 0:
            self.phase = AvoidancePhase.TURNING
            # To one side all the way: straight before a wall noise alone says which is nearer.
            self._side = math.copysign(1.0, force.left)
        elif self.phase is not AvoidancePhase.WATCHING and force.strength < self._clear:
            self.phase = AvoidancePhase.WATCHING
        if self.phase is AvoidancePhase.TURNING and force.ahead >= FACING_AWAY * force.strength:
            self.phase = AvoidancePhase.LEAVING
        elif self.phase is AvoidancePhase.LEAVING and force.ahead < 0:
            self.phase = AvoidancePhase.TURNING
        return self._command()

    def reset(self) -> None:
        """Leave the robot to its driver."""
        self.phase = AvoidancePhase.WATCHING

    def _command(self) -> VelocityCommand | None:
        if self.phase is AvoidancePhase.WATCHING:
            return None
        if self.phase is AvoidancePhase.TURNING:
            return VelocityCommand(0.0, self._side * self._config.turn)
        return VelocityCommand(self._config.speed, 0.0)


class AvoidanceLink:
    """Messages to and from the relay.

    :param connection: to the robot
    :param scan: topic of the scanner
    :param command: topic of the commands
    :param clock: seconds, including suspends
    """

    def __init__(
        self,
        connection: RosbridgeConnection,
        scan: str,
        command: str,
        clock: Callable[[], float] = seconds_since_boot,
    ) -> None:
        self._connection = connection
        self._liveness = LivenessMonitor(connection, clock, PING_SECONDS, LOST_SECONDS)
        self._clock = clock
        self._command = command
        self._asked: set[str] = set()
        self._waiting = ""
        self.in_command = False
        """Whether the relay has confirmed the suppression."""
        connection.send(op="set_level", level="error")
        connection.send(op="advertise", id=COMMANDS, topic=command, type="geometry_msgs/msg/Twist")
        connection.send(
            op="subscribe", id=SCANS, topic=scan, type="sensor_msgs/msg/LaserScan", queue_length=1
        )

    def scan(self, seconds: float) -> ScanReading | None:
        """The next scan, or ``None`` if none arrives within ``seconds``.

        :raises Lost: the relay has not answered for long
        :raises Refused: the relay refuses a scan subscription or a command
        """
        end = self._clock() + seconds
        while (left := end - self._clock()) > 0:
            message = self._liveness.receive(left)
            if message is None:
                return None
            if message["op"] == "service_response":
                self._answered(message)
            elif message["op"] == "status" and message.get("id") in (SCANS, COMMANDS):
                raise Refused(message["msg"])
            elif message["op"] == "publish":
                seen = message["msg"]
                return ScanReading(seen["ranges"], seen["angle_min"], seen["angle_increment"])
        return None

    def suppress(self) -> None:
        """Start or renew the suppression of other commands."""
        self._waiting = self._ask(SUPPRESS_MS)

    def drive(self, command: VelocityCommand) -> None:
        """Send a command, once the suppression is confirmed."""
        if self.in_command:
            self._connection.send(op="publish", topic=self._command, msg=twist(command))

    def release_control(self) -> None:
        """Stop, and end the suppression."""
        self.drive(ZERO_VELOCITY)
        self.in_command = False
        self._waiting = ""
        self._ask(0)

    def _ask(self, ms: int) -> str:
        number = self._connection.call("/relay/suppress", resource=self._command, ms=ms)
        self._asked.add(number)
        return number

    def _answered(self, message: dict[str, Any]) -> None:
        number = message["id"]
        if number not in self._asked:
            return  # the answer to a ping
        self._asked.discard(number)
        if not message["result"]:
            raise Refused(str(message["values"]))
        if number == self._waiting:
            self.in_command = bool(message["values"]["success"])


class AvoidanceProgram:
    """Reads scans, decides, and drives.

    :param scan: topic of the scanner
    :param command: topic of the commands
    :param report: takes a short text about every change
    :param clock: seconds, including suspends
    """

    def __init__(
        self,
        scan: str,
        command: str,
        avoidance: CollisionAvoidance,
        report: Callable[[str], None],
        clock: Callable[[], float] = seconds_since_boot,
    ) -> None:
        self._scan = scan
        self._command = command
        self._avoidance = avoidance
        self._report = report
        self._clock = clock
        self._link: AvoidanceLink
        self._wanted: VelocityCommand | None = None
        self._seen = self._asked = clock()

    def begin(self, connection: RosbridgeConnection) -> None:
        """A connection was made; earlier scans do not count."""
        self._link = AvoidanceLink(connection, self._scan, self._command, self._clock)
        self._avoidance.reset()
        self._wanted = None
        self._seen = self._clock()
        self._report("READY")

    def step(self) -> bool:
        """Receive one message, and act on it.

        :raises robot_client.apps.connection.Lost: the relay has not answered for long
        :raises robot_client.apps.connection.Refused: the relay refuses, and a retry does not help
        """
        scan = self._link.scan(RENEWAL_SECONDS / 2)
        now = self._clock()
        if scan is not None:
            self._seen = now
            self._follow(self._avoidance.update(scan))
        elif now - self._seen > SCAN_TIMEOUT:
            self._avoidance.reset()
            self._follow(None)
        if self._wanted is not None:
            if now - self._asked >= RENEWAL_SECONDS:
                self._asked = now
                self._link.suppress()
            self._link.drive(self._wanted)
        return True

    def leave(self) -> None:
        """End a suppression."""
        self._follow(None)

    def lost(self, why: str, seconds: float) -> None:
        """Report it. The suppression ends by itself."""
        self._report(f"{why}; again in {seconds:.1f} s")

    def _follow(self, wanted: VelocityCommand | None) -> None:
        if wanted is None and self._wanted is not None:
            # Set before sending, because the connection may break.
            self._wanted = None
            self._report("clear: suppression ended")
            self._link.release_control()
        elif wanted is not None and self._wanted is None:
            self._report("too near: turning away")
            self._asked = -math.inf
        self._wanted = wanted


@click.command(cls=OutputCommand, context_settings={"help_option_names": ["-h", "--help"]})
@click.argument("url")
@click.option("--scan", default="/scan", show_default=True, help="Topic of the scanner.")
@click.option("--command", default="/cmd_vel", show_default=True, help="Topic of the commands.")
@click.option("--near", type=Number(0.1, 1.4), default=AvoidanceConfig().near, show_default=True, metavar="M")
@click.option(
    "--clear", type=Number(0.1, 1.5), default=AvoidanceConfig().clear, show_default=True, metavar="M"
)
def main(url: str, scan: str, command: str, near: float, clear: float) -> None:
    """Keep the robot at URL (ws://relay/robots/NAME) away from obstacles.

    The access token is read from SWITCHBOARD_TOKEN. Prints READY when it watches, and reconnects when the connection
    is lost. SIGINT and SIGTERM end the program.

    \b
    Examples:
      ROBOT=ws://127.0.0.1:9090/robots/robot-one
      python -m robot_client.apps.collision_avoidance $ROBOT
      python -m robot_client.apps.collision_avoidance $ROBOT --near 0.6 --clear 0.7
    """
    if clear <= near:
        raise click.BadParameter(f"--clear ({clear:g}) must be more than --near ({near:g})")
    access_token()
    exit_signal = ExitSignal()
    status = StatusLine(sys.stdout, seconds_since_boot)
    program = AvoidanceProgram(
        scan, command, CollisionAvoidance(AvoidanceConfig(near=near, clear=clear)), status.show
    )
    with errors_as_click():
        run_connected(url, program, exit_signal)
    status.finish("ended")


if __name__ == "__main__":
    main()
