"""A robot's resources for HTTP and Roles.

Each request uses a session in this process, so its caller needs the same rights as by a websocket.
"""

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
from relay_server.access import may_subscribe
from relay_server.channels.names import resolve
from relay_server.common.clock import Clock
from relay_server.common.concurrency import FairLock, shield, with_timeout
from relay_server.common.database import BoundedThreadPool
from relay_server.common.errors import NotDone, NothingReceived
from relay_server.common.etags import PreconditionFailed, check_match
from relay_server.common.freshness_tokens import HEADER, NEEDED, FreshnessTokenExpired, FreshnessTokenRequired
from relay_server.in_process_sessions.one_shot_publisher import OneShotPublisher, may_move, type_of
from relay_server.in_process_sessions.pool import InProcessSessionPool, PooledSession, RobotCaller
from relay_server.relay_node.interfaces import RELAY, ROSAPI
from relay_server.relay_node.visible_graph import visible_graph
from relay_server.resources import params
from relay_server.resources.page import TypedPageQuery
from relay_server.resources.states import ParamState, TopicContext, TopicState, topic_context
from relay_server.resources.topic_stream import TopicStream
from relay_server.robots.registry import RobotState
from relay_server.sessions.context import ClientContext
from relay_server.sessions.service_calls import RESUME
from relay_server.sessions.session_quota import SessionQuota

T = TypeVar("T")

READY_SECONDS = 5.0
"""Seconds that a robot has to begin publishing a topic."""

KINDS = ("topics", "services", "actions")
"""Collections that are in the robot's graph."""


class MessageConditions(NamedTuple):
    """Which message of a topic is an answer.

    :param wait: seconds to wait for a message
    :param max_age: largest age in seconds since the relay received it; ``None`` for any
    :param unlike: entity tags of the states that the client has
    :param next: wait for a message that comes from now on; when none came in time, the newest one
    """

    wait: float = 2.0
    max_age: float | None = None
    unlike: frozenset[str] = frozenset()
    next: bool = False


