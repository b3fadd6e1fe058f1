"""The demo: its printed commands work, and no process or file is left."""

from __future__ import annotations

import contextlib
import json
import os
import re
import secrets
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import psutil
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from robot_client.modules import processes
from tests.worlds.file_modes import open_to_others
from tests.worlds.foxglove_apps import is_installed, saw_the_robot, visit
from tests.worlds.http_requests import ask, log_in
from tests.worlds.module_daemon_process import marked
from tests.worlds.processes import BIN, Process
from tests.worlds.sync_client import Client
from tests.worlds.waiting import PATIENCE, wait_for

TD_SCHEMA = (
    Path(__file__).parent
    / "clients/node_modules/wot-thing-description-types/schema/td-json-schema-validation.json"
)
ODOMETRY = {"topic": "/odom", "type": "nav_msgs/msg/Odometry"}


@contextlib.contextmanager
def demo_in(folder: Path, option: str) -> Iterator[Process]:
    """``switchboard demo`` on a data folder; killed with all its children at the end if needed."""
    command = [sys.executable, str(BIN / "switchboard"), "demo", "--data", str(folder / "demo"), option]
    demo = Process(command, folder, "demo")
    try:
        yield demo
    finally:
        if demo.popen.poll() is None:
            family = psutil.Process(demo.popen.pid).children(recursive=True)
            # Modules outlive a daemon that was killed.
            for each in psutil.process_iter(["cmdline"]):
                if str(folder) in " ".join(each.info["cmdline"] or []):
                    with contextlib.suppress(psutil.NoSuchProcess):
                        family += [each, *each.children(recursive=True)]
            for each in family:
                with contextlib.suppress(psutil.NoSuchProcess):
                    each.kill()
            demo.kill()


def test_the_demo_works_for_all_three_logins_and_leaves_nothing_behind(tmp_path: Path) -> None:
    """READY, three passwords that work, rights as printed; Ctrl-C ends every process."""
    with demo_in(tmp_path, "--home") as demo:
        url = demo.wait_to_say("READY http").split()[1]
        port = int(url.rpartition(":")[2])
        logins = dict(re.findall(r"^  (admin|driver|viewer) +(\S+)   ", demo.said(), re.MULTILINE))
        cookies = {user: log_in(port, user, password) for user, password in logins.items()}
        assert set(cookies) == {"admin", "driver", "viewer"}
        seen = {user: robots_of(port, cookie) for user, cookie in cookies.items()}
        assert seen["driver"] == {"robot-one": "operator", "home": "operator"}
        assert seen["viewer"] == {"robot-one": "viewer", "robot-two": "viewer", "home": "viewer"}
        assert set(seen["admin"]) == {"robot-one", "robot-two", "home"}
        described_as_things(port, cookies["admin"])
        wait_for(
            "the admin sees modules run",
            lambda: (
                running_modules(port, cookies["admin"])
                == {"base", "battery", "obstacles", "speech", "navigator", "targets"}
            ),
        )
        crashes_and_comes_back(port, cookies["admin"], "base")
        for name in ("commands", "gps", "markers"):
            starts(port, cookies["admin"], name)
        daemon_comes_back(demo, port, cookies["admin"])
        opens_in_foxglove(tmp_path / "demo", url)
        operates_by_foxglove(tmp_path / "demo", url)
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
        assert robots_of(port, log_in(port, "driver", logins["driver"])) == {"home": "operator"}
        assert "login" in administer(tmp_path / "demo", "audit", "list", "--json")
        assert len(psutil.Process(demo.popen.pid).children(recursive=True)) >= 4
        end_all(demo)
    left = [
        each.info["cmdline"]
        for each in psutil.process_iter(["cmdline"])
        if str(tmp_path) in " ".join(each.info["cmdline"] or [])
    ]
    assert left == []
    assert open_to_others(tmp_path / "demo") == {}
    log = (tmp_path / "demo" / "relay.log").read_text()
    assert "Traceback" not in log + demo.log.read_text()
    assert not any(password in log for password in logins.values())


