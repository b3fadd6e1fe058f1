"""Relays whose lease has ended. One that still answers is only cut off from the bus, and goes on with its jobs."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterable

from twisted.internet.defer import Deferred, DeferredList

from relay_server.cluster.relays import RelayInfo

MOST = 1000
"""Relays that are remembered; of more, the oldest are taken to be gone."""


class DepartedRelays:
    """
    :param answers: whether a relay answers at its address
    """

    def __init__(self, answers: Callable[[RelayInfo], Awaitable[bool]]) -> None:
        self._answers = answers
        self._known: dict[str, RelayInfo] = {}

    def note(self, live: Iterable[RelayInfo]) -> None:
        """Remember relays that have a lease now."""
        for each in live:
            self._known.pop(each.id, None)
            self._known[each.id] = each
        while len(self._known) > MOST:
            del self._known[next(iter(self._known))]

    async def alive(self, live: Iterable[RelayInfo]) -> set[str]:
        """The ids of relays without a lease that answer. The others are forgotten.

        :param live: relays with a lease. At the address of one of them nothing else can be: it was started again
        """
        live = list(live)
        ids, addresses = {each.id for each in live}, {each.address for each in live}
        departed = [each for each in self._known.values() if each.id not in ids]
        asked = [each for each in departed if each.address not in addresses]
        answers = await DeferredList(
            [Deferred.fromCoroutine(self._ask(each)) for each in asked], consumeErrors=True
        )
        found = {each.id for each, (done, answer) in zip(asked, answers, strict=True) if done and answer}
        for each in departed:
            if each.id not in found:
                del self._known[each.id]
        return found

    async def _ask(self, relay: RelayInfo) -> bool:
        return await self._answers(relay)
