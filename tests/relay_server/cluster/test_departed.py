"""Relays that have lost their lease: which of them still work."""

from __future__ import annotations

import pytest_twisted

from relay_server.cluster.departed import DepartedRelays
from relay_server.cluster.relays import RelayInfo


def relay(name: str, port: int) -> RelayInfo:
    return RelayInfo(name, "10.0.0.1", port, "1", 0.0)


@pytest_twisted.ensureDeferred
async def test_a_relay_without_a_lease_that_answers_is_alive() -> None:
    asked: list[str] = []
    answering = {"cut off"}

    async def answers(relay: RelayInfo) -> bool:
        asked.append(relay.id)
        if relay.id == "broken":
            raise OSError
        return relay.id in answering

    here, cut, dead, broken, old = (
        relay(name, port)
        for port, name in enumerate(("here", "cut off", "dead", "broken", "restarted before"), 9000)
    )
    again = relay("restarted", old.port)
    departed = DepartedRelays(answers)
    departed.note([here, cut, dead, broken, old])
    departed.note([here, again])
    assert await departed.alive([here, again]) == {"cut off"}
    # At the address of the one that was restarted its successor would answer.
    assert asked == ["cut off", "dead", "broken"]
    answering.clear()
    assert await departed.alive([here, again]) == set()
    assert asked[3:] == ["cut off"]
    assert await departed.alive([here, again]) == set()
    assert asked[4:] == []
