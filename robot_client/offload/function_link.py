"""A function link: dials the relay beside the daemon, proves the robot's identity, sends requests. It has a thread of
its own, so that it works in any program."""

from __future__ import annotations

import itertools
import selectors
import socket
import ssl
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from typing import ClassVar

from relay_protocol import frames
from relay_protocol.clocks import now_ns
from relay_protocol.errors import Invalid, PeerError, SwitchboardError, Unavailable
from relay_protocol.function_link import FUNCTION_FRAME, FunctionReply, decode_reply
from relay_protocol.functions import FAULTS, CallFailed
from relay_protocol.limits import MIB
from robot_client.link.addresses import RelayAddresses
from robot_client.link.enrolment import Enrolment
from robot_client.link.links import ControlLink, Event, Identity, LinkEnded, LinkState, SampleReceived
from robot_client.link.tls import split_address

CONNECT_SECONDS = 5.0
"""Longest time to dial the relay and to prove the identity."""

RECEIVE_BYTES = 256 * 1024

WRITE_BYTES = 64 * 1024

CHECK_SECONDS = 1.0
"""Seconds between two checks whether the relay is silent."""

WAITING_BYTES = 64 * MIB
"""Most bytes of requests that wait until the link has room."""


class FunctionLink(ControlLink):
    """The protocol of a function link: a control link's handshake, then requests and replies in samples."""

    functions: ClassVar[bool] = True

    def _sample(self, frame: frames.Frame) -> list[Event]:
        if self.state is LinkState.REGISTERED and isinstance(frame, frames.SampleFrame):
            return [SampleReceived(frame)]
        return super()._sample(frame)

    def registered(self) -> bool:
        """Whether the relay has accepted it; from then on frames may be large."""
        if self.state is LinkState.REGISTERED:
            self._frames.limit = FUNCTION_FRAME
        return self.state is LinkState.REGISTERED


class Overtaken(Unavailable):
    """The call gave way to a newer one before it was sent."""

    code = "overtaken"


class Reply:
    """The answer to one request.

    :ivar future: its last reply
    :ivar on_progress: called with others, in the receiver's thread
    """

    def __init__(self, number: int, body: bytes, newest: str) -> None:
        self.number = number
        self.body = body
        self.newest = newest
        self.sent = False
        self.future: Future[FunctionReply] = Future()
        self.on_progress: Callable[[FunctionReply], None] = _ignore

    def fail(self, error: SwitchboardError) -> None:
        """There is no answer."""
        if not self.future.done():
            self.future.set_exception(error)


def _ignore(reply: FunctionReply) -> None:
    """Progress that no one follows."""


