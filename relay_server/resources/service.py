"""What HTTP asks about a robot's resources, done by a connection that is judged as any client's is."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from typing import Any, NamedTuple, TypeVar
from weakref import WeakValueDictionary

import msgspec
from twisted.internet.defer import CancelledError, Deferred, DeferredLock
from twisted.python.failure import Failure

from relay_protocol.errors import NotFound, Refused, SwitchboardError, Unavailable
from relay_protocol.link import Service, Topic
from relay_protocol.rights import Operation
from relay_server.access import Principal
from relay_server.channels.robot_link import resolve
from relay_server.common.clock import Clock, shield, with_timeout
from relay_server.common.database import BoundedThreadPool
from relay_server.common.fair_lock import FairLock
from relay_server.common.freshness_tokens import NEEDED, FreshnessTokenExpired, FreshnessTokenRequired
from relay_server.control.commands import NotDone
from relay_server.http_sessions.one_shot_publisher import OneShotPublisher, may_move, type_of
from relay_server.http_sessions.pool import PooledSession, SessionPool
from relay_server.relay_node.interfaces import RELAY, ROSAPI
from relay_server.relay_node.view import view
from relay_server.resources import params
from relay_server.resources.etags import ParamState, PreconditionFailed, TopicState, see_match
from relay_server.resources.page import PageQuery
from relay_server.resources.topic_context import TopicContext, topic_context
from relay_server.resources.topic_stream import TopicStream
from relay_server.robots.registry import RobotState
from relay_server.sessions.service_calls import RESUME, moves_by
from relay_server.sessions.session import Session
from relay_server.sessions.session_quota import SessionQuota
from relay_server.video.ports import NoFrame

T = TypeVar("T")

READY_SECONDS = 5.0
"""A robot has so long to begin publishing a topic."""

KINDS = ("topics", "services", "actions")
"""Collections that are in the robot's graph."""


class RequestOrigin(NamedTuple):
    """Who asks, of which robot, from where."""

    principal: Principal
    robot: str
    address: str


class TopicQuery(NamedTuple):
    """Which state of a topic is wanted.

    :param wait: seconds for which it may be waited
    :param max_age: seconds since the relay got it, at most; ``None`` for however long
    :param unlike: entity tags of those that are known already
    """

    wait: float = 2.0
    max_age: float | None = None
    unlike: frozenset[str] = frozenset()


