"""Limits of connections per network, and of unauthenticated connections."""

from __future__ import annotations

from relay_server.http.limits import ConnectionLimits


def test_a_network_of_addresses_counts_as_one() -> None:
    """A /64 of IPv6 counts as one network; so does an IPv4 address, in both of its notations."""
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


def test_without_a_limit_all_connections_enter() -> None:
    cap = ConnectionLimits(0)
    assert all(cap.enter("192.0.2.1") for _ in range(3))


def test_a_slot_is_released_once() -> None:
    """A client that is authenticated first and leaves later frees one slot, not two."""
    cap = ConnectionLimits(2, unauthenticated=1)
    slot = cap.unauthenticated()
    assert slot is not None
    assert cap.unauthenticated() is None
    slot.release()
    slot.release()
    assert cap.unauthenticated() is not None
    assert cap.unauthenticated() is None


def test_no_count_is_kept_for_a_network_without_connections() -> None:
    """Many addresses cannot fill the memory."""
    cap = ConnectionLimits(2)
    for number in range(100):
        cap.enter(f"192.0.2.{number}")
        cap.leave(f"192.0.2.{number}")
    assert not cap._counts
