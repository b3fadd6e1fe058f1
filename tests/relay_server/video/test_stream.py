"""The life of a stream: every event in every state, and notifications to viewers and robot."""

from __future__ import annotations

import pytest
from msgspec import structs

from relay_protocol import link
from relay_protocol.errors import MalformedMessage, NotFound, Unavailable
from relay_server.video.errors import NO_CAMERA, EncoderUnavailable, NoFrame
from relay_server.video.frame_waits import FIRST_FRAME_SECONDS, KEY_SECONDS
from relay_server.video.frames import STALE_SECONDS
from relay_server.video.stream import (
    JOIN_SECONDS,
    LINGER_SECONDS,
    LINKED,
    MAX_REOPEN_SECONDS,
    NEXT,
    REOPEN_SECONDS,
    STATUS_SECONDS,
    STREAM_VIEWERS,
    CameraStream,
    StreamCallbacks,
    StreamEvent,
    StreamState,
)
from tests.worlds.relay import MemoryLink, World
from tests.worlds.viewers import (
    CAMERA,
    DELTA,
    KEY,
    OTHER,
    Watcher,
    asked,
    jpeg,
    png,
    robot_comes,
    robot_joins,
    shows,
)

H264 = link.VideoSettings(codec="h264")
PLAYING = link.StreamStatus(width=32, height=24, quality=80)


def watched(
    world: World, settings: link.VideoSettings | None = None
) -> tuple[CameraStream, Watcher, MemoryLink]:
    """An open stream with one viewer, and the robot's side."""
    if world.robot.control_link is None:
        robot_comes(world)
    watcher = Watcher()
    stream = watcher.watch(world, settings)
    return stream, watcher, robot_joins(world)


def brought_to(world: World, state: StreamState) -> CameraStream:
    """A stream that real events have brought to this state."""
    if state is StreamState.NEW:
        hooks = StreamCallbacks(lambda stream: "ticket", *3 * (lambda stream: None,))
        return CameraStream(world.clock, world.robot, CAMERA, link.VideoSettings(), "rover#video0", hooks)
    watcher = Watcher()
    stream = watcher.watch(world)
    if state is StreamState.WAITING:
        return stream
    robot_comes(world)
    if state in (StreamState.OPEN, StreamState.LINGERING):
        robot_joins(world)
    if state in (StreamState.LINGERING, StreamState.CLOSED):
        watcher.leave()
    return stream


@pytest.mark.parametrize("event", StreamEvent)
@pytest.mark.parametrize("state", StreamState)
def test_every_event_in_every_state(world: World, state: StreamState, event: StreamEvent) -> None:
    """The table lists all transitions; other events change nothing."""
    stream = brought_to(world, state)
    assert stream.state is state
    stream._handle(event)
    assert stream.state is NEXT.get((state, event), state)
    assert (stream._link is not None) == (state in LINKED and stream.state in LINKED)
    assert (stream in world.robot.observers) == (stream.state is not StreamState.CLOSED)


# --- viewers ----------------------------------------------------------------------------------------------


def test_a_frame_goes_to_all_viewers_and_is_acknowledged_at_once(world: World) -> None:
    """With its own size, regardless of the robot's report, and its time of arrival."""
    stream, first, end = watched(world)
    second = Watcher(user=8)
    assert second.watch(world) is stream
    shows(world, stream, 5, jpeg(48, 32))
    assert end.all(link.FrameAck) == [link.FrameAck(number=5)]
    (picture,) = first.pictures
    assert second.pictures == [picture]
    assert (picture.number, picture.codec, picture.width, picture.height) == (5, "jpeg", 48, 32)
    assert picture.key
    assert picture.body == jpeg(48, 32)
    assert picture.good_until == world.clock.seconds() + STALE_SECONDS
    assert picture.stamp == pytest.approx(1.7e9 + world.clock.seconds())
    assert stream.newest is picture


def test_delayed_command_is_valid_for_less_time(world: World) -> None:
    """After a stall old frames arrive together and must not pass as new ones."""
    stream, watcher, _ = watched(world)
    for number, late in enumerate((0.0, 0.3, 2.0)):
        shows(world, stream, number, late=late)
    left = [picture.good_until - world.clock.seconds() for picture in watcher.pictures]
    assert left == pytest.approx([STALE_SECONDS, STALE_SECONDS - 0.3, STALE_SECONDS - 2.0])


