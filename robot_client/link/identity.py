"""The state folder: who this robot is, to which relay. Private key 0600, folder 0700, all or nothing."""

from __future__ import annotations

import os
from pathlib import Path

import msgspec

from relay_protocol import identity
from relay_protocol.errors import Invalid, SwitchboardError
from robot_client.link.protocol import Identity

KEY = "robot.key"
STATE = "robot.json"
_PENDING = "robot.key.pending"


class Enrolment(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What enrolling taught.

    :param address: ``host:port`` of the relay
    :param robot: this robot's name
    :param relay: the name the relay gave itself; another one is refused later
    :param ca: PEM file of the only authorities trusted, empty for the system's
    :param server_name: name the certificate must bear, empty for the host
    """

    address: str
    robot: str
    relay: str
    tls: bool
    ca: str = ""
    server_name: str = ""


class StateError(SwitchboardError):
    """The state folder is not as it must be."""


class StateFolder:
    """A folder with a key and an enrolment.

    :param path: made when needed
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def load(self) -> tuple[Enrolment, Identity]:
        """Who this robot is.

        :raises StateError: not enrolled, a file is damaged, or others may read the key
        """
        try:
            text = (self.path / STATE).read_bytes()
            enrolment = msgspec.json.decode(text, type=Enrolment)
            mode = (self.path / KEY).stat().st_mode
            key = (self.path / KEY).read_bytes()
        except FileNotFoundError:
            raise StateError(
                f"no robot is enrolled in {self.path}; run: switchboard-robot enroll --state {self.path} …"
            ) from None
        except OSError as error:
            raise StateError(f"the state in {self.path} can't be read: {error.strerror}") from None
        except (msgspec.MsgspecError, UnicodeDecodeError) as error:
            raise StateError(f"{self.path / STATE} is damaged: {error}; enrol this robot again") from None
        if mode & 0o077:
            raise StateError(f"others may read the key {self.path / KEY}; run: chmod 600 {self.path / KEY}")
        if len(key) != 32:
            raise StateError(f"{self.path / KEY} is damaged; enrol this robot again")
        return enrolment, Identity(enrolment.robot, enrolment.relay, key)

    @property
    def enrolled(self) -> bool:
        """Whether there is an enrolment already."""
        return (self.path / STATE).exists()

    def prepare(self) -> Preparation:
        """Make a key and see that it can be stored, before the one-time code is spent.

        :raises Invalid: the folder can't be written
        """
        made = not self.path.exists()
        try:
            self.path.mkdir(parents=True, exist_ok=True, mode=0o700)
            self.path.chmod(0o700)
            key = identity.generate_key()
            _write(self.path / _PENDING, key)
        except OSError as error:
            raise Invalid(f"the folder {self.path} can't be written: {error.strerror}") from None
        return Preparation(self.path, key, made)


class Preparation:
    """A key that waits for the relay's yes."""

    def __init__(self, path: Path, key: bytes, made_folder: bool) -> None:
        self._path = path
        self._made_folder = made_folder
        self.public_key = identity.public_half(key)

    def commit(self, enrolment: Enrolment) -> None:
        """The relay said yes: this key and this enrolment are the robot's now.

        :raises Invalid: they can't be stored; the code is spent
        """
        pending = self._path / (STATE + ".pending")
        try:
            _write(pending, msgspec.json.format(msgspec.json.encode(enrolment), indent=2) + b"\n")
            (self._path / _PENDING).replace(self._path / KEY)
            pending.replace(self._path / STATE)
            _sync_folder(self._path)
        except OSError as error:
            raise Invalid(
                f"the enrolment can't be stored in {self._path}: {error.strerror}; free some space, and enroll again "
                "with a new code"
            ) from None

    def abandon(self) -> None:
        """The relay said no: leave nothing."""
        (self._path / _PENDING).unlink(missing_ok=True)
        if self._made_folder:
            self._path.rmdir()


def _write(path: Path, data: bytes) -> None:
    path.unlink(missing_ok=True)
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_NOFOLLOW", 0), 0o600)
    with os.fdopen(handle, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _sync_folder(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
