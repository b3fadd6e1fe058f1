"""What one client may ask for at most, as SPEC section 5 has it."""

from __future__ import annotations

from pathlib import Path

import pytest

from relay_protocol.limits import MIB
from relay_server import outbox
from relay_server.channel import calls, goals, listener, publications, wire
from relay_server.session import calling, core, listening, operations

SPEC = (Path(__file__).parents[2] / "protocol" / "SPEC.md").read_text()


@pytest.mark.parametrize(
    "row",
    [
        f"subscriptions of it to one topic | {listening.SUBSCRIPTIONS}, {listener.ASKS} |",
        f"by topic and `id` | {publications.ADVERTISEMENTS} |",
        f"over all connections | {wire.USER_TOPICS} |",
        f"for clients on one robot | {wire.NAMES} |",
        f"| {listener.THROTTLE_SECONDS:g} s; {listener.QUEUE_LENGTH}; {publications.QUEUE_SIZE:,}; more counts",
        f"of one client | {listener.QUEUE_BYTES // MIB} MiB, {listener.QUEUES_BYTES // MIB} MiB;",
        f"slow client | {outbox.DATA_PER_TOPIC} of a topic, {outbox.DATA_BYTES // MIB} MiB together, "
        f"{outbox.DATA_AGE:g} s;",
        f"slow client | {outbox.CONTROL_MESSAGES}, {outbox.CONTROL_BYTES // MIB} MiB; then it is cut",
        f"| {publications.HELD_MESSAGES} of a topic, {publications.HELD_BYTES // MIB} MiB of a client together, "
        f"{publications.HELD_SECONDS:g} s |",
        f"wait for the robot | {calling.CALLS}, {calling.CALL_BYTES // MIB} MiB together |",
        f"on one robot | {calls.PENDING} each |",
        f"on one robot | {goals.ROBOT_GOALS} each |",
        f"| {operations.CHANGES_AT_ONCE:g} at once, then {operations.CHANGES_A_SECOND:g} a second |",
        f"no rosbridge | {core.MALFORMED} |",
    ],
)
def test_what_a_client_may_have_is_told(row: str) -> None:
    """A limit that is changed in the code must be changed in the text."""
    assert row in SPEC
