"""How old a client's message can be at most."""

from __future__ import annotations

import itertools

from relay_server.sessions.message_age import PENDING, MessageAge


class Client:
    """A freshness on a clock that stands unless it is moved."""

    def __init__(self) -> None:
        self.now = 1_000
        tokens = itertools.count()
        self.fresh = MessageAge(lambda: self.now, self.now, lambda: next(tokens).to_bytes(8, "big"))


def test_before_the_first_pong_a_message_may_be_as_old_as_the_connection() -> None:
    """The client can't have spoken before the handshake was answered."""
    client = Client()
    client.now += 50
    assert client.fresh.age() == 50


def test_a_pong_proves_the_sending_time_of_its_ping() -> None:
    """Not the time of its arrival: what comes after was sent after the ping was."""
    client = Client()
    client.now = 2_000
    payload = client.fresh.ping()
    client.now = 2_700
    assert client.fresh.pong(payload)
    assert client.fresh.not_before == 2_000
    assert client.fresh.age() == 700
    assert client.fresh.rtt == 700
    assert client.fresh.silence() == 0


def test_a_stall_ages_what_comes_after_it() -> None:
    """While no pong comes the age grows, whoever stood still."""
    client = Client()
    assert client.fresh.pong(client.fresh.ping())
    client.now += 10**10
    assert client.fresh.age() == 10**10
    assert client.fresh.silence() == 10**10


def test_unknown_pongs_prove_nothing() -> None:
    """A pong nobody asked for (RFC 6455 section 5.5.3) changes nothing, nor does the same pong again."""
    client = Client()
    payload = client.fresh.ping()
    client.now += 100
    assert not client.fresh.pong(b"guess")
    assert client.fresh.not_before == 1_000
    assert client.fresh.pong(payload)
    client.now += 100
    assert not client.fresh.pong(payload)
    assert client.fresh.silence() == 100


def test_a_pong_answers_the_pings_before_it() -> None:
    """A client may answer only the latest ping; an older one after that is unknown and takes nothing back."""
    client = Client()
    first = client.fresh.ping()
    client.now += 10
    second = client.fresh.ping()
    assert client.fresh.pong(second)
    assert not client.fresh.pong(first)
    assert client.fresh.not_before == 1_010


def test_unanswered_pings_are_bounded() -> None:
    """The oldest are forgotten."""
    client = Client()
    payloads = [client.fresh.ping() for _ in range(PENDING + 1)]
    assert not client.fresh.pong(payloads[0])
    assert client.fresh.pong(payloads[1])
