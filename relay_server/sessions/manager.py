"""What edges ask for, put together from who it is, what it may, and who is there."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from relay_db import queries
from relay_protocol import link
from relay_protocol.errors import NotFound, SwitchboardError, Unavailable
from relay_protocol.rights import Operation
from relay_server.access import NO_ROBOT, Access, Permit, Principal
from relay_server.auth import passwords
from relay_server.auth.authenticator import (
    NAMED,
    Authenticator,
    TicketPurpose,
    TooManyTries,
    named_realm,
    session_token,
)
from relay_server.auth.origins import Origins
from relay_server.channels.channels import Channels
from relay_server.common import close_codes
from relay_server.common.clock import Clock, with_timeout
from relay_server.common.connection_ids import ConnectionIds
from relay_server.common.cpu_quota import UserQuotas
from relay_server.common.database import AsyncDatabase
from relay_server.common.timers import PeriodicTimers
from relay_server.control.controllers import Controllers
from relay_server.events.bus import EventBus
from relay_server.relay_node.node import RelayNode
from relay_server.robots.registry import RobotRegistry, RobotState
from relay_server.sessions.message_age import MessageAge
from relay_server.sessions.ports import ClientTransport, Timing
from relay_server.sessions.presence import PresenceService
from relay_server.sessions.session import Session
from relay_server.sessions.summaries import RobotSummaries
from relay_server.video.streams import CameraStreams
from relay_server.video.viewer import CameraViewer, FrameSink, check_view, view

LOOKUP_SECONDS = 3.0
"""The database has so long to say that somebody may stop a robot."""

NOT_LOOKED_UP = (
    f"the database has not answered within {LOOKUP_SECONDS:g} s, and without it the relay can't say who may do what to "
    "which robots. Stop those that move by their own switch, or by 'switchboard stop' on the relay's machine"
)


class ShuttingDown(Unavailable):
    """The relay ends, and with it what is open."""

    code = "going_down"


@dataclass(frozen=True)
class AuthorizedSession:
    """Somebody who may come in to a robot; ``snapshot``: for one picture."""

    permit: Permit
    robot: RobotState
    address: str
    snapshot: bool = False


class SessionManager:
    """Serves the HTTP API and the websockets; keeps the open sessions.

    :param cookie: name of the session cookie
    :param clock_ns: monotonic nanoseconds
    :param wall: Unix time in seconds
    """

    def __init__(
        self,
        clock: Clock,
        store: AsyncDatabase,
        authenticator: Authenticator,
        access: Access,
        registry: RobotRegistry,
        channels: Channels,
        videos: CameraStreams,
        desks: Controllers,
        journal: EventBus,
        origins: Origins,
        timing: Timing,
        *,
        cookie: str,
        clock_ns: Callable[[], int],
        wall: Callable[[], float],
    ) -> None:
        self.accepting = True
        self._clock = clock
        self._store = store
        self._auth = authenticator
        self._access = access
        self._registry = registry
        self._channels = channels
        self._videos = videos
        self._desks = desks
        self._journal = journal
        self._origins = origins
        self.timing = timing
        self._rounds = PeriodicTimers(clock)
        self._budgets = UserQuotas(clock.seconds, time.thread_time)
        self._cookie = cookie
        self._clock_ns = clock_ns
        self._wall = wall
        # By them robots know who has to let go. They must not take a client for one of a relay that ran before.
        self._numbers = ConnectionIds()
        self._sessions: dict[int, dict[int, Session]] = {}
        self._watchings: set[CameraViewer] = set()
        people = PresenceService(self.sessions_of, desks.holder, clock.seconds)
        self.overview = RobotSummaries(access, registry, people, self.sessions_of, desks, clock.seconds)
        self._local = RelayNode(self.sessions_of, videos, people)

    def __iter__(self) -> Iterator[Session]:
        return iter([session for each in self._sessions.values() for session in each.values()])

    def sessions_of(self, robot_id: int) -> list[Session]:
        """The open sessions on a robot, oldest first."""
        return list(self._sessions.get(robot_id, {}).values())

    # --- who is it ----------------------------------------------------------------------------------------

    async def password(self, user: str, password: str, address: str) -> tuple[Principal, str]:
        """Log in by password; a principal and the token of a new portal session."""
        try:
            login = await self._auth.password(user, password, address)
        except SwitchboardError as error:
            # Who is over the limit was recorded while under it; a flood must not reach the database.
            if not isinstance(error, TooManyTries):
                self._journal.event(
                    "login.refused",
                    "relay",
                    cause=address,
                    user=user[:NAMED],
                    realm=named_realm(user),
                    address=address,
                    reason=error.code,
                )
            raise
        return login, await self._auth.open_session(login, address, "password")

    async def login_code(self, code: str, address: str) -> tuple[Principal, str]:
        """Log in by a one-time link."""
        login = await self._auth.login_code(code, address)
        return login, await self._auth.open_session(login, address, "link")

    async def logout(self, principal: Principal) -> None:
        """End the session the principal came with, and what was opened with it."""
        await self._store.write(queries.revoke_token, principal.token_id)
        await self._access.refresh()

    async def token(self, token: str) -> Principal:
        """The principal of an access token or session."""
        token_hash = passwords.token_hash(token)
        known = self._access.proves(token_hash)
        if known is not None:
            return known
        seen = self._access.refreshed
        principal = await self._auth.token(token)
        self._access.remember(token_hash, principal, seen)
        return principal

    bearer = token

    async def urgent_token(self, token: str) -> Principal:
        """The same for who stops robots: one that was proved before need not wait for the database.

        :raises Unavailable: the database has to be asked, and does not answer soon
        """
        known = self._access.remembered(passwords.token_hash(token))
        if known is not None:
            return known
        return await with_timeout(self._clock, LOOKUP_SECONDS, self.token(token), NOT_LOOKED_UP)

    async def ticket(self, ticket: str, asked: TicketPurpose, *, spend: bool = True) -> Principal:
        """The principal of a single-use ticket."""
        return await self._auth.ticket(ticket, asked, spend=spend)

    async def cookie(self, header: str, origin: str | None, host: str) -> Principal | None:
        """The principal of a session cookie in a websocket's handshake.

        :raises Refused: a cookie without a listed Origin
        """
        token = session_token(self._origins, self._cookie, header, origin, host)
        return None if token is None else await self._auth.token(token)

    # --- robots -------------------------------------------------------------------------------------------

    async def admit(self, principal: Principal, robot: str, address: str) -> AuthorizedSession:
        """Let a principal in to a robot it has a right on; :meth:`open` or :meth:`turn_away` must follow.

        :raises NotFound: no such robot, or no right on it: one and the same answer
        """
        found = await self._access.permit_by_name(principal, robot)
        if found is None:
            self._journal.event(
                "client.refused",
                "relay",
                cause=f"user:{principal.full}",
                user_id=principal.user_id,
                robot=robot[:64],
                address=address,
            )
            raise NotFound(NO_ROBOT)
        record, permit = found
        return AuthorizedSession(
            permit, self._registry.presence(record.id, record.name, record.realm), address
        )

    def turn_away(self, admission: AuthorizedSession) -> None:
        """Somebody who was admitted left before a session began."""
        self._access.release(admission.permit)

    def open(self, admission: AuthorizedSession, transport: ClientTransport, opened_ns: int) -> Session:
        """Begin a session that was admitted.

        :param opened_ns: when the websocket's handshake was answered, monotonic nanoseconds
        """
        robot = admission.robot
        session = Session(
            self._clock,
            transport,
            admission.permit,
            robot,
            self._channels.of(robot),
            self._desks.of(robot),
            self._local,
            MessageAge(self._clock_ns, opened_ns, lambda: secrets.token_bytes(8)),
            self.timing,
            self._rounds,
            self._budgets.of(admission.permit.principal.user_id),
            number=self._numbers.take(),
            address=admission.address,
            since=self._wall(),
            ended=self._ended,
        )
        self._sessions.setdefault(robot.robot_id, {})[session.number] = session
        robot.users = len(self._sessions[robot.robot_id])
        principal = admission.permit.principal
        session.notice = partial(self._journal.tell, robot_id=robot.robot_id, source=f"user:{session.name}")
        self._journal.event(
            "client.joined",
            f"user:{session.name}",
            cause=f"user:{principal.full}",
            robot_id=robot.robot_id,
            user_id=principal.user_id,
            address=admission.address,
        )
        self._registry.changed()
        return session

    def _ended(self, session: Session) -> None:
        self._access.release(session.permit)
        open_here = self._sessions.get(session.robot.robot_id, {})
        open_here.pop(session.number, None)
        session.robot.users = len(open_here)
        principal = session.permit.principal
        self._journal.event(
            "client.left",
            f"user:{session.name}",
            cause=f"user:{principal.full}",
            robot_id=session.robot.robot_id,
            user_id=principal.user_id,
            drops=session.outbox.dropped,
            refusals=session.refusals,
        )
        self._registry.changed()

    # --- cameras ------------------------------------------------------------------------------------------

    async def cameras(self, principal: Principal, robot: str) -> list[dict[str, Any]]:
        """The cameras of a robot that the principal may view.

        :raises NotFound: no such robot, or no right on it
        """
        for record, rules in await self._access.robots(principal):
            if record.name == robot:
                there = self._registry.presence(record.id, record.name, record.realm)
                streams = self._videos.of(there)
                return [
                    view(camera, streams)
                    for camera in there.cameras
                    if rules.judge(Operation.VIEW, camera.name).allowed
                ]
        raise NotFound(NO_ROBOT)

    async def may_view(
        self, principal: Principal, robot: str, camera: str, transport: str, address: str
    ) -> None:
        """Whether the principal may view this camera now.

        :raises NotFound: no such robot, or no right on it or to view this
        """
        admission = await self.admit(principal, robot, address)
        try:
            check_view(admission.permit, camera, transport)
        finally:
            self.turn_away(admission)

    async def viewing(
        self,
        principal: Principal,
        robot: str,
        camera: str,
        settings: link.VideoSettings,
        screen: FrameSink,
        address: str,
        snapshot: bool = False,
    ) -> CameraViewer:
        """Have a camera shown, until :meth:`CameraViewer.leave` or until the screen is told that it has ended.

        :param snapshot: for one picture
        :raises NotFound: no such robot, or no right on it or to view this
        :raises Unavailable: too many watch, or the relay is going down
        """
        admission = await self.admit(principal, robot, address)
        return self.watch(replace(admission, snapshot=snapshot), camera, settings, screen)

    def watch(
        self, admission: AuthorizedSession, camera: str, settings: link.VideoSettings, screen: FrameSink
    ) -> CameraViewer:
        """The same for somebody who was admitted; whatever comes of it, the admission is used up."""
        watching = CameraViewer(
            admission.permit,
            admission.robot,
            camera,
            settings,
            screen,
            address=admission.address,
            over=self._left,
            snapshot=admission.snapshot,
        )
        try:
            if not self.accepting:
                raise ShuttingDown("the relay is going down; come again in a moment")
            watching.begin(self._videos)
        except SwitchboardError:
            self.turn_away(admission)
            raise
        self._watchings.add(watching)
        self._registry.looks_on(watching.robot, watching)
        self._tell_of_video("video.joined", watching, address=watching.address)
        return watching

    def _left(self, watching: CameraViewer) -> None:
        self._access.release(watching.permit)
        self._watchings.discard(watching)
        self._registry.looks_away(watching.robot, watching)
        self._tell_of_video("video.left", watching, pictures=watching.pictures)

    def _tell_of_video(self, kind: str, watching: CameraViewer, **data: Any) -> None:
        principal = watching.permit.principal
        self._journal.event(
            kind,
            f"user:{watching.name}",
            # Not that of the user's other events: snapshots may come one a second.
            cause=f"video:{principal.full}",
            robot_id=watching.robot.robot_id,
            user_id=principal.user_id,
            **watching.about,
            **data,
        )

    # --- what robots there are ----------------------------------------------------------------------------

    async def issue_ticket(self, principal: Principal, opens: TicketPurpose) -> str:
        """A ticket for one use of a robot.

        :raises NotFound: no such robot, or no right on it
        """
        for record, _ in await self._access.robots(principal):
            if record.name == opens.robot:
                return self._auth.issue_ticket(principal, opens)
        raise NotFound(NO_ROBOT)

    async def robots(self, principal: Principal) -> list[dict[str, Any]]:
        """What the principal may see of its robots."""
        return await self.overview.robots(principal)

    async def healthy(self) -> bool:
        """Whether the database answers."""
        try:
            await self._store.read(queries.revision)
        except SwitchboardError:
            return False
        return True

    def on_change(self, listener: Callable[[], None]) -> Callable[[], None]:
        """Call ``listener`` when something about robots may have changed; returns what ends that."""
        return self._registry.on_change(listener)

    def status(self) -> list[dict[str, Any]]:
        """Every robot the relay knows and who works with it, for the administrator's own machine."""
        return self.overview.status()

    def say_goodbye(self, reason: str) -> None:
        """Refuse newcomers and close what is open: the relay is going down."""
        self.accepting = False
        for session in self:
            session.close(close_codes.GOING_AWAY, reason)
        for watching in list(self._watchings):
            watching.end(ShuttingDown(reason))
