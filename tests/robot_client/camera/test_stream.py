"""One stream in memory: a link without a socket, a camera without images, and threads simulated by the test."""

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
from robot_client.camera.images import DamagedImage
from robot_client.camera.ipc import OpenStream
from robot_client.camera.packetizer import PART
from robot_client.camera.rate_control import PROBE_AFTER, RttProbe
from robot_client.camera.stream import (
    DAMAGED_SECONDS,
    MAX_FAULTS,
    REPORT_INTERVAL,
    EncodedStream,
    StreamLimitReached,
)
from robot_client.link.links import VideoLink
from robot_client.link.transport import LinkProtocol

QUIET = ("join", "ping", "pong")


def unread() -> Any:
    raise AssertionError("nobody here reads pixels")


class View:
    """The stream's view of the camera; the test completes encodings."""

    def __init__(self) -> None:
        self.fps = 15.0
        self.latched = False
        self.closed = 0
        self.before: Frame | None = None
        self.requests: list[EncodeRequest] = []
        self.making: list[tuple[Frame, Deferred[Encoded]]] = []

    def encode(self, shot: Frame, request: EncodeRequest) -> Deferred[Encoded]:
        self.requests.append(request)
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
                line, protocol, self.open_view, self.clock, lambda _, why: self.gone.append(why), self.way
            ),
            self.clock,
        )
        self.stream: Any = self.protocol.owner
        self.transport = StringTransportWithDisconnection()
        self.transport.protocol = self.protocol
        self.transport.abortConnection = self.transport.loseConnection  # for this test, as a real one ends
        self.protocol.makeConnection(self.transport)

    def now(self) -> int:
        return round(self.clock.seconds() * 1e9)

    def open_view(self, line: OpenStream, on_shot: Callable[[Frame], None]) -> View:
        if self._refusal is not None:
            raise self._refusal
        self.shoot: Callable[[Frame], None] = on_shot
        return self.view

    def send(self, message: link.Message) -> None:
        self.protocol.dataReceived(link.frame(message))

    def joined(self) -> Scene:
        self.send(link.Joined(channel="s", at=1))
        for _ in range(3):
            self.send(link.Pong(t=self.now(), at=2))
        return self

    def shot(self, stamp: int) -> None:
        self.shoot(Frame(stamp, self.clock.seconds(), lambda: FrameFormat("rgb8", 64, 48), unread))

    def encode(self, size: int = 1000, width: int = 64) -> None:
        """Completes the latest encoding."""
        self.view.making[-1][1].callback(Encoded(bytes(size), width, 48, "rgb8"))

    def heard(self) -> list[Any]:
        """Frames and messages (as dicts) sent to the relay, except pings and the handshake."""
        data = self.transport.value()
        self.transport.clear()
        found = [
            json.loads(each.body) if isinstance(each, frames.JsonFrame) else each
            for each in frames.FrameDecoder(2**25).feed(data)
        ]
        return [each for each in found if not isinstance(each, dict) or each["op"] not in QUIET]

    def pictures(self) -> list[int]:
        """Stamps of the sent frames."""
        return [each.stamp for each in self.heard() if isinstance(each, frames.VideoFrame)]


def test_playing_is_sent_before_the_first_frame() -> None:
    """Then the frame, numbered from 1, with the stamp of its arrival."""
    scene = Scene().joined()
    scene.heard()
    scene.shot(7)
    scene.encode(10)
    playing, picture = scene.heard()
    assert playing.pop("reduced", 0) == 0
    assert playing == {
        "op": "stream_status",
        "width": 64,
        "height": 48,
        "quality": 80,
        "encoding": "rgb8",
        "source_fps": 15.0,
    }
    assert picture == frames.VideoFrame(1, 7, bytes(10))


def test_newest_frame_wins() -> None:
    """While one is being encoded and two are under way, only the newest waits; it is sent at the next answer."""
    scene = Scene().joined()
    scene.shot(1)
    scene.shot(2)
    scene.shot(3)
    scene.encode()
    assert scene.pictures() == [1]
    scene.shot(4)
    assert len(scene.view.making) == 1  # the first one measures the link
    scene.clock.advance(0.01)
    scene.send(link.FrameAck(number=1))
    assert [shot.stamp for shot, _ in scene.view.making] == [1, 4]
    scene.encode()
    scene.shot(5)
    scene.encode()
    scene.shot(6)
    assert scene.pictures() == [4, 5]
    assert len(scene.view.making) == 3


