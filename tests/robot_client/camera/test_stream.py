"""One stream in memory: a link without a socket, a camera without pictures, threads that the test is."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest
from twisted.internet.defer import Deferred
from twisted.internet.task import Clock
from twisted.internet.testing import StringTransportWithDisconnection

from relay_protocol import frames, link
from relay_protocol.errors import Invalid, NotFound, SwitchboardError
from robot_client.camera.leaving import PART
from robot_client.camera.lines import Open
from robot_client.camera.shot import Look, Made, Shot, Wish
from robot_client.camera.stream import FAULTS, TELL_EVERY, Busy, Stream
from robot_client.link import VideoLink
from robot_client.transport import LinkProtocol

QUIET = ("join", "ping", "pong")


def unread() -> Any:
    raise AssertionError("nobody here reads pixels")


class View:
    """The camera as the stream has it; pictures are made when the test says so."""

    def __init__(self) -> None:
        self.fps = 15.0
        self.closed = 0
        self.wishes: list[Wish] = []
        self.making: list[tuple[Shot, Deferred[Made]]] = []

    def make(self, shot: Shot, wish: Wish) -> Deferred[Made]:
        self.wishes.append(wish)
        done: Deferred[Made] = Deferred()
        self.making.append((shot, done))
        return done

    def close(self) -> None:
        self.closed += 1


class Scene:
    def __init__(self, refusal: SwitchboardError | None = None, **settings: Any) -> None:
        self.clock = Clock()
        self.clock.advance(100)
        self.view = View()
        self.gone: list[str] = []
        self._refusal = refusal
        line = Open(
            stream="s",
            ticket="t",
            camera="/c",
            topic="/c",
            settings=link.VideoSettings(**settings),
            heartbeat=2.0,
        )
        self.protocol = LinkProtocol(
            VideoLink("t", self.now, 2.0),
            lambda protocol: Stream(
                line, protocol, self.watch, self.clock, lambda _, why: self.gone.append(why)
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

    def watch(self, line: Open, on_shot: Callable[[Shot], None]) -> View:
        if self._refusal is not None:
            raise self._refusal
        self.shoot: Callable[[Shot], None] = on_shot
        return self.view

    def say(self, message: link.Message) -> None:
        self.protocol.dataReceived(link.frame(message))

    def joined(self) -> Scene:
        self.say(link.Joined(channel="s", at=1))
        for _ in range(3):
            self.say(link.Pong(t=self.now(), at=2))
        return self

    def shot(self, stamp: int) -> None:
        self.shoot(Shot(stamp, self.clock.seconds(), lambda: Look("rgb8", 64, 48), unread))

    def make(self, size: int = 1000, width: int = 64) -> None:
        """End the making of the latest picture."""
        self.view.making[-1][1].callback(Made(bytes(size), width, 48, "rgb8"))

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


def test_broken_picture_in_between_is_left_out() -> None:
    """A stream that has shown something bears some broken pictures in a row, not for ever."""
    scene = Scene().joined()
    scene.shot(1)
    scene.make()
    scene.clock.advance(0.05)
    scene.say(link.Took(number=1))
    for broken in range(FAULTS):
        assert scene.transport.connected, broken
        scene.shot(2)
        scene.view.making[-1][1].errback(Invalid("cut off"))
    assert scene.heard()[-1]["reason"] == "cut off"
    assert not scene.transport.connected


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
