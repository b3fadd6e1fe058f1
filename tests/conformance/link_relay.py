"""The relay's side of the robot link (SPEC, section 2), played step by step to check a robot.

It uses plain dicts, so that it can also send messages that no correct relay sends.
"""

from __future__ import annotations

import base64
import contextlib
import json
import secrets
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from relay_protocol import identity

PATIENCE = 30.0
ABSENCE = 0.4
HEARTBEAT = 1.0
RARE = 90.0
"""A heartbeat so rare that a robot which hangs up within :data:`PATIENCE` did not do so for silence."""

PATIENCE_TO_DIAL = 60.0
PATIENCE_AFTER_ANOTHER_NAME = 90.0
"""Seconds until a robot is back: after a loss, and after a relay of another name (SPEC 2.2)."""

FRAME_LIMIT = 2**24
RELAY_JSON_FRAME = 2**22
JSON, SAMPLE, PART, COMMAND = 0, 1, 3, 5
RELAY = "conformance relay"
ENROLMENT_CODE = "conformance"

_HEAD = struct.Struct("!IB")
_SAMPLE = struct.Struct("!IQ")
_PART = struct.Struct("!IQII")
_COMMAND = struct.Struct("!IQI")


class Sample(NamedTuple):
    """One message of a topic: its subscription number, the robot's wall clock (ns), and its body."""

    number: int
    stamp: int
    body: bytes


def frame(kind: int, body: bytes) -> bytes:
    """A frame (SPEC 2.1)."""
    return _HEAD.pack(len(body) + 1, kind) + body


def message(op: str, **fields: Any) -> bytes:
    """The frame of a JSON message."""
    return frame(JSON, json.dumps({"op": op, **fields}).encode())


def sample_frame(number: int, stamp: int, body: bytes) -> bytes:
    """The frame of a sample."""
    return frame(SAMPLE, _SAMPLE.pack(number, stamp) + body)


def command_frame(number: int, stamp: int, source: int, body: bytes) -> bytes:
    """The frame of a command."""
    return frame(COMMAND, _COMMAND.pack(number, stamp, source) + body)


