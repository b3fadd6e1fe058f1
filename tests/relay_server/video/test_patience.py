"""Slow cameras and slow rates: how long somebody waits for his first picture, and which one that may be."""

from __future__ import annotations

import pytest
from msgspec import structs

from relay_protocol import link
from relay_server.video.first_frame_timeout import (
    COMING_SECONDS,
    FIRST_PICTURE_SECONDS,
    MOST_SECONDS,
    UNKNOWN_SECONDS,
)
from relay_server.video.frames import STALE_SECONDS
from relay_server.video.ports import NoFrame, StreamRequest
from relay_server.video.stream import CameraStream
from tests.relay_server.memory import World
from tests.relay_server.video.watching import CAMERA, KEY, Watcher, jpeg, robot_comes, robot_joins, shows


def camera_gives(world: World, fps: float) -> None:
    """The robot tells of its camera's rate."""
    world.registry.cameras(world.robot, link.Cameras(cameras=[link.Camera(name=CAMERA, fps=fps)]))


def waits(world: World, watcher: Watcher, before: float = 0.0) -> float:
    """How long it takes until he is told that nothing comes, seconds.

    :param before: for how long he has waited already, seconds
    """
    began = world.clock.seconds()
    while watcher.error is None:
        world.clock.advance(0.5)
    assert isinstance(watcher.error, NoFrame)
    waited = world.clock.seconds() - began
    assert f"has given no picture for {before + waited:.0f} s" in str(watcher.error)
    return waited


def slow_stream(world: World, fps: float = 0.05) -> CameraStream:
    """One that is asked to give few pictures, watched by somebody who has had one."""
    robot_comes(world)
    stream = Watcher().watch(world, link.VideoSettings(fps=fps))
    robot_joins(world)
    stream.message(link.Playing(width=32, height=24, quality=80, fps=fps, source_fps=15))
    shows(world, stream, 1)
    return stream


@pytest.mark.parametrize(
    ("asked", "camera", "seconds"),
    [
        (0.0, 0.0, FIRST_PICTURE_SECONDS),
        (15.0, 30.0, FIRST_PICTURE_SECONDS),
        (0.05, 30.0, 50.0),
        (0.0, 0.04, 62.5),
        (0.05, 0.04, 62.5),
        (0.001, 0.0, MOST_SECONDS),
    ],
)
def test_who_waits_for_a_slow_camera_has_patience(
    world: World, asked: float, camera: float, seconds: float
) -> None:
    """Two and a half pictures' time by what was asked for or told of the camera, ten seconds to two minutes."""
    robot_comes(world)
    camera_gives(world, camera)
    watcher = Watcher()
    watcher.watch(world, link.VideoSettings(fps=asked))
    robot_joins(world)
    assert waits(world, watcher) == seconds


def test_what_is_told_of_the_camera_meanwhile_counts(world: World) -> None:
    """Its rate may be known only once somebody watches."""
    robot_comes(world)
    watcher = Watcher()
    watcher.watch(world)
    robot_joins(world)
    world.clock.advance(FIRST_PICTURE_SECONDS - 1)
    camera_gives(world, 0.1)
    world.clock.advance(24 - FIRST_PICTURE_SECONDS)
    assert watcher.error is None
    assert watcher.stream is not None
    shows(world, watcher.stream, 1)
    world.clock.advance(MOST_SECONDS)
    assert watcher.error is None
    assert watcher.numbers == [1]


def test_patience_is_for_cameras_not_for_robots_that_are_away(world: World) -> None:
    """After ten seconds it is told that there is no robot, whatever rate was asked for."""
    watcher = Watcher()
    watcher.watch(world, link.VideoSettings(fps=0.05))
    world.clock.advance(FIRST_PICTURE_SECONDS)
    assert str(watcher.error) == "robot rover is offline"


