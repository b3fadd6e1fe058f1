"""The data folder belongs to one relay at a time."""

from __future__ import annotations

import fcntl
import os
import secrets
from pathlib import Path
from typing import BinaryIO

from relay_protocol import limits
from relay_protocol.errors import Invalid, Unavailable
from relay_protocol.text import legible


def private(path: Path) -> BinaryIO:
    """Open a file for writing, empty; its mode is 0600 whatever the umask.

    :raises OSError: it can't be made
    """
    descriptor = os.open(path, os.O_CREAT | os.O_TRUNC | os.O_WRONLY | os.O_CLOEXEC, 0o600)
    os.fchmod(descriptor, 0o600)
    return os.fdopen(descriptor, "wb")


class DataDir:
    """The folder of one running relay: its lock, its name, its local socket.

    The kernel keeps the lock, so it ends with the process however that ends; a file with a process id in it would
    outlive a power cut and then name somebody else's process.

    :raises Unavailable: another relay runs on this folder, or it can't be written
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._lock = os.open(path / "relay.lock", os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
        except OSError as error:
            raise Unavailable(
                f"the data folder {path} can't be written: {error.strerror}; check its owner and mode, or give "
                "another --data"
            ) from None
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(self._lock)
            raise Unavailable(
                "another relay runs on this data folder; stop it first, or give --data"
            ) from None

    def clear_socket(self, socket: Path) -> None:
        """Take away a socket that a killed relay left behind; only the holder of the lock can have one.

        :raises Invalid: it can't be taken away
        """
        try:
            socket.unlink(missing_ok=True)
        except OSError as error:
            raise Invalid(f"{socket.name} in the data folder can't be replaced: {error.strerror}") from None

    def relay_name(self) -> str:
        """What robots sign for, made up once.

        :raises Invalid: it can't be read, or is no name
        """
        path = self.path / "relay.name"
        try:
            name = path.read_bytes().decode(errors="replace").strip()
        except FileNotFoundError:
            name = f"relay-{secrets.token_hex(8)}"
            with private(path) as stream:
                stream.write(f"{name}\n".encode())
        except OSError as error:
            raise Invalid(f"the relay's name can't be read from {path.name}: {error.strerror}") from None
        if not 0 < len(name) <= limits.LABEL or not legible(name):
            raise Invalid(
                f"{path.name} in the data folder is no name, one printable line of at most {limits.LABEL} characters; "
                "restore it from a backup, or give the name that robots know by --name"
            )
        return name

    def release(self) -> None:
        """Let another relay have the folder."""
        os.close(self._lock)
