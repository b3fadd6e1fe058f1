"""Builds what receives and keeps the files of robots."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from relay_db.queries import FileQuotas
from relay_protocol.errors import Invalid
from relay_server.auth import passwords
from relay_server.common.database import AsyncDatabase, BoundedThreadPool
from relay_server.config import RelaySettings
from relay_server.events.bus import EventBus
from relay_server.files.incoming import IncomingFolder
from relay_server.files.links import FileLinks
from relay_server.files.object_storage import ObjectStorage
from relay_server.files.storage import FileStorage, LocalStorage
from relay_server.files.uploads import Uploads
from relay_server.robots.tickets import Tickets

FOLDER = "files"
THREADS = 4
STORING_THREADS = 4
"""For whole files, which take long with an S3-compatible storage; the others go on with parts and downloads."""

WAITING = 4096
"""Most pieces of work with the disk that run or wait."""


@dataclass(frozen=True)
class FileCore:
    """The parts of a relay that receive and keep files."""

    pool: BoundedThreadPool
    storing: BoundedThreadPool
    incoming: IncomingFolder
    storage: FileStorage
    uploads: Uploads
    links: FileLinks

    def start(self) -> None:
        """Start the threads.

        :raises Invalid: the folder of files can't be used
        """
        try:
            self.incoming.prepare()
        except OSError as error:
            raise Invalid(f"the folder of files can't be used: {error.strerror}") from None
        self.pool.start()
        self.storing.start()

    def stop(self) -> None:
        """Finish all work with the disk and the storage; blocks for as long as that takes."""
        self.storing.stop()
        self.pool.stop()


def open_storage(folder: Path, url: str) -> FileStorage:
    """The storage of files.

    :param folder: of files, in the data folder
    :param url: of an S3-compatible storage, or empty: ``folder``
    :raises Invalid: the URL can't be used
    """
    return ObjectStorage(url) if url else LocalStorage(folder)


def build_files(reactor: Any, settings: RelaySettings, database: AsyncDatabase, bus: EventBus) -> FileCore:
    """Build it; nothing is opened."""
    files = settings.files
    folder = settings.data / FOLDER
    storage = open_storage(folder, files.storage)
    incoming = IncomingFolder(folder / "incoming", storage, files.reserve)
    overload = "too many files are being written; try again in a moment"
    pool = BoundedThreadPool(reactor, "files", THREADS, WAITING, overload)
    storing = BoundedThreadPool(reactor, "storing files", STORING_THREADS, WAITING, overload)
    uploads = Uploads(
        database=database,
        pool=pool,
        storing=storing,
        incoming=incoming,
        storage=storage,
        quotas=FileQuotas(files.robot, files.realm, files.relay),
        bus=bus,
        wall=time.time,
    )
    links = FileLinks(uploads, Tickets(reactor, passwords.new_token))
    return FileCore(pool, storing, incoming, storage, uploads, links)
