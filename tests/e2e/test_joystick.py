"""A gamepad on a desk drives a robot: program, relay, daemon and simulator, all in processes of their own.

The gamepad is a virtual joystick of SDL; everything behind it is what a real one has.
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
from switchboard_fed import Fed
from switchboard_processes import running
from switchboard_proxy import ChaosProxy
from switchboard_waiting import wait_for

SCRIPT = Path(__file__).parent / "clients" / "joystick_in_hand.py"
LEFT_Y, LEFT_X = 1, 0
HOLD, STOP = 10, 1
"""As SDL numbers the buttons of the gamepads it knows."""

ABSENCE = 0.6
"""Seconds that prove an absence: the robot would have obeyed after a tenth of that."""


class Desk:
    """A robot, and a gamepad far from it."""

    def __init__(self, folder: Path, world: Any) -> None:
        self.folder = folder
        self.relay = world.relay
        self.robot = world.robot
        self.way = ChaosProxy(self.relay.http_port)
        self.token = world.operator
        self.pad: Fed
        self._seen = 0

    def sit_down(self) -> Fed:
        """Start the program, and plug the gamepad in."""
        url = f"ws://127.0.0.1:{self.way.port}/robots/rover"
        command = [sys.executable, "-u", str(SCRIPT), url, "--speed", "0.3"]
        environment = {**os.environ, "SWITCHBOARD_TOKEN": self.token}
        self.pad = Fed(command, self.folder / "pad", f"pad{time.monotonic_ns()}", environment)
        self._seen = 0
        self.says("no gamepad")
        self.pad.wait_to_say("no gamepad")
        self.pad.tell("plug")
        return self.pad

    def says(self, words: str) -> None:
        """Wait until the program says this anew."""

        def found() -> bool:
            at = self.pad.said().find(words, self._seen)
            if at >= 0:
                self._seen = at + len(words)
            return at >= 0

        wait_for(f"the program says {words}", found)

    def hold(self, pressed: bool = True) -> None:
        """Press the dead man's button, or let it go."""
        self.pad.tell(f"button {HOLD} {int(pressed)}")

    def push(self, ahead: float, left: float = 0.0) -> None:
        """Move the stick."""
        self.pad.tell(f"axis {LEFT_Y} {-ahead}")
        self.pad.tell(f"axis {LEFT_X} {-left}")

    def take(self) -> None:
        """Have control, and everything let go of."""
        self.says("press the button to take control")
        self.hold()
        self.says("you have control")
        self.hold(False)
        self.says("hold the button to drive")

    def drive(self) -> None:
        """Drive until the robot moves, by its own record."""
        self.hold()
        self.says("driving")
        self.push(1.0)
        wait_for("the robot moves", self.robot.moving)

    def stands(self) -> None:
        """Wait until the robot stands, by a zero that was said."""

        def stands() -> bool:
            last = self.robot.events("command")[-1]
            return not self.robot.moving() and (last["v"], last["w"]) == (0.0, 0.0)

        wait_for("the robot stands", stands)

    def moves_nothing(self) -> None:
        """It stands, and goes on standing."""
        since = time.monotonic_ns()
        time.sleep(ABSENCE)  # so long nothing must come
        assert [each for each in self.robot.events("command", since) if each["v"] or each["w"]] == []

    def holder(self) -> str:
        """Who has control."""
        with self.relay.connect("rover", self.token) as client:
            client.send(op="subscribe", topic="/relay/control")
            holder = client.until(op="publish")["msg"]["holder"]
        return "" if holder is None else str(holder["user"])

    def stop(self) -> None:
        """End everything."""
        self.way.close()


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory, world: Any) -> Iterator[Desk]:
    """One for all."""
    world.left_alone()
    desk = Desk(tmp_path_factory.mktemp("desk"), world)
    with running(desk):
        yield desk


def test_the_robot_moves_while_the_button_is_held_and_the_stick_is_pushed(desk: Desk) -> None:
    """As fast as it was told; control is taken by the button, and given back at the end, after a zero."""
    since = time.monotonic_ns()
    with running(desk.sit_down()):
        assert desk.holder() == ""
        desk.take()
        assert desk.holder() == "operator"
        desk.drive()
        desk.push(0.0)
        desk.stands()
        desk.push(0.0, 1.0)
        wait_for("it turns to the left", lambda: desk.robot.events("command")[-1]["w"] == 1.0)
        desk.hold(False)
        desk.says("hold the button to drive")
        desk.stands()
        desk.moves_nothing()
        desk.push(0.0)
        desk.drive()
        assert max(each["v"] for each in desk.robot.events("command", since)) == 0.3
        desk.pad.signal(signal.SIGINT)
        desk.stands()
        desk.says("ended")
    wait_for("control is given back", lambda: not desk.holder())


def test_what_was_taken_out_of_the_hand_moves_nothing_until_it_was_let_go(desk: Desk) -> None:
    """A gamepad that is unplugged and comes back, and a connection that is lost and made again."""
    with running(desk.sit_down()):
        desk.take()
        desk.drive()
        desk.pad.tell("unplug")
        desk.says("no gamepad")
        desk.stands()
        desk.pad.tell("plug")
        desk.says("hold the button to drive")
        desk.drive()
        desk.way.reset()
        desk.says("is lost")
        desk.stands()
        desk.says("let go of stick and button")
        desk.moves_nothing()
        desk.hold(False)
        desk.push(0.0)
        desk.take()
        desk.drive()
    desk.stands()


def test_the_stop_button_stops_the_robot_whoever_drives_it(desk: Desk) -> None:
    """It takes no control; who drove moves nothing afterwards, until it is resumed."""
    with running(desk.sit_down()):
        desk.says("press the button to take control")
        desk.pad.tell(f"button {STOP} 1")
        desk.says("the robot is stopped by operator")
        wait_for("nobody has control", lambda: not desk.holder())
        desk.pad.tell(f"button {STOP} 0")
        with desk.relay.connect("rover", desk.token) as client:
            assert client.call("/relay/take_control")["values"]["success"]
            wait_for("it is resumed", lambda: client.call("/relay/resume")["result"])
