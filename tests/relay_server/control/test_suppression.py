"""Suppressing and inhibiting: the robot is notified, and the relay accepts commands accordingly."""

from __future__ import annotations

import pytest

from relay_protocol import limits, link
from relay_protocol.errors import Invalid, Unavailable
from relay_protocol.rights import Grant, Level, Rules
from tests.relay_server.control.test_stopping import ANN
from tests.worlds.control import ControlWorld, outcome, result


def test_suppression_gives_command_of_a_topic_without_control() -> None:
    """For that topic and for the given time. The controller's commands still pass; the robot decides."""
    scene = ControlWorld().online()
    ann, olga = scene.holding("ann"), scene.connection("olga")
    result(scene.service.suppression.suppress(ANN, [olga.number], "/cmd_vel", 100))
    (order,) = scene.link.orders(link.Suppress)
    assert (order.resource, order.sources, order.ms, order.by) == ("/cmd_vel", [olga.number], 100, "ann")
    assert scene.service.may_command(olga, "/cmd_vel")
    assert not scene.service.may_command(olga, "/arm")
    assert scene.service.may_command(ann, "/cmd_vel")
    scene.clock.advance(0.7)
    assert not scene.service.may_command(olga, "/cmd_vel")


def test_a_suppression_goes_on_while_it_is_renewed_and_is_noted_once() -> None:
    """The decision about commands stays the same object."""
    scene = ControlWorld().online()
    olga = scene.connection("olga")
    standing = None
    for _ in range(20):
        result(scene.service.suppression.suppress(ANN, [olga.number], "/cmd_vel", 200))
        assert standing in (None, scene.service.snapshot)
        standing = scene.service.snapshot
        scene.clock.advance(0.15)
        assert scene.service.may_command(olga, "/cmd_vel")
    assert scene.record.kinds == ["robot.suppressed"]
    result(scene.service.suppression.suppress(ANN, [], "/cmd_vel", 0))
    assert not scene.service.may_command(olga, "/cmd_vel")
    scene.clock.advance(1)
    assert not [call for call in scene.clock.getDelayedCalls() if call.active()]


def test_commands_pass_when_the_robot_has_agreed() -> None:
    """They do not pass if it refuses, or if its link is lost."""
    scene = ControlWorld().online()
    olga = scene.connection("olga")
    scene.link.silent = True
    asked = outcome(scene.service.suppression.suppress(ANN, [olga.number], "/cmd_vel", 100))
    assert not scene.service.may_command(olga, "/cmd_vel")
    scene.link.answers(scene.link.orders(link.Suppress)[0])
    assert asked == [None]
    assert scene.service.may_command(olga, "/cmd_vel")
    scene.offline()
    assert not scene.service.may_command(olga, "/cmd_vel")
    with pytest.raises(Unavailable, match="offline"):
        result(scene.service.suppression.suppress(ANN, [olga.number], "/cmd_vel", 100))


@pytest.mark.parametrize("ms", [-1, 1, 49, 201, 10**9])
def test_impossible_durations_are_refused(ms: int) -> None:
    """The robot receives none of them."""
    scene = ControlWorld().online()
    with pytest.raises(Invalid, match="'ms' must be"):
        scene.service.suppression.suppress(ANN, [1], "/cmd_vel", ms)
    with pytest.raises(Invalid, match="'ms' must be"):
        scene.service.suppression.inhibit(ANN, "/scan", -1 if ms < 0 else 60_001, False)
    assert scene.link.said == []


def test_topics_that_are_suppressed_are_bounded() -> None:
    """A renewal is always accepted."""
    scene = ControlWorld().online()
    for number in range(limits.LIST_ITEMS):
        result(scene.service.suppression.suppress(ANN, [1], f"/t{number}", 200))
    with pytest.raises(Unavailable, match="64 topics of robot rover are suppressed already"):
        scene.service.suppression.suppress(ANN, [1], "/more", 200)
    result(scene.service.suppression.suppress(ANN, [1], "/t0", 200))


def test_a_topic_is_inhibited_by_the_robot() -> None:
    """With its last value if the client asks for that."""
    scene = ControlWorld().online()
    result(scene.service.suppression.inhibit(ANN, "/scan", 1000, True))
    result(scene.service.suppression.inhibit(ANN, "/scan", 0, False))
    assert [(order.ms, order.hold) for order in scene.link.orders(link.Inhibit)] == [(1000, True), (0, False)]
    assert scene.record.kinds == ["robot.inhibited"]


def test_inhibition_ends_with_its_connection() -> None:
    """Only topics that this connection inhibited last. An offline robot is notified when it is back."""
    scene = ControlWorld().online()
    olga, otto = scene.connection("olga", Level.OWNER), scene.connection("otto", Level.OWNER)
    inhibit = scene.service.suppression.inhibit
    result(inhibit(ANN, "/scan", 60_000, False, olga))
    result(inhibit(ANN, "/map", 60_000, False, olga))
    result(inhibit(ANN, "/map", 60_000, False, otto))
    scene.service.client_left(olga)
    assert ended(scene) == ["/scan"]
    scene.offline()
    scene.service.client_left(otto)
    scene.online()
    assert ended(scene) == ["/map"]
    scene.offline()
    scene.online()
    assert ended(scene) == []
    assert not [call for call in scene.clock.getDelayedCalls() if call.active()]


def test_inhibition_ends_with_its_right() -> None:
    """Topic by topic; an inhibition that has expired is not ended again."""
    scene = ControlWorld().online()
    olga = scene.connection("olga", Level.OWNER)
    over: list[str] = []
    for topic, ms in (("/scan", 60_000), ("/map", 60_000), ("/odom", 100)):
        result(
            scene.service.suppression.inhibit(
                ANN, topic, ms, False, olga, lambda topic=topic: over.append(topic)
            )
        )
    scene.clock.advance(1)
    assert over == ["/odom"]
    olga.permit.rules = Rules([Grant(Level.OWNER, (), ("inhibit:/scan",))])
    scene.service.rights_changed(olga)
    assert ended(scene) == ["/scan"]
    olga.permit.rules = Rules()
    scene.service.rights_changed(olga)
    assert ended(scene) == ["/scan", "/map"]
    assert over == ["/odom", "/scan", "/map"]


def test_topics_that_are_inhibited_are_bounded() -> None:
    """A renewal and an end are always accepted; an inhibition that the robot refuses takes no place."""
    scene = ControlWorld().online()
    inhibit = scene.service.suppression.inhibit
    scene.link.unable = "no such topic"
    outcome(inhibit(ANN, "/none", 1000, False))
    scene.link.unable = ""
    for number in range(limits.LIST_ITEMS):
        result(inhibit(ANN, f"/t{number}", 1000, False))
    with pytest.raises(Unavailable, match="64 topics of robot rover are inhibited already"):
        inhibit(ANN, "/more", 1000, False)
    result(inhibit(ANN, "/t0", 1000, False))
    result(inhibit(ANN, "/more", 0, False))


def ended(scene: ControlWorld) -> list[str]:
    """Topics whose inhibition the robot was asked to end."""
    return [order.resource for order in scene.link.orders(link.Inhibit) if order.ms == 0]
