"""All streams of a relay: who shares one, how many there may be, and where viewers go when there is no more room."""

from __future__ import annotations

import pytest

from relay_protocol import link
from relay_protocol.errors import NotFound, Unavailable
from relay_server.video import State, Stream, TooOften
from relay_server.video.hub import (
    ROBOT_STREAMS,
    STREAMS_A_SECOND,
    STREAMS_AT_ONCE,
    USER_VIEWERS,
)
from relay_server.video.stream import STREAM_VIEWERS
from tests.relay_server.memory import World
from tests.relay_server.video.watching import (
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


def showing(world: World, width: int, height: int, camera: str = CAMERA, **settings: object) -> Stream:
    """An open stream whose pictures have this size."""
    wanted = link.VideoSettings(width=width, height=height, **settings)  # type: ignore[arg-type]
    stream = Watcher(user=width).watch(world, wanted, camera)
    robot_joins(world)
    shows(world, stream, 1, png(width, height) if wanted.codec == "png" else jpeg(width, height))
    return stream


def busy(world: World, settings: link.VideoSettings, camera: str = CAMERA) -> Watcher:
    """A viewer of what the robot says it can't make as well."""
    watcher = Watcher(user=1)
    stream = watcher.watch(world, settings, camera)
    robot_joins(world)
    stream.message(link.NotPlaying(reason="two streams are all I can", busy=True))
    assert stream.state is State.CLOSED
    return watcher


def test_who_wants_the_same_shares_a_stream(world: World) -> None:
    """Another form, another camera or another robot is another stream."""
    stream = Watcher().watch(world)
    assert Watcher(8).watch(world, link.VideoSettings(quality=80)) is stream
    small = Watcher().watch(world, link.VideoSettings(width=320))
    rear = Watcher().watch(world, camera=OTHER)
    other = world.registry.presence(2, "digger", "main")
    elsewhere = world.videos.watch(other, CAMERA, link.VideoSettings(), Watcher())
    assert len({stream, small, rear, elsewhere}) == 4
    assert len({each.name for each in world.videos}) == 4
    assert world.videos.of(world.robot) == [stream, small, rear]
    assert world.videos.of(other) == [elsewhere]


def test_a_ticket_is_for_its_stream_alone(world: World) -> None:
    """What is no ticket of a stream may be one of a channel."""
    robot_comes(world)
    first = Watcher().watch(world)
    second = Watcher().watch(world, camera=OTHER)
    one, two = asked(world)
    assert world.videos.redeem(two.ticket) is second
    assert world.videos.redeem(one.ticket) is first
    assert world.videos.redeem(one.ticket) is None
    assert world.videos.redeem("invented") is None


def test_a_user_watches_a_robot_so_many_times(world: World) -> None:
    """Over all streams; others still may, and so may he when he has left one."""
    watchers = [Watcher() for _ in range(USER_VIEWERS)]
    for number, watcher in enumerate(watchers):
        watcher.watch(world, link.VideoSettings(width=100 + number % 3))
    with pytest.raises(Unavailable, match="you watch robot rover 32 times already"):
        Watcher().watch(world)
    Watcher(8).watch(world)
    watchers[0].leave()
    Watcher().watch(world)


def test_nobody_takes_all_streams_of_a_robot_for_himself(world: World) -> None:
    """Not with forms nobody else wants, nor with cameras that are not there; what others watch he may as well."""
    robot_comes(world)
    for number in range(12):
        Watcher().watch(world, camera=f"/nowhere/{number}")
    with pytest.raises(Unavailable, match="you have 12 streams of robot rover to yourself"):
        Watcher().watch(world)
    shared = Watcher(8).watch(world)
    assert Watcher().watch(world) is shared
    Watcher(8).watch(world, camera="/nowhere/0")
    Watcher().watch(world, camera=OTHER)


def test_of_a_robot_that_makes_few_streams_nobody_takes_all(world: World) -> None:
    """Three quarters of those it says it makes, and all of one that makes but one."""
    robot_comes(world, streams=4)
    for width in (20, 30, 40):
        Watcher().watch(world, link.VideoSettings(width=width))
    with pytest.raises(Unavailable, match="you have 3 streams"):
        Watcher().watch(world, link.VideoSettings(width=50))
    Watcher(8).watch(world, link.VideoSettings(width=50))
    with pytest.raises(Unavailable, match="shows 4 streams already, the most it can"):
        Watcher(9).watch(world, link.VideoSettings(width=60))
    world.videos.shut()
    robot_comes(world, streams=1)
    Watcher().watch(world)


def test_a_user_begins_streams_only_so_fast(world: World) -> None:
    """Whatever he left before; he is told when he may again. He may elsewhere, and watch what others began."""
    robot_comes(world)
    for number in range(STREAMS_AT_ONCE):
        watcher = Watcher()
        watcher.watch(world, link.VideoSettings(width=16 + number))
        watcher.leave()
    shared = Watcher(8).watch(world)
    assert len(world.videos.of(world.robot)) == 1
    with pytest.raises(TooOften, match="you begin streams of robot rover") as caught:
        Watcher().watch(world, link.VideoSettings(width=16))
    assert caught.value.retry_after == 1 / STREAMS_A_SECOND
    assert Watcher().watch(world) is shared
    other = world.registry.presence(2, "digger", "main")
    world.videos.watch(other, CAMERA, link.VideoSettings(), Watcher())
    world.clock.advance(caught.value.retry_after)
    Watcher().watch(world, link.VideoSettings(width=16))
    with pytest.raises(TooOften):
        Watcher().watch(world, link.VideoSettings(width=17))


def test_a_page_with_many_cameras_may_be_loaded_again_and_again(world: World) -> None:
    """Every few seconds, for ever, each camera in two forms in turn."""
    robot_comes(world)
    for load in range(100):
        watchers = [Watcher() for _ in range(12)]
        for number, watcher in enumerate(watchers):
            watcher.watch(world, link.VideoSettings(width=16 + load % 2), f"/camera/{number}")
        world.clock.advance(6)
        for watcher in watchers:
            watcher.leave()


def test_a_robot_has_so_many_streams(world: World) -> None:
    """Then one in which nobody is left gives way, else the viewer gets the nearest, if there is any."""
    robot_comes(world)
    streams = [showing(world, 20 + number, 16) for number in range(ROBOT_STREAMS)]
    late = Watcher(1)
    assert late.watch(world, link.VideoSettings(width=33, height=17)) is streams[15]
    with pytest.raises(Unavailable, match="robot rover shows 16 streams already"):
        Watcher(1).watch(world, camera=OTHER)
    (only,) = streams[3].viewers
    streams[3].detach(only)
    assert Watcher(1).watch(world, camera=OTHER) not in streams
    assert streams[3].state is State.CLOSED
    assert len(world.videos.of(world.robot)) == ROBOT_STREAMS


def test_when_the_robot_is_busy_the_nearest_stream_is_shared(world: World) -> None:
    """Nearest in pixels, of the same camera and codec, cropped and turned alike, which is not the one refused."""
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


def test_a_picture_that_is_turned_otherwise_is_not_near(world: World) -> None:
    """It would mislead who drives by it."""
    robot_comes(world)
    upright, turned = showing(world, 32, 24), showing(world, 24, 32, rotate=90)
    assert busy(world, link.VideoSettings(width=32, height=24, rotate=90)).stream is turned
    assert busy(world, link.VideoSettings(width=24, height=32)).stream is upright
    assert busy(world, link.VideoSettings(width=32, height=24, invert=True)).error is not None
    stamped = showing(world, 64, 48, stamp=True)
    assert busy(world, link.VideoSettings(width=60, height=45)).stream is upright
    assert busy(world, link.VideoSettings(width=32, height=24, stamp=True)).stream is stamped


def test_what_may_be_another_topic_is_not_near(world: World) -> None:
    """By another transport, which not everybody may view who may view the camera."""
    robot_comes(world)
    showing(world, 40, 30, transport="compressed")
    assert busy(world, link.VideoSettings(width=41)).error is not None
    plain = showing(world, 80, 60)
    assert busy(world, link.VideoSettings(width=41, transport="compressed")).stream is not plain
    assert busy(world, link.VideoSettings(width=41, transport="raw")).stream is plain


def test_a_busy_robot_without_such_a_stream_is_told_of(world: World) -> None:
    """In its own words; so it is to those whom the other stream does not take."""
    robot_comes(world)
    png_of_it = showing(world, 32, 24, codec="png")
    alone = busy(world, link.VideoSettings())
    assert str(alone.error) == "two streams are all I can"
    assert len(png_of_it.viewers) == 1
    full = showing(world, 32, 24)
    for user in range(STREAM_VIEWERS - 1):
        Watcher(2000 + user).watch(world, full.settings)
    assert str(busy(world, link.VideoSettings()).error) == "two streams are all I can"


def test_all_streams_of_a_robot_end(world: World) -> None:
    """Its key was revoked, or it was removed; others go on."""
    robot_comes(world)
    watcher, elsewhere = Watcher(), Watcher()
    watcher.watch(world)
    other = world.registry.presence(2, "digger", "main")
    elsewhere.stream = world.videos.watch(other, CAMERA, link.VideoSettings(), elsewhere)
    world.videos.end(world.robot, NotFound("this robot was removed"))
    assert str(watcher.error) == "this robot was removed"
    assert list(world.videos) == [elsewhere.stream]
    world.videos.shut()
    assert str(elsewhere.error) == "the relay is going down"
    assert list(world.videos) == []
    assert not world.robot.watchers
