"""NATS servers with JetStream on loopback: one, or a cluster of three."""

from __future__ import annotations

import shutil
import signal
import socket
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from tests.worlds.processes import Process
from tests.worlds.waiting import PATIENCE, wait_for

NAMES = ("a", "b", "c")


class NatsServer:
    """One server, which can be killed, frozen and started again on its port.

    :param port: of clients
    :param cluster: address for the other servers, and the addresses of all; empty for a single server
    """

    def __init__(self, folder: Path, name: str, port: int, *cluster: str) -> None:
        self.url = f"nats://127.0.0.1:{port}"
        self._port = port
        self._name = name
        self._folder = folder
        self._command = [
            str(Path(sys.executable).parent / "nats-server"),
            *("--name", name, "--addr", "127.0.0.1", "--port", str(port)),
            *("--jetstream", "--store_dir", str(folder / name)),
        ]
        if cluster:
            own, *routes = cluster
            self._command += ["--cluster_name", "test", "--cluster", own, "--routes", ",".join(routes)]
        self.start()

    def start(self) -> None:
        self._process = Process(self._command, self._folder, f"nats-{self._name}")

    def listens(self) -> bool:
        """Whether it accepts clients."""
        try:
            socket.create_connection(("127.0.0.1", self._port), PATIENCE).close()
        except OSError:
            return False
        return True

    def kill(self) -> None:
        """Ends it at once."""
        self._process.kill()

    def freeze(self) -> None:
        """SIGSTOP; it stands still when this returns."""
        self._process.freeze()

    def thaw(self) -> None:
        """SIGCONT."""
        self._process.signal(signal.SIGCONT)


@contextmanager
def nats_server(folder: Path) -> Iterator[NatsServer]:
    """A single server."""
    server = NatsServer(folder, "single", _free_ports(1)[0])
    try:
        wait_for("the server listens", server.listens)
        yield server
    finally:
        server.kill()


@contextmanager
def nats_cluster(folder: Path) -> Iterator[list[NatsServer]]:
    """Three servers."""
    ports = _free_ports(2 * len(NAMES))
    clients, routes = ports[: len(NAMES)], ports[len(NAMES) :]
    addresses = [f"nats://127.0.0.1:{port}" for port in routes]
    shutil.rmtree(folder, ignore_errors=True)
    with ExitStack() as stack:
        servers = []
        for name, port, own in zip(NAMES, clients, addresses, strict=True):
            server = NatsServer(folder, name, port, own, *addresses)
            stack.callback(server.kill)
            servers.append(server)
        for server in servers:
            wait_for("the server listens", server.listens)
        yield servers


def _free_ports(count: int) -> list[int]:
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for each in sockets:
            each.bind(("127.0.0.1", 0))
        return [each.getsockname()[1] for each in sockets]
