"""Keeps a robot away from what is in its way, whoever drives it: ``python -m robot_client.apps.collision_avoidance``.

A program beside the driver, who goes on driving: it reads the scanner, and where something ahead comes near it
suppresses the driver's commands, turns the robot away, moves it off, and gives it back. Nothing of that is in the
driver's program. It is the behaviour *runaway* of R. Brooks's subsumption architecture, by suppression of an input as
SOM4R has it.

Each ray pushes the robot away from what it met, with the inverse square of the distance; the sum is the force. It takes
the right to subscribe to the scanner's topic, and to suppress that of the commands.
"""

from __future__ import annotations

import enum
import math
import sys
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import click

from robot_client.apps.clock import now as since_start
from robot_client.apps.connection import LivenessCheck, Refused, RosbridgeConnection, in_words, token
from robot_client.apps.driver import SILENT, STILL, VelocityCommand, twist
from robot_client.apps.reconnect import Ending, run_connected
from robot_client.apps.status_line import StatusLine
from robot_client.numbers import Number

REACH = 1.5
"""Metres beyond which nothing pushes."""
NEAREST = 0.05
"""Metres; what seems nearer pushes no harder."""
FLAT = 4 / 3
"""The force of a flat wall at one metre: the integral of the cube of the cosine over half a circle."""
BLIND = 0.5
"""Seconds without a scan after which it lets go: it does not move what it can't see."""
RENEW = 0.1
"""Seconds between two suppressions, at most."""
SUPPRESS_MS = 200
SCANS, COMMANDS = "scans", "commands"
"""By these the relay names what it refuses. Of a command alone, as to a robot that is away, it may be done again."""
BEAT = 1.0
"""Seconds from one question to the relay to the next."""
FACING = math.cos(math.radians(60))
"""Of the angle between heading and force from which the robot moves off."""


class ScanReading(NamedTuple):
    """One turn of the scanner.

    :ivar ranges: metres by ray; what is no finite number met nothing
    :ivar begin: radians of the first ray from straight ahead, counter-clockwise
    :ivar step: radians from one ray to the next
    """

    ranges: Sequence[float | None]
    begin: float
    step: float


class Force(NamedTuple):
    """What pushes the robot, ahead and to the left."""

    ahead: float
    left: float

    @property
    def strength(self) -> float:
        """How hard, however it points."""
        return math.hypot(self.ahead, self.left)


class AvoidanceConfig(NamedTuple):
    """How it behaves.

    :ivar near: metres from a flat wall ahead at which it takes over
    :ivar clear: metres from a flat wall at which it gives the robot back
    :ivar speed: metres per second at which it moves off
    :ivar turn: radians per second at which it turns away
    """

    near: float = 0.5
    clear: float = 0.55
    speed: float = 0.2
    turn: float = 1.2


def repulsion(scan: ScanReading) -> Force:
    """The sum of what all rays push."""
    ahead = left = 0.0
    for number, distance in enumerate(scan.ranges):
        if distance is None or not 0.0 < distance < REACH:  # NaN is not in between either
            continue
        angle = scan.begin + number * scan.step
        push = scan.step / max(distance, NEAREST) ** 2
        ahead -= push * math.cos(angle)
        left -= push * math.sin(angle)
    return Force(ahead, left)


class AvoidancePhase(enum.Enum):
    """What it does."""

    WATCHING = "watching"
    TURNING = "turning"
    LEAVING = "leaving"


class CollisionAvoidance:
    """Decides; pure."""

    def __init__(self, manners: AvoidanceConfig) -> None:
        self.phase = AvoidancePhase.WATCHING
        self._manners = manners
        self._near = FLAT / manners.near**2
        self._clear = FLAT / manners.clear**2
        self._side = 1.0

    def see(self, scan: ScanReading) -> VelocityCommand | None:
        """What the robot is to do now; ``None`` to leave it to its driver."""
        force = repulsion(scan)
        if self.phase is AvoidancePhase.WATCHING and force.strength > self._near and force.ahead < 0:
            self.phase = AvoidancePhase.TURNING
            # To one side all the way: straight before a wall noise alone says which is nearer.
            self._side = math.copysign(1.0, force.left)
        elif self.phase is not AvoidancePhase.WATCHING and force.strength < self._clear:
            self.phase = AvoidancePhase.WATCHING
        if self.phase is AvoidancePhase.TURNING and force.ahead >= FACING * force.strength:
            self.phase = AvoidancePhase.LEAVING
        elif self.phase is AvoidancePhase.LEAVING and force.ahead < 0:
            self.phase = AvoidancePhase.TURNING
        return self._command()

    def rest(self) -> None:
        """Leave the robot to its driver, whatever was under way."""
        self.phase = AvoidancePhase.WATCHING

    def _command(self) -> VelocityCommand | None:
        if self.phase is AvoidancePhase.WATCHING:
            return None
        if self.phase is AvoidancePhase.TURNING:
            return VelocityCommand(0.0, self._side * self._manners.turn)
        return VelocityCommand(self._manners.speed, 0.0)