@pytest.mark.parametrize("codec", ["jpeg", "h264"])
@pytest.mark.parametrize("goes", [False, True])
def test_a_picture_that_comes_too_late_is_none_for_who_waits(
    world: World, codec: link.Codec, goes: bool
) -> None:
    """When it was the only one he is told so, or that the robot is away, as if none had come."""
    robot_comes(world)
    settings = link.VideoSettings(codec=codec)
    body = KEY if codec == "h264" else None
    served = Watcher(8)
    stream = served.watch(world, settings)
    robot_joins(world)
    stream.message(link.Playing(width=32, height=24, quality=80))
    shows(world, stream, 1, body)
    world.clock.advance(1)
    watcher = Watcher()
    watcher.watch(world, settings)
    world.clock.advance(1)
    shows(world, stream, 2, body, late=5.0)
    assert watcher.numbers == [2]
    stream.start_anew(watcher)
    if goes:
        world.robot_goes()
    world.clock.advance(FIRST_PICTURE_SECONDS)
    assert served.error is None
    if goes:
        assert str(watcher.error) == "robot rover is offline"
    else:
        assert isinstance(watcher.error, NoFrame)


def test_a_recording_takes_what_comes_too_late_to_be_shown(world: World) -> None:
    """And is not told that nothing came."""
    stream = slow_stream(world, 15)
    world.clock.advance(1)
    recording = Watcher()
    stream.attach(recording, StreamRequest(stream.settings, first=True))
    world.clock.advance(1)
    shows(world, stream, 2, late=5.0)
    world.clock.advance(FIRST_PICTURE_SECONDS)
    assert recording.numbers == [2]
    assert recording.error is None


def test_while_parts_of_a_picture_come_it_is_waited_for(world: World) -> None:
    """A large one takes its time on a thin uplink; when no more of it comes, that is told soon."""
    robot_comes(world)
    watcher = Watcher()
    stream = watcher.watch(world, link.VideoSettings(codec="png"))
    robot_joins(world)
    for _ in range(12):
        world.clock.advance(COMING_SECONDS - 1)
        stream.part()
        assert watcher.error is None
    assert waits(world, watcher, 12 * (COMING_SECONDS - 1)) == COMING_SECONDS


def test_parts_of_a_picture_are_not_waited_for_for_ever(world: World) -> None:
    """A robot could send them one by one; who has had a picture is not asked to wait at all."""
    robot_comes(world)
    watcher, served = Watcher(), Watcher(8)
    stream = watcher.watch(world)
    robot_joins(world)
    for _ in range(int(MOST_SECONDS) - 1):
        world.clock.advance(1)
        stream.part()
    assert watcher.error is None
    served.watch(world)
    world.clock.advance(1)
    assert isinstance(watcher.error, NoFrame)
    assert "has given no picture for 120 s" in str(watcher.error)
    shows(world, stream)
    assert served.numbers == [1]
    world.clock.advance(MOST_SECONDS)
    assert served.error is None


def test_who_comes_to_a_slow_stream_sees_its_newest_picture(world: World) -> None:
    """As long as the next one is not due; the stamp tells its age, and it is good as long as one that just came."""
    stream = slow_stream(world)
    stamp = 1.7e9 + world.clock.seconds()
    world.clock.advance(19)
    late = Watcher()
    stream.attach(late, StreamRequest(stream.settings, newest=True))
    late.stream = stream
    world.clock.advance(0)
    (picture,) = late.pictures
    assert picture.stamp == pytest.approx(stamp)
    assert picture.good_until == world.clock.seconds() + STALE_SECONDS
    assert picture.body == jpeg()
    shows(world, stream, 2)
    assert late.numbers == [1, 2]


def test_a_picture_whose_successor_is_overdue_is_shown_to_nobody(world: World) -> None:
    """Nor one of a camera that is not slow, nor to a recording, which did not see it when it came."""
    stream = slow_stream(world)
    world.clock.advance(19)
    recording = Watcher()
    recording.watch(world, stream.settings)
    world.clock.advance(2)
    late = Watcher()
    stream.attach(late, StreamRequest(stream.settings, newest=True))
    world.clock.advance(0)
    fast = slow_stream(world, 5)
    world.clock.advance(1)
    stream.attach(late, StreamRequest(stream.settings, newest=True))
    fast.attach(Watcher(), StreamRequest(fast.settings, newest=True))
    world.clock.advance(0)
    assert recording.pictures == []
    assert late.pictures == []


