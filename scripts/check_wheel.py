"""Check the wheel of a release: what it contains, and that it works where no checkout is.

    python scripts/check_wheel.py dist/*.whl --relay python3.11 --relay python3.14 --robot python3.10

Each Python gets a new virtual environment. A relay there must start on an empty folder, log its administrator in and
serve the portal. A robot's daemon must enrol at such a relay and be online; where ROS 2 can't be installed for its
Python, it must say so. Needs pip's index, Python 3.10 and nothing else.
"""

from __future__ import annotations

import argparse
import contextlib
import fnmatch
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.request
import zipfile
from collections.abc import Callable, Iterator
from http.cookiejar import CookieJar
from pathlib import Path

NEEDED = (
    "relay_server/portal/index.html",
    "relay_server/portal/licences.md",
    "relay_server/portal/assets/*.js",
    "relay_server/portal/assets/*.css",
    "relay_server/http/rdf/switchboard.ttl",
    "relay_db/migrations/env.py",
    "relay_db/migrations/versions/*.py",
    "*.data/data/share/robot-switchboard/switchboard.service",
    "*.data/data/share/robot-switchboard/switchboard-robot.service",
    "*.dist-info/licenses/LICENSE",
)
ALLOWED = r"(relay_protocol|relay_db|relay_server|robot_client|robot_switchboard-[0-9.]+\.(dist-info|data))/"
"""Top folders of the wheel; all others would be installed beside everybody's packages."""
PATIENCE = 600.0
"""Most seconds to wait for a condition, such as a program that is ready."""
RELAY = "[server]"
ROBOT, ROBOT_WITH_ROS = "[robot]", "[robot,ros]"
LEFT_OUT = {"PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV", "PIP_REQUIRE_VIRTUALENV"} | {
    "LD_LIBRARY_PATH",
    "AMENT_PREFIX_PATH",
    "_ROS_WHEELS_BOOTSTRAP_COMPLETE",
}
"""Variables that would lead into the environment which runs this; those of ROS's wheels among them."""


def say(line: str) -> None:
    """Print a line at once."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def wait_for(condition: Callable[[], object]) -> bool:
    """Wait until a condition holds.

    :returns: whether it does, after ``PATIENCE`` at the latest
    """
    end = time.monotonic() + PATIENCE
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.1)
    return True


def check_contents(wheel: Path) -> None:
    """Nothing is missing, and nothing else is in it.

    :raises SystemExit: names what is wrong
    """
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        missing = [each for each in NEEDED if not fnmatch.filter(names, each)]
        strange = [each for each in names if not re.match(ALLOWED, each)]
        page = archive.read(NEEDED[0]).decode() if NEEDED[0] in names else ""
    linked = re.findall(r'(?:src|href)="/([^"]+)"', page)
    missing += [each for each in linked if f"relay_server/portal/{each}" not in names]
    if missing or strange:
        sys.exit(f"{wheel.name}: missing {missing}, not expected {strange[:10]}. Run 'make wheel'.")


class Environment:
    """A new virtual environment, with a home of its own.

    :param dependencies: a folder of packages; the wheel is then installed alone, without pip's index
    """

    def __init__(self, python: str, folder: Path, dependencies: Path | None) -> None:
        self.folder = folder
        self._dependencies = dependencies
        home = folder / "home"
        home.mkdir(parents=True)
        self._variables = {name: value for name, value in os.environ.items() if name not in LEFT_OUT}
        self._variables |= {"HOME": str(home), "PATH": f"{folder}/venv/bin:/usr/bin:/bin"}
        self._variables |= {"ROS_DOMAIN_ID": "100", "PYTHONNOUSERSITE": "1"}
        self._variables |= {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
        self.python = folder / "venv/bin/python"
        bare = ["--without-pip"] if dependencies else []
        subprocess.run([shutil.which(python) or python, "-m", "venv", *bare, folder / "venv"], check=True)
        self.version = self.run("python", "--version").stdout.split()[1]

    def install(self, wheel: Path, extras: str) -> bool:
        """Install the wheel.

        :returns: whether all that the extras name could be installed
        """
        if self._dependencies is None:
            return self.run("python", "-m", "pip", "install", "--quiet", f"{wheel}{extras}").returncode == 0
        (packages,) = (self.folder / "venv/lib").glob("python*/site-packages")
        (packages / "dependencies.pth").write_text(f"{self._dependencies}\n")
        pip = [sys.executable, "-m", "pip", "--python", str(self.python), "install", "--quiet"]
        options = ["--no-compile", "--no-deps", "--no-index"]
        return subprocess.run([*pip, *options, wheel], check=False).returncode == 0

    def run(self, *command: str, typed: str = "") -> subprocess.CompletedProcess[str]:
        """Run a program of this environment to its end."""
        return subprocess.run(
            [self.folder / "venv/bin" / command[0], *command[1:]],
            cwd=self.folder,
            env=self._variables,
            input=typed,
            capture_output=True,
            text=True,
            check=False,
        )

    def must_run(self, *command: str, typed: str = "") -> str:
        """Run a program that must succeed, and return its output."""
        done = self.run(*command, typed=typed)
        if done.returncode:
            sys.exit(f"Python {self.version}: {' '.join(command)} failed:\n{done.stdout}{done.stderr}")
        return done.stdout

    @contextlib.contextmanager
    def running(self, *command: str, until: str = "") -> Iterator[str]:
        """A program that runs until the block ends.

        :param until: pattern of the output to wait for
        :returns: the output until then
        """
        output = self.folder / f"{command[0]}.out"
        with output.open("w") as out:
            process = subprocess.Popen(
                [self.folder / "venv/bin" / command[0], *command[1:]],
                cwd=self.folder,
                env=self._variables,
                stdout=out,
                stderr=subprocess.STDOUT,
            )
        try:
            wait_for(lambda: re.search(until, output.read_text()) or process.poll() is not None)
            printed = output.read_text()
            if not re.search(until, printed):
                sys.exit(f"Python {self.version}: {command[0]} is not ready:\n{printed}")
            yield printed
        finally:
            process.terminate()
            process.wait()


class RunningRelay:
    """``switchboard serve`` on an empty folder.

    :param printed: its output until READY
    """

    def __init__(self, environment: Environment, printed: str) -> None:
        self.environment = environment
        self.robots_port = int(re.findall(r"robots=(\d+)", printed)[0])
        self._url, self._code = re.findall(r"(http://\S+)/login#code=(\S+)", printed)[0]
        self._open = urllib.request.build_opener(urllib.request.HTTPCookieProcessor(CookieJar())).open

    def check(self) -> None:
        """The administrator logs in, and the portal is there, with its scripts."""
        headers = {"Content-Type": "application/json", "Origin": self._url}
        body = json.dumps({"code": self._code}).encode()
        self._open(urllib.request.Request(f"{self._url}/api/v1/session", body, headers))  # noqa: S310
        user = json.loads(self._get("/api/v1/session"))
        assert user["user"] == "admin" and user["admin"], user
        page = self._get("/").decode()
        scripts = re.findall(r'src="(/assets/[^"]+\.js)"', page)
        assert "<title>Switchboard</title>" in page and scripts, page
        assert all(len(self._get(each)) > 1000 for each in scripts)

    def _get(self, path: str) -> bytes:
        with self._open(self._url + path) as answer:
            return bytes(answer.read())

    def command(self, *command: str) -> str:
        """An administrator's command."""
        return self.environment.must_run("switchboard", "--data", "data", *command)


