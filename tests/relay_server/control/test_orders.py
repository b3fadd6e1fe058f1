"""Every order ends: by the robot's answer, by time, or with the link."""

from __future__ import annotations

import pytest

from relay_protocol import link
from relay_protocol.errors import Unavailable
from relay_server.common.errors import NotDone
from relay_server.control import orders as module
from tests.worlds.control import ControlWorld, outcome, result


def stop(scene: ControlWorld, **more: bool) -> list[object]:
    """Orders a stop."""
    return outcome(scene.service.orders.send(lambda id: link.Stop(id=id, by="ann"), **more))


def test_an_order_ends_with_the_robots_word() -> None:
    """Each order has a number, by which its answer is matched."""
    scene = ControlWorld().online()
    scene.link.silent = True
    first, second = stop(scene), stop(scene)
    orders = scene.link.orders(link.Stop)
    assert orders[0].id != orders[1].id
    scene.link.answers(orders[1])
    assert (first, second) == ([], [None])
    scene.link.answers(orders[0])
    assert first == [None]


def test_failure_is_reported_in_the_robots_words() -> None:
    """An answer without a reason has a default text."""
    scene = ControlWorld().online()
    scene.link.unable = "the relay of the emergency stop does not answer"
    with pytest.raises(NotDone, match="rover could not do it: the relay of the emergency stop"):
        result(scene.service.orders.send(lambda id: link.Stop(id=id, by="ann")))


def test_a_robot_that_does_not_answer_is_waited_for_three_seconds() -> None:
    """Later answers are ignored."""
    scene = ControlWorld().online()
    scene.link.silent = True
    asked = stop(scene)
    scene.clock.advance(2.9)
    assert asked == []
    scene.clock.advance(0.2)
    assert str(asked[0]) == "robot rover did not answer within 3 s"
    scene.link.answers(scene.link.orders(link.Stop)[0])


def test_a_lost_link_ends_all_orders_with_a_reason() -> None:
    """A robot that is offline gets no orders."""
    scene = ControlWorld().online()
    scene.link.silent = True
    asked = stop(scene)
    scene.offline()
    assert isinstance(asked[0], Unavailable)
    assert "lost its connection" in str(asked[0])
    assert "is offline" in str(stop(scene)[0])
    assert not [call for call in scene.clock.getDelayedCalls() if call.active()]


def test_orders_are_bounded_but_for_what_must_always_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot that never answers costs bounded memory."""
    monkeypatch.setattr(module, "MAX_PENDING", 2)
    scene = ControlWorld().online()
    scene.link.silent = True
    stop(scene)
    stop(scene)
    assert "has 2 orders to answer already" in str(stop(scene)[0])
    assert stop(scene, always=True) == []
    assert len(scene.link.orders(link.Stop)) == 3


def test_an_answer_without_an_order_is_ignored() -> None:
    """A robot cannot end an order twice or one that was never given."""
    scene = ControlWorld().online()
    assert stop(scene) == [None]
    scene.service.message_received(link.OrderResult(id=1))
    scene.service.message_received(link.OrderResult(id=-7, ok=False))


def test_an_answer_meant_for_a_relay_that_ran_before_ends_no_order_of_this_one() -> None:
    """A robot may repeat it after it reconnects."""
    before = ControlWorld().online()
    for _ in range(3):
        stop(before)
    scene = ControlWorld().online()
    scene.link.silent = True
    asked = [stop(scene) for _ in range(3)]
    for order in before.link.orders(link.Stop):
        scene.service.message_received(link.OrderResult(id=order.id))
    assert asked == [[], [], []]
    assert all(0 < order.id < 1 << 31 for order in scene.link.orders(link.Stop))
