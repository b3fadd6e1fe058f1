"""A simulated robot with its daemon, in processes of their own."""

from __future__ import annotations

import json
import subprocess
from typing import Any

from tests.worlds.forked_programs import run_command
from tests.worlds.processes import BIN, Process, ros_environment
from tests.worlds.relay_process import Relay
from tests.worlds.ros_domains import free_domain
from tests.worlds.waiting import PATIENCE, wait_for


class Robot:
    """A simulated robot in its own ROS domain, with its daemon, enrolled at a relay.

    :param port: the daemon's target; a proxy's port, or the relay's
    :param settings: text of the daemon's settings file
    :param sim_options: further ones of ``switchboard-sim``, such as ``--camera-size``, ``1280x720``
    """

    def __init__(
        self,
        relay: Relay,
        name: str,
        *,
        port: int | None = None,
        camera: bool = False,
        daemon_env: dict[str, str] | None = None,
        enroll_options: tuple[str, ...] = (),
        sim_options: tuple[str, ...] = (),
        settings: str = "",
    ) -> None:
        self.relay = relay
        self.name = name
        self.domain = free_domain()
        self.folder = relay.folder / name
        self.record_file = self.folder / "record.jsonl"
        self.state = self.folder / "state"
        self._daemon_env = daemon_env or {}
        self._settings = settings
        self._record: list[dict[str, Any]] = []
        self._recorded = 0
        """Bytes of the file that are read."""
        self.folder.mkdir(parents=True)
        command = [str(BIN / "switchboard-sim"), "--record", str(self.record_file), "--seed", "1"]
        command += ["--camera" if camera else "--no-camera", *sim_options]
        self.sim = Process(command, self.folder, "sim", ros_environment(self.domain))
        code = relay.cli("robot", "add", name)["enrolment_code"]
        self.enroll(code, port or relay.robots_port, *enroll_options).check_returncode()
        self.sim.wait_to_say("READY")
        self.daemon = self._daemon()
        self.wait_online()

    def enroll(self, code: str, port: int, *options: str) -> subprocess.CompletedProcess[str]:
        """``switchboard-robot enroll``; options such as ``--tls``, ``--ca`` FILE."""
        command = [
            str(BIN / "switchboard-robot"),
            "enroll",
            "--relay",
            f"127.0.0.1:{port}",
            "--robot",
            self.name,
        ]
        command += ["--code", "-", "--state", str(self.state), *options]
        return run_command(command, stdin=code)

    def _daemon(self) -> Process:
        command = [str(BIN / "switchboard-robot"), "run", "--state", str(self.state)]
        if self._settings:
            config = self.folder / "robot.toml"
            config.write_text(self._settings)
            command += ["--config", str(config)]
        return Process(command, self.folder, "daemon", {**ros_environment(self.domain), **self._daemon_env})

    def start_daemon(self) -> None:
        """Start the daemon again after it was killed."""
        self.daemon = self._daemon()

    def wait_online(self, seconds: float = PATIENCE) -> None:
        """Waits until the relay sees it."""
        try:
            wait_for(f"{self.name} is online", lambda: self.relay.state_of(self.name) != "offline", seconds)
        except AssertionError as error:
            raise AssertionError(f"{error}\n{self.daemon.explanation()}") from None

    def record(self) -> list[dict[str, Any]]:
        """Commands and motion of the simulated body: dicts with ``t`` (monotonic ns) and ``event``."""
        if self.record_file.exists():
            with self.record_file.open("rb") as file:
                file.seek(self._recorded)
                whole, _, _ = file.read().rpartition(b"\n")
            self._recorded += len(whole) + bool(whole)
            self._record += [json.loads(line) for line in whole.splitlines()]
        return self._record

    def events(self, kind: str, since: int = 0) -> list[dict[str, Any]]:
        """Events of one kind after a moment."""
        return [each for each in self.record() if each["event"] == kind and each["t"] >= since]

    def moving(self) -> bool:
        """Whether it moves, by its own log."""
        changes = (each["event"] for each in reversed(self.record()))
        return next((each for each in changes if each in ("moving", "standstill")), "") == "moving"

    def stop(self) -> None:
        """End daemon and simulator."""
        self.daemon.stop()
        self.sim.stop()