def test_first_frame_and_a_requested_one_are_key_frames() -> None:
    """A key frame is requested at the start, and once when a viewer joined."""
    scene = Scene(codec="h264").joined()
    for number in range(1, 5):
        if number == 3:
            scene.send(link.RequestKeyFrame())
        scene.shot(number)
        scene.encode()
        scene.clock.advance(0.05)
        scene.send(link.FrameAck(number=number))
    assert [request.key for request in scene.view.requests] == [True, False, True, False]


def test_thin_uplink_makes_less_and_reports_it() -> None:
    """After a frame that took seconds, a smaller one is requested, and `stream_status` has the reduction."""
    scene = Scene().joined()
    scene.shot(1)
    scene.encode(15_000)
    scene.heard()
    scene.clock.advance(2.0)
    scene.send(link.FrameAck(number=1))
    scene.shot(2)
    request = scene.view.requests[-1]
    assert request.reduced
    assert request.quality < 80
    assert request.scale < 1
    scene.encode(2_000, width=16)
    playing = scene.heard()[0]
    assert playing["width"] == 16
    assert 0 < playing["reduced"] <= 1
    assert playing["delay_ms"] == 2000


def test_after_a_frame_that_was_discarded_one_is_a_key_frame() -> None:
    """The part that the relay has is no reference."""
    scene = Scene(codec="h264").joined()
    scene.shot(1)
    scene.encode(200_000)
    parts = scene.heard()[1:]
    assert [each.offset for each in parts] == [0, PART, 2 * PART]
    for part in parts:
        scene.shot(2)
        assert len(scene.view.making) == 1
        scene.clock.advance(1.0)
        scene.send(link.FrameAck(number=1, received=part.offset + PART))
    assert scene.heard() == []
    assert [request.key for request in scene.view.requests] == [True, True]
    assert scene.view.requests[-1].scale < 1


@pytest.mark.parametrize("codec", ["h264", "jpeg"])
def test_frame_in_the_encoder_does_not_continue_a_discarded_one(codec: str) -> None:
    """In H.264 it is encoded again as a key frame, if there is no newer one."""
    scene = Scene(codec=codec).joined()
    scene.shot(1)
    scene.encode(40_000)
    for part in scene.heard()[1:]:
        scene.clock.advance(0.001)
        scene.send(
            link.FrameAck(number=1, received=part.offset + PART if part.offset + PART < 40_000 else None)
        )
    scene.shot(2)
    scene.encode(200_000)
    scene.shot(3)
    assert [shot.stamp for shot, _ in scene.view.making] == [1, 2, 3]
    while parts := scene.heard():
        for part in parts:
            scene.clock.advance(1.0)
            scene.send(link.FrameAck(number=2, received=part.offset + PART))
    scene.encode(1000)
    if codec == "jpeg":
        assert scene.pictures() == [3]
        return
    assert scene.pictures() == []
    assert [
        (shot.stamp, request.key)
        for (shot, _), request in zip(scene.view.making, scene.view.requests, strict=True)
    ] == [(1, True), (2, False), (3, False), (3, True)]
    scene.encode(1000)
    (picture,) = [each for each in scene.heard() if isinstance(each, frames.VideoFrame)]
    assert (picture.number, picture.stamp) == (3, 3)
    scene.clock.advance(0.01)
    scene.send(link.FrameAck(number=3))
    scene.shot(4)
    scene.clock.advance(1.0)
    scene.encode(1000)
    assert scene.pictures() == [4]
    assert not scene.view.requests[-1].key


@pytest.mark.parametrize(("latched", "made"), [(True, [1, 1]), (False, [1])])
def test_latched_frame_that_was_discarded_is_encoded_again(latched: bool, made: list[int]) -> None:
    """Smaller, because no other one may follow; other cameras send the next one."""
    scene = Scene().joined()
    scene.view.latched = latched
    scene.shot(1)
    scene.view.before = scene.view.making[-1][0]
    scene.encode(200_000)
    for part in scene.heard()[1:]:
        scene.clock.advance(1.0)
        scene.send(link.FrameAck(number=1, received=part.offset + PART))
    assert [shot.stamp for shot, _ in scene.view.making] == made
    assert (scene.view.requests[-1].scale < 1) == latched