def test_the_demo_of_a_cluster_goes_on_without_one_relay(tmp_path: Path) -> None:
    """A robot is driven through a relay that is not its home; its home is killed, and it is driven again."""
    with demo_in(tmp_path, "--cluster") as demo:
        demo.wait_to_say("READY http")
        said = demo.said()
        ports = dict(re.findall(r"^  (relay-\w+) +http://127.0.0.1:(\d+)", said, re.MULTILINE))
        home = int(re.findall(r"^  relay-two .* kill -9 (\d+)$", said, re.MULTILINE)[0])
        password = re.findall(r"^  driver +(\S+) ", said, re.MULTILINE)[0]
        port = int(ports["relay-one"])
        cookie = log_in(port, "driver", password)
        assert robots_of(int(ports["relay-three"]), cookie) == {"robot-one": "operator"}
        with enter(port, cookie, "robot-one") as client:
            moves_in_odometry(client)
            psutil.Process(home).kill()
            with pytest.raises(ConnectionClosed, match="connect again"):
                while True:
                    client.receive()
        wait_for("the robot is driven again", lambda: drives(port, cookie))
        end_all(demo)
    assert open_to_others(tmp_path / "demo") == {}


def test_a_demo_that_is_ended_while_it_starts_leaves_nothing_running(tmp_path: Path) -> None:
    """SIGTERM when PostgreSQL runs and NATS is about to."""
    run = secrets.token_hex(8)
    command = [
        sys.executable,
        str(BIN / "switchboard"),
        "demo",
        "--data",
        str(tmp_path / "demo"),
        "--cluster",
    ]
    demo = Process(command, tmp_path, "demo", env={**os.environ, processes.MARK: run})
    try:
        demo.wait_to_say("… starting NATS")
        demo.signal(signal.SIGTERM)
        demo.popen.wait(PATIENCE)
        assert marked(run) == []
        assert "Traceback" not in demo.log.read_text()
    finally:
        processes.send(marked(run), signal.SIGKILL)
        demo.kill()


def end_all(demo: Process) -> None:
    """Ctrl-C ends the demo and every process that it started."""
    family = psutil.Process(demo.popen.pid).children(recursive=True)
    demo.signal(signal.SIGINT)
    _, alive = psutil.wait_procs(family, timeout=PATIENCE)
    assert demo.popen.wait(PATIENCE) == 0
    assert alive == []


