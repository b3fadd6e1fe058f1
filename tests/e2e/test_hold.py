"""An owner has topics held and commands suppressed over HTTP, with a real relay and a real ROS 2 robot."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
from switchboard_client import Client
from switchboard_drive import LET_GO_SECONDS, UNDERSTOOD_SECONDS
from switchboard_pulse import Pulse
from switchboard_relay import Relay
from switchboard_robot import Robot
from switchboard_threads import Driver
from switchboard_waiting import PATIENCE, wait_for

from relay_server.common.freshness_tokens import HEADER

LEVELS = {"olga": "owner", "ann": "operator", "vic": "viewer"}
ODOM = {"topic": "/odom", "type": "nav_msgs/msg/Odometry"}
SUPPRESS_MS = 200
SETTLED = 5
"""Suppressions after which nothing of what went before is under way any more."""

AGAIN = 5
"""So often the same is read again."""


class Place:
    """A relay with a robot, and an owner, a driver and a viewer."""

    def __init__(self, folder: Path) -> None:
        self.relay = Relay(folder)
        self.robot = Robot(self.relay, "rover")
        self.tokens = {name: self.relay.user(name) for name in LEVELS}
        for name, level in LEVELS.items():
            self.relay.cli("right", "grant", name, "rover", level)

    def connect(self, name: str) -> Client:
        """A websocket of one of them."""
        return self.relay.connect("rover", self.tokens[name])

    @contextmanager
    def asking(self, name: str) -> Iterator[httpx.Client]:
        """Requests of one of them below the robot's address."""
        headers = {"Authorization": f"Bearer {self.tokens[name]}"}
        base = f"http://127.0.0.1:{self.relay.http_port}/api/v1/robots/rover"
        with httpx.Client(base_url=base, headers=headers, timeout=PATIENCE) as client:
            yield client

    def stop(self) -> None:
        """End everything."""
        self.robot.stop()
        self.relay.stop()


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Place]:
    """One for all tests, each of which leaves the robot as it was."""
    made = Place(tmp_path_factory.mktemp("hold"))
    try:
        yield made
    finally:
        made.stop()


@pytest.fixture
def olga(place: Place) -> Iterator[httpx.Client]:
    """Requests of the owner."""
    with place.asking("olga") as client:
        yield client


def by_websocket(client: Client) -> Iterator[Any]:
    """Odometry as it comes."""
    client.send(op="subscribe", **ODOM)
    while True:
        yield client.until(op="publish", topic="/odom")["msg"]


def by_events(client: httpx.Client) -> Generator[Any, None, None]:
    """The same by HTTP."""
    with client.stream("GET", "topics/odom", headers={"Accept": "text/event-stream"}) as answer:
        assert answer.status_code == 200
        for line in answer.iter_lines():
            if line.startswith("data: "):
                yield json.loads(line.removeprefix("data: "))


def repeated(said: Iterator[Any]) -> Any:
    """Read until the same has come again and again; what it is."""
    last, times = None, 0
    until = time.monotonic() + PATIENCE
    while times < AGAIN:
        assert time.monotonic() < until, "each is another"
        before, last = last, next(said)
        times = times + 1 if last == before else 0
    return last


def other(said: Iterator[Any], than: Any) -> Any:
    """Read until another comes."""
    until = time.monotonic() + PATIENCE
    for each in said:
        if each != than:
            return each
        assert time.monotonic() < until, "it is the same for ever"
    raise AssertionError("nothing more comes")


def stamp(odometry: Any) -> tuple[int, int]:
    """When the robot measured it."""
    return odometry["header"]["stamp"]["sec"], odometry["header"]["stamp"]["nanosec"]


def test_what_is_held_says_its_last_value(place: Place, olga: httpx.Client) -> None:
    """Again and again to all who read it already, until that is ended; then what is new."""
    with place.connect("vic") as vic, place.asking("vic") as client, closing(by_events(client)) as events:
        readers = [by_websocket(vic), events]
        for each in readers:
            other(each, next(each))
        held = olga.post("hold", json={"resource": "/odom", "ms": 60_000})
        assert (held.status_code, held.json()) == (200, {"resource": "/odom", "ms": 60_000})
        last = [repeated(each) for each in readers]
        told = wait_for("the robot tells of it", lambda: olga.get("control").json()["inhibited"])
        assert [(each["resource"], each["hold"]) for each in told] == [("/odom", True)]
        assert olga.post("hold", json={"resource": "/odom", "ms": 0}).status_code == 200
        for reader, kept in zip(readers, last, strict=True):
            first = other(reader, kept)
            second = other(reader, first)
            assert stamp(kept) < stamp(first) < stamp(second)
        wait_for("the robot tells of it", lambda: not olga.get("control").json()["inhibited"])


