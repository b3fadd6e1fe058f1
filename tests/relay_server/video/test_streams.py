"""All streams of a relay: sharing, limits, and viewers without room."""

from __future__ import annotations

import re

import pytest

from relay_protocol import link
from relay_protocol.errors import NotFound, Unavailable
from relay_server.video.errors import TooManyStreamStarts
from relay_server.video.stream import LINGER_SECONDS, STREAM_VIEWERS, CameraStream, StreamState
from relay_server.video.streams import ROBOT_STREAMS, STREAMS_A_SECOND, STREAMS_AT_ONCE, USER_VIEWERS
from tests.worlds.relay import MemoryLink, World
from tests.worlds.viewers import (
    CAMERA,
    OTHER,
    Watcher,
    asked,
    jpeg,
    png,
    robot_comes,
    robot_joins,
    shows,
)


def showing(world: World, width: int, height: int, camera: str = CAMERA, **settings: object) -> CameraStream:
    """An open stream whose frames have this size."""
    wanted = link.VideoSettings(width=width, height=height, **settings)  # type: ignore[arg-type]
    stream = Watcher(user=width).watch(world, wanted, camera)
    robot_joins(world)
    shows(world, stream, 1, png(width, height) if wanted.codec == "png" else jpeg(width, height))
    return stream


def busy(world: World, settings: link.VideoSettings, camera: str = CAMERA) -> Watcher:
    """A viewer of a stream that the robot refuses because it is busy."""
    watcher = Watcher(user=1)
    stream = watcher.watch(world, settings, camera)
    robot_joins(world)
    stream.message_received(link.StreamRefused(reason="two streams are all I can", busy=True))
    assert stream.state is StreamState.CLOSED
    return watcher


def test_equal_requests_share_a_stream(world: World) -> None:
    """Another format, camera or robot is another stream."""
    stream = Watcher().watch(world)
    assert Watcher(8).watch(world, link.VideoSettings(quality=80)) is stream
    small = Watcher().watch(world, link.VideoSettings(width=320))
    rear = Watcher().watch(world, camera=OTHER)
    other = world.registry.robot(2, "digger", "main")
    elsewhere = world.videos.watch(other, CAMERA, link.VideoSettings(), Watcher())
    assert len({stream, small, rear, elsewhere}) == 4
    assert len({each.name for each in world.videos}) == 4
    assert world.videos.streams_of(world.robot) == [stream, small, rear]
    assert world.videos.streams_of(other) == [elsewhere]


def test_a_streams_name_does_not_disclose_their_number(world: World) -> None:
    """The robot receives the name and must not learn about other streams."""
    name = Watcher().watch(world).name
    assert re.fullmatch(r"rover#video[0-9a-f]{8}", name)


def test_a_ticket_is_for_its_stream_alone(world: World) -> None:
    """A ticket of a channel is different."""
    robot_comes(world)
    first = Watcher().watch(world)
    second = Watcher().watch(world, camera=OTHER)
    one, two = asked(world)
    assert world.videos.redeem(two.ticket) is second
    assert world.videos.redeem(one.ticket) is first
    assert world.videos.redeem(one.ticket) is None
    assert world.videos.redeem("invented") is None


def test_a_user_watches_a_robot_so_many_times(world: World) -> None:
    """Over all streams; other users still may, and so may this one after leaving one."""
    watchers = [Watcher() for _ in range(USER_VIEWERS)]
    for number, watcher in enumerate(watchers):
        watcher.watch(world, link.VideoSettings(width=100 + number % 3))
    with pytest.raises(Unavailable, match="you watch robot rover 32 times already"):
        Watcher().watch(world)
    Watcher(8).watch(world)
    watchers[0].leave()
    Watcher().watch(world)


def test_streams_of_a_robot_are_limited_per_user(world: World) -> None:
    """Unusual formats and missing cameras count; streams of other users may still be viewed."""
    robot_comes(world)
    for number in range(12):
        Watcher().watch(world, camera=f"/nowhere/{number}")
    with pytest.raises(Unavailable, match="you watch 12 streams of robot rover alone"):
        Watcher().watch(world)
    shared = Watcher(8).watch(world)
    assert Watcher().watch(world) is shared
    Watcher(8).watch(world, camera="/nowhere/0")
    Watcher().watch(world, camera=OTHER)