def administer(data: Path, *arguments: str) -> str:
    """Runs an administrator's command beside the relay; returns its output."""
    command = [str(BIN / "switchboard"), "--data", str(data), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout


def foxglove_url(data: Path, relay: str, user: str, *options: str) -> str:
    """A new URL for the first robot."""
    return administer(data, "foxglove-url", "create", "robot-one", user, "--relay", relay, *options).strip()


def opens_in_foxglove(data: Path, relay: str) -> None:
    """The apps' client reads every channel of the first robot by its URL, with the definitions of the
    installed packages. It may change nothing.
    """
    url = foxglove_url(data, relay, "viewer")
    seen = visit(url, "", "foxglove.sdk.v1")
    saw_the_robot(seen)
    assert "clientPublish" not in seen["info"]["capabilities"]
    assert "/reset" not in seen["services"]
    assert seen["parameters"] == 0
    refused_by_foxglove(url)
    channels = [each for each in seen["channels"] if each["encoding"] == "cdr"]
    assert len(channels) > 10
    share = Path(sys.prefix) / "share"
    assert [
        each["topic"] for each in channels if not is_installed(each["schema"], each["schemaName"], share)
    ] == []


def refused_by_foxglove(url: str) -> None:
    """A viewer's URL neither publishes nor sets a parameter, also for a driver who may do both."""
    with connect(url, subprotocols=[Subprotocol("foxglove.sdk.v1")], open_timeout=PATIENCE) as client:
        channel = {"id": 1, "topic": "/cmd_vel", "encoding": "json", "schemaName": "geometry_msgs/Twist"}
        client.send(json.dumps({"op": "advertise", "channels": [channel]}))
        parameter = {"name": "/base.max_speed", "value": 0.1, "type": "float64"}
        client.send(json.dumps({"op": "setParameters", "parameters": [parameter]}))
        missing = {"channel:1", "parameters-set:/base"}
        while missing:
            message = client.recv(PATIENCE)
            status = json.loads(message) if isinstance(message, str) else {}
            if status.get("op") == "status" and status["level"] == 2:
                missing.discard(status.get("id"))


def operates_by_foxglove(data: Path, relay: str) -> None:
    """By a driver's URL the apps' client publishes, calls a service and sets a parameter."""
    refused_by_foxglove(foxglove_url(data, relay, "driver"))
    seen = visit(foxglove_url(data, relay, "driver", "--level", "operator"), "", "foxglove.sdk.v1")
    assert [seen["moved"], seen["stopped"]] == [True, True]
    assert [seen["answers"][0]["success"], seen["answers"][2]["success"]] == [True, True]
    assert seen["set"] == [{"name": seen["speed"]["name"], "value": 1, "type": "float64"}]
    assert seen["back"] == [seen["speed"]]


def described_as_things(port: int, cookie: str) -> None:
    """The Thing Descriptions of all robots and of the home's devices are valid by W3C's own schema."""
    schema = json.loads(TD_SCHEMA.read_text())
    things = ask(port, "GET", "/api/v1/things", headers={"Cookie": cookie}).json
    assert [each["title"] for each in things] == ["home", "robot-one", "robot-two"]
    for each in things:
        jsonschema.validate(each, schema, jsonschema.Draft7Validator)
        assert each["properties"], each["title"]


def module_of(port: int, cookie: str, name: str) -> dict[str, Any]:
    """A module of the first robot."""
    path = f"/api/v1/robots/robot-one/modules/{name}"
    return dict(ask(port, "GET", path, headers={"Cookie": cookie}).json)


def crashes_and_comes_back(port: int, cookie: str, name: str) -> None:
    """A module that is killed is started again."""
    pid = module_of(port, cookie, name)["pid"]
    psutil.Process(pid).kill()

    def is_back() -> bool:
        found = module_of(port, cookie, name)
        return bool(found["state"] == "running" and found["pid"] != pid and found["restarts"] == 1)

    wait_for(f"{name} is back", is_back)


def starts(port: int, cookie: str, name: str) -> None:
    headers = {"Cookie": cookie, "Origin": f"http://127.0.0.1:{port}"}
    ordered = ask(port, "POST", f"/api/v1/robots/robot-one/modules/{name}/start", headers=headers)
    assert ordered.status == 202, ordered.body
    wait_for(f"{name} runs", lambda: module_of(port, cookie, name)["state"] == "running")


def daemon_comes_back(demo: Process, port: int, cookie: str) -> None:
    """The first robot's daemon is killed; it is started again, and its modules have gone on."""
    before = module_of(port, cookie, "base")["pid"]
    (daemon,) = (
        each for each in psutil.Process(demo.popen.pid).children() if "robot-one" in " ".join(each.cmdline())
    )
    daemon.kill()
    wait_for("its end is noticed", lambda: "robot-one-daemon has ended" in demo.said())
    wait_for("it is online again", lambda: (module_of(port, cookie, "base") or {}).get("pid") == before)


def running_modules(port: int, cookie: str) -> set[str]:
    """Names of the modules of the first robot that run."""
    found = ask(port, "GET", "/api/v1/robots/robot-one/modules", headers={"Cookie": cookie}).json
    return {each["name"] for each in found["modules"] if each["state"] == "running"}


def robots_of(port: int, cookie: str) -> dict[str, str]:
    """Names and levels of the robots a session sees; all are online."""

    def seen() -> Any:
        robots = ask(port, "GET", "/api/v1/robots", headers={"Cookie": cookie}).json["robots"]
        return [robots] if all(each["state"] != "offline" for each in robots) else None

    (robots,) = wait_for("all are online", seen)
    return {each["name"]: each["level"] for each in robots}


def enter(port: int, cookie: str, robot: str) -> Client:
    """Opens a websocket with a session's cookie."""
    url, origin = f"ws://127.0.0.1:{port}/robots/{robot}", f"http://127.0.0.1:{port}"
    return Client(connect(url, additional_headers={"Cookie": cookie}, origin=origin, open_timeout=PATIENCE))


def moves_in_odometry(client: Client) -> None:
    """The robot's odometry has a speed while it is driven."""
    client.send(op="subscribe", **ODOMETRY)
    client.send(op="advertise", topic="/cmd_vel", type="geometry_msgs/msg/Twist")

    def moving() -> bool:
        client.drive(0.2, 0.6)
        return bool(client.until(op="publish", topic="/odom")["msg"]["twist"]["twist"]["linear"]["x"] > 0.05)

    wait_for("the robot moves", moving)


def drives(port: int, cookie: str) -> bool:
    """Whether the robot can be reached, and moves after the controls were released."""
    try:
        with enter(port, cookie, "robot-one") as client:
            client.drive(0.0)
            moves_in_odometry(client)
    except (ConnectionClosed, InvalidStatus):
        return False
    return True