def test_a_picture_that_is_the_only_one_so_far_holds_for_a_while(world: World) -> None:
    """For half a minute, because nobody knows yet when the next one comes."""
    robot_comes(world)
    stream = Watcher().watch(world)
    robot_joins(world)
    stream.message(link.Playing(width=32, height=24, quality=80))
    seen = []
    for number, seconds in ((1, UNKNOWN_SECONDS - 1), (1, UNKNOWN_SECONDS + 1), (2, 1)):
        shows(world, stream, number)
        world.clock.advance(seconds)
        late = Watcher()
        stream.attach(late, StreamRequest(stream.settings, newest=True))
        world.clock.advance(0)
        seen.append(late.numbers)
        stream.detach(late)
    assert seen == [[1], [], []]


def test_a_camera_that_gave_one_picture_and_no_more_is_waited_for_no_longer_than_others(world: World) -> None:
    """Nobody told or asked for a slow rate."""
    robot_comes(world)
    stream = Watcher().watch(world)
    robot_joins(world)
    stream.message(link.Playing(width=32, height=24, quality=80))
    shows(world, stream, 1)
    world.clock.advance(UNKNOWN_SECONDS + 1)
    late = Watcher()
    stream.attach(late, StreamRequest(stream.settings, newest=True))
    late.stream = stream
    assert waits(world, late) == FIRST_PICTURE_SECONDS


def test_a_camera_that_has_died_is_no_slow_one(world: World) -> None:
    """Its rate seems to fall, but what came was told as fast."""
    robot_comes(world)
    stream = Watcher().watch(world)
    robot_joins(world)
    stream.message(link.Playing(width=32, height=24, quality=80, source_fps=15))
    shows(world, stream, 1)
    world.clock.advance(5)
    camera_gives(world, 0.1)
    late = Watcher()
    stream.attach(late, StreamRequest(stream.settings, newest=True))
    world.clock.advance(0)
    assert late.pictures == []


@pytest.mark.parametrize("newest", [True, False])
def test_a_picture_that_its_publisher_keeps_is_shown_to_all_who_come(world: World, newest: bool) -> None:
    """To a recording, too: there may never be another one; the stamp tells its age."""
    robot_comes(world)
    stream = Watcher().watch(world)
    robot_joins(world)
    stream.message(link.Playing(width=32, height=24, quality=80, latched=True))
    shows(world, stream, 1)
    shows(world, stream, 2)
    stamp = 1.7e9 + world.clock.seconds()
    world.clock.advance(86400)
    late = Watcher()
    stream.attach(late, StreamRequest(stream.settings, newest=newest))
    world.clock.advance(0)
    (picture,) = late.pictures
    assert picture.number == 2
    assert picture.stamp == pytest.approx(stamp)
    assert picture.good_until == world.clock.seconds() + STALE_SECONDS


def test_a_picture_that_is_kept_no_more_is_shown_to_nobody(world: World) -> None:
    """Its publisher is another one now."""
    robot_comes(world)
    stream = Watcher().watch(world)
    robot_joins(world)
    stream.message(link.Playing(width=32, height=24, quality=80, latched=True))
    shows(world, stream, 1)
    stream.message(link.Playing(width=32, height=24, quality=80))
    world.clock.advance(UNKNOWN_SECONDS + 1)
    late = Watcher()
    stream.attach(late, StreamRequest(stream.settings, newest=True))
    world.clock.advance(0)
    assert late.pictures == []


def test_a_picture_that_was_kept_while_it_must_not_be_shown_is_not_late(world: World) -> None:
    """It is no fault of the network's how old it is, as long as no other one follows soon."""
    robot_comes(world)
    watcher = Watcher()
    stream = watcher.watch(world)
    robot_joins(world)
    lateness = []
    playing = link.Playing(width=32, height=24, quality=80)
    for fps, latched in ((0.0, True), (0.05, True), (15.0, True), (0.0, False)):
        shows(world, stream)
        stream.message(structs.replace(playing, source_fps=fps, latched=latched))
        world.clock.advance(5)
        shows(world, stream, late=20)
        lateness.append(world.clock.seconds() + STALE_SECONDS - watcher.pictures[-1].good_until)
    assert lateness == pytest.approx([0, 0, 20, 20])
