"""What is asked of the robot once, and answered once: it waits for the channel to open, but not for ever."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

from twisted.internet.defer import CancelledError, Deferred
from twisted.python.failure import Failure

from relay_protocol import limits
from relay_protocol.errors import SwitchboardError, Unavailable
from relay_server.channels.definitions import Definitions, Interfaces
from relay_server.channels.goals import ActionGoals, ClientGoal, GoalRequester
from relay_server.channels.robot_link import Publisher, RequestContext, RobotLinkState
from relay_server.channels.rtt_probe import ChannelPings
from relay_server.channels.service_calls import GRACE, ServiceCalls, call_seconds
from relay_server.channels.states import ChannelState
from relay_server.common.clock import Clock, as_twisted

T = TypeVar("T")


class RequestGateway:
    """Calls, goals and questions of members.

    :param state: the channel's, now
    """

    def __init__(
        self,
        clock: Clock,
        wire: RobotLinkState,
        state: Callable[[], ChannelState],
        calls: ServiceCalls,
        goals: ActionGoals,
        definitions: Definitions,
        interfaces: Interfaces,
    ) -> None:
        self._clock = clock
        self._robot = wire.robot
        self._state = state
        self._calls = calls
        self._goals = goals
        self._definitions = definitions
        self._interfaces = interfaces
        self._round_trips = ChannelPings(wire)
        self._waiting: list[Deferred[None]] = []

    async def call(
        self,
        service: str,
        type_name: str,
        args: bytes,
        timeout: float | None,
        sent: RequestContext,
    ) -> bytes:
        """Call a service on the robot; see :meth:`ServiceCalls.call`.

        :param timeout: seconds, or what is usual
        :raises Unavailable: besides the cases there, the robot is offline
        """
        seconds = call_seconds(timeout)

        async def work() -> bytes:
            await self._open()
            await sent.controls()
            return await self._calls.call(service, type_name, args, seconds, sent)

        # One second more than the call itself has: its own words are the better ones.
        return await self.within(seconds + 2 * GRACE, work())

    def pursue(
        self,
        member: Publisher,
        asker: GoalRequester,
        action: str,
        type_name: str,
        args: bytes,
        sent: RequestContext,
        *,
        feedback: bool,
    ) -> ClientGoal:
        """Have a goal pursued; see :meth:`ActionGoals.begin`. All that comes of it is told to ``asker``, failures too.

        :param feedback: whether that is wanted
        """
        goal = self._goals.want(member, asker, action, feedback)

        async def work() -> None:
            await self._open()
            await sent.controls()
            await self._goals.begin(goal, type_name, args, sent)

        goal.beginning = Deferred.fromCoroutine(self.within(limits.CALL_SECONDS, work()))
        goal.beginning.addErrback(self._goals.not_begun, goal)
        return goal

    async def round_trip(self) -> float:
        """Seconds for a ping to the robot over the channel's own link.

        :raises Unavailable: the robot is offline or lost before it answers
        """

        async def work() -> float:
            await self._open()
            return await self._round_trips.ask()

        return await self.within(limits.CALL_SECONDS, work())

    async def definition(self, type_name: str, text: bool = False) -> None:
        """Wait until the robot's definition of a type is known.

        :param text: wait for the robot's text of just this type; else one that contains it will do
        :raises NotFound: the robot does not have it
        :raises Invalid: the robot's definition is unusable
        :raises Unavailable: the robot is offline
        """

        async def work() -> None:
            await self._open()
            await self._definitions.ready(type_name, text)

        await self.within(limits.CALL_SECONDS, work())

    async def interfaces(self) -> list[str]:
        """The full names of all types the robot can tell the definition of.

        :raises Unavailable: the robot is offline, or does not tell them
        """

        async def work() -> list[str]:
            await self._open()
            return await self._interfaces.names()

        return await self.within(limits.CALL_SECONDS, work())

    async def within(self, seconds: float, work: Coroutine[Deferred[Any], Any, T]) -> T:
        """Whatever the robot leaves out, nobody waits longer than this for it.

        :raises Unavailable: it has not answered
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
        state = self._state()
        if state is ChannelState.WAITING:
            raise Unavailable(f"robot {self._robot.name} is offline")
        if state is ChannelState.OPENING:
            waiting: Deferred[None] = Deferred()
            self._waiting.append(waiting)
            await waiting

    # --- the channel --------------------------------------------------------------------------------------

    def opened(self) -> None:
        """What waited is asked now."""
        waiting, self._waiting = self._waiting, []
        for each in waiting:
            each.callback(None)

    def not_opened(self, error: SwitchboardError) -> None:
        """What waited is answered with the reason."""
        waiting, self._waiting = self._waiting, []
        for each in waiting:
            each.errback(error)
