"""A gamepad drives a robot: program, relay, daemon and simulator, each in its own process.

The gamepad is a virtual joystick of SDL; everything behind it is as for a real one.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.worlds.chaos_proxy import ChaosProxy
from tests.worlds.piped_process import PipedProcess
from tests.worlds.processes import running
from tests.worlds.waiting import wait_for

SCRIPT = Path(__file__).parent / "clients" / "joystick_in_hand.py"
LEFT_Y, LEFT_X = 1, 0
HOLD, STOP = 10, 1
"""As SDL numbers the buttons of the gamepads it knows."""

ABSENCE = 0.6
"""Seconds that prove an absence: the robot would have obeyed after a tenth of that."""


class GamepadWorld:
    """A robot, and a gamepad for it."""

    def __init__(self, folder: Path, world: Any) -> None:
        self.folder = folder
        self.relay = world.relay
        self.robot = world.robot
        self.network = ChaosProxy(self.relay.http_port)
        self.token = world.operator
        self.pad: PipedProcess
        self._seen = 0

    def sit_down(self) -> PipedProcess:
        """Starts the program, and plugs in the gamepad."""
        url = f"ws://127.0.0.1:{self.network.port}/robots/rover"
        command = [sys.executable, "-u", str(SCRIPT), url, "--speed", "0.3"]
        environment = {**os.environ, "SWITCHBOARD_TOKEN": self.token}
        self.pad = PipedProcess(command, self.folder / "pad", f"pad{time.monotonic_ns()}", environment)
        self._seen = 0
        self.says("no gamepad")
        self.pad.wait_to_say("no gamepad")
        self.pad.tell("plug")
        return self.pad

    def says(self, words: str) -> None:
        """Waits until the program prints this again."""

        def found() -> bool:
            at = self.pad.said().find(words, self._seen)
            if at >= 0:
                self._seen = at + len(words)
            return at >= 0

        wait_for(f"the program says {words}", found)

    def hold(self, pressed: bool = True) -> None:
        """Presses or releases the deadman button."""
        self.pad.tell(f"button {HOLD} {int(pressed)}")

    def push(self, ahead: float, left: float = 0.0) -> None:
        """Moves the stick."""
        self.pad.tell(f"axis {LEFT_Y} {-ahead}")
        self.pad.tell(f"axis {LEFT_X} {-left}")

    def take(self) -> None:
        """Takes control, with all buttons released."""
        self.says("press the button to take control")
        self.hold()
        self.says("you have control")
        self.hold(False)
        self.says("hold the button to drive")

    def drive(self) -> None:
        """Drives until the robot moves, by its own log."""
        self.hold()
        self.says("driving")
        self.push(1.0)
        wait_for("the robot moves", self.robot.moving)

    def stands(self) -> None:
        """Waits until the robot stands after a zero command."""

        def stands() -> bool:
            last = self.robot.events("command")[-1]
            return not self.robot.moving() and (last["v"], last["w"]) == (0.0, 0.0)

        wait_for("the robot stands", stands)

    def moves_nothing(self) -> None:
        """The robot stands, and goes on standing."""
        since = time.monotonic_ns()
        time.sleep(ABSENCE)  # no command must arrive meanwhile
        assert [each for each in self.robot.events("command", since) if each["v"] or each["w"]] == []

    def holder(self) -> str:
        """The controller's name."""
        with self.relay.connect("rover", self.token) as client:
            client.send(op="subscribe", topic="/relay/control")
            holder = client.until(op="publish")["msg"]["holder"]
        return "" if holder is None else str(holder["user"])

    def stop(self) -> None:
        self.network.close()


@pytest.fixture(scope="module")
def gamepad(tmp_path_factory: pytest.TempPathFactory, world: Any) -> Iterator[GamepadWorld]:
    """One for all tests."""
    world.left_alone()
    gamepad = GamepadWorld(tmp_path_factory.mktemp("gamepad"), world)
    with running(gamepad):
        yield gamepad


def test_the_robot_moves_while_the_button_is_held_and_the_stick_is_pushed(gamepad: GamepadWorld) -> None:
    """At the commanded speed; the button takes control, and the end releases it after a zero."""
    since = time.monotonic_ns()
    with running(gamepad.sit_down()):
        assert gamepad.holder() == ""
        gamepad.take()
        assert gamepad.holder() == "operator"
        gamepad.drive()
        gamepad.push(0.0)
        gamepad.stands()
        gamepad.push(0.0, 1.0)
        wait_for("it turns to the left", lambda: gamepad.robot.events("command")[-1]["w"] == 1.0)
        gamepad.hold(False)
        gamepad.says("hold the button to drive")
        gamepad.stands()
        gamepad.moves_nothing()
        gamepad.push(0.0)
        gamepad.drive()
        assert max(each["v"] for each in gamepad.robot.events("command", since)) == 0.3
        gamepad.pad.signal(signal.SIGINT)
        gamepad.stands()
        gamepad.says("ended")
    wait_for("control is given back", lambda: not gamepad.holder())


def test_command_after_losing_control_moves_nothing_until_release(gamepad: GamepadWorld) -> None:
    """After unplugging and plugging in the gamepad, and after a lost connection."""
    with running(gamepad.sit_down()):
        gamepad.take()
        gamepad.drive()
        gamepad.pad.tell("unplug")
        gamepad.says("no gamepad")
        gamepad.stands()
        gamepad.pad.tell("plug")
        gamepad.says("hold the button to drive")
        gamepad.drive()
        gamepad.network.reset()
        gamepad.says("is lost")
        gamepad.stands()
        gamepad.says("release stick and button")
        gamepad.moves_nothing()
        gamepad.hold(False)
        gamepad.push(0.0)
        gamepad.take()
        gamepad.drive()
    gamepad.stands()


def test_the_stop_button_stops_the_robot_of_any_driver(gamepad: GamepadWorld) -> None:
    """It takes no control; the driver's commands have no effect until a resume."""
    with running(gamepad.sit_down()):
        gamepad.says("press the button to take control")
        gamepad.pad.tell(f"button {STOP} 1")
        gamepad.says("the robot is stopped by operator")
        wait_for("nobody has control", lambda: not gamepad.holder())
        gamepad.pad.tell(f"button {STOP} 0")
        with gamepad.relay.connect("rover", gamepad.token) as client:
            assert client.call("/relay/take_control")["values"]["success"]
            wait_for("it is resumed", lambda: client.call("/relay/resume")["result"])