class FunctionConnection:
    """A connected function link with its thread.

    :raises Unavailable: the relay can't be reached
    :raises SwitchboardError: the relay refuses the robot, or a setting can't be used
    """

    def __init__(self, enrolment: Enrolment, identity: Identity) -> None:
        self._link = FunctionLink(identity, "robot_client.offload", now_ns)
        self._numbers = itertools.count(1)
        self._lock = threading.Lock()
        self._waiting: deque[Reply] = deque()
        self._replies: dict[int, Reply] = {}
        self._out: deque[memoryview] = deque()
        self._reason = "the relay closed the connection"
        self._check_at = 0.0
        self.open = True
        self._socket = _dial(enrolment)
        try:
            self._greet()
        except OSError as error:
            self._socket.close()
            raise Unavailable(f"the relay at {enrolment.address} does not answer: {error}") from None
        except SwitchboardError:
            self._socket.close()
            raise
        self._wake, self._woken = socket.socketpair()
        self._wake.setblocking(False)
        self._woken.setblocking(False)
        self._socket.setblocking(False)
        threading.Thread(target=self._run, name="functions", daemon=True).start()

    def begin(self, body: bytes, newest: str = "") -> Reply:
        """Send a request.

        :param body: MessagePack
        :param newest: of requests of the same text one is under way; of those that wait for its answer only
            the newest is sent
        :raises Unavailable: the link is lost, or too much waits for it
        """
        reply = Reply(next(self._numbers), body, newest)
        with self._lock:
            if not self.open:
                raise Unavailable(f"the link to the relay is lost ({self._reason})")
            overtaken = [old for old in self._waiting if newest and old.newest == newest]
            waiting = sum(len(each.body) for each in self._waiting if each not in overtaken)
            if waiting and waiting + len(body) > WAITING_BYTES:
                raise Unavailable(f"{waiting} bytes of calls wait for the slow link to the relay already")
            for each in overtaken:
                self._waiting.remove(each)
                del self._replies[each.number]
            self._waiting.append(reply)
            self._replies[reply.number] = reply
        for each in overtaken:
            each.fail(Overtaken("a newer call took its place while an earlier one was under way"))
        self._wake_up()
        return reply

    def withdraw(self, reply: Reply) -> bool:
        """Take a request back; false if it was sent, or has its answer."""
        with self._lock:
            if reply not in self._waiting:
                return False
            self._waiting.remove(reply)
            self._replies.pop(reply.number, None)
        return True

    def close(self, reason: str) -> None:
        """End the link; calls without an answer fail."""
        with self._lock:
            if not self.open:
                return
            self.open, self._reason = False, reason
            replies, self._replies = self._replies, {}
            self._waiting.clear()
        self._wake_up()
        for each in replies.values():
            if each.sent:
                each.fail(
                    CallFailed("lost", f"the link to the relay is lost ({reason}); the call may have run")
                )
            else:
                each.fail(Unavailable(f"the link to the relay is lost ({reason})"))

    def _wake_up(self) -> None:
        with suppress(OSError):
            self._wake.send(b"x")

    def _greet(self) -> None:
        self._socket.settimeout(CONNECT_SECONDS)
        self._link.begin()
        while True:
            for each in self._link.take():
                self._socket.sendall(each)
            if self._link.registered():
                return
            data = self._socket.recv(RECEIVE_BYTES)
            if not data:
                raise Unavailable("the relay closed the connection")
            self._link.receive(data)

    # --- the thread ---------------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            with selectors.DefaultSelector() as selector:
                selector.register(self._woken, selectors.EVENT_READ)
                selector.register(self._socket, selectors.EVENT_READ)
                while self.open:
                    self._step(selector)
        except Exception as error:
            self._reason = str(error) or type(error).__name__
        # After an error of any kind: a link that stays open without its thread would answer nothing.
        self.close(self._reason)
        self._socket.close()
        self._woken.close()
        self._wake.close()

    def _step(self, selector: selectors.BaseSelector) -> None:
        """Write and read what is possible, then wait for more."""
        self._write()
        if self._read():
            return
        self._fill()
        wanted = selectors.EVENT_READ | (selectors.EVENT_WRITE if self._out else 0)
        selector.modify(self._socket, wanted)
        selector.select(CHECK_SECONDS)
        now = time.monotonic()
        if now >= self._check_at:
            self._check_at = now + CHECK_SECONDS
            self._link.check_silence()
        with suppress(BlockingIOError):
            self._woken.recv(4096)

    def _read(self) -> bool:
        """Whether anything was received."""
        try:
            data = self._socket.recv(RECEIVE_BYTES)
        except (BlockingIOError, ssl.SSLWantReadError, ssl.SSLWantWriteError):
            return False
        if not data:
            raise Unavailable(self._reason)
        for event in self._link.receive(data):
            if isinstance(event, SampleReceived):
                self._received(event.frame)
            elif isinstance(event, LinkEnded):
                self._reason = event.reason
        return True

    def _fill(self) -> None:
        """Take what is to be written next: answers to pings first, then one request."""
        self._out.extend(map(memoryview, self._link.take()))
        if self._out:
            return
        with self._lock:
            busy = {each.newest for each in self._replies.values() if each.sent and each.newest}
            reply = next((each for each in self._waiting if each.newest not in busy), None)
            if reply is None:
                return
            self._waiting.remove(reply)
            reply.sent = True
        size = len(reply.body) + frames.SAMPLE_HEAD
        self._out.append(memoryview(frames.pack_sample_head(size, frames.SAMPLE, reply.number, 0)))
        self._out.append(memoryview(reply.body))
        reply.body = b""

    def _write(self) -> None:
        self._fill()
        while self._out:
            try:
                written = self._socket.send(self._out[0][:WRITE_BYTES])
            except (BlockingIOError, ssl.SSLWantReadError, ssl.SSLWantWriteError):
                return
            self._out[0] = self._out[0][written:]
            if not self._out[0]:
                self._out.popleft()
                self._fill()

    def _received(self, frame: frames.SampleFrame) -> None:
        try:
            answer = decode_reply(frame.body)
        except FAULTS as error:
            raise PeerError(f"the relay sent no reply: {error}") from None
        with self._lock:
            reply = self._replies.pop(frame.number, None) if answer.final else self._replies.get(frame.number)
        if reply is None:
            return
        if answer.final:
            reply.future.set_result(answer)
        else:
            reply.on_progress(answer)


def _dial(enrolment: Enrolment) -> socket.socket:
    *others, last = RelayAddresses(enrolment.address)
    for each in others:
        with suppress(Unavailable):
            return _dial_address(enrolment, each)
    return _dial_address(enrolment, last)


def _dial_address(enrolment: Enrolment, address: str) -> socket.socket:
    host, port = split_address(address)
    try:
        plain = socket.create_connection((host, port), CONNECT_SECONDS)
        plain.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if not enrolment.tls:
            return plain
        context = ssl.create_default_context(cafile=enrolment.ca or None)
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        return context.wrap_socket(plain, server_hostname=enrolment.server_name or host)
    except ssl.SSLCertVerificationError as error:
        raise Invalid(f"the relay's certificate is refused: {error.verify_message}") from None
    except OSError as error:
        raise Unavailable(f"the relay at {address} can't be reached: {error}") from None
