"""What one client may ask for at most, as SPEC section 5 has it."""

from __future__ import annotations

from pathlib import Path

import pytest

from relay_protocol.limits import MIB
from relay_server.channels import client_subscription, goals, publications, robot_link, service_calls
from relay_server.common import send_queue
from relay_server.robots import connection
from relay_server.sessions import service_calls as session_calls
from relay_server.sessions import session, subscriptions

SPEC = (Path(__file__).parents[2] / "protocol" / "SPEC.md").read_text()


@pytest.mark.parametrize(
    "row",
    [
        f"subscriptions of it to one topic | {subscriptions.SUBSCRIPTIONS}, {client_subscription.ASKS} |",
        f"by topic and `id` | {publications.ADVERTISEMENTS} |",
        f"over all connections | {robot_link.USER_TOPICS} |",
        f"for clients on one robot | {robot_link.NAMES} |",
        f"| {client_subscription.THROTTLE_SECONDS:g} s; {client_subscription.QUEUE_LENGTH}; "
        f"{publications.QUEUE_SIZE:,}; more counts",
        f"of one client | {client_subscription.QUEUE_BYTES // MIB} MiB, {client_subscription.QUEUES_BYTES // MIB} MiB;",
        f"slow client | {send_queue.DATA_PER_TOPIC} of a topic, {send_queue.DATA_BYTES // MIB} MiB together, "
        f"{send_queue.DATA_AGE:g} s;",
        f"slow client | {send_queue.CONTROL_MESSAGES}, {send_queue.CONTROL_BYTES // MIB} MiB, "
        f"and {send_queue.TAKEN} times as much while it answers pings; then it is cut (4429)",
        f"answers of clients, that wait for a slow robot | {connection.REQUEST_BYTES // MIB} MiB together,",
        f"| {publications.HELD_MESSAGES} of a topic, {publications.HELD_BYTES // MIB} MiB of a client together, "
        f"{publications.HELD_SECONDS:g} s |",
        f"wait for the robot | {session_calls.CALLS}, {session_calls.CALL_BYTES // MIB} MiB together |",
        f"on one robot | {service_calls.PENDING} each |",
        f"on one robot | {goals.ROBOT_GOALS} each |",
        f"| {session.CHANGES_AT_ONCE:g} at once, then {session.CHANGES_A_SECOND:g} a second |",
        f"no rosbridge | {session.MALFORMED} |",
    ],
)
def test_what_a_client_may_have_is_told(row: str) -> None:
    """A limit that is changed in the code must be changed in the text."""
    assert row in SPEC
