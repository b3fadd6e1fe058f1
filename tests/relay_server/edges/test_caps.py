"""How many connections one network may hold."""

from __future__ import annotations

from relay_server.http.connection_limits import ConnectionLimits


def test_a_network_of_addresses_counts_as_one() -> None:
    """Whoever has a /64 of IPv6 has no more places than others; an IPv4 address is one however it is written."""
    cap = ConnectionLimits(2)
    assert cap.enter("2001:db8::1")
    assert cap.enter("2001:db8::2")
    assert not cap.enter("2001:db8::3")
    assert cap.enter("2001:db8:0:1::1")
    cap.leave("2001:db8::3")
    cap.leave("2001:db8::1")
    assert cap.enter("2001:db8::4")
    assert cap.enter("192.0.2.1")
    assert cap.enter("::ffff:192.0.2.1")
    assert not cap.enter("192.0.2.1")


def test_a_place_is_given_back_once() -> None:
    """Known first and gone later is one place, not two."""
    cap = ConnectionLimits(2, strangers=1)
    place = cap.stranger()
    assert place is not None
    assert cap.stranger() is None
    place.give_back()
    place.give_back()
    assert cap.stranger() is not None
    assert cap.stranger() is None


def test_nothing_is_kept_of_who_has_left() -> None:
    """Addresses without end fill no memory."""
    cap = ConnectionLimits(2)
    for number in range(100):
        cap.enter(f"192.0.2.{number}")
        cap.leave(f"192.0.2.{number}")
    assert not cap._counts
