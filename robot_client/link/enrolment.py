"""Enrolment: stores the robot's key and identity in its state folder, and registers the public key at the relay.

The private key has mode 0600 and the folder 0700. A key and an enrolment are stored together or not at all.
"""

from __future__ import annotations

import fcntl
import os
import time
from pathlib import Path
from typing import Any

import msgspec
from twisted.internet.defer import Deferred
from twisted.internet.protocol import Factory

from relay_protocol import PROTOCOL_VERSION, identity, link
from relay_protocol.errors import Invalid, SwitchboardError
from robot_client.link.links import EnrolledAt, EnrolmentLink, Event, Identity
from robot_client.link.tls import explain
from robot_client.link.transport import LinkLost, LinkProtocol
from robot_client.twisted_types import DialEndpoint

KEY = "robot.key"
STATE = "robot.json"
CA = "ca.pem"
_PENDING = "robot.key.pending"


class Enrolment(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The result of an enrolment.

    :param address: ``host:port`` of the relay; of several relays, with commas in between
    :param robot: this robot's name
    :param relay: name of the relay; later a relay of another name is refused
    :param ca: PEM file of the only trusted authorities, empty for the system's. In the state folder it is stored
        relative to that
    :param server_name: name in the relay's certificate, empty for the host
    """

    address: str
    robot: str
    relay: str
    tls: bool
    ca: str = ""
    server_name: str = ""


class StateError(SwitchboardError):
    """The state folder can't be used."""


class StateFolder:
    """A folder with a key and an enrolment.

    :param path: created by :meth:`prepare` if it does not exist
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def load(self) -> tuple[Enrolment, Identity]:
        """The stored enrolment and identity.

        :raises StateError: the robot is not enrolled, a file is damaged, or other users may read the key
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
            raise StateError(
                f"other users may read the key {self.path / KEY}; run: chmod 600 {self.path / KEY}"
            )
        if len(key) != 32:
            raise StateError(f"{self.path / KEY} is damaged; enrol this robot again")
        if enrolment.ca:
            enrolment = msgspec.structs.replace(enrolment, ca=str(self.path.absolute() / enrolment.ca))
        return enrolment, Identity(enrolment.robot, enrolment.relay, key)

    def lock(self) -> int:
        """Lock the folder for a daemon, until the process ends. Other commands may use the folder beside it.

        The folder itself is locked, which needs no room on its disk and no right to write.

        :returns: the descriptor that holds the lock; programs that the daemon starts do not inherit it
        :raises StateError: another daemon runs with it, or it can't be locked
        """
        try:
            descriptor = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        except OSError as error:
            raise StateError(f"the folder {self.path} can't be opened: {error.strerror}") from None
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(descriptor)
            if not isinstance(error, BlockingIOError):
                raise StateError(f"the folder {self.path} can't be locked: {error.strerror}") from None
            raise StateError(
                f"another daemon runs with the state folder {self.path.absolute()}; stop it first, as by "
                "'systemctl stop switchboard-robot', or give another --state with an enrolment of its own"
            ) from None
        return descriptor

    @property
    def enrolled(self) -> bool:
        """Whether the folder holds an enrolment."""
        return (self.path / STATE).exists()

    def prepare(self) -> Preparation:
        """Generate a key and store it, before the one-time code is used.

        :raises Invalid: the folder can't be written
        """
        created = not self.path.exists()
        try:
            self.path.mkdir(parents=True, exist_ok=True, mode=0o700)
            self.path.chmod(0o700)
            key = identity.generate_key()
            _write(self.path / _PENDING, key)
        except OSError as error:
            raise Invalid(f"the folder {self.path} can't be written: {error.strerror}") from None
        return Preparation(self.path, key, created)


class Preparation:
    """A stored key that the relay has not accepted yet."""

    def __init__(self, path: Path, key: bytes, created_folder: bool) -> None:
        self._path = path
        self._created_folder = created_folder
        self.public_key = identity.public_half(key)

    def commit(self, enrolment: Enrolment, authorities: bytes = b"") -> None:
        """Make this key and this enrolment the robot's, after the relay has accepted the key.

        :param authorities: certificates of the only trusted ones in PEM form, which are stored too
        :raises Invalid: they can't be stored; the code is used up
        """
        pending = self._path / (STATE + ".pending")
        try:
            if authorities:
                # The daemon runs as a user who may not read where they came from.
                _write(self._path / (CA + ".pending"), authorities)
                (self._path / (CA + ".pending")).replace(self._path / CA)
                enrolment = msgspec.structs.replace(enrolment, ca=CA)
            _write(pending, msgspec.json.format(msgspec.json.encode(enrolment), indent=2) + b"\n")
            (self._path / _PENDING).replace(self._path / KEY)
            pending.replace(self._path / STATE)
            _sync_folder(self._path)
        except OSError as error:
            raise Invalid(
                f"the enrolment can't be stored in {self._path}: {error.strerror}; free some space, and enrol again "
                "with a new code"
            ) from None

    def abandon(self) -> None:
        """Remove the key, and the folder if it was created."""
        (self._path / _PENDING).unlink(missing_ok=True)
        if self._created_folder:
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


class _EnrolmentAttempt:
    """One attempt; a :class:`~robot_client.link.transport.LinkOwner`."""

    def __init__(self, protocol: LinkProtocol, result: Deferred[link.Enrolled]) -> None:
        self._protocol = protocol
        self._result = result

    def on_event(self, event: Event) -> None:
        if isinstance(event, EnrolledAt) and not self._result.called:
            self._protocol.end(LinkLost("enrolled"), gently=True)
            self._result.callback(event.enrolled)

    def on_lost(self, reason: SwitchboardError) -> None:
        if not self._result.called:
            self._result.errback(reason)

    def on_pause(self) -> None:
        """Do nothing: there is a single message."""

    def on_resume(self) -> None:
        """Do nothing, see :meth:`on_pause`."""


def enroll(
    clock: Any, endpoint: DialEndpoint, robot: str, code: str, public_key: bytes, agent: str
) -> Deferred[link.Enrolled]:
    """Register a public key at the relay; fails with a :class:`SwitchboardError`.

    :param code: one-time code from the relay's administrator
    :param public_key: 32 raw bytes
    :param agent: name and version of this software
    """
    result: Deferred[link.Enrolled] = Deferred()
    request = link.Enroll(
        version=PROTOCOL_VERSION,
        robot=robot,
        code=code,
        public_key=link.to_base64(public_key),
        agent=agent,
    )

    def build() -> LinkProtocol:
        return LinkProtocol(
            EnrolmentLink(request, time.monotonic_ns),
            lambda protocol: _EnrolmentAttempt(protocol, result),
            clock,
        )

    factory = Factory.forProtocol(build)
    factory.noisy = False
    endpoint.connect(factory).addErrback(lambda failure: result.errback(LinkLost(explain(failure))))
    return result
