"""One stream in memory: a link without a socket, a camera without pictures, threads that the test is."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest
from twisted.internet.defer import Deferred
from twisted.internet.task import Clock
from twisted.internet.testing import StringTransportWithDisconnection
from twisted.logger import capturedLogs

from relay_protocol import frames, link
from relay_protocol.errors import Invalid, NotFound, SwitchboardError, Unavailable
from robot_client.camera.frame import Encoded, EncodeRequest, Frame, FrameFormat
from robot_client.camera.ipc import OpenStream
from robot_client.camera.messages import Damaged
from robot_client.camera.packetizer import PART
from robot_client.camera.rtt_probe import DOUBT, RttProbe
from robot_client.camera.stream import BEARS, FAULTS, TELL_EVERY, Busy, EncodedStream
from robot_client.link.protocol import VideoLink
from robot_client.link.transport import LinkProtocol

QUIET = ("join", "ping", "pong")


def unread() -> Any:
    raise AssertionError("nobody here reads pixels")


class View:
    """The camera as the stream has it; pictures are made when the test says so."""

    def __init__(self) -> None:
        self.fps = 15.0
        self.latched = False
        self.closed = 0
        self.before: Frame | None = None
        self.wishes: list[EncodeRequest] = []
        self.making: list[tuple[Frame, Deferred[Encoded]]] = []

    def make(self, shot: Frame, wish: EncodeRequest) -> Deferred[Encoded]:
        self.wishes.append(wish)
        done: Deferred[Encoded] = Deferred()
        self.making.append((shot, done))
        return done

    def latest(self) -> Frame | None:
        return self.before

    def close(self) -> None:
        self.closed += 1


class Scene:
    def __init__(self, refusal: SwitchboardError | None = None, **settings: Any) -> None:
        self.clock = Clock()
        self.clock.advance(100)
        self.view = View()
        self.way = RttProbe()
        self.gone: list[str] = []
        self._refusal = refusal
        line = OpenStream(
            stream="s",
            ticket="t",
            camera="/c",
            topic="/c",
            settings=link.VideoSettings(**settings),
            heartbeat=2.0,
        )
        self.protocol = LinkProtocol(
            VideoLink("t", self.now, 2.0),
            lambda protocol: EncodedStream(
                line, protocol, self.watch, self.clock, lambda _, why: self.gone.append(why), self.way
            ),
            self.clock,
        )
        self.stream: Any = self.protocol.owner
        self.transport = StringTransportWithDisconnection()
        self.transport.protocol = self.protocol
        self.transport.abortConnection = self.transport.loseConnection  # as a real one ends, for this test
        self.protocol.makeConnection(self.transport)

    def now(self) -> int:
        return round(self.clock.seconds() * 1e9)

    def watch(self, line: OpenStream, on_shot: Callable[[Frame], None]) -> View:
        if self._refusal is not None:
            raise self._refusal
        self.shoot: Callable[[Frame], None] = on_shot
        return self.view

    def say(self, message: link.Message) -> None:
        self.protocol.dataReceived(link.frame(message))

    def joined(self) -> Scene:
        self.say(link.Joined(channel="s", at=1))
        for _ in range(3):
            self.say(link.Pong(t=self.now(), at=2))
        return self

    def shot(self, stamp: int) -> None:
        self.shoot(Frame(stamp, self.clock.seconds(), lambda: FrameFormat("rgb8", 64, 48), unread))

    def make(self, size: int = 1000, width: int = 64) -> None:
        """End the making of the latest picture."""
        self.view.making[-1][1].callback(Encoded(bytes(size), width, 48, "rgb8"))

    def heard(self) -> list[Any]:
        """What went to the relay, pictures, and messages as dicts, but for pings and the opening."""
        data = self.transport.value()
        self.transport.clear()
        found = [
            json.loads(each.body) if isinstance(each, frames.JsonFrame) else each
            for each in frames.FrameDecoder(2**25).feed(data)
        ]
        return [each for each in found if not isinstance(each, dict) or each["op"] not in QUIET]

    def pictures(self) -> list[int]:
        """Stamps of the pictures that went."""
        return [each.stamp for each in self.heard() if isinstance(each, frames.VideoFrame)]


def test_playing_is_said_before_the_first_picture() -> None:
    """Then the picture, numbered from 1, with the stamp of its arrival."""
    scene = Scene().joined()
    scene.heard()
    scene.shot(7)
    scene.make(10)
    playing, picture = scene.heard()
    assert playing.pop("reduced", 0) == 0
    assert playing == {
        "op": "playing",
        "width": 64,
        "height": 48,
        "quality": 80,
        "encoding": "rgb8",
        "source_fps": 15.0,
    }
    assert picture == frames.VideoFrame(1, 7, bytes(10))


def test_newest_picture_wins() -> None:
    """While one is being made and while two are under way only the newest waits; it goes when the relay took one."""
    scene = Scene().joined()
    scene.shot(1)
    scene.shot(2)
    scene.shot(3)
    scene.make()
    assert scene.pictures() == [1]
    scene.shot(4)
    assert len(scene.view.making) == 1  # the first shows what the link is like
    scene.clock.advance(0.01)
    scene.say(link.Took(number=1))
    assert [shot.stamp for shot, _ in scene.view.making] == [1, 4]
    scene.make()
    scene.shot(5)
    scene.make()
    scene.shot(6)
    assert scene.pictures() == [4, 5]
    assert len(scene.view.making) == 3


def test_first_picture_and_the_one_asked_for_stand_alone() -> None:
    """A key frame is wished at the start, and once when somebody joined."""
    scene = Scene(codec="h264").joined()
    for number in range(1, 5):
        if number == 3:
            scene.say(link.KeyFrame())
        scene.shot(number)
        scene.make()
        scene.clock.advance(0.05)
        scene.say(link.Took(number=number))
    assert [wish.key for wish in scene.view.wishes] == [True, False, True, False]


def test_thin_uplink_makes_less_and_says_so() -> None:
    """After a picture that took seconds the next is wished smaller, and `playing` says how much."""
    scene = Scene().joined()
    scene.shot(1)
    scene.make(15_000)
    scene.heard()
    scene.clock.advance(2.0)
    scene.say(link.Took(number=1))
    scene.shot(2)
    wish = scene.view.wishes[-1]
    assert wish.reduced
    assert wish.quality < 80
    assert wish.scale < 1
    scene.make(2_000, width=16)
    playing = scene.heard()[0]
    assert playing["width"] == 16
    assert 0 < playing["reduced"] <= 1
    assert playing["delay_ms"] == 2000


def test_after_a_picture_that_was_given_up_one_stands_alone() -> None:
    """What the relay has of it is nothing to go on from."""
    scene = Scene(codec="h264").joined()
    scene.shot(1)
    scene.make(200_000)
    parts = scene.heard()[1:]
    assert [each.offset for each in parts] == [0, PART, 2 * PART]
    for part in parts:
        scene.shot(2)
        assert len(scene.view.making) == 1
        scene.clock.advance(1.0)
        scene.say(link.Took(number=1, upto=part.offset + PART))
    assert scene.heard() == []
    assert [wish.key for wish in scene.view.wishes] == [True, True]
    assert scene.view.wishes[-1].scale < 1


@pytest.mark.parametrize("codec", ["h264", "jpeg"])
def test_one_that_was_being_made_when_it_was_given_up_does_not_go_on_from_it(codec: str) -> None:
    """Of H.264; it is made again, so as to stand alone, if no newer one is there."""
    scene = Scene(codec=codec).joined()
    scene.shot(1)
    scene.make(40_000)
    for part in scene.heard()[1:]:
        scene.clock.advance(0.001)
        scene.say(link.Took(number=1, upto=part.offset + PART if part.offset + PART < 40_000 else None))
    scene.shot(2)
    scene.make(200_000)
    scene.shot(3)
    assert [shot.stamp for shot, _ in scene.view.making] == [1, 2, 3]
    while parts := scene.heard():
        for part in parts:
            scene.clock.advance(1.0)
            scene.say(link.Took(number=2, upto=part.offset + PART))
    scene.make(1000)
    if codec == "jpeg":
        assert scene.pictures() == [3]
        return
    assert scene.pictures() == []
    assert [
        (shot.stamp, wish.key) for (shot, _), wish in zip(scene.view.making, scene.view.wishes, strict=True)
    ] == [(1, True), (2, False), (3, False), (3, True)]
    scene.make(1000)
    (picture,) = [each for each in scene.heard() if isinstance(each, frames.VideoFrame)]
    assert (picture.number, picture.stamp) == (3, 3)
    scene.clock.advance(0.01)
    scene.say(link.Took(number=3))
    scene.shot(4)
    scene.clock.advance(1.0)
    scene.make(1000)
    assert scene.pictures() == [4]
    assert not scene.view.wishes[-1].key


@pytest.mark.parametrize(("latched", "made"), [(True, [1, 1]), (False, [1])])
def test_kept_picture_that_was_given_up_is_made_again(latched: bool, made: list[int]) -> None:
    """Smaller, because no other one may follow; of other cameras the next one does."""
    scene = Scene().joined()
    scene.view.latched = latched
    scene.shot(1)
    scene.view.before = scene.view.making[-1][0]
    scene.make(200_000)
    for part in scene.heard()[1:]:
        scene.clock.advance(1.0)
        scene.say(link.Took(number=1, upto=part.offset + PART))
    assert [shot.stamp for shot, _ in scene.view.making] == made
    assert (scene.view.wishes[-1].scale < 1) == latched


@pytest.mark.parametrize(("latched", "made"), [(True, [(1, True), (1, True)]), (False, [(1, True)])])
def test_kept_picture_is_made_again_for_who_needs_one_that_stands_alone(
    latched: bool, made: list[tuple[int, bool]]
) -> None:
    """In H.264, at once, because no other one may follow."""
    scene = Scene(codec="h264").joined()
    scene.view.latched = latched
    scene.shot(1)
    scene.view.before = scene.view.making[-1][0]
    scene.make()
    scene.clock.advance(0.01)
    scene.say(link.Took(number=1))
    scene.say(link.KeyFrame())
    wished = zip(scene.view.making, scene.view.wishes, strict=True)
    assert [(shot.stamp, wish.key) for (shot, _), wish in wished] == made


def test_measured_delay_is_told_once_a_second_at_most() -> None:
    """What was decided is told at once, what is measured now and then."""
    scene = Scene().joined()
    told = 0
    for number in range(1, 41):
        scene.shot(number)
        scene.make()
        scene.clock.advance(0.05 + 0.001 * number)
        scene.say(link.Took(number=number))
        told += sum(isinstance(each, dict) and each["op"] == "playing" for each in scene.heard())
    assert 2 <= told <= 2 + (scene.clock.seconds() - 100) / TELL_EVERY


def test_whether_a_picture_is_kept_is_told_with_it_and_when_it_changes() -> None:
    """Also if no other picture comes: who subscribes to a topic learns only then how it is published."""
    scene = Scene().joined()
    scene.heard()
    scene.clock.advance(TELL_EVERY)
    assert scene.heard() == []  # nothing is told before there is a picture
    scene.view.latched = True
    scene.shot(1)
    scene.make()
    assert scene.heard()[0]["latched"]
    scene.clock.advance(TELL_EVERY)
    scene.say(link.Took(number=1))
    assert scene.heard() == []
    scene.view.latched = False
    scene.clock.advance(TELL_EVERY)
    (playing,) = scene.heard()
    assert (playing["op"], playing["width"], playing.get("latched", False)) == ("playing", 64, False)
    scene.stream.close("over")
    scene.view.latched = True
    scene.clock.advance(TELL_EVERY)
    assert [each["op"] for each in scene.heard()] == ["bye"]


def test_rate_is_kept_and_the_last_picture_still_goes() -> None:
    """A picture that came too early for the rate goes when its time has come, also if no other follows."""
    scene = Scene(fps=2).joined()
    scene.shot(1)
    scene.make()
    scene.clock.advance(0.05)
    scene.say(link.Took(number=1))
    scene.shot(2)
    assert len(scene.view.making) == 1
    scene.clock.advance(0.5)
    assert len(scene.view.making) == 2


@pytest.mark.parametrize(
    ("error", "busy"), [(NotFound("no such camera"), False), (Busy("too many streams"), True)]
)
def test_camera_that_can_not_be_had_is_refused_in_words(error: SwitchboardError, busy: bool) -> None:
    """And the link ends."""
    scene = Scene(error).joined()
    (said,) = scene.heard()
    assert (said["op"], said["reason"], said.get("busy", False)) == ("not_playing", str(error), busy)
    assert not scene.transport.connected
    assert scene.gone == [str(error)]


def test_first_picture_that_can_not_be_made_ends_the_stream() -> None:
    """With what is wrong with it."""
    scene = Scene().joined()
    scene.heard()
    scene.shot(1)
    scene.view.making[-1][1].errback(Invalid("no such encoding"))
    (said,) = scene.heard()
    assert (said["op"], said["reason"]) == ("not_playing", "no such encoding")
    assert scene.view.closed == 1


def spoil(scene: Scene, error: Exception) -> None:
    """Another picture comes, of which nothing can be made."""
    scene.shot(1)
    scene.view.making[-1][1].errback(error)


def test_damaged_pictures_at_the_beginning_are_left_out() -> None:
    """Cameras often begin with some; then it goes on as if nothing had been."""
    scene = Scene().joined()
    scene.heard()
    for _ in range(FAULTS - 1):
        spoil(scene, Damaged("the JPEG ends in the middle"))
    assert scene.heard() == []
    scene.shot(7)
    scene.make()
    assert scene.pictures() == [7]
    assert scene.view.wishes[-1].key
    for _ in range(round(2 * BEARS / TELL_EVERY)):
        scene.clock.advance(TELL_EVERY)
        scene.say(link.Took(number=1))
    assert scene.transport.connected


def test_stream_of_nothing_but_damaged_pictures_ends_with_what_is_wrong() -> None:
    """After as many as in between."""
    scene = Scene().joined()
    scene.heard()
    for _ in range(FAULTS):
        assert scene.transport.connected
        spoil(scene, Damaged("the JPEG ends in the middle"))
    (said,) = scene.heard()
    assert (said["op"], said["reason"]) == ("not_playing", "the JPEG ends in the middle")
    assert scene.view.closed == 1


def test_damaged_picture_after_which_none_comes_is_told() -> None:
    """A kept one may be all there is: who waits learns why before he is told that nothing came."""
    scene = Scene().joined()
    scene.heard()
    spoil(scene, Damaged("the PNG is broken"))
    scene.clock.pump([TELL_EVERY] * round(BEARS / TELL_EVERY - 1))
    assert scene.heard() == []
    scene.clock.pump([TELL_EVERY] * 2)
    (said,) = scene.heard()
    assert (said["op"], said["reason"]) == ("not_playing", "the PNG is broken")
    assert not scene.transport.connected
    assert scene.view.closed == 1


def test_what_can_not_be_shown_ends_the_stream_also_behind_a_damaged_picture() -> None:
    """At once: it would come again."""
    scene = Scene().joined()
    scene.heard()
    spoil(scene, Damaged("cut off"))
    spoil(scene, Invalid("no such encoding"))
    assert [each["reason"] for each in scene.heard()] == ["no such encoding"]


@pytest.mark.parametrize(
    "error", [Damaged("cut off"), Invalid("no such encoding"), Unavailable("OpenCV can't")]
)
def test_stream_outlives_any_spell_of_pictures_that_can_not_be_shown(error: SwitchboardError) -> None:
    """Why none comes is said once that has lasted, and taken back with the first good one."""
    scene = Scene().joined()
    first(scene)
    for _ in range(30 * FAULTS):
        spoil(scene, error)
        scene.clock.advance(TELL_EVERY / 10)
        scene.say(link.Pong(t=scene.now(), at=2))
    (said,) = scene.heard()
    assert (said["op"], said["trouble"]) == ("playing", str(error))
    scene.shot(3)
    scene.make(width=32)
    playing, picture = scene.heard()
    assert (playing.get("trouble", ""), playing["width"], picture.stamp) == ("", 32, 3)
    assert scene.transport.connected


def test_single_picture_that_can_not_be_shown_is_no_trouble() -> None:
    """The next one comes before anybody is told."""
    scene = Scene().joined()
    first(scene)
    for stamp in range(2, 40):
        spoil(scene, Damaged("cut off"))
        scene.clock.advance(TELL_EVERY / 4)
        scene.shot(stamp)
        scene.make()
        scene.say(link.Took(number=stamp))
    assert not [each for each in scene.heard() if isinstance(each, dict) and each.get("trouble")]


def test_encoder_of_h264_that_fails_ends_the_stream() -> None:
    """Another codec may do, and viewers are told so; a camera's own faults don't end it."""
    scene = Scene(codec="h264").joined()
    first(scene)
    for _ in range(3 * FAULTS):
        spoil(scene, Damaged("cut off"))
    assert scene.transport.connected
    scene.shot(2)
    scene.make()
    scene.say(link.Took(number=2))
    scene.heard()
    for _ in range(FAULTS):
        assert scene.transport.connected
        spoil(scene, Unavailable("this size can't be encoded"))
    assert scene.heard()[-1]["reason"] == "this size can't be encoded"


def test_fault_of_ours_in_between_is_logged_once_and_borne() -> None:
    """What nobody foresaw is for the log, not for viewers."""
    scene = Scene().joined()
    first(scene)
    with capturedLogs() as logs:
        for _ in range(5):
            spoil(scene, ZeroDivisionError("at /home/secret"))
    assert len(logs) == 1
    scene.clock.advance(2 * TELL_EVERY)
    (said,) = scene.heard()
    assert "robot's log" in said["trouble"] and "secret" not in said["trouble"]
    assert scene.transport.connected


def first(scene: Scene) -> None:
    """One picture is shown."""
    scene.shot(1)
    scene.make()
    scene.clock.advance(0.05)
    scene.say(link.Took(number=1))
    scene.heard()


def test_fault_of_ours_ends_the_stream_without_its_text() -> None:
    """What nobody foresaw is for the log, not for viewers."""
    scene = Scene().joined()
    scene.heard()
    scene.shot(1)
    scene.view.making[-1][1].errback(ZeroDivisionError("at /home/secret"))
    (said,) = scene.heard()
    assert said["op"] == "not_playing"
    assert "secret" not in said["reason"]


def test_close_says_goodbye_and_lets_the_camera_go() -> None:
    """What is being made then is not sent."""
    scene = Scene().joined()
    scene.shot(1)
    scene.heard()
    scene.stream.close("nobody watches")
    scene.make()
    assert [each["op"] for each in scene.heard()] == ["bye"]
    assert scene.view.closed == 1
    assert scene.gone == ["nobody watches"]


def test_lost_link_lets_the_camera_go() -> None:
    """And is told once."""
    scene = Scene().joined()
    scene.shot(1)
    scene.transport.loseConnection()
    scene.make()
    assert scene.view.closed == 1
    assert len(scene.gone) == 1


def test_joined_to_another_stream_is_not_believed() -> None:
    """Pictures of this camera are not for it."""
    scene = Scene()
    scene.say(link.Joined(channel="other", at=1))
    assert not scene.transport.connected
    assert scene.view.closed == 0


def doubted(scene: Scene) -> Scene:
    """What is measured has been longer than the round trip for so long that it is asked for."""
    now = scene.clock.seconds()
    scene.way.measured(0.005, now)
    scene.way.measured(0.4, now)
    scene.clock.advance(DOUBT)
    return scene


def test_round_trip_is_asked_for_by_the_first_byte_of_a_picture() -> None:
    """The rest leaves when it has its answer, and the relay gets the picture it was."""
    scene = doubted(Scene().joined())
    scene.shot(1)
    scene.make(1000)
    (first,) = scene.heard()[1:]
    assert (first.offset, len(first.body), first.total) == (0, 1, 1000)
    scene.clock.advance(0.35)
    scene.say(link.Took(number=1, upto=1))
    (rest,) = scene.heard()
    joiner = frames.PictureJoiner(2**22)
    assert joiner.join(first) is None
    assert joiner.join(rest) == frames.VideoFrame(1, 1, bytes(1000))
    assert scene.way.seconds == pytest.approx(0.35)


def test_picture_that_had_to_wait_for_another_stream_goes_when_that_is_over() -> None:
    """Also if the camera gives no other one."""
    scene = doubted(Scene().joined())
    scene.way.leaves("another stream", scene.clock.seconds())
    scene.shot(1)
    scene.clock.advance(0.5)
    assert scene.view.making == []
    scene.way.idle("another stream", scene.clock.seconds())
    scene.clock.advance(0.1)
    assert len(scene.view.making) == 1


def test_lost_link_holds_up_no_other_stream() -> None:
    """What was under way on it is answered no more."""
    scene = doubted(Scene().joined())
    scene.shot(1)
    scene.make(1000)
    assert not scene.way.may_leave(scene.clock.seconds())
    scene.transport.loseConnection()
    assert scene.way.may_leave(scene.clock.seconds())


def test_stream_begins_with_the_picture_that_was_there() -> None:
    """With its stamp; its age says nothing of the uplink."""
    scene = Scene()
    scene.view.before = Frame(7, scene.clock.seconds() - 15, lambda: FrameFormat("rgb8", 64, 48), unread)
    scene.joined()
    scene.make()
    assert scene.pictures() == [7]
    scene.clock.advance(0.02)
    scene.say(link.Took(number=1))
    assert scene.stream.pace.delay == pytest.approx(0.02)
    assert scene.stream.pace.reduced == 0
    assert scene.stream.pace.may_send(scene.clock.seconds())
