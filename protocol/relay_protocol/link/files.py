"""Files of a robot (SPEC 2.7): the link over which they are uploaded, which is opened by orders on the control link."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from relay_protocol import limits
from relay_protocol.link.common import Bye, Ping, Pong
from relay_protocol.link.fields import Label, Reasoned
from relay_protocol.message import Message

UploadNumber = Annotated[int, Meta(ge=1, le=2**32 - 1)]
FileSize = Annotated[int, Meta(ge=0, le=2**53)]
FileName = Annotated[str, Meta(min_length=1, max_length=limits.FILE_NAME)]
FileHash = Annotated[str, Meta(pattern=r"^[0-9a-f]{64}\Z")]


class RequestFileLink(Message, frozen=True, kw_only=True):
    """Robot, control link: files wait to be uploaded. The relay answers with :class:`OpenFileLink`."""


class OpenFileLink(Message, frozen=True, kw_only=True):
    """Relay, control link: dial, ``join`` with this ticket, and upload files there.

    :param address: ``host:port`` to dial; empty for the address of the control link
    """

    ticket: Label
    address: str = ""


class OfferFile(Message, frozen=True, kw_only=True):
    """Robot, file link: a file to be uploaded.

    :param upload: number of this upload, chosen by the robot, that the answers repeat
    :param group: group of files in the robot's settings
    :param name: with ``/`` between folders
    :param size: bytes
    :param sha256: of the whole file, hexadecimal
    :param modified: when it was changed last, Unix time at the robot, seconds
    """

    upload: UploadNumber
    group: Label
    name: FileName
    size: FileSize
    sha256: FileHash
    modified: Annotated[float, Meta(ge=0, le=1e11)] = 0.0


class ContinueFile(Message, frozen=True, kw_only=True):
    """Relay, file link: send the file from this byte on.

    :param offset: bytes that the relay has already, from an upload that was broken off
    """

    upload: UploadNumber
    offset: FileSize


class FileReceived(Message, frozen=True, kw_only=True):
    """Relay, file link: so many bytes of the file have been written. They need not survive a loss of power."""

    upload: UploadNumber
    received: FileSize


class FileStored(Message, frozen=True, kw_only=True):
    """Relay, file link: the whole file is stored durably, and listed. The robot may delete its copy.

    :param sha256: of the relay's copy, read back from its disk
    """

    upload: UploadNumber
    sha256: FileHash


class FileRefused(Reasoned, frozen=True, kw_only=True):
    """Relay, file link: this upload has ended without being stored.

    :param code: ``quota``, ``disk_full``, ``name``, ``mismatch`` (other contents than offered) or ``unavailable``
    :param retry_after: seconds after which another attempt may succeed
    """

    upload: UploadNumber
    code: Label
    reason: str
    retry_after: Annotated[float, Meta(ge=0, le=1e6)] = 60.0


class WithdrawFile(Message, frozen=True, kw_only=True):
    """Robot, file link: this upload ends, because the file has changed or can't be read."""

    upload: UploadNumber


RobotFiles = OfferFile | WithdrawFile | Ping | Pong | Bye
RelayFiles = ContinueFile | FileReceived | FileStored | FileRefused | Ping | Pong | Bye
