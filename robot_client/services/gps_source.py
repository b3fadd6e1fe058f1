"""Sources of NMEA sentences: a serial device, a TCP server or a recorded file."""

from __future__ import annotations

import os
import re
import select
import socket
import stat
import termios
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from relay_protocol.errors import Invalid, Unavailable
from robot_client.services.health import Level, ServiceFinding

RETRY_SECONDS = 1.0
"""Seconds until a lost source is reopened."""
CONNECT_SECONDS = 5.0
"""Timeout of a connection, seconds."""
POLL_SECONDS = 0.2
"""Longest wait of one read, seconds."""
CHUNK = 4096

BAUDS = (4800, 9600, 19200, 38400, 57600, 115200, 230400, 460800, 921600)


class ByteSource(Protocol):
    """A source of bytes."""

    def read(self) -> bytes:
        """Bytes received within :data:`POLL_SECONDS`; may be empty.

        :raises EOFError: end of the file
        :raises OSError: the source is lost
        """

    def close(self) -> None:
        """Close the source."""


class SerialSource:
    """A serial device, or another file that is read like one.

    :param baud: bits per second
    :raises OSError: it can't be opened
    """

    def __init__(self, path: Path, baud: int) -> None:
        # O_NOCTTY: a hang-up of the device must not end this process.
        self._file = os.open(path, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            if os.isatty(self._file):
                _set_raw(self._file, baud)
        except termios.error as error:
            os.close(self._file)
            code, message = error.args
            raise OSError(code, message) from None

    def read(self) -> bytes:
        """See :class:`ByteSource`."""
        if not select.select([self._file], [], [], POLL_SECONDS)[0]:
            return b""
        data = os.read(self._file, CHUNK)
        if not data:
            raise OSError(0, "the other end closed it")
        return data

    def close(self) -> None:
        """See :class:`ByteSource`."""
        os.close(self._file)


class TcpSource:
    """A TCP server that sends sentences.

    :raises OSError: it does not answer
    """

    def __init__(self, host: str, port: int) -> None:
        self._socket = socket.create_connection((host, port), timeout=CONNECT_SECONDS)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        self._socket.settimeout(POLL_SECONDS)

    def read(self) -> bytes:
        """See :class:`ByteSource`."""
        try:
            data = self._socket.recv(CHUNK)
        except TimeoutError:
            return b""
        if not data:
            raise OSError(0, "the server closed the connection")
        return data

    def close(self) -> None:
        """See :class:`ByteSource`."""
        self._socket.close()


class FileSource:
    """A file, replayed at the pace of a receiver.

    :param pace: seconds between two positions
    :raises OSError: it can't be opened
    """

    def __init__(self, path: Path, pace: float, sleep: Callable[[float], object] = time.sleep) -> None:
        self._file = path.open("rb")
        self._pace = pace
        self._sleep = sleep

    def read(self) -> bytes:
        """See :class:`ByteSource`."""
        line = self._file.readline(CHUNK)
        if not line:
            raise EOFError
        if line[3:6] == b"GGA":
            self._sleep(self._pace)
        return line

    def close(self) -> None:
        """See :class:`ByteSource`."""
        self._file.close()


def source_factory(text: str, baud: int, pace: float) -> Callable[[], ByteSource]:
    """A function that opens a source.

    :param text: ``tcp://host:port``, or the path of a device or a file
    :raises Invalid: invalid address
    :raises Unavailable: the file does not exist
    """
    if text.startswith("tcp://"):
        found = re.fullmatch(r"tcp://(?:\[([^]]+)\]|([^:/]+)):([0-9]{1,5})/?", text)
        if not found or not 0 < int(found[3]) < 65536:
            raise Invalid(f"'{text}' is not an address; write tcp://HOST:PORT")
        host, port = found[1] or found[2], int(found[3])
        return lambda: TcpSource(host, port)
    path = Path(text)
    try:
        regular = stat.S_ISREG(path.stat().st_mode)
    except OSError as error:
        # Devices may appear later; a missing file outside /dev is an error.
        if path.parent.is_relative_to("/dev"):
            return lambda: SerialSource(path, baud)
        raise Unavailable(f"{text}: {error.strerror}") from None
    if regular:
        return lambda: FileSource(path, pace)
    return lambda: SerialSource(path, baud)


class ByteReader:
    """Reads a source in a thread of its own, and opens it again when it is lost.

    :param name: of the source, for display
    :param on_data: called in the thread with received bytes
    """

    def __init__(
        self, name: str, open_source: Callable[[], ByteSource], on_data: Callable[[bytes], None]
    ) -> None:
        self._name = name
        self._open = open_source
        self._on_data = on_data
        self._ending = threading.Event()
        self._problem: ServiceFinding | None = ServiceFinding(Level.STALE, f"waiting for {name}")
        self._thread = threading.Thread(target=self._run, name="gps-source", daemon=True)
        self._thread.start()

    def finding(self) -> ServiceFinding | None:
        """Problem with the source, else ``None``."""
        return self._problem

    def close(self) -> None:
        """Stop reading."""
        self._ending.set()
        self._thread.join(2.0)

    def _run(self) -> None:
        while not self._ending.is_set():
            try:
                self._read_all()
            except EOFError:
                self._problem = ServiceFinding(Level.STALE, f"{self._name} has ended")
                return
            except OSError as error:
                self._problem = ServiceFinding(Level.ERROR, f"{self._name}: {error.strerror or error}")
                self._ending.wait(RETRY_SECONDS)

    def _read_all(self) -> None:
        source = self._open()
        try:
            while not self._ending.is_set():
                data = source.read()
                if data:
                    self._problem = None
                    self._on_data(data)
        finally:
            source.close()


def _set_raw(file: int, baud: int) -> None:
    """Set eight bits, no parity, one stop bit, raw mode.

    :raises termios.error: the device rejects it
    """
    speed = getattr(termios, f"B{baud}")
    settings = termios.tcgetattr(file)
    settings[0] = termios.IGNPAR
    settings[1] = 0
    settings[2] = termios.CS8 | termios.CREAD | termios.CLOCAL
    settings[3] = 0
    settings[4] = settings[5] = speed
    settings[6][termios.VMIN], settings[6][termios.VTIME] = 1, 0
    termios.tcsetattr(file, termios.TCSANOW, settings)
    termios.tcflush(file, termios.TCIFLUSH)