def test_new_viewer_of_an_inhibited_camera_gets_no_frame(world: World) -> None:
    """Not even its latched frame, which is sent at the end. A held frame is shown."""
    stream, _, _ = watched(world)
    stream.message_received(structs.replace(PLAYING, latched=True))
    shows(world, stream, 1)
    inhibited = link.Inhibited(resource=stream.camera, ms=5000, by="olga")
    world.robot.motion_state = structs.replace(world.robot.motion_state, inhibited=[inhibited])
    late = Watcher()
    late.watch(world)
    world.clock.pump([0.2] * 15)
    assert late.played and late.numbers == []
    world.robot.motion_state = structs.replace(
        world.robot.motion_state, inhibited=[structs.replace(inhibited, hold=True)]
    )
    world.clock.advance(1)
    assert late.numbers == [1]


def test_later_subscriber_gets_the_current_state(world: World) -> None:
    """The playback status, and the newest frame if it is recent enough."""
    stream, _, _ = watched(world)
    stream.message_received(PLAYING)
    shows(world, stream, 1)
    world.clock.advance(0.4)
    late = Watcher()
    late.watch(world)
    world.clock.advance(0)
    assert late.played == [PLAYING]
    assert late.numbers == [1]
    world.clock.advance(0.2)
    later = Watcher()
    later.watch(world)
    world.clock.advance(0)
    assert later.played == [PLAYING]
    assert later.numbers == []


def test_a_new_viewer_gets_a_frame_once(world: World) -> None:
    """Even if a frame arrives before the viewer's first status."""
    stream, _, _ = watched(world)
    shows(world, stream, 1)
    late = Watcher()
    late.watch(world)
    shows(world, stream, 2)
    world.clock.advance(0)
    assert late.numbers == [2]


def test_gone_client_receives_nothing(world: World) -> None:
    """Neither frames nor errors; leaving twice has no effect."""
    stream, watcher, _ = watched(world)
    stays = Watcher()
    stays.watch(world)
    watcher.leave()
    watcher.leave()
    shows(world, stream)
    world.clock.advance(FIRST_FRAME_SECONDS + 1)
    stream.close(Unavailable("over"))
    assert watcher.pictures == []
    assert watcher.error is None
    assert str(stays.error) == "over"


def test_viewer_may_leave_during_delivery(world: World) -> None:
    """It may even remove other viewers."""
    stream, first, _ = watched(world)
    second = Watcher()
    second.watch(world)
    for each, other in ((first, second), (second, first)):
        each.frame_received = lambda picture, other=other: other.leave()  # type: ignore[method-assign]
    shows(world, stream)
    assert len(stream.viewers) == 1


def test_a_stream_lingers_after_its_last_viewer(world: World) -> None:
    """A viewer that joins in time finds it open; after that the robot is asked to stop, within 2 s in all."""
    stream, watcher, end = watched(world)
    watcher.leave()
    assert stream.state is StreamState.LINGERING
    world.clock.advance(LINGER_SECONDS - 0.1)
    shows(world, stream, 9)
    assert end.all(link.FrameAck) == [link.FrameAck(number=9)]
    back = Watcher()
    assert back.watch(world) is stream
    world.clock.advance(0)
    assert back.numbers == [9]
    world.clock.advance(LINGER_SECONDS)
    assert stream.state is StreamState.OPEN
    back.leave()
    world.clock.advance(LINGER_SECONDS)
    assert stream.state is StreamState.CLOSED
    assert end.closed
    assert world.control.all(link.CloseVideo) == [link.CloseVideo(stream=stream.name)]
    assert not [call for call in world.clock.getDelayedCalls() if call.active()]


def test_channel_opens_while_a_client_waits(world: World) -> None:
    """A stream without viewers is closed at once; a robot with its ticket is refused."""
    robot_comes(world)
    watcher = Watcher()
    stream = watcher.watch(world)
    (ask,) = asked(world)
    watcher.leave()
    assert stream.state is StreamState.CLOSED
    assert len(world.control.all(link.CloseVideo)) == 1
    assert world.videos.redeem(ask.ticket) is None
    late = MemoryLink()
    stream.joined(late)
    assert late.closed


def test_a_stream_takes_a_number_of_viewers(world: World) -> None:
    """One more gets an error."""
    for user in range(STREAM_VIEWERS):
        Watcher(user).watch(world)
    with pytest.raises(Unavailable, match="256 viewers watch this stream already"):
        Watcher(1000).watch(world)


# --- no frame ---------------------------------------------------------------------------------------------


