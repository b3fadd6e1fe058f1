"""With ``--other-relay``, the clients of all tests connect to another relay of a cluster than the robots.

What holds for one relay must hold there too, except for what docs/operate/cluster.md excludes.
"""

from __future__ import annotations

import atexit
import itertools
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import psycopg

from tests.worlds.nats_servers import NatsServer, nats_server
from tests.worlds.postgresql_server import postgresql_database
from tests.worlds.processes import Process
from tests.worlds.relay_process import Relay

NAME = "fleet.example.org"
SECRET = "0123456789abcdef" * 2


class Servers:
    """One PostgreSQL for all relays of the tests, and a NATS server for each cluster."""

    def __init__(self) -> None:
        self._stack = ExitStack()
        self._folder = Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix="other-relay-")))
        self._url = ""
        self._numbers = itertools.count(1)
        atexit.register(self._stack.close)

    def database(self) -> str:
        """URL of a new database."""
        if not self._url:
            self._url = self._stack.enter_context(postgresql_database())
        name = f"relay{next(self._numbers)}"
        with psycopg.connect(self._url, autocommit=True) as connection:
            connection.execute(f'CREATE DATABASE "{name}"')
        return self._url.replace("/relay?", f"/{name}?")

    def bus(self) -> NatsServer:
        """A new server."""
        return self._stack.enter_context(nats_server(self._folder / f"nats{next(self._numbers)}"))


class RelayPair:
    """The other relay of one that a test starts."""

    def __init__(self, relay: Any, servers: Servers) -> None:
        self.bus = servers.bus()
        secret = relay.folder / "secret"
        secret.parent.mkdir(parents=True, exist_ok=True)
        secret.write_text(SECRET + "\n")
        more = ["--cluster-bus", self.bus.url, "--cluster-secret", str(secret)]
        self.options = [*relay._options, *more]
        if "--name" not in relay._options:
            self.options += ["--name", NAME]
        self.home_port = 0
        self.port = 0
        self.process: Process | None = None


def install() -> None:
    """Have each relay of the tests started with another one, at which clients connect."""
    servers = Servers()
    start, kill, stop, init = Relay.start, Relay.kill, Relay.stop, Relay.__init__

    def with_database(relay: Any, folder: Path, *options: str, database: str | None = None) -> None:
        alone = "--cluster-bus" in options or "--workers" in options
        relay.pair = None
        relay.alone = alone
        init(relay, folder, *options, database=database or (None if alone else servers.database()))

    def start_both(relay: Any) -> None:
        if relay.alone:
            start(relay)
            return
        if relay.pair is None:
            relay.pair = RelayPair(relay, servers)
            relay._options = tuple(relay.pair.options)
        pair = relay.pair
        relay.http_port = pair.home_port
        start(relay)
        pair.home_port = relay.http_port
        from tests.worlds.processes import BIN

        command = [str(BIN / "switchboard"), "serve", "--data", str(relay.folder / "other-relay-data")]
        command += [*pair.options, "--http", f"127.0.0.1:{pair.port}", "--robots", "127.0.0.1:0"]
        pair.process = Process(command, relay.folder, "other-relay", relay._environment)
        words = dict(word.split("=") for word in pair.process.wait_to_say("READY").split()[1:])
        pair.port = relay.http_port = int(words["http"])

    def kill_both(relay: Any) -> None:
        if relay.pair is not None and relay.pair.process is not None:
            relay.pair.process.kill()
        kill(relay)

    def stop_both(relay: Any) -> int:
        if relay.pair is not None and relay.pair.process is not None:
            relay.pair.process.kill()
        return stop(relay)

    Relay.__init__ = with_database  # type: ignore[method-assign]
    Relay.start, Relay.kill, Relay.stop = start_both, kill_both, stop_both  # type: ignore[method-assign]
