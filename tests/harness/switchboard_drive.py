"""A robot being driven, with everything in between breakable."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from typing import Any

from switchboard_client import Client
from switchboard_proxy import ChaosProxy
from switchboard_pulse import Pulse
from switchboard_relay import Relay
from switchboard_robot import Robot
from switchboard_threads import Driver
from switchboard_waiting import wait_for

LIMIT_MS = 500
"""What is promised, and measured by ``make bench BENCH=standstill``."""

LATE_MS = 1500
"""What tests take for that: a computer full of them is late at times. Without what is tested nothing would stand."""

SIM_STEP_MS = 20
LET_GO_SECONDS = 0.8
"""Silence of half a second is letting go, and as long as pings leave in doubt when somebody spoke."""


UNDERSTOOD_SECONDS = 5.0
"""Who has let go, and commands, moves the robot long before."""


def understood(driver: Driver, robot: Robot) -> None:
    """Wait until a robot moves by a driver: whom a busy machine has not understood to have let go does so once more."""
    for _ in range(12):
        with contextlib.suppress(AssertionError):
            wait_for("the robot moves", robot.moving, UNDERSTOOD_SECONDS)
            return
        driver.let_go(LET_GO_SECONDS)
    wait_for("the robot moves", robot.moving)


class Drive:
    """A relay, a robot and somebody driving, each behind a proxy that can be broken."""

    def __init__(self, folder: Path) -> None:
        self.relay = Relay(folder, "--heartbeat", "0.5")
        self.robot_side = ChaosProxy(self.relay.robots_port)
        self.client_side = ChaosProxy(self.relay.http_port)
        self.robot = Robot(self.relay, "rover", port=self.robot_side.port)
        self.token = self.relay.user("driver")
        self.relay.cli("right", "grant", "driver", "rover", "operator")
        self._drivers: list[Any] = []
        self._pulse = Pulse()
        self._pulse.start()

    def start_driving(self, driver: Any = None) -> Any:
        """Drive in circles until the robot moves by its own record.

        :param driver: who drives, from its ``start`` to its ``stop``; a :class:`Driver` where there is none
        """
        if driver is None:
            driver = Driver(self.relay.connect_by(self.client_side.port, "rover", self.token))
        driver.start()
        self._drivers.append(driver)
        return self._driven(driver)

    def _driven(self, driver: Any) -> Any:
        wait_for("the robot moves", self.robot.moving)
        # Some commands more, so that all links are in the state they are in for hours.
        enough = self._obeyed() + 5
        wait_for("it is driven", lambda: self._obeyed() >= enough)
        return driver

    def _obeyed(self) -> int:
        """How many commands to move have reached the robot."""
        return sum(1 for each in self.robot.events("command") if each["v"] or each["w"])

    def standstill_ms(self, since: int) -> float:
        """Milliseconds from a fault at ``since`` (monotonic ns) to the standstill, by the robot's own record."""
        self.stands()
        return float(self.robot.events("standstill")[-1]["t"] - since) / 1e6

    def stands(self) -> None:
        """Wait until the robot stands."""
        wait_for("the robot stands", lambda: not self.robot.moving())

    def answers(self, client: Client) -> None:
        """Wait until the robot answers, behind everything that was held up on the way to it."""
        wait_for("the robot answers", lambda: client.call("/relay/ping", {"robot": True})["result"])

    def stands_within_limit(self, since: int) -> None:
        """The robot came to a standstill after a fault, and by that fault."""
        before = self._pulse.lost()
        took_ms = self.standstill_ms(since)
        lost_ms = 1000 * (self._pulse.lost() - before)
        assert took_ms <= LATE_MS + lost_ms, (
            f"it took {took_ms:.0f} ms; the machine stood still for {lost_ms:.0f}"
        )

    def again(self) -> None:
        """All is back by itself: by a new connection he drives who lets go once, and then leaves it."""
        self.robot.wait_online()
        time.sleep(LET_GO_SECONDS)  # so long he must say nothing
        driver = Driver(self.relay.connect_by(self.client_side.port, "rover", self.token))
        driver.begin_with_a_pause(LET_GO_SECONDS)
        driver.start()
        try:
            understood(driver, self.robot)
            self._driven(driver)
        finally:
            # Whoever goes on would keep control from all tests that follow.
            driver.stop()
        self.stands()

    def stop(self) -> None:
        """End everything."""
        self._pulse.stop()
        self.robot_side.heal()
        self.client_side.heal()
        for driver in self._drivers:
            driver.stop()
        self.robot.stop()
        self.relay.stop()
        self.robot_side.close()
        self.client_side.close()
