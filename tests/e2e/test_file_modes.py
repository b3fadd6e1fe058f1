"""Files of a relay and a robot are accessible only to their owner, for any umask at the start."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from tests.worlds import offload_functions
from tests.worlds.file_modes import open_to_others
from tests.worlds.http_requests import ask
from tests.worlds.processes import BIN, Process, ros_environment
from tests.worlds.ros_domains import free_domain
from tests.worlds.waiting import wait_for

OPEN = ["sh", "-c", 'umask 0; exec "$0" "$@"']


class Site:
    """A relay, a simulated robot and its daemon, all started under umask 0, with all files in one folder."""

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
        """Starts a program and waits for its READY line, if it has one."""
        process = Process([*OPEN, str(BIN / program), *arguments], self._output, name, self._environment)
        self._stack.callback(process.stop)
        return process.wait_to_say("READY") if program != "switchboard-robot" else ""

    def runs(self, program: str, *arguments: str, stdin: str = "") -> Any:
        """Runs a program to its end; returns its output as JSON."""
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
        """Runs an administrator's command."""
        return self.runs("switchboard", "--data", str(self.data), *arguments, "--json", stdin=stdin)

    def stop(self) -> None:
        """Ends all, the last first."""
        self._stack.close()


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    """No process runs yet."""
    made = Site(tmp_path)
    try:
        yield made
    finally:
        made.stop()


SETTINGS = """
[[module]]
name = "talker"
command = ["sh", "-c", "echo hello; exec sleep 600"]
ready_log = "hello"

[[file_group]]
name = "bags"
folder = "{bags}"
patterns = ["*.bag"]
settle_seconds = 0.5
after = "delete"
"""


def test_all_files_of_a_relay_and_a_robot_are_closed_to_others(site: Site, tmp_path: Path) -> None:
    """Database, name, lock, socket, recordings, files, a worker's; key, enrolment, a stored stop, a module and its log,
    the state of the computer, uploaded files, ROS logs; while running and afterwards.
    """
    functions, bags = tmp_path / "functions", tmp_path / "bags"
    for each in (functions, bags):
        each.mkdir()
    shutil.copy(offload_functions.__file__, functions)
    (bags / "one.bag").write_bytes(b"x" * 1000)
    settings = tmp_path / "robot.toml"
    settings.write_text(SETTINGS.format(bags=bags))
    options = ["--http", "127.0.0.1:0", "--robots", "127.0.0.1:0"]
    options += ["--offload-folder", str(functions), "--offload-processes", "1"]
    ready = site.starts("relay", "switchboard", "serve", "--data", str(site.data), *options)
    ports = dict(word.split("=") for word in ready.split()[1:])
    site.starts("sim", "switchboard-sim", "--camera", "--record", str(site.made / "record.jsonl"))
    code = site.cli("robot", "add", "rover")["enrolment_code"]
    enrolling = "--relay", f"127.0.0.1:{ports['robots']}", "--robot", "rover", "--code", "-"
    site.runs("switchboard-robot", "enroll", *enrolling, "--state", str(site.state), stdin=code)
    site.starts("daemon", "switchboard-robot", "run", "--state", str(site.state), "--config", str(settings))
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
    wait_for("the module runs", lambda: asks("GET", "/modules/talker").json["state"] == "running")
    wait_for("a file is uploaded", lambda: asks("GET", "/files").json["files"])
    site.cli("file", "put", "rover", str(settings))

    def adds() -> Any:
        """The result, unless the worker process is still being started."""
        body = {"arguments": {"a": 1.0}}
        answer = ask(int(ports["http"]), "POST", "/api/v1/functions/add", body, token=token)
        return answer.json.get("result")

    assert wait_for("a function runs", adds)["sum"] == 2.0
    names = {each.name for each in site.data.iterdir()}
    assert names >= {
        "relay.name",
        "relay.lock",
        "relay.sock",
        "recordings",
        "files",
        "switchboard.db",
        "switchboard.db-wal",
    }
    assert list(site.state.glob("modules/talker/**/*"))
    assert open_to_others(site.made) == {}
    site.stop()
    assert open_to_others(site.made) == {}
