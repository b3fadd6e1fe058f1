"""An owner holds topics and suppresses commands over HTTP, with a real relay and a real ROS 2 robot."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest

from relay_server.common.freshness_tokens import HEADER
from tests.worlds.client_threads import Driver
from tests.worlds.driving import LET_GO_SECONDS, UNDERSTOOD_SECONDS
from tests.worlds.machine_pauses import Pulse
from tests.worlds.relay_process import Relay
from tests.worlds.robot_process import Robot
from tests.worlds.sync_client import Client
from tests.worlds.waiting import PATIENCE, wait_for

LEVELS = {"olga": "owner", "ann": "operator", "vic": "viewer"}
ODOM = {"topic": "/odom", "type": "nav_msgs/msg/Odometry"}
SUPPRESS_MS = 200
SETTLED = 5
"""Suppressions after which nothing of what went before is under way any more."""

AGAIN = 5
"""So often the same is read again."""


class ControlWorld:
    """A relay with a robot, and an owner, a driver and a viewer."""

    def __init__(self, folder: Path) -> None:
        self.relay = Relay(folder)
        self.robot = Robot(self.relay, "rover")
        self.tokens = {name: self.relay.user(name) for name in LEVELS}
        for name, level in LEVELS.items():
            self.relay.cli("right", "grant", name, "rover", level)
        with self.asking("olga") as client:
            wait_for("the relay knows the topic", lambda: client.get("topics/odom").status_code == 200)

    def connect(self, name: str) -> Client:
        """A user's websocket."""
        return self.relay.connect("rover", self.tokens[name])

    @contextmanager
    def asking(self, name: str) -> Iterator[httpx.Client]:
        """A user's requests below the robot's address."""
        headers = {"Authorization": f"Bearer {self.tokens[name]}"}
        base = f"http://127.0.0.1:{self.relay.http_port}/api/v1/robots/rover"
        with httpx.Client(base_url=base, headers=headers, timeout=PATIENCE) as client:
            yield client

    def stop(self) -> None:
        self.robot.stop()
        self.relay.stop()


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ControlWorld]:
    """One for all tests, each of which restores the robot's state."""
    made = ControlWorld(tmp_path_factory.mktemp("hold"))
    try:
        yield made
    finally:
        made.stop()


@pytest.fixture
def olga(scene: ControlWorld) -> Iterator[httpx.Client]:
    """Requests of the owner."""
    with scene.asking("olga") as client:
        yield client


def by_websocket(client: Client) -> Iterator[Any]:
    """Odometry by websocket."""
    client.send(op="subscribe", **ODOM)
    while True:
        yield client.until(op="publish", topic="/odom")["msg"]


def by_events(client: httpx.Client) -> Generator[Any, None, None]:
    """Odometry by server-sent events."""
    with client.stream("GET", "topics/odom", headers={"Accept": "text/event-stream"}) as answer:
        assert answer.status_code == 200
        for line in answer.iter_lines():
            # On a busy machine there may be statuses between the messages.
            if line.startswith('data: {"header"'):
                yield json.loads(line.removeprefix("data: "))


def repeated(said: Iterator[Any]) -> Any:
    """Reads until a message is repeated; returns it."""
    last, times = None, 0
    until = time.monotonic() + PATIENCE
    while times < AGAIN:
        assert time.monotonic() < until, "each is another"
        before, last = last, next(said)
        times = times + 1 if last == before else 0
    return last


def other(said: Iterator[Any], than: Any) -> Any:
    """Reads until another message arrives."""
    until = time.monotonic() + PATIENCE
    for each in said:
        if each != than:
            return each
        assert time.monotonic() < until, "it is the same for ever"
    raise AssertionError("nothing more comes")


def stamp(odometry: Any) -> tuple[int, int]:
    """Time of the robot's measurement."""
    return odometry["header"]["stamp"]["sec"], odometry["header"]["stamp"]["nanosec"]


def test_held_topic_repeats_its_last_value(scene: ControlWorld, olga: httpx.Client) -> None:
    """To all present subscribers until the hold ends; then new messages follow."""
    with scene.connect("vic") as vic, scene.asking("vic") as client, closing(by_events(client)) as events:
        readers = [by_websocket(vic), events]
        for each in readers:
            other(each, next(each))
        held = olga.post("hold", json={"resource": "/odom", "ms": 60_000})
        assert (held.status_code, held.json()) == (200, {"resource": "/odom", "ms": 60_000})
        last = [repeated(each) for each in readers]
        reported = wait_for("the robot reports it", lambda: olga.get("control").json()["inhibited"])
        assert [(each["resource"], each["hold"]) for each in reported] == [("/odom", True)]
        assert olga.post("hold", json={"resource": "/odom", "ms": 0}).status_code == 200
        for reader, kept in zip(readers, last, strict=True):
            first = other(reader, kept)
            second = other(reader, first)
            assert stamp(kept) < stamp(first) < stamp(second)
        wait_for("the robot reports it", lambda: not olga.get("control").json()["inhibited"])


