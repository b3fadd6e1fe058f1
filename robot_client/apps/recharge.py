"""Drives a robot whose battery is low to its charger: ``python -m robot_client.apps.recharge``.

It watches the battery. When that is low it takes control, turns until the service ``markers`` sees the charger's
marker, drives there, stands, and gives control back. It never takes control from anybody: while somebody has it, or
has stopped the robot, it waits; when somebody asks for it, it gives it at once. What is in the way, a marker that is
lost, a scanner that is silent, a robot that does not answer: it stands.
"""

from __future__ import annotations

import enum
import math
import sys
import time
from collections.abc import Callable
from typing import Any

import click

from robot_client.apps.clock import now as since_start
from robot_client.apps.connection import RosbridgeConnection, in_words, token
from robot_client.apps.docking import (
    UNKNOWN,
    Approach,
    Charge,
    DockingTopics,
    Need,
    Sighting,
    charge,
    sighting,
    way_ahead,
)
from robot_client.apps.driver import STILL, Driver, StopNotice, VelocityCommand
from robot_client.apps.options import driving
from robot_client.apps.reconnect import Ending, run_connected
from robot_client.apps.status_line import StatusLine
from robot_client.numbers import Number

NAME = "recharge"
LOOK = EVERY = 0.05
"""Seconds from one command to the next."""

SEEKING_TURN = 0.4
"""Radians per second at which it looks for the marker, at most."""
SLOWEST_TURN = 0.05  # what is counted with where a robot is allowed less
ROUND = 1.5 * math.tau
"""Radians that it turns before it says that the marker is not there."""

FRESH = 0.3
"""Seconds that it drives by a sighting: where pictures come slowly it goes step by step."""
SILENCE = 0.7
"""Seconds without a command by which it has let go (SPEC section 2.5: half a second)."""
BLIND = 0.5
"""Seconds without a scan after which it does not drive."""
GLIMPSE = 1.0
"""Seconds within which a marker must be seen in two pictures; when it was in one it stands until then."""
LOST = 3.0
"""Seconds without a sighting after which the marker is looked for again."""
CALM = 5.0
"""Seconds it leaves the robot alone after somebody else had it, had stopped it, or wanted it."""
AGAIN = 60.0
"""Seconds from a failure to the next attempt."""
PATIENCE = 30.0
"""Seconds that it waits before something in the way."""


class RechargePhase(enum.Enum):
    """What it does."""

    WATCHING = "watching"
    WAITING = "waiting"
    SEEKING = "seeking"
    GOING = "going"
    STAYING = "staying"


