"""Files of packages, such as meshes, which the relay fetches in parts.

Only regular files below the share folder of an installed package are read, with one of :data:`EXTENSIONS`. After links
are resolved they must still be there, or below a directory that the robot's settings name, and have such an ending.
Files are read in threads, so that a slow disk does not hold up the daemon.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.threads import deferToThread
from twisted.logger import Logger

from relay_protocol import asset_uri, limits, link
from relay_protocol.errors import NotFound, Refused, SwitchboardError, Unavailable
from robot_client.channel.handler import ChannelWriter
from robot_client.platforms.definitions import prefixes

EXTENSIONS = frozenset(
    [
        "dae",
        "fbx",
        "glb",
        "gltf",
        "jpeg",
        "jpg",
        "mtl",
        "obj",
        "png",
        "stl",
        "tif",
        "tiff",
        "urdf",
        "webp",
        "xacro",
    ]
)
"""Endings of files that are sent: meshes, their materials and images, and descriptions of robots."""

READS = 4
"""Most parts that are read at a time."""

Run = Callable[[Callable[[], link.AssetPart]], "Deferred[link.AssetPart]"]
"""Runs a function in a thread."""


def asset_path(uri: str, where: Iterable[Path], roots: Iterable[Path] = ()) -> Path:
    """The file of a URI, with links resolved.

    :param where: prefixes in which packages may be installed
    :param roots: directories outside of them to which links of packages may lead
    :raises Invalid: it is no such URI
    :raises Refused: such a file is not sent
    :raises NotFound: there is no such package or file
    """
    package, path = asset_uri.parse(uri)
    for prefix in where:
        # Only packages: the share folder of the system has much else.
        if (prefix / "share/ament_index/resource_index/packages" / package).exists():
            return _resolved(prefix / "share" / package, path.split("/"), roots)
    raise NotFound(f"there is no package '{package}' on this robot")


def _resolved(share: Path, names: list[str], roots: Iterable[Path]) -> Path:
    try:
        path = share.joinpath(*names).resolve(strict=True)
        allowed = [share.resolve(strict=True), *(Path(os.path.realpath(each)) for each in roots)]
    except (OSError, RuntimeError):
        raise NotFound("there is no such file in the package's share folder") from None
    if not any(path.is_relative_to(each) for each in allowed):
        raise Refused(
            "the file is a link that leads out of the package's share folder; where that is wanted, add the directory "
            "it leads to to 'roots' in [assets] of the robot's settings"
        )
    for name in (names[-1], path.name):
        if name.rpartition(".")[2].lower() not in EXTENSIONS:
            raise Refused(f"files of this kind are not sent, only {', '.join(sorted(EXTENSIONS))}")
    return path


def read_part(number: int, path: Path, offset: int) -> link.AssetPart:
    """A part of a file.

    :param path: without links, as of :func:`asset_path`
    :raises NotFound: it is no regular file, or can't be read
    :raises Refused: it is too large
    """
    try:
        # Links were resolved, so the last name may be none any more; nor may opening wait.
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise NotFound(f"the file can't be read: {error.strerror}") from None
    try:
        # One of its directories may have become a link since its links were resolved (proc_pid_fd(5)).
        if Path(f"/proc/self/fd/{descriptor}").readlink() != path:
            raise NotFound("the file was moved while it was opened")
        facts = os.fstat(descriptor)
        if not stat.S_ISREG(facts.st_mode):
            raise NotFound("it is no file")
        if facts.st_size > limits.ASSET:
            raise Refused(f"the file has {facts.st_size} bytes; at most {limits.ASSET} are sent")
        data = os.pread(descriptor, limits.ASSET_PART, offset)
    except OSError as error:
        raise NotFound(f"the file can't be read: {error.strerror}") from None
    finally:
        os.close(descriptor)
    version = f"{facts.st_ino}-{facts.st_mtime_ns}-{facts.st_size}"
    return link.AssetPart(number=number, offset=offset, size=facts.st_size, version=version, data=data)


class ChannelAssets:
    """Answers requests for assets on one channel.

    :param where: prefixes in which packages may be installed
    :param run: runs a function in a thread
    :param roots: directories outside of them to which links of packages may lead
    """

    log = Logger("assets")

    def __init__(
        self,
        writer: ChannelWriter,
        where: Callable[[], Iterable[Path]] = prefixes,
        run: Run = deferToThread,
        roots: Iterable[Path] = (),
    ) -> None:
        self._writer = writer
        self._where = where
        self._run = run
        self._roots = tuple(roots)
        self._reading = 0
        self._closed = False

    def close(self) -> None:
        """The channel ends; nothing is answered any more."""
        self._closed = True

    def get(self, message: link.GetAsset) -> None:
        """Send a part of a file, or why it is not sent.

        :raises Unavailable: too many are requested at a time
        """
        if self._reading >= READS:
            raise Unavailable(f"{READS} parts of assets are being read already")
        self._reading += 1
        number, uri, offset = message.number, message.uri, max(0, message.offset)
        where = list(self._where())
        reading = self._run(lambda: read_part(number, asset_path(uri, where, self._roots), offset))
        reading.addCallbacks(self._read, self._failed, errbackArgs=(number,))

    def _read(self, part: link.AssetPart) -> None:
        self._reading -= 1
        if not self._closed:
            self._writer.send(part)

    def _failed(self, failure: Any, number: int) -> None:
        self._reading -= 1
        reason = "the asset could not be read; the robot's log says why"
        if isinstance(failure.value, SwitchboardError):
            reason = str(failure.value)
        else:
            self.log.failure("an asset could not be read", failure)
        if not self._closed:
            self._writer.send(link.Failed(request="get_asset", reference=str(number), reason=reason))
