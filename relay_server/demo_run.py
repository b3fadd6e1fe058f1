"""Runs the demo: the relay in this process, the robots in their own."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import click
from twisted.internet.defer import Deferred
from twisted.internet.threads import deferToThread
from twisted.python.failure import Failure

from relay_db.engine import Database
from relay_protocol.errors import Unavailable
from relay_server import logs
from relay_server.clock import looping
from relay_server.config import Endpoint, Settings
from relay_server.demo import ROBOTS, Fleet, Login, prepare
from relay_server.run import leave, monotonic_reactor, run
from relay_server.service import Relay

ONLINE_SECONDS = 90.0


def run_demo(folder: Path, http: Endpoint, robots: Endpoint) -> int:
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
    fleet = Fleet(folder, _say)
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
        code = run(Settings(data=folder, database=url, http=http, robots=robots), ready, hangup_ends=True)
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


async def _all_online(reactor: Any, relay: Relay, fleet: Fleet) -> None:
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


async def _welcome(relay: Relay, logins: list[Login], folder: Path) -> None:
    link = await relay.login_link("admin")
    width = max(len(login.name) for login in logins)
    lines = [f"  {login.name:<{width}}  {login.password}   {login.may}" for login in logins]
    click.echo("\n".join(["", "Users and passwords of this demo:", *lines, ""]))
    click.echo(f"Log in as admin with this link, once:\n  {link}\n")
    click.echo(f"Logs are in {folder}. Ctrl-C ends everything.")
    click.echo(f"READY {relay.url}")


def _say(text: str) -> None:
    click.echo(f"… {text}")