class Link:
    """A connection of a robot. Pings are answered at once by default.

    :param hook: called with every JSON message
    """

    def __init__(self, connection: socket.socket, hook: Callable[[dict[str, Any]], None]) -> None:
        self._connection = connection
        self._hook = hook
        self._waiting: list[Any] = []
        self._parts: dict[int, tuple[tuple[int, int], bytearray]] = {}
        self._change = threading.Condition()
        self.ended = False
        self.broken = ""
        self.pings = 0
        self._orders = 1000
        self.answers_pings = True
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        threading.Thread(target=self._read, daemon=True).start()

    # --- sending ---

    def raw(self, data: bytes) -> None:
        """Sends bytes unchanged. A robot that has disconnected meanwhile is no error here."""
        with contextlib.suppress(OSError):
            self._connection.sendall(data)

    def say(self, op: str, **fields: Any) -> None:
        """Sends a JSON message."""
        self.raw(message(op, **fields))

    def sample(self, number: int, body: bytes, age: float = 0.0) -> None:
        """Sends a sample with a maximum age of ``age`` seconds; below 0 it lies in the future."""
        self.raw(sample_frame(number, max(0, time.monotonic_ns() - int(age * 1e9)), body))

    def command(
        self, number: int, body: bytes, source: int, age: float = 0.0, at: float | None = None
    ) -> None:
        """Sends a command of a source; see :meth:`sample`.

        :param at: in place of ``age``, the earliest time it can have been sent, seconds of :func:`time.monotonic`
        """
        stamp = time.monotonic_ns() - int(age * 1e9) if at is None else int(at * 1e9)
        self.raw(command_frame(number, max(0, stamp), source, body))

    def order(self, op: str, **fields: Any) -> dict[str, Any]:
        """Sends an order about motion; returns the robot's answer."""
        self._orders += 1
        self.say(op, id=self._orders, **fields)
        return self.expect("order_result", id=self._orders)

    def cut(self) -> None:
        """Ends the connection without a message."""
        with self._change:
            self.ended = True
            self._change.notify_all()
        with contextlib.suppress(OSError):
            self._connection.shutdown(socket.SHUT_RDWR)
        self._connection.close()

    # --- receiving ---

    def take(self, what: str, wanted: Callable[[Any], bool], seconds: float = PATIENCE) -> Any:
        """The next matching dict or :class:`Sample`; others are kept."""
        until = time.monotonic() + seconds
        with self._change:
            while True:
                for place, each in enumerate(self._waiting):
                    if wanted(each):
                        return self._waiting.pop(place)
                said = [each.get("op") for each in self._waiting if isinstance(each, dict)]
                assert not self.ended, (
                    f"the robot closed the link before {what} came; it said {said} {self.broken}"
                )
                left = until - time.monotonic()
                assert left > 0, f"no {what} within {seconds:g} s; it said {said}"
                self._change.wait(left)

    def expect(self, op: str, seconds: float = PATIENCE, **like: Any) -> dict[str, Any]:
        """The next message with this ``op`` and these fields."""

        def wanted(each: Any) -> bool:
            return (
                isinstance(each, dict) and each["op"] == op and all(each.get(k) == v for k, v in like.items())
            )

        return dict(self.take(f"'{op}' {like or ''}", wanted, seconds))

    def expect_sample(self, number: int, seconds: float = PATIENCE) -> Sample:
        """The next sample of a number."""
        found: Sample = self.take(
            f"sample of number {number}",
            lambda each: isinstance(each, Sample) and each.number == number,
            seconds,
        )
        return found

    def no_sample(self, number: int, seconds: float = ABSENCE) -> None:
        """Discards received samples; from now on none of this number must arrive."""
        with contextlib.suppress(AssertionError):
            while True:
                self.expect_sample(number, 0.05)
        try:
            self.expect_sample(number, seconds)
        except AssertionError:
            return
        raise AssertionError(f"samples of number {number} still come")

    def wait_end(self, seconds: float = PATIENCE) -> None:
        """Waits until the robot disconnects."""
        until = time.monotonic() + seconds
        with self._change:
            while not self.ended:
                left = until - time.monotonic()
                assert left > 0, f"the robot did not close the link within {seconds:g} s"
                self._change.wait(left)

    def _read(self) -> None:
        with contextlib.suppress(OSError):
            try:
                stream = self._connection.makefile("rb")
                while head := stream.read(5):
                    length, kind = _HEAD.unpack(head)
                    assert 1 <= length <= FRAME_LIMIT, f"a frame of {length} bytes"
                    self._frame(kind, stream.read(length - 1))
            except (AssertionError, ValueError, struct.error, KeyError) as error:
                self.broken = f"(what it sent breaks the contract: {error})"
        self.cut()

    def _frame(self, kind: int, body: bytes) -> None:
        found: Any
        if kind == JSON:
            found = json.loads(body)
            if found["op"] == "ping":
                self.pings += 1
                if self.answers_pings:
                    self.say("pong", t=found["t"], at=time.monotonic_ns())
            self._hook(found)
        elif kind == SAMPLE:
            found = Sample(*_SAMPLE.unpack_from(body), body[_SAMPLE.size :])
        else:
            assert kind == PART, f"a frame of kind {kind}"
            found = self._part(body)
        if found is not None:
            with self._change:
                self._waiting.append(found)
                self._change.notify_all()

    def _part(self, body: bytes) -> Sample | None:
        number, stamp, total, offset = _PART.unpack_from(body)
        if offset == 0:
            self._parts[number] = (stamp, total), bytearray()
        begun, whole = self._parts[number]
        assert begun == (stamp, total), "parts of one sample with two stamps or lengths"
        assert offset == len(whole), "parts of a sample with a gap"
        whole += body[_PART.size :]
        assert len(whole) <= total, "parts of a sample beyond its end"
        if len(whole) < total:
            return None
        del self._parts[number]
        return Sample(number, stamp, bytes(whole))


