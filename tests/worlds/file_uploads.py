"""A robot's uploader and a relay's uploads on one clock, with real files and a real database, and no threads.

Every access of either side to a disk or the database is a step. At any step the robot or the relay can be
killed, before or after its effect, or the link be cut.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

from twisted.internet.defer import Deferred, maybeDeferred, succeed
from twisted.internet.task import Clock

from relay_db import queries
from relay_db.engine import Database
from relay_db.queries import FileQuotas, FileRecord
from relay_protocol import link
from relay_protocol.errors import Unavailable
from relay_server.events.bus import EventBus
from relay_server.files.file_link import FileLinkHandler
from relay_server.files.incoming import IncomingFolder
from relay_server.files.links import FileLinks
from relay_server.files.storage import FileStorage, LocalStorage
from relay_server.files.uploads import Uploads
from relay_server.http.limits import ConnectionLimits
from relay_server.robots.connection import LinkTiming, RobotConnection
from relay_server.robots.registry import RobotState
from relay_server.robots.tickets import Tickets
from robot_client.files.confirmed import ConfirmedFiles
from robot_client.files.settings import FileGroupSettings
from robot_client.files.uploader import FileUploader
from tests.worlds.empty_database import write_empty_database
from tests.worlds.robot_links import Transport

LARGE = 10**15
OLD = 1_000_000_000.0
"""Time of files, Unix seconds."""


class Steps:
    """Counts the effects of one side, which dies or stalls at the chosen one.

    :param at: number of the step, ``None`` for none
    :param done: whether its effect takes place
    :param struck: called at that step
    """

    def __init__(self, at: int | None = None, done: bool = True, struck: Callable[[], None] = bool) -> None:
        self.at = at
        self.done = done
        self.struck = struck
        self.count = 0
        self.dead = False

    def run(self, work: Callable[..., Any], *args: Any, **more: Any) -> Deferred[Any]:
        """Does a step. The result of the last step of a dead side never arrives."""
        if self.dead:
            return Deferred()
        self.count += 1
        if self.count != self.at:
            return maybeDeferred(work, *args, **more)
        result = maybeDeferred(work, *args, **more) if self.done else Deferred()
        self.dead = True
        self.struck()
        if self.dead:
            result.addErrback(lambda failure: None)
            return Deferred()
        return result if self.done else maybeDeferred(work, *args, **more)


class StepPool:
    """Runs work at once, as :class:`relay_server.common.database.BoundedThreadPool` does later."""

    def __init__(self, steps: Steps) -> None:
        self._steps = steps

    async def run(self, work: Callable[..., Any], *args: Any, **more: Any) -> Any:
        return await self._steps.run(work, *args, **more)


class StepDatabase:
    """Runs queries at once."""

    def __init__(self, steps: Steps, database: Database) -> None:
        self._steps = steps
        self.database = database
        self.down = False

    async def read(self, query: Callable[..., Any], *args: Any, **more: Any) -> Any:
        with self.database.reading() as session:
            return query(session, *args, **more)

    async def write(self, query: Callable[..., Any], *args: Any, **more: Any) -> Any:
        def work() -> Any:
            if self.down:
                raise Unavailable("the database does not answer")
            with self.database.begin() as session:
                return query(session, *args, **more)

        return await self._steps.run(work)


class Wire(Transport):
    """One side of a connection; :meth:`FileWorld.pump` delivers its bytes to the other."""

    peer: Wire
    end: Any

    def __init__(self) -> None:
        super().__init__()
        self.outgoing: list[bytes] = []

    def write(self, data: bytes) -> None:
        self.outgoing.append(bytes(data))

    def writeSequence(self, data: Any) -> None:
        self.outgoing += [bytes(each) for each in data]


class ControlLink:
    """The relay's messages on the control link, as far as files need it."""

    def __init__(self, world: FileWorld) -> None:
        self._world = world

    def send(self, message: link.Message) -> None:
        assert isinstance(message, link.OpenFileLink)
        self._world.clock.callLater(0, self._world.opened, message)


