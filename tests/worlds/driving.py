"""A driven robot, with breakable connections between all parts."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from typing import Any

from tests.worlds.chaos_proxy import ChaosProxy
from tests.worlds.client_threads import Driver
from tests.worlds.machine_pauses import Pulse
from tests.worlds.relay_process import Relay
from tests.worlds.robot_process import Robot
from tests.worlds.sync_client import Client
from tests.worlds.waiting import wait_for

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
    """Waits until a robot follows a driver; on a busy machine a pause may be missed, so it is repeated."""
    for _ in range(12):
        with contextlib.suppress(AssertionError):
            wait_for("the robot moves", robot.moving, UNDERSTOOD_SECONDS)
            return
        driver.let_go(LET_GO_SECONDS)
    wait_for("the robot moves", robot.moving)


class Drive:
    """A relay, a robot and a driver, each behind a breakable proxy."""

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
        """Drives in circles until the robot moves by its own log.

        :param driver: from its ``start`` to its ``stop``; a :class:`Driver` by default
        """
        if driver is None:
            driver = Driver(self.relay.connect_by(self.client_side.port, "rover", self.token))
        driver.start()
        self._drivers.append(driver)
        return self._driven(driver)

    def _driven(self, driver: Any) -> Any:
        wait_for("the robot moves", self.robot.moving)
        # Some more commands bring all links into their steady state.
        enough = self._obeyed() + 5
        wait_for("it is driven", lambda: self._obeyed() >= enough)
        return driver

    def _obeyed(self) -> int:
        """The number of moving commands that reached the robot."""
        return sum(1 for each in self.robot.events("command") if each["v"] or each["w"])

    def standstill_ms(self, since: int) -> float:
        """Milliseconds from a fault at ``since`` (monotonic ns) to the standstill, by the robot's own log."""
        self.stands()
        return float(self.robot.events("standstill")[-1]["t"] - since) / 1e6

    def stands(self) -> None:
        """Waits until the robot stands."""
        wait_for("the robot stands", lambda: not self.robot.moving())

    def answers(self, client: Client) -> None:
        """Waits until the robot answers, after all delayed messages to it."""
        wait_for("the robot answers", lambda: client.call("/relay/ping", {"robot": True})["result"])

    def stands_within_limit(self, since: int) -> None:
        """The robot came to a standstill after a fault, because of that fault."""
        before = self._pulse.held_up()
        took_ms = self.standstill_ms(since)
        held_up_ms = 1000 * (self._pulse.held_up() - before)
        assert took_ms <= LATE_MS + held_up_ms, (
            f"it took {took_ms:.0f} ms; the machine held it up for {held_up_ms:.0f}"
        )

    def again(self) -> None:
        """All parts recover by themselves: after a pause a new connection drives, and releases at the end."""
        self.robot.wait_online()
        time.sleep(LET_GO_SECONDS)  # a pause this long counts as a release
        driver = Driver(self.relay.connect_by(self.client_side.port, "rover", self.token))
        driver.begin_with_a_pause(LET_GO_SECONDS)
        driver.start()
        try:
            understood(driver, self.robot)
            self._driven(driver)
        finally:
            # A driver that goes on would keep control during all later tests.
            driver.stop()
        self.stands()

    def stop(self) -> None:
        self._pulse.stop()
        self.robot_side.heal()
        self.client_side.heal()
        for driver in self._drivers:
            driver.stop()
        self.robot.stop()
        self.relay.stop()
        self.robot_side.close()
        self.client_side.close()