def test_viewer_without_frames_gets_the_reason(world: World) -> None:
    """The robot is offline, has no such camera, does not join, or sends no frame."""

    def reported(settings: link.VideoSettings, camera: str = CAMERA) -> BaseException | None:
        watcher = Watcher()
        watcher.watch(world, settings, camera)
        if settings.fps == 2:
            robot_joins(world)
        world.clock.advance(FIRST_FRAME_SECONDS - 0.1)
        assert watcher.error is None
        world.clock.advance(0.1)
        return watcher.error

    assert str(reported(link.VideoSettings())) == "robot rover is offline"
    robot_comes(world)
    nowhere = reported(link.VideoSettings(), "/nowhere")
    assert isinstance(nowhere, NotFound)
    assert str(nowhere) == NO_CAMERA
    silent = reported(link.VideoSettings(fps=1))
    assert isinstance(silent, NoFrame)
    assert "does not open the stream" in str(silent)
    dark = reported(link.VideoSettings(fps=2))
    assert isinstance(dark, NoFrame)
    assert "has sent no frame for 10 s" in str(dark)
    world.clock.advance(LINGER_SECONDS)
    assert list(world.videos) == []


def test_viewer_with_a_frame_waits_for_more(world: World) -> None:
    """This includes an offline robot: an image on a page continues when it is back."""
    stream, watcher, end = watched(world)
    shows(world, stream, 1)
    world.robot_goes()
    assert end.closed
    assert stream.state is StreamState.WAITING
    assert stream.newest is None
    world.clock.advance(3600)
    assert watcher.error is None
    robot_comes(world)
    robot_joins(world)
    shows(world, stream, 1)
    assert watcher.numbers == [1, 1]


# --- the robot --------------------------------------------------------------------------------------------


def test_the_robot_is_asked_when_it_has_the_camera(world: World) -> None:
    """Not before it has reported it, and only once."""
    settings = link.VideoSettings(width=320, quality=60)
    stream = Watcher().watch(world, settings)
    robot_comes(world, OTHER)
    assert asked(world) == []
    has = link.Cameras(cameras=[link.Camera(name=OTHER), link.Camera(name=CAMERA)])
    for _ in range(2):
        world.registry.cameras(world.robot, has)
    (ask,) = asked(world)
    assert ask == link.OpenVideo(stream=stream.name, ticket=ask.ticket, camera=CAMERA, settings=settings)
    assert asked(world) == []


def test_cameras_of_a_former_registration_count_no_more(world: World) -> None:
    """The daemon may have been restarted with other cameras."""
    robot_comes(world)
    world.registry.registered(world.robot, MemoryLink())
    assert world.robot.cameras == ()


def test_a_robot_that_does_not_join_is_asked_again(world: World) -> None:
    """With another ticket, as long as there is a viewer; the former ticket is invalid."""
    robot_comes(world)
    first, second = Watcher(), Watcher()
    stream = first.watch(world)
    (ask,) = asked(world)
    world.clock.advance(1)
    second.watch(world)
    world.clock.advance(JOIN_SECONDS - 1)
    (again,) = asked(world)
    assert isinstance(first.error, NoFrame)
    assert second.error is None
    assert again.stream == ask.stream
    assert world.videos.redeem(ask.ticket) is None
    assert world.videos.redeem(again.ticket) is stream


def test_a_broken_link_is_opened_again_ever_more_slowly(world: World) -> None:
    """Until a frame arrives."""
    stream, watcher, end = watched(world)

    def pause() -> float:
        stream.lost(end)
        assert asked(world) == []
        began = world.clock.seconds()
        while not world.control.all(link.OpenVideo):
            world.clock.advance(0.25)
        return world.clock.seconds() - began

    shows(world, stream)
    for expected in (REOPEN_SECONDS, 1.0, 2.0, 4.0, MAX_REOPEN_SECONDS, MAX_REOPEN_SECONDS):
        assert pause() == expected
        end = robot_joins(world)
    shows(world, stream, 2)
    assert pause() == REOPEN_SECONDS
    assert watcher.error is None


def test_another_link_is_refused(world: World) -> None:
    """Its loss does not affect the stream."""
    stream, _, end = watched(world)
    other = MemoryLink()
    stream.joined(other)
    assert other.closed
    stream.lost(other)
    assert stream.state is StreamState.OPEN
    assert end.closed is None


