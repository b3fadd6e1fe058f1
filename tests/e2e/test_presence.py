"""The quality of links, and connected users: a real relay, and a robot whose network can be slow."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from relay_protocol import link
from tests.worlds.chaos_proxy import ChaosProxy
from tests.worlds.fake_robot import FakeRobot
from tests.worlds.http_requests import ask
from tests.worlds.relay_process import Relay
from tests.worlds.sync_client import Client
from tests.worlds.waiting import wait_for

KEY = bytes(range(32))
FAR = 0.2
"""Seconds each way."""


class Answering(threading.Thread):
    """Answers a robot's pings until the connection ends."""

    def __init__(self, robot: FakeRobot) -> None:
        super().__init__(daemon=True)
        self._robot = robot
        self.start()

    def run(self) -> None:
        """Reads one message after the other."""
        try:
            while (message := self._robot.receive(30)) is not None:
                if message["op"] == "ping":
                    self._robot.send(link.Pong(t=message["t"], at=1))
        except OSError:
            return


@contextmanager
def away(relay: Relay, proxy: ChaosProxy) -> Iterator[FakeRobot]:
    """The robot ``faraway`` behind a proxy."""
    with FakeRobot(proxy.port) as robot:
        assert robot.register("faraway", KEY)["op"] == "welcome"
        answering = Answering(robot)
        try:
            wait_for("it is online", lambda: relay.state_of("faraway") == "online")
            yield robot
        finally:
            with contextlib.suppress(OSError):  # the relay may have ended it
                robot.socket.shutdown(socket.SHUT_RDWR)
            answering.join(10)


@pytest.fixture
def relay(tmp_path: Any) -> Iterator[Relay]:
    """A relay that knows the robot ``faraway``."""
    running = Relay(tmp_path)
    try:
        code = running.cli("robot", "add", "faraway")["enrolment_code"]
        with FakeRobot(running.robots_port) as robot:
            assert robot.enroll("faraway", code, KEY)["op"] == "enrolled"
        yield running
    finally:
        running.stop()


@pytest.fixture
def proxy(relay: Relay) -> Iterator[ChaosProxy]:
    """The network between the robot and the relay."""
    made = ChaosProxy(relay.robots_port)
    yield made
    made.close()


def robot_link(relay: Relay) -> dict[str, Any]:
    """The link of the robot, as the administrator sees it."""
    (robot,) = relay.cli("status", "faraway")["robots"]
    return dict(robot["link"])


def next_status(client: Client) -> dict[str, Any]:
    """The next ``/relay/status``."""
    return dict(client.until(op="publish", topic="/relay/status")["msg"])


def reported(client: Client, part: str, quality: str) -> dict[str, Any]:
    """The first ``/relay/status`` with this quality for a part of the path."""

    def looked() -> dict[str, Any] | None:
        status = next_status(client)
        return status if status["links"][part]["quality"] == quality else None

    return dict(wait_for(f"{part} is told to be {quality}", looked))


def test_a_robot_that_is_far_away_is_seen_to_be(relay: Relay, proxy: ChaosProxy) -> None:
    """The rating follows the network from good to bad and back, with its numbers, for all readers."""
    ann = relay.user("ann")
    relay.cli("right", "grant", "ann", "faraway", "viewer")
    with away(relay, proxy), relay.connect("faraway", ann) as client:
        client.send(op="subscribe", topic="/relay/status")
        wait_for("the link is good", lambda: robot_link(relay)["quality"] == "good")
        near = reported(client, "client_robot", "good")["links"]
        assert near["client_relay"]["quality"] == near["relay_robot"]["quality"] == "good"
        assert near["client_robot"]["rtt_ms"] >= near["relay_robot"]["rtt_ms"]

        proxy.seconds_away = FAR
        wait_for("the link is bad", lambda: robot_link(relay)["quality"] == "bad")

        def seen_far() -> bool:
            """Once earlier values, and those of a stall of the machine, have left the window."""
            links = next_status(client)["links"]
            near, away = links["client_relay"]["quality"], links["client_robot"]["quality"]
            p95_ms = links["relay_robot"]["p95_ms"]
            return (near, away) == ("good", "bad") and 2000 * FAR <= (p95_ms or 0) < 2000 * FAR + 500

        wait_for("it is told how far it is", seen_far)
        (robot,) = ask(relay.http_port, "GET", "/api/v1/robots", token=ann).json["robots"]
        assert (robot["quality"], robot["people"]) == ("bad", 1)

        proxy.seconds_away = 0.0
        wait_for("the link is good again", lambda: robot_link(relay)["quality"] == "good")
        reported(client, "client_robot", "good")

        proxy.black_hole()
        wait_for("the link is lost", lambda: robot_link(relay)["quality"] in ("bad", "lost"))
        reported(client, "relay_robot", "lost")
        proxy.heal()


def test_connected_users_are_shown_to_users_with_the_right(relay: Relay, proxy: ChaosProxy) -> None:
    """Owners also see addresses; without a right the robot is not found."""
    ann, bob, eve = (relay.user(name) for name in ("ann", "bob", "eve"))
    relay.cli("right", "grant", "ann", "faraway", "owner")
    relay.cli("right", "grant", "bob", "faraway", "viewer")

    def people(token: str) -> Any:
        return ask(relay.http_port, "GET", "/api/v1/robots/faraway/people", token=token)

    with (
        away(relay, proxy),
        relay.connect("faraway", ann) as one,
        relay.connect("faraway", ann),
        relay.connect("faraway", bob),
    ):
        everybody = wait_for("all three are measured", lambda: _measured(people(ann).json, 3))
        assert [(each["user"], each["you"], len(each["connections"])) for each in everybody["people"]] == [
            ("ann", True, 2),
            ("bob", False, 1),
        ]
        assert _addresses(everybody) == {"127.0.0.1"}
        assert _addresses(people(bob).json) == {""}
        assert people(eve).status == 404
        one.send(op="subscribe", topic="/relay/status")
        mine = [
            each for person in next_status(one)["people"] for each in person["connections"] if each["you"]
        ]
        assert len(mine) == 1
    wait_for("all have left", lambda: people(ann).json["people"] == [])


def _addresses(reported: dict[str, Any]) -> set[str]:
    return {each["address"] for person in reported["people"] for each in person["connections"]}


def _measured(reported: dict[str, Any], count: int) -> dict[str, Any] | None:
    """The report, once this many connections have a round trip to the robot."""
    found = [each["robot_rtt_ms"] for person in reported["people"] for each in person["connections"]]
    return reported if len(found) == count and None not in found else None