@pytest.mark.parametrize(("latched", "made"), [(True, [(1, True), (1, True)]), (False, [(1, True)])])
def test_latched_frame_is_encoded_again_for_a_viewer_that_needs_one_that_is_a_key_frame(
    latched: bool, made: list[tuple[int, bool]]
) -> None:
    """In H.264, at once, because no other one may follow."""
    scene = Scene(codec="h264").joined()
    scene.view.latched = latched
    scene.shot(1)
    scene.view.before = scene.view.making[-1][0]
    scene.encode()
    scene.clock.advance(0.01)
    scene.send(link.FrameAck(number=1))
    scene.send(link.RequestKeyFrame())
    encoded = zip(scene.view.making, scene.view.requests, strict=True)
    assert [(shot.stamp, request.key) for (shot, _), request in encoded] == made


def test_measured_delay_is_reported_once_a_second_at_most() -> None:
    """Decisions are reported at once, measurements at intervals."""
    scene = Scene().joined()
    reported = 0
    for number in range(1, 41):
        scene.shot(number)
        scene.encode()
        scene.clock.advance(0.05 + 0.001 * number)
        scene.send(link.FrameAck(number=number))
        reported += sum(isinstance(each, dict) and each["op"] == "stream_status" for each in scene.heard())
    assert 2 <= reported <= 2 + (scene.clock.seconds() - 100) / REPORT_INTERVAL


def test_whether_a_frame_is_latched_is_reported_with_it_and_when_it_changes() -> None:
    """Even without another frame: a new subscriber learns the publisher's QoS only then."""
    scene = Scene().joined()
    scene.heard()
    scene.clock.advance(REPORT_INTERVAL)
    assert scene.heard() == []  # there is no report before the first frame
    scene.view.latched = True
    scene.shot(1)
    scene.encode()
    assert scene.heard()[0]["latched"]
    scene.clock.advance(REPORT_INTERVAL)
    scene.send(link.FrameAck(number=1))
    assert scene.heard() == []
    scene.view.latched = False
    scene.clock.advance(REPORT_INTERVAL)
    (playing,) = scene.heard()
    assert (playing["op"], playing["width"], playing.get("latched", False)) == ("stream_status", 64, False)
    scene.stream.close("over")
    scene.view.latched = True
    scene.clock.advance(REPORT_INTERVAL)
    assert [each["op"] for each in scene.heard()] == ["bye"]


def test_rate_is_kept_and_the_last_frame_still_goes() -> None:
    """A frame that was too early for the rate is sent when it is due, even without another."""
    scene = Scene(fps=2).joined()
    scene.shot(1)
    scene.encode()
    scene.clock.advance(0.05)
    scene.send(link.FrameAck(number=1))
    scene.shot(2)
    assert len(scene.view.making) == 1
    scene.clock.advance(0.5)
    assert len(scene.view.making) == 2


@pytest.mark.parametrize(
    ("error", "busy"), [(NotFound("no such camera"), False), (StreamLimitReached("too many streams"), True)]
)
def test_camera_that_can_not_be_opened_is_refused_with_the_reason(
    error: SwitchboardError, busy: bool
) -> None:
    """The link ends."""
    scene = Scene(error).joined()
    (said,) = scene.heard()
    assert (said["op"], said["reason"], said.get("busy", False)) == ("stream_refused", str(error), busy)
    assert not scene.transport.connected
    assert scene.gone == [str(error)]


def test_first_frame_that_can_not_be_made_ends_the_stream() -> None:
    """With the reason."""
    scene = Scene().joined()
    scene.heard()
    scene.shot(1)
    scene.view.making[-1][1].errback(Invalid("no such encoding"))
    (said,) = scene.heard()
    assert (said["op"], said["reason"]) == ("stream_refused", "no such encoding")
    assert scene.view.closed == 1


def spoil(scene: Scene, error: Exception) -> None:
    """Another frame arrives that cannot be encoded."""
    scene.shot(1)
    scene.view.making[-1][1].errback(error)


def test_damaged_frames_at_the_beginning_are_left_out() -> None:
    """Cameras often begin with some; then the stream continues normally."""
    scene = Scene().joined()
    scene.heard()
    for _ in range(MAX_FAULTS - 1):
        spoil(scene, DamagedImage("the JPEG is cut off"))
    assert scene.heard() == []
    scene.shot(7)
    scene.encode()
    assert scene.pictures() == [7]
    assert scene.view.requests[-1].key
    for _ in range(round(2 * DAMAGED_SECONDS / REPORT_INTERVAL)):
        scene.clock.advance(REPORT_INTERVAL)
        scene.send(link.FrameAck(number=1))
    assert scene.transport.connected


