"""Relays and robots that stop, crash and return; two relays on one host; PostgreSQL."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus

from tests.worlds.client_threads import Driver
from tests.worlds.driving import LET_GO_SECONDS, understood
from tests.worlds.http_requests import ask, log_in
from tests.worlds.postgresql_server import postgresql_database
from tests.worlds.processes import Process, running
from tests.worlds.relay_process import Relay
from tests.worlds.robot_process import Robot
from tests.worlds.sync_client import Client
from tests.worlds.waiting import PATIENCE, wait_for

CLIENTS = Path(__file__).parent / "clients"
PASSWORD = "correct horse"
ODOMETRY = {"topic": "/odom", "type": "nav_msgs/msg/Odometry"}


class World:
    """A relay on a fixed port with a robot and its users."""

    def __init__(self, folder: Path) -> None:
        self.relay = Relay(folder, "--heartbeat", "0.5")
        self.robot = Robot(self.relay, "rover")
        self.driver = self.relay.user("driver")
        self.viewer = self.relay.user("viewer")
        self.relay.cli("right", "grant", "driver", "rover", "operator")
        self.relay.cli("right", "grant", "viewer", "rover", "viewer")

    def restart(self) -> None:
        """Starts a killed or stopped relay again, on the same ports."""
        self.relay.start()
        self.robot.wait_online()

    def stop(self) -> None:
        self.robot.stop()
        self.relay.stop()


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """One world for all; each test leaves it intact."""
    world = World(tmp_path_factory.mktemp("world"))
    try:
        yield world
    finally:
        world.stop()


def close_of(client: Client) -> Any:
    """Reads until the peer closes; returns the close frame."""
    with pytest.raises(ConnectionClosed) as closed:
        while True:
            client.receive()
    assert closed.value.rcvd is not None
    return closed.value.rcvd


def drives(relay: Relay, robot: Robot, token: str) -> None:
    """An operator moves the robot, and releases it."""
    driver = Driver(relay.connect(robot.name, token))
    driver.begin_with_a_pause(LET_GO_SECONDS)
    driver.start()
    try:
        understood(driver, robot)
    finally:
        driver.stop()
    wait_for("the robot stands", lambda: not robot.moving())


# --- the relay --------------------------------------------------------------------------------------------


def test_a_relay_that_is_stopped_closes_clients_and_leaves_the_robot_standing(world: World) -> None:
    """SIGTERM: clients get 1001 with a reason, the exit code is 0, the driven robot stands."""
    driver = Driver(world.relay.connect("rover", world.driver))
    driver.start()
    wait_for("the robot moves", world.robot.moving)
    with world.relay.connect("rover", world.viewer) as client:
        client.send(op="subscribe", **ODOMETRY)
        client.until(op="publish")
        assert world.relay.stop() == 0
        farewell = close_of(client)
        assert farewell.code == 1001
        assert "going down" in farewell.reason
    wait_for("the robot stands", lambda: not world.robot.moving())
    driver.stop()
    assert "Traceback" not in world.relay.log
    world.restart()
    assert not world.robot.moving()
    drives(world.relay, world.robot, world.driver)


def test_a_killed_relay_comes_back_with_sessions_tokens_rights_and_robots(world: World) -> None:
    """After kill -9 a new process has all acknowledged changes; the robot reconnects by itself."""
    cookie = log_in(world.relay.http_port, "driver", PASSWORD)
    world.relay.cli("right", "grant", "viewer", "rover", "operator")
    world.relay.kill()
    world.relay.start()
    world.robot.wait_online()
    session = ask(world.relay.http_port, "GET", "/api/v1/session", headers={"Cookie": cookie})
    assert session.json["user"] == "driver"
    with world.relay.connect("rover", world.viewer) as client:
        wait_for("the robot answers a call", lambda: client.call("/reset")["result"])
    world.relay.cli("right", "grant", "viewer", "rover", "viewer")
    drives(world.relay, world.robot, world.driver)


@pytest.mark.parametrize("what", ["right", "token", "user"])
def test_revocation_survives_a_kill(world: World, what: str) -> None:
    """A revocation is committed before it is confirmed, so kill -9 cannot undo it."""
    name = f"leaver-{what}"
    token = world.relay.user(name)
    world.relay.cli("right", "grant", name, "rover", "operator")
    numbers = [str(each["id"]) for each in world.relay.cli("token", "list", "--user", name)]
    revoke = {
        "right": ["right", "revoke", name, "rover"],
        "token": ["token", "revoke", *numbers],
        "user": ["user", "disable", name],
    }
    with world.relay.connect("rover", token) as client:
        assert client.call("/relay/ping")["result"]
        done = world.relay.run_cli(*revoke[what])
        world.relay.kill()
    world.restart()
    assert done.returncode == 0, done.stderr
    with pytest.raises(InvalidStatus) as refused:
        world.relay.connect("rover", token)
    assert refused.value.response.status_code == (403 if what == "right" else 401)


def test_an_unmodified_client_program_goes_on_after_the_relay_was_restarted(world: World) -> None:
    """roslibpy reconnects by itself and gets its topic again, after a restart and after kill -9."""
    command = [sys.executable, str(CLIENTS / "reconnecting.py"), world.relay.url("rover"), world.viewer]
    client = Process(command, world.relay.folder, "reconnecting")
    try:
        client.wait_to_say("ODOMETRY 0")
        world.relay.stop()
        world.restart()
        client.wait_to_say("ODOMETRY 1")
        world.relay.kill()
        world.restart()
        client.wait_to_say("ODOMETRY 2")
    finally:
        client.stop()


# --- the robot --------------------------------------------------------------------------------------------


def test_a_client_stays_while_its_robot_is_away_and_goes_on_when_it_is_back(world: World) -> None:
    """The connection stays, a call is answered with a reason, and the subscription continues by itself."""
    with world.relay.connect("rover", world.driver) as client:
        client.send(op="set_level", level="error")
        client.send(op="subscribe", **ODOMETRY)
        client.until(op="publish")
        world.robot.daemon.kill()
        wait_for("it is offline", lambda: world.relay.state_of("rover") == "offline")
        answer = client.call("/reset")
        assert answer["result"] is False
        assert "offline" in answer["values"]
        client.drive(0.2)
        assert "offline" in client.until(op="status")["msg"]
        back = time.time()
        world.robot.start_daemon()
        world.robot.wait_online()

        def fresh() -> bool:
            stamp = client.until(op="publish", topic="/odom")["msg"]["header"]["stamp"]
            return bool(stamp["sec"] >= int(back))

        wait_for("odometry comes again", fresh)
        wait_for("the robot answers a call", lambda: client.call("/reset")["result"])
    drives(world.relay, world.robot, world.driver)


def test_a_call_under_way_is_answered_when_the_robot_is_lost(world: World) -> None:
    """The caller gets a reason as soon as the robot is lost, not at the timeout."""
    with world.relay.connect("rover", world.driver) as client:
        wait_for("the robot answers a call", lambda: client.call("/reset")["result"])
        world.robot.daemon.freeze()
        try:
            client.send(op="call_service", id="under way", service="/reset", timeout=10 * PATIENCE)
            answer = client.until(op="service_response", id="under way")
            assert answer["result"] is False
            assert "lost" in answer["values"]
        finally:
            world.robot.daemon.signal(signal.SIGCONT)
            world.robot.wait_online()
        wait_for("it answers again", lambda: client.call("/reset")["result"])


def test_two_relays_live_side_by_side_on_one_host(world: World, tmp_path: Path) -> None:
    """Each has its own robots and users; credentials of one are refused by the other."""
    other = Relay(tmp_path)
    with running(other):
        robot = Robot(other, "rover")
        with running(robot):
            token = other.user("driver")
            other.cli("right", "grant", "driver", "rover", "operator")
            for relay, foreign in ((other, world.driver), (world.relay, token)):
                with pytest.raises(InvalidStatus) as refused:
                    relay.connect("rover", foreign)
                assert refused.value.response.status_code == 401
            moved = len(world.robot.events("moving"))
            drives(other, robot, token)
            assert len(world.robot.events("moving")) == moved
            drives(world.relay, world.robot, world.driver)
            # Browsers send both: cookies ignore ports.
            both = [log_in(relay.http_port, "driver", PASSWORD) for relay in (other, world.relay)]
            for relay in (other, world.relay):
                session = ask(relay.http_port, "GET", "/api/v1/session", headers={"Cookie": "; ".join(both)})
                assert session.status == 200


def test_a_robot_that_is_removed_is_cut_and_forgotten(tmp_path: Path) -> None:
    """The command line removes it: its link ends, it is in no list, and its key is refused."""
    relay = Relay(tmp_path)
    robot = Robot(relay, "rover")
    try:
        relay.cli("robot", "remove", "rover", "--yes")
        wait_for("the robot is forgotten", lambda: relay.cli("status")["robots"] == [])
        wait_for("it is told", lambda: "not accepted" in robot.daemon.log.read_text())
        assert relay.cli("status")["robots"] == []
    finally:
        robot.stop()
        relay.stop()


# --- PostgreSQL -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def postgres() -> Iterator[str]:
    """URL of an empty database on a new PostgreSQL server."""
    with postgresql_database() as url:
        yield url


def test_a_relay_on_postgresql_does_the_daily_round(postgres: str, tmp_path: Path) -> None:
    """Enrol, view, drive, revoke within a second, kill and restart, all on PostgreSQL."""
    relay = Relay(tmp_path, database=postgres)
    with running(relay):
        robot = Robot(relay, "rover")
        with running(robot):
            token = relay.user("driver")
            relay.cli("right", "grant", "driver", "rover", "operator")
            drives(relay, robot, token)
            relay.kill()
            relay.start()
            robot.wait_online()
            with relay.connect("rover", token) as client:
                client.send(op="subscribe", **ODOMETRY)
                client.until(op="publish")
                relay.run_cli("right", "revoke", "driver", "rover").check_returncode()
                with pytest.raises(ConnectionClosed) as closed:
                    while True:
                        client.receive()
                # A client that reads too late on a busy machine gets no close frame.
                assert closed.value.rcvd is None or closed.value.rcvd.code == 4403
            assert "is cut: your right on this robot was revoked" in relay.log
            assert not (relay.data / "switchboard.db").exists()
    assert "Traceback" not in relay.log
    assert "postgres" not in relay.log