def test_a_user_can_not_take_all_streams_of_a_robot(world: World) -> None:
    """Three quarters of the robot's limit, rounded up; all if the limit is one or two."""
    robot_comes(world, streams=4)
    for width in (20, 30, 40):
        Watcher().watch(world, link.VideoSettings(width=width))
    with pytest.raises(Unavailable, match="you watch 3 streams"):
        Watcher().watch(world, link.VideoSettings(width=50))
    Watcher(8).watch(world, link.VideoSettings(width=50))
    with pytest.raises(Unavailable, match="has 4 streams open, the most it can"):
        Watcher(9).watch(world, link.VideoSettings(width=60))
    for streams in (1, 2):
        world.videos.close()
        robot_comes(world, streams=streams)
        for number in range(streams):
            Watcher().watch(world, camera=f"/nowhere/{number}")
        with pytest.raises(Unavailable, match=f"you watch {streams} streams? of robot rover"):
            Watcher().watch(world)


def test_plural_needs_more_than_one(world: World) -> None:
    """This concerns the text of the error."""
    robot_comes(world, streams=1)
    Watcher().watch(world)
    with pytest.raises(Unavailable, match="you watch 1 stream of robot rover alone"):
        Watcher().watch(world, camera=OTHER)
    with pytest.raises(Unavailable, match="robot rover has 1 stream open"):
        Watcher(8).watch(world, camera=OTHER)


def test_a_user_begins_streams_only_so_fast(world: World) -> None:
    """Ended streams count. The error has the time to wait. Other robots and existing streams are still
    available.
    """
    robot_comes(world)
    for number in range(STREAMS_AT_ONCE):
        watcher = Watcher()
        watcher.watch(world, link.VideoSettings(width=16 + number))
        watcher.leave()
    shared = Watcher(8).watch(world)
    assert len(world.videos.streams_of(world.robot)) == 1
    with pytest.raises(TooManyStreamStarts, match="you start streams of robot rover") as caught:
        Watcher().watch(world, link.VideoSettings(width=16))
    assert caught.value.retry_after == 1 / STREAMS_A_SECOND
    assert Watcher().watch(world) is shared
    other = world.registry.robot(2, "digger", "main")
    world.videos.watch(other, CAMERA, link.VideoSettings(), Watcher())
    world.clock.advance(caught.value.retry_after)
    Watcher().watch(world, link.VideoSettings(width=16))
    with pytest.raises(TooManyStreamStarts):
        Watcher().watch(world, link.VideoSettings(width=17))


def test_a_page_with_many_cameras_may_be_loaded_again_and_again(world: World) -> None:
    """Every few seconds without end, each camera alternately in two formats."""
    robot_comes(world)
    for load in range(100):
        watchers = [Watcher() for _ in range(12)]
        for number, watcher in enumerate(watchers):
            watcher.watch(world, link.VideoSettings(width=16 + load % 2), f"/camera/{number}")
        world.clock.advance(6)
        for watcher in watchers:
            watcher.leave()


def test_a_robot_has_so_many_streams(world: World) -> None:
    """At the limit a stream without viewers is closed; otherwise the viewer gets the nearest one, if any."""
    robot_comes(world)
    streams = [showing(world, 20 + number, 16) for number in range(ROBOT_STREAMS)]
    late = Watcher(1)
    assert late.watch(world, link.VideoSettings(width=33, height=17)) is streams[15]
    with pytest.raises(Unavailable, match="robot rover has 16 streams open"):
        Watcher(1).watch(world, camera=OTHER)
    (only,) = streams[3].viewers
    streams[3].detach(only)
    assert Watcher(1).watch(world, camera=OTHER) not in streams
    assert streams[3].state is StreamState.CLOSED
    assert len(world.videos.streams_of(world.robot)) == ROBOT_STREAMS


def test_when_the_robot_is_busy_the_nearest_stream_is_shared(world: World) -> None:
    """Nearest in pixels, with the same camera, codec, crop and rotation, and not the refused one."""
    robot_comes(world)
    small, large = showing(world, 32, 24), showing(world, 64, 48)
    showing(world, 40, 30, codec="png")
    showing(world, 40, 30, camera=OTHER)
    watcher = busy(world, link.VideoSettings(width=40, height=30))
    assert watcher.stream is small
    shows(world, small, 2, jpeg(32, 24))
    assert watcher.numbers == [2]
    assert busy(world, link.VideoSettings()).stream is large
    assert busy(world, link.VideoSettings(width=60)).stream is large
    assert busy(world, link.VideoSettings(height=20)).stream is small
    assert busy(world, link.VideoSettings(crop=(0, 0, 30, 20))).error is not None
    watcher.leave()
    assert watcher not in small.viewers


