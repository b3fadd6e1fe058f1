"""What the edge asks about recordings: judged by the rights on all that a recording holds."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec

from relay_db import queries
from relay_protocol.errors import Invalid, NotFound, Refused, Unavailable
from relay_protocol.realms import full_name
from relay_protocol.rights import Operation
from relay_server.access import Permit, Principal, may_subscribe
from relay_server.common.database import AsyncDatabase
from relay_server.common.token_bucket import TokenBucket
from relay_server.events.bus import EventBus
from relay_server.recordings.library import READABLE, RUNNING, UNKNOWN, RecordingEntry, place
from relay_server.recordings.recordings import RecordingRequest, Recordings
from relay_server.recordings.rights import why_denied, why_not
from relay_server.sessions.manager import AuthorizedSession, SessionManager

RATE = 1.0
BURST = 20
"""What one user may have put on record about recordings: so much a second, and so much at once."""

FETCH_SECONDS = 3600.0
"""A download is put on record once in so long, however many parts the one who has it takes it in."""

FETCHES = 1000
"""Downloads that are remembered for that."""

PAGE = 100
PAGE_MOST = 500
"""Recordings that are listed at a time, unless others are asked for, and at most."""


class Download:
    """A file on its way to somebody. Give it back by :meth:`close`.

    :ivar name: for the one who gets it
    :ivar size: bytes
    :ivar tag: names this content; it never changes under it
    """

    def __init__(
        self,
        recordings: Recordings,
        entry: RecordingEntry,
        permit: Permit,
        begin: Callable[[], Awaitable[None]],
        close: Callable[[], None],
    ) -> None:
        self._recordings = recordings
        self._entry = entry
        self._permit = permit
        self._path: Path = recordings.library.path(entry)
        self.name = f"{entry.robot}-{entry.id}.mcap"
        self.size = entry.bytes
        self.tag = entry.id
        self._begin = begin
        self.close = close

    async def begin(self) -> None:
        """Put on record that it is sent.

        :raises Unavailable: it can't be
        """
        await self._begin()

    def watch(self, denied: Callable[[str], None]) -> None:
        """Tell when it may not go on, and why."""
        self._permit.on_revoke = lambda error: denied(str(error))

        def changed() -> None:
            reason = why_denied(self._permit, self._entry)
            if reason:
                denied(reason)

        self._permit.on_change = changed
        changed()

    async def part(self, offset: int, size: int) -> bytes:
        """Some of its bytes; none when it is not there any more.

        :raises OSError: it can't be read
        """
        return await self._recordings.read(self._path, offset, size)


class RecordingService:
    """Recordings as users have them.

    :param wall: Unix time in seconds
    """

    def __init__(
        self,
        desk: SessionManager,
        recordings: Recordings,
        store: AsyncDatabase,
        journal: EventBus,
        wall: Callable[[], float],
    ) -> None:
        self._desk = desk
        self._recordings = recordings
        self._store = store
        self._journal = journal
        self._wall = wall
        self._buckets: dict[int, TokenBucket] = {}
        self._fetched: OrderedDict[tuple[int, str, str], float] = OrderedDict()

    # --- what users ask for -------------------------------------------------------------------------------

    async def start(
        self, principal: Principal, robot: str, ask: RecordingRequest, address: str
    ) -> dict[str, Any]:
        """Begin a recording.

        :raises NotFound: no such robot, or no right on it
        :raises Refused: no right to what is to be recorded
        :raises SwitchboardError: see :meth:`Recordings.start`
        """
        admission = await self._desk.admit(principal, robot, address)
        try:
            entry = self._recordings.entry(ask, admission.robot, admission.permit)
            self._see_allowed(admission, entry)
            await self._on_record("recording.start", entry, admission)
            await self._recordings.start(
                entry, admission.robot, admission.permit, lambda entry: self._ended(entry, admission)
            )
        except BaseException:
            self._desk.turn_away(admission)
            raise
        self._event("recording.started", entry, admission, address=address)
        return self._view(entry)

    async def may_start(self, principal: Principal, robot: str, ask: RecordingRequest, address: str) -> None:
        """See that somebody might begin a recording now, without doing it.

        :raises SwitchboardError: as :meth:`start`, as far as rights go
        """
        with self._admitted(await self._desk.admit(principal, robot, address)) as admission:
            self._see_allowed(admission, self._recordings.entry(ask, admission.robot, admission.permit))

    @staticmethod
    def _see_allowed(admission: AuthorizedSession, entry: RecordingEntry) -> None:
        reason = why_denied(admission.permit, entry)
        if reason:
            raise Refused(reason)

    async def possible(self, principal: Principal, robot: str, address: str) -> dict[str, Any]:
        """What the principal could record of a robot now: topics, cameras, and how much.

        :raises NotFound: no such robot, or no right on it
        """
        with self._admitted(await self._desk.admit(principal, robot, address)) as admission:
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
    ) -> dict[str, Any]:
        """The recordings of a robot that the principal may have, the latest first.

        :param limit: no more than so many
        :param before: what an earlier answer gave as ``next``: go on behind the last of that one
        :raises NotFound: no such robot, or no right on it
        :raises Invalid: no answer gave that
        """
        behind = _place_of(before) if before else None
        with self._admitted(await self._desk.admit(principal, robot, address)) as admission:
            found: list[RecordingEntry] = []
            for entry in self._recordings.library.of(admission.robot.robot_id):
                if (behind is None or place(entry) < behind) and not why_denied(admission.permit, entry):
                    if len(found) == limit:
                        # There is one more.
                        return self._page(found, _cursor_of(found[-1]))
                    found.append(entry)
            return self._page(found, None)

    def _page(self, found: list[RecordingEntry], following: str | None) -> dict[str, Any]:
        shown = [self._view(self._recordings.look(entry)) for entry in found]
        return {"recordings": shown, "next": following}

    async def one(self, principal: Principal, robot: str, id: str, address: str) -> dict[str, Any]:
        """One recording.

        :raises NotFound: no such robot or recording, or no right to all of it
        """
        with self._admitted(await self._desk.admit(principal, robot, address)) as admission:
            return self._view(self._recordings.look(self._find(admission, id)))

    async def stop(self, principal: Principal, robot: str, id: str, address: str) -> dict[str, Any]:
        """Finish a recording; one that is finished stays what it is.

        :raises NotFound: as :meth:`one`
        :raises Refused: somebody else's, and no right to manage the robot
        """
        with self._admitted(await self._desk.admit(principal, robot, address)) as admission:
            entry = self._find(admission, id)
            self._check_own(admission.permit, entry)
        await self._recordings.stop(entry, f"stopped by {principal.name}")
        return self._view(entry)

    async def delete(self, principal: Principal, robot: str, id: str, address: str) -> None:
        """Delete a recording; one that runs is stopped before.

        :raises NotFound: as :meth:`one`
        :raises Refused: somebody else's, and no right to manage the robot
        :raises Unavailable: it can't be deleted
        """
        with self._admitted(await self._desk.admit(principal, robot, address)) as admission:
            entry = self._find(admission, id)
            self._check_own(admission.permit, entry)
            await self._on_record("recording.delete", entry, admission)
        await self._recordings.stop(entry, f"deleted by {principal.name}")
        await self._recordings.delete(entry)

    async def download(self, principal: Principal, robot: str, id: str, address: str) -> Download:
        """The file of a recording; it must be closed.

        :raises NotFound: as :meth:`one`
        :raises Unavailable: it is not finished
        """
        admission = await self._desk.admit(principal, robot, address)
        try:
            entry = self._find(admission, id)
            if entry.state in RUNNING:
                raise Unavailable("it is still being recorded: stop it, or wait for its end")
            if entry.state not in READABLE:
                raise Unavailable("it broke off, and the file is not recovered yet; try again later")
        except BaseException:
            self._desk.turn_away(admission)
            raise
        return Download(
            self._recordings,
            entry,
            admission.permit,
            lambda: self._fetch(entry, admission),
            lambda: self._desk.turn_away(admission),
        )

    # --- rights -------------------------------------------------------------------------------------------

    @staticmethod
    def _why_no_topic(admission: AuthorizedSession, name: str) -> str:
        permit, robot = admission.permit, admission.robot
        verdict = may_subscribe(permit.judge, robot, name)
        return why_not(permit, Operation.SUBSCRIBE, name) if verdict.allowed else verdict.reason

    @contextmanager
    def _admitted(self, admission: AuthorizedSession) -> Iterator[AuthorizedSession]:
        try:
            yield admission
        finally:
            self._desk.turn_away(admission)

    def _find(self, admission: AuthorizedSession, id: str) -> RecordingEntry:
        entry = self._recordings.library.find(admission.robot.robot_id, id)
        if why_denied(admission.permit, entry):
            raise NotFound(UNKNOWN)
        return entry

    @staticmethod
    def _check_own(permit: Permit, entry: RecordingEntry) -> None:
        if entry.user_id != permit.principal.user_id:
            for name in (*entry.topics, *entry.cameras):
                verdict = permit.judge(Operation.MANAGE, name)
                if not verdict.allowed:
                    raise Refused(f"it is a recording of {entry.user}; {verdict.reason}")

    def _view(self, entry: RecordingEntry) -> dict[str, Any]:
        """What its users see of a recording."""
        shown: dict[str, Any] = msgspec.to_builtins(entry)
        for hidden in ("robot_id", "user_id", "realm", "home", "pictures"):
            del shown[hidden]
        shown["megabytes"] = shown.pop("limit") / 10**6
        # Told by the relay: the clocks of those who look may be wrong.
        until = self._wall() if entry.state in RUNNING else entry.ended
        shown["lasted"] = None if until is None else round(until - entry.begun, 1)
        return shown

    # --- what is put on record ----------------------------------------------------------------------------

    async def _on_record(self, action: str, entry: RecordingEntry, admission: AuthorizedSession) -> None:
        """Who does it is on record before it is done.

        :raises Unavailable: it can't be, or the user does too much
        """
        principal = admission.permit.principal
        bucket = self._buckets.setdefault(principal.user_id, TokenBucket(RATE, BURST, self._wall))
        if not bucket.take():
            raise Unavailable("you do too much with recordings at once; try again in a moment")
        await self._store.write(
            queries.append_audit,
            at=self._wall(),
            actor=f"user:{principal.full}",
            action=action,
            target=f"{entry.robot_full}/{entry.id}",
            origin=admission.address,
            data={"topics": list(entry.topics), "cameras": list(entry.cameras)},
        )

    async def _fetch(self, entry: RecordingEntry, admission: AuthorizedSession) -> None:
        key = (admission.permit.principal.user_id, entry.id, admission.address)
        if self._fetched.get(key, -FETCH_SECONDS) + FETCH_SECONDS > self._wall():
            return
        await self._on_record("recording.download", entry, admission)
        self._fetched[key] = self._wall()
        self._fetched.move_to_end(key)
        while len(self._fetched) > FETCHES:
            self._fetched.popitem(last=False)

    def _ended(self, entry: RecordingEntry, admission: AuthorizedSession) -> None:
        self._desk.turn_away(admission)
        self._event(
            "recording.ended",
            entry,
            admission,
            state=entry.state.value,
            reason=entry.reason[:200],
            bytes=entry.bytes,
            messages=entry.messages,
            drops=entry.drops,
        )

    def _event(self, kind: str, entry: RecordingEntry, admission: AuthorizedSession, **data: Any) -> None:
        self._journal.event(
            kind,
            f"user:{admission.robot.name_of(entry.user, entry.realm)}",
            cause=f"user:{full_name(entry.user, entry.realm)}",
            robot_id=entry.robot_id,
            user_id=entry.user_id,
            recording=entry.id,
            **data,
        )


def _cursor_of(entry: RecordingEntry) -> str:
    """Where a page ends: also when that recording is deleted, the next one begins behind it."""
    begun, id = place(entry)
    return f"{begun!r}_{id}"


def _place_of(cursor: str) -> tuple[float, str]:
    """Where :func:`_cursor_of` says.

    :raises Invalid: it never said that
    """
    begun, _, id = cursor.partition("_")
    try:
        at = float(begun)
    except ValueError:
        at = math.nan
    if not math.isfinite(at):
        raise Invalid("'before' is what an earlier answer gave as 'next'")
    return at, id
