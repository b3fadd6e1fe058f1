"""Devices on a serial port: lines in, bytes out, opened again when they were unplugged."""

from __future__ import annotations

import contextlib
import importlib
import queue
import sys
import threading
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

from robot_client.devices.module import Module

WAITING_WRITES = 256
"""Most writes that wait for the device; then the oldest are dropped."""

WRITE_SECONDS = 1.0
"""A write waits so long for room while the device is open, so that a slow device loses nothing."""

RETRY_SECONDS = 0.5
"""Seconds between two attempts to open a device."""

CLOSE_SECONDS = 1.0

LONGEST_LINE = 4096
"""Bytes; a longer line is cut into pieces."""


class SerialPort:
    """A serial port with a thread that reads and one that writes. Both block while there is nothing to do.

    While the device is gone, the reading thread tries every :data:`RETRY_SECONDS` to open it again.

    :param path: of the device, as ``/dev/ttyUSB0``
    :param baud: bits per second
    :param received: called with each line, without its end, in the reading thread. A slow one slows reading down; an
        exception ends the module
    :param connected: called in the reading thread, with whether the device is open, when that has changed
    :param keep: whether writes wait, in order, while the device is gone, at most :data:`WAITING_WRITES`. If not, they
        are dropped then, and the oldest of those that wait for a slow device: commands that move something must not
        be carried out late
    """

    def __init__(
        self,
        path: str,
        baud: int,
        received: Callable[[bytes], object],
        connected: Callable[[bool], object] = lambda is_open: None,
        keep: bool = False,
    ) -> None:
        self._keep = keep
        self._path = path
        self._baud = baud
        self._received = received
        self._connected = connected
        self._writes: queue.Queue[tuple[bytes, Any] | None] = queue.Queue(WAITING_WRITES)
        """Bytes, and the only device that they are for; ``None`` as device: any. ``None`` alone ends the writing."""
        self._device: Any = None
        self._changed = threading.Condition()
        """Guards :attr:`_device` and :attr:`_ending`."""
        self._ending = False
        self._stalled = False
        """Whether writes that should be kept were dropped, and none was written since."""
        self._problem = ""
        self._reader = threading.Thread(target=self._read, name="serial-reader", daemon=True)
        self._writer = threading.Thread(target=self._write, name="serial-writer", daemon=True)

    def open(self) -> None:
        """Open the device, now or when it is there.

        :raises ModuleNotFoundError: pyserial is not installed
        """
        try:
            importlib.import_module("serial")  # a thread could not raise it to the caller
        except ModuleNotFoundError:
            raise ModuleNotFoundError("pyserial is missing; install the extra 'devices'") from None
        self._reader.start()
        self._writer.start()

    def write(self, data: bytes) -> None:
        """Queue bytes for the device.

        Without ``keep`` they are dropped while the device is gone. While :data:`WAITING_WRITES` wait, the oldest is
        dropped; with ``keep`` and an open device only after :data:`WRITE_SECONDS`.
        """
        with self._changed:
            device = self._device
        if not self._keep:
            if device is not None:
                self._replace_oldest(data, device)
            return
        try:
            may_wait = device is not None and not self._stalled
            self._writes.put((data, None), block=may_wait, timeout=WRITE_SECONDS)
        except queue.Full:
            if not self._stalled:
                self._stalled = True
                self._print(f"{WAITING_WRITES} writes wait for the device; the oldest are dropped")
            self._replace_oldest(data, None)

    def _replace_oldest(self, data: bytes, only_for: Any) -> None:
        with self._changed:
            with contextlib.suppress(queue.Empty):
                if self._writes.full():
                    self._writes.get_nowait()
            with contextlib.suppress(queue.Full):
                self._writes.put_nowait((data, only_for))

    def close(self) -> None:
        """Write what is queued, if the device is open, within :data:`CLOSE_SECONDS`, and close it."""
        with self._changed:
            may_write = self._device is not None
        if may_write:
            with contextlib.suppress(queue.Full):
                self._writes.put(None, timeout=CLOSE_SECONDS)
                self._writer.join(CLOSE_SECONDS)
        with self._changed:
            self._ending = True
            self._changed.notify_all()
            if self._device is not None:
                # The reader may close it at this moment, as it is lost.
                with contextlib.suppress(OSError):
                    self._device.cancel_read()
                    self._device.cancel_write()
        if self._reader.is_alive():
            self._reader.join(CLOSE_SECONDS)

    def _read(self) -> None:
        import serial

        while not self._ending:
            try:
                # Two readers would each get a part of the lines.
                device = serial.Serial(self._path, self._baud, exclusive=True)
            except OSError as error:
                self._report(str(error))
            else:
                try:
                    self._use(device)
                    for line in self._lines(device):
                        self._received(line)
                finally:
                    with contextlib.suppress(OSError, TypeError):
                        device.close()
                    self._use(None)
            with self._changed:
                self._changed.wait_for(lambda: self._ending, RETRY_SECONDS)

    def _lines(self, device: Any) -> Iterator[bytes]:
        """Lines of a device until it is gone. Its errors are handled here, so that those of callbacks are not."""
        unfinished = b""
        while not self._ending and self._device is device:
            try:
                data = device.read(1)
                data += device.read(device.in_waiting)
            except (OSError, TypeError) as error:
                # pyserial's errors are of OSError; a port that is closed meanwhile raises TypeError.
                self._report(str(error))
                return
            *lines, unfinished = (unfinished + data).split(b"\n")
            for line in lines:
                yield line.removesuffix(b"\r")
            while len(unfinished) > LONGEST_LINE:
                yield unfinished[:LONGEST_LINE]
                unfinished = unfinished[LONGEST_LINE:]

    def _write(self) -> None:
        while (item := self._writes.get()) is not None:
            data, only_for = item
            while data:
                with self._changed:
                    if only_for is None:
                        self._changed.wait_for(lambda: self._device is not None or self._ending)
                    device = self._device
                if only_for is not None and device is not only_for:
                    break  # it would be late
                if device is None:
                    return
                try:
                    data = data[device.write(data) :]
                    self._stalled = False
                except (OSError, TypeError):
                    self._give_up(device)

    def _give_up(self, device: Any) -> None:
        """A write has failed: have the reading thread open the device again."""
        with self._changed:
            if self._device is device:
                device.cancel_read()
        self._use(None, device)

    def _use(self, device: Any, instead_of: Any = None) -> None:
        with self._changed:
            if instead_of is not None and self._device is not instead_of:
                return
            was_open, self._device = self._device is not None, device
            self._changed.notify_all()
        if was_open is not (device is not None):
            self._connected(device is not None)
        if device is not None and self._problem:
            self._print(f"{self._path}: open")
            self._problem = ""

    def _report(self, problem: str) -> None:
        """Write a problem to the module's log, once."""
        if problem != self._problem:
            # A level as Python's logging writes it, which the log of modules understands.
            self._print(f"WARNING: {self._path}: {problem}")
        self._problem = problem

    @staticmethod
    def _print(line: str) -> None:
        print(line, file=sys.stderr, flush=True)


class SerialDevice(Module):
    """A module that is one device on a serial port.

    :param path: of the device, as ``/dev/ttyUSB0``
    :param baud: bits per second
    :param keep: whether writes wait while the device is gone, as of :class:`SerialPort`
    """

    def __init__(self, path: str, baud: int = 115200, keep: bool = False) -> None:
        self.port = SerialPort(
            path, baud, partial(self.call, self.received), partial(self.call, self.connected), keep
        )

    def start(self) -> None:
        """Open the device."""
        self.port.open()

    def stop(self) -> None:
        """Close the device."""
        self.port.close()

    def received(self, line: bytes) -> None:
        """The device has sent a line, here without its end. To be overridden."""

    def connected(self, is_open: bool) -> None:
        """The device was opened, or is lost. To be overridden, as to send it its settings."""

    def write(self, data: bytes) -> None:
        """Queue bytes for the device. Without ``keep`` they are dropped while it is gone."""
        self.port.write(data)
