"""Notifications to systemd."""

from __future__ import annotations

import re
import socket
from pathlib import Path

from twisted.internet.task import Clock

from robot_client.systemd import Notifier


def test_systemd_gets_ready_watchdog_stopping(tmp_path: Path) -> None:
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


def test_without_systemd_nothing_is_sent() -> None:
    clock = Clock()
    notifier = Notifier(clock, {}, lambda: True)
    notifier.start()
    assert clock.getDelayedCalls() == []
    notifier.stop()


def test_unit_lets_modules_outlive_the_daemon_and_open_the_devices_of_the_documents() -> None:
    root = Path(__file__).parents[2]
    unit = (root / "deploy" / "switchboard-robot.service").read_text()
    settings = [line.partition("=")[::2] for line in unit.splitlines() if "=" in line and line[0] != "#"]
    assert dict(settings)["KillMode"] == "process"
    documents = "".join((root / "docs/guides" / name).read_text() for name in ("modules.md", "devices.md"))
    named = {f"char-{kind} rw" for kind in re.findall(r"/dev/(tty[A-Z]+)\d", documents)}
    assert named and named <= {value for name, value in settings if name == "DeviceAllow"}
