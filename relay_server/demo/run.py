"""Runs the demo until a signal ends it: a relay in this process, all else in their own."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import click
from twisted.internet.defer import Deferred
from twisted.internet.threads import deferToThread
from twisted.python.failure import Failure

from relay_db import queries
from relay_db.engine import Database
from relay_protocol.errors import Invalid, Unavailable
from relay_server import logs
from relay_server.common.clock import looping
from relay_server.config import ListenAddress, RelaySettings
from relay_server.demo.cluster import DemoCluster, DemoRelay
from relay_server.demo.home import check_home
from relay_server.demo.processes import RESTART_SECONDS, DemoProcesses
from relay_server.demo.robots import DemoRobots
from relay_server.demo.users import DemoUser, prepare
from relay_server.relay import Relay
from relay_server.run import leave, monotonic_reactor, run

ONLINE_SECONDS = 90.0


def run_demo(
    folder: Path,
    http: ListenAddress,
    robots: ListenAddress,
    *,
    home: bool = False,
    cluster: bool = False,
    origins: Sequence[str] = (),
) -> int:
    """Run until a signal ends it.

    :param folder: for the database, the robots' state and all logs
    :param home: whether to add a simulated home with MQTT devices
    :param cluster: whether to run three relays
    :param origins: further ones whose pages may use the relay
    :returns: exit code
    :raises Invalid: they are given without the port of HTTP
    :raises Unavailable: the home or the cluster needs a program that is not installed
    """
    if home:
        check_home()
    # Like Ctrl-C, until the reactor has handlers of its own: what was started before ends with the demo.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    settings = RelaySettings(
        data=folder, database=f"sqlite:///{folder / 'switchboard.db'}", http=http, robots=robots
    )
    if origins:
        if not http.port:
            raise Invalid("--origin needs a port in --http, as in --http 127.0.0.1:9090")
        settings = replace(settings, origins=(settings.url(http.port), *origins))
    with ExitStack() as stack:
        log = stack.enter_context((folder / "relay.log").open("a"))
        logs.begin(as_json=False, out=log, later=logs.later)
        relays = None
        if cluster:
            relays = DemoCluster(folder, DemoProcesses(folder / "logs"), _print)
            stack.callback(relays.stop)
            with _interrupted_afterwards():
                relays.start()
            settings = relays.settings(settings)
        database = Database(settings.database)
        stack.callback(database.close)
        demo = _Demo(settings, database, prepare(database, home), relays, home=home)
        code = demo.run()
    if demo.failure:
        click.echo(f"The demo failed: {demo.failure}", err=True)
        for path in [folder / "relay.log", *sorted((folder / "logs").glob("*.log"))]:
            for line in path.read_text(errors="replace").splitlines()[-5:]:
                click.echo(f"  {path.name}: {line}", err=True)
    return code or bool(demo.failure)


class _Demo:
    """The relay of this process, which starts all else once it listens.

    :param cluster: with the other relays, if there are any
    :ivar failure: why the demo had to end; empty if it had not
    """

    def __init__(
        self,
        settings: RelaySettings,
        database: Database,
        logins: list[DemoUser],
        cluster: DemoCluster | None,
        *,
        home: bool,
    ) -> None:
        self.failure = ""
        self._settings = settings
        self._database = database
        self._logins = logins
        self._cluster = cluster
        self._others: list[DemoRelay] = []
        self._processes = DemoProcesses(settings.data / "logs")
        self._robots = DemoRobots(settings.data, _print, self._processes, home=home)
        self._reactor = monotonic_reactor()

    def run(self) -> int:
        """Run until a signal or a failure ends it; returns the exit code."""
        self._reactor.addSystemEventTrigger("before", "shutdown", lambda: deferToThread(self._processes.stop))
        try:
            return run(self._settings, self._ready, in_terminal=True)
        finally:
            self._processes.stop()

    def _ready(self, relay: Relay, _: str | None) -> None:
        _print(f"the relay listens at {relay.url}")
        Deferred.fromCoroutine(self._launch(relay)).addErrback(self._failed)

    async def _launch(self, relay: Relay) -> None:
        if self._cluster is not None:
            self._others = await deferToThread(self._cluster.start_relays, self._settings.http.host)
        addresses = [f"127.0.0.1:{relay.robots_port}", *(each.robots for each in self._others)]
        await deferToThread(self._robots.launch, self._database, addresses)
        await self._all_online(relay)
        await self._welcome(relay)
        looping(self._reactor, self._restart).start(RESTART_SECONDS)

    def _restart(self) -> None:
        for name in self._processes.restart():
            _print(f"{name} has ended, and is started again")

    def _failed(self, failure: Failure) -> None:
        self.failure = failure.getErrorMessage()
        leave(self._reactor)

    async def _all_online(self, relay: Relay) -> None:
        with self._database.reading() as session:
            found = [queries.find_robot(session, name) for name in self._robots.names]
        robots = [each.id for each in found if each is not None]
        known = relay.services.core.robots
        end = time.monotonic() + ONLINE_SECONDS
        done: Deferred[None] = Deferred()

        def check() -> None:
            ended = self._processes.unexpected_end()
            if ended is not None:
                done.errback(Unavailable(ended))
            elif all(known.connected(each) or known.is_elsewhere(each) for each in robots):
                done.callback(None)
            elif time.monotonic() > end:
                done.errback(Unavailable(f"not all robots came online within {ONLINE_SECONDS:g} s"))

        loop = looping(self._reactor, check)
        loop.start(0.2)
        try:
            await done
        finally:
            loop.stop()

    async def _welcome(self, relay: Relay) -> None:
        link = await relay.login_link("admin")
        width = max(len(login.name) for login in self._logins)
        lines = [f"  {login.name:<{width}}  {login.password}   {login.may}" for login in self._logins]
        click.echo(
            "\n".join(["", "Users of this demo, with passwords that are new at each start:", *lines, ""])
        )
        click.echo(f"Log in as admin with this link, once:\n  {link}\n")
        if self._cluster is not None:
            click.echo(_relays_text(relay.url, self._others, self._cluster.database, self._settings.data))
        click.echo(f"Logs are in {self._settings.data}. Ctrl-C ends everything.")
        click.echo(f"READY {relay.url}")


@contextmanager
def _interrupted_afterwards() -> Iterator[None]:
    """Have SIGTERM and Ctrl-C wait for the end of a step, so that every process that is started is ended."""
    received: list[int] = []
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    for number, handler in before.items():
        if handler is not signal.SIG_IGN:
            signal.signal(number, lambda number, _: received.append(number))
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if received:
            raise KeyboardInterrupt


def _relays_text(url: str, others: list[DemoRelay], database: str, folder: Path) -> str:
    """What the demo of a cluster shows, and how to see it."""
    second, third = others
    return f"""\
Three relays serve the robots. A login at one of them is valid at all:
  relay-one    {url}   this process
  relay-two    {second.url}   robot-one dials it first; end it by: kill -9 {second.pid}
  relay-three  {third.url}   robot-two dials it first; end it by: kill -9 {third.pid}

Drive robot-one at relay-one, and end relay-two meanwhile: the robot stops and dials relay-three. Release the
controls, and drive on. If you end the relay of your page, open the robot at another one.
Administer them by:
  export SWITCHBOARD_DB='{database}'
  switchboard --data {folder} cluster status
"""


def _print(text: str) -> None:
    click.echo(f"… {text}")
