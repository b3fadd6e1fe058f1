"""When the robot is asked for key frames: at once for who comes, ever more rarely for who is too slow."""

from __future__ import annotations

import pytest
from twisted.internet.task import Clock

from relay_protocol import link
from relay_server.video.keyframes import (
    ALONE_KEY_SECONDS,
    KEY_SECONDS,
    MOST_KEY_SECONDS,
    STEADY_SECONDS,
    Keyframes,
)
from relay_server.video.stream import CameraStream
from tests.relay_server.memory import MemoryLink, World
from tests.relay_server.video.watching import DELTA, KEY, Watcher, robot_comes, robot_joins, shows

H264 = link.VideoSettings(codec="h264")
PLAYING = link.Playing(width=32, height=24, quality=80)
STEP = 1 / 8


class Robot:
    """One that makes each key frame it is asked for a moment later, and when that was, seconds."""

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
        """A key frame, which everybody who waits is shown."""
        for each in self.slow:
            self.keys.shown(each)
            self.clock.callLater(STEP, self.keys.left_out, each)

    def runs(self, seconds: float) -> None:
        """Time goes by."""
        for _ in range(round(seconds / STEP)):
            self.clock.advance(STEP)

    @property
    def pauses(self) -> list[float]:
        """Between the requests."""
        return [later - earlier for earlier, later in zip(self.asked, self.asked[1:], strict=False)]


@pytest.fixture
def robot() -> Robot:
    """Nobody has asked for anything."""
    return Robot()


def test_who_is_too_slow_again_and_again_has_it_asked_ever_more_rarely(robot: Robot) -> None:
    """After half a second, then twice as long each time, at last every eight seconds."""
    robot.slow = [Watcher()]
    robot.keys.left_out(robot.slow[0])
    robot.runs(32)
    assert robot.asked[0] == 0
    assert robot.pauses == [KEY_SECONDS, 1, 2, 4, MOST_KEY_SECONDS, MOST_KEY_SECONDS, MOST_KEY_SECONDS]


def test_who_watches_alone_is_asked_for_once_a_second(robot: Robot) -> None:
    """However slow he is; when somebody else comes it is as rare as ever."""
    robot.shared = False
    robot.slow = [Watcher()]
    robot.keys.left_out(robot.slow[0])
    robot.runs(8)
    assert robot.pauses[0] == KEY_SECONDS
    assert set(robot.pauses[1:]) == {ALONE_KEY_SECONDS}
    robot.shared = True
    robot.asked.clear()
    robot.runs(3 * MOST_KEY_SECONDS)
    assert set(robot.pauses) == {MOST_KEY_SECONDS}


def test_who_is_left_alone_waits_no_longer_for_the_sake_of_others(robot: Robot) -> None:
    """His pause is over within a second."""
    robot.slow = [Watcher()]
    robot.keys.left_out(robot.slow[0])
    robot.runs(17)
    robot.shared = False
    before, now = len(robot.asked), robot.clock.seconds()
    robot.runs(ALONE_KEY_SECONDS)
    assert len(robot.asked) > before
    assert robot.asked[before] - now <= ALONE_KEY_SECONDS


def test_many_who_are_too_slow_are_asked_for_together(robot: Robot) -> None:
    """The key frame of one is for all who wait."""
    robot.slow = [Watcher() for _ in range(30)]
    for number, each in enumerate(robot.slow):
        robot.clock.callLater(number * STEP / 10, robot.keys.left_out, each)
    robot.runs(60)
    robot.asked.clear()
    robot.runs(10 * MOST_KEY_SECONDS)
    assert len(robot.asked) == 10


def test_a_key_frame_that_comes_anyway_is_his_too(robot: Robot) -> None:
    """And nothing is asked for when his pause is over."""
    slow = Watcher()
    for _ in range(3):
        robot.keys.left_out(slow)
        robot.keys.shown(slow)
    robot.keys.left_out(slow)
    assert robot.keys.waits(slow)
    robot.keys.shown(slow)
    robot.runs(20)
    assert robot.asked == [0]


