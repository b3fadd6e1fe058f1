"""Requests to a robot: a bounded number under way, newer ones in place of older ones that wait."""

from __future__ import annotations

import pytest
from twisted.internet.task import Clock

from relay_protocol import link
from relay_server.channels.robot_link import ASK_SECONDS, ASKS, Request, RequestQueue


class Scene:
    def __init__(self) -> None:
        self.clock = Clock()
        self.sent: list[link.Message] = []
        self.asks = RequestQueue(self.clock, self.sent.append)

    def ask(self, number: int, throttle_ms: int = 0) -> None:
        message = link.Subscribe(number=number, topic="/t", throttle_ms=throttle_ms)
        self.asks.ask(Request(("subscribe", number), message, lambda: None))

    @property
    def numbers(self) -> list[int]:
        return [message.number for message in self.sent if isinstance(message, link.Subscribe)]


@pytest.fixture
def scene() -> Scene:
    return Scene()


def test_no_more_than_so_many_are_under_way(scene: Scene) -> None:
    """The rest follows answer by answer, in order."""
    for number in range(ASKS + 3):
        scene.ask(number)
    assert scene.numbers == list(range(ASKS))
    scene.asks.answered(("subscribe", 7))
    assert scene.numbers == list(range(ASKS + 1))


def test_a_change_waits_for_the_answer_and_only_the_newest_goes(scene: Scene) -> None:
    """A client that changes its mind a thousand times costs the robot two requests."""
    for throttle in range(1000):
        scene.ask(1, throttle)
    assert len(scene.sent) == 1
    scene.asks.answered(("subscribe", 1))
    assert scene.sent[1:] == [link.Subscribe(number=1, topic="/t", throttle_ms=999)]


def test_what_only_waited_was_never_asked(scene: Scene) -> None:
    """Taking it back costs the robot nothing; what is under way it must be told."""
    for number in range(ASKS + 1):
        scene.ask(number)
    assert scene.asks.withdraw(("subscribe", ASKS)) is False
    assert scene.asks.withdraw(("subscribe", 0)) is True
    scene.asks.answered(("subscribe", 3))
    assert ASKS not in scene.numbers


def test_a_robot_that_does_not_answer_holds_up_nobody_for_long(scene: Scene) -> None:
    """Requests without an answer stop counting after a while."""
    for number in range(ASKS + 1):
        scene.ask(number)
    scene.clock.advance(ASK_SECONDS + 1)
    assert ASKS in scene.numbers


def test_nothing_is_left_after_the_link(scene: Scene) -> None:
    """A new link begins anew."""
    for number in range(ASKS + 1):
        scene.ask(number)
    scene.asks.reset()
    assert scene.clock.getDelayedCalls() == []
    scene.ask(5)
    assert scene.numbers[-1] == 5