class RobotResourceService:
    """Topics, services, actions and parameters of robots.

    :param threads: convert to and from RDF, one document at a time
    :param clock_ns: the relay's monotonic nanoseconds
    :param wall: Unix time in seconds
    """

    def __init__(
        self,
        clock: Clock,
        pool: InProcessSessionPool,
        threads: BoundedThreadPool,
        clock_ns: Callable[[], int],
        wall: Callable[[], float],
    ) -> None:
        self._clock = clock
        self._pool = pool
        self._threads = threads
        self._clock_ns = clock_ns
        self._wall = wall
        self._fair_lock = FairLock()
        self._changing: WeakValueDictionary[tuple[int, str], DeferredLock] = WeakValueDictionary()

    async def members(self, caller: RobotCaller, kind: str, listing: TypedPageQuery) -> dict[str, Any]:
        """A page of one of :data:`KINDS`.

        :raises NotFound: no such robot, or no right on it
        """
        async with self._pool.at(caller) as pooled:
            robot = pooled.client.robot
            members = getattr(visible_graph(pooled.client), kind)
            page, after = listing.page(members, lambda each: each.types)
            return {
                kind: [_listed(robot, kind, name, each) for name, each in page],
                "next": after,
                "online": robot.control_link is not None,
            }

    async def member(self, caller: RobotCaller, kind: str, name: str) -> dict[str, Any]:
        """One member of one of :data:`KINDS`, as in its page.

        :raises NotFound: no such robot or member, or no right on it
        :raises Unavailable: the robot is offline
        """
        async with self._pool.at(caller) as pooled:
            resource = resolve(name)
            visible = visible_graph(pooled.client)
            found = visible.topic(resource) if kind == "topics" else getattr(visible, kind).get(resource)
            if found is None:
                raise _not_found(pooled.client, kind, resource)
            return _listed(pooled.client.robot, kind, resource, found)

    async def check_may_know(self, caller: RobotCaller) -> None:
        """Check that the caller has a right on a robot.

        :raises NotFound: no such robot, or no right on it
        """
        async with self._pool.admitted(caller):
            pass

    async def newest_message(self, caller: RobotCaller, name: str, wanted: MessageConditions) -> TopicState:
        """The newest message of a topic: the one that the client has if no other came in time.

        :raises NotFound: no such robot or topic, or no right on it
        :raises Refused: the client may not subscribe to the topic
        :raises Unavailable: the robot is offline
        :raises NothingReceived: no message was received in time
        """
        async with self._pool.at(caller) as pooled:
            topic = resolve(name)
            type_name = visible_type(pooled.client, topic)
            # Checks the right to subscribe, also of those whom an earlier request has subscribed.
            latest = pooled.subscribe(topic, type_name)
            until = self._clock.seconds() + wanted.wait
            known: TopicState | None = None
            number = 0
            if wanted.next:
                number = await latest.wait_for_next(wanted.wait)
                until = self._clock.seconds()
            while True:
                now = self._clock.seconds()
                message = await latest.after(number, max(0.0, until - now))
                pooled.port.check(topic)
                if message is None:
                    break
                number = message.number
                now = self._clock.seconds()
                if wanted.max_age is not None and now - message.at > wanted.max_age:
                    continue
                state = TopicState(topic, type_name, self._wall() - (now - message.at), message.body)
                if state.etag not in wanted.unlike:
                    return state
                known = state
                if wanted.wait <= 0:
                    break
            if known is not None:
                return known
            # Raises if the right to subscribe was revoked meanwhile.
            pooled.subscribe(topic, type_name)
            raise NothingReceived(f"no message on {topic} was received within {wanted.wait:g} s")

    async def topic_context(self, caller: RobotCaller, state: TopicState) -> TopicContext:
        """Facts about a topic that its representation in RDF needs."""
        async with self._pool.at(caller) as pooled:
            return await topic_context(pooled.client, state.topic, state.type)

    async def convert(self, caller: RobotCaller, work: Callable[[], T]) -> T:
        """Do something in a thread, and charge it to the CPU quota of the caller.

        :raises Refused: the quota is used up, now or when the work would begin
        :raises Unavailable: too much work waits, of this user or of all; or the relay shuts down
        """
        async with self._pool.at(caller) as pooled:
            quota = pooled.client.quota
            quota.check()
            making = Deferred.fromCoroutine(self._counted(caller.principal.user_id, quota, work))
            # The work runs to its end, so it is charged even if the client disconnects.
            waiting = shield(making)
            making.addErrback(_ignore_refusal)
            return await waiting

    async def _counted(self, user: int, quota: SessionQuota, work: Callable[[], T]) -> T:
        spent = 0.0

        def timed() -> T:
            nonlocal spent
            began = time.thread_time()
            try:
                return work()
            finally:
                spent = time.thread_time() - began

        async with self._fair_lock.hold(user):
            # Checked again: other work may have used the quota up meanwhile.
            quota.check()
            try:
                return await self._threads.run(timed)
            finally:
                quota.count_elsewhere(spent)

    @asynccontextmanager
    async def follow(
        self,
        caller: RobotCaller,
        name: str,
        throttle_ms: float,
        send: Callable[[bytes], None],
        send_status: Callable[[str, str], None],
        *,
        whole: bool = False,
    ) -> AsyncIterator[TopicStream]:
        """Pass every message of a topic to ``send`` while the block runs.

        :param throttle_ms: least time between two messages; the newest counts
        :param send_status: takes level and text of a status: why messages are missing
        :param whole: pass each as in :meth:`relay_server.resources.states.TopicState.json`
        :raises SwitchboardError: as :meth:`newest_message`
        """
        async with self._pool.unshared(caller) as port:
            topic = resolve(name)
            type_name, stream = visible_type(port.client, topic), TopicStream(port, topic)

            def send_whole(body: bytes) -> None:
                send(TopicState(topic, type_name, self._wall(), body).json())

            stream.begin(type_name, throttle_ms, send_whole if whole else send, send_status)
            yield stream

    async def publish(
        self, caller: RobotCaller, name: str, body: msgspec.Raw, type_name: str, earliest_sent: int | None
    ) -> str:
        """Publish a message.

        :param body: JSON of the message
        :param type_name: of the topic; empty for its known type
        :param earliest_sent: earliest time of the request, the relay's monotonic nanoseconds
        :returns: a warning that messages of this client to the topic were dropped; empty: none since the last one
        :raises FreshnessTokenRequired: it moves the robot, and the request has no freshness token
        :raises FreshnessTokenExpired: it moves the robot, and the request may be too old
        :raises SwitchboardError: it is refused, or not possible
        """
        async with self._pool.at(caller) as pooled:
            topic, client = resolve(name), pooled.client
            client.require(Operation.PUBLISH, topic)
            publisher = OneShotPublisher(self._clock, pooled.port, topic)
            if client.robot.control_link is None:
                # This refuses the message, and notes that the client must release the controls when the robot is back.
                publisher.publish_now(body, earliest_sent)
            named = type_of(client, topic, type_name)
            if not may_move(client, topic, named):
                published = publisher.publish(body, named)
                late = f"the robot did not begin to publish {topic} within {READY_SECONDS:g} s; try again"
                await with_timeout(self._clock, READY_SECONDS, published, late)
                return publisher.take_warning()
            try:
                checked = self.check_freshness(pooled, earliest_sent)
            except Refused:
                # It still counts as a rejected command.
                with suppress(SwitchboardError):
                    publisher.advertise(named)
                    publisher.publish_now(body, earliest_sent)
                raise
            left = client.robot.description.motion.deadline_ms / 1000 - (self._clock_ns() - checked) / 1e9
            await publisher.publish_command(body, named, checked, left)
            return publisher.take_warning()

    async def call(
        self,
        caller: RobotCaller,
        name: str,
        args: msgspec.Raw,
        type_name: str,
        seconds: float,
        earliest_sent: int | None,
    ) -> bytes:
        """Call a service; the JSON of its answer.

        :param args: JSON
        :param seconds: timeout
        :raises FreshnessTokenRequired: it moves or resumes the robot, and the request has no freshness token
        :raises NotDone: the service did not answer, or failed with a reason
        :raises SwitchboardError: as :meth:`publish`
        """
        async with self._pool.at(caller) as pooled:
            service = resolve(name)
            if not type_name and service not in visible_graph(pooled.client).services:
                raise _not_found(pooled.client, "services", service)
            if service == RESUME and earliest_sent is None:
                raise FreshnessTokenRequired(f"this resumes the robot: {NEEDED}")
            if pooled.client.robot.description.motion.moves_by_service(service):
                self.check_freshness(pooled, earliest_sent)
            answer = await pooled.port.call(service, args, type_name, seconds, earliest_sent)
            if not answer.result:
                raise NotDone(str(answer.read))
            return bytes(answer.values)

    async def may(self, caller: RobotCaller, operation: Operation, name: str) -> None:
        """Check that something may be done now, without doing it.

        :raises NotFound: no such robot, or no right on it
        :raises Refused: it may not
        """
        resource = resolve(name)
        async with self._pool.admitted(caller) as (permit, _):
            decision = permit.decide(operation, resource)
        # Any right on the robot is enough for the relay's own services.
        own = operation is Operation.CALL and resource.startswith((f"{RELAY}/", f"{ROSAPI}/"))
        if not (decision.allowed or own):
            raise Refused(decision.reason)

    async def check_may_subscribe(self, caller: RobotCaller, name: str) -> None:
        """Check that the caller may subscribe to a topic, without doing it.

        :raises NotFound: no such robot, or no right on it
        :raises Refused: it may not
        """
        topic = resolve(name)
        async with self._pool.admitted(caller) as (permit, robot):
            decision = may_subscribe(permit.decide, robot, topic)
        if not decision.allowed:
            raise Refused(decision.reason)

    # --- parameters ---------------------------------------------------------------------------------------

    async def params(self, caller: RobotCaller, listing: TypedPageQuery) -> dict[str, Any]:
        """A page of the names of parameters.

        :raises SwitchboardError: as :meth:`newest_message`
        """
        async with self._pool.at(caller) as pooled:
            members = dict.fromkeys(await params.names(pooled), "")
            page, after = listing.page(members, lambda each: [each])
            return {"params": [{"name": name} for name, _ in page], "next": after}

    async def param(self, caller: RobotCaller, name: str) -> ParamState:
        """A parameter.

        :param name: ``<node>:<parameter>``
        :raises NotFound: there is none
        """
        async with self._pool.at(caller) as pooled:
            return ParamState(name, await params.value(pooled, name))

    async def set_param(self, caller: RobotCaller, name: str, json: bytes, match: str | None) -> None:
        """Set a parameter.

        :param match: only if it still has this value: entity tags, as in ``If-Match``
        :raises PreconditionFailed: it has another value
        :raises NotDone: its node refuses, with the reason
        """
        async with self._pool.at(caller) as pooled, self._change_lock(pooled, name):
            await self._check_precondition(pooled, name, match)
            await params.set_value(pooled, name, json)

    async def remove_param(self, caller: RobotCaller, name: str, match: str | None) -> None:
        """Delete a parameter; see :meth:`set_param`."""
        async with self._pool.at(caller) as pooled, self._change_lock(pooled, name):
            await self._check_precondition(pooled, name, match)
            await params.remove(pooled, name)

    def _change_lock(self, pooled: PooledSession, name: str) -> DeferredLock:
        """Lock a parameter against other HTTP requests, so that a checked precondition still holds.

        Nodes, and clients of ``/rosapi/set_param``, can still change it.
        """
        key = pooled.client.robot.robot_id, name.lstrip("/")
        return self._changing.setdefault(key, DeferredLock())

    @staticmethod
    async def _check_precondition(pooled: PooledSession, name: str, match: str | None) -> None:
        if match is None:
            return
        try:
            found = ParamState(name, await params.value(pooled, name))
        except NotFound as error:
            raise PreconditionFailed(str(error)) from None
        check_match(found.etag, match)

    def check_freshness(self, pooled: PooledSession, earliest_sent: int | None) -> int:
        """Check the age of a request that moves the robot; returns the earliest time at which it can have been sent.

        :param earliest_sent: the relay's monotonic nanoseconds, by the freshness token
        :raises FreshnessTokenRequired: the request has no freshness token
        :raises FreshnessTokenExpired: the request may be too old
        """
        if earliest_sent is None:
            raise FreshnessTokenRequired(f"this moves the robot: {NEEDED}")
        age_ms = (self._clock_ns() - earliest_sent) / 1e6
        deadline_ms = pooled.client.robot.description.motion.deadline_ms
        if age_ms > deadline_ms:
            raise FreshnessTokenExpired(
                f"this may have been sent {age_ms:.0f} ms ago; the robot accepts nothing older than {deadline_ms} ms. "
                f"Send it again with the '{HEADER}' of this answer"
            )
        return earliest_sent