def test_single_damaged_frames_between_good_ones_are_counted() -> None:
    scene = Scene().joined()
    scene.shot(1)
    scene.encode()
    scene.heard()
    for number in (2, 3):
        scene.send(link.FrameAck(number=number - 1))
        spoil(scene, DamagedImage("the JPEG is cut off"))
        scene.shot(number)
        scene.encode()
    scene.clock.advance(REPORT_INTERVAL)
    scene.send(link.FrameAck(number=3))
    scene.shot(4)
    scene.encode()
    said = [each for each in scene.heard() if isinstance(each, dict)]
    assert {(each["op"], each["damaged"]) for each in said} == {("stream_status", 2)}


def test_stream_of_nothing_but_damaged_frames_ends_with_what_is_wrong() -> None:
    """After the same number as within a stream."""
    scene = Scene().joined()
    scene.heard()
    for _ in range(MAX_FAULTS):
        assert scene.transport.connected
        spoil(scene, DamagedImage("the JPEG is cut off"))
    (said,) = scene.heard()
    assert (said["op"], said["reason"]) == ("stream_refused", "the JPEG is cut off")
    assert scene.view.closed == 1


def test_damaged_frame_after_which_none_comes_is_reported() -> None:
    """It may be the only one, so the viewer gets this reason before the error that no frame arrived."""
    scene = Scene().joined()
    scene.heard()
    spoil(scene, DamagedImage("the PNG is broken"))
    scene.clock.pump([REPORT_INTERVAL] * round(DAMAGED_SECONDS / REPORT_INTERVAL - 1))
    assert scene.heard() == []
    scene.clock.pump([REPORT_INTERVAL] * 2)
    (said,) = scene.heard()
    assert (said["op"], said["reason"]) == ("stream_refused", "the PNG is broken")
    assert not scene.transport.connected
    assert scene.view.closed == 1


def test_undecodable_frame_ends_the_stream_also_behind_a_damaged_one() -> None:
    """At once, since it would be repeated."""
    scene = Scene().joined()
    scene.heard()
    spoil(scene, DamagedImage("cut off"))
    spoil(scene, Invalid("no such encoding"))
    assert [each["reason"] for each in scene.heard()] == ["no such encoding"]


@pytest.mark.parametrize(
    "error", [DamagedImage("cut off"), Invalid("no such encoding"), Unavailable("OpenCV can't")]
)
def test_stream_outlives_any_spell_of_frames_that_can_not_be_shown(error: SwitchboardError) -> None:
    """The reason is reported once after a while, and withdrawn with the first good one."""
    scene = Scene().joined()
    first(scene)
    for _ in range(30 * MAX_FAULTS):
        spoil(scene, error)
        scene.clock.advance(REPORT_INTERVAL / 10)
        scene.send(link.Pong(t=scene.now(), at=2))
    (said,) = scene.heard()
    assert (said["op"], said["problem"]) == ("stream_status", str(error))
    scene.shot(3)
    scene.encode(width=32)
    playing, picture = scene.heard()
    assert (playing.get("problem", ""), playing["width"], picture.stamp) == ("", 32, 3)
    assert scene.transport.connected


def test_single_frame_that_can_not_be_shown_is_no_trouble() -> None:
    """The next one arrives before the report."""
    scene = Scene().joined()
    first(scene)
    for stamp in range(2, 40):
        spoil(scene, DamagedImage("cut off"))
        scene.clock.advance(REPORT_INTERVAL / 4)
        scene.shot(stamp)
        scene.encode()
        scene.send(link.FrameAck(number=stamp))
    assert not [each for each in scene.heard() if isinstance(each, dict) and each.get("problem")]


def test_encoder_of_h264_that_fails_ends_the_stream() -> None:
    """Another codec may work, which viewers are informed of; errors of a camera do not end it."""
    scene = Scene(codec="h264").joined()
    first(scene)
    for _ in range(3 * MAX_FAULTS):
        spoil(scene, DamagedImage("cut off"))
    assert scene.transport.connected
    scene.shot(2)
    scene.encode()
    scene.send(link.FrameAck(number=2))
    scene.heard()
    for _ in range(MAX_FAULTS):
        assert scene.transport.connected
        spoil(scene, Unavailable("this size can't be encoded"))
    assert scene.heard()[-1]["reason"] == "this size can't be encoded"


