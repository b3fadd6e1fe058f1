"""One camera for many streams: its newest frame, and reports about it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from twisted.internet.task import Clock

from relay_protocol.errors import Invalid
from robot_client.camera.frame import CHECK_INTERVAL, FIRST_FRAME_SECONDS, Frame, FrameFormat, LatestFrame
from robot_client.camera.ipc import CameraSeen


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

    def withhold(self, stamp: int) -> None:
        self.feed.withhold(Frame(stamp, self.clock.seconds(), lambda: FrameFormat("rgb8", 64, 48), unread))

    def turn(self) -> None:
        """Runs the reactor's pending calls."""
        called, self.called[:] = list(self.called), []
        for each in called:
            each()


@pytest.fixture
def scene() -> Scene:
    return Scene()


def test_only_the_newest_frame_reaches_the_reactor(scene: Scene) -> None:
    """For any number of frames while it was busy, one call delivers the last."""
    for stamp in (1, 2, 3):
        scene.put(stamp)
    assert len(scene.called) == 1
    scene.turn()
    assert scene.got == [3]
    scene.put(4)
    scene.turn()
    assert scene.got == [3, 4]


def test_first_look_is_reported_at_once_and_the_rate_later(scene: Scene) -> None:
    """Unchanged values are not reported again."""
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
def test_rate_is_reported_also_of_slow_cameras(scene: Scene, seconds: float) -> None:
    """It is measured by the time between frames, and reported as soon as there are two."""
    scene.clock.pump([0.04] * 30)
    for stamp in range(2 if seconds > CHECK_INTERVAL else 60):
        scene.put(stamp)
        scene.turn()
        scene.clock.pump([0.04] * round(seconds / 0.04))
    scene.clock.advance(CHECK_INTERVAL)
    assert scene.seen[-1].fps == pytest.approx(1 / seconds, rel=0.05)


@pytest.mark.parametrize("fps", [20, 0.05])
def test_camera_that_gives_no_more_has_no_rate(scene: Scene, fps: float) -> None:
    """After a silence of more than two frame intervals; viewers need not wait as for a slow camera."""
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
    scene.clock.advance(CHECK_INTERVAL)
    assert scene.feed.fps == pytest.approx(fps, rel=0.05)


def test_latest_frame_holds_until_the_next_is_overdue(scene: Scene) -> None:
    """Two and a half frame intervals; ten seconds after a single frame."""
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
    scene.clock.advance(2 * (FIRST_FRAME_SECONDS + 1))
    latest = scene.feed.latest()
    assert latest is not None
    assert latest.stamp == 2
    scene.clock.advance(FIRST_FRAME_SECONDS)
    assert scene.feed.latest() is None


def test_frame_of_a_quick_camera_holds_for_a_moment(scene: Scene) -> None:
    """The next one would have arrived."""
    for stamp in range(40):
        scene.clock.advance(0.05)
        scene.put(stamp)
        scene.turn()
    assert scene.feed.latest() is not None
    scene.clock.advance(0.2)
    assert scene.feed.latest() is None


def test_latched_frame_holds_for_ever(scene: Scene) -> None:
    """A new subscriber would get it too."""
    scene.latched = True
    scene.put(1)
    scene.turn()
    scene.clock.advance(86400)
    assert scene.feed.latest() is not None


@pytest.mark.parametrize(("latched", "shown"), [(True, [2]), (False, [])])
def test_latched_frame_that_came_while_it_was_silent_comes_afterwards(
    scene: Scene, latched: bool, shown: list[int]
) -> None:
    """It is sent only once; other cameras send further frames."""
    scene.latched = latched
    scene.withhold(1)
    scene.withhold(2)
    scene.turn()
    assert scene.got == []
    scene.feed.release()
    scene.turn()
    scene.feed.release()
    scene.turn()
    assert scene.got == shown


def test_latest_measurement_is_reported_without_viewers(scene: Scene) -> None:
    """With its time, from which the age follows; a camera without frames has no report."""
    for second in range(1, 4):
        scene.put(second * 10**9)
        scene.turn()
        scene.clock.advance(CHECK_INTERVAL)
    scene.feed.close()
    assert scene.seen[-1] == CameraSeen(camera="/c", encoding="rgb8", width=64, height=48, fps=1.0, at=3.0)
    unseen = Scene()
    unseen.feed.close()
    assert unseen.seen == []


def test_new_size_is_reported(scene: Scene) -> None:
    """Within a second."""
    scene.put(1)
    scene.turn()
    scene.put(2, lambda: FrameFormat("rgb8", 32, 24))
    scene.turn()
    scene.clock.advance(CHECK_INTERVAL)
    assert (scene.seen[-1].width, scene.seen[-1].height) == (32, 24)


def test_an_invalid_frame_is_reported_by_the_streams(scene: Scene) -> None:
    """It is passed on, and there is no report about the camera."""

    def broken() -> FrameFormat:
        raise Invalid("no picture")

    scene.put(1, broken)
    scene.turn()
    assert scene.got == [1]
    assert scene.seen == []


def test_closed_feed_closes_its_source(scene: Scene) -> None:
    """A pending frame is not delivered any more, and no timer is left."""
    scene.put(1)
    scene.feed.listeners.clear()
    scene.feed.close()
    scene.turn()
    assert scene.got == []
    assert scene.closed == 1
    assert scene.clock.getDelayedCalls() == []