@contextlib.contextmanager
def running_relay(environment: Environment) -> Iterator[RunningRelay]:
    """A relay with an empty database, on any free ports."""
    serve = ("serve", "--data", "data", "--http", "127.0.0.1:0", "--robots", "127.0.0.1:0")
    with environment.running("switchboard", *serve, until="READY") as printed:
        yield RunningRelay(environment, printed)


@contextlib.contextmanager
def checked_relay(environment: Environment, wheel: Path) -> Iterator[RunningRelay]:
    """A relay that serves its portal and logs in."""
    if not environment.install(wheel, RELAY):
        sys.exit(f"Python {environment.version}: {wheel.name}{RELAY} can't be installed")
    assert "serve" in environment.must_run("switchboard", "--help")
    place = environment.must_run("python", "-c", "import relay_server; print(relay_server.__file__)")
    assert place.startswith(str(environment.folder)), place
    with running_relay(environment) as relay:
        relay.check()
        say(f"relay on Python {environment.version}: serves the portal, logs in")
        yield relay


def check_robot(environment: Environment, wheel: Path, relay: RunningRelay) -> None:
    """A daemon enrols. With ROS 2 it is online; without it says what is missing."""
    with_ros = environment.install(wheel, ROBOT_WITH_ROS)
    if not (with_ros or environment.install(wheel, ROBOT)):
        sys.exit(f"Python {environment.version}: {wheel.name}{ROBOT} can't be installed")
    with_ros = environment.run("python", "-c", "import rclpy").returncode == 0
    assert "enroll" in environment.must_run("switchboard-robot", "--help")
    name = f"robot-{environment.version.replace('.', '-')}"
    code = re.findall(r"Enrolment code: (\S+)", relay.command("robot", "add", name))[0]
    target = ("--relay", f"127.0.0.1:{relay.robots_port}", "--robot", name)
    environment.must_run(
        "switchboard-robot", "enroll", *target, "--code", "-", "--state", "state", typed=code
    )
    if with_ros:
        with environment.running("switchboard-robot", "run", "--state", "state", until="registered as"):
            if not wait_for(lambda: name in online(relay)):
                sys.exit(f"Python {environment.version}: {name} is not online:\n{relay.command('status')}")
        said = "online"
    else:
        done = environment.run("switchboard-robot", "run", "--state", "state")
        said = done.stderr.strip()
        assert done.returncode and "rclpy" in said and "Traceback" not in said, said
    say(f"robot on Python {environment.version}: enrols, then: {said}")


def online(relay: RunningRelay) -> list[str]:
    """Names of the robots that are connected."""
    return [each["name"] for each in json.loads(relay.command("status", "--json"))["robots"]]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("wheel", type=Path)
    parser.add_argument("--relay", action="append", default=[], metavar="PYTHON", help="try a relay with it")
    parser.add_argument("--robot", action="append", default=[], metavar="PYTHON", help="try a robot with it")
    parser.add_argument(
        "--dependencies", type=Path, help="folder of all other packages; pip's index is not used"
    )
    given = parser.parse_args()
    wheel, dependencies = given.wheel.resolve(), given.dependencies and given.dependencies.resolve()
    check_contents(wheel)
    say(f"{wheel.name}: {wheel.stat().st_size / 1e6:.1f} MB, complete")
    with tempfile.TemporaryDirectory(prefix="switchboard-") as name, contextlib.ExitStack() as stack:
        folder = Path(name)
        relays = [
            stack.enter_context(
                checked_relay(Environment(python, folder / f"relay-{number}", dependencies), wheel)
            )
            for number, python in enumerate(given.relay or ([sys.executable] if given.robot else []))
        ]
        for number, python in enumerate(given.robot):
            check_robot(Environment(python, folder / f"robot-{number}", dependencies), wheel, relays[0])


if __name__ == "__main__":
    main()
