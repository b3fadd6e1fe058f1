"""Orders to stop that a page sends over a websocket (SPEC 1.7), since its requests may wait for a connection."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import msgspec

from relay_protocol import jsontext, nonfinite
from relay_protocol.errors import Invalid, MalformedMessage
from relay_server.access import Principal
from relay_server.common.clock import Clock
from relay_server.fleet.order import FleetOrderEnd, FleetStopOrder, TaskResult
from relay_server.fleet.service import FleetService

_STOP = msgspec.json.Decoder(FleetStopOrder)


class WebsocketStops:
    """Carries out orders to stop.

    :param service: of orders to many robots
    """

    def __init__(self, clock: Clock, service: FleetService) -> None:
        self._clock = clock
        self._service = service

    async def carry_out(
        self, principal: Principal, payload: bytes, address: str, send: Callable[[bytes], None]
    ) -> None:
        """Carry out one order, whether or not its page stays connected.

        :param payload: the order, as in the body of a request (SPEC 1.11)
        :param address: of the page
        :param send: takes each line of the answer; it may ignore them
        :raises Invalid: the payload is no order to stop
        :raises SwitchboardError: the order can't begin
        """
        try:
            order = nonfinite.decode(_STOP, nonfinite.mark_body(payload), ()).order
        except MalformedMessage as error:
            raise Invalid(f"this websocket takes only orders to stop: {error}") from None
        began = self._clock.seconds()
        plan = await self._service.plan(principal, order, address)
        counted: Counter[bool] = Counter()

        async def report(result: TaskResult) -> None:
            counted[result.outcome.ok] += 1
            send(jsontext.encode(result.line))

        await self._service.carry_out(plan, lambda: send(jsontext.encode(plan.start)), report)
        seconds = round(self._clock.seconds() - began, 3)
        end = FleetOrderEnd(
            done=True, robots=len(plan.robots), ok=counted[True], failed=counted[False], seconds=seconds
        )
        send(jsontext.encode(end))
