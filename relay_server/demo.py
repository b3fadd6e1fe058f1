"""Runs the demo: the relay in this process, the robots in their own."""

from __future__ import annotations

import os
import random
import secrets
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
from twisted.internet.defer import Deferred
from twisted.internet.threads import deferToThread
from twisted.python.failure import Failure

from relay_db import queries
from relay_db.engine import Database
from relay_protocol.errors import SwitchboardError, Unavailable
from relay_protocol.rights import Level
from relay_server import logs
from relay_server.auth import passwords
from relay_server.common.clock import looping
from relay_server.config import ListenAddress, RelaySettings
from relay_server.run import leave, monotonic_reactor, run
from relay_server.service import Relay

ROBOTS = ("robot-one", "robot-two")
USERS = ("admin", "driver", "viewer")
STOP_SECONDS = 3.0
ENROL_SECONDS = 60.0
DOMAINS = range(1, 100)
"""ROS domains whose ports lie below Linux's ephemeral range (docs.ros.org, "The ROS_DOMAIN_ID")."""


@dataclass(frozen=True)
class DemoUser:
    """A user of the demo."""

    name: str
    password: str
    may: str


def prepare(database: Database) -> list[DemoUser]:
    """Users, robots and rights of the demo; on a folder used before, users get new passwords."""
    database.upgrade()
    logins = [DemoUser(name, secrets.token_urlsafe(9), _MAY[name]) for name in USERS]
    with database.begin() as session:
        for login in logins:
            hashed = passwords.hash_password(login.password)
            found = queries.find_user(session, login.name)
            if found is None:
                queries.add_user(session, login.name, hashed, admin=login.name == "admin")
            else:
                queries.set_password(session, found.id, hashed)
        for name in ROBOTS:
            if queries.find_robot(session, name) is None:
                queries.add_robot(session, name, f"Simulated robot {name.partition('-')[2]}")
        for user, robot, level in _RIGHTS:
            to, on = queries.find_user(session, user), queries.find_robot(session, robot)
            assert to is not None and on is not None
            queries.grant_right(session, on.id, level, user_id=to.id)
    return logins


_MAY = {
    "admin": "everything",
    "driver": "operator on robot-one",
    "viewer": "viewer on both robots",
}
_RIGHTS = (
    ("driver", "robot-one", Level.OPERATOR),
    ("viewer", "robot-one", Level.VIEWER),
    ("viewer", "robot-two", Level.VIEWER),
)


