"""With ``--other-relay``, the clients of all tests connect to another relay of a cluster than the robots.

Each relay that a test starts has two others and three NATS servers. Its clients connect to one of the two by chance.
What holds for one relay must hold there too, except for what docs/operate/cluster.md excludes.
"""

from __future__ import annotations

import atexit
import itertools
import random
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import psycopg

from tests.worlds.nats_servers import NatsServer, nats_cluster
from tests.worlds.postgresql_server import postgresql_database
from tests.worlds.processes import Process
from tests.worlds.relay_process import Relay

NAME = "fleet.example.org"
SECRET = "0123456789abcdef" * 2


class Servers:
    """One PostgreSQL for all relays of the tests, and three NATS servers for each cluster."""

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

    def bus(self) -> list[NatsServer]:
        """New servers."""
        return self._stack.enter_context(nats_cluster(self._folder / f"nats{next(self._numbers)}"))


class OtherRelays:
    """The two others of a relay that a test starts.

    :ivar ports: of the two for clients
    :ivar home_port: of the relay itself
    :ivar chosen: the place of the one that clients connect to
    """

    def __init__(self, relay: Any, servers: Servers) -> None:
        bus = ",".join(each.url for each in servers.bus())
        secret = relay.folder / "secret"
        secret.parent.mkdir(parents=True, exist_ok=True)
        secret.write_text(SECRET + "\n")
        more = ["--cluster-bus", bus, "--cluster-secret", str(secret)]
        self.options = [*relay._options, *more]
        if "--name" not in relay._options:
            self.options += ["--name", NAME]
        self.home_port = 0
        self.ports = [0, 0]
        self.chosen = random.randrange(2)
        self._processes: list[Process] = []

    def start(self, relay: Any) -> None:
        """Start both."""
        from tests.worlds.processes import BIN

        for at, port in enumerate(self.ports):
            command = [str(BIN / "switchboard"), "serve", "--data", str(relay.folder / f"other-relay-{at}")]
            command += [*self.options, "--http", f"127.0.0.1:{port}", "--robots", "127.0.0.1:0"]
            process = Process(command, relay.folder, f"other-relay-{at}", relay._environment)
            self._processes.append(process)
            words = dict(word.split("=") for word in process.wait_to_say("READY").split()[1:])
            self.ports[at] = int(words["http"])

    def kill(self) -> None:
        """End both at once."""
        for each in self._processes:
            each.kill()
        self._processes.clear()


def install() -> None:
    """Have each relay of the tests started with two others, at one of which clients connect."""
    servers = Servers()
    start, kill, stop, init = Relay.start, Relay.kill, Relay.stop, Relay.__init__

    def with_database(relay: Any, folder: Path, *options: str, database: str | None = None) -> None:
        alone = "--cluster-bus" in options or "--workers" in options
        relay.others = None
        relay.alone = alone
        init(relay, folder, *options, database=database or (None if alone else servers.database()))

    def start_all(relay: Any) -> None:
        if relay.alone:
            start(relay)
            return
        if relay.others is None:
            relay.others = OtherRelays(relay, servers)
            relay._options = tuple(relay.others.options)
        others = relay.others
        relay.http_port = others.home_port
        start(relay)
        others.home_port = relay.http_port
        others.start(relay)
        relay.http_port = others.ports[others.chosen]

    def kill_all(relay: Any) -> None:
        if relay.others is not None:
            relay.others.kill()
        kill(relay)

    def stop_all(relay: Any) -> int:
        if relay.others is not None:
            relay.others.kill()
        return stop(relay)

    Relay.__init__ = with_database  # type: ignore[method-assign]
    Relay.start, Relay.kill, Relay.stop = start_all, kill_all, stop_all  # type: ignore[method-assign]