class FileWorld:
    """A relay and a robot with one group of files.

    :ivar folder: of the group, on the robot
    :ivar groups: for the next daemon
    """

    def __init__(self, folder: Path, **group: Any) -> None:
        self.clock = Clock()
        self.clock.advance(1000.0)
        self.data = folder / "relay"
        self.state = folder / "robot-state"
        self.folder = folder / "robot"
        for each in (self.data, self.state, self.folder):
            each.mkdir()
        settings: dict[str, Any] = {"name": "bags", "folder": str(self.folder), "after": "delete", **group}
        self.groups = [FileGroupSettings(**settings)]
        write_empty_database(folder / "relay.db")
        self.database = Database(f"sqlite:///{folder / 'relay.db'}")
        with self.database.begin() as session:
            self.robot_id = queries.add_robot(session, "r1", "", "default").id
        self.quotas = FileQuotas(LARGE, LARGE, LARGE)
        self.reserve = 0
        self.storage: FileStorage | None = None
        self.full = False
        self._delivered = 0
        self.wires: list[Wire] = []
        self.alerts: list[tuple[str, bool]] = []
        self.received: list[tuple[str, dict[str, Any]]] = []
        self.tickets = itertools.count(1)
        self.sent_offers: list[link.OfferFile] = []
        self.start_relay(Steps())
        self.start_robot(Steps())

    # --- both sides ---------------------------------------------------------------------------------------

    def start_relay(self, steps: Steps) -> None:
        """Starts a relay on the same database and folder."""
        self.relay_steps = steps
        self.store = StepDatabase(steps, self.database)
        storage = self.storage or LocalStorage(self.data)
        incoming = self.incoming_folder = IncomingFolder(self.data / "incoming", storage, self.reserve)
        incoming.prepare()
        bus = EventBus()
        bus.subscribe(lambda event: self.received.append((event.kind, event.data)))
        pool, store = StepPool(steps), self.store
        self.uploads = Uploads(
            database=store,  # type: ignore[arg-type]
            pool=pool,  # type: ignore[arg-type]
            storing=pool,  # type: ignore[arg-type]
            incoming=incoming,
            storage=storage,
            quotas=self.quotas,
            bus=bus,
            wall=lambda: OLD + self.clock.seconds(),
        )
        self.links = FileLinks(self.uploads, Tickets(self.clock, lambda: f"ticket-{next(self.tickets)}"))
        self.robot = RobotState(self.robot_id, "r1", "default", control_link=ControlLink(self))  # type: ignore[arg-type]
        self.content = storage

    def start_robot(self, steps: Steps) -> None:
        """Starts a daemon on the same folders."""
        self.robot_steps = steps
        self.uploader = FileUploader(
            self.groups,
            ConfirmedFiles(self.state / "confirmed.db"),
            send=self._sent,
            dial=lambda address: self,  # type: ignore[arg-type, return-value]
            clock=self.clock,
            in_thread=steps.run,
            full=lambda: self.full,
            now=self.now,
            alert=self._alert,
            wall=lambda: OLD + self.clock.seconds(),
        )
        self.uploader.registered(1.0)

    def now(self) -> int:
        return int(self.clock.seconds() * 1e9)

    def _sent(self, message: link.Message) -> None:
        assert isinstance(message, link.RequestFileLink)
        self.links.request(self.robot)

    def _alert(self, level: str, text: str, kind: str = "", about: str = "", over: bool = False) -> None:
        self.alerts.append((text, over))

    def opened(self, message: link.OpenFileLink) -> None:
        if not self.robot_steps.dead:
            self.uploader.open(message)

    def connect(self, factory: Any) -> Deferred[Any]:
        """Connects to the relay."""
        near, far = Wire(), Wire()
        near.peer, far.peer = far, near
        near.end = near.protocol = factory.buildProtocol(None)
        limits = ConnectionLimits(1000)
        far.end = far.protocol = RobotConnection(
            self.clock, self.now, LinkTiming(1.0), lambda each: _Join(self, each), limits
        )
        self.wires += [near, far]
        near.end.makeConnection(near)
        far.end.makeConnection(far)
        return succeed(near.end)

    # --- time ---------------------------------------------------------------------------------------------

    def pump(self) -> bool:
        """Delivers written bytes; returns false if there were none."""
        some = False
        for wire in list(self.wires):
            data, wire.outgoing = b"".join(wire.outgoing), []
            dead = self.robot_steps.dead or self.relay_steps.dead
            if data and wire.peer.connected and not dead:
                some = True
                if isinstance(wire.peer.end, RobotConnection):
                    self._delivered += len(data)
                wire.peer.end.dataReceived(data)
            if not wire.connected and wire.peer.connected:
                some = True
                wire.peer.abortConnection()
        self.wires = [each for each in self.wires if each.connected or each.peer.connected]
        return some

    def run(self, seconds: float) -> None:
        """Lets time pass."""
        for _ in range(max(1, round(seconds / 0.5))):
            self.clock.advance(0.5)
            if not self.robot_steps.dead:
                self.uploader.check()
            while self.pump():
                self.clock.advance(0)

    def cut(self) -> None:
        """Cuts all connections."""
        for wire in list(self.wires):
            wire.outgoing = []
            if wire.connected:
                wire.abortConnection()
        self.wires = []

    @property
    def offered_bytes(self) -> int:
        """Bytes that have reached the relay over all connections."""
        return self._delivered

    def incoming(self) -> list[Path]:
        """Incoming files on the relay's disk."""
        return [each for each in (self.data / "incoming").iterdir() if each.stat().st_size]

    # --- files --------------------------------------------------------------------------------------------

    def write(self, name: str, content: bytes) -> Path:
        """A file of the robot with an old time."""
        import os

        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        os.utime(path, (OLD, OLD))
        return path

    def stored(self) -> list[FileRecord]:
        """The files that the relay lists."""
        with self.database.reading() as session:
            return queries.list_files(session, self.robot_id, "", None, 10**6)

    def read(self, file: FileRecord) -> bytes:
        """The content of a listed file."""
        content = self.content.open(str(file.id))
        try:
            return content.read(0, file.size + 1)
        finally:
            content.close()

    def check(self, name: str, content: bytes) -> None:
        """The file is listed once, with its content, and the relay's disk has no other files."""
        files = self.stored()
        assert [each.name for each in files] == [f"bags/{name}"]
        assert files[0].sha256 == hashlib.sha256(content).hexdigest()
        assert self.read(files[0]) == content


class _Join:
    """The first role of a connection: it takes the ticket."""

    def __init__(self, world: FileWorld, connection: RobotConnection) -> None:
        self._world = world
        self._connection = connection

    def message(self, body: bytes) -> None:
        from relay_protocol import jsontext, limits

        message = jsontext.decode(link.handshake_request_decoder, body)
        assert isinstance(message, link.Join)
        robot = self._world.links.redeem(message.ticket, self._connection)
        assert robot is not None
        handler = FileLinkHandler(self._world.uploads, robot, self._connection)
        self._connection.send(link.Joined(channel="files", at=self._world.now()))
        self._connection.set_handler(handler, 2 * limits.FILE_PART)

    def sample(self, frame: Any) -> None:
        raise AssertionError

    def lost(self, reason: str) -> None:
        """Nothing to close."""
