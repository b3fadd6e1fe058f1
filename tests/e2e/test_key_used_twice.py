"""Two daemons with the key of one robot: its owners are notified at once."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from relay_protocol import identity, link
from tests.worlds.fake_robot import FakeRobot
from tests.worlds.http_requests import ask
from tests.worlds.processes import BIN, Process, ros_environment
from tests.worlds.relay_process import Relay
from tests.worlds.robot_process import Robot
from tests.worlds.waiting import wait_for

KEY = b"k" * 32


class People:
    """Users with rights on the robot, and their alerts and events about its key."""

    def __init__(self, relay: Relay, robot: str) -> None:
        self._relay, self._robot = relay, robot
        self._tokens = {level: relay.user(level) for level in ("owner", "viewer")}
        for level in self._tokens:
            relay.cli("right", "grant", level, robot, level)

    def alerts(self, who: str) -> list[dict[str, Any]]:
        """Alerts about it."""
        return [each for each in self._get(who, "alerts", "alerts") if each["kind"] == "key"]

    def events(self, who: str) -> list[dict[str, Any]]:
        """Events about it."""
        return [each for each in self._get(who, "events", "events") if each["kind"] == "robot.key_used_twice"]

    def _get(self, who: str, path: str, part: str) -> list[dict[str, Any]]:
        answer = ask(self._relay.http_port, "GET", f"/api/v1/{path}", token=self._tokens[who])
        assert answer.status == 200, answer.body
        return list(answer.json[part])


@pytest.fixture
def relay(tmp_path: Path) -> Iterator[Relay]:
    """One for each test."""
    made = Relay(tmp_path)
    try:
        yield made
    finally:
        made.stop()


def answers_a_ping(robot: FakeRobot) -> None:
    """Answers all received pings, but at least one."""
    robot.send(link.Pong(t=robot.until("ping")["t"], at=1))


def test_owners_see_both_addresses_and_the_first_registration(relay: Relay) -> None:
    """The second link is refused, and the first one answers: that is enough. Viewers get no address."""
    code = relay.cli("robot", "add", "twin")["enrolment_code"]
    with FakeRobot(relay.robots_port) as robot:
        assert robot.enroll("twin", code, KEY)["op"] == "enrolled"
    people = People(relay, "twin")
    with (
        FakeRobot(relay.robots_port, "127.0.0.2") as first,
        FakeRobot(relay.robots_port, "127.0.0.3") as second,
    ):
        assert first.register("twin", KEY)["op"] == "welcome"
        answers_a_ping(first)
        assert second.register("twin", KEY)["op"] == "refused"

        def reported() -> bool:
            answers_a_ping(first)
            return bool(people.alerts("owner"))

        wait_for("the owner is notified", reported)
    (alert,) = people.alerts("owner")
    assert (alert["level"], alert["robot"]) == ("error", "twin")
    assert "127.0.0.2, 127.0.0.3" in alert["text"]
    (event,) = wait_for("the event is kept", lambda: people.events("owner"))
    assert event["data"] == {"addresses": "127.0.0.2, 127.0.0.3"}
    assert people.alerts("viewer") == []
    assert [each["data"] for each in people.events("viewer")] == [{}]
    assert identity.fingerprint(identity.public_half(KEY)) not in str(alert)


def test_a_copy_of_a_daemon_is_an_alert(relay: Relay) -> None:
    """Two real daemons displace each other; there is only one alert."""
    robot = Robot(relay, "twin")
    copy: Process | None = None
    try:
        people = People(relay, "twin")
        state = robot.folder / "copy"
        shutil.copytree(robot.state, state, ignore=shutil.ignore_patterns("*.lock", "*.sock"))
        command = [str(BIN / "switchboard-robot"), "run", "--state", str(state)]
        copy = Process(command, robot.folder, "copy", ros_environment(robot.domain))
        (alert,) = wait_for("the owner is notified", lambda: people.alerts("owner"))
        assert "127.0.0.1, 127.0.0.1" in alert["text"]
        assert wait_for("the event is kept", lambda: people.events("owner"))
        # Both connect repeatedly.
        wait_for("the alert counts more of them", lambda: people.alerts("owner")[0]["count"] > 2)
        assert len(people.alerts("owner")) == 1
    finally:
        if copy is not None:
            copy.stop()
        robot.stop()


def test_a_restarted_daemon_is_no_alert(relay: Relay) -> None:
    """For any way of ending."""
    robot = Robot(relay, "twin")
    with stopping(robot):
        people = People(relay, "twin")
        session = online(people)
        robot.daemon.kill()
        robot.start_daemon()
        wait_for("it is online again", lambda: online(people) > session)
        assert people.alerts("owner") == people.events("owner") == []


def online(people: People) -> int:
    """The number of connections of the robot."""
    return sum(each["kind"] == "robot.online" for each in people._get("owner", "events", "events"))


@contextlib.contextmanager
def stopping(robot: Robot) -> Iterator[Robot]:
    """Stops it at the end."""
    try:
        yield robot
    finally:
        robot.stop()