@pytest.mark.parametrize(
    "body", [b"<html>", b"", png(), jpeg() + b"\n", jpeg()[:-2]], ids=lambda b: repr(b[:6])
)
def test_invalid_frame_breaks_the_link_but_no_stream(world: World, body: bytes) -> None:
    """The frame is not sent to viewers. Those without a frame get an error; others get a status and later
    frames.
    """
    stream, watcher, end = watched(world)
    stream.message_received(PLAYING)
    shows(world, stream, 1)
    world.clock.advance(STALE_SECONDS + 1)
    late = Watcher()
    late.watch(world)
    with pytest.raises(MalformedMessage):
        shows(world, stream, 2, body)
    assert watcher.numbers == [1] and watcher.error is None
    assert str(late.error).startswith("robot rover sent a frame that is not an image: ")
    assert watcher.played[-1].problem == str(late.error)
    assert stream.last_status == watcher.played[-1]
    assert end.closed is None, "it is the connection that says why"
    assert end.all(link.FrameAck) == [link.FrameAck(number=1), link.FrameAck(number=2)]
    world.clock.advance(REOPEN_SECONDS)
    robot_joins(world)
    stream.message_received(PLAYING)
    shows(world, stream, 1)
    assert watcher.numbers == [1, 1]
    assert stream.last_status is None


def test_invalid_first_frame_ends_the_stream(world: World) -> None:
    """Every viewer gets the error."""
    stream, watcher, _ = watched(world)
    with pytest.raises(MalformedMessage):
        shows(world, stream, 1, b"<html>")
    assert str(watcher.error).startswith("robot rover sent a frame that is not an image: ")
    assert stream.state is StreamState.CLOSED


def test_a_robot_that_can_not_show_it_any_more_is_asked_again(world: World) -> None:
    """With growing pauses, as long as a viewer has seen frames; it gets the reason."""
    stream, watcher, end = watched(world)
    stream.message_received(PLAYING)
    shows(world, stream, 1)
    pause = REOPEN_SECONDS
    for _ in range(8):
        stream.message_received(link.StreamRefused(reason="the JPEG ends in the middle"))
        assert end.closed and stream.state is StreamState.OPENING
        world.clock.advance(pause / 2)
        assert asked(world) == []
        world.clock.advance(pause / 2)
        end = robot_joins(world)
        pause = min(2 * pause, MAX_REOPEN_SECONDS)
    assert watcher.error is None
    assert [each.problem for each in watcher.played] == ["", "the JPEG ends in the middle"]
    shows(world, stream, 1)
    assert watcher.numbers == [1, 1]
    watcher.leave()
    world.clock.advance(LINGER_SECONDS)
    assert stream.state is StreamState.CLOSED


def test_a_viewer_without_a_first_frame_learns_the_reason(world: World) -> None:
    """The reason is the robot's, at the viewer's timeout; viewers that have seen frames stay."""
    stream, watcher, _ = watched(world)
    stream.message_received(PLAYING)
    shows(world, stream, 1)
    world.clock.advance(STALE_SECONDS + 1)
    stream.message_received(structs.replace(PLAYING, problem="the PNG is broken"))
    late = Watcher()
    late.watch(world)
    world.clock.advance(FIRST_FRAME_SECONDS)
    assert str(late.error) == "camera /camera/image has sent no frame for 10 s: the PNG is broken"
    assert watcher.error is None and watcher.played[-1].problem == "the PNG is broken"


def test_a_robot_that_refuses_a_stream_gives_the_reason(world: World) -> None:
    """Its viewers get the reason, and the stream ends."""
    stream, watcher, end = watched(world)
    stream.message_received(link.StreamRefused(reason="no module named av"))
    assert type(watcher.error) is Unavailable
    assert str(watcher.error) == "no module named av"
    assert stream.state is StreamState.CLOSED
    assert end.closed


@pytest.mark.parametrize("busy", [False, True])
def test_a_refusal_of_h264_shows_whether_another_codec_is_available(world: World, busy: bool) -> None:
    """A robot with too many streams does not suggest another codec."""
    stream, watcher, _ = watched(world, H264)
    stream.message_received(link.StreamRefused(reason="no module named av", busy=busy))
    assert type(watcher.error) is (Unavailable if busy else EncoderUnavailable)
    assert str(watcher.error) == "no module named av"


def test_invalid_h264_is_the_encoders_fault(world: World) -> None:
    """JPEG may work."""
    stream, watcher, _ = watched(world, H264)
    stream.message_received(PLAYING)
    with pytest.raises(MalformedMessage):
        shows(world, stream, 1, b"<html>")
    assert type(watcher.error) is EncoderUnavailable


