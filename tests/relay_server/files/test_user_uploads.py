"""Files that users upload by HTTP: in parts, resumed, checked, and by rights."""

from __future__ import annotations

import hashlib
from contextlib import asynccontextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from twisted.internet.defer import Deferred

from relay_db import queries
from relay_protocol.errors import Invalid, NotFound, Refused, Unavailable
from relay_protocol.rights import Operation
from relay_server.events.bus import EventBus
from relay_server.files.build import FileCore
from relay_server.files.http import FileUploadQuery, _part_of
from relay_server.files.schemas import FileInfo, UploadInfo
from relay_server.files.service import FileService, UploadGap, UploadPart
from relay_server.files.uploads import UploadRefused
from tests.worlds.file_uploads import OLD, FileWorld, StepPool, Steps

CONTENT = bytes(range(256)) * 100
SHA256 = hashlib.sha256(CONTENT).hexdigest()
EVERYTHING = frozenset(Operation)


class Permit:
    """Allows some operations on all names."""

    def __init__(self, operations: frozenset[Operation]) -> None:
        self._operations = operations
        self.principal = SimpleNamespace(name="ann", realm="default", full="ann@default")

    def decide(self, operation: Operation, resource: str) -> Any:
        allowed = operation in self._operations
        return SimpleNamespace(allowed=allowed, reason="only owners manage")


class Sessions:
    """Admits one user to one robot."""

    def __init__(self, world: FileWorld) -> None:
        self._world = world
        self.operations = EVERYTHING

    @asynccontextmanager
    async def admitted(self, principal: Any, robot: str, address: str) -> Any:
        robot_state = SimpleNamespace(
            robot_id=self._world.robot_id, full="r1@default", name_of=lambda user, realm: user
        )
        yield SimpleNamespace(permit=Permit(self.operations), robot=robot_state, address=address)


class Uploader:
    """A user who uploads to a world's robot."""

    def __init__(self, folder: Path) -> None:
        self.world = FileWorld(folder)
        self.sessions = Sessions(self.world)
        self.name = "maps/hall.yaml"
        self.restart()

    def restart(self) -> None:
        """Starts a relay on the same database and folder."""
        world = self.world
        world.start_relay(Steps())
        pool: Any = StepPool(world.relay_steps)
        database: Any = world.store
        sessions: Any = self.sessions
        core = FileCore(pool, pool, world.incoming_folder, world.content, world.uploads, world.links)
        self.service = FileService(sessions, core, database, EventBus(), 0, lambda: OLD)

    def put(self, offset: int | None, stop: int = 0, sha256: str = SHA256, data: bytes = CONTENT) -> Any:
        """Sends a part; returns the answer or the error."""
        sent = b"" if offset is None else data[offset:stop]
        part = UploadPart(sha256, len(CONTENT), OLD, offset, sent)
        principal: Any = SimpleNamespace(name="ann", realm="default")
        done: list[Any] = []
        work = self.service.upload(principal, "r1", self.name, "::1", part)
        Deferred.fromCoroutine(work).addBoth(done.append)
        assert done
        return getattr(done[0], "value", done[0])

    def audited(self) -> list[str]:
        with self.world.database.reading() as session:
            return [each.action for each in queries.list_audit(session)]


@pytest.fixture
def uploader(tmp_path: Path) -> Uploader:
    return Uploader(tmp_path)


def test_a_file_arrives_in_parts_also_over_a_restart_of_the_relay(uploader: Uploader) -> None:
    first = uploader.put(0, 10_000)
    assert isinstance(first, UploadInfo)
    assert (first.received, first.size, first.origin) == (10_000, len(CONTENT), "user:ann")
    assert uploader.world.stored() == []
    uploader.restart()
    assert uploader.put(None).received == 10_000
    stored = uploader.put(10_000, len(CONTENT))
    assert isinstance(stored, FileInfo)
    [file] = uploader.world.stored()
    assert (file.name, file.sha256, file.origin) == (uploader.name, SHA256, "user:ann")
    assert uploader.world.read(file) == CONTENT
    assert uploader.audited().count("file.put") == 1
    assert [kind for kind, _ in uploader.world.received] == ["file.stored"]


def test_a_part_may_be_sent_again(uploader: Uploader) -> None:
    uploader.put(0, 10_000)
    assert uploader.put(0, 10_000).received == 10_000
    assert uploader.put(5_000, 12_000).received == 12_000
    assert isinstance(uploader.put(0, len(CONTENT)), FileInfo)
    again = uploader.put(0, 10)
    assert isinstance(again, FileInfo)
    assert again.sha256 == SHA256