def test_internal_error_in_between_is_logged_once_and_survived() -> None:
    """Details are for the log, not for viewers."""
    scene = Scene().joined()
    first(scene)
    with capturedLogs() as logs:
        for _ in range(5):
            spoil(scene, ZeroDivisionError("at /home/secret"))
    assert len(logs) == 1
    scene.clock.advance(2 * REPORT_INTERVAL)
    (said,) = scene.heard()
    assert "robot's log" in said["problem"] and "secret" not in said["problem"]
    assert scene.transport.connected


def first(scene: Scene) -> None:
    """One frame is shown."""
    scene.shot(1)
    scene.encode()
    scene.clock.advance(0.05)
    scene.send(link.FrameAck(number=1))
    scene.heard()


def test_internal_error_ends_the_stream_without_its_text() -> None:
    """Details are for the log, not for viewers."""
    scene = Scene().joined()
    scene.heard()
    scene.shot(1)
    scene.view.making[-1][1].errback(ZeroDivisionError("at /home/secret"))
    (said,) = scene.heard()
    assert said["op"] == "stream_refused"
    assert "secret" not in said["reason"]


def test_close_sends_bye_and_closes_the_camera() -> None:
    """A frame being encoded is not sent."""
    scene = Scene().joined()
    scene.shot(1)
    scene.heard()
    scene.stream.close("nobody watches")
    scene.encode()
    assert [each["op"] for each in scene.heard()] == ["bye"]
    assert scene.view.closed == 1
    assert scene.gone == ["nobody watches"]


def test_lost_link_closes_the_camera() -> None:
    """It is reported once."""
    scene = Scene().joined()
    scene.shot(1)
    scene.transport.loseConnection()
    scene.encode()
    assert scene.view.closed == 1
    assert len(scene.gone) == 1


def test_joined_to_another_stream_is_not_believed() -> None:
    """Frames of this camera do not belong to it."""
    scene = Scene()
    scene.send(link.Joined(channel="other", at=1))
    assert not scene.transport.connected
    assert scene.view.closed == 0


def doubted(scene: Scene) -> Scene:
    """Measurements have been longer than the round trip for so long that a probe is due."""
    now = scene.clock.seconds()
    scene.way.add_measurement(0.005, now)
    scene.way.add_measurement(0.4, now)
    scene.clock.advance(PROBE_AFTER)
    return scene


def test_round_trip_is_asked_for_by_the_first_byte_of_a_frame() -> None:
    """The rest is sent after its answer, and the relay gets the complete frame."""
    scene = doubted(Scene().joined())
    scene.shot(1)
    scene.encode(1000)
    (first,) = scene.heard()[1:]
    assert (first.offset, len(first.body), first.total) == (0, 1, 1000)
    scene.clock.advance(0.35)
    scene.send(link.FrameAck(number=1, received=1))
    (rest,) = scene.heard()
    joiner = frames.VideoFrameJoiner(2**22)
    assert joiner.join(first) is None
    assert joiner.join(rest) == frames.VideoFrame(1, 1, bytes(1000))
    assert scene.way.seconds == pytest.approx(0.35)


def test_frame_that_had_to_wait_for_another_stream_goes_when_that_is_over() -> None:
    """Even if the camera sends no other one."""
    scene = doubted(Scene().joined())
    scene.way.begin("another stream", scene.clock.seconds())
    scene.shot(1)
    scene.clock.advance(0.5)
    assert scene.view.making == []
    scene.way.idle("another stream", scene.clock.seconds())
    scene.clock.advance(0.1)
    assert len(scene.view.making) == 1


def test_lost_link_holds_up_no_other_stream() -> None:
    """Frames under way on it get no answer any more."""
    scene = doubted(Scene().joined())
    scene.shot(1)
    scene.encode(1000)
    assert not scene.way.may_send(scene.clock.seconds())
    scene.transport.loseConnection()
    assert scene.way.may_send(scene.clock.seconds())


def test_stream_begins_with_the_frame_that_was_there() -> None:
    """With its stamp; its age does not count for the uplink."""
    scene = Scene()
    scene.view.before = Frame(7, scene.clock.seconds() - 15, lambda: FrameFormat("rgb8", 64, 48), unread)
    scene.joined()
    scene.encode()
    assert scene.pictures() == [7]
    scene.clock.advance(0.02)
    scene.send(link.FrameAck(number=1))
    assert scene.stream.rate_control.delay == pytest.approx(0.02)
    assert scene.stream.rate_control.reduced == 0
    assert scene.stream.rate_control.may_send(scene.clock.seconds())
