"""One camera for many streams: the newest picture, and what is told of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from twisted.internet.task import Clock

from relay_protocol.errors import Invalid
from robot_client.camera.feed import LOOK_EVERY, Feed
from robot_client.camera.lines import Seen
from robot_client.camera.shot import Look, Shot


def unread() -> Any:
    raise AssertionError("nobody here reads pixels")


class Scene:
    def __init__(self) -> None:
        self.clock = Clock()
        self.called: list[Callable[[], None]] = []
        self.seen: list[Seen] = []
        self.got: list[int] = []
        self.closed = 0
        self.feed = Feed("/c", self.clock, self.called.append, self.seen.append)
        self.feed.source = self
        self.feed.listeners.add(lambda shot: self.got.append(shot.stamp))

    def close(self) -> None:
        self.closed += 1

    def put(self, stamp: int, look: Callable[[], Look] = lambda: Look("rgb8", 64, 48)) -> None:
        self.feed.put(Shot(stamp, self.clock.seconds(), look, unread))

    def turn(self) -> None:
        """Let the reactor do what it was called for."""
        called, self.called[:] = list(self.called), []
        for each in called:
            each()


@pytest.fixture
def scene() -> Scene:
    return Scene()


def test_only_the_newest_picture_reaches_the_reactor(scene: Scene) -> None:
    """However many came while it was busy, it is called once, and has the last."""
    for stamp in (1, 2, 3):
        scene.put(stamp)
    assert len(scene.called) == 1
    scene.turn()
    assert scene.got == [3]
    scene.put(4)
    scene.turn()
    assert scene.got == [3, 4]


def test_first_look_is_told_at_once_and_the_rate_later(scene: Scene) -> None:
    """What stays as it was is not told again."""
    scene.put(2_500_000_000)
    scene.turn()
    assert scene.seen == [Seen(camera="/c", encoding="rgb8", width=64, height=48, fps=0.0, at=2.5)]
    for _ in range(10):
        for stamp in range(10):
            scene.put(stamp)
        scene.turn()
        scene.clock.advance(LOOK_EVERY)
    assert 2 <= len(scene.seen) <= 4
    assert scene.feed.fps == pytest.approx(10, rel=0.1)


def test_what_was_seen_last_is_told_when_nobody_watches_any_more(scene: Scene) -> None:
    """With the time, by which others know how old it is; of what was never seen there is nothing to tell."""
    for second in range(1, 4):
        scene.put(second * 10**9)
        scene.turn()
        scene.clock.advance(LOOK_EVERY)
    scene.feed.close()
    assert scene.seen[-1] == Seen(camera="/c", encoding="rgb8", width=64, height=48, fps=1.0, at=3.0)
    unseen = Scene()
    unseen.feed.close()
    assert unseen.seen == []


def test_new_size_is_told(scene: Scene) -> None:
    """Within a second."""
    scene.put(1)
    scene.turn()
    scene.put(2, lambda: Look("rgb8", 32, 24))
    scene.turn()
    scene.clock.advance(LOOK_EVERY)
    assert (scene.seen[-1].width, scene.seen[-1].height) == (32, 24)


def test_picture_that_is_none_is_for_the_streams_to_tell(scene: Scene) -> None:
    """It is passed on, and nothing is told of the camera."""

    def broken() -> Look:
        raise Invalid("no picture")

    scene.put(1, broken)
    scene.turn()
    assert scene.got == [1]
    assert scene.seen == []


def test_closed_feed_lets_its_source_go(scene: Scene) -> None:
    """A picture under way then reaches nobody who has left, and no timer is left."""
    scene.put(1)
    scene.feed.listeners.clear()
    scene.feed.close()
    scene.turn()
    assert scene.got == []
    assert scene.closed == 1
    assert scene.clock.getDelayedCalls() == []
