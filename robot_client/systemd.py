"""Notifications to systemd (``sd_notify(3)``): ready, watchdog, stopping."""

from __future__ import annotations

import socket
from collections.abc import Callable, Mapping
from typing import Any

from twisted.internet.task import LoopingCall


class Notifier:
    """Notifies systemd if it requested that.

    :param environment: with ``NOTIFY_SOCKET`` and ``WATCHDOG_USEC`` from systemd
    :param healthy: called before each watchdog notification; without it systemd restarts the daemon
    """

    def __init__(self, clock: Any, environment: Mapping[str, str], healthy: Callable[[], bool]) -> None:
        path = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + path[1:] if path.startswith("@") else path
        usec = environment.get("WATCHDOG_USEC", "")
        self._every = int(usec) / 2_000_000 if usec.isdigit() else 0.0
        self._healthy = healthy
        self._loop = LoopingCall(self._notify_watchdog)
        self._loop.clock = clock

    def start(self) -> None:
        """Notify that the daemon is ready."""
        self._send("READY=1")
        if self._address and self._every:
            self._loop.start(self._every, now=False)

    def stop(self) -> None:
        """Notify that the daemon is stopping."""
        if self._loop.running:
            self._loop.stop()
        self._send("STOPPING=1")

    def _notify_watchdog(self) -> None:
        if self._healthy():
            self._send("WATCHDOG=1")

    def _send(self, text: str) -> None:
        if not self._address:
            return
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as out:
            try:
                out.sendto(text.encode(), self._address)
            except OSError:
                return  # systemd does not read its socket