def _listed(robot: RobotState, kind: str, name: str, member: Topic | Service) -> dict[str, Any]:
    """A member as it is listed."""
    motion = robot.description.motion
    moves = {
        "topics": lambda: any(robot.is_motion(name, each) for each in member.types),
        "services": lambda: motion.moves_by_service(name),
        "actions": lambda: motion.moves_by_action(name),
    }
    return {"name": name, **msgspec.to_builtins(member), "moves": moves[kind]()}


def _not_found(client: ClientContext, kind: str, name: str) -> NotFound:
    """The error for a resource that does not exist, or is hidden from the client.

    :raises Unavailable: the robot is offline
    """
    require_online(client)
    noun = kind.removesuffix("s")
    return NotFound(f"there is no {noun} {name} on robot {client.robot.name}, or you have no right on it")


def _ignore_refusal(failure: Failure) -> None:
    """Ignore errors of work whose client has disconnected: the relay did not fail."""
    failure.trap(SwitchboardError, CancelledError)


def visible_type(client: ClientContext, topic: str) -> str:
    """The type of a topic that the client may subscribe or publish to.

    :raises NotFound: there is none, or the client has neither right on it
    :raises Unavailable: the robot is offline
    """
    known = visible_graph(client).topic(topic)
    if known is not None and known.types:
        return known.types[0]
    raise _not_found(client, "topics", topic)


def require_online(client: ClientContext) -> None:
    """:raises Unavailable: the robot is offline"""
    if client.robot.control_link is None:
        raise Unavailable(f"robot {client.robot.name} is offline")