def test_a_gap_is_refused_with_the_place_to_go_on(uploader: Uploader) -> None:
    uploader.put(0, 10_000)
    gap = uploader.put(10_001, 12_000)
    assert isinstance(gap, UploadGap)
    assert gap.problem_fields == {"received": 10_000}


def test_other_contents_are_refused_and_begin_again(uploader: Uploader) -> None:
    refused = uploader.put(0, len(CONTENT), data=bytes(len(CONTENT)))
    assert isinstance(refused, UploadRefused)
    assert (refused.code, refused.http_status) == ("mismatch", 422)
    assert uploader.world.stored() == []
    assert uploader.put(None).received == 0


@pytest.mark.parametrize(
    ("operations", "error"),
    [
        (frozenset({Operation.DOWNLOAD}), Refused),
        (frozenset({Operation.MANAGE}), NotFound),
        (frozenset(), NotFound),
    ],
)
def test_without_the_rights_nothing_is_uploaded(
    uploader: Uploader, operations: frozenset[Operation], error: type[Exception]
) -> None:
    uploader.sessions.operations = operations
    assert isinstance(uploader.put(0, len(CONTENT)), error)
    with uploader.world.database.reading() as session:
        assert queries.usage_of_robot(session, uploader.world.robot_id).files == 0


def test_the_quota_holds(uploader: Uploader) -> None:
    uploader.world.quotas = queries.FileQuotas(1000, 1000, 1000)
    uploader.restart()
    refused = uploader.put(0, 100)
    assert (refused.code, refused.http_status) == ("quota", 409)


@pytest.mark.parametrize("name", ["../relay.db", "maps//x", "a\nb", "x" * 1025])
def test_a_name_that_can_not_be_is_refused(uploader: Uploader, name: str) -> None:
    uploader.name = name
    assert isinstance(uploader.put(0, len(CONTENT)), Invalid)


def test_no_audit_entry_no_upload(uploader: Uploader, monkeypatch: pytest.MonkeyPatch) -> None:
    async def unwritten(*args: object) -> None:
        raise Unavailable("the database does not answer")

    monkeypatch.setattr(uploader.service, "_audit", unwritten)
    assert isinstance(uploader.put(0, len(CONTENT)), Unavailable)
    assert uploader.world.stored() == []


def test_an_unfinished_upload_is_deleted_by_name(uploader: Uploader) -> None:
    uploader.put(0, 10_000)
    principal: Any = SimpleNamespace(name="ann", realm="default")
    work = uploader.service.delete(principal, "r1", uploader.name, "::1", None)
    done: list[Any] = []
    Deferred.fromCoroutine(work).addBoth(done.append)
    assert done == [None]
    assert uploader.world.incoming() == []
    with uploader.world.database.reading() as session:
        assert queries.usage_of_robot(session, uploader.world.robot_id).files == 0


class Request:
    """A request with a body."""

    def __init__(self, body: bytes, place: str | None) -> None:
        self._body = body
        self._place = place

    def content(self) -> bytes:
        return self._body

    def header(self, name: str) -> str | None:
        return self._place


@pytest.mark.parametrize(
    ("place", "body", "size", "offset"),
    [
        (None, b"12345", 5, 0),
        ("bytes 0-4/5", b"12345", 5, 0),
        ("bytes 3-4/9", b"45", 9, 3),
        ("bytes */9", b"", 9, None),
    ],
)
def test_places_of_parts(place: str | None, body: bytes, size: int, offset: int | None) -> None:
    request: Any = Request(body, place)
    part = _part_of(request, FileUploadQuery(SHA256), OLD)
    assert part == UploadPart(SHA256, size, OLD, offset, body)


@pytest.mark.parametrize(
    ("place", "body", "sha256"),
    [
        ("bytes 0-4/5", b"12345", None),
        ("bytes 0-4/5", b"1234", SHA256),
        ("bytes 0-4/*", b"12345", SHA256),
        ("bytes 4-8/5", b"12345", SHA256),
        (f"bytes */{2**70}", b"", SHA256),
        ("bytes */9", b"1", SHA256),
        ("lines 0-4/5", b"12345", SHA256),
        ("nonsense", b"", SHA256),
    ],
)
def test_places_that_can_not_be_are_refused(place: str, body: bytes, sha256: str | None) -> None:
    request: Any = Request(body, place)
    with pytest.raises(Invalid):
        _part_of(request, FileUploadQuery(sha256), OLD)


def test_the_hash_of_a_whole_file_may_be_left_out() -> None:
    request: Any = Request(CONTENT, None)
    assert _part_of(request, FileUploadQuery(), OLD).sha256 == SHA256
