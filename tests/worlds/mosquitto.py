"""A Mosquitto broker on a port from the OS."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
from collections.abc import Sequence
from pathlib import Path

from tests.worlds.processes import Process
from tests.worlds.waiting import PATIENCE, wait_for

USER, PASSWORD = "gateway", "correct horse battery"


def program(name: str) -> str:
    """The path of a program of the package ``mosquitto``; Debian has the broker in /usr/sbin."""
    found = shutil.which(name, path=os.environ["PATH"] + os.pathsep + "/usr/sbin")
    assert found is not None, (
        f"{name} is not installed; run scripts/setup.sh broker, or: apt install mosquitto"
    )
    return found


class Mosquitto:
    """The broker's process; all clients need :data:`USER` and :data:`PASSWORD`.

    :param certificate: PEM file with key and certificate, for a second port with TLS
    :param rules: lines of its access control file; without it everything is allowed
    """

    def __init__(self, folder: Path, certificate: Path | None = None, *, rules: Sequence[str] = ()) -> None:
        self.folder = folder
        self.port, self._tls_port = _free_ports()
        folder.mkdir(parents=True, exist_ok=True)
        passwords = folder / "passwords"
        subprocess.run(
            [program("mosquitto_passwd"), "-b", "-c", str(passwords), USER, PASSWORD],
            check=True,
            capture_output=True,
        )
        passwords.chmod(0o600)
        lines = [
            f"listener {self.port} 127.0.0.1",
            "allow_anonymous false",
            f"password_file {passwords}",
            # Started by root it would become another user, who cannot read the password file.
            *(["user root"] if os.getuid() == 0 else []),
        ]
        if rules:
            access = folder / "rules"
            access.write_text("\n".join([f"user {USER}", *rules]) + "\n")
            access.chmod(0o600)
            lines.append(f"acl_file {access}")
        if certificate is not None:
            lines += [
                f"listener {self._tls_port} 127.0.0.1",
                f"certfile {certificate}",
                f"keyfile {certificate}",
            ]
        self._config = folder / "mosquitto.conf"
        self._config.write_text("\n".join(lines) + "\n")
        self.start()

    @property
    def address(self) -> str:
        """``host:port``."""
        return f"127.0.0.1:{self.port}"

    @property
    def tls_address(self) -> str:
        """``host:port`` of the port with TLS."""
        return f"127.0.0.1:{self._tls_port}"

    def start(self) -> None:
        """Starts it, on the port it had before."""
        self._process = Process([program("mosquitto"), "-c", str(self._config)], self.folder, "mosquitto")
        wait_for("the broker listens", self._listens)

    def _listens(self) -> bool:
        try:
            socket.create_connection(("127.0.0.1", self.port), PATIENCE).close()
        except OSError:
            return False
        return True

    def freeze(self) -> None:
        """SIGSTOP; it stands still when this returns."""
        self._process.freeze()

    def thaw(self) -> None:
        """SIGCONT."""
        self._process.signal(signal.SIGCONT)

    def stop(self) -> None:
        """Ends it, even while frozen; retained messages are lost."""
        self._process.kill()


def _free_ports() -> tuple[int, int]:
    with socket.socket() as first, socket.socket() as second:
        for each in (first, second):
            each.bind(("127.0.0.1", 0))
        return first.getsockname()[1], second.getsockname()[1]
