"""A network that can be broken, between any two peers."""

from __future__ import annotations

import contextlib
import socket
import threading
import time

PACKET_BYTES = 1460
"""What goes at once over a thin line."""


class _Line:
    """One direction, shared by all connections."""

    def __init__(self) -> None:
        self.bytes = 0
        self._rate: float | None = None
        self._free_at = 0.0
        self._lock = threading.Lock()

    def squeeze(self, bits_per_second: float | None) -> None:
        with self._lock:
            self._rate = None if bits_per_second is None else bits_per_second / 8

    def send(self, sink: socket.socket, data: bytes) -> None:
        """Packet by packet on a slow line, so that connections take turns."""
        rest = memoryview(data)
        while rest:
            with self._lock:
                rate = self._rate
                packet = rest if rate is None else rest[:PACKET_BYTES]
                self._free_at = max(self._free_at, time.monotonic()) if rate else 0.0
                if rate:
                    self._free_at += len(packet) / rate
                free_at = self._free_at
            # A packet arrives with its last bit: after the time that a link of this rate needs for all
            # before it.
            time.sleep(max(0.0, free_at - time.monotonic()))
            sink.sendall(packet)
            rest = rest[len(packet) :]
            with self._lock:
                self.bytes += len(packet)


def _twin_server(host: str) -> socket.socket:
    """A server whose port is free at 127.0.0.1 too."""
    while True:
        server = socket.create_server((host, 0))
        with contextlib.suppress(OSError), socket.create_server(("127.0.0.1", server.getsockname()[1])):
            return server
        server.close()


class ChaosProxy:
    """A TCP proxy on loopback that can drop bytes, limit the rate in either direction, add a delay, or reset
    everything.

    :param target: its target port; 0: the same port of 127.0.0.1 as its own, which is free
    :param buffer: approximate bytes that its kernel takes from the target before they are passed on;
        unlimited by default. A network without a proxy acknowledges nothing that the client has not received.
    :param host: its own address
    """

    def __init__(self, target: int, buffer: int | None = None, host: str = "127.0.0.1") -> None:
        self._buffer = buffer
        self._up, self._down = _Line(), _Line()
        self.seconds_away = 0.0
        """By so much later what comes leaves, each way."""
        self._server = socket.create_server((host, 0)) if target else _twin_server(host)
        self.port = int(self._server.getsockname()[1])
        self._target = target or self.port
        self._open: set[socket.socket] = set()
        self._lock = threading.Lock()
        self.forward_up = threading.Event()
        self.forward_down = threading.Event()
        self.forward_up.set()
        self.forward_down.set()
        self._closing = False
        threading.Thread(target=self._accept, daemon=True).start()

    def black_hole(self) -> None:
        """No byte passes any more, without notice. Arriving bytes are stored, as in a network's queues."""
        self.forward_up.clear()
        self.forward_down.clear()

    def heal(self) -> None:
        """All bytes pass again, however late."""
        self.forward_up.set()
        self.forward_down.set()

    @property
    def up(self) -> int:
        """Bytes sent to the target, over all connections."""
        return self._up.bytes

    def squeeze(self, bits_per_second: float | None) -> None:
        """From now on all connections share an uplink of this rate; ``None``: unlimited."""
        self._up.squeeze(bits_per_second)

    def squeeze_down(self, bits_per_second: float | None) -> None:
        """The same for bytes from the target."""
        self._down.squeeze(bits_per_second)

    def reset(self) -> None:
        """Cuts all connections at once."""
        with self._lock:
            for each in list(self._open):
                with contextlib.suppress(OSError):
                    each.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self._closing = True
        self._server.close()
        self.heal()
        self.reset()

    def _accept(self) -> None:
        while not self._closing:
            try:
                near, _ = self._server.accept()
                far = self._dial()
            except OSError:
                if self._closing:
                    return
                with contextlib.suppress(OSError, UnboundLocalError):
                    near.close()
                continue
            far.settimeout(None)
            for each in (near, far):
                each.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            with self._lock:
                self._open |= {near, far}
            over: list[int] = []
            ways = (
                (near, far, self.forward_up, self._up, over),
                (far, near, self.forward_down, self._down, over),
            )
            for way in ways:
                threading.Thread(target=self._pump, args=way, daemon=True).start()

    def _dial(self) -> socket.socket:
        far = socket.socket()
        try:
            if self._buffer is not None:
                far.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, self._buffer)
            far.settimeout(5)
            far.connect(("127.0.0.1", self._target))
        except OSError:
            far.close()
            raise
        return far

    def _pump(
        self, source: socket.socket, sink: socket.socket, gate: threading.Event, line: _Line, over: list[int]
    ) -> None:
        how = socket.SHUT_RDWR
        try:
            while data := source.recv(65536):
                gate.wait()
                # Bytes that arrive meanwhile are sent with the next ones.
                time.sleep(self.seconds_away)
                line.send(sink, data)
            # The other direction may continue.
            how = socket.SHUT_WR
        except OSError:
            pass
        finally:
            gate.wait()
            with contextlib.suppress(OSError):
                sink.shutdown(how)
            if how == socket.SHUT_RDWR:
                with contextlib.suppress(OSError):
                    source.shutdown(how)
            with self._lock:
                over.append(1)
                last = len(over) == 2
                if last:
                    self._open -= {source, sink}
            if last:
                source.close()
                sink.close()
