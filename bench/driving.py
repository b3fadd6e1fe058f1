"""Drivers whose commands say when they were sent, and what the simulated robot's record tells of that.

The moment is written into the turning speed, behind the fourth digit, where no robot feels it. The record of the
simulator has each command as it came, so it tells how old every one was when it was carried out.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
import threading
import time
from collections.abc import Iterable
from typing import Any

from websockets.sync.client import connect

from bench.child import Child
from tests.worlds.driving import LET_GO_SECONDS
from tests.worlds.sync_client import Client
from tests.worlds.waiting import wait_for

TOPIC = "/cmd_vel"
TWIST = "geometry_msgs/msg/Twist"
TURN = 0.6
"""Radians per second that the robot turns."""

AHEAD = 0.2
"""Metres per second."""

EVERY = 0.05
"""Seconds from one command to the next."""

_UNIT = 1e-14
"""Of the turning speed, for a microsecond; a double of this size is exact to a hundredth of it."""
_ROUND = 10**10
"""Microseconds after which the count begins anew."""

EXACT_MS = 0.01
"""How exactly a command tells when it was sent."""


def stamped_turn(now: int) -> float:
    """The turning speed that says that it is sent now.

    :param now: monotonic nanoseconds
    """
    return TURN + now // 1000 % _ROUND * _UNIT


def age_ms(turn: float, came: int) -> float:
    """How long a command was on its way, milliseconds.

    :param turn: as the record has it
    :param came: monotonic nanoseconds
    """
    sent = round((turn - TURN) / _UNIT)
    age = (came // 1000 - sent) % _ROUND
    return (age - _ROUND if age > _ROUND // 2 else age) / 1000


def ages_ms(events: Iterable[dict[str, Any]]) -> list[float]:
    """The ages of the commands to move among some events of a record."""
    return [age_ms(each["w"], each["t"]) for each in events if each["event"] == "command" and each["v"]]


def sent_before(moment: int, events: Iterable[dict[str, Any]]) -> bool:
    """Whether any command to move among some events of a record was sent before a moment.

    :param moment: monotonic nanoseconds
    """
    moving = (each for each in events if each["event"] == "command" and each["v"])
    return any(age_ms(each["w"], each["t"]) - (each["t"] - moment) / 1e6 > EXACT_MS for each in moving)


def first_move(events: Iterable[dict[str, Any]]) -> int:
    """When the first command to move among some events of a record came, monotonic nanoseconds; 0 without one."""
    commands = (each for each in events if each["event"] == "command")
    return next((int(each["t"]) for each in commands if each["v"] or each["w"]), 0)


def connected(port: int, robot: str, token: str) -> Client:
    """A client that does not wait long for an answer to its goodbye."""
    headers = {"Authorization": f"Bearer {token}"}
    url = f"ws://127.0.0.1:{port}/robots/{robot}"
    return Client(connect(url, additional_headers=headers, close_timeout=1))


def take_control(client: Client, seconds: float = 60.0) -> None:
    """Ask until the robot is one's own: that who had it is gone is found out in seconds."""

    def taken() -> bool:
        return bool(client.call("/relay/take_control", {"why": "bench"})["values"]["success"])

    wait_for("control is taken", taken, seconds)


class TimedDriver(threading.Thread):
    """Takes control and drives, until it is stopped or the connection breaks.

    :param client: connected
    :param pauses: whether he lets go once after his first command, as who drove before the robot's link broke must
    :param asks: whether he asks for control; a program that knows nothing of control just commands
    """

    def __init__(self, client: Client, pauses: bool = False, asks: bool = True) -> None:
        super().__init__(daemon=True)
        self._client = client
        self._pauses = pauses
        self._asks = asks
        self._end = threading.Event()
        self._silent = threading.Event()
        self.broken = ""

    def run(self) -> None:
        """Send, and read what comes so that nothing piles up."""
        try:
            if self._asks:
                take_control(self._client)
            self._client.send(op="advertise", topic=TOPIC, type=TWIST)
            if self._pauses:
                self._client.drive(AHEAD, stamped_turn(time.monotonic_ns()), TOPIC)
                self._end.wait(LET_GO_SECONDS)  # so long he must say nothing
            due = time.monotonic()
            while not self._end.is_set():
                if not self._silent.is_set():
                    self._client.drive(AHEAD, stamped_turn(time.monotonic_ns()), TOPIC)
                due += EVERY
                while (left := due - time.monotonic()) > 0:
                    with contextlib.suppress(TimeoutError):
                        self._client.receive(left)
        except Exception as error:
            self.broken = repr(error)

    def fall_silent(self) -> None:
        """Stay, and say nothing more."""
        self._silent.set()

    def stop(self) -> None:
        """Leave, without a zero."""
        self._end.set()
        self.join(10)
        with contextlib.suppress(Exception):  # its connection may be broken by design
            self._client.close()


class DriverProcess(Child):
    """The same in a process of its own, which can be frozen and killed.

    :param port: where it connects
    :param token: of who drives
    """

    def __init__(self, port: int, robot: str, token: str) -> None:
        command = [sys.executable, "-m", "bench.driving", str(port), robot]
        super().__init__(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        assert self.popen.stdin is not None
        self.popen.stdin.write(token + "\n")
        self.popen.stdin.flush()
        self.ready(AssertionError("the driver does not start; see above"))

    def start(self) -> None:
        """It has begun by itself."""

    def fall_silent(self) -> None:
        """It does as long as it is frozen, or for good."""


def main() -> None:
    """Drive until the standard input ends; its first line is the token."""
    port, robot, token = int(sys.argv[1]), sys.argv[2], sys.stdin.readline().strip()
    driver = TimedDriver(connected(port, robot, token))
    driver.start()
    print("READY", flush=True)
    sys.stdin.read()


if __name__ == "__main__":
    main()
