"""The demo: what it prints opens what it says, and it leaves nothing behind."""

from __future__ import annotations

import contextlib
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
from switchboard_client import Client
from switchboard_http import ask, log_in
from switchboard_processes import BIN, Process
from switchboard_pulse import Pulse
from switchboard_waiting import PATIENCE, wait_for
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

ODOMETRY = {"topic": "/odom", "type": "nav_msgs/msg/Odometry"}


@contextlib.contextmanager
def demo_in(folder: Path) -> Iterator[Process]:
    """``switchboard demo`` on a data folder, killed with all its children at the end, if need be."""
    command = [sys.executable, str(BIN / "switchboard"), "demo", "--data", str(folder / "demo")]
    demo = Process(command, folder, "demo")
    try:
        yield demo
    finally:
        if demo.popen.poll() is None:
            for each in psutil.Process(demo.popen.pid).children(recursive=True):
                each.kill()
            demo.kill()


def test_the_demo_works_for_all_three_logins_and_leaves_nothing_behind(tmp_path: Path) -> None:
    """READY, three passwords that work, rights as printed; Ctrl-C ends every process within five seconds."""
    with demo_in(tmp_path) as demo:
        url = demo.wait_to_say("READY http").split()[1]
        port = int(url.rpartition(":")[2])
        logins = dict(re.findall(r"^  (admin|driver|viewer) +(\S+)   ", demo.said(), re.MULTILINE))
        cookies = {user: log_in(port, user, password) for user, password in logins.items()}
        assert set(cookies) == {"admin", "driver", "viewer"}
        seen = {user: robots_of(port, cookie) for user, cookie in cookies.items()}
        assert seen["driver"] == {"robot-one": "operator"}
        assert seen["viewer"] == {"robot-one": "viewer", "robot-two": "viewer"}
        assert set(seen["admin"]) == {"robot-one", "robot-two"}
        with enter(port, cookies["viewer"], "robot-two") as client:
            client.send(op="set_level", level="error")
            client.drive(0.2)
            assert "needs the level operator" in client.until(op="status")["msg"]
            client.send(op="subscribe", **ODOMETRY)
            assert client.until(op="publish")["msg"]["twist"]["twist"]["linear"]["x"] == 0
        with enter(port, cookies["driver"], "robot-one") as client:
            moves_in_odometry(client)
            administer(tmp_path / "demo", "user", "list")
            administer(tmp_path / "demo", "right", "revoke", "driver", "robot-one")
            with pytest.raises(ConnectionClosed):
                while True:
                    client.receive()
        assert robots_of(port, log_in(port, "driver", logins["driver"])) == {}
        assert "login" in administer(tmp_path / "demo", "audit", "list", "--json")
        family = [
            psutil.Process(demo.popen.pid),
            *psutil.Process(demo.popen.pid).children(recursive=True),
        ]
        assert len(family) >= 5
        with Pulse() as pulse:
            begun = time.monotonic()
            demo.signal(signal.SIGINT)
            _, alive = psutil.wait_procs(family[1:], timeout=PATIENCE)
            assert demo.popen.wait(PATIENCE) == 0
            took = time.monotonic() - begun
            assert alive == []
            assert took < 5 + pulse.lost(), f"it took {took:.1f} s"
    left = [
        each.info["cmdline"]
        for each in psutil.process_iter(["cmdline"])
        if str(tmp_path) in " ".join(each.info["cmdline"] or [])
    ]
    assert left == []
    log = (tmp_path / "demo" / "relay.log").read_text()
    assert "Traceback" not in log + demo.log.read_text()
    assert not any(password in log for password in logins.values())


def administer(data: Path, *arguments: str) -> str:
    """An admin command on a folder whose relay runs; what it prints."""
    command = [str(BIN / "switchboard"), "--data", str(data), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout


def robots_of(port: int, cookie: str) -> dict[str, str]:
    """Names and levels of the robots a session sees; all are online."""

    def seen() -> Any:
        robots = ask(port, "GET", "/api/v1/robots", headers={"Cookie": cookie}).json["robots"]
        return [robots] if all(each["state"] != "offline" for each in robots) else None

    (robots,) = wait_for("all are online", seen)
    return {each["name"]: each["level"] for each in robots}


def enter(port: int, cookie: str, robot: str) -> Client:
    """A websocket with a session's cookie."""
    url, origin = f"ws://127.0.0.1:{port}/robots/{robot}", f"http://127.0.0.1:{port}"
    return Client(connect(url, additional_headers={"Cookie": cookie}, origin=origin, open_timeout=PATIENCE))


def moves_in_odometry(client: Client) -> None:
    """The robot's odometry tells speed while it is driven."""
    client.send(op="subscribe", **ODOMETRY)
    client.send(op="advertise", topic="/cmd_vel", type="geometry_msgs/msg/Twist")

    def moving() -> bool:
        client.drive(0.2, 0.6)
        return bool(client.until(op="publish", topic="/odom")["msg"]["twist"]["twist"]["linear"]["x"] > 0.05)

    wait_for("the robot moves", moving)
