"""Stopping, dying and coming back: of relays and of robots; two relays on one host; PostgreSQL."""

from __future__ import annotations

import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pgserver
import psutil
import psycopg
import pytest
from switchboard_client import Client
from switchboard_drive import LET_GO_SECONDS, understood
from switchboard_http import ask, log_in
from switchboard_processes import Process, running
from switchboard_pulse import Pulse
from switchboard_relay import Relay
from switchboard_robot import Robot
from switchboard_threads import Driver
from switchboard_waiting import wait_for
from websockets.exceptions import ConnectionClosed, InvalidStatus

CLIENTS = Path(__file__).parent / "clients"
PASSWORD = "correct horse"
ODOMETRY = {"topic": "/odom", "type": "nav_msgs/msg/Odometry"}


class House:
    """A relay on a fixed port with a robot and its people."""

    def __init__(self, folder: Path) -> None:
        self.relay = Relay(folder, "--heartbeat", "0.5")
        self.robot = Robot(self.relay, "rover")
        self.driver = self.relay.user("driver")
        self.viewer = self.relay.user("viewer")
        self.relay.cli("right", "grant", "driver", "rover", "operator")
        self.relay.cli("right", "grant", "viewer", "rover", "viewer")

    def restart(self) -> None:
        """A killed or stopped relay again, on the same ports."""
        self.relay.start()
        self.robot.wait_online()

    def stop(self) -> None:
        """End everything."""
        self.robot.stop()
        self.relay.stop()