class Recharge:
    """Watches, seeks, drives.

    :param topics: of battery, markers and scanner
    :param command: topic of the commands
    :param marker: number of the charger's
    :param need: says when the battery is to be charged
    :param approach: how it drives there; its speeds within what the robot allows
    :param clear: metres to what is in the way ahead, nearer than which it stands
    :param tell: takes the state in a few words, and what changes all the time
    :param clock: seconds, suspends included
    """

    def __init__(
        self,
        topics: DockingTopics,
        command: str,
        marker: int,
        need: Need,
        approach: Approach,
        clear: float,
        tell: Callable[[str, str], None],
        clock: Callable[[], float] = since_start,
    ) -> None:
        self._topics = topics
        self._command = command
        self._marker = marker
        self._need = need
        self._approach = approach
        self._clear = clear
        self._tell = tell
        self._clock = clock
        self._driver: Driver
        self._stop = StopNotice()
        self._rest()
        self._do = {
            RechargePhase.WATCHING: self._watch,
            RechargePhase.WAITING: self._wait,
            RechargePhase.SEEKING: self._seek,
            RechargePhase.GOING: self._go,
            RechargePhase.STAYING: self._stay,
        }

    def _rest(self) -> None:
        """Nothing is known, and nothing under way."""
        self.phase = RechargePhase.WATCHING
        self._charge: Charge | None = None
        self._seen: Sighting | None = None
        self._seen_at = self._glimpsed_at = self._scanned_at = self._sent = -math.inf
        self._ahead: float | None = None
        self._not_before = -math.inf
        self._since = 0.0
        """When the phase began, or in it what is waited for."""
        self._side = 1.0
        self._failed = ""
        """Why the last attempt failed, until the next."""

    def begin(self, line: RosbridgeConnection) -> None:
        """There is a line. What was under way before is begun anew."""
        self._rest()
        self._driver = Driver(line, self._command, NAME, self._clock, self._stop, self._heard)
        for topic, kind in self._topics.kinds():
            line.say(op="subscribe", topic=topic, type=kind, queue_length=1)
        self._tell("waiting for what the battery tells", "")

    def step(self) -> bool:
        """Take what comes within a moment, and act on it."""
        self._driver.hear(LOOK)
        now = self._clock()
        if self.phase in (RechargePhase.SEEKING, RechargePhase.GOING):
            why_not = self._why_not(now) or ("" if self._driver.in_control else "control is lost")
            if why_not or not self._wanted():
                self._let_go(now, why_not or "the battery needs no charging any more")
            elif self._driver.said:
                self._pause(now)
        self._do[self.phase](now)
        return True

    def leave(self) -> None:
        """Stand still, and let others drive."""
        self._driver.give_back()

    def lost(self, why: str, seconds: float) -> None:
        """Say so; the robot stands by itself."""
        self._tell(f"{why}; again in {seconds:.1f} s", "")

    def _heard(self, topic: str, message: dict[str, Any]) -> None:
        now = self._clock()
        if topic == self._topics.battery:
            self._charge = charge(message)
            if self._charge is not None:
                self._need.see(self._charge)
        elif topic == self._topics.markers:
            if (seen := sighting(message.get("data"), self._marker)) is not None:
                # One alone may be something else that looks like it.
                if now - self._glimpsed_at <= GLIMPSE:
                    self._seen, self._seen_at = seen, now
                self._glimpsed_at = now
        elif topic == self._topics.scan:
            self._ahead = way_ahead(message)
            if self._ahead is not None:
                self._scanned_at = now

    def _wanted(self) -> bool:
        return self._need.urgent and self._charge is not None and not self._charge.fed

    def _why_not(self, now: float) -> str:
        """Why it must not drive now; empty when it may."""
        driver = self._driver
        others = driver.obstacle or (driver.wanted_by and f"{driver.wanted_by} asks for control")
        if others:
            self._not_before, self._failed = max(self._not_before, now + CALM), ""
            return others
        if driver.suppressed:
            return "another program suppresses its commands"
        if driver.late:
            return "the robot does not answer"
        if now - self._scanned_at > BLIND:
            why = driver.said or "it would not see what is in the way"
            return f"nothing comes on {self._topics.scan}: {why}"
        return ""

    def _let_go(self, now: float, why: str) -> None:
        """Stand, give control back, and wait."""
        self._driver.give_back()
        self._become(RechargePhase.WAITING, now)
        self._tell(f"control given back: {why}", "")

    def _pause(self, now: float) -> None:
        """A command was refused: let go, so that the next is obeyed."""
        self._tell(f"refused: {self._driver.said}", "")
        self._driver.said = ""
        self._driver.still()
        self._sent = now + SILENCE

    def _fail(self, now: float, why: str) -> None:
        self._failed, self._not_before = why, now + AGAIN
        self._let_go(now, f"{why}; again in {AGAIN:.0f} s")

    def _become(self, phase: RechargePhase, now: float) -> None:
        self.phase, self._since = phase, now

    def _percent(self) -> str:
        return "battery" if self._charge is None else f"battery {self._charge.share * 100:.0f} %"

    def _watch(self, now: float) -> None:
        if self._wanted():
            self._become(RechargePhase.WAITING, now)
        elif self._charge is not None:
            self._tell("charging" if self._charge.fed else "watching the battery", self._percent())
        elif self._driver.said:
            self._tell(f"refused: {self._driver.said}", "")

    def _wait(self, now: float) -> None:
        driver = self._driver
        if not self._wanted():
            self._become(RechargePhase.WATCHING, now)
            return
        why_not = self._why_not(now)
        if driver.in_control and not why_not and now >= self._not_before:
            # Who drove a moment ago by a connection that is lost must let go first (SPEC section 2.5).
            driver.drive(STILL)
            self._sent = now + SILENCE
            self._become(RechargePhase.SEEKING, now)
            self._tell(f"looking for marker {self._marker}", self._percent())
            return
        if not why_not and driver.said and not driver.in_control:
            # It was asked for in the moment in which somebody else took it; a request would be in his way.
            self._failed, driver.said = driver.said, ""
            driver.withdraw()
            self._not_before = now + CALM
        if driver.in_control or why_not or now < self._not_before:
            why = why_not or self._failed or "the robot was somebody else's a moment ago"
            self._tell(f"the battery is low, and it waits: {why}", self._percent())
            driver.give_back()
        else:
            self._failed = ""
            driver.take()

    def _seek(self, now: float) -> None:
        turn = min(SEEKING_TURN, self._approach.turn, self._driver.limits.turn)
        if now - self._seen_at <= FRESH:
            self._become(RechargePhase.GOING, now)
            self._tell(f"driving to marker {self._marker}", self._percent())
        elif now - self._since > ROUND / max(turn, SLOWEST_TURN):
            self._fail(now, f"marker {self._marker} is nowhere around")
        elif now - self._glimpsed_at <= GLIMPSE:
            self._driver.still()
        else:
            self._drive(VelocityCommand(0.0, self._side * turn), now)

    def _go(self, now: float) -> None:
        assert self._seen is not None
        missing = now - self._seen_at
        if missing > LOST:
            self._side = math.copysign(1.0, self._seen.bearing)
            self._become(RechargePhase.SEEKING, now)
            self._tell(f"marker {self._marker} is lost: looking for it", self._percent())
        elif missing > FRESH:
            self._driver.still()
        elif self._approach.arrived(self._seen):
            self._driver.give_back()
            self._become(RechargePhase.STAYING, now)
        elif self._ahead is not None and self._ahead < self._clear:
            self._stand_before(now)
        else:
            self._since = now
            self._tell(f"driving to marker {self._marker}", f"{self._seen.distance:.2f} m")
            self._drive(self._approach.command(self._seen), now)

    def _stand_before(self, now: float) -> None:
        self._driver.still()
        self._tell("something is in the way: it stands", f"{self._ahead:.2f} m")
        if now - self._since > PATIENCE:
            self._fail(now, "something is in the way")

    def _stay(self, now: float) -> None:
        if not self._need.urgent:
            self._become(RechargePhase.WATCHING, now)
        elif self._charge is not None and self._charge.fed:
            self._since = now
            self._tell("charging", self._percent())
        elif self._charge is not None and self._charge.status == UNKNOWN:
            self._tell(f"stands at marker {self._marker}", self._percent())
        else:
            self._tell(
                f"stands at marker {self._marker}, and the battery does not charge yet", self._percent()
            )
            if now - self._since > AGAIN:
                self._become(RechargePhase.WAITING, now)

    def _drive(self, command: VelocityCommand, now: float) -> None:
        if now - self._sent >= EVERY:
            self._sent = now
            self._driver.drive(command)


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@driving
@click.option("--battery", default="/battery_state", show_default=True, metavar="TOPIC")
@click.option(
    "--markers", default="/markers/seen", show_default=True, metavar="TOPIC", help="Of the service 'markers'."
)
@click.option("--scan", default="/scan", show_default=True, metavar="TOPIC", help="Of the scanner.")
@click.option("--marker", type=click.IntRange(0), default=7, show_default=True, help="The charger's.")
@click.option(
    "--low",
    type=Number(0, 100),
    default=20.0,
    show_default=True,
    metavar="PERCENT",
    help="It drives there below.",
)
@click.option(
    "--enough",
    type=Number(0, 100),
    default=80.0,
    show_default=True,
    metavar="PERCENT",
    help="From here on the battery may become low again.",
)
@click.option(
    "--distance",
    type=Number(0.1, 10),
    default=0.45,
    show_default=True,
    metavar="M",
    help="From the marker to the camera, where it is there.",
)
@click.option(
    "--clear",
    type=Number(0.05, 10),
    default=0.3,
    show_default=True,
    metavar="M",
    help="It stands when something ahead is nearer to the scanner.",
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

    Camera and scanner look ahead, from the middle of the robot. The charger is where its marker is, which the service
    'markers' of the robot sees. SIGINT and SIGTERM end it. The token comes from the variable SWITCHBOARD_TOKEN.

    \b
    Examples:
      ROBOT=ws://127.0.0.1:9090/robots/robot-one
      python -m robot_client.apps.recharge $ROBOT --low 99 --enough 99.5 --speed 0.2
    """
    if enough <= low:
        raise click.BadParameter(f"--enough ({enough:g}) must be more than --low ({low:g})")
    if clear >= distance:
        raise click.BadParameter(f"--clear ({clear:g}) must be less than --distance ({distance:g})")
    token()
    ending = Ending()
    status = StatusLine(sys.stdout, time.monotonic)
    program = Recharge(
        DockingTopics(battery, markers, scan),
        topic,
        marker,
        Need(low / 100, enough / 100),
        Approach(distance, speed, turn),
        clear,
        status.tell,
    )
    with in_words():
        run_connected(url, program, ending)
    status.end("ended")


if __name__ == "__main__":
    main()
