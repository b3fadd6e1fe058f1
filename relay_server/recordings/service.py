"""Recordings in answers of the HTTP API.

Recordings as users start, list, stop, delete and download them, by their rights on all that a recording
contains.
"""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable, Sequence
from typing import Any, Literal, TypedDict

from relay_db import queries
from relay_protocol.errors import Invalid, NotFound, Refused, Unavailable
from relay_protocol.rights import Operation
from relay_server.access import Permit, Principal, may_subscribe
from relay_server.common.database import AsyncDatabase
from relay_server.common.token_bucket import TokenBucket
from relay_server.events.bus import EventBus
from relay_server.files.storage import ContentReader
from relay_server.recordings.library import (
    READABLE,
    RUNNING,
    UNKNOWN,
    RecordingEntry,
    place,
    why_denied,
    why_not,
)
from relay_server.recordings.recordings import RecordingRequest, Recordings
from relay_server.sessions.download_audit import DownloadAudit
from relay_server.sessions.manager import Admission, SessionManager


class RecordingInfo(TypedDict):
    """A recording.

    :param begun: Unix seconds
    :param ended: Unix seconds
    :param lasted: duration, seconds
    :param megabytes: largest size of the file
    """

    id: str
    robot: str
    user: str
    topics: list[str]
    cameras: list[str]
    begun: float
    ended: float | None
    lasted: float | None
    state: Literal["recording", "finishing", "complete", "incomplete", "recovered"]
    reason: str
    seconds: float
    megabytes: float
    bytes: int
    messages: int
    drops: int
    problems: list[str]


class RecordingPage(TypedDict):
    """A page of recordings, the latest first."""

    recordings: list[RecordingInfo]
    next: str | None


class Recordable(TypedDict):
    """Topics and cameras that the caller could record now.

    :param denied: why there are none
    :param megabytes: largest size of all recordings of the realm together
    :param full: why no other recording can begin
    """

    topics: list[str]
    cameras: list[str]
    denied: str
    megabytes: float
    left: float
    full: str


RATE = 1.0
BURST = 20
"""Audit entries of one user about recordings: per second, and at once."""

PAGE = 100
PAGE_MOST = 500
"""Recordings on a page: by default, and at most."""


class Download:
    """A file that is being downloaded. It must be closed.

    :ivar name: file name for the client
    :ivar size: bytes
    :ivar tag: entity tag; the contents never change
    :ivar begin: writes the audit entry
    """

    def __init__(
        self,
        recordings: Recordings,
        entry: RecordingEntry,
        content: ContentReader,
        permit: Permit,
        begin: Callable[[], Awaitable[None]],
        release: Callable[[], None],
    ) -> None:
        self._recordings = recordings
        self._entry = entry
        self.permit = permit
        self._content = content
        self._release = release
        self._closed = False
        self.name = f"{entry.robot}-{entry.id}.mcap"
        self.size = entry.bytes
        self.tag = entry.id
        self.begin = begin

    def allowed(self) -> bool:
        """Whether it may go on."""
        return not why_denied(self.permit, self._entry)

    async def part(self, offset: int, size: int) -> bytes:
        """Some bytes of the file; none when it has been deleted.

        :raises OSError: it cannot be read
        """
        return await self._recordings.read(self._entry, self._content, offset, size)

    def close(self) -> None:
        """End the download."""
        if not self._closed:
            self._closed = True
            self._content.close()
            self._release()