def test_what_is_held_speaks_again_in_time(place: Place, olga: httpx.Client) -> None:
    """By itself."""
    with place.connect("vic") as vic:
        reader = by_websocket(vic)
        next(reader)

        def held() -> Any:
            """What it said, where the machine was fast enough to see any of it."""
            assert olga.post("hold", json={"resource": "/odom", "ms": 2000}).status_code == 200
            begun, last = time.monotonic(), next(reader)
            while time.monotonic() < begun + 2.0:
                before, last = last, next(reader)
                if last == before:
                    return last
            return None

        kept = wait_for("it is held", held)
        assert stamp(other(reader, kept)) > stamp(kept)


def test_who_may_not_inhibit_holds_nothing(place: Place, olga: httpx.Client) -> None:
    """It takes the right to; and there is one way."""
    for name in ("ann", "vic"):
        with place.asking(name) as client:
            assert client.post("hold", json={"resource": "/odom"}).status_code == 403
    refused = olga.post("inhibit", json={"resource": "/odom", "hold": True})
    assert refused.status_code == 400 and "hold" in refused.json()["detail"]
    assert olga.post("hold", json={"resource": "/odom", "ms": 60_001}).status_code == 400
    assert olga.post("hold", json={"resource": "/nowhere", "ms": 100}).status_code == 409
    assert olga.get("control").json()["inhibited"] == []


class Hand:
    """Suppresses who drives, and commands in his place, by requests alone.

    :param client: of who may
    """

    def __init__(self, client: httpx.Client) -> None:
        self._client = client
        # By asking for what there is he has a connection, which the topic then obeys.
        self._moment = client.get("topics").headers[HEADER]

    def renew(self, ms: int = SUPPRESS_MS) -> None:
        """The topic is his for so long."""
        answer = self._client.post("suppress", json={"resource": "/cmd_vel", "ms": ms})
        assert answer.status_code == 200, answer.text
        self._moment = answer.headers[HEADER]

    def command(self, v: float) -> httpx.Response:
        """One command."""
        body = {"value": {"linear": {"x": v}}}
        answer = self._client.put("topics/cmd_vel", json=body, headers={HEADER: self._moment})
        self._moment = answer.headers[HEADER]
        return answer

    def overrules(self) -> tuple[int, int] | None:
        """Command for a while by suppressions that follow each other without a gap.

        :returns: from when to when nobody else was obeyed, monotonic nanoseconds; ``None`` where the machine was so
            slow that there may have been a gap
        """
        moments: list[int] = []
        with Pulse() as pulse:
            for _ in range(3 * SETTLED):
                asked = time.monotonic_ns()
                self.renew()
                # The robot counts from when it was told, which was no earlier than it was asked.
                if moments and time.monotonic_ns() - moments[-1] > SUPPRESS_MS * 1e6:
                    return None
                moments.append(asked)
                status = self.command(-0.1).status_code
                assert status in (204, 409, 412), status
            return None if pulse.lost() else (moments[SETTLED], moments[-1])


def speeds(robot: Robot, since: int, until: int) -> list[float]:
    """What the robot was told in that time."""
    return [each["v"] for each in robot.events("command", since) if each["t"] <= until]


def test_an_owner_suppresses_who_drives_by_requests(place: Place, olga: httpx.Client) -> None:
    """His own commands move the robot, and none of the driver's; then it is the driver's again, once he has let go."""
    robot = place.robot
    time.sleep(LET_GO_SECONDS)  # so long the driver must say nothing
    driver = Driver(place.connect("ann"), v=0.2, w=0.0)
    driver.start()
    try:
        wait_for("the driver moves it", lambda: [each for each in robot.events("command") if each["v"] > 0])
        hand = Hand(olga)

        def overruled() -> list[float] | None:
            told = hand.overrules()
            return None if told is None else speeds(robot, *told)

        told = wait_for("it is suppressed without a gap", overruled)
        assert min(told) < 0, "his own commands did not come through"
        assert max(told) <= 0, "the driver's commands came through"
        assert olga.get("control").json()["holder"]["user"] == "ann"
        hand.renew(0)
        wait_for("nothing is suppressed", lambda: not olga.get("control").json()["suppressed"])
        since = time.monotonic_ns()
        wait_for("the driver has it again", _drives_on(robot, driver, since))
        # The moment he gives back may be too old at first.
        wait_for("he is refused", lambda: hand.command(-0.1).status_code == 403)
        assert olga.get("control").json()["holder"]["user"] == "ann"
    finally:
        driver.stop()
    wait_for("it stands", lambda: not robot.moving())


def _drives_on(robot: Robot, driver: Driver, since: int) -> Callable[[], bool]:
    """Let the driver let go, until he drives on: on a slow machine a pause is understood later, or not at all."""

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
