"""Suppressing and inhibiting: the robot is told, and the relay lets by whom it obeys."""

from __future__ import annotations

import pytest

from relay_protocol import limits, link
from relay_protocol.errors import Invalid, Unavailable
from relay_protocol.rights import Grant, Level, Rules
from tests.relay_server.control.test_stopping import ANN
from tests.relay_server.steering import Place, outcome, result


def test_who_suppresses_a_topic_commands_it_without_control() -> None:
    """That topic, and no longer than the robot could obey; whoever has control still passes, for the robot to judge."""
    place = Place().online()
    ann, olga = place.holding("ann"), place.connection("olga")
    result(place.desk.subsuming.suppress(ANN, [olga.number], "/cmd_vel", 100))
    (order,) = place.link.orders(link.Suppress)
    assert (order.resource, order.sources, order.ms, order.by) == ("/cmd_vel", [olga.number], 100, "ann")
    assert place.desk.passes(olga, "/cmd_vel")
    assert not place.desk.passes(olga, "/arm")
    assert place.desk.passes(ann, "/cmd_vel")
    place.clock.advance(0.7)
    assert not place.desk.passes(olga, "/cmd_vel")


def test_a_suppression_goes_on_while_it_is_renewed_and_is_noted_once() -> None:
    """What decides over commands is no other object for it."""
    place = Place().online()
    olga = place.connection("olga")
    standing = None
    for _ in range(20):
        result(place.desk.subsuming.suppress(ANN, [olga.number], "/cmd_vel", 200))
        assert standing in (None, place.desk.standing)
        standing = place.desk.standing
        place.clock.advance(0.15)
        assert place.desk.passes(olga, "/cmd_vel")
    assert place.record.kinds == ["robot.suppressed"]
    result(place.desk.subsuming.suppress(ANN, [], "/cmd_vel", 0))
    assert not place.desk.passes(olga, "/cmd_vel")
    place.clock.advance(1)
    assert not [call for call in place.clock.getDelayedCalls() if call.active()]


def test_nobody_passes_before_the_robot_has_agreed() -> None:
    """Nor when it does not, nor when its link is lost."""
    place = Place().online()
    olga = place.connection("olga")
    place.link.silent = True
    asked = outcome(place.desk.subsuming.suppress(ANN, [olga.number], "/cmd_vel", 100))
    assert not place.desk.passes(olga, "/cmd_vel")
    place.link.answers(place.link.orders(link.Suppress)[0])
    assert asked == [None]
    assert place.desk.passes(olga, "/cmd_vel")
    place.offline()
    assert not place.desk.passes(olga, "/cmd_vel")
    with pytest.raises(Unavailable, match="offline"):
        result(place.desk.subsuming.suppress(ANN, [olga.number], "/cmd_vel", 100))


@pytest.mark.parametrize("ms", [-1, 1, 49, 201, 10**9])
def test_times_that_can_not_be_are_told(ms: int) -> None:
    """The robot hears nothing of them."""
    place = Place().online()
    with pytest.raises(Invalid, match="'ms' must be"):
        place.desk.subsuming.suppress(ANN, [1], "/cmd_vel", ms)
    with pytest.raises(Invalid, match="'ms' must be"):
        place.desk.subsuming.inhibit(ANN, "/scan", -1 if ms < 0 else 60_001, False)
    assert place.link.said == []


def test_topics_that_are_suppressed_are_bounded() -> None:
    """A renewal is always taken."""
    place = Place().online()
    for number in range(limits.FACTS):
        result(place.desk.subsuming.suppress(ANN, [1], f"/t{number}", 200))
    with pytest.raises(Unavailable, match="64 topics of robot rover are suppressed already"):
        place.desk.subsuming.suppress(ANN, [1], "/more", 200)
    result(place.desk.subsuming.suppress(ANN, [1], "/t0", 200))


def test_a_topic_is_inhibited_by_the_robot() -> None:
    """With its last value where that is asked for."""
    place = Place().online()
    result(place.desk.subsuming.inhibit(ANN, "/scan", 1000, True))
    result(place.desk.subsuming.inhibit(ANN, "/scan", 0, False))
    assert [(order.ms, order.hold) for order in place.link.orders(link.Inhibit)] == [(1000, True), (0, False)]
    assert place.record.kinds == ["robot.inhibited"]


def test_what_somebody_inhibits_ends_with_his_connection() -> None:
    """Only what he was the last to inhibit, and a robot that is away hears of it when it is back."""
    place = Place().online()
    olga, otto = place.connection("olga", Level.OWNER), place.connection("otto", Level.OWNER)
    inhibit = place.desk.subsuming.inhibit
    result(inhibit(ANN, "/scan", 60_000, False, olga))
    result(inhibit(ANN, "/map", 60_000, False, olga))
    result(inhibit(ANN, "/map", 60_000, False, otto))
    place.desk.left(olga)
    assert ended(place) == ["/scan"]
    place.offline()
    place.desk.left(otto)
    place.online()
    assert ended(place) == ["/map"]
    place.offline()
    place.online()
    assert ended(place) == []
    assert not [call for call in place.clock.getDelayedCalls() if call.active()]


def test_what_somebody_inhibits_ends_with_his_right() -> None:
    """Topic by topic; what is over by itself is not ended once more."""
    place = Place().online()
    olga = place.connection("olga", Level.OWNER)
    over: list[str] = []
    for topic, ms in (("/scan", 60_000), ("/map", 60_000), ("/odom", 100)):
        result(
            place.desk.subsuming.inhibit(ANN, topic, ms, False, olga, lambda topic=topic: over.append(topic))
        )
    place.clock.advance(1)
    assert over == ["/odom"]
    olga.permit.rules = Rules([Grant(Level.OWNER, (), ("inhibit:/scan",))])
    place.desk.rights_changed(olga)
    assert ended(place) == ["/scan"]
    olga.permit.rules = Rules()
    place.desk.rights_changed(olga)
    assert ended(place) == ["/scan", "/map"]
    assert over == ["/odom", "/scan", "/map"]


def test_topics_that_are_inhibited_are_bounded() -> None:
    """A renewal and an end are always taken; what the robot refuses takes no place."""
    place = Place().online()
    inhibit = place.desk.subsuming.inhibit
    place.link.unable = "no such topic"
    outcome(inhibit(ANN, "/none", 1000, False))
    place.link.unable = ""
    for number in range(limits.FACTS):
        result(inhibit(ANN, f"/t{number}", 1000, False))
    with pytest.raises(Unavailable, match="64 topics of robot rover are inhibited already"):
        inhibit(ANN, "/more", 1000, False)
    result(inhibit(ANN, "/t0", 1000, False))
    result(inhibit(ANN, "/more", 0, False))


def ended(place: Place) -> list[str]:
    """The topics that the robot was told to inhibit no more."""
    return [order.resource for order in place.link.orders(link.Inhibit) if order.ms == 0]