class RecordingService:
    """:param wall: Unix time in seconds"""

    def __init__(
        self,
        sessions: SessionManager,
        recordings: Recordings,
        store: AsyncDatabase,
        bus: EventBus,
        wall: Callable[[], float],
    ) -> None:
        self._sessions = sessions
        self._recordings = recordings
        self._store = store
        self._bus = bus
        self._wall = wall
        self._buckets: dict[int, TokenBucket] = {}
        self._downloads = DownloadAudit(wall)

    # --- requests of users ---------------------------------------------------------------------------------

    async def start(
        self, principal: Principal, robot: str, ask: RecordingRequest, address: str
    ) -> RecordingInfo:
        """Start a recording.

        :raises NotFound: no such robot, or no right on it
        :raises Refused: no right to record something
        :raises SwitchboardError: see :meth:`Recordings.start`
        """
        admission = await self._sessions.admit(principal, robot, address)
        try:
            entry = self._recordings.entry(ask, admission.robot, admission.permit)
            self._check_allowed(admission, entry)
            await self._audit("recording.start", entry, admission)
            await self._recordings.start(
                entry, admission.robot, admission.permit, lambda entry: self._ended(entry, admission)
            )
        except BaseException:
            self._sessions.release(admission)
            raise
        self._publish("recording.started", entry, admission, address=address)
        return self._info(entry)

    async def may_start(self, principal: Principal, robot: str, ask: RecordingRequest, address: str) -> None:
        """Check that a recording could be started now, without doing it.

        :raises SwitchboardError: as :meth:`start`, as far as rights are concerned
        """
        async with self._sessions.admitted(principal, robot, address) as admission:
            self._check_allowed(admission, self._recordings.entry(ask, admission.robot, admission.permit))

    @staticmethod
    def _check_allowed(admission: Admission, entry: RecordingEntry) -> None:
        reason = why_denied(admission.permit, entry)
        if reason:
            raise Refused(reason)

    async def possible(self, principal: Principal, robot: str, address: str) -> Recordable:
        """Topics and cameras of a robot that the principal could record now, and the limits.

        :raises NotFound: no such robot, or no right on it
        """
        async with self._sessions.admitted(principal, robot, address) as admission:
            there, library = admission.robot, self._recordings.library
            topics = {
                name: self._why_no_topic(admission, name)
                for name in sorted(there.graph.topics)
                if "/_" not in name
            }
            cameras = {
                camera.name: why_not(admission.permit, Operation.VIEW, camera.name)
                for camera in there.cameras
            }
            reasons = [*topics.values(), *cameras.values()]
            return {
                "topics": [name for name, reason in topics.items() if not reason],
                "cameras": [name for name, reason in cameras.items() if not reason],
                "denied": reasons[0] if all(reasons) and reasons else "",
                "megabytes": library.quota / 10**6,
                "left": library.left(principal.realm) / 10**6,
                "full": await self._recordings.full(there, principal.realm),
            }

    async def all(
        self, principal: Principal, robot: str, address: str, limit: int = PAGE, before: str = ""
    ) -> RecordingPage:
        """The recordings of a robot that the principal may read, the latest first.

        :param limit: most recordings on the page
        :param before: ``next`` of an earlier page, which this one follows
        :raises NotFound: no such robot, or no right on it
        :raises Invalid: ``before`` is not of an earlier page
        """
        behind = _place_of(before) if before else None
        async with self._sessions.admitted(principal, robot, address) as admission:
            found: list[RecordingEntry] = []
            for entry in self._recordings.library.of(admission.robot.robot_id):
                if (behind is None or place(entry) < behind) and not why_denied(admission.permit, entry):
                    if len(found) == limit:
                        # There is one more.
                        return self._page(found, _cursor_of(found[-1]))
                    found.append(entry)
            return self._page(found, None)

    def _page(self, found: list[RecordingEntry], following: str | None) -> RecordingPage:
        shown = [self._info(self._recordings.updated(entry)) for entry in found]
        return {"recordings": shown, "next": following}

    async def one(self, principal: Principal, robot: str, id: str, address: str) -> RecordingInfo:
        """:raises NotFound: no such robot or recording, or no right to all of it"""
        async with self._sessions.admitted(principal, robot, address) as admission:
            return self._info(self._recordings.updated(self._find(admission, id)))

    async def stop(self, principal: Principal, robot: str, id: str, address: str) -> RecordingInfo:
        """Finish a recording; a finished one stays as it is.

        :raises NotFound: as :meth:`one`
        :raises Refused: another user's recording, without the right to manage the robot
        """
        async with self._sessions.admitted(principal, robot, address) as admission:
            entry = self._find(admission, id)
            self._check_own(admission.permit, entry)
        await self._recordings.stop(entry, f"stopped by {principal.name}")
        return self._info(entry)

    async def delete(self, principal: Principal, robot: str, id: str, address: str) -> None:
        """Delete a recording; a running one is stopped first.

        :raises NotFound: as :meth:`one`
        :raises Refused: another user's recording, without the right to manage the robot
        :raises Unavailable: it cannot be deleted
        """
        async with self._sessions.admitted(principal, robot, address) as admission:
            entry = self._find(admission, id)
            self._check_own(admission.permit, entry)
            await self._audit("recording.delete", entry, admission)
        await self._recordings.stop(entry, f"deleted by {principal.name}")
        await self._recordings.delete(entry)

    async def download(self, principal: Principal, robot: str, id: str, address: str) -> Download:
        """The file of a recording; it must be closed.

        :raises NotFound: as :meth:`one`
        :raises Unavailable: it is not finished, or the storage does not answer
        """
        admission = await self._sessions.admit(principal, robot, address)
        try:
            entry = self._find(admission, id)
            if entry.state in RUNNING:
                raise Unavailable("it is still being recorded: stop it, or wait for its end")
            if entry.state not in READABLE:
                raise Unavailable("it broke off, and the file is not recovered yet; try again later")
            content = await self._open(entry)
        except BaseException:
            self._sessions.release(admission)
            raise
        return Download(
            self._recordings,
            entry,
            content,
            admission.permit,
            lambda: self._downloads.write_once(
                admission, entry.id, lambda: self._audit("recording.download", entry, admission)
            ),
            lambda: self._sessions.release(admission),
        )

    async def _open(self, entry: RecordingEntry) -> ContentReader:
        """:raises SwitchboardError: its file is missing, or can't be read now"""
        try:
            return await self._recordings.open_content(entry)
        except FileNotFoundError:
            raise NotFound("the file of this recording is not there any more") from None
        except OSError:
            raise Unavailable("the file can't be read now; try again later") from None

    # --- rights -------------------------------------------------------------------------------------------

    @staticmethod
    def _why_no_topic(admission: Admission, name: str) -> str:
        permit, robot = admission.permit, admission.robot
        decision = may_subscribe(permit.decide, robot, name)
        return why_not(permit, Operation.SUBSCRIBE, name) if decision.allowed else decision.reason

    def _find(self, admission: Admission, id: str) -> RecordingEntry:
        entry = self._recordings.library.find(admission.robot.robot_id, id)
        if why_denied(admission.permit, entry):
            raise NotFound(UNKNOWN)
        return entry

    @staticmethod
    def _check_own(permit: Permit, entry: RecordingEntry) -> None:
        if entry.user_id != permit.principal.user_id:
            for name in (*entry.topics, *entry.cameras):
                decision = permit.decide(Operation.MANAGE, name)
                if not decision.allowed:
                    raise Refused(f"this recording belongs to {entry.user}; {decision.reason}")

    def _info(self, entry: RecordingEntry) -> RecordingInfo:
        # Sent by the relay, since the clocks of clients may be wrong.
        until = self._wall() if entry.state in RUNNING else entry.ended
        return {
            "id": entry.id,
            "robot": entry.robot,
            "user": entry.user,
            "topics": list(entry.topics),
            "cameras": list(entry.cameras),
            "begun": entry.begun,
            "ended": entry.ended,
            "lasted": None if until is None else round(until - entry.begun, 1),
            "state": entry.state.value,
            "reason": entry.reason,
            "seconds": entry.seconds,
            "megabytes": entry.limit / 10**6,
            "bytes": entry.bytes,
            "messages": entry.messages,
            "drops": entry.drops,
            "problems": entry.problems,
        }

    # --- audit entries and events --------------------------------------------------------------------------

    async def _audit(self, action: str, entry: RecordingEntry, admission: Admission) -> None:
        """Write the audit entry of a request before it is carried out.

        :raises Unavailable: it cannot be written, or the user makes too many requests
        """
        principal = admission.permit.principal
        bucket = self._buckets.setdefault(principal.user_id, TokenBucket(RATE, BURST, self._wall))
        if not bucket.take():
            raise Unavailable("you make too many requests about recordings; try again in a moment")
        await self._store.write(
            queries.append_audit,
            at=self._wall(),
            actor=f"user:{principal.full}",
            action=action,
            target=f"{entry.robot_full}/{entry.id}",
            origin=admission.address,
            data={"topics": list(entry.topics), "cameras": list(entry.cameras)},
        )

    def _ended(self, entry: RecordingEntry, admission: Admission) -> None:
        self._sessions.release(admission)
        self._publish(
            "recording.ended",
            entry,
            admission,
            state=entry.state.value,
            reason=entry.reason[:200],
            bytes=entry.bytes,
            messages=entry.messages,
            drops=entry.drops,
        )

    def _publish(self, kind: str, entry: RecordingEntry, admission: Admission, **data: Any) -> None:
        source = f"user:{admission.robot.name_of(entry.user, entry.realm)}"
        self._bus.publish(kind, entry.robot_id, source, recording=entry.id, **data)


def merge_pages(pages: Sequence[RecordingPage], limit: int) -> RecordingPage:
    """One page of the pages that several relays have.

    :param limit: most recordings on it
    """
    found = [each for page in pages for each in page["recordings"]]
    found.sort(key=lambda each: (each["begun"], each["id"]), reverse=True)
    more = len(found) > limit or any(page["next"] is not None for page in pages)
    shown = found[:limit]
    return {"recordings": shown, "next": _cursor(shown[-1]["begun"], shown[-1]["id"]) if more else None}


def _cursor_of(entry: RecordingEntry) -> str:
    """The end of a page. It stays valid when that recording is deleted."""
    return _cursor(*place(entry))


def _cursor(begun: float, id: str) -> str:
    return f"{begun!r}_{id}"


def _place_of(cursor: str) -> tuple[float, str]:
    """The position in a cursor of :func:`_cursor_of`.

    :raises Invalid: it is not one
    """
    begun, _, id = cursor.partition("_")
    try:
        at = float(begun)
    except ValueError:
        at = math.nan
    if not math.isfinite(at):
        raise Invalid("'before' must be 'next' of an earlier page")
    return at, id
