"""Requests for key frames: at once for a new viewer, with growing pauses for a slow one."""

from __future__ import annotations

import pytest
from twisted.internet.task import Clock

from relay_protocol import link
from relay_server.video.frame_waits import (
    ALONE_KEY_SECONDS,
    KEY_SECONDS,
    MAX_KEY_SECONDS,
    STEADY_SECONDS,
    Keyframes,
)
from relay_server.video.stream import CameraStream
from tests.worlds.relay import MemoryLink, World
from tests.worlds.viewers import DELTA, KEY, Watcher, robot_comes, robot_joins, shows

H264 = link.VideoSettings(codec="h264")
PLAYING = link.StreamStatus(width=32, height=24, quality=80)
STEP = 1 / 8


class Robot:
    """A robot that sends each requested key frame shortly after, and the times of requests in seconds."""

    def __init__(self) -> None:
        self.clock = Clock()
        self.keys = Keyframes(self.clock, self._asked, lambda: self.shared)
        self.asked: list[float] = []
        self.shared = True
        """Whether others watch too."""
        self.slow: list[Watcher] = []
        """Leave out a picture a moment after each key frame."""

    def _asked(self) -> None:
        self.asked.append(self.clock.seconds())
        self.clock.callLater(STEP, self.makes)

    def makes(self) -> None:
        """Sends a key frame to all waiting viewers."""
        for each in self.slow:
            self.keys.keyframe_shown(each)
            self.clock.callLater(STEP, self.keys.frame_dropped, each)

    def runs(self, seconds: float) -> None:
        """Lets time pass."""
        for _ in range(round(seconds / STEP)):
            self.clock.advance(STEP)

    @property
    def pauses(self) -> list[float]:
        """Pauses between the requests."""
        return [later - earlier for earlier, later in zip(self.asked, self.asked[1:], strict=False)]


@pytest.fixture
def robot() -> Robot:
    """A robot without requests."""
    return Robot()


def test_key_frames_for_a_slow_viewer_become_rarer(robot: Robot) -> None:
    """After 0.5 s, then twice as long each time, up to 8 s."""
    robot.slow = [Watcher()]
    robot.keys.frame_dropped(robot.slow[0])
    robot.runs(32)
    assert robot.asked[0] == 0
    assert robot.pauses == [KEY_SECONDS, 1, 2, 4, MAX_KEY_SECONDS, MAX_KEY_SECONDS, MAX_KEY_SECONDS]


def test_key_frames_for_a_single_viewer_come_once_a_second(robot: Robot) -> None:
    """However slow it is; with another viewer they become rare again."""
    robot.shared = False
    robot.slow = [Watcher()]
    robot.keys.frame_dropped(robot.slow[0])
    robot.runs(8)
    assert robot.pauses[0] == KEY_SECONDS
    assert set(robot.pauses[1:]) == {ALONE_KEY_SECONDS}
    robot.shared = True
    robot.asked.clear()
    robot.runs(3 * MAX_KEY_SECONDS)
    assert set(robot.pauses) == {MAX_KEY_SECONDS}


def test_last_user_waits_no_longer_for_others(robot: Robot) -> None:
    """Its pause ends within a second."""
    robot.slow = [Watcher()]
    robot.keys.frame_dropped(robot.slow[0])
    robot.runs(17)
    robot.shared = False
    before, now = len(robot.asked), robot.clock.seconds()
    robot.runs(ALONE_KEY_SECONDS)
    assert len(robot.asked) > before
    assert robot.asked[before] - now <= ALONE_KEY_SECONDS


def test_key_frames_for_many_slow_viewers_are_requested_together(robot: Robot) -> None:
    """One key frame serves all waiting viewers."""
    robot.slow = [Watcher() for _ in range(30)]
    for number, each in enumerate(robot.slow):
        robot.clock.callLater(number * STEP / 10, robot.keys.frame_dropped, each)
    robot.runs(60)
    robot.asked.clear()
    robot.runs(10 * MAX_KEY_SECONDS)
    assert len(robot.asked) == 10


def test_a_slow_viewer_gets_a_key_frame_that_comes_anyway(robot: Robot) -> None:
    """No request follows when its pause is over."""
    slow = Watcher()
    for _ in range(3):
        robot.keys.frame_dropped(slow)
        robot.keys.keyframe_shown(slow)
    robot.keys.frame_dropped(slow)
    assert robot.keys.is_waiting(slow)
    robot.keys.keyframe_shown(slow)
    robot.runs(20)
    assert robot.asked == [0]