def test_held_topic_continues_in_time(scene: ControlWorld, olga: httpx.Client) -> None:
    """By itself when its time is over."""
    with scene.connect("vic") as vic:
        reader = by_websocket(vic)
        next(reader)

        def held() -> Any:
            """The held message, or None on a machine too slow to see it."""
            assert olga.post("hold", json={"resource": "/odom", "ms": 2000}).status_code == 200
            begun, last = time.monotonic(), next(reader)
            while time.monotonic() < begun + 2.0:
                before, last = last, next(reader)
                if last == before:
                    return last
            return None

        kept = wait_for("it is held", held)
        assert stamp(other(reader, kept)) > stamp(kept)


def test_hold_needs_the_right_to_inhibit(scene: ControlWorld, olga: httpx.Client) -> None:
    """There is no other method."""
    for name in ("ann", "vic"):
        with scene.asking(name) as client:
            assert client.post("hold", json={"resource": "/odom"}).status_code == 403
    refused = olga.post("inhibit", json={"resource": "/odom", "hold": True})
    assert refused.status_code == 400 and "hold" in refused.json()["detail"]
    assert olga.post("hold", json={"resource": "/odom", "ms": 60_001}).status_code == 400
    assert olga.post("hold", json={"resource": "/nowhere", "ms": 100}).status_code == 409
    assert olga.get("control").json()["inhibited"] == []


class HttpOperator:
    """Suppresses a driver and commands instead, by requests only.

    :param client: of a user with the right
    """

    def __init__(self, client: httpx.Client) -> None:
        self._client = client
        # Reading a resource opens the connection that the topic then obeys.
        self._moment = client.get("topics").headers[HEADER]

    def renew(self, ms: int = SUPPRESS_MS) -> None:
        """Suppresses the topic for this time."""
        answer = self._client.post("suppress", json={"resource": "/cmd_vel", "ms": ms})
        assert answer.status_code == 200, answer.text
        self._moment = answer.headers[HEADER]

    def command(self, v: float) -> httpx.Response:
        """Sends one command."""
        body = {"value": {"linear": {"x": v}}}
        answer = self._client.put("topics/cmd_vel", json=body, headers={HEADER: self._moment})
        self._moment = answer.headers[HEADER]
        return answer

    def overrules(self) -> tuple[int, int] | None:
        """Commands for a while by overlapping suppressions.

        :returns: start and end of the time without other commands, monotonic nanoseconds; ``None`` if the
            machine was so slow that there may have been a gap
        """
        moments: list[int] = []
        with Pulse() as pulse:
            for _ in range(3 * SETTLED):
                asked = time.monotonic_ns()
                self.renew()
                # The robot counts from its receipt of the order, which is not before the request.
                if moments and time.monotonic_ns() - moments[-1] > SUPPRESS_MS * 1e6:
                    return None
                moments.append(asked)
                status = self.command(-0.1).status_code
                assert status in (204, 409, 412), status
            return None if pulse.lost() else (moments[SETTLED], moments[-1])


def speeds(robot: Robot, since: int, until: int) -> list[float]:
    """Speeds of commands to the robot in that time."""
    return [each["v"] for each in robot.events("command", since) if each["t"] <= until]


def test_an_owner_suppresses_a_driver_by_requests(scene: ControlWorld, olga: httpx.Client) -> None:
    """The owner's commands move the robot, and the driver's do not; afterwards the driver's do, following a
    pause.
    """
    robot = scene.robot
    time.sleep(LET_GO_SECONDS)  # a pause of the driver
    driver = Driver(scene.connect("ann"), v=0.2, w=0.0)
    driver.start()
    try:
        wait_for("the driver moves it", lambda: [each for each in robot.events("command") if each["v"] > 0])
        operator_ = HttpOperator(olga)

        def overruled() -> list[float] | None:
            reported = operator_.overrules()
            return None if reported is None else speeds(robot, *reported)

        reported = wait_for("it is suppressed without a gap", overruled)
        assert min(reported) < 0, "his own commands did not come through"
        assert max(reported) <= 0, "the driver's commands came through"
        assert olga.get("control").json()["holder"]["user"] == "ann"
        operator_.renew(0)
        wait_for("nothing is suppressed", lambda: not olga.get("control").json()["suppressed"])
        since = time.monotonic_ns()
        wait_for("the driver has it again", _drives_on(robot, driver, since))
        # The first token may be too old.
        wait_for("he is refused", lambda: operator_.command(-0.1).status_code == 403)
        assert olga.get("control").json()["holder"]["user"] == "ann"
    finally:
        driver.stop()
    wait_for("it stands", lambda: not robot.moving())


def _drives_on(robot: Robot, driver: Driver, since: int) -> Callable[[], bool]:
    """Makes the driver pause until its commands work: on a slow machine a pause may be detected late or not
    at all.
    """

    def driven() -> bool:
        driver.let_go(LET_GO_SECONDS)
        until = time.monotonic() + UNDERSTOOD_SECONDS
        while time.monotonic() < until and driver.broken is None:
            if any(each["v"] > 0 for each in robot.events("command", since)):
                return True
            time.sleep(0.02)  # the pace of wait_for
        assert driver.broken is None, driver.broken
        return False

    return driven