def test_playback_is_reported_when_it_changes(world: World) -> None:
    """The status is kept until its link is closed."""
    stream, watcher, end = watched(world)
    less = link.StreamStatus(width=16, height=12, quality=40, reduced=0.5)
    stream.message_received(PLAYING)
    stream.message_received(PLAYING)
    stream.message_received(less)
    assert stream.status == less
    world.clock.advance(1)
    assert watcher.played == [PLAYING, less]
    stream.lost(end)
    assert stream.status is None
    world.clock.advance(REOPEN_SECONDS)
    robot_joins(world)
    stream.message_received(less)
    assert watcher.played == [PLAYING, less, less]


def test_endless_stream_statuses_are_passed_on_ten_times_a_second(world: World) -> None:
    """The first at once, then the newest. New viewers get it too, and no viewer gets any after the end."""
    stream, watcher, _ = watched(world)
    playing = [link.StreamStatus(width=16 + number, height=12, quality=40) for number in range(1000)]
    for each in playing:
        stream.message_received(each)
    assert watcher.played == playing[:1]
    late = Watcher()
    late.watch(world)
    world.clock.advance(STATUS_SECONDS)
    assert watcher.played == [playing[0], playing[-1]]
    assert set(late.played) == {playing[-1]}
    for number in range(100):
        stream.message_received(playing[number])
        world.clock.advance(STATUS_SECONDS / 10)
    assert len(watcher.played) == pytest.approx(2 + 10, abs=1)
    stream.message_received(PLAYING)
    stream.close(Unavailable("over"))
    world.clock.advance(1)
    assert PLAYING not in watcher.played


# --- H.264 ------------------------------------------------------------------------------------------------


def test_h264_is_shown_from_a_key_frame_on(world: World) -> None:
    """A new viewer causes a request for one; its size is that of the playback status."""
    stream, first, end = watched(world, H264)
    stream.message_received(PLAYING)
    shows(world, stream, 1, KEY)
    shows(world, stream, 2, DELTA)
    assert [(each.key, each.width, each.height) for each in first.pictures] == [
        (True, 32, 24),
        (False, 32, 24),
    ]
    assert end.take(link.RequestKeyFrame) == []
    second = Watcher()
    second.watch(world, H264)
    assert len(end.take(link.RequestKeyFrame)) == 1
    shows(world, stream, 3, DELTA)
    shows(world, stream, 4, KEY)
    shows(world, stream, 5, DELTA)
    world.clock.advance(KEY_SECONDS)
    assert first.numbers == [1, 2, 3, 4, 5]
    assert second.numbers == [4, 5]


def test_key_frames_are_asked_for_now_and_then(world: World) -> None:
    """At most twice a second, the first time at once, and not for viewers that have one."""
    stream, _, end = watched(world, H264)
    stream.message_received(PLAYING)
    for _ in range(20):
        Watcher().watch(world, H264)
        world.clock.advance(0.1)
    assert len(end.take(link.RequestKeyFrame)) == 1 + 2 * 2
    Watcher().watch(world, H264)
    shows(world, stream, 1, KEY)
    world.clock.advance(5)
    assert end.take(link.RequestKeyFrame) == []


def test_a_viewer_that_skipped_a_frame_starts_with_a_key_frame(world: World) -> None:
    """The frames that follow are useless to it; others get them."""
    stream, slow, end = watched(world, H264)
    fast = Watcher()
    fast.watch(world, H264)
    stream.message_received(PLAYING)
    shows(world, stream, 1, KEY)
    world.clock.advance(KEY_SECONDS)
    end.take(link.RequestKeyFrame)
    stream.request_keyframe(slow)
    assert len(end.take(link.RequestKeyFrame)) == 1
    shows(world, stream, 2, DELTA)
    shows(world, stream, 3, KEY)
    assert slow.numbers == [1, 3]
    assert fast.numbers == [1, 2, 3]


def test_after_a_break_all_viewers_start_with_a_key_frame(world: World) -> None:
    """The robot's encoder has been restarted."""
    stream, watcher, end = watched(world, H264)
    stream.message_received(PLAYING)
    shows(world, stream, 1, KEY)
    stream.lost(end)
    world.clock.advance(REOPEN_SECONDS)
    robot_joins(world)
    stream.message_received(PLAYING)
    shows(world, stream, 1, DELTA)
    assert watcher.numbers == [1]
    shows(world, stream, 2, KEY)
    assert watcher.numbers == [1, 2]


def test_h264_without_a_size_breaks_the_contract(world: World) -> None:
    """``stream_status`` must precede the first frame."""
    stream, watcher, _ = watched(world, H264)
    with pytest.raises(MalformedMessage, match="before 'stream_status'"):
        shows(world, stream, 1, KEY)
    assert watcher.error is not None
