"""Slow cameras and slow rates: how long a viewer waits for a first frame, and which frames are accepted."""

from __future__ import annotations

import pytest
from msgspec import structs

from relay_protocol import link
from relay_server.video.errors import NoFrame
from relay_server.video.frame_waits import (
    FIRST_FRAME_SECONDS,
    MAX_WAIT_SECONDS,
    PART_SECONDS,
    UNKNOWN_RATE_SECONDS,
)
from relay_server.video.frames import STALE_SECONDS
from relay_server.video.stream import CameraStream, StreamRequest
from tests.worlds.relay import World
from tests.worlds.viewers import CAMERA, KEY, Watcher, jpeg, robot_comes, robot_joins, shows


def camera_gives(world: World, fps: float) -> None:
    """The robot reports its camera's rate."""
    world.registry.cameras(world.robot, link.Cameras(cameras=[link.Camera(name=CAMERA, fps=fps)]))


def waits(world: World, watcher: Watcher, before: float = 0.0) -> float:
    """Seconds until the viewer gets the error that no frame arrived.

    :param before: seconds of waiting so far
    """
    began = world.clock.seconds()
    while watcher.error is None:
        world.clock.advance(0.5)
    assert isinstance(watcher.error, NoFrame)
    waited = world.clock.seconds() - began
    assert f"has sent no frame for {before + waited:.0f} s" in str(watcher.error)
    return waited


def slow_stream(world: World, fps: float = 0.05) -> CameraStream:
    """A stream with a low requested rate, and a viewer that has had one frame."""
    robot_comes(world)
    stream = Watcher().watch(world, link.VideoSettings(fps=fps))
    robot_joins(world)
    stream.message_received(link.StreamStatus(width=32, height=24, quality=80, fps=fps, source_fps=15))
    shows(world, stream, 1)
    return stream


@pytest.mark.parametrize(
    ("asked", "camera", "seconds"),
    [
        (0.0, 0.0, FIRST_FRAME_SECONDS),
        (15.0, 30.0, FIRST_FRAME_SECONDS),
        (0.05, 30.0, 50.0),
        (0.0, 0.04, 62.5),
        (0.05, 0.04, 62.5),
        (0.001, 0.0, MAX_WAIT_SECONDS),
    ],
)
def test_viewer_of_a_slow_camera_waits_longer(
    world: World, asked: float, camera: float, seconds: float
) -> None:
    """Two and a half frame intervals, by the requested or reported rate: 10 s to 2 min."""
    robot_comes(world)
    camera_gives(world, camera)
    watcher = Watcher()
    watcher.watch(world, link.VideoSettings(fps=asked))
    robot_joins(world)
    assert waits(world, watcher) == seconds


def test_camera_description_received_meanwhile_counts(world: World) -> None:
    """A rate may be reported only after the viewer has joined."""
    robot_comes(world)
    watcher = Watcher()
    watcher.watch(world)
    robot_joins(world)
    world.clock.advance(FIRST_FRAME_SECONDS - 1)
    camera_gives(world, 0.1)
    world.clock.advance(24 - FIRST_FRAME_SECONDS)
    assert watcher.error is None
    assert watcher.stream is not None
    shows(world, watcher.stream, 1)
    world.clock.advance(MAX_WAIT_SECONDS)
    assert watcher.error is None
    assert watcher.numbers == [1]


def test_patience_is_for_cameras_not_for_robots_that_are_away(world: World) -> None:
    """After 10 s the error says that the robot is offline, for any requested rate."""
    watcher = Watcher()
    watcher.watch(world, link.VideoSettings(fps=0.05))
    world.clock.advance(FIRST_FRAME_SECONDS)
    assert str(watcher.error) == "robot rover is offline"


@pytest.mark.parametrize("codec", ["jpeg", "h264"])
@pytest.mark.parametrize("goes", [False, True])
def test_a_frame_that_comes_too_late_is_not_shown_to_waiting_viewers(
    world: World, codec: link.Codec, goes: bool
) -> None:
    """If there was no other, the viewer gets the error of no frame, or of an offline robot."""
    robot_comes(world)
    settings = link.VideoSettings(codec=codec)
    body = KEY if codec == "h264" else None
    served = Watcher(8)
    stream = served.watch(world, settings)
    robot_joins(world)
    stream.message_received(link.StreamStatus(width=32, height=24, quality=80))
    shows(world, stream, 1, body)
    world.clock.advance(1)
    watcher = Watcher()
    watcher.watch(world, settings)
    world.clock.advance(1)
    shows(world, stream, 2, body, late=5.0)
    assert watcher.numbers == [2]
    stream.request_keyframe(watcher)
    if goes:
        world.robot_goes()
    world.clock.advance(FIRST_FRAME_SECONDS)
    assert served.error is None
    if goes:
        assert str(watcher.error) == "robot rover is offline"
    else:
        assert isinstance(watcher.error, NoFrame)


def test_a_recording_takes_what_comes_too_late_to_be_shown(world: World) -> None:
    """The recording gets no error."""
    stream = slow_stream(world, 15)
    world.clock.advance(1)
    recording = Watcher()
    stream.attach(recording, StreamRequest(stream.settings, first=True))
    world.clock.advance(1)
    shows(world, stream, 2, late=5.0)
    world.clock.advance(FIRST_FRAME_SECONDS)
    assert recording.numbers == [2]
    assert recording.error is None