def test_viewer_moved_to_a_slow_stream_gets_its_newest_frame_if_requested(world: World) -> None:
    """As a viewer that joins it directly does."""
    robot_comes(world)
    slow = showing(world, 32, 24, fps=0.05)
    world.clock.advance(5)
    watchers = {newest: Watcher(user=1) for newest in (True, False)}
    wanted = link.VideoSettings(width=40, height=30)
    for newest, watcher in watchers.items():
        watcher.stream = world.videos.watch(world.robot, CAMERA, wanted, watcher, newest=newest)
    robot_joins(world)
    refused = watchers[True].stream
    assert refused is not None
    refused.message_received(link.StreamRefused(reason="two streams are all I can", busy=True))
    world.clock.advance(0)
    assert {watcher.stream for watcher in watchers.values()} == {slow}
    assert {newest: watcher.numbers for newest, watcher in watchers.items()} == {True: [1], False: []}


def test_of_streams_of_one_size_that_of_the_nearest_quality_and_rate_is_shared(world: World) -> None:
    """Quality first; rates are compared by the time between two frames."""
    robot_comes(world)
    poor = showing(world, 32, 24, quality=20, fps=30)
    slow, quick = showing(world, 32, 24, quality=70, fps=1), showing(world, 32, 24, quality=70, fps=15)
    assert busy(world, link.VideoSettings(width=32, height=24, quality=30)).stream is poor
    assert busy(world, link.VideoSettings(width=32, height=24, quality=80)).stream is quick
    assert busy(world, link.VideoSettings(width=32, height=24, quality=80, fps=30)).stream is quick
    assert busy(world, link.VideoSettings(width=32, height=24, quality=80, fps=1.2)).stream is slow
    assert busy(world, link.VideoSettings(width=48, height=36, quality=20)).stream is poor


def test_a_frame_that_is_turned_otherwise_is_not_near(world: World) -> None:
    """It would mislead a driver."""
    robot_comes(world)
    upright, turned = showing(world, 32, 24), showing(world, 24, 32, rotate=90)
    assert busy(world, link.VideoSettings(width=32, height=24, rotate=90)).stream is turned
    assert busy(world, link.VideoSettings(width=24, height=32)).stream is upright
    assert busy(world, link.VideoSettings(width=32, height=24, invert=True)).error is not None
    stamped = showing(world, 64, 48, stamp=True)
    assert busy(world, link.VideoSettings(width=60, height=45)).stream is upright
    assert busy(world, link.VideoSettings(width=32, height=24, stamp=True)).stream is stamped


def test_ambiguous_topic_is_not_matched(world: World) -> None:
    """It has another transport, for which not every viewer of the camera has the right."""
    robot_comes(world)
    showing(world, 40, 30, transport="compressed")
    assert busy(world, link.VideoSettings(width=41)).error is not None
    plain = showing(world, 80, 60)
    assert busy(world, link.VideoSettings(width=41, transport="compressed")).stream is not plain
    assert busy(world, link.VideoSettings(width=41, transport="raw")).stream is plain


def test_a_busy_robot_without_such_a_stream_is_reported(world: World) -> None:
    """With the robot's reason; so do viewers that the other stream cannot accept."""
    robot_comes(world)
    png_of_it = showing(world, 32, 24, codec="png")
    alone = busy(world, link.VideoSettings())
    assert str(alone.error) == "two streams are all I can"
    assert len(png_of_it.viewers) == 1
    full = showing(world, 32, 24)
    for user in range(STREAM_VIEWERS - 1):
        Watcher(2000 + user).watch(world, full.settings)
    assert str(busy(world, link.VideoSettings()).error) == "two streams are all I can"


