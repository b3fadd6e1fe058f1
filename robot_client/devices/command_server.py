"""A module that takes commands for other modules by TCP.

Frames are those of the robot link (SPEC 2.1): u32 big-endian length, u8 kind 0, JSON.
docs/guides/remote_goals.md describes the messages.
"""

from __future__ import annotations

import hmac
import ipaddress
import json
import os
import secrets
import socket
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from twisted.internet import reactor as default_reactor
from twisted.internet.protocol import Factory, connectionDone
from twisted.internet.protocol import Protocol as TwistedProtocol
from twisted.python.failure import Failure

from relay_protocol.errors import PeerError
from relay_protocol.frames import FrameDecoder, JsonFrame, encode_json
from relay_protocol.jsontext import decode_any
from robot_client.devices.module import Call, Module
from robot_client.modules.command_relay import MESSAGE_BYTES
from robot_client.modules.module_run import connect_runner
from robot_client.modules.processes import FOLDER

reactor: Any = default_reactor

CONNECTIONS = 16
"""Most clients at a time that may send commands."""

UNPROVED_CONNECTIONS = 8
"""Most connections at a time that have not proved that they know the secret; then the oldest of them is closed."""

PROOF_SECONDS = 5.0
"""A client has so long for that proof."""

PROOF_FRAME = 256
"""Longest frame of a client that has not proved that it knows the secret, bytes."""

COMMAND_FRAME = MESSAGE_BYTES - 1024
"""Longest frame after that; there must be room for what the runner adds."""

FRAME_SECONDS = 10.0
"""A client has so long for each frame, from its first byte to its last."""

CLIENT_COMMANDS = 32
"""Most commands of a client without an answer."""

LONGEST_ID = 60

DEAD_SECONDS = 6
"""A client whose machine no longer answers is noticed within this time."""

SECRET_BYTES = 16
"""Shortest secret."""


class ModuleLink(Protocol):
    """A connection to a module's runner, as :class:`robot_client.modules.module_run.RunnerLink`."""

    def order(self, order: str, **more: Any) -> None:
        """Send one message."""

    def close(self) -> None:
        """End it."""


OpenModule = Callable[[str, Callable[[dict[str, Any]], None], Callable[[], None]], ModuleLink]
"""Connects to the module of a name, with functions for its messages and its end. Raises OSError where it does not
run."""


class ConnectionPlaces:
    """The connections of one server. Those that have proved nothing take no place of the others."""

    def __init__(self) -> None:
        self._unproved: list[CommandConnection] = []
        """The oldest first."""
        self._clients: set[CommandConnection] = set()

    def enter(self, connection: CommandConnection) -> None:
        """Add a connection that has to prove that it knows the secret; the oldest may have to leave for it."""
        self._unproved.append(connection)
        if len(self._unproved) > UNPROVED_CONNECTIONS:
            self._unproved.pop(0).refuse(
                f"{UNPROVED_CONNECTIONS} newer connections have not sent their proof either; connect again"
            )

    def admit(self, connection: CommandConnection) -> None:
        """Let a connection send commands.

        :raises PeerError: too many may do so
        """
        if len(self._clients) >= CONNECTIONS:
            raise PeerError(f"{CONNECTIONS} clients are connected, the most at a time; try again later")
        self._clients.add(connection)
        self._forget(connection)

    def leave(self, connection: CommandConnection) -> None:
        """Remove a connection that has ended."""
        self._clients.discard(connection)
        self._forget(connection)

    def _forget(self, connection: CommandConnection) -> None:
        if connection in self._unproved:
            self._unproved.remove(connection)


