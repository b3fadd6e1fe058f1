"""The data folder, which one relay at a time uses.

It also names the file of the relay's admin socket, and the header with the time of an order.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import secrets
import shutil
from pathlib import Path
from typing import BinaryIO

from relay_db.engine import copy_database
from relay_protocol import limits
from relay_protocol.errors import Invalid, Unavailable
from relay_protocol.text import is_printable

NAME_FILE = "relay.name"


def private(path: Path) -> BinaryIO:
    """Create or empty a file, and open it for writing; its mode is 0600 whatever the umask.

    :raises OSError: it can't be created
    """
    descriptor = os.open(path, os.O_CREAT | os.O_TRUNC | os.O_WRONLY | os.O_CLOEXEC, 0o600)
    os.fchmod(descriptor, 0o600)
    return os.fdopen(descriptor, "wb")


def copy_data(data: Path, database_url: str, folder: Path) -> None:
    """Copy the database and the name of a relay, which may run, into a new data folder.

    :raises Invalid: the folder exists, or the database is no file
    :raises Unavailable: something can't be read or written; the folder is removed again
    """
    try:
        folder.mkdir(mode=0o700, parents=True)
    except FileExistsError:
        raise Invalid(f"{folder} exists; name a new folder for each backup") from None
    except OSError as error:
        raise Unavailable(f"{folder} can't be created: {error.strerror}") from None
    with contextlib.ExitStack() as undo:
        undo.callback(shutil.rmtree, folder)
        copy_database(database_url, folder / "switchboard.db")
        # A relay that has always got its name by --name has no such file.
        if (data / NAME_FILE).exists():
            try:
                name = (data / NAME_FILE).read_bytes()
                with private(folder / NAME_FILE) as stream:
                    stream.write(name)
            except OSError as error:
                raise Unavailable(f"the relay's name can't be copied: {error.strerror}") from None
        undo.pop_all()


class DataDir:
    """The folder of one running relay: its lock, its name, its local socket.

    The kernel holds the lock, so it always ends with the process. A file with a process id would outlive a power cut,
    and then name another process.

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
        """Remove a socket that a killed relay has left; the holder of the lock alone may have one.

        :raises Invalid: it can't be removed
        """
        try:
            socket.unlink(missing_ok=True)
        except OSError as error:
            raise Invalid(f"{socket.name} in the data folder can't be replaced: {error.strerror}") from None

    def relay_name(self) -> str:
        """The name that robots include in their signatures; made at the first start.

        :raises Invalid: it can't be read, or is not valid
        """
        path = self.path / NAME_FILE
        try:
            name = path.read_bytes().decode(errors="replace").strip()
        except FileNotFoundError:
            name = f"relay-{secrets.token_hex(8)}"
            with private(path) as stream:
                stream.write(f"{name}\n".encode())
        except OSError as error:
            raise Invalid(f"the relay's name can't be read from {path.name}: {error.strerror}") from None
        if not 0 < len(name) <= limits.LABEL_LENGTH or not is_printable(name):
            raise Invalid(
                f"{path.name} in the data folder is not a name of one printable line, at most "
                f"{limits.LABEL_LENGTH} characters; "
                "restore it from a backup, or give the name that robots know by --name"
            )
        return name

    def release(self) -> None:
        """Release the lock."""
        os.close(self._lock)


SOCKET_NAME = "relay.sock"
"""The Unix socket in the data folder."""

SENT_HEADER = "Switchboard-Sent"
"""Header of an order: when it was sent, nanoseconds of the machine's monotonic clock."""

_DIGITS = 20


def parse_sent(header: str | None) -> int | None:
    """The time in :data:`SENT_HEADER`; ``None`` if it is missing or no number.

    It is trusted, since only the relay's own user can open the socket.
    """
    text = header or ""
    return int(text) if len(text) <= _DIGITS and text.isascii() and text.isdigit() else None