class LinkRelay:
    """Listens for the robot under test, enrols and registers it, and registers it again after each lost link.

    :param robot: its required name
    """

    def __init__(self, robot: str, host: str = "127.0.0.1", port: int = 0) -> None:
        self.robot = robot
        self.public_key = b""
        self.enrolment: dict[str, Any] = {}
        self.hello: dict[str, Any] = {}
        self.describe: dict[str, Any] = {}
        self.graph: dict[str, dict[str, Any]] = {"topics": {}, "services": {}, "actions": {}, "nodes": {}}
        self.first_graph: dict[str, Any] | None = None
        self._control: Link | None = None
        self._heartbeat = HEARTBEAT
        self._dialled: list[Link] = []
        self._change = threading.Condition()
        self.dials = 0
        self.patience = PATIENCE_TO_DIAL
        self._listener = socket.create_server((host, port))
        self.host, self.port = self._listener.getsockname()[:2]
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        for each in (*self._dialled, self._control):
            if each is not None:
                each.cut()

    def dialled(self, op: str, seconds: float = PATIENCE) -> tuple[Link, dict[str, Any]]:
        """The next connection that begins with this message; ended ones before it are discarded."""
        until = time.monotonic() + seconds
        while True:
            with self._change:
                self._dialled = [each for each in self._dialled if not each.ended]
                links = list(self._dialled)
            for each in links:
                with contextlib.suppress(AssertionError):
                    first = each.expect(op, 0.0)
                    self._dialled.remove(each)
                    return each, first
            assert time.monotonic() < until, f"the robot did not dial with '{op}' within {seconds:g} s"
            time.sleep(0.01)

    def enrol(self, patience: float) -> None:
        """Accepts the robot's key for the code."""
        while not self.public_key:
            link, asked = self.dialled("enroll", patience)
            if (asked.get("robot"), asked.get("code")) != (self.robot, ENROLMENT_CODE):
                link.say(
                    "refused",
                    reason=f"robot {self.robot} and code {ENROLMENT_CODE} are wanted",
                    code="not_found",
                )
                link.cut()
                continue
            self.enrolment = asked
            self.public_key = base64.b64decode(asked["public_key"], validate=True)
            link.say("enrolled", robot=self.robot, relay=RELAY)
            link.wait_end()

    def challenge(self, link: Link, relay: str = RELAY) -> bytes:
        """Challenges a robot after its hello; returns the nonce."""
        nonce = secrets.token_bytes(identity.NONCE_BYTES)
        link.say("challenge", nonce=base64.b64encode(nonce).decode(), relay=relay)
        return nonce

    def register(self, patience: float = 0.0, heartbeat: float = HEARTBEAT) -> Link:
        """Registers the robot when it connects, with its proof checked."""
        link, self.hello = self.dialled("hello", max(patience, self.patience))
        self.patience = PATIENCE_TO_DIAL
        nonce = self.challenge(link)
        signature = base64.b64decode(link.expect("prove")["signature"], validate=True)
        assert identity.verify(self.public_key, RELAY, self.robot, nonce, signature), "the signature is wrong"
        self.describe, self.first_graph = {}, None
        link.say("welcome", session=secrets.token_hex(4), heartbeat=heartbeat, frame_limit=FRAME_LIMIT)
        self._control, self._heartbeat = link, heartbeat
        return link

    def control_with(self, heartbeat: float) -> Link:
        """The control link with this heartbeat in seconds; registers again if it has another."""
        if self._control is None or self._control.ended or self._heartbeat != heartbeat:
            if self._control is not None:
                self._control.cut()
            self.register(heartbeat=heartbeat)
            self.facts()
        return self.control

    @property
    def control(self) -> Link:
        """The control link; registers again if it was lost."""
        if self._control is None or self._control.ended:
            link = self.register()
            self.facts()
            return link
        return self._control

    def facts(self) -> dict[str, Any]:
        """The robot's description, once it has sent it with its graph."""
        until = time.monotonic() + PATIENCE
        while not self.describe or self.first_graph is None:
            assert time.monotonic() < until, "the robot sent no 'describe' and 'graph' after 'welcome'"
            time.sleep(0.01)
        return self.describe

    @contextlib.contextmanager
    def channel(self) -> Iterator[Link]:
        """An open and joined channel link, which is closed at the end."""
        control = self.control
        name, ticket = f"c-{secrets.token_hex(3)}", secrets.token_urlsafe(12)
        control.say("open_channel", channel=name, ticket=ticket)
        link, join = self.dialled("join")
        assert join["ticket"] == ticket
        link.say("joined", channel=name, at=time.monotonic_ns())
        try:
            yield link
        finally:
            control.say("close_channel", channel=name)
            link.cut()

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            with self._change:
                self.dials += 1
                self._dialled.append(Link(connection, self._noted))

    def _noted(self, said: dict[str, Any]) -> None:
        if said["op"] == "describe":
            self.describe = said
        elif said["op"] == "graph":
            if said.get("full"):
                self.graph = {kind: {} for kind in self.graph}
            if self.first_graph is None:
                self.first_graph = said
            for kind, names in self.graph.items():
                names.update(said.get(kind, {}))
                for name in [name for name, value in names.items() if value is None]:
                    del names[name]