class CommandConnection(TwistedProtocol):
    """One client.

    :param modules: names of the modules that it may command
    :param secret: that it must know; empty: none
    :param open_module: connects to a module
    :param clock: for time limits
    :param places: the server's connections
    """

    transport: Any

    def __init__(
        self,
        *,
        modules: list[str],
        secret: bytes,
        open_module: OpenModule,
        clock: Any,
        places: ConnectionPlaces,
    ) -> None:
        self._modules = modules
        self._secret = secret
        self._open_module = open_module
        self._clock = clock
        self._places = places
        self._challenge = secrets.token_hex(32) if secret else ""
        self._trusted = False
        self._refused = False
        self._decoder = FrameDecoder(PROOF_FRAME if secret else COMMAND_FRAME)
        self._links: dict[str, ModuleLink] = {}
        self._waiting: dict[int, tuple[str, Any]] = {}
        """Commands without an answer: module, and the client's id."""
        self._count = 0
        self._timer: Any = None
        self._full = False
        self._missed: dict[str, int] = {}
        """By module: feedback that was dropped because the client does not read."""

    def connectionMade(self) -> None:
        """Send the challenge."""
        self.transport.registerProducer(self, True)
        self._send(hello="switchboard commands", challenge=self._challenge)
        if self._secret:
            self._places.enter(self)
            self._limit_time(PROOF_SECONDS, "the proof")
            return
        try:
            self._admit()
        except PeerError as error:
            self.refuse(str(error))

    def dataReceived(self, data: bytes) -> None:
        """Take bytes of the client; any error ends the connection with its text."""
        if self._refused:
            return
        try:
            frames = self._decoder.feed(data)
            for frame in frames:
                if not isinstance(frame, JsonFrame):
                    raise PeerError("only frames of kind 0 (JSON) are taken here")
                self._received(frame.body)
        except PeerError as error:
            self.refuse(str(error))
            return
        if frames and self._trusted:
            self._end_limit()
        if self._decoder.buffered and self._timer is None:
            self._limit_time(FRAME_SECONDS, "a frame")

    def connectionLost(self, reason: Failure = connectionDone) -> None:
        """Leave all modules, which end what this client began."""
        self._end_limit()
        for link in self._links.values():
            link.close()
        self._places.leave(self)

    # --- messages of the client -------------------------------------------------------------------------------

    def _received(self, body: bytes) -> None:
        message = decode_any(body)
        if not isinstance(message, dict):
            raise PeerError("a message is a JSON object")
        if not self._trusted:
            self._prove(message.get("proof"))
        else:
            self._command(message)

    def _prove(self, proof: Any) -> None:
        expected = hmac.digest(self._secret, self._challenge.encode(), "sha256").hex()
        given = proof.encode(errors="replace") if isinstance(proof, str) else b""
        if not hmac.compare_digest(given, expected.encode()):
            raise PeerError(
                "the proof is wrong: it is HMAC-SHA256 of the challenge with the secret as key, in hex"
            )
        self._admit()

    def _admit(self) -> None:
        """:raises PeerError: too many clients are connected"""
        self._places.admit(self)
        self._trusted = True
        self._decoder.limit = COMMAND_FRAME
        self._end_limit()
        self._send(welcome=True, modules=self._modules)

    def _command(self, message: dict[str, Any]) -> None:
        id, name = message.get("id"), message.get("module")
        if not isinstance(id, int | str) or len(str(id)) > LONGEST_ID:
            raise PeerError(f"id must be a number or a text of at most {LONGEST_ID} characters")
        if not isinstance(name, str) or name not in self._modules:
            names = ", ".join(self._modules)
            self._answer(id, f"there is no such module; commands are taken for: {names}")
        elif len(self._waiting) >= CLIENT_COMMANDS:
            self._answer(id, f"{CLIENT_COMMANDS} commands wait for their answers; send this one again later")
        else:
            self._pass_on(id, name, message)

    def _pass_on(self, id: Any, name: str, message: dict[str, Any]) -> None:
        try:
            link = self._link(name)
        except OSError:
            self._answer(id, f"the module {name} does not run")
            return
        if "command" not in message:
            # It only listens.
            self._answer(id, "")
            return
        if len(json.dumps(message["command"], ensure_ascii=False).encode()) > COMMAND_FRAME:
            self._answer(id, f"the command is too long; at most {COMMAND_FRAME} bytes are passed on")
            return
        self._count += 1
        self._waiting[self._count] = name, id
        link.order("command", id=self._count, value=message["command"])

    # --- messages of modules ----------------------------------------------------------------------------------

    def _link(self, name: str) -> ModuleLink:
        if name not in self._links:
            made = self._open_module(
                name, partial(self._from_module, name), partial(self._module_ended, name)
            )
            self._links[name] = made
            made.order("listen")
        return self._links[name]

    def _from_module(self, name: str, message: dict[str, Any]) -> None:
        event = message.get("event")
        if event == "answer":
            _, id = self._waiting.pop(message["id"], (name, None))
            self._answer(id, message["error"])
        elif event == "feedback" and self._full:
            self._missed[name] = self._missed.get(name, 0) + 1
        elif event == "feedback":
            missed = self._missed.pop(name, 0)
            self._send(module=name, feedback=message["value"], **({"missed": missed} if missed else {}))

    def _module_ended(self, name: str) -> None:
        self._links.pop(name, None)
        for number in [number for number, each in self._waiting.items() if each[0] == name]:
            self._answer(self._waiting.pop(number)[1], f"the module {name} has ended")
        self._send(module=name, ended=True)

    # --- the connection ---------------------------------------------------------------------------------------

    def pauseProducing(self) -> None:
        """The client does not read: drop feedback, and take no more commands."""
        self._full = True
        self.transport.pauseProducing()

    def resumeProducing(self) -> None:
        """The client reads again."""
        self._full = False
        self.transport.resumeProducing()

    def stopProducing(self) -> None:
        """The connection has ended."""

    def _answer(self, id: Any, error: str) -> None:
        self._send(id=id, error=error)

    def _send(self, **message: Any) -> None:
        self.transport.write(encode_json(json.dumps(message).encode()))

    def _limit_time(self, seconds: float, what: str) -> None:
        self._timer = self._clock.callLater(seconds, self.refuse, f"{what} took longer than {seconds:g} s")

    def _end_limit(self) -> None:
        if self._timer is not None and self._timer.active():
            self._timer.cancel()
        self._timer = None

    def refuse(self, why: str) -> None:
        """End the connection with a reason."""
        self._refused = True
        self._send(error=why)
        self._end_limit()
        self.transport.unregisterProducer()
        self.transport.loseConnection()
        # It may not read this.
        self._timer = self._clock.callLater(FRAME_SECONDS, self.transport.abortConnection)