class RobotResourceService:
    """See the module's text.

    :param threads: do what takes long, one piece at a time
    :param clock_ns: the relay's monotonic nanoseconds
    :param wall: Unix time in seconds
    """

    def __init__(
        self,
        clock: Clock,
        guests: SessionPool,
        threads: BoundedThreadPool,
        clock_ns: Callable[[], int],
        wall: Callable[[], float],
    ) -> None:
        self._clock = clock
        self._guests = guests
        self._threads = threads
        self._clock_ns = clock_ns
        self._wall = wall
        self._turns = FairLock()
        self._changing: WeakValueDictionary[tuple[int, str], DeferredLock] = WeakValueDictionary()

    async def members(self, asker: RequestOrigin, kind: str, listing: PageQuery) -> dict[str, Any]:
        """A page of one of :data:`KINDS`.

        :raises NotFound: no such robot, or no right on it
        """
        async with self._guests.at(*asker) as guest:
            robot = guest.session.robot
            members = getattr(view(guest.session), kind)
            page, after = listing.page(members, lambda each: each.types)
            return {
                kind: [_told(robot, kind, name, each) for name, each in page],
                "next": after,
                "online": robot.control is not None,
            }

    async def member(self, asker: RequestOrigin, kind: str, name: str) -> dict[str, Any]:
        """One member of one of :data:`KINDS`, as the page with it tells of it.

        :raises NotFound: no such robot or member, or no right on it
        :raises Unavailable: the robot is offline, so that nobody knows
        """
        async with self._guests.at(*asker) as guest:
            resource = resolve(name)
            seen = view(guest.session)
            found = seen.topic(resource) if kind == "topics" else getattr(seen, kind).get(resource)
            if found is None:
                raise _nothing(guest.session, kind, resource)
            return _told(guest.session.robot, kind, resource, found)

    async def see(self, asker: RequestOrigin) -> None:
        """See that somebody has a right on a robot.

        :raises NotFound: no such robot, or no right on it
        """
        async with self._guests.permit(*asker):
            pass

    async def state(self, asker: RequestOrigin, name: str, wanted: TopicQuery) -> tuple[TopicState, bool]:
        """The newest state of a topic, and whether it is known already, since there is none but those that are.

        :raises NotFound: no such robot or topic, or no right on it
        :raises Refused: the topic may not be heard
        :raises Unavailable: the robot is offline
        :raises NothingCame: nobody has said anything there in time
        """
        async with self._guests.at(*asker) as guest:
            topic = resolve(name)
            type_name = known_type(guest.session, topic)
            feed = guest.feed(topic, type_name)
            until = self._clock.seconds() + wanted.wait
            known: TopicState | None = None
            number = 0
            while True:
                now = self._clock.seconds()
                heard = await feed.after(number, max(0.0, until - now))
                guest.client.check(topic)
                if heard is None:
                    break
                number = heard.number
                now = self._clock.seconds()
                if wanted.max_age is not None and now - heard.at > wanted.max_age:
                    continue
                state = TopicState(topic, type_name, self._wall() - (now - heard.at), heard.body)
                if state.etag not in wanted.unlike:
                    return state, False
                known = state
                if wanted.wait <= 0:
                    break
            if known is not None:
                return known, True
            # The right to hear it may have been withdrawn meanwhile.
            guest.feed(topic, type_name)
            raise NoFrame(f"nobody has said anything on {topic} within {wanted.wait:g} s")

    async def background(self, asker: RequestOrigin, state: TopicState) -> TopicContext:
        """What is to be known of a topic beside its state."""
        async with self._guests.at(*asker) as guest:
            return await topic_context(guest.session, state.topic, state.type)

    async def made(self, asker: RequestOrigin, work: Callable[[], T]) -> T:
        """Do something in a thread, on the account of who asks for it.

        :raises Refused: he has used up his share of the processor, now or when it would be his turn
        :raises Unavailable: too much waits already, of his or of all; or the relay goes down
        """
        async with self._guests.at(*asker) as guest:
            share = guest.session.share
            share.check()
            making = Deferred.fromCoroutine(self._counted(asker.principal.user_id, share, work))
            # To the end, so that it is counted for who leaves before.
            waiting = shield(making)
            making.addErrback(_nobody_waits)
            return await waiting

    async def _counted(self, user: int, share: SessionQuota, work: Callable[[], T]) -> T:
        spent = 0.0

        def timed() -> T:
            nonlocal spent
            began = time.thread_time()
            try:
                return work()
            finally:
                spent = time.thread_time() - began

        async with self._turns.turn(user):
            # Again: what was made meanwhile may have used it up.
            share.check()
            try:
                return await self._threads.run(timed)
            finally:
                share.took(spent)

    @asynccontextmanager
    async def follow(
        self, asker: RequestOrigin, name: str, throttle_ms: float, tell: Callable[[bytes], None]
    ) -> AsyncIterator[TopicStream]:
        """Have every message of a topic told, as long as the block lasts.

        :param throttle_ms: least time between two; the newest counts
        :raises SwitchboardError: as :meth:`state`
        """
        async with self._guests.visit(*asker) as (session, client):
            topic = resolve(name)
            following = TopicStream(session, client, topic)
            following.begin(known_type(session, topic), throttle_ms, tell)
            yield following

    async def publish(
        self, asker: RequestOrigin, name: str, body: msgspec.Raw, type_name: str, moment: int | None
    ) -> None:
        """Say something on a topic.

        :param body: JSON of the message
        :param type_name: of the topic; empty for the one it has
        :param moment: the relay's monotonic nanoseconds before which it can't have been asked for
        :raises MomentNeeded: it moves the robot, and no moment is named
        :raises TooOld: it moves the robot, and may be too old
        :raises SwitchboardError: it is refused, or can't be done
        """
        async with self._guests.at(*asker) as guest:
            topic, session = resolve(name), guest.session
            session.judge(Operation.PUBLISH, topic)
            speaker = OneShotPublisher(self._clock, guest.client, session, topic)
            if session.robot.control is None:
                # Which refuses it. Who commands a robot that is away has to let go when it is back.
                speaker.say_now(body, moment)
            named = type_of(session, topic, type_name)
            if not may_move(session, topic, named):
                saying, late = speaker.say(body, named), f"the robot does not publish {topic} in time"
                await with_timeout(self._clock, READY_SECONDS, saying, late)
                return
            try:
                since = self.dated(guest, moment)
            except Refused:
                # It counts as a command in vain all the same.
                with suppress(SwitchboardError):
                    speaker.advertise(named)
                    speaker.say_now(body, moment)
                raise
            left = session.robot.description.motion.deadline_ms / 1000 - (self._clock_ns() - since) / 1e9
            await speaker.command(body, named, since, left)

    async def call(
        self,
        asker: RequestOrigin,
        name: str,
        args: msgspec.Raw,
        type_name: str,
        seconds: float,
        moment: int | None,
    ) -> bytes:
        """Call a service; JSON of what it answers.

        :param args: JSON
        :param seconds: it may take
        :raises MomentNeeded: it moves the robot or lets it move again, and no moment is named
        :raises NotDone: it has not answered, or says why not
        :raises SwitchboardError: as :meth:`publish`
        """
        async with self._guests.at(*asker) as guest:
            service = resolve(name)
            if not type_name and service not in view(guest.session).services:
                raise _nothing(guest.session, "services", service)
            if service == RESUME and moment is None:
                raise FreshnessTokenRequired(f"this lets the robot move again: {NEEDED}")
            if moves_by(guest.session.robot.description.motion, service):
                self.dated(guest, moment)
            answer = await guest.client.call(service, args, type_name, seconds, moment)
            if not answer.result:
                raise NotDone(str(answer.read))
            return bytes(answer.values)

    async def may(self, asker: RequestOrigin, operation: Operation, name: str) -> None:
        """See that something may be done now, without doing it.

        :raises NotFound: no such robot, or no right on it
        :raises Refused: it may not
        """
        resource = resolve(name)
        async with self._guests.permit(*asker) as permit:
            verdict = permit.judge(operation, resource)
        # The relay's own services are open to all who have a right on the robot.
        own = operation is Operation.CALL and resource.startswith((f"{RELAY}/", f"{ROSAPI}/"))
        if not (verdict.allowed or own):
            raise Refused(verdict.reason)

    # --- parameters ---------------------------------------------------------------------------------------

    async def params(self, asker: RequestOrigin, listing: PageQuery) -> dict[str, Any]:
        """A page of the names of parameters.

        :raises SwitchboardError: as :meth:`state`
        """
        async with self._guests.at(*asker) as guest:
            members = dict.fromkeys(await params.names(guest), "")
            page, after = listing.page(members, lambda each: [each])
            return {"params": [{"name": name} for name, _ in page], "next": after}

    async def param(self, asker: RequestOrigin, name: str) -> ParamState:
        """A parameter.

        :param name: ``<node>:<parameter>``
        :raises NotFound: there is none
        """
        async with self._guests.at(*asker) as guest:
            return ParamState(name, await params.value(guest, name))

    async def set_param(self, asker: RequestOrigin, name: str, json: bytes, match: str | None) -> None:
        """Set a parameter.

        :param match: only if it still has this value: entity tags, as in ``If-Match``
        :raises NotAsBefore: it has another
        :raises NotDone: its node says why not
        """
        async with self._guests.at(*asker) as guest, self._alone_with(guest, name):
            await self._see_same(guest, name, match)
            await params.set_value(guest, name, json)

    async def remove_param(self, asker: RequestOrigin, name: str, match: str | None) -> None:
        """Delete a parameter; see :meth:`set_param`."""
        async with self._guests.at(*asker) as guest, self._alone_with(guest, name):
            await self._see_same(guest, name, match)
            await params.remove(guest, name)

    def _alone_with(self, guest: PooledSession, name: str) -> DeferredLock:
        """While it is held nobody else changes that parameter by HTTP: what was seen of it still holds.

        Nodes, and clients of ``/rosapi/set_param``, are not kept from it.
        """
        key = guest.session.robot.robot_id, name.lstrip("/")
        return self._changing.setdefault(key, DeferredLock())

    @staticmethod
    async def _see_same(guest: PooledSession, name: str, match: str | None) -> None:
        if match is None:
            return
        try:
            found = ParamState(name, await params.value(guest, name))
        except NotFound as error:
            raise PreconditionFailed(str(error)) from None
        see_match(found.etag, match)

    def dated(self, guest: PooledSession, moment: int | None) -> int:
        """When something that moves the robot can have been asked for at the earliest.

        :param moment: the relay's monotonic nanoseconds, as the asker names it
        :raises MomentNeeded: he does not
        :raises TooOld: that is too long ago
        """
        if moment is None:
            raise FreshnessTokenRequired(f"this moves the robot: {NEEDED}")
        age_ms = (self._clock_ns() - moment) / 1e6
        deadline_ms = guest.session.robot.description.motion.deadline_ms
        if age_ms > deadline_ms:
            raise FreshnessTokenExpired(
                f"this may have been sent {age_ms:.0f} ms ago; the robot takes nothing older than {deadline_ms} ms. "
                "Give back the 'switchboard-moment' of this answer"
            )
        return moment


