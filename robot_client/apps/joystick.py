"""Drives a robot by a gamepad: ``python -m robot_client.apps.joystick``.

It moves only while a button on the shoulder is held. It stands at once when that is released, the stick is in its
middle, the gamepad is unplugged, or the program is ended; when the connection is lost the relay and the robot see to
it. What was held then counts no more until stick and button were let go of.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable

import click

from robot_client.apps.clock import now as since_start
from robot_client.apps.connection import RosbridgeConnection, in_words
from robot_client.apps.deadman import CENTRE, Curve, Deadman, DeadmanPhase, GamepadState, Stick
from robot_client.apps.driver import Driver, MaximumSpeeds, StopNotice, VelocityCommand
from robot_client.apps.gamepads import Gamepad, Gamepads, Layout
from robot_client.apps.options import driving
from robot_client.apps.reconnect import Ending, run_connected
from robot_client.apps.status_line import StatusLine
from robot_client.numbers import Number

NAME = "joystick"
LOOK = 0.02
"""Seconds from one look at the pad to the next."""

EVERY = 0.05
"""Seconds from one command to the next; a standstill does not wait."""


class Joystick:
    """Looks, and drives.

    :param pad: what is held
    :param grip: what that means
    :param topic: of the commands
    :param wanted: the fastest, within what the robot allows
    :param tell: takes the state in a few words, and what changes all the time
    :param clock: seconds, suspends included
    """

    def __init__(
        self,
        pad: Gamepad,
        grip: Deadman,
        topic: str,
        wanted: MaximumSpeeds,
        tell: Callable[[str, str], None],
        clock: Callable[[], float] = since_start,
    ) -> None:
        self._pad = pad
        self._grip = grip
        self._topic = topic
        self._wanted = wanted
        self._tell = tell
        self._clock = clock
        self._driver: Driver
        self._stop = StopNotice()
        self._sent = -math.inf
        self._last = CENTRE
        self._pressed = (False, False)

    def begin(self, line: RosbridgeConnection) -> None:
        """There is a line: what is held counts no more until it was let go of; but the stop button, held, stops."""
        self._pressed = (False, False)
        self._grip.drop()
        self._driver = Driver(line, self._topic, NAME, self._clock, self._stop)

    def step(self) -> bool:
        """Take what comes within a moment, look, and drive."""
        driver = self._driver
        driver.hear(LOOK)
        now = self._clock()
        look = self._pad.look()
        self._press(look)
        was = self._grip.phase
        allowed = driver.in_control and not driver.obstacle and not driver.late
        stick = self._grip.look(look, allowed, now)
        if stick is not None:
            self._drive(stick, now)
        elif was is DeadmanPhase.HELD:
            driver.still()
        if was is DeadmanPhase.READY and self._grip.phase is DeadmanPhase.SPENT:
            driver.take()
        self._tell(*self._state(stick))
        return True

    def leave(self) -> None:
        """Stand still, and let others drive."""
        self._grip.drop()
        self._driver.give_back()

    def lost(self, why: str, seconds: float) -> None:
        """Say so; the robot stands by itself."""
        self._grip.drop()
        self._tell(f"{why}; again in {seconds:.1f} s", "")

    def _press(self, look: GamepadState | None) -> None:
        """What buttons ask for that were not pressed before."""
        pressed = (False, False) if look is None else (look.stop, look.back)
        before, self._pressed = self._pressed, pressed
        if pressed[0] and not before[0]:
            self._grip.drop()
            self._driver.stop()
        if pressed[1] and not before[1]:
            self._grip.drop()
            self._driver.give_back()

    def _drive(self, stick: Stick, now: float) -> None:
        stands = stick == CENTRE and self._last != CENTRE
        self._last = stick
        if stands or now - self._sent >= EVERY:
            self._sent = now
            self._driver.drive(self._command(stick))

    def _command(self, stick: Stick) -> VelocityCommand:
        top = self._wanted.within(self._driver.limits)
        return VelocityCommand(stick.ahead * top.speed, stick.left * top.turn)

    def _state(self, stick: Stick | None) -> tuple[str, str]:
        driver, phase = self._driver, self._grip.phase
        words = phase.value
        if phase is DeadmanPhase.READY and not driver.in_control:
            words = "press the button to take control"
        elif phase is DeadmanPhase.SPENT and driver.in_control:
            words = f"you have control: {phase.value}"
        for also in (
            driver.obstacle,
            driver.said,
            "" if self._stop.done else self._stop.words,
            driver.wanted_by and f"{driver.wanted_by} asks for control",
        ):
            if also:
                words += f" ({also})"
        if driver.late:
            words += " (the robot does not answer)"
        moving = ""
        if stick is not None:
            command = self._command(stick)
            moving = f"{command.speed:+.2f} m/s {command.turn:+.2f} rad/s"
        if driver.round_trip is not None:
            moving += f"  to the robot and back {driver.round_trip * 1000:.0f} ms"
        return words, moving.strip()


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@driving
@click.option(
    "--dead",
    type=Number(0.0, 0.9),
    default=Curve().dead,
    show_default=True,
    help="Of the stick's way: its middle.",
)
@click.option(
    "--expo",
    type=Number(0.0, 1.0),
    default=Curve().expo,
    show_default=True,
    help="0: in proportion; 1: gentle near the middle.",
)
@click.option(
    "--axes",
    type=(int, int),
    default=(Layout().ahead, Layout().left),
    show_default=True,
    metavar="AHEAD LEFT",
    help="Of a pad that SDL does not know.",
)
@click.option(
    "--buttons",
    type=(int, int, int),
    default=(Layout().hold, Layout().stop, Layout().back),
    show_default=True,
    metavar="HOLD STOP BACK",
    help="Of a pad that SDL does not know.",
)
def main(
    url: str,
    topic: str,
    speed: float,
    turn: float,
    dead: float,
    expo: float,
    axes: tuple[int, int],
    buttons: tuple[int, int, int],
) -> None:
    """Drive the robot at URL (ws://relay/robots/NAME) by a gamepad.

    The button on the right shoulder takes control when it is pressed first; from then on the robot moves while it is
    held, by the left stick. B stops the robot, until somebody resumes it. BACK gives control back.

    The token comes from the variable SWITCHBOARD_TOKEN. SIGINT and SIGTERM end it.

    \b
    Examples:
      ROBOT=ws://127.0.0.1:9090/robots/robot-one
      python -m robot_client.apps.joystick $ROBOT
      python -m robot_client.apps.joystick $ROBOT --speed 0.5 --expo 0.7
      python -m robot_client.apps.joystick $ROBOT --axes 1 0 --buttons 7 2 8
    """
    ending = Ending()
    pads = Gamepads(Layout(*axes, *buttons))
    status = StatusLine(sys.stdout, time.monotonic)
    program = Joystick(pads, Deadman(Curve(dead, expo)), topic, MaximumSpeeds(speed, turn), status.tell)
    with in_words():
        run_connected(url, program, ending)
    status.end("ended")


if __name__ == "__main__":
    main()
