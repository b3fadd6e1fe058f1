"""A relay for tests: real TCP, real frames of the contract, controlled step by step by the test."""

from __future__ import annotations

import contextlib
import queue
import secrets
import socket
import ssl
import threading
import time
from typing import Any, TypeVar

import msgspec

from relay_protocol import frames, identity, link
from relay_protocol.errors import PeerError
from relay_protocol.link.motion import ControlOrder

T = TypeVar("T", bound=link.Message | frames.SampleFrame | frames.VideoFrame)
PATIENCE = 60.0


class Peer:
    """One accepted connection."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._decoder = frames.FrameDecoder(2**25)
        self._pictures = frames.VideoFrameJoiner(2**25)
        self._inbox: queue.Queue[Any] = queue.Queue()
        self.read = link.handshake_request_decoder
        self.skipped: list[Any] = []
        self.takes = True
        """Whether pictures are answered at once."""
        self.answers = True
        """Whether pings are."""
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        try:
            while data := self._connection.recv(65536):
                for frame in self._decoder.feed(data):
                    self._take(frame)
        except (OSError, PeerError, msgspec.DecodeError):
            self.cut()
        self._inbox.put(None)

    def _take(self, frame: frames.Frame) -> None:
        if isinstance(frame, frames.VideoFramePart):
            whole = self._pictures.join(frame)
            if whole is None:
                if self.takes:
                    self.send(link.FrameAck(number=frame.number, received=self._pictures.size))
                return
            frame = whole
        if not isinstance(frame, frames.JsonFrame):
            if isinstance(frame, frames.VideoFrame) and self.takes:
                self.send(link.FrameAck(number=frame.number))
            self._inbox.put(frame)
            return
        message = self.read.decode(frame.body)
        if isinstance(message, link.Prove):
            self.read = link.robot_control_decoder
        elif isinstance(message, link.Join):
            self.read = link.robot_channel_decoder
        if isinstance(message, link.Ping):
            if self.answers:
                self.send(link.Pong(t=message.t, at=time.monotonic_ns()))
        else:
            self._inbox.put(message)

    def send(self, message: link.Message) -> None:
        self.raw(link.frame(message))

    def sample(self, number: int, body: bytes, age: float = 0.0) -> None:
        self.raw(frames.encode_sample(number, time.monotonic_ns() - int(age * 1e9), body))

    def command(self, number: int, body: bytes, age: float = 0.0, source: int = 1) -> None:
        self.raw(frames.encode_command(number, time.monotonic_ns() - int(age * 1e9), source, body))

    def order(self, message: ControlOrder) -> link.OrderResult:
        """Sends a command; returns the robot's answer."""
        self.send(message)
        while (done := self.expect(link.OrderResult)).id != message.id:
            self.skipped.append(done)
        return done

    def raw(self, data: bytes) -> None:
        with contextlib.suppress(OSError):
            self._connection.sendall(data)

    def expect(self, kind: type[T], timeout: float = PATIENCE) -> T:
        """The next message of a kind; others are ignored."""
        deadline = time.monotonic() + timeout
        while True:
            message = self._inbox.get(timeout=max(0.01, deadline - time.monotonic()))
            assert message is not None, (
                f"the robot hung up before it said {kind.__name__}; it said {self.skipped[-5:]}"
            )
            if isinstance(message, kind):
                return message
            self.skipped.append(message)

    def expect_sample(self, timeout: float = PATIENCE) -> frames.SampleFrame:
        return self.expect(frames.SampleFrame, timeout)

    def expect_end(self, timeout: float = PATIENCE) -> list[Any]:
        """Waits until the robot disconnects; returns the messages before that."""
        deadline = time.monotonic() + timeout
        said = []
        while (message := self._inbox.get(timeout=max(0.01, deadline - time.monotonic()))) is not None:
            said.append(message)
        return said

    def cut(self) -> None:
        with contextlib.suppress(OSError):
            self._connection.shutdown(socket.SHUT_RDWR)
        self._connection.close()


class FakeRelay:
    """Listens; the test answers robots."""

    def __init__(self, name: str = "relay-1", tls: ssl.SSLContext | None = None) -> None:
        self.name = name
        self.public_key = b""
        self._tls = tls
        self._peers: queue.Queue[Peer] = queue.Queue()
        self._all: list[Peer] = []
        self.port = 0
        self.open()

    def open(self) -> None:
        self._listener = socket.create_server(("127.0.0.1", self.port))
        self.port = self._listener.getsockname()[1]
        threading.Thread(target=self._serve, args=(self._listener,), daemon=True).start()

    def _serve(self, listener: socket.socket) -> None:
        while True:
            try:
                connection, _ = listener.accept()
            except OSError:
                return
            try:
                if self._tls is not None:
                    connection = self._tls.wrap_socket(connection, server_side=True)
            except (OSError, ssl.SSLError):
                connection.close()
                continue
            peer = Peer(connection)
            self._all.append(peer)
            self._peers.put(peer)

    @property
    def address(self) -> str:
        return f"127.0.0.1:{self.port}"

    def accept(self, timeout: float = PATIENCE) -> Peer:
        return self._peers.get(timeout=timeout)

    def enroll(self) -> link.Enroll:
        peer = self.accept()
        asked = peer.expect(link.Enroll)
        self.public_key = link.from_base64(asked.public_key, "public_key")
        peer.send(link.Enrolled(robot=asked.robot, relay=self.name))
        return asked

    def challenge(self, peer: Peer) -> tuple[link.Hello, bytes]:
        hello = peer.expect(link.Hello)
        nonce = secrets.token_bytes(32)
        peer.send(link.Challenge(nonce=link.to_base64(nonce), relay=self.name))
        return hello, nonce

    def register(self, heartbeat: float = 1.0) -> Peer:
        """Registers one robot, with its proof checked."""
        peer = self.accept()
        hello, nonce = self.challenge(peer)
        proof = link.from_base64(peer.expect(link.Prove).signature, "signature")
        assert identity.verify(self.public_key, self.name, hello.robot, nonce, proof)
        peer.send(link.Welcome(session="s", heartbeat=heartbeat, frame_limit=2**24))
        return peer

    def channel(self, control: Peer, name: str = "c1") -> Peer:
        """Requests a channel, and waits until the robot has joined."""
        ticket = secrets.token_hex(8)
        control.send(link.OpenChannel(channel=name, ticket=ticket))
        peer = self.accept()
        assert peer.expect(link.Join).ticket == ticket
        peer.send(link.Joined(channel=name, at=time.monotonic_ns()))
        return peer

    def video(
        self, control: Peer, camera: str, settings: link.VideoSettings | None = None, name: str = "s1"
    ) -> Peer:
        """Requests a camera stream, and waits until the robot has joined."""
        ticket = secrets.token_hex(8)
        wanted = settings or link.VideoSettings()
        control.send(link.OpenVideo(stream=name, ticket=ticket, camera=camera, settings=wanted))
        peer = self.accept()
        assert peer.expect(link.Join).ticket == ticket
        peer.read = link.robot_video_decoder
        peer.send(link.Joined(channel=name, at=time.monotonic_ns()))
        return peer

    def close(self) -> None:
        # Wakes the thread in accept(), which close() alone would not.
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        for peer in self._all:
            peer.cut()
        self._all.clear()
