"""What a relay and a robot leave on the disk is their owner's alone, whatever the umask was when they were started."""

from __future__ import annotations

import json
import os
import stat
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from switchboard_domains import free_domain
from switchboard_http import ask
from switchboard_processes import BIN, Process, ros_environment
from switchboard_waiting import wait_for

OPEN = ["sh", "-c", 'umask 0; exec "$0" "$@"']


class Site:
    """A relay, a simulated robot and its daemon, all started under umask 0, with all that they make in one folder."""

    def __init__(self, folder: Path) -> None:
        self.made = folder / "made"
        self.made.mkdir(mode=0o700)
        self._output = folder / "output"
        self.data, self.state = self.made / "relay", self.made / "robot"
        temporary = self.made / "tmp"
        temporary.mkdir(mode=0o700)
        places = {"HOME": str(self.made), "TMPDIR": str(temporary)}
        self._environment = {**ros_environment(free_domain()), **places}
        self._stack = ExitStack()

    def starts(self, name: str, program: str, *arguments: str) -> str:
        """A program, until it has said that it is ready, if it says so."""
        process = Process([*OPEN, str(BIN / program), *arguments], self._output, name, self._environment)
        self._stack.callback(process.stop)
        return process.wait_to_say("READY") if program != "switchboard-robot" else ""

    def runs(self, program: str, *arguments: str, stdin: str = "") -> Any:
        """A program to its end; what it prints as JSON."""
        done = subprocess.run(
            [*OPEN, str(BIN / program), *arguments],
            input=stdin,
            env=self._environment,
            capture_output=True,
            text=True,
            check=True,
            timeout=120,
        )
        return json.loads(done.stdout) if done.stdout.startswith(("{", "[")) else None

    def cli(self, *arguments: str, stdin: str = "") -> Any:
        """An administrator's command."""
        return self.runs("switchboard", "--data", str(self.data), *arguments, "--json", stdin=stdin)

    def stop(self) -> None:
        """End all, the last first."""
        self._stack.close()


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    """Nothing runs yet."""
    made = Site(tmp_path)
    try:
        yield made
    finally:
        made.stop()


def open_to_others(folder: Path) -> dict[str, str]:
    """All below a folder that others may do anything with, links aside."""
    found = {}
    for root, folders, files in os.walk(folder):
        for name in (*folders, *files):
            path = Path(root, name)
            mode = path.lstat().st_mode
            if not stat.S_ISLNK(mode) and mode & 0o077:
                found[str(path.relative_to(folder))] = oct(mode)
    return found


def test_all_files_of_a_relay_and_a_robot_are_closed_to_others(site: Site) -> None:
    """Database, name, lock, socket, recordings; key, enrolment, a stop that is kept, logs of ROS; as long as all
    run and when they have ended.
    """
    addresses = "--http", "127.0.0.1:0", "--robots", "127.0.0.1:0"
    ready = site.starts("relay", "switchboard", "serve", "--data", str(site.data), *addresses)
    ports = dict(word.split("=") for word in ready.split()[1:])
    site.starts("sim", "switchboard-sim", "--camera", "--record", str(site.made / "record.jsonl"))
    code = site.cli("robot", "add", "rover")["enrolment_code"]
    enrolling = "--relay", f"127.0.0.1:{ports['robots']}", "--robot", "rover", "--code", "-"
    site.runs("switchboard-robot", "enroll", *enrolling, "--state", str(site.state), stdin=code)
    site.starts("daemon", "switchboard-robot", "run", "--state", str(site.state))
    site.cli("user", "add", "ann", "--password-stdin", stdin="correct horse\n")
    site.cli("right", "grant", "ann", "rover", "owner")
    token = site.cli("token", "create", "ann", "--ttl", "1h")["token"]

    def asks(method: str, path: str, body: Any = None) -> Any:
        answer = ask(int(ports["http"]), method, f"/api/v1/robots/rover{path}", body, token=token)
        return answer if answer.status < 300 else None

    wait_for("the robot is there", lambda: asks("GET", "/topics/odom") or asks("GET", "/cameras"))
    topics = {"topics": ["/odom"], "cameras": ["/camera/image_raw"]}
    recording = wait_for("a recording begins", lambda: asks("POST", "/recordings", topics)).json["id"]
    wait_for("it is on the disk", lambda: list(site.data.glob("recordings/*.mcap")))
    wait_for("the robot is stopped", lambda: asks("POST", "/stop", {"why": "test"}))
    wait_for("the stop is kept", lambda: list(site.state.glob("*stop*")))
    assert asks("POST", f"/recordings/{recording}/stop", {}) is not None
    names = {each.name for each in site.data.iterdir()}
    assert names >= {
        "relay.name",
        "relay.lock",
        "relay.sock",
        "recordings",
        "switchboard.db",
        "switchboard.db-wal",
    }
    assert open_to_others(site.made) == {}
    site.stop()
    assert open_to_others(site.made) == {}
