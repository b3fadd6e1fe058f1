"""A network camera: RTSP 1.0, frames in the same TCP connection (RFC 2326, 10.12), H.264 in RTP (RFC 6184).

It shows a red square on grey ground, with each frame's number in black and white squares below it.
"""

from __future__ import annotations

import base64
import contextlib
import re
import socket
import struct
import threading
from collections.abc import Iterator
from fractions import Fraction

import av
import numpy as np
import numpy.typing as npt

WIDTH, HEIGHT = 160, 120
FPS = 25
_BIT = 20
"""Side of a square that stands for a bit, pixels."""

_PACKET = 1200
"""Most bytes of a unit in one packet."""
_FRAGMENT = 28
"""Type of a unit that holds a part of another one: FU-A."""
_CLOCK = 90_000
_START = re.compile(rb"\x00{2,}\x01")

_SDP = """v=0\r
o=- 1 1 IN IP4 127.0.0.1\r
s=camera\r
t=0 0\r
m=video 0 RTP/AVP 96\r
c=IN IP4 0.0.0.0\r
a=rtpmap:96 H264/90000\r
a=fmtp:96 packetization-mode=1\r
a=control:track\r
"""


def card(number: int) -> npt.NDArray[np.uint8]:
    """The image of a number, with its last eight bits, in the order blue, green, red."""
    picture = np.full((HEIGHT, WIDTH, 3), 120, np.uint8)
    picture[: HEIGHT // 2, : WIDTH // 2] = (0, 0, 220)
    for bit in range(WIDTH // _BIT):
        picture[-_BIT:, bit * _BIT : (bit + 1) * _BIT] = 255 * (number >> bit & 1)
    return picture


def number_of(picture: npt.NDArray[np.uint8]) -> int:
    """The number of an image, as far as it is visible."""
    middles = picture[-_BIT // 2, _BIT // 2 :: _BIT].mean(1)
    return sum(1 << bit for bit, shade in enumerate(middles) if shade > 128)


class RtspCamera:
    """Listens on loopback until it is closed; each connection has its own film.

    :param port: where; 0 for any free one
    :param login: required user and password, in the form of an address
    """

    def __init__(self, port: int = 0, login: str = "") -> None:
        self.visits = 0
        """Connections so far."""
        self.newest = 0
        """Number of the last picture that was sent."""
        self._login = login
        self._flows = threading.Event()
        self._flows.set()
        self._over = threading.Event()
        self._lock = threading.Lock()
        self._open: set[socket.socket] = set()
        self._threads: list[threading.Thread] = []
        self._listener = socket.create_server(("127.0.0.1", port))
        self.port = int(self._listener.getsockname()[1])
        self._begin(self._accept)

    @property
    def url(self) -> str:
        """Its address, with the login."""
        return f"rtsp://{self._login}{'@' * bool(self._login)}127.0.0.1:{self.port}/front"

    def stall(self) -> None:
        """Sends nothing more, but stays connected, and accepts connections."""
        self._flows.clear()

    def goes_on(self) -> None:
        """Continues to send."""
        self._flows.set()

    def close(self) -> None:
        """Closes it with all connections."""
        self._over.set()
        self._flows.set()
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        with self._lock:
            for each in self._open:
                with contextlib.suppress(OSError):
                    each.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join(10)

    def _begin(self, work: object, *arguments: object) -> None:
        thread = threading.Thread(target=work, args=arguments, daemon=True)
        self._threads.append(thread)
        thread.start()

    def _accept(self) -> None:
        while not self._over.is_set():
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            self.visits += 1
            with self._lock:
                self._open.add(connection)
            self._begin(self._serve, connection)

    def _serve(self, connection: socket.socket) -> None:
        with connection, contextlib.suppress(OSError), connection.makefile("rb") as reader:
            while (first := reader.read(1)) and not self._over.is_set():
                if first == b"$":  # quality of received packets, in RTCP
                    reader.read(int.from_bytes(reader.read(3)[1:]))
                    continue
                request = first + b"".join(iter(reader.readline, b"\r\n"))
                self._flows.wait()
                self._answer(connection, request.decode())
        with self._lock:
            self._open.discard(connection)

    def _answer(self, connection: socket.socket, request: str) -> None:
        method = request.partition(" ")[0]
        headers = dict(re.findall(r"^([\w-]+): *(.*?)\r?$", request, re.MULTILINE))
        status, more, body = "200 OK", "Session: 1\r\n", ""
        proof = "Basic " + base64.b64encode(self._login.encode()).decode()
        if self._login and headers.get("Authorization") != proof:
            status, more = "401 Unauthorized", 'WWW-Authenticate: Basic realm="camera"\r\n'
        elif method == "OPTIONS":
            more = "Public: DESCRIBE, SETUP, PLAY, GET_PARAMETER, TEARDOWN\r\n"
        elif method == "DESCRIBE":
            more, body = "Content-Type: application/sdp\r\n", _SDP
        elif method == "SETUP" and "interleaved" not in headers["Transport"]:
            status = "461 Unsupported Transport"
        elif method == "SETUP":
            more += "Transport: RTP/AVP/TCP;unicast;interleaved=0-1\r\n"
        length = f"Content-Length: {len(body)}\r\n" if body else ""
        connection.sendall(
            f"RTSP/1.0 {status}\r\nCSeq: {headers['CSeq']}\r\n{more}{length}\r\n{body}".encode()
        )
        if method == "PLAY":
            self._begin(self._play, connection)

    def _play(self, connection: socket.socket) -> None:
        sequence = 0
        with contextlib.suppress(OSError):
            for number, units in enumerate(_film()):
                payloads = [payload for unit in units for payload in _payloads(unit)]
                for payload in payloads:
                    last = payload is payloads[-1]
                    head = (0x80, last << 7 | 96, sequence % 65536, number * _CLOCK // FPS % 2**32, 1)
                    packet = struct.pack(">BBHII", *head) + payload
                    self._flows.wait()
                    connection.sendall(struct.pack(">cBH", b"$", 0, len(packet)) + packet)
                    sequence += 1
                self.newest = number
                if self._over.wait(1 / FPS):
                    return


def _film() -> Iterator[list[bytes]]:
    """The units of H.264 of one frame after the other."""
    encoder = av.CodecContext.create("libx264", "w")
    encoder.width, encoder.height, encoder.pix_fmt = WIDTH, HEIGHT, "yuv420p"
    encoder.time_base = Fraction(1, FPS)
    encoder.gop_size = FPS
    encoder.options = {"preset": "ultrafast", "tune": "zerolatency"}
    number = 0
    while True:
        frame = av.VideoFrame.from_ndarray(card(number), "bgr24")
        frame.pts = number
        yield [unit for packet in encoder.encode(frame) for unit in _START.split(bytes(packet))[1:]]
        number += 1


def _payloads(unit: bytes) -> Iterator[bytes]:
    """A unit in one piece, or in parts (RFC 6184, 5.6 and 5.8)."""
    if len(unit) <= _PACKET:
        yield unit
        return
    for at in range(1, len(unit), _PACKET):
        begins, ends = at == 1, at + _PACKET >= len(unit)
        head = (unit[0] & 0xE0 | _FRAGMENT, begins << 7 | ends << 6 | unit[0] & 0x1F)
        yield bytes(head) + unit[at : at + _PACKET]
