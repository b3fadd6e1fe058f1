"""The control table: each state allows only its own transitions."""

from __future__ import annotations

import itertools

import pytest

from relay_server.control.lease import FREE, NEXT, ControlRequest, Lease, LeaseEvent, LeaseState
from tests.worlds.control import ControlWorld

PLACE = ControlWorld()
ANN, BOB = PLACE.connection("ann"), PLACE.connection("bob")


def held() -> Lease:
    """Ann has control."""
    return FREE.give(ANN, 1.0).done(2.0)


def requested() -> Lease:
    """Bob requests control."""
    return held().requested(ControlRequest(BOB, 3.0, 33.0, "my turn"))


def test_control_starts_when_the_robot_has_agreed() -> None:
    """A pending controller has no control yet."""
    asked = FREE.give(ANN, 1.0)
    assert (asked.state, asked.holder) == (LeaseState.ASKING, None)
    assert asked.pending_for(ANN)
    assert not asked.held_by(ANN)
    assert held().held_by(ANN)
    assert held().holder == (ANN, 2.0, False)


def test_a_handover_never_leaves_control_free() -> None:
    """While the robot is notified of Bob, neither Ann nor Bob moves it."""
    handing = requested().give(BOB, 4.0)
    assert handing.holder is None
    assert handing.request is None
    assert handing.done(5.0).held_by(BOB)


def test_a_robot_that_does_not_agree_leaves_it_free() -> None:
    """This holds for a new controller and for a release."""
    assert FREE.give(ANN, 1.0).failed() == FREE
    assert held().free().failed() == FREE
    assert held().free().done(3.0) == FREE


def test_a_lost_link_frees_it_from_every_state() -> None:
    """Controller, pending controller and requester are removed."""
    for lease in (FREE, FREE.give(ANN, 1.0), held(), requested(), held().free()):
        assert lease.lost() == FREE


def test_a_request_is_taken_back() -> None:
    """The controller keeps control."""
    assert requested().state is LeaseState.REQUESTED
    assert requested().requested_by(BOB)
    assert requested().withdrawn() == held()


def test_there_are_never_two() -> None:
    """For any order of events there is at most one of controller and pending controller, and a request only
    to a controller.
    """
    events = {
        LeaseEvent.GIVE: lambda lease: lease.give(BOB, 1.0),
        LeaseEvent.FREE: lambda lease: lease.free(),
        LeaseEvent.DONE: lambda lease: lease.done(1.0),
        LeaseEvent.FAILED: lambda lease: lease.failed(),
        LeaseEvent.REQUEST: lambda lease: lease.requested(ControlRequest(BOB, 1.0, 2.0, "")),
        LeaseEvent.WITHDRAW: lambda lease: lease.withdrawn(),
        LeaseEvent.LOST: lambda lease: lease.lost(),
    }
    reached = set()
    for path in itertools.product(LeaseEvent, repeat=4):
        lease = FREE
        for event in path:
            if (lease.state, event) in NEXT:
                lease = events[event](lease)
                reached.add(lease.state)
        assert lease.holder is None or lease.pending_holder is None
        assert (lease.holder is not None) == (lease.state in (LeaseState.HELD, LeaseState.REQUESTED))
        assert (lease.pending_holder is not None) == (lease.state is LeaseState.ASKING)
        assert (lease.request is not None) == (lease.state is LeaseState.REQUESTED)
    assert reached == set(LeaseState)


def test_impossible_transition_is_an_internal_error() -> None:
    """For example a request for a free robot."""
    with pytest.raises(ValueError, match="'request' can't happen while control is free"):
        FREE.requested(ControlRequest(BOB, 1.0, 2.0, ""))