def test_while_parts_of_a_frame_come_it_is_waited_for(world: World) -> None:
    """A large frame takes long on a slow uplink; the error comes soon after its parts stop."""
    robot_comes(world)
    watcher = Watcher()
    stream = watcher.watch(world, link.VideoSettings(codec="png"))
    robot_joins(world)
    for _ in range(12):
        world.clock.advance(PART_SECONDS - 1)
        stream.frame_part_received()
        assert watcher.error is None
    assert waits(world, watcher, 12 * (PART_SECONDS - 1)) == PART_SECONDS


def test_the_wait_for_parts_of_a_frame_is_bounded(world: World) -> None:
    """A robot could send parts endlessly. A viewer that has had a frame is not affected."""
    robot_comes(world)
    watcher, served = Watcher(), Watcher(8)
    stream = watcher.watch(world)
    robot_joins(world)
    for _ in range(int(MAX_WAIT_SECONDS) - 1):
        world.clock.advance(1)
        stream.frame_part_received()
    assert watcher.error is None
    served.watch(world)
    world.clock.advance(1)
    assert isinstance(watcher.error, NoFrame)
    assert "has sent no frame for 120 s" in str(watcher.error)
    shows(world, stream)
    assert served.numbers == [1]
    world.clock.advance(MAX_WAIT_SECONDS)
    assert served.error is None


def test_new_viewer_of_a_slow_stream_gets_its_newest_frame(world: World) -> None:
    """As long as the next one is not due. The stamp has its age, and it counts as a new frame."""
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


def test_a_frame_whose_successor_is_overdue_is_not_shown(world: World) -> None:
    """Nor is one of a fast camera, nor any to a recording, which gets only new frames."""
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


def test_a_frame_that_is_the_only_one_so_far_holds_for_a_while(world: World) -> None:
    """For 30 s, because the rate is unknown."""
    robot_comes(world)
    stream = Watcher().watch(world)
    robot_joins(world)
    stream.message_received(link.StreamStatus(width=32, height=24, quality=80))
    seen = []
    for number, seconds in ((1, UNKNOWN_RATE_SECONDS - 1), (1, UNKNOWN_RATE_SECONDS + 1), (2, 1)):
        shows(world, stream, number)
        world.clock.advance(seconds)
        late = Watcher()
        stream.attach(late, StreamRequest(stream.settings, newest=True))
        world.clock.advance(0)
        seen.append(late.numbers)
        stream.detach(late)
    assert seen == [[1], [], []]


def test_a_camera_that_gave_one_frame_and_no_more_is_waited_for_no_longer_than_others(world: World) -> None:
    """No slow rate was reported or requested."""
    robot_comes(world)
    stream = Watcher().watch(world)
    robot_joins(world)
    stream.message_received(link.StreamStatus(width=32, height=24, quality=80))
    shows(world, stream, 1)
    world.clock.advance(UNKNOWN_RATE_SECONDS + 1)
    late = Watcher()
    stream.attach(late, StreamRequest(stream.settings, newest=True))
    late.stream = stream
    assert waits(world, late) == FIRST_FRAME_SECONDS


def test_a_camera_that_has_died_is_no_slow_one(world: World) -> None:
    """Its rate seems to fall, but its frames were reported as fast."""
    robot_comes(world)
    stream = Watcher().watch(world)
    robot_joins(world)
    stream.message_received(link.StreamStatus(width=32, height=24, quality=80, source_fps=15))
    shows(world, stream, 1)
    world.clock.advance(5)
    camera_gives(world, 0.1)
    late = Watcher()
    stream.attach(late, StreamRequest(stream.settings, newest=True))
    world.clock.advance(0)
    assert late.pictures == []


@pytest.mark.parametrize("newest", [True, False])
def test_a_latched_frame_is_shown_to_new_viewers(world: World, newest: bool) -> None:
    """To recordings too, since there may never be another; the stamp has its age."""
    robot_comes(world)
    stream = Watcher().watch(world)
    robot_joins(world)
    stream.message_received(link.StreamStatus(width=32, height=24, quality=80, latched=True))
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


def test_a_frame_that_is_latched_no_more_is_not_shown(world: World) -> None:
    """It has another publisher now."""
    robot_comes(world)
    stream = Watcher().watch(world)
    robot_joins(world)
    stream.message_received(link.StreamStatus(width=32, height=24, quality=80, latched=True))
    shows(world, stream, 1)
    stream.message_received(link.StreamStatus(width=32, height=24, quality=80))
    world.clock.advance(UNKNOWN_RATE_SECONDS + 1)
    late = Watcher()
    stream.attach(late, StreamRequest(stream.settings, newest=True))
    world.clock.advance(0)
    assert late.pictures == []


def test_a_frame_stored_during_an_inhibition_is_not_late(world: World) -> None:
    """Its age does not come from the network, as long as no other frame follows soon."""
    robot_comes(world)
    watcher = Watcher()
    stream = watcher.watch(world)
    robot_joins(world)
    lateness = []
    playing = link.StreamStatus(width=32, height=24, quality=80)
    for fps, latched in ((0.0, True), (0.05, True), (15.0, True), (0.0, False)):
        shows(world, stream)
        stream.message_received(structs.replace(playing, source_fps=fps, latched=latched))
        world.clock.advance(5)
        shows(world, stream, late=20)
        lateness.append(world.clock.seconds() + STALE_SECONDS - watcher.pictures[-1].good_until)
    assert lateness == pytest.approx([0, 0, 20, 20])