class CommandServer(Module):
    """Takes commands for modules by TCP.

    :param modules: names of the modules that clients may command
    :param port: to listen at
    :param host: address to listen at
    :param secret_file: file with the secret that clients must know, readable by its owner alone; at least 16 bytes.
        Required unless ``host`` is a loopback address
    :raises ValueError: the secret is missing, too short or readable by others
    """

    def __init__(self, modules: list[str], port: int, host: str = "127.0.0.1", secret_file: str = "") -> None:
        self._secret = read_secret(Path(secret_file)) if secret_file else b""
        if not self._secret and not is_loopback(host):
            raise ValueError(f"{host} can be reached from other machines, so secret_file is needed")
        self._modules = modules
        self._address = host, port
        self._folder = Path(os.environ.get(FOLDER, "."))
        self._places = ConnectionPlaces()

    def start(self) -> None:
        """Listen."""
        factory = _CommandFactory(self._connected)
        port = reactor.listenTCP(self._address[1], factory, interface=self._address[0])
        address = port.getHost()
        print(f"listening at {address.host}:{address.port}", flush=True)

    def _connected(self) -> CommandConnection:
        return _KeptAlive(
            modules=self._modules,
            secret=self._secret,
            open_module=self._open_module,
            clock=reactor,
            places=self._places,
        )

    def _open_module(
        self, name: str, on_message: Callable[[dict[str, Any]], None], on_lost: Callable[[], None]
    ) -> ModuleLink:
        return connect_runner(reactor, self._folder / name, on_message, on_lost)

    def _host_run(self) -> None:
        """Run the reactor until :meth:`_host_end`."""
        reactor.run(installSignalHandlers=False)

    def _host_end(self) -> None:
        """See :class:`Module`."""
        reactor.callFromThread(reactor.callWhenRunning, reactor.stop)

    def _host_post(self, call: Call) -> None:
        """See :class:`Module`."""
        reactor.callFromThread(call)


class _CommandFactory(Factory):
    noisy = False

    def __init__(self, build: Callable[[], CommandConnection]) -> None:
        self._build = build

    def buildProtocol(self, addr: Any) -> CommandConnection:
        return self._build()


class _KeptAlive(CommandConnection):
    """Notices a client whose machine is gone (tcp(7)): its targets must not be driven to any further."""

    def connectionMade(self) -> None:
        handle = self.transport.getHandle()
        handle.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in (
            ("TCP_KEEPIDLE", DEAD_SECONDS // 2),
            ("TCP_KEEPINTVL", 1),
            ("TCP_KEEPCNT", DEAD_SECONDS // 2),
            ("TCP_USER_TIMEOUT", DEAD_SECONDS * 1000),
        ):
            if hasattr(socket, name):
                handle.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
        super().connectionMade()


def is_loopback(host: str) -> bool:
    """Whether an address can only be reached from this machine; names count as reachable."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def read_secret(path: Path) -> bytes:
    """The secret in a file, without white space around it.

    :raises ValueError: it can't be read, is too short, or others may read it
    """
    try:
        if path.stat().st_mode & 0o077:
            raise ValueError(f"{path} may be read by others: chmod 600 {path}")
        found = path.read_bytes().strip()
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}") from None
    if len(found) < SECRET_BYTES:
        raise ValueError(f"the secret in {path} has {len(found)} bytes; it needs at least {SECRET_BYTES}")
    return found
