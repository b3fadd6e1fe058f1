"""Requests to a robot: a bounded number open at a time, newer ones in place of queued ones with the same key."""

from __future__ import annotations

import pytest
from twisted.internet.task import Clock

from relay_protocol import link
from relay_server.channels.robot_requests import (
    ANSWER_SECONDS,
    OPEN_REQUESTS,
    RobotRequest,
    RobotRequestQueue,
)


class Scene:
    def __init__(self) -> None:
        self.clock = Clock()
        self.sent: list[link.Message] = []
        self.requests = RobotRequestQueue(self.clock, self.sent.append)

    def subscribe(self, number: int, throttle_ms: int = 0) -> None:
        message = link.Subscribe(number=number, topic="/t", throttle_ms=throttle_ms)
        self.requests.put(RobotRequest(("subscribe", number), message, lambda: None))

    @property
    def numbers(self) -> list[int]:
        return [message.number for message in self.sent if isinstance(message, link.Subscribe)]


@pytest.fixture
def scene() -> Scene:
    return Scene()


def test_requests_over_the_limit_follow_answer_by_answer_in_order(scene: Scene) -> None:
    for number in range(OPEN_REQUESTS + 3):
        scene.subscribe(number)
    assert scene.numbers == list(range(OPEN_REQUESTS))
    scene.requests.answered(("subscribe", 7))
    assert scene.numbers == list(range(OPEN_REQUESTS + 1))


def test_of_many_changes_while_a_request_is_open_only_the_newest_is_sent(scene: Scene) -> None:
    for throttle in range(1000):
        scene.subscribe(1, throttle)
    assert len(scene.sent) == 1
    scene.requests.answered(("subscribe", 1))
    assert scene.sent[1:] == [link.Subscribe(number=1, topic="/t", throttle_ms=999)]


def test_a_queued_request_that_is_withdrawn_is_never_sent(scene: Scene) -> None:
    for number in range(OPEN_REQUESTS + 1):
        scene.subscribe(number)
    assert scene.requests.withdraw(("subscribe", OPEN_REQUESTS)) is False
    assert scene.requests.withdraw(("subscribe", 0)) is True
    scene.requests.answered(("subscribe", 3))
    assert OPEN_REQUESTS not in scene.numbers


def test_requests_without_an_answer_stop_counting_after_a_while(scene: Scene) -> None:
    for number in range(OPEN_REQUESTS + 1):
        scene.subscribe(number)
    scene.clock.advance(ANSWER_SECONDS + 1)
    assert OPEN_REQUESTS in scene.numbers


def test_a_reset_forgets_all_requests_and_the_timer(scene: Scene) -> None:
    for number in range(OPEN_REQUESTS + 1):
        scene.subscribe(number)
    scene.requests.reset()
    assert scene.clock.getDelayedCalls() == []
    scene.subscribe(5)
    assert scene.numbers[-1] == 5
