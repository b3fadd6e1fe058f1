"""The maximum age of a client's message."""

from __future__ import annotations

import itertools

from relay_server.sessions.message_age import MAX_UNANSWERED, MessageAge


class Client:
    """A ``MessageAge`` on a clock that the test moves."""

    def __init__(self) -> None:
        self.now = 1_000
        tokens = itertools.count()
        self.fresh = MessageAge(lambda: self.now, self.now, lambda: next(tokens).to_bytes(8, "big"))


def test_before_the_first_pong_a_message_may_be_as_old_as_the_connection() -> None:
    """The client cannot have sent it before the handshake was answered."""
    client = Client()
    client.now += 50
    assert client.now - client.fresh.earliest_sent == 50


def test_a_pong_proves_the_sending_time_of_its_ping() -> None:
    """It does not prove the time of its arrival: later messages were sent after the ping."""
    client = Client()
    client.now = 2_000
    payload = client.fresh.ping()
    client.now = 2_700
    assert client.fresh.pong(payload)
    assert client.fresh.earliest_sent == 2_000
    assert client.now - client.fresh.earliest_sent == 700
    assert client.fresh.rtt == 700
    assert client.fresh.silence() == 0


def test_a_stall_ages_what_comes_after_it() -> None:
    """Without pongs the age grows, whether the client or the relay has stalled."""
    client = Client()
    assert client.fresh.pong(client.fresh.ping())
    client.now += 10**10
    assert client.now - client.fresh.earliest_sent == 10**10
    assert client.fresh.silence() == 10**10


def test_unknown_pongs_prove_nothing() -> None:
    """An unsolicited pong (RFC 6455 section 5.5.3) changes nothing, nor does a repeated one."""
    client = Client()
    payload = client.fresh.ping()
    client.now += 100
    assert not client.fresh.pong(b"guess")
    assert client.fresh.earliest_sent == 1_000
    assert client.fresh.pong(payload)
    client.now += 100
    assert not client.fresh.pong(payload)
    assert client.fresh.silence() == 100


def test_a_pong_answers_the_pings_before_it() -> None:
    """A client may answer only the latest ping; a later pong for an older one is unknown and changes nothing."""
    client = Client()
    first = client.fresh.ping()
    client.now += 10
    second = client.fresh.ping()
    assert client.fresh.pong(second)
    assert not client.fresh.pong(first)
    assert client.fresh.earliest_sent == 1_010


def test_unanswered_pings_are_bounded() -> None:
    """The oldest are removed."""
    client = Client()
    payloads = [client.fresh.ping() for _ in range(MAX_UNANSWERED + 1)]
    assert not client.fresh.pong(payloads[0])
    assert client.fresh.pong(payloads[1])