class AvoidanceLink:
    """What it says to the relay, and what it hears.

    :param line: to the robot
    :param scan: topic of the scanner
    :param command: topic of the commands
    :param clock: seconds, suspends included
    """

    def __init__(
        self, line: RosbridgeConnection, scan: str, command: str, clock: Callable[[], float] = since_start
    ) -> None:
        self._line = line
        self._pulse = LivenessCheck(line, clock, BEAT, SILENT)
        self._clock = clock
        self._command = command
        self._asked: set[str] = set()
        self._waiting = ""
        self.has_it = False
        """Whether the relay has said that the robot obeys this program."""
        line.say(op="set_level", level="error")
        line.say(op="advertise", id=COMMANDS, topic=command, type="geometry_msgs/msg/Twist")
        line.say(op="subscribe", id=SCANS, topic=scan, type="sensor_msgs/msg/LaserScan", queue_length=1)

    def scan(self, seconds: float) -> ScanReading | None:
        """The next scan that comes within this time.

        :raises Lost: the relay has not answered for long
        :raises Refused: the relay says that it must not do what it does
        """
        end = self._clock() + seconds
        while (left := end - self._clock()) > 0:
            message = self._pulse.hear(left)
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
        """Have the robot obey this program alone, for a moment; again to go on."""
        self._waiting = self._ask(SUPPRESS_MS)

    def drive(self, command: VelocityCommand) -> None:
        """One command, once the robot obeys."""
        if self.has_it:
            self._line.say(op="publish", topic=self._command, msg=twist(command))

    def give_back(self) -> None:
        """Let go of the robot, which its driver moves again."""
        self.drive(STILL)
        self.has_it = False
        self._waiting = ""
        self._ask(0)

    def _ask(self, ms: int) -> str:
        number = self._line.call("/relay/suppress", resource=self._command, ms=ms)
        self._asked.add(number)
        return number

    def _answered(self, message: dict[str, Any]) -> None:
        number = message["id"]
        if number not in self._asked:
            return  # of a question whether anybody is there
        self._asked.discard(number)
        if not message["result"]:
            raise Refused(str(message["values"]))
        if number == self._waiting:
            self.has_it = bool(message["values"]["success"])


class AvoidanceProgram:
    """Sees, decides, drives.

    :param scan: topic of the scanner
    :param command: topic of the commands
    :param tell: takes what happens, in a few words
    :param clock: seconds, suspends included
    """

    def __init__(
        self,
        scan: str,
        command: str,
        runaway: CollisionAvoidance,
        tell: Callable[[str], None],
        clock: Callable[[], float] = since_start,
    ) -> None:
        self._scan = scan
        self._command = command
        self._runaway = runaway
        self._tell = tell
        self._clock = clock
        self._link: AvoidanceLink
        self._wanted: VelocityCommand | None = None
        self._seen = self._asked = clock()

    def begin(self, line: RosbridgeConnection) -> None:
        """There is a line. Nothing of what was seen by another counts."""
        self._link = AvoidanceLink(line, self._scan, self._command, self._clock)
        self._runaway.rest()
        self._wanted = None
        self._seen = self._clock()
        self._tell("READY")

    def step(self) -> bool:
        """Take what comes within a moment, and act on it.

        :raises robot_client.apps.connection.Lost: the relay has not answered for long
        :raises robot_client.apps.connection.Refused: the relay says no, and will until a person has done something
        """
        scan = self._link.scan(RENEW / 2)
        now = self._clock()
        if scan is not None:
            self._seen = now
            self._follow(self._runaway.see(scan))
        elif now - self._seen > BLIND:
            self._runaway.rest()
            self._follow(None)
        if self._wanted is not None:
            if now - self._asked >= RENEW:
                self._asked = now
                self._link.suppress()
            self._link.drive(self._wanted)
        return True

    def leave(self) -> None:
        """Let go of the robot, if it has it."""
        self._follow(None)

    def lost(self, why: str, seconds: float) -> None:
        """Say so. The robot was its driver's again within a moment."""
        self._tell(f"{why}; again in {seconds:.1f} s")

    def _follow(self, wanted: VelocityCommand | None) -> None:
        if wanted is None and self._wanted is not None:
            # Before it is said: the line may break in saying it.
            self._wanted = None
            self._tell("clear: given back")
            self._link.give_back()
        elif wanted is not None and self._wanted is None:
            self._tell("too near: turning away")
            self._asked = -math.inf
        self._wanted = wanted


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.argument("url")
@click.option("--scan", default="/scan", show_default=True, help="Topic of the scanner.")
@click.option("--command", default="/cmd_vel", show_default=True, help="Topic of the commands.")
@click.option("--near", type=Number(0.1, 1.4), default=AvoidanceConfig().near, show_default=True, metavar="M")
@click.option(
    "--clear", type=Number(0.1, 1.5), default=AvoidanceConfig().clear, show_default=True, metavar="M"
)
def main(url: str, scan: str, command: str, near: float, clear: float) -> None:
    """Keep the robot at URL (ws://relay/robots/NAME) away from what is in its way.

    The token comes from the variable SWITCHBOARD_TOKEN. Prints READY when it watches, and connects anew when the
    connection is lost. SIGINT and SIGTERM end it.

    \b
    Examples:
      ROBOT=ws://127.0.0.1:9090/robots/robot-one
      python -m robot_client.apps.collision_avoidance $ROBOT
      python -m robot_client.apps.collision_avoidance $ROBOT --near 0.6 --clear 0.7
    """
    if clear <= near:
        raise click.BadParameter(f"--clear ({clear:g}) must be more than --near ({near:g})")
    token()
    ending = Ending()
    status = StatusLine(sys.stdout, since_start)
    program = AvoidanceProgram(
        scan, command, CollisionAvoidance(AvoidanceConfig(near=near, clear=clear)), status.tell
    )
    with in_words():
        run_connected(url, program, ending)
    status.end("ended")


if __name__ == "__main__":
    main()
