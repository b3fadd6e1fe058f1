"""Every order ends: with the robot's word, with time, or with the link."""

from __future__ import annotations

import pytest

from relay_protocol import link
from relay_protocol.errors import Unavailable
from relay_server.control import commands as module
from relay_server.control.commands import NotDone
from tests.relay_server.steering import Place, outcome, result


def stop(place: Place, **more: bool) -> list[object]:
    """Order a stop."""
    return outcome(place.desk.orders.give(lambda id: link.Stop(id=id, by="ann"), **more))


def test_an_order_ends_with_the_robots_word() -> None:
    """Not before; orders have numbers of their own, and each answer is matched."""
    place = Place().online()
    place.link.silent = True
    first, second = stop(place), stop(place)
    orders = place.link.orders(link.Stop)
    assert orders[0].id != orders[1].id
    place.link.answers(orders[1])
    assert (first, second) == ([], [None])
    place.link.answers(orders[0])
    assert first == [None]


def test_what_could_not_be_done_is_told_in_the_robots_words() -> None:
    """And an answer without a reason says so."""
    place = Place().online()
    place.link.unable = "the relay of the emergency stop does not answer"
    with pytest.raises(NotDone, match="rover could not do it: the relay of the emergency stop"):
        result(place.desk.orders.give(lambda id: link.Stop(id=id, by="ann")))


def test_a_robot_that_does_not_answer_is_waited_for_three_seconds() -> None:
    """What it says later is let go."""
    place = Place().online()
    place.link.silent = True
    asked = stop(place)
    place.clock.advance(2.9)
    assert asked == []
    place.clock.advance(0.2)
    assert str(asked[0]) == "robot rover did not answer within 3 s"
    place.link.answers(place.link.orders(link.Stop)[0])


def test_a_lost_link_ends_all_orders_in_words() -> None:
    """And a robot that is offline gets none."""
    place = Place().online()
    place.link.silent = True
    asked = stop(place)
    place.offline()
    assert isinstance(asked[0], Unavailable)
    assert "lost its connection" in str(asked[0])
    assert "is offline" in str(stop(place)[0])
    assert not [call for call in place.clock.getDelayedCalls() if call.active()]


def test_orders_are_bounded_but_for_what_must_always_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot that answers nothing costs the relay no memory."""
    monkeypatch.setattr(module, "WAITING", 2)
    place = Place().online()
    place.link.silent = True
    stop(place)
    stop(place)
    assert "has 2 orders to answer already" in str(stop(place)[0])
    assert stop(place, always=True) == []
    assert len(place.link.orders(link.Stop)) == 3


def test_an_answer_to_nothing_is_let_go() -> None:
    """A robot can't end what was never ordered, nor end something twice."""
    place = Place().online()
    assert stop(place) == [None]
    place.desk.told(link.Done(id=1))
    place.desk.told(link.Done(id=-7, ok=False))


def test_an_answer_meant_for_a_relay_that_ran_before_ends_no_order_of_this_one() -> None:
    """A robot may still have it to say when it dials again."""
    before = Place().online()
    for _ in range(3):
        stop(before)
    place = Place().online()
    place.link.silent = True
    asked = [stop(place) for _ in range(3)]
    for order in before.link.orders(link.Stop):
        place.desk.told(link.Done(id=order.id))
    assert asked == [[], [], []]
    assert all(0 < order.id < 1 << 31 for order in place.link.orders(link.Stop))
