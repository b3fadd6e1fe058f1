"""Limits of one client, as in SPEC 5."""

from __future__ import annotations

import pytest

from relay_protocol.limits import MIB
from relay_server.channels import client_subscription, goals, link_state, publications, service_calls
from relay_server.common import send_queue
from relay_server.foxglove import assets, parameters
from relay_server.foxglove import services as foxglove_services
from relay_server.robots import connection
from relay_server.sessions import service_calls as session_calls
from relay_server.sessions import session, subscriptions, websocket_port
from tests.worlds.specification import SPEC, unwrapped


@pytest.mark.parametrize(
    "row",
    [
        f"subscriptions of it to one topic | {subscriptions.SUBSCRIPTIONS}, {client_subscription.MAX_REQUESTS} |",
        f"by topic and `id` | {publications.ADVERTISEMENTS} |",
        f"over all connections | {link_state.USER_TOPICS} |",
        f"for clients on one robot | {link_state.NAMES} |",
        f"| {client_subscription.THROTTLE_SECONDS:g} s; {client_subscription.QUEUE_LENGTH}; "
        f"{publications.QUEUE_SIZE:,}; more counts",
        f"of one client | {client_subscription.QUEUE_BYTES // MIB} MiB, {client_subscription.QUEUES_BYTES // MIB} MiB;",
        f"slow client | {send_queue.DATA_PER_TOPIC} of a topic, {send_queue.DATA_BYTES // MIB} MiB together, "
        f"{send_queue.DATA_AGE:g} s;",
        f"slow client | {send_queue.CONTROL_MESSAGES}, {send_queue.CONTROL_BYTES // MIB} MiB, "
        f"and {send_queue.READING_FACTOR} times as much while it answers pings; then it is cut (4429)",
        f"answers of clients, that wait for a slow robot | {connection.REQUEST_BYTES // MIB} MiB together,",
        f"| {publications.QUEUED_MESSAGES} of a topic, {publications.QUEUED_BYTES // MIB} MiB of a client together, "
        f"{publications.QUEUED_SECONDS:g} s |",
        f"wait for the robot | {session_calls.CALLS}, {session_calls.CALL_BYTES // MIB} MiB together |",
        f"on one robot | {service_calls.MAX_CALLS} each |",
        f"on one robot | {goals.ROBOT_GOALS} each |",
        f"| {session.CHANGES_AT_ONCE:g} at once, then {session.CHANGES_A_SECOND:g} a second |",
        f"no rosbridge | {websocket_port.MAX_MALFORMED} |",
        f"gets a `status`; {websocket_port.MAX_MALFORMED} in a row close the connection",
        f"One message may have {subscriptions.SUBSCRIPTIONS} subscriptions, channels or ids",
        f"On one connection {foxglove_services.CALLS} calls (calls that stop the robot do not count)",
        f"{parameters.REQUESTS} requests for parameters and {assets.ASSETS} assets wait at a time. "
        f"{parameters.NAMES} parameters",
        f"take at most {assets.USER_BYTES // MIB} MiB of one user, over all connections, "
        f"and {assets.RELAY_BYTES // MIB} MiB of all users",
    ],
)
def test_available_resources_are_listed(row: str) -> None:
    """A limit that changes in the code must change in the text."""
    assert row in unwrapped(SPEC)
