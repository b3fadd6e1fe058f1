"""Keeps a robot away from what is in its way, whoever drives it: ``python -m robot_client.apps.runaway``.

A program beside the driver, who goes on driving: it reads the scanner, and where something ahead comes near it
suppresses the driver's commands, turns the robot away, moves it off, and gives it back. Nothing of that is in the
driver's program. It is the behaviour *runaway* of R. Brooks's subsumption architecture, by suppression of an input as
SOM4R has it.

Each ray pushes the robot away from what it met, with the inverse square of the distance; the sum is the force. It takes
the right to subscribe to the scanner's topic, and to suppress that of the commands.
"""

from __future__ import annotations

import contextlib
import enum
import math
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import click

from robot_client.apps.driver import STILL, Command, twist
from robot_client.apps.line import Line, Refused, connected, end_by_signal, in_words

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
FACING = math.cos(math.radians(60))
"""Of the angle between heading and force from which the robot moves off."""


class Scan(NamedTuple):
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


class Manners(NamedTuple):
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


def repulsion(scan: Scan) -> Force:
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


class Phase(enum.Enum):
    """What it does."""

    WATCHING = "watching"
    TURNING = "turning"
    LEAVING = "leaving"


class Runaway:
    """Decides; pure."""

    def __init__(self, manners: Manners) -> None:
        self.phase = Phase.WATCHING
        self._manners = manners
        self._near = FLAT / manners.near**2
        self._clear = FLAT / manners.clear**2
        self._side = 1.0

    def see(self, scan: Scan) -> Command | None:
        """What the robot is to do now; ``None`` to leave it to its driver."""
        force = repulsion(scan)
        if self.phase is Phase.WATCHING and force.strength > self._near and force.ahead < 0:
            self.phase = Phase.TURNING
            # To one side all the way: straight before a wall noise alone says which is nearer.
            self._side = math.copysign(1.0, force.left)
        elif self.phase is not Phase.WATCHING and force.strength < self._clear:
            self.phase = Phase.WATCHING
        if self.phase is Phase.TURNING and force.ahead >= FACING * force.strength:
            self.phase = Phase.LEAVING
        elif self.phase is Phase.LEAVING and force.ahead < 0:
            self.phase = Phase.TURNING
        return self._command()

    def rest(self) -> None:
        """Leave the robot to its driver, whatever was under way."""
        self.phase = Phase.WATCHING

    def _command(self) -> Command | None:
        if self.phase is Phase.WATCHING:
            return None
        if self.phase is Phase.TURNING:
            return Command(0.0, self._side * self._manners.turn)
        return Command(self._manners.speed, 0.0)


class Link:
    """What it says to the relay, and what it hears.

    :param line: to the robot
    :param scan: topic of the scanner
    :param command: topic of the commands
    """

    def __init__(self, line: Line, scan: str, command: str) -> None:
        self._line = line
        self._command = command
        self._waiting = ""
        self.has_it = False
        """Whether the relay has said that the robot obeys this program."""
        line.say(op="set_level", level="error")
        line.say(op="advertise", topic=command, type="geometry_msgs/msg/Twist")
        line.say(op="subscribe", topic=scan, type="sensor_msgs/msg/LaserScan", queue_length=1)

    def scan(self, seconds: float) -> Scan | None:
        """The next scan that comes within this time.

        :raises Refused: the relay says that it must not do what it does
        """
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            message = self._line.hear(left)
            if message is None:
                return None
            if message["op"] == "service_response":
                self._answered(message)
            elif message["op"] == "status" and not self.has_it:
                raise Refused(message["msg"])
            elif message["op"] == "publish":
                seen = message["msg"]
                return Scan(seen["ranges"], seen["angle_min"], seen["angle_increment"])
        return None

    def suppress(self) -> None:
        """Have the robot obey this program alone, for a moment; again to go on."""
        self._waiting = self._ask(SUPPRESS_MS)

    def drive(self, command: Command) -> None:
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
        return self._line.call("/relay/suppress", resource=self._command, ms=ms)

    def _answered(self, message: dict[str, Any]) -> None:
        if not message["result"]:
            raise Refused(str(message["values"]))
        if message["id"] == self._waiting:
            self.has_it = bool(message["values"]["success"])


class Program:
    """Sees, decides, drives."""

    def __init__(self, link: Link, runaway: Runaway, clock: Any = time.monotonic) -> None:
        self._link = link
        self._runaway = runaway
        self._clock = clock
        self._wanted: Command | None = None
        self._seen = self._asked = clock()

    def step(self) -> None:
        """Take what comes within a moment, and act on it."""
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

    def _follow(self, wanted: Command | None) -> None:
        if wanted is None and self._wanted is not None:
            click.echo("clear: given back")
            self._link.give_back()
        elif wanted is not None and self._wanted is None:
            click.echo("too near: turning away")
            self._asked = -math.inf
        self._wanted = wanted

    def stop(self) -> None:
        """Let go of what it has."""
        self._follow(None)


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.argument("url")
@click.option("--scan", default="/scan", show_default=True, help="Topic of the scanner.")
@click.option("--command", default="/cmd_vel", show_default=True, help="Topic of the commands.")
@click.option(
    "--near", type=click.FloatRange(0.1, 1.4), default=Manners().near, show_default=True, metavar="M"
)
@click.option(
    "--clear", type=click.FloatRange(0.1, 1.5), default=Manners().clear, show_default=True, metavar="M"
)
def main(url: str, scan: str, command: str, near: float, clear: float) -> None:
    """Keep the robot at URL (ws://relay/robots/NAME) away from what is in its way.

    The token comes from the variable SWITCHBOARD_TOKEN. Prints READY when it watches. SIGINT and SIGTERM end it.
    """
    if clear <= near:
        raise click.BadParameter(f"--clear ({clear:g}) must be more than --near ({near:g})")
    runaway = Runaway(Manners(near=near, clear=clear))
    end_by_signal()
    with in_words(), connected(url) as line:
        program = Program(Link(line, scan, command), runaway)
        with contextlib.ExitStack() as leaving:
            leaving.callback(program.stop)
            click.echo("READY")
            while True:
                program.step()


if __name__ == "__main__":
    main()