def test_viewer_of_another_format_gets_its_own_when_possible(world: World) -> None:
    """Recordings first, then by arrival; the robot is not asked for more streams than its limit."""
    robot_comes(world, streams=3)
    small, large, rear = showing(world, 32, 24), showing(world, 64, 48), showing(world, 32, 24, OTHER)
    early, tape, late = Watcher(1), Watcher(2), Watcher(3)
    assert early.watch(world, link.VideoSettings(width=40)) is small
    tape.stream = world.videos.watch(world.robot, CAMERA, link.VideoSettings(), tape, first=True)
    assert late.watch(world, link.VideoSettings(width=60)) is tape.stream is large
    (only,) = rear.viewers
    rear.detach(only)
    world.clock.advance(LINGER_SECONDS)
    (asked_for,) = asked(world)
    assert asked_for.settings == link.VideoSettings()
    assert {early.stream, late.stream} == {small, large}
    assert tape.stream.settings == asked_for.settings
    assert tape.stream.viewers == {tape}
    tape.leave()
    world.clock.advance(LINGER_SECONDS)
    assert early.stream.settings.width == 40
    assert late.stream is large
    assert len(world.videos.streams_of(world.robot)) == 3
    assert not any(each.error for each in (early, tape, late))


def test_a_stream_without_viewers_is_evicted(world: World) -> None:
    """Its last viewer's own stream takes the place; others share it until it is their turn."""
    robot_comes(world, streams=1)
    shared = showing(world, 32, 24)
    (owner,) = shared.viewers
    early, tape = Watcher(1), Watcher(2)
    early.watch(world, link.VideoSettings(width=40))
    tape.stream = world.videos.watch(world.robot, CAMERA, link.VideoSettings(), tape, first=True)
    world.control.take(link.OpenVideo)
    shared.detach(owner)
    world.clock.advance(0)
    assert shared.state is StreamState.CLOSED
    (whole,) = world.videos.streams_of(world.robot)
    assert (whole.settings, whole.viewers) == (link.VideoSettings(), {early, tape})
    reported = [type(each) for each in world.control.said if not isinstance(each, link.RequestKeyFrame)]
    assert reported == [link.CloseVideo, link.OpenVideo]
    tape.leave()
    world.clock.advance(0)
    (own,) = world.videos.streams_of(world.robot)
    assert (own.settings.width, own.viewers, early.stream) == (40, {early}, own)


def test_a_place_that_the_robot_has_not_is_asked_for_once(world: World) -> None:
    """The robot knows its limit best; a viewer that is moved back sees its former stream."""
    robot_comes(world)
    shared = showing(world, 32, 24)
    watcher = busy(world, link.VideoSettings(width=40))
    assert watcher.stream is shared
    assert asked(world) == []
    gone = showing(world, 32, 24, OTHER)
    gone.close(Unavailable("the lens is covered"))
    refused = world.videos.redeem(asked(world)[-1].ticket)
    assert refused is not None and refused is watcher.stream
    refused.joined(MemoryLink())
    refused.message_received(link.StreamRefused(reason="one stream is all I can", busy=True))
    assert watcher.stream is shared
    world.clock.advance(5)
    assert asked(world) == []
    assert watcher.error is None


def test_ambiguous_topic_replaces_no_other(world: World) -> None:
    """Not every viewer of the camera has the right to it."""
    robot_comes(world, streams=1)
    shared = showing(world, 32, 24)
    (owner,) = shared.viewers
    first, second = Watcher(1), Watcher(2)
    first.watch(world, link.VideoSettings(transport="compressed"))
    second.watch(world, link.VideoSettings(transport="raw"))
    shared.detach(owner)
    world.clock.advance(0)
    assert shared.viewers == {first, second}
    second.leave()
    world.clock.advance(0)
    assert first.stream is not None
    assert first.stream.settings.transport == "compressed"


def test_all_streams_of_a_robot_end(world: World) -> None:
    """The robot was removed or its key revoked; other robots' streams continue."""
    robot_comes(world)
    watcher, elsewhere = Watcher(), Watcher()
    watcher.watch(world)
    other = world.registry.robot(2, "digger", "main")
    elsewhere.stream = world.videos.watch(other, CAMERA, link.VideoSettings(), elsewhere)
    world.videos.close_streams(world.robot, NotFound("this robot was removed"))
    assert str(watcher.error) == "this robot was removed"
    assert list(world.videos) == [elsewhere.stream]
    world.videos.close()
    assert str(elsewhere.error) == "the relay is going down"
    assert list(world.videos) == []
    assert not world.robot.observers
