"""Definitions that a client must have before a channel or service is announced to it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence

from relay_protocol.errors import NotFound, SwitchboardError, Unavailable
from relay_protocol.ros_types import TypeRegistry
from relay_server.common.concurrency import gather_per_key
from relay_server.foxglove.context import FoxgloveContext

MOST_TYPES_SHOWN = 8
"""Most types that one status names."""


class DefinitionRequests:
    """Requests definitions of types from the robot, for one client.

    :param arrived: called when definitions have arrived that were requested, at most once in a reactor turn
    """

    def __init__(self, context: FoxgloveContext, status_id: str, arrived: Callable[[], None]) -> None:
        self._context = context
        self._status_id = status_id
        self._arrived = arrived
        self._types: TypeRegistry | None = None
        self._requested: set[str] = set()
        self._missing: dict[str, str] = {}
        """Reasons why types have no definition, by name."""
        self._left_out: list[str] = []
        """Types of topics or services of which no type has a definition."""
        self._notifying = False
        self.outdated = False
        """Whether a definition has arrived, or must be requested again, since this was last set to false."""

    def request(self, undefined: Iterable[Sequence[str]]) -> None:
        """Request a definition for each topic or service that has none: of its first type that may have one.

        :param undefined: the types of each
        """
        self._forget_of_earlier_run()
        wanted, self._left_out = [], []
        for types in undefined:
            possible = [each for each in types if each not in self._missing]
            if possible:
                wanted.append(possible[0])
            else:
                self._left_out += types
        self._show_left_out()
        self._begin(wanted)

    def request_again(self, name: str) -> None:
        """Request the definition of a type that is advertised with an earlier one."""
        self._forget_of_earlier_run()
        if name not in self._missing:
            self._begin([name])

    def _forget_of_earlier_run(self) -> None:
        types = self._context.client.robot.types
        if self._types is not types:
            # The robot has registered again, and may know other types now.
            self._types = types
            self._missing.clear()

    def _begin(self, names: list[str]) -> None:
        fresh = [each for each in dict.fromkeys(names) if each not in self._requested]
        if fresh and self._context.client.robot.control_link is None:
            self.outdated = True
        elif fresh:
            self._requested.update(fresh)
            self._context.run(self._request(fresh))

    async def _request(self, names: list[str]) -> None:
        await gather_per_key(deque(names), self._await_definition)
        self._notify()

    def _notify(self) -> None:
        """Call ``arrived`` in the next reactor turn, once for all definitions of this one."""
        if not self._notifying:
            self._notifying = True
            self._context.clock.callLater(0, self._notify_now)

    def _notify_now(self) -> None:
        self._notifying = False
        if not self._context.session.closed:
            self._arrived()

    async def _await_definition(self, name: str) -> None:
        try:
            await self._context.client.channel.requests.definition(name)
            if not self._context.client.robot.types.knows(name):
                raise NotFound(f"the robot has no definition of {name}")
        except Unavailable:
            # It is requested again with the next look at the graph.
            return
        except SwitchboardError as error:
            self._missing[name] = str(error)
        finally:
            self._requested.discard(name)
            self.outdated = True
        # One slow definition must not delay the others.
        self._notify()

    def _show_left_out(self) -> None:
        reasons = [self._missing[each] for each in dict.fromkeys(self._left_out)]
        if not reasons:
            self._context.statuses.remove(self._status_id)
            return
        shown = "; ".join(reasons[:MOST_TYPES_SHOWN])
        more = len(reasons) - MOST_TYPES_SHOWN
        rest = f"; and {more} more" if more > 0 else ""
        text = f"left out, as they have no definition: {shown}{rest}"
        self._context.show_state("warning", text, self._status_id)