def _told(robot: RobotState, kind: str, name: str, member: Topic | Service) -> dict[str, Any]:
    """A member as it is listed."""
    motion = robot.description.motion
    moves = {
        "topics": lambda: any(robot.is_motion(name, each) for each in member.types),
        "services": lambda: motion.moves_by_service(name),
        "actions": lambda: motion.moves_by_action(name),
    }
    return {"name": name, **msgspec.to_builtins(member), "moves": moves[kind]()}


def _nothing(session: Session, kind: str, name: str) -> NotFound:
    """What is said of what there is not, or not for who asks.

    :raises Unavailable: the robot is offline
    """
    see_online(session)
    what = kind.removesuffix("s")
    return NotFound(f"there is no {what} {name} on robot {session.robot.name}, or you have no right on it")


def _nobody_waits(failure: Failure) -> None:
    """Why something was not made, when who asked has left: that is no failure of the relay."""
    failure.trap(SwitchboardError, CancelledError)


def known_type(session: Session, topic: str) -> str:
    """The type of a topic that the asker may know of.

    :raises NotFound: there is none
    :raises Unavailable: the robot is offline
    """
    known = view(session).topic(topic)
    if known is not None and known.types:
        return known.types[0]
    raise _nothing(session, "topics", topic)


def see_online(session: Session) -> None:
    """:raises Unavailable: the robot is offline"""
    if session.robot.control is None:
        raise Unavailable(f"robot {session.robot.name} is offline")