def test_recovered_viewer_is_no_longer_slow(robot: Robot) -> None:
    """Its next dropped frame causes a request at once, as the first time; a shorter recovery is not enough."""
    slow = Watcher()

    def keeps_up(seconds: float) -> float:
        robot.keys.keyframe_shown(slow)
        robot.runs(seconds)
        before, now = len(robot.asked), robot.clock.seconds()
        robot.keys.frame_dropped(slow)
        while len(robot.asked) == before:
            robot.runs(STEP)
        return robot.asked[-1] - now

    robot.keys.frame_dropped(slow)
    assert [keeps_up(0) for _ in range(6)] == [0.5, 1, 2, 4, 8, 8]
    assert keeps_up(STEADY_SECONDS - 4) == 2
    assert keeps_up(STEADY_SECONDS) == 0
    assert keeps_up(0) == KEY_SECONDS


def test_new_viewer_does_not_wait_for_a_slow_one(robot: Robot) -> None:
    """A request for it is sent at once."""
    slow = Watcher()
    robot.keys.frame_dropped(slow)
    for _ in range(5):
        robot.runs(MAX_KEY_SECONDS)
        robot.keys.keyframe_shown(slow)
        robot.keys.frame_dropped(slow)
    robot.runs(1)
    robot.asked.clear()
    now = robot.clock.seconds()
    robot.keys.request(Watcher())
    assert robot.asked == [now]


def test_gone_client_is_no_longer_requested_for(robot: Robot) -> None:
    """Its slowness is forgotten too."""
    slow = Watcher()
    robot.keys.frame_dropped(slow)
    robot.keys.keyframe_shown(slow)
    robot.keys.frame_dropped(slow)
    robot.keys.remove(slow)
    robot.runs(20)
    assert robot.asked == [0]
    robot.keys.frame_dropped(slow)
    assert robot.asked == [0, 20]


def begun(world: World, viewer: Watcher, *others: Watcher) -> tuple[CameraStream, MemoryLink]:
    """An H.264 stream whose first key frame these viewers have seen, and the robot's side of it."""
    robot_comes(world)
    stream = viewer.watch(world, H264)
    for each in others:
        each.watch(world, H264)
    end = robot_joins(world)
    stream.message_received(PLAYING)
    shows(world, stream, 0, KEY)
    return stream, end


def test_slow_viewer_does_not_set_the_key_frame_rate(world: World) -> None:
    """Seven requests in 30 s, not two per second."""
    slow, fast = Watcher(), Watcher()
    stream, end = begun(world, slow, fast)
    keys = 0
    for number in range(1, 300):
        asked = len(end.take(link.RequestKeyFrame))
        keys += asked
        shows(world, stream, number, KEY if asked else DELTA)
        if slow.pictures[-1].number == number:
            stream.request_keyframe(slow)
        world.clock.advance(0.1)
    assert keys == 7
    assert fast.numbers == list(range(300))


def test_a_single_slow_viewer_gets_more_frames(world: World) -> None:
    """Nearly one request per second in 30 s."""
    slow = Watcher()
    stream, end = begun(world, slow)
    for number in range(1, 300):
        shows(world, stream, number, KEY if end.take(link.RequestKeyFrame) else DELTA)
        if slow.pictures[-1].number == number:
            stream.request_keyframe(slow)
        world.clock.advance(0.1)
    assert sum(each.key for each in slow.pictures) > 20


def test_delay_of_the_robot_is_not_the_viewers(world: World) -> None:
    """When the robot's uplink is on time again, a key frame is requested at once."""
    watcher = Watcher()
    stream, end = begun(world, watcher)
    for number in range(1, 20):
        shows(world, stream, number, KEY if end.take(link.RequestKeyFrame) else DELTA, late=1.0 + number % 5)
        if watcher.pictures[-1].number == number:
            stream.request_keyframe(watcher)
        world.clock.advance(KEY_SECONDS)
    end.take(link.RequestKeyFrame)
    shows(world, stream, 20, KEY)
    world.clock.advance(KEY_SECONDS)
    stream.request_keyframe(watcher)
    assert len(end.take(link.RequestKeyFrame)) == 1
