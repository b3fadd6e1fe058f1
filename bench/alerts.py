"""How soon somebody hears of a robot whose plug was pulled: from the fault to the request at a webhook, in seconds.

A real relay, daemon and simulated robot, which is being driven. Each time it is another robot with a rule of its own:
what comes again within a minute is told only then, and one rule tells no more than three errors at once.
"""

from __future__ import annotations

import contextlib
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bench.relay import Relay
from bench.report import Options, Row
from tests.worlds.chaos_proxy import ChaosProxy
from tests.worlds.client_threads import Driver
from tests.worlds.http_requests import ask
from tests.worlds.processes import running
from tests.worlds.robot_process import Robot
from tests.worlds.waiting import wait_for
from tests.worlds.webhook_server import Delivery, WebhookServer

BAR_SECONDS = 5
WATCHED = 5.0
"""Seconds from the message in which another one would be seen."""

RULES = "/api/v1/alerts/rules"
FAULTS: dict[str, Callable[[Robot, ChaosProxy], None]] = {
    "daemon killed (SIGKILL)": lambda robot, way: robot.daemon.kill(),
    "robot's link: black hole": lambda robot, way: way.black_hole(),
}


class House:
    """A relay that may send to this machine, and who drives and is told."""

    def __init__(self, folder: Path, stack: contextlib.ExitStack, watched: float) -> None:
        self.relay = Relay(folder, "--webhook-networks", "127.0.0.0/8")
        stack.enter_context(running(self.relay))
        self.hook = WebhookServer()
        stack.enter_context(running(self.hook))
        self.token = self.relay.user("boss", admin=True)
        self._robots = 0
        self._watched = watched

    def pull(self, fault: Callable[[Robot, ChaosProxy], None]) -> tuple[float, int]:
        """Let a robot go dark while it is driven; seconds until that was told, and how often it was."""
        self._robots += 1
        name = f"pulled-{self._robots}"
        with contextlib.closing(ChaosProxy(self.relay.robots_port)) as way:
            robot = Robot(self.relay, name, port=way.port)
            with running(robot), self._rule(name), self.relay.connect(name, self.token) as client:
                driver = Driver(client)
                with running(driver):
                    driver.start()
                    wait_for("the robot moves", robot.moving)
                    pulled = time.monotonic()
                    fault(robot, way)
                    wait_for("the webhook hears of it", lambda: self._told(name))
                    time.sleep(self._watched)  # to see that it does not come twice
                told = self._told(name)
                way.heal()  # so that the daemon can say goodbye
        return told[0].at - pulled, len(told)

    @contextlib.contextmanager
    def _rule(self, robot: str) -> Any:
        """A rule as it comes, for one robot."""
        rule = self._ask("POST", RULES, {"channel": "webhook", "url": self.hook.url, "robots": robot})
        try:
            yield
        finally:
            self._ask("DELETE", f"{RULES}/{rule['id']}")

    def _ask(self, method: str, path: str, body: Any = None) -> Any:
        answer = ask(self.relay.http_port, method, path, body, token=self.token)
        assert answer.status < 300, answer.body
        return answer.json if answer.body else None

    def _told(self, robot: str) -> list[Delivery]:
        """The requests so far that tell that a robot is offline, one for each time they do."""
        return [
            delivery
            for delivery in list(self.hook.got)
            for each in delivery.json["alerts"]
            if (each["robot"], each["kind"], each["event"]) == (robot, "offline", "begun")
        ]


def run(options: Options) -> list[Row]:
    """Both faults in turn, some times each; the worst counts."""
    runs = options.runs or int(options.pick(1, 20))
    rows, deliveries = [], []
    with tempfile.TemporaryDirectory(prefix="bench-") as folder, contextlib.ExitStack() as stack:
        house = House(Path(folder), stack, options.pick(0, WATCHED))
        for name, fault in FAULTS.items():
            found = [house.pull(fault) for _ in range(runs)]
            deliveries += [count for _, count in found]
            rows += _rows(name, [took for took, _ in found])
    words = f"of {len(deliveries)} faults: not told exactly once"
    return [*rows, Row("alerts", words, "faults", sum(count != 1 for count in deliveries), bar=0)]


def _rows(name: str, times: list[float]) -> list[Row]:
    print(f"    {name}: {', '.join(f'{each:.2f}' for each in times)} s", flush=True)
    worst = f"fault → webhook, worst of {len(times)}: {name}"
    return [
        Row("alerts", f"fault → webhook, median: {name}", "s", statistics.median(times)),
        Row("alerts", worst, "s", max(times), bar=BAR_SECONDS),
    ]