class DemoRobots:
    """The processes of the simulated robots.

    :param data: folder; each robot's state and logs go below it
    :param say: tells people what is going on
    """

    def __init__(self, data: Path, say: Callable[[str], None]) -> None:
        self._data = data
        self._say = say
        self._running: list[subprocess.Popen[bytes]] = []
        self._stopping = False

    def launch(self, database: Database, robots_port: int) -> None:
        """Enroll the robots, start simulators and daemons. Blocks; run it in a thread.

        :raises Unavailable: a robot could not be enrolled or started
        """
        domains = _free_domains(len(ROBOTS))
        for name, domain in zip(ROBOTS, domains, strict=True):
            state = self._data / "robots" / name
            self._say(f"enrolling {name}")
            self._enroll(database, name, state, robots_port)
            environment = {
                **os.environ,
                "ROS_DOMAIN_ID": str(domain),
                "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            }
            self._say(f"starting {name} in ROS domain {domain}")
            self._start([_command("switchboard-sim")], f"{name}-sim", environment)
            self._start(
                [_command("switchboard-robot"), "run", "--state", str(state)], f"{name}-daemon", environment
            )

    def dead(self) -> str | None:
        """The log of a process that has ended by itself, if one has."""
        for process in self._running:
            if process.poll() is not None and not self._stopping:
                return f"{Path(str(process.args[0])).name} ended with code {process.returncode}"  # type: ignore[index]  # a list, see _start
        return None

    def stop(self) -> None:
        """End all processes and wait for them; those that don't listen are killed."""
        self._stopping = True
        for process in reversed(self._running):
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
        until = time.monotonic() + STOP_SECONDS
        for process in self._running:
            try:
                process.wait(max(0.0, until - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def _enroll(self, database: Database, name: str, state: Path, robots_port: int) -> None:
        code = passwords.new_enrolment_code()
        with database.begin() as session:
            robot = queries.find_robot(session, name)
            assert robot is not None
            hashed = passwords.token_hash(passwords.normalise_code(code))
            queries.issue_enrolment_code(session, robot.id, hashed, time.time() + ENROL_SECONDS)
        command = [_command("switchboard-robot"), "enroll", "--relay", f"127.0.0.1:{robots_port}"]
        # The port may differ from the last time this folder was used.
        command += ["--robot", name, "--code", "-", "--state", str(state), "--replace"]
        done = subprocess.run(
            command,
            input=code.encode(),
            capture_output=True,
            # Ctrl-C is for the demo, which ends the rest in order.
            start_new_session=True,
            timeout=ENROL_SECONDS,
            check=False,
        )
        if done.returncode:
            raise Unavailable(f"{name} could not be enrolled: {done.stderr.decode(errors='replace').strip()}")

    def _start(self, command: list[str], name: str, environment: dict[str, str]) -> None:
        if self._stopping:
            return
        logs = self._data / "logs"
        logs.mkdir(exist_ok=True)
        with (logs / f"{name}.log").open("ab") as log:
            # A session of its own: Ctrl-C reaches the demo alone, which ends the rest in order.
            self._running.append(
                subprocess.Popen(
                    command,
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    env=environment,
                    start_new_session=True,
                )
            )


def _command(name: str) -> str:
    """A command of ours, installed beside the Python that runs this."""
    path = Path(sys.executable).parent / name
    if not path.exists():
        raise SwitchboardError(
            f"{name} is not installed here; install 'robot-switchboard[server,robot,sim,ros]'"
        )
    return str(path)


def _free_domains(count: int) -> list[int]:
    """ROS domains that nobody on this machine uses, as far as their first port tells (DDSI-RTPS 9.6.1.4)."""
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


ONLINE_SECONDS = 90.0


def run_demo(folder: Path, http: ListenAddress, robots: ListenAddress) -> int:
    """Run until a signal ends it.

    :param folder: for the database, the robots' state and all logs
    :returns: exit code
    """
    url = f"sqlite:///{folder / 'switchboard.db'}"
    log = (folder / "relay.log").open("a")
    logs.begin(as_json=False, out=log, later=logs.later)
    reactor = monotonic_reactor()
    database = Database(url)
    logins = prepare(database)
    fleet = DemoRobots(folder, _say)
    failed: list[str] = []

    def broken(failure: Failure) -> None:
        failed.append(failure.getErrorMessage())
        leave(reactor)

    def ready(relay: Relay, _: str | None) -> None:
        _say(f"the relay listens at {relay.url}")
        launching = deferToThread(fleet.launch, database, relay.robots_port)
        launching.addCallback(lambda _: Deferred.fromCoroutine(_all_online(reactor, relay, fleet)))
        launching.addCallback(lambda _: Deferred.fromCoroutine(_welcome(relay, logins, folder)))
        launching.addErrback(broken)

    reactor.addSystemEventTrigger("before", "shutdown", lambda: deferToThread(fleet.stop))
    try:
        code = run(
            RelaySettings(data=folder, database=url, http=http, robots=robots), ready, hangup_ends=True
        )
    finally:
        fleet.stop()
        database.close()
        log.close()
    if failed:
        click.echo(f"The demo failed: {failed[0]}", err=True)
        for path in [folder / "relay.log", *sorted((folder / "logs").glob("*.log"))]:
            for line in path.read_text(errors="replace").splitlines()[-5:]:
                click.echo(f"  {path.name}: {line}", err=True)
    return code or bool(failed)


async def _all_online(reactor: Any, relay: Relay, fleet: DemoRobots) -> None:
    since = time.monotonic()
    done: Deferred[None] = Deferred()

    def look() -> None:
        online = [robot["name"] for robot in relay.status()["robots"] if robot["state"] != "offline"]
        dead = fleet.dead()
        if dead is not None:
            done.errback(Unavailable(dead))
        elif len(online) == len(ROBOTS):
            done.callback(None)
        elif time.monotonic() - since > ONLINE_SECONDS:
            done.errback(Unavailable(f"not all robots came online within {ONLINE_SECONDS:g} s"))

    loop = looping(reactor, look)
    loop.start(0.2)
    try:
        await done
    finally:
        loop.stop()


async def _welcome(relay: Relay, logins: list[DemoUser], folder: Path) -> None:
    link = await relay.login_link("admin")
    width = max(len(login.name) for login in logins)
    lines = [f"  {login.name:<{width}}  {login.password}   {login.may}" for login in logins]
    click.echo("\n".join(["", "Users and passwords of this demo:", *lines, ""]))
    click.echo(f"Log in as admin with this link, once:\n  {link}\n")
    click.echo(f"Logs are in {folder}. Ctrl-C ends everything.")
    click.echo(f"READY {relay.url}")


def _say(text: str) -> None:
    click.echo(f"… {text}")
