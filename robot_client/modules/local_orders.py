"""Orders to modules on the robot itself, by a Unix socket in the folder of the modules. They need no relay.

JSON by line. Client → daemon: ``{"do": "list"}``, or ``start``, ``stop`` or ``restart`` with ``"module": "base"``.
Daemon → client: ``{"modules": […]}``, each as in the message ``modules`` (SPEC 2.4), or ``{"error": …}``, empty if the
order was accepted. The socket is open to the daemon's own user alone.
"""

from __future__ import annotations

import json
import os
import socket
from pathlib import Path
from typing import Any

import msgspec
from twisted.internet.defer import Deferred, maybeDeferred, succeed
from twisted.internet.error import CannotListenError
from twisted.internet.interfaces import IAddress
from twisted.internet.protocol import Factory
from twisted.logger import Logger
from twisted.protocols.basic import LineReceiver

from relay_protocol.errors import Refused, SwitchboardError, Unavailable
from robot_client.modules.relay_requests import module_info
from robot_client.modules.supervisor import ModuleSupervisor

ORDERS = ("start", "stop", "restart")
SOCKET = "orders.sock"
ANSWER_SECONDS = 10.0


class LocalOrderServer(Factory):
    """Takes orders.

    :param folder: holds a folder for each module
    """

    noisy = False
    log = Logger()

    def __init__(self, supervisor: ModuleSupervisor, folder: Path) -> None:
        self._supervisor = supervisor
        self._folder = folder
        self._port: Any = None
        self._descriptor = -1

    def start(self, reactor: Any) -> None:
        """Listen. A daemon that can't do so runs without local orders, and logs why."""
        try:
            self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            # That of a daemon that was killed.
            (self._folder / SOCKET).unlink(missing_ok=True)
            # A path of the folder's descriptor is short enough for a socket's address.
            self._descriptor = os.open(self._folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
            path = f"/proc/self/fd/{self._descriptor}/{SOCKET}"
            self._port = reactor.listenUNIX(path, self, backlog=8, mode=0o600)
        except (OSError, CannotListenError) as error:
            self.log.error("no orders to modules are taken on the robot itself: {reason}", reason=str(error))

    def stop(self) -> Deferred[None]:
        """Take no more orders."""
        if self._port is None:
            return succeed(None)
        stopped = maybeDeferred(self._port.stopListening)
        # The port removes its socket by the descriptor.
        return stopped.addCallback(lambda _: os.close(self._descriptor))

    def buildProtocol(self, addr: IAddress | None) -> LocalOrderConnection:
        return LocalOrderConnection(self)

    def carry_out(self, line: bytes) -> dict[str, Any]:
        """Carry out an order, and answer it."""
        try:
            order = json.loads(line)
            do, name = order["do"], str(order.get("module", ""))
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
            return {"error": "this is not an order"}
        if do == "list":
            return {"modules": [msgspec.structs.asdict(module_info(each)) for each in self._supervisor]}
        if do not in ORDERS:
            return {"error": f"'{do}' is not 'list', 'start', 'stop' or 'restart'"}
        try:
            module = self._supervisor[name]
        except SwitchboardError as error:
            return {"error": str(error)}
        self.log.info("{action} {module}, by a local order", action=do, module=name)
        getattr(module, do)()
        return {"error": ""}


class LocalOrderConnection(LineReceiver):
    """A client of :class:`LocalOrderServer`."""

    transport: Any
    delimiter = b"\n"

    def __init__(self, server: LocalOrderServer) -> None:
        self._server = server

    def lineReceived(self, line: bytes) -> None:
        self.transport.write(json.dumps(self._server.carry_out(line)).encode() + b"\n")


def send_local_order(folder: Path, do: str, module: str = "") -> dict[str, Any]:
    """Send an order to the daemon of this robot, and wait for its answer.

    :param folder: of the modules
    :raises Unavailable: no daemon runs with this folder, or it does not answer
    :raises Refused: it does not carry the order out
    """
    try:
        answer = json.loads(_exchange(folder, json.dumps({"do": do, "module": module}).encode() + b"\n"))
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "it does not answer"
        text = f"no daemon takes orders in {folder}: {reason}; is 'switchboard-robot run' active?"
        raise Unavailable(text) from None
    if answer.get("error"):
        raise Refused(answer["error"])
    return dict(answer)


def _exchange(folder: Path, line: bytes) -> bytes:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        with socket.socket(socket.AF_UNIX) as connection:
            connection.settimeout(ANSWER_SECONDS)
            connection.connect(f"/proc/self/fd/{descriptor}/{SOCKET}")
            connection.sendall(line)
            with connection.makefile("rb") as answers:
                return answers.readline()
    finally:
        os.close(descriptor)
