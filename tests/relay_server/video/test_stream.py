"""A stream's life: every event in every state, and what viewers and the robot are told meanwhile."""

from __future__ import annotations

import pytest
from msgspec import structs

from relay_protocol import link
from relay_protocol.errors import MalformedMessage, NotFound, Unavailable
from relay_server.video.first_frame_timeout import FIRST_PICTURE_SECONDS
from relay_server.video.frames import STALE_SECONDS
from relay_server.video.keyframes import KEY_SECONDS
from relay_server.video.ports import NO_CAMERA, EncoderUnavailable, NoFrame
from relay_server.video.stream import (
    JOIN_SECONDS,
    LINGER_SECONDS,
    LINKED,
    MOST_REOPEN_SECONDS,
    NEXT,
    REOPEN_SECONDS,
    STREAM_VIEWERS,
    TELL_SECONDS,
    CameraStream,
    StreamCallbacks,
    StreamEvent,
    StreamState,
)
from tests.relay_server.memory import MemoryLink, World
from tests.relay_server.video.watching import (
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
PLAYING = link.Playing(width=32, height=24, quality=80)


def watched(
    world: World, settings: link.VideoSettings | None = None
) -> tuple[CameraStream, Watcher, MemoryLink]:
    """An open stream with one viewer, and the robot's end."""
    if world.robot.control is None:
        robot_comes(world)
    watcher = Watcher()
    stream = watcher.watch(world, settings)
    return stream, watcher, robot_joins(world)


def brought_to(world: World, state: StreamState) -> CameraStream:
    """A stream in this state, by what really happens."""
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
    """The table says what follows; what it does not list changes nothing."""
    stream = brought_to(world, state)
    assert stream.state is state
    stream._happen(event)
    assert stream.state is NEXT.get((state, event), state)
    assert (stream._link is not None) == (state in LINKED and stream.state in LINKED)
    assert (stream in world.robot.watchers) == (stream.state is not StreamState.CLOSED)


# --- viewers ----------------------------------------------------------------------------------------------


def test_a_picture_goes_to_everybody_and_the_robot_is_told_at_once(world: World) -> None:
    """With its own size, whatever the robot says, and the moment it was here."""
    stream, first, end = watched(world)
    second = Watcher(user=8)
    assert second.watch(world) is stream
    shows(world, stream, 5, jpeg(48, 32))
    assert end.all(link.Took) == [link.Took(number=5)]
    (picture,) = first.pictures
    assert second.pictures == [picture]
    assert (picture.number, picture.codec, picture.width, picture.height) == (5, "jpeg", 48, 32)
    assert picture.key
    assert picture.body == jpeg(48, 32)
    assert picture.good_until == world.clock.seconds() + STALE_SECONDS
    assert picture.stamp == pytest.approx(1.7e9 + world.clock.seconds())
    assert stream.newest is picture


def test_what_the_network_held_up_is_good_for_less_long(world: World) -> None:
    """After a stall old pictures come in a heap, which nobody shall take for what the camera sees now."""
    stream, watcher, _ = watched(world)
    for number, late in enumerate((0.0, 0.3, 2.0)):
        shows(world, stream, number, late=late)
    left = [picture.good_until - world.clock.seconds() for picture in watcher.pictures]
    assert left == pytest.approx([STALE_SECONDS, STALE_SECONDS - 0.3, STALE_SECONDS - 2.0])


def test_who_comes_while_a_camera_is_inhibited_sees_nothing_of_it(world: World) -> None:
    """Not even the picture that its publisher keeps; that comes when it is over. One that is held is shown."""
    stream, _, _ = watched(world)
    stream.message(structs.replace(PLAYING, latched=True))
    shows(world, stream, 1)
    inhibited = link.Inhibited(resource=stream.camera, ms=5000, by="olga")
    world.robot.safety = structs.replace(world.robot.safety, inhibited=[inhibited])
    late = Watcher()
    late.watch(world)
    world.clock.pump([0.2] * 15)
    assert late.played and late.numbers == []
    world.robot.safety = structs.replace(
        world.robot.safety, inhibited=[structs.replace(inhibited, hold=True)]
    )
    world.clock.advance(1)
    assert late.numbers == [1]


def test_who_comes_later_is_told_what_the_others_know(world: World) -> None:
    """What the robot plays, and the newest picture, if it is not too old to be shown."""
    stream, _, _ = watched(world)
    stream.message(PLAYING)
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


def test_a_picture_comes_once_to_who_is_new(world: World) -> None:
    """Also one that comes before he was greeted."""
    stream, _, _ = watched(world)
    shows(world, stream, 1)
    late = Watcher()
    late.watch(world)
    shows(world, stream, 2)
    world.clock.advance(0)
    assert late.numbers == [2]


def test_who_has_left_is_told_nothing(world: World) -> None:
    """Neither pictures nor the end, nor that none came; leaving twice is nothing."""
    stream, watcher, _ = watched(world)
    stays = Watcher()
    stays.watch(world)
    watcher.leave()
    watcher.leave()
    shows(world, stream)
    world.clock.advance(FIRST_PICTURE_SECONDS + 1)
    stream.shut(Unavailable("over"))
    assert watcher.pictures == []
    assert watcher.error is None
    assert str(stays.error) == "over"


def test_one_viewer_may_leave_while_another_is_shown_a_picture(world: World) -> None:
    """And takes others with him."""
    stream, first, _ = watched(world)
    second = Watcher()
    second.watch(world)
    for each, other in ((first, second), (second, first)):
        each.picture = lambda picture, other=other: other.leave()  # type: ignore[method-assign]
    shows(world, stream)
    assert len(stream.viewers) == 1


def test_a_stream_lingers_after_its_last_viewer(world: World) -> None:
    """Who comes within the time finds it open; after it the robot is told to stop, within 2 s in all."""
    stream, watcher, end = watched(world)
    watcher.leave()
    assert stream.state is StreamState.LINGERING
    world.clock.advance(LINGER_SECONDS - 0.1)
    shows(world, stream, 9)
    assert end.all(link.Took) == [link.Took(number=9)]
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


def test_nobody_left_before_it_opened(world: World) -> None:
    """It is over at once; a robot that comes with its ticket is turned away."""
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
    """One more is refused in words."""
    for user in range(STREAM_VIEWERS):
        Watcher(user).watch(world)
    with pytest.raises(Unavailable, match="256 viewers watch this stream already"):
        Watcher(1000).watch(world)


# --- no picture -------------------------------------------------------------------------------------------


def test_who_gets_no_picture_is_told_why(world: World) -> None:
    """The robot is away, has no such camera, does not join, or shows nothing."""

    def told(settings: link.VideoSettings, camera: str = CAMERA) -> BaseException | None:
        watcher = Watcher()
        watcher.watch(world, settings, camera)
        if settings.fps == 2:
            robot_joins(world)
        world.clock.advance(FIRST_PICTURE_SECONDS - 0.1)
        assert watcher.error is None
        world.clock.advance(0.1)
        return watcher.error

    assert str(told(link.VideoSettings())) == "robot rover is offline"
    robot_comes(world)
    nowhere = told(link.VideoSettings(), "/nowhere")
    assert isinstance(nowhere, NotFound)
    assert str(nowhere) == NO_CAMERA
    silent = told(link.VideoSettings(fps=1))
    assert isinstance(silent, NoFrame)
    assert "does not open the video" in str(silent)
    dark = told(link.VideoSettings(fps=2))
    assert isinstance(dark, NoFrame)
    assert "has given no picture for 10 s" in str(dark)
    world.clock.advance(LINGER_SECONDS)
    assert list(world.videos) == []


def test_who_has_got_a_picture_waits_for_more(world: World) -> None:
    """Also while the robot is away: an image on a page goes on when it is back."""
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
    """Not before it has said so, and once."""
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
    """The daemon may have been started with others."""
    robot_comes(world)
    world.registry.registered(world.robot, MemoryLink())
    assert world.robot.cameras == ()


def test_a_robot_that_does_not_join_is_asked_again(world: World) -> None:
    """With another ticket, as long as somebody waits; the former one is good no more."""
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


def test_a_broken_link_is_opened_anew_ever_more_slowly(world: World) -> None:
    """Until a picture has come."""
    stream, watcher, end = watched(world)

    def pause() -> float:
        stream.lost(end)
        assert asked(world) == []
        began = world.clock.seconds()
        while not world.control.all(link.OpenVideo):
            world.clock.advance(0.25)
        return world.clock.seconds() - began

    shows(world, stream)
    for expected in (REOPEN_SECONDS, 1.0, 2.0, 4.0, MOST_REOPEN_SECONDS, MOST_REOPEN_SECONDS):
        assert pause() == expected
        end = robot_joins(world)
    shows(world, stream, 2)
    assert pause() == REOPEN_SECONDS
    assert watcher.error is None


def test_another_link_is_turned_away(world: World) -> None:
    """What it loses is not the stream's."""
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
def test_what_is_no_picture_breaks_the_link_and_no_stream(world: World, body: bytes) -> None:
    """Nobody gets it; who waits for a first picture is told, who has seen some is told and sees what comes later."""
    stream, watcher, end = watched(world)
    stream.message(PLAYING)
    shows(world, stream, 1)
    world.clock.advance(STALE_SECONDS + 1)
    late = Watcher()
    late.watch(world)
    with pytest.raises(MalformedMessage):
        shows(world, stream, 2, body)
    assert watcher.numbers == [1] and watcher.error is None
    assert str(late.error).startswith("robot rover sent what is no picture: ")
    assert watcher.played[-1].trouble == str(late.error)
    assert stream.failed == watcher.played[-1]
    assert end.closed is None, "it is the connection that says why"
    assert end.all(link.Took) == [link.Took(number=1), link.Took(number=2)]
    world.clock.advance(REOPEN_SECONDS)
    robot_joins(world)
    stream.message(PLAYING)
    shows(world, stream, 1)
    assert watcher.numbers == [1, 1]
    assert stream.failed is None


def test_what_is_no_picture_ends_a_stream_that_has_shown_none(world: World) -> None:
    """Everybody is told."""
    stream, watcher, _ = watched(world)
    with pytest.raises(MalformedMessage):
        shows(world, stream, 1, b"<html>")
    assert str(watcher.error).startswith("robot rover sent what is no picture: ")
    assert stream.state is StreamState.CLOSED


def test_a_robot_that_can_not_show_it_any_more_is_asked_again(world: World) -> None:
    """Less and less often, as long as anybody watches who has seen pictures; he is told why none comes."""
    stream, watcher, end = watched(world)
    stream.message(PLAYING)
    shows(world, stream, 1)
    pause = REOPEN_SECONDS
    for _ in range(8):
        stream.message(link.NotPlaying(reason="the JPEG ends in the middle"))
        assert end.closed and stream.state is StreamState.OPENING
        world.clock.advance(pause / 2)
        assert asked(world) == []
        world.clock.advance(pause / 2)
        end = robot_joins(world)
        pause = min(2 * pause, MOST_REOPEN_SECONDS)
    assert watcher.error is None
    assert [each.trouble for each in watcher.played] == ["", "the JPEG ends in the middle"]
    shows(world, stream, 1)
    assert watcher.numbers == [1, 1]
    watcher.leave()
    world.clock.advance(LINGER_SECONDS)
    assert stream.state is StreamState.CLOSED


def test_a_viewer_who_waits_for_his_first_picture_in_a_bad_spell_is_told_what_is_wrong(world: World) -> None:
    """With the words of the robot, when his patience is over; who has seen some stays."""
    stream, watcher, _ = watched(world)
    stream.message(PLAYING)
    shows(world, stream, 1)
    world.clock.advance(STALE_SECONDS + 1)
    stream.message(structs.replace(PLAYING, trouble="the PNG is broken"))
    late = Watcher()
    late.watch(world)
    world.clock.advance(FIRST_PICTURE_SECONDS)
    assert str(late.error) == "camera /camera/image has given no picture for 10 s: the PNG is broken"
    assert watcher.error is None and watcher.played[-1].trouble == "the PNG is broken"


def test_a_robot_that_can_not_show_it_says_why(world: World) -> None:
    """The viewers hear it, and the stream is over."""
    stream, watcher, end = watched(world)
    stream.message(link.NotPlaying(reason="no module named av"))
    assert type(watcher.error) is Unavailable
    assert str(watcher.error) == "no module named av"
    assert stream.state is StreamState.CLOSED
    assert end.closed


@pytest.mark.parametrize("busy", [False, True])
def test_of_h264_it_is_told_whether_another_codec_may_do(world: World, busy: bool) -> None:
    """Not when the robot only makes too many streams."""
    stream, watcher, _ = watched(world, H264)
    stream.message(link.NotPlaying(reason="no module named av", busy=busy))
    assert type(watcher.error) is (Unavailable if busy else EncoderUnavailable)
    assert str(watcher.error) == "no module named av"


def test_h264_that_is_none_is_the_encoders_fault(world: World) -> None:
    """JPEG may be better."""
    stream, watcher, _ = watched(world, H264)
    stream.message(PLAYING)
    with pytest.raises(MalformedMessage):
        shows(world, stream, 1, b"<html>")
    assert type(watcher.error) is EncoderUnavailable


def test_what_the_robot_plays_is_told_when_it_changes(world: World) -> None:
    """And kept, until its link is gone."""
    stream, watcher, end = watched(world)
    less = link.Playing(width=16, height=12, quality=40, reduced=0.5)
    stream.message(PLAYING)
    stream.message(PLAYING)
    stream.message(less)
    assert stream.told == less
    world.clock.advance(1)
    assert watcher.played == [PLAYING, less]
    stream.lost(end)
    assert stream.told is None
    world.clock.advance(REOPEN_SECONDS)
    robot_joins(world)
    stream.message(less)
    assert watcher.played == [PLAYING, less, less]


def test_a_robot_that_says_without_end_what_it_plays_is_told_of_ten_times_a_second(world: World) -> None:
    """The first at once, then the newest; who comes meanwhile hears that, and nobody anything once it is over."""
    stream, watcher, _ = watched(world)
    playing = [link.Playing(width=16 + number, height=12, quality=40) for number in range(1000)]
    for each in playing:
        stream.message(each)
    assert watcher.played == playing[:1]
    late = Watcher()
    late.watch(world)
    world.clock.advance(TELL_SECONDS)
    assert watcher.played == [playing[0], playing[-1]]
    assert set(late.played) == {playing[-1]}
    for number in range(100):
        stream.message(playing[number])
        world.clock.advance(TELL_SECONDS / 10)
    assert len(watcher.played) == pytest.approx(2 + 10, abs=1)
    stream.message(PLAYING)
    stream.shut(Unavailable("over"))
    world.clock.advance(1)
    assert PLAYING not in watcher.played


# --- H.264 ------------------------------------------------------------------------------------------------


def test_h264_is_shown_from_a_key_frame_on(world: World) -> None:
    """The robot is asked for one when somebody comes; its size is what the robot plays."""
    stream, first, end = watched(world, H264)
    stream.message(PLAYING)
    shows(world, stream, 1, KEY)
    shows(world, stream, 2, DELTA)
    assert [(each.key, each.width, each.height) for each in first.pictures] == [
        (True, 32, 24),
        (False, 32, 24),
    ]
    assert end.take(link.KeyFrame) == []
    second = Watcher()
    second.watch(world, H264)
    assert len(end.take(link.KeyFrame)) == 1
    shows(world, stream, 3, DELTA)
    shows(world, stream, 4, KEY)
    shows(world, stream, 5, DELTA)
    world.clock.advance(KEY_SECONDS)
    assert first.numbers == [1, 2, 3, 4, 5]
    assert second.numbers == [4, 5]


def test_key_frames_are_asked_for_now_and_then(world: World) -> None:
    """Twice a second, the first time at once, whoever comes; and not for who has one already."""
    stream, _, end = watched(world, H264)
    stream.message(PLAYING)
    for _ in range(20):
        Watcher().watch(world, H264)
        world.clock.advance(0.1)
    assert len(end.take(link.KeyFrame)) == 1 + 2 * 2
    Watcher().watch(world, H264)
    shows(world, stream, 1, KEY)
    world.clock.advance(5)
    assert end.take(link.KeyFrame) == []


def test_a_viewer_that_left_out_a_picture_starts_anew(world: World) -> None:
    """What follows is of no use to him; the others see it."""
    stream, slow, end = watched(world, H264)
    fast = Watcher()
    fast.watch(world, H264)
    stream.message(PLAYING)
    shows(world, stream, 1, KEY)
    world.clock.advance(KEY_SECONDS)
    end.take(link.KeyFrame)
    stream.start_anew(slow)
    assert len(end.take(link.KeyFrame)) == 1
    shows(world, stream, 2, DELTA)
    shows(world, stream, 3, KEY)
    assert slow.numbers == [1, 3]
    assert fast.numbers == [1, 2, 3]


def test_after_a_break_everybody_starts_anew(world: World) -> None:
    """The robot's encoder is another one."""
    stream, watcher, end = watched(world, H264)
    stream.message(PLAYING)
    shows(world, stream, 1, KEY)
    stream.lost(end)
    world.clock.advance(REOPEN_SECONDS)
    robot_joins(world)
    stream.message(PLAYING)
    shows(world, stream, 1, DELTA)
    assert watcher.numbers == [1]
    shows(world, stream, 2, KEY)
    assert watcher.numbers == [1, 2]


def test_h264_without_a_size_breaks_the_contract(world: World) -> None:
    """``playing`` comes before the first picture."""
    stream, watcher, _ = watched(world, H264)
    with pytest.raises(MalformedMessage, match="before 'playing'"):
        shows(world, stream, 1, KEY)
    assert watcher.error is not None