@pytest.fixture(scope="module")
def house(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    """One house for all; each test leaves it whole."""
    house = House(tmp_path_factory.mktemp("house"))
    try:
        yield house
    finally:
        house.stop()


def close_of(client: Client) -> Any:
    """Read until the other end closes; the close frame."""
    with pytest.raises(ConnectionClosed) as closed:
        while True:
            client.receive()
    assert closed.value.rcvd is not None
    return closed.value.rcvd


def drives(relay: Relay, robot: Robot, token: str) -> None:
    """An operator makes the robot move, and lets go of it."""
    driver = Driver(relay.connect(robot.name, token))
    driver.begin_with_a_pause(LET_GO_SECONDS)
    driver.start()
    try:
        understood(driver, robot)
    finally:
        driver.stop()
    wait_for("the robot stands", lambda: not robot.moving())


# --- the relay --------------------------------------------------------------------------------------------


def test_a_relay_that_is_ended_says_goodbye_and_leaves_the_robot_standing(house: House) -> None:
    """SIGTERM: clients get 1001 in words, the exit code is 0 within ten seconds, the driven robot stands."""
    driver = Driver(house.relay.connect("rover", house.driver))
    driver.start()
    wait_for("the robot moves", house.robot.moving)
    with house.relay.connect("rover", house.viewer) as client:
        client.send(op="subscribe", **ODOMETRY)
        client.until(op="publish")
        with Pulse() as pulse:
            begun = time.monotonic()
            assert house.relay.stop() == 0
            assert time.monotonic() - begun < 10 + pulse.lost()
        farewell = close_of(client)
        assert farewell.code == 1001
        assert "going down" in farewell.reason
    wait_for("the robot stands", lambda: not house.robot.moving())
    driver.stop()
    assert "Traceback" not in house.relay.log
    house.restart()
    assert not house.robot.moving()
    drives(house.relay, house.robot, house.driver)


def test_a_killed_relay_comes_back_with_sessions_tokens_rights_and_robots(house: House) -> None:
    """After kill -9 a new process has all that was acknowledged; the robot is back by itself."""
    cookie = log_in(house.relay.http_port, "driver", PASSWORD)
    house.relay.cli("right", "grant", "viewer", "rover", "operator")
    house.relay.kill()
    house.relay.start()
    assert house.relay.process is not None
    used = psutil.Process(house.relay.process.popen.pid).cpu_times()
    # On an idle machine this is the time until READY.
    assert used.user + used.system < 3
    house.robot.wait_online()
    session = ask(house.relay.http_port, "GET", "/api/v1/session", headers={"Cookie": cookie})
    assert session.json["user"] == "driver"
    with house.relay.connect("rover", house.viewer) as client:
        wait_for("the robot answers a call", lambda: client.call("/reset")["result"])
    house.relay.cli("right", "grant", "viewer", "rover", "viewer")
    drives(house.relay, house.robot, house.driver)


@pytest.mark.parametrize("what", ["right", "token", "user"])
def test_what_was_revoked_before_a_kill_stays_revoked(house: House, what: str) -> None:
    """A revocation is in the database before anybody is told, so no kill -9 can undo it."""
    name = f"leaver-{what}"
    token = house.relay.user(name)
    house.relay.cli("right", "grant", name, "rover", "operator")
    numbers = [str(each["id"]) for each in house.relay.cli("token", "list", "--user", name)]
    revoke = {
        "right": ["right", "revoke", name, "rover"],
        "token": ["token", "revoke", *numbers],
        "user": ["user", "disable", name],
    }
    with house.relay.connect("rover", token) as client:
        assert client.call("/relay/ping")["result"]
        done = house.relay.run_cli(*revoke[what])
        house.relay.kill()
    house.restart()
    assert done.returncode == 0, done.stderr
    with pytest.raises(InvalidStatus) as refused:
        house.relay.connect("rover", token)
    assert refused.value.response.status_code == (403 if what == "right" else 401)


def test_an_unmodified_client_program_goes_on_after_the_relay_was_restarted(house: House) -> None:
    """roslibpy reconnects by itself and gets its topic again, with a restart and with a kill -9."""
    command = [sys.executable, str(CLIENTS / "reconnecting.py"), house.relay.url("rover"), house.viewer]
    client = Process(command, house.relay.folder, "reconnecting")
    try:
        client.wait_to_say("ODOMETRY 0")
        house.relay.stop()
        house.restart()
        client.wait_to_say("ODOMETRY 1")
        house.relay.kill()
        house.restart()
        client.wait_to_say("ODOMETRY 2")
    finally:
        client.stop()


# --- the robot --------------------------------------------------------------------------------------------


def test_a_client_stays_while_its_robot_is_away_and_goes_on_when_it_is_back(house: House) -> None:
    """Robot offline: the connection stays, a call is answered in words, the subscription continues by itself."""
    with house.relay.connect("rover", house.driver) as client:
        client.send(op="set_level", level="error")
        client.send(op="subscribe", **ODOMETRY)
        client.until(op="publish")
        house.robot.daemon.kill()
        wait_for("it is offline", lambda: house.relay.state_of("rover") == "offline")
        answer = client.call("/reset")
        assert answer["result"] is False
        assert "offline" in answer["values"]
        client.drive(0.2)
        assert "offline" in client.until(op="status")["msg"]
        back = time.time()
        house.robot.start_daemon()
        house.robot.wait_online()

        def fresh() -> bool:
            stamp = client.until(op="publish", topic="/odom")["msg"]["header"]["stamp"]
            return bool(stamp["sec"] >= int(back))

        wait_for("odometry comes again", fresh)
        wait_for("the robot answers a call", lambda: client.call("/reset")["result"])
    drives(house.relay, house.robot, house.driver)


def test_a_call_under_way_is_answered_when_the_robot_is_lost(house: House) -> None:
    """Who waits for an answer gets words as soon as the robot is gone, not the end of a timeout."""
    with house.relay.connect("rover", house.driver) as client:
        wait_for("the robot answers a call", lambda: client.call("/reset")["result"])
        house.robot.daemon.freeze()
        try:
            with Pulse() as pulse:
                begun = time.monotonic()
                answer = client.call("/reset")
                assert time.monotonic() - begun < 15 + pulse.lost()
            assert answer["result"] is False
            assert answer["values"]
        finally:
            house.robot.daemon.signal(signal.SIGCONT)
            house.robot.wait_online()
        wait_for("it answers again", lambda: client.call("/reset")["result"])


def test_two_relays_live_side_by_side_on_one_host(house: House, tmp_path: Path) -> None:
    """Each has its robots and its people; what opens one opens nothing at the other."""
    other = Relay(tmp_path)
    with running(other):
        robot = Robot(other, "rover")
        with running(robot):
            token = other.user("driver")
            other.cli("right", "grant", "driver", "rover", "operator")
            for relay, foreign in ((other, house.driver), (house.relay, token)):
                with pytest.raises(InvalidStatus) as refused:
                    relay.connect("rover", foreign)
                assert refused.value.response.status_code == 401
            moved = len(house.robot.events("moving"))
            drives(other, robot, token)
            assert len(house.robot.events("moving")) == moved
            drives(house.relay, house.robot, house.driver)
            # Browsers send both: cookies know no ports.
            both = [log_in(relay.http_port, "driver", PASSWORD) for relay in (other, house.relay)]
            for relay in (other, house.relay):
                session = ask(relay.http_port, "GET", "/api/v1/session", headers={"Cookie": "; ".join(both)})
                assert session.status == 200


def test_a_robot_that_is_removed_is_cut_and_forgotten(tmp_path: Path) -> None:
    """The command line removes it: its link ends, nobody sees it any more, and its key opens nothing."""
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
    """URL of an empty database on a PostgreSQL server of our own.

    Not in pytest's folder, which other users can't enter: under root the server is another user's.
    """
    folder = Path(tempfile.mkdtemp(prefix="pg-of-e2e-"))
    server = pgserver.get_server(folder / "data", cleanup_mode="stop")
    try:
        with psycopg.connect(server.get_uri(), autocommit=True) as connection:
            connection.execute('CREATE DATABASE "relay"')
        yield server.get_uri().replace("/postgres?", "/relay?")
    finally:
        server.cleanup()
        shutil.rmtree(folder, ignore_errors=True)


def test_a_relay_on_postgresql_does_the_daily_round(postgres: str, tmp_path: Path) -> None:
    """Enroll, watch, drive, revoke within a second, kill and restart: all of it on PostgreSQL."""
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
                with Pulse() as pulse:
                    begun = time.monotonic()
                    with pytest.raises(ConnectionClosed) as closed:
                        while True:
                            client.receive()
                    assert time.monotonic() - begun < 1 + pulse.lost()
                # Who reads so late on a busy machine that the relay gives up waiting for his answer sees no frame.
                assert closed.value.rcvd is None or closed.value.rcvd.code == 4403
            assert "is cut: your right on this robot was revoked" in relay.log
            assert not (relay.data / "switchboard.db").exists()
    assert "Traceback" not in relay.log
    assert "postgres" not in relay.log
