"""Requests of sessions to the robot that are answered once.

They wait for the channel to open, for a limited time.
"""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

from twisted.internet.defer import CancelledError, Deferred
from twisted.python.failure import Failure

from relay_protocol import limits
from relay_protocol.errors import SwitchboardError, Unavailable
from relay_server.channels.definitions import Definitions, Interfaces
from relay_server.channels.goals import ActionGoals, ClientGoal, GoalRequester
from relay_server.channels.link_state import RobotLinkState
from relay_server.channels.members import ClientMember, RequestContext
from relay_server.channels.service_calls import GRACE, ServiceCalls, call_seconds
from relay_server.channels.states import ChannelState
from relay_server.common.clock import Clock, as_twisted


class ChannelPings:
    """Pings the robot over the channel's own link; one ping answers all requests made meanwhile."""

    def __init__(self, link_state: RobotLinkState) -> None:
        self._link_state = link_state
        self._waiting: list[Deferred[float]] = []

    def ping(self) -> Deferred[float]:
        """Fires with the round-trip time in seconds; fails with :class:`Unavailable` without a link."""
        waiting: Deferred[float] = Deferred()
        if self._link_state.link is None:
            waiting.errback(Unavailable(f"robot {self._link_state.robot.name} is not connected"))
            return waiting
        self._waiting.append(waiting)
        if len(self._waiting) == 1:
            self._link_state.link.round_trip().addBoth(self._answered)
        return waiting

    def _answered(self, result: float | Failure) -> None:
        waiting, self._waiting = self._waiting, []
        for each in waiting:
            if not each.called:
                each.errback(result) if isinstance(result, Failure) else each.callback(result)


T = TypeVar("T")


class RequestGateway:
    """Sends calls, goals and queries of sessions to the robot.

    :param state: returns the state of the channel
    """

    def __init__(
        self,
        clock: Clock,
        link_state: RobotLinkState,
        state: Callable[[], ChannelState],
        calls: ServiceCalls,
        goals: ActionGoals,
        definitions: Definitions,
        interfaces: Interfaces,
    ) -> None:
        self._clock = clock
        self._robot = link_state.robot
        self._state = state
        self._calls = calls
        self._goals = goals
        self._definitions = definitions
        self._interfaces = interfaces
        self._pings = ChannelPings(link_state)
        self._waiting: list[Deferred[None]] = []

    async def call(
        self,
        service: str,
        type_name: str,
        args: bytes,
        timeout: float | None,
        context: RequestContext,
    ) -> bytes:
        """Call a service on the robot; see :meth:`ServiceCalls.call`.

        :param timeout: seconds; ``None``: the usual timeout
        :raises Unavailable: as there, or the robot is offline
        """
        seconds = call_seconds(timeout)

        async def work() -> bytes:
            await self._open()
            await context.wait_for_control()
            return await self._calls.call(service, type_name, args, seconds, context)

        # One second more than the call itself has, as its own error is more precise.
        return await self.within(seconds + 2 * GRACE, work())

    def send_goal(
        self,
        member: ClientMember,
        requester: GoalRequester,
        action: str,
        type_name: str,
        args: bytes,
        context: RequestContext,
        *,
        feedback: bool,
    ) -> ClientGoal:
        """Have a goal executed; see :meth:`ActionGoals.begin`. The requester gets feedback, and the end in any case.

        :param feedback: whether to send feedback
        """
        goal = self._goals.create(member, requester, action, feedback)

        async def work() -> None:
            await self._open()
            await context.wait_for_control()
            await self._goals.begin(goal, type_name, args, context)

        goal.starting = Deferred.fromCoroutine(self.within(limits.CALL_SECONDS, work()))
        goal.starting.addErrback(self._goals.start_failed, goal)
        return goal

    async def round_trip(self) -> float:
        """Round-trip time to the robot over the channel's own link, seconds.

        :raises Unavailable: the robot is offline, or the link is lost before it answers
        """

        async def work() -> float:
            await self._open()
            return await self._pings.ping()

        return await self.within(limits.CALL_SECONDS, work())

    async def definition(self, type_name: str, text: bool = False) -> None:
        """Wait until the robot's definition of a type is known.

        :param text: wait for the robot's text of this very type; else a text that contains it is enough
        :raises NotFound: the robot does not have it
        :raises Invalid: the robot's definition is unusable
        :raises Unavailable: the robot is offline
        """

        async def work() -> None:
            await self._open()
            await self._definitions.ready(type_name, text)

        await self.within(limits.CALL_SECONDS, work())

    async def until_open(self) -> None:
        """Wait until the channel is open.

        :raises Unavailable: the robot is offline
        """
        await self.within(limits.CALL_SECONDS, self._open())

    async def interfaces(self) -> list[str]:
        """The full names of all types of which the robot has the definition.

        :raises Unavailable: the robot is offline, or does not list them
        """

        async def work() -> list[str]:
            await self._open()
            return await self._interfaces.names()

        return await self.within(limits.CALL_SECONDS, work())

    async def within(self, seconds: float, work: Coroutine[Deferred[Any], Any, T]) -> T:
        """Await an answer of the robot for a limited time.

        :raises Unavailable: it has not answered in time
        """
        running = Deferred.fromCoroutine(work)
        late = Unavailable(f"robot {self._robot.name} did not answer within {seconds:g} s")

        def too_late(result: Any, timeout: float) -> Any:
            if isinstance(result, Failure):
                result.trap(CancelledError)
                raise late
            return result

        running.addTimeout(seconds, as_twisted(self._clock), too_late)
        return await running

    async def _open(self) -> None:
        """:raises Unavailable: the robot is offline"""
        state = self._state()
        if state is ChannelState.WAITING:
            raise Unavailable(f"robot {self._robot.name} is offline")
        if state is ChannelState.OPENING:
            waiting: Deferred[None] = Deferred()
            self._waiting.append(waiting)
            await waiting

    # --- the channel --------------------------------------------------------------------------------------

    def opened(self) -> None:
        """The channel is open: continue the requests that wait for it."""
        waiting, self._waiting = self._waiting, []
        for each in waiting:
            each.callback(None)

    def not_opened(self, error: SwitchboardError) -> None:
        """The channel does not open: the requests that wait for it fail."""
        waiting, self._waiting = self._waiting, []
        for each in waiting:
            each.errback(error)
