"""One camera for many streams: the newest picture, and what is told of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from twisted.internet.task import Clock

from relay_protocol.errors import Invalid
from robot_client.camera.frame import Frame, FrameFormat
from robot_client.camera.ipc import CameraSeen
from robot_client.camera.latest_frame import LOOK_EVERY, UNKNOWN, LatestFrame


def unread() -> Any:
    raise AssertionError("nobody here reads pixels")


class Scene:
    def __init__(self) -> None:
        self.clock = Clock()
        self.called: list[Callable[[], None]] = []
        self.seen: list[CameraSeen] = []
        self.got: list[int] = []
        self.closed = 0
        self.latched = False
        self.feed = LatestFrame("/c", self.clock, self.called.append, self.seen.append)
        self.feed.source = self
        self.feed.listeners.add(lambda shot: self.got.append(shot.stamp))

    def close(self) -> None:
        self.closed += 1

    def put(self, stamp: int, look: Callable[[], FrameFormat] = lambda: FrameFormat("rgb8", 64, 48)) -> None:
        self.feed.put(Frame(stamp, self.clock.seconds(), look, unread))

    def keep(self, stamp: int) -> None:
        self.feed.keep(Frame(stamp, self.clock.seconds(), lambda: FrameFormat("rgb8", 64, 48), unread))

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
    assert scene.seen == [CameraSeen(camera="/c", encoding="rgb8", width=64, height=48, fps=0.0, at=2.5)]
    for stamp in range(100):
        scene.clock.advance(0.1)
        scene.put(stamp)
        scene.turn()
    assert 2 <= len(scene.seen) <= 4
    assert scene.feed.fps == pytest.approx(10, rel=0.1)


@pytest.mark.parametrize("seconds", [0.04, 1, 20])
def test_rate_is_told_also_of_slow_cameras(scene: Scene, seconds: float) -> None:
    """It is the time between pictures that counts, and it is told as soon as there are two."""
    scene.clock.pump([0.04] * 30)
    for stamp in range(2 if seconds > LOOK_EVERY else 60):
        scene.put(stamp)
        scene.turn()
        scene.clock.pump([0.04] * round(seconds / 0.04))
    scene.clock.advance(LOOK_EVERY)
    assert scene.seen[-1].fps == pytest.approx(1 / seconds, rel=0.05)


@pytest.mark.parametrize("fps", [20, 0.05])
def test_camera_that_gives_no_more_has_no_rate(scene: Scene, fps: float) -> None:
    """Once it is silent for more than two of its pictures; nobody need wait for the next one as for a slow camera's."""
    for stamp in range(60):
        scene.clock.pump([0.05] * round(20 / fps))
        scene.put(stamp)
        scene.turn()
    scene.clock.pump([0.05] * round(20 / fps))
    assert scene.feed.fps == pytest.approx(fps, rel=0.05)
    scene.clock.pump([0.5] * round(2 * max(2.5 / fps, 3)))
    assert scene.feed.fps == scene.seen[-1].fps == 0
    for stamp in range(60, 63):
        scene.put(stamp)
        scene.turn()
        scene.clock.pump([0.05] * round(20 / fps))
    scene.clock.advance(LOOK_EVERY)
    assert scene.feed.fps == pytest.approx(fps, rel=0.05)


def test_latest_picture_holds_until_the_next_is_overdue(scene: Scene) -> None:
    """Twice and a half the time between pictures; ten seconds where only one has come."""
    assert scene.feed.latest() is None
    scene.put(1)
    scene.turn()
    scene.clock.advance(9)
    latest = scene.feed.latest()
    assert latest is not None
    assert (latest.stamp, latest.arrived) == (1, 0)
    scene.clock.advance(2)
    assert scene.feed.latest() is None
    scene.put(2)
    scene.turn()
    scene.clock.advance(2 * (UNKNOWN + 1))
    latest = scene.feed.latest()
    assert latest is not None
    assert latest.stamp == 2
    scene.clock.advance(UNKNOWN)
    assert scene.feed.latest() is None


def test_picture_of_a_quick_camera_holds_for_a_moment(scene: Scene) -> None:
    """The next one would have come."""
    for stamp in range(40):
        scene.clock.advance(0.05)
        scene.put(stamp)
        scene.turn()
    assert scene.feed.latest() is not None
    scene.clock.advance(0.2)
    assert scene.feed.latest() is None


def test_latched_picture_holds_for_ever(scene: Scene) -> None:
    """Who subscribed now would get it, too."""
    scene.latched = True
    scene.put(1)
    scene.turn()
    scene.clock.advance(86400)
    assert scene.feed.latest() is not None


@pytest.mark.parametrize(("latched", "shown"), [(True, [2]), (False, [])])
def test_latched_picture_that_came_while_it_was_silent_comes_afterwards(
    scene: Scene, latched: bool, shown: list[int]
) -> None:
    """It comes but once; of other cameras the next ones do."""
    scene.latched = latched
    scene.keep(1)
    scene.keep(2)
    scene.turn()
    assert scene.got == []
    scene.feed.speak()
    scene.turn()
    scene.feed.speak()
    scene.turn()
    assert scene.got == shown


def test_what_was_seen_last_is_told_when_nobody_watches_any_more(scene: Scene) -> None:
    """With the time, by which others know how old it is; of what was never seen there is nothing to tell."""
    for second in range(1, 4):
        scene.put(second * 10**9)
        scene.turn()
        scene.clock.advance(LOOK_EVERY)
    scene.feed.close()
    assert scene.seen[-1] == CameraSeen(camera="/c", encoding="rgb8", width=64, height=48, fps=1.0, at=3.0)
    unseen = Scene()
    unseen.feed.close()
    assert unseen.seen == []


def test_new_size_is_told(scene: Scene) -> None:
    """Within a second."""
    scene.put(1)
    scene.turn()
    scene.put(2, lambda: FrameFormat("rgb8", 32, 24))
    scene.turn()
    scene.clock.advance(LOOK_EVERY)
    assert (scene.seen[-1].width, scene.seen[-1].height) == (32, 24)


def test_picture_that_is_none_is_for_the_streams_to_tell(scene: Scene) -> None:
    """It is passed on, and nothing is told of the camera."""

    def broken() -> FrameFormat:
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
