"""Signs of life for systemd."""

from __future__ import annotations

import socket
from pathlib import Path

from twisted.internet.task import Clock

from robot_client.systemd import Notifier


def test_systemd_hears_ready_alive_leaving(tmp_path: Path) -> None:
    """The daemon says it is ready, gives a sign of life twice per watchdog time while healthy, and says it leaves."""
    path = tmp_path / "notify"
    clock, healthy = Clock(), [True]
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(path))
        systemd.setblocking(False)

        def heard() -> list[bytes]:
            found = []
            while True:
                try:
                    found.append(systemd.recv(100))
                except BlockingIOError:
                    return found

        notifier = Notifier(
            clock, {"NOTIFY_SOCKET": str(path), "WATCHDOG_USEC": "30000000"}, lambda: healthy[0]
        )
        notifier.start()
        assert heard() == [b"READY=1"]
        clock.advance(15)
        assert heard() == [b"WATCHDOG=1"]
        healthy[0] = False
        clock.advance(15)
        assert heard() == []
        notifier.stop()
        assert heard() == [b"STOPPING=1"]


def test_without_systemd_nothing_is_said() -> None:
    """Without systemd's variables nothing is scheduled or sent."""
    clock = Clock()
    notifier = Notifier(clock, {}, lambda: True)
    notifier.start()
    assert clock.getDelayedCalls() == []
    notifier.stop()
