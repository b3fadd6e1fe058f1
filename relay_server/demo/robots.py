"""The simulated robots of the demo: their daemons, which start the rest as modules."""

from __future__ import annotations

import importlib.util
import json
import os
import random
import socket
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from relay_db import queries
from relay_db.engine import Database
from relay_protocol.errors import Unavailable
from relay_server.auth import passwords
from relay_server.demo.home import HOME, start_home
from relay_server.demo.processes import DemoProcesses, command_path

ROBOTS = ("robot-one", "robot-two")
ENROL_SECONDS = 60.0
DOMAINS = range(1, 100)
"""ROS domains whose ports are below Linux's ephemeral range (docs.ros.org, "The ROS_DOMAIN_ID")."""


class DemoRobots:
    """The processes of the simulated robots.

    :param data: folder; each robot's state and logs are stored below it
    :param report: prints progress
    :param processes: where they are started
    :param home: whether to start the simulated home too
    """

    def __init__(
        self, data: Path, report: Callable[[str], None], processes: DemoProcesses, *, home: bool
    ) -> None:
        self.names = (*ROBOTS, HOME) if home else ROBOTS
        self._data = data
        self._report = report
        self._processes = processes

    def launch(self, database: Database, relays: Sequence[str]) -> None:
        """Enrol the robots, and start their daemons, which start the rest. Blocks, so run it in a thread.

        :param relays: addresses (``HOST:PORT``) for robots; the first robot dials the second of them first, and so on
        :raises Unavailable: a robot could not be enrolled or started
        """
        domains = _free_domains(len(ROBOTS))
        for number, name in enumerate(self.names, 1):
            state = self._data / "robots" / name
            first = number % len(relays)
            self._report(f"enrolling {name}")
            self._enroll(database, name, state, ",".join((*relays[first:], *relays[:first])))
            if name == HOME:
                self._report(f"starting {name}")
                gateway = [command_path("switchboard-mqtt"), "--state", str(state)]
                start_home(state, gateway, self._processes.start)
            else:
                self._start(name, state, domains.pop())

    def _start(self, name: str, state: Path, domain: int) -> None:
        environment = {
            **os.environ,
            "ROS_DOMAIN_ID": str(domain),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        }
        self._report(f"starting {name} in ROS domain {domain}")
        settings = state / "robot.toml"
        settings.write_text(_modules(state))
        daemon = [command_path("switchboard-robot"), "run", "--state", str(state), "--config", str(settings)]
        self._processes.start(daemon, f"{name}-daemon", environment, restarts=True)

    def _enroll(self, database: Database, name: str, state: Path, relays: str) -> None:
        code = passwords.new_enrolment_code()
        with database.begin() as session:
            robot = queries.find_robot(session, name)
            assert robot is not None
            hashed = passwords.token_hash(passwords.normalise_code(code))
            queries.issue_enrolment_code(session, robot.id, hashed, time.time() + ENROL_SECONDS)
        command = [command_path("switchboard-robot"), "enroll", "--relay", relays]
        # The ports may differ from the last run in this folder.
        command += ["--robot", name, "--code", "-", "--state", str(state), "--replace"]
        done = subprocess.run(
            command,
            input=code.encode(),
            capture_output=True,
            # Ctrl-C goes to the demo alone, which ends the rest in order.
            start_new_session=True,
            timeout=ENROL_SECONDS,
            check=False,
        )
        if done.returncode:
            raise Unavailable(f"{name} could not be enrolled: {done.stderr.decode(errors='replace').strip()}")


def _modules(state: Path) -> str:
    """Settings of a robot's daemon: the simulated base and services that come with Switchboard, as modules.

    :param state: folder of the robot
    """
    service = command_path("switchboard-robot-service")
    # The base stops by itself when its navigator was killed.
    base = [command_path("switchboard-sim"), "--command-timeout", "0.4"]
    speech = [service, "speech", "--out", str(state / "said.wav")]
    modules: dict[str, dict[str, Any]] = {
        "base": {"command": base},
        "battery": {"command": [service, "battery", "--topic", "/battery_state"], "after": ["base"]},
        "obstacles": {"command": [service, "obstacles", "--scan", "/scan"], "after": ["base"]},
        "markers": {"command": [service, "markers", "--view", "75", "--size", "0.4"], "autostart": False},
        "speech": {"command": speech, "autostart": _installed("espeakng_loader")},
    }
    if _DRIVE.exists():
        modules["gps"] = {"command": [service, "gps", str(_DRIVE)], "autostart": False}
    # Without a compiler set-up builds neither.
    if _installed("nav2_msgs", "tf2_msgs"):
        modules["navigator"] = {"command": [service, "navigator"], "after": ["base"]}
        modules["targets"] = {
            "python": f"{_DEVICES}.target_follower:TargetFollower",
            "settings": {"waypoints": "follow_waypoints"},
            "after": ["navigator"],
        }
        commands = {"modules": ["targets"], "port": 0}
        server = f"{_DEVICES}.command_server:CommandServer"
        modules["commands"] = {"python": server, "settings": commands, "autostart": False}
    return "\n".join(_table(name, settings) for name, settings in modules.items())


_DEVICES = "robot_client.devices"

_DRIVE = Path(__file__).parents[2] / "docs" / "examples" / "drive.nmea"
"""A recorded drive; not part of an installed package."""


def _table(name: str, settings: dict[str, Any]) -> str:
    """One module as TOML. Tables within are inline: JSON with ``=``."""
    lines = [f"[[module]]\nname = {json.dumps(name)}"]
    common = {"ready_log": "READY", "term_after_s": 1, "kill_after_s": 1}
    for key, value in {**common, **settings}.items():
        inline = [f"{each} = {json.dumps(what)}" for each, what in value.items()] if key == "settings" else []
        lines.append(f"{key} = {{ {', '.join(inline)} }}" if inline else f"{key} = {json.dumps(value)}")
    return "\n".join(lines) + "\n"


def _installed(*packages: str) -> bool:
    return all(importlib.util.find_spec(each) for each in packages)


def _free_domains(count: int) -> list[int]:
    """ROS domains that are not in use on this machine, by their first port (DDSI-RTPS 9.6.1.4)."""
    found: list[int] = []
    for domain in random.sample(DOMAINS, len(DOMAINS)):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(("127.0.0.1", 7400 + 250 * domain + 10))
            except OSError:
                continue
        found.append(domain)
        if len(found) == count:
            return found
    raise Unavailable("no free ROS domain was found on this machine")