def test_who_kept_up_for_a_while_is_slow_no_more(robot: Robot) -> None:
    """What he leaves out then is asked for at once, as the first time; a while less is not enough."""
    slow = Watcher()

    def keeps_up(seconds: float) -> float:
        robot.keys.shown(slow)
        robot.runs(seconds)
        before, now = len(robot.asked), robot.clock.seconds()
        robot.keys.left_out(slow)
        while len(robot.asked) == before:
            robot.runs(STEP)
        return robot.asked[-1] - now

    robot.keys.left_out(slow)
    assert [keeps_up(0) for _ in range(6)] == [0.5, 1, 2, 4, 8, 8]
    assert keeps_up(STEADY_SECONDS - 4) == 2
    assert keeps_up(STEADY_SECONDS) == 0
    assert keeps_up(0) == KEY_SECONDS


def test_who_comes_waits_for_no_slow_one(robot: Robot) -> None:
    """The robot is asked for him as soon as for anybody."""
    slow = Watcher()
    robot.keys.left_out(slow)
    for _ in range(5):
        robot.runs(MOST_KEY_SECONDS)
        robot.keys.shown(slow)
        robot.keys.left_out(slow)
    robot.runs(1)
    robot.asked.clear()
    now = robot.clock.seconds()
    robot.keys.wants(Watcher())
    assert robot.asked == [now]


def test_who_left_is_asked_for_no_more(robot: Robot) -> None:
    """Nor is his slowness remembered."""
    slow = Watcher()
    robot.keys.left_out(slow)
    robot.keys.shown(slow)
    robot.keys.left_out(slow)
    robot.keys.leaves(slow)
    robot.runs(20)
    assert robot.asked == [0]
    robot.keys.left_out(slow)
    assert robot.asked == [0, 20]


def begun(world: World, viewer: Watcher, *others: Watcher) -> tuple[CameraStream, MemoryLink]:
    """A stream of H.264 whose first key frame these viewers have seen, and the robot's end of it."""
    robot_comes(world)
    stream = viewer.watch(world, H264)
    for each in others:
        each.watch(world, H264)
    end = robot_joins(world)
    stream.message(PLAYING)
    shows(world, stream, 0, KEY)
    return stream, end


def test_one_slow_viewer_sets_nobodys_rate_of_key_frames(world: World) -> None:
    """In half a minute the robot is asked seven times for him, and not twice a second."""
    slow, fast = Watcher(), Watcher()
    stream, end = begun(world, slow, fast)
    keys = 0
    for number in range(1, 300):
        asked = len(end.take(link.KeyFrame))
        keys += asked
        shows(world, stream, number, KEY if asked else DELTA)
        if slow.pictures[-1].number == number:
            stream.start_anew(slow)
        world.clock.advance(0.1)
    assert keys == 7
    assert fast.numbers == list(range(300))


def test_a_slow_viewer_who_is_alone_sees_more(world: World) -> None:
    """In half a minute the robot is asked nearly once a second for him."""
    slow = Watcher()
    stream, end = begun(world, slow)
    for number in range(1, 300):
        shows(world, stream, number, KEY if end.take(link.KeyFrame) else DELTA)
        if slow.pictures[-1].number == number:
            stream.start_anew(slow)
        world.clock.advance(0.1)
    assert sum(each.key for each in slow.pictures) > 20


def test_what_came_too_late_for_everybody_is_nobodys_slowness(world: World) -> None:
    """When the robot's uplink is in time again a key frame is asked for at once."""
    watcher = Watcher()
    stream, end = begun(world, watcher)
    for number in range(1, 20):
        shows(world, stream, number, KEY if end.take(link.KeyFrame) else DELTA, late=1.0 + number % 5)
        if watcher.pictures[-1].number == number:
            stream.start_anew(watcher)
        world.clock.advance(KEY_SECONDS)
    end.take(link.KeyFrame)
    shows(world, stream, 20, KEY)
    world.clock.advance(KEY_SECONDS)
    stream.start_anew(watcher)
    assert len(end.take(link.KeyFrame)) == 1
