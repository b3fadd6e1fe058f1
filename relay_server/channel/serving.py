"""Calls of services that clients offer, from the robot's graph and from other clients."""

from __future__ import annotations

from typing import Any

from twisted.internet.defer import CancelledError, Deferred
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_protocol import jsontext, limits, link, rosbridge
from relay_protocol.errors import NotFound, SwitchboardError, Unavailable
from relay_server.channel.bodies import Bodies
from relay_server.channel.errands import Errand, Errands
from relay_server.channel.offers import Offer, Offers, Provider
from relay_server.channel.wire import ChannelLink, Wire
from relay_server.clock import Clock, Timer, cancel

GRAPH_CALLS = 1024
"""Calls from one robot's graph that may be under way."""

LONGEST_CALL = 3600.0
"""Most seconds a caller may give a service."""


def call_seconds(timeout: float | None) -> float:
    """How long a call may take, by what the caller asked for."""
    return min(timeout, LONGEST_CALL) if timeout and timeout > 0 else limits.CALL_SECONDS


class _Call(Errand):
    """A call on its way to the client that offers the service."""

    waiting: Deferred[bytes] | None = None
    late: Timer | None = None

    def withdrawn(self, reason: str) -> None:
        """The client will never answer."""
        self.settle(Unavailable(reason))

    def settle(self, answer: bytes | SwitchboardError) -> None:
        """Give the caller its answer, if it still waits."""
        cancel(self.late)
        waiting, self.waiting = self.waiting, None
        if waiting is None:
            return
        if isinstance(answer, bytes):
            waiting.callback(answer)
        else:
            waiting.errback(answer)


class ServedCalls:
    """Each call is answered exactly once: by the client, by time, or because the client has gone."""

    log = Logger()

    def __init__(self, clock: Clock, wire: Wire, bodies: Bodies, offers: Offers, errands: Errands) -> None:
        self._clock = clock
        self._wire = wire
        self._bodies = bodies
        self._offers = offers
        self._errands = errands
        self._graph_calls: set[Deferred[None]] = set()

    def ask(self, offer: Offer, request: bytes, seconds: float) -> Deferred[bytes]:
        """Have the client that offers the service answer a request; cancel it when nobody wants the answer any more.

        :param request: a body, see :class:`Bodies`; the answer is one too
        :param seconds: the client has for its answer
        :raises Invalid: the request is no such body
        :raises Unavailable: the client has too much to do; the answer fails so when there is none or it says no
        """
        args = self._bodies.to_client(f"{offer.type}_Request", request)
        call = _Call(self._errands.new_id(), offer, args)
        self._errands.add(call)
        waiting = call.waiting = Deferred(lambda _: self._give_up(call))
        call.late = self._clock.callLater(seconds, self._too_late, call, seconds)
        offer.member.say(rosbridge.call_service(offer.written, call.id, args))
        return waiting

    def answered(self, member: Provider, answer: rosbridge.ServiceResponse) -> None:
        """A client answers a call.

        :raises Refused: it was not asked that
        :raises Invalid: the answer does not fit the type; the caller is told too
        """
        call = self._errands.find(member, answer.id, _Call)
        self._errands.remove(call)
        name, text = call.offer.name, bytes(answer.values or b"")
        try:
            if not answer.result:
                reason = reason_in(text) or f"the client that offers {name} could not do it"
                call.settle(Unavailable(reason))
                return
            body = self._bodies.from_client(f"{call.offer.type}_Response", text)
        except SwitchboardError as error:
            call.settle(Unavailable(f"the client that offers {name} gave an unfit answer: {error}"))
            raise
        call.settle(body)

    def called(self, message: link.CallService) -> None:
        """The graph calls a service that a client offers."""
        origin = self._wire.link
        if origin is None:
            return
        if len(self._graph_calls) >= GRAPH_CALLS:
            origin.send(_no(message, f"{GRAPH_CALLS} calls from the graph are under way already"))
            return
        running = Deferred.fromCoroutine(self._serve(message, origin))
        self._graph_calls.add(running)
        running.addErrback(self._unexpected, message, origin)
        running.addBoth(self._over, running)

    def lost(self) -> None:
        """The link is gone, and with it those who called over it."""
        for running in list(self._graph_calls):
            running.cancel()

    async def _serve(self, message: link.CallService, origin: ChannelLink) -> None:
        try:
            body = await self._answer(message)
        except SwitchboardError as error:
            origin.send(_no(message, str(error)))
        else:
            origin.send(link.ServiceResponse(id=message.id, result=True, **self._bodies.values(body)))

    async def _answer(self, message: link.CallService) -> bytes:
        offer = self._offers.standing(message.service)
        if offer is None:
            raise NotFound(f"no client offers the service {message.service}")
        await self._bodies.ready(offer.type)
        self._offers.check(offer)
        request = self._bodies.from_robot(f"{offer.type}_Request", message.cdr, message.args)
        return await self.ask(offer, request, call_seconds(message.timeout))

    def _give_up(self, call: _Call) -> None:
        call.waiting = None
        cancel(call.late)
        self._errands.fade(call)

    def _too_late(self, call: _Call, seconds: float) -> None:
        self._errands.fade(call)
        call.settle(
            Unavailable(f"the client that offers {call.offer.name} did not answer within {seconds:g} s")
        )

    def _unexpected(self, failure: Failure, message: link.CallService, origin: ChannelLink) -> None:
        if failure.check(CancelledError):
            return
        self.log.failure("a call of {service} from the graph failed", failure, service=message.service)
        origin.send(_no(message, "the relay failed on this call; its log tells more"))

    def _over(self, _: Any, running: Deferred[None]) -> None:
        self._graph_calls.discard(running)


def reason_in(text: bytes) -> str:
    """Why a client says no, out of the ``values`` of its answer: a string, or whatever else it sent."""
    value = jsontext.decode_any(text) if text else ""
    words = value if isinstance(value, str) else jsontext.encode(value).decode()
    return words[: limits.WORDS]


def _no(message: link.CallService, reason: str) -> link.ServiceResponse:
    return link.ServiceResponse(id=message.id, result=False, reason=reason)
