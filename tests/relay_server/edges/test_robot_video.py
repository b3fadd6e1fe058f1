"""A robot's link of a stream, from its ticket to its end, as bytes on a connection."""

from __future__ import annotations

import json

import pytest
import pytest_twisted

from relay_protocol import PROTOCOL_VERSION, limits, link
from relay_protocol.frames import encode_json, encode_part, encode_picture_part, encode_sample, encode_video
from relay_server.robots.link_roles import QUESTIONS_AT_ONCE
from relay_server.video.stream import CameraStream, StreamState
from tests.relay_server.edges.robot_ends import Hall, Robot
from tests.relay_server.video.watching import CAMERA, Watcher, jpeg


async def asked_to_show(hall: Hall) -> tuple[Robot, CameraStream, Watcher, str]:
    """A registered robot with a camera somebody watches, and the ticket it was given."""
    robot = await hall.registered()
    robot.says(link.Cameras(cameras=[link.Camera(name=CAMERA)]))
    assert hall.presence is not None
    watcher = Watcher()
    stream = hall.world.videos.watch(hall.presence, CAMERA, link.VideoSettings(width=32), watcher)
    watcher.stream = stream
    hall.world.clock.advance(0)
    (ask,) = [each for each in robot.hears() if each["op"] == "open_video"]
    assert (ask["camera"], ask["settings"]) == (CAMERA, {"width": 32})
    return robot, stream, watcher, ask["ticket"]


async def joined(hall: Hall) -> tuple[Robot, CameraStream, Watcher]:
    """A stream's link, open."""
    end, stream, watcher, _ = await linked(hall)
    return end, stream, watcher


async def linked(hall: Hall) -> tuple[Robot, CameraStream, Watcher, Robot]:
    """A stream's link, open, and last the robot's control link."""
    robot, stream, watcher, ticket = await asked_to_show(hall)
    end = hall.dial()
    end.says(link.Join(version=PROTOCOL_VERSION, ticket=ticket))
    assert end.hears()[0] == {"op": "joined", "channel": stream.name, "at": hall.world.now_ns()}
    return end, stream, watcher, robot


def passes(hall: Hall, robot: Robot, seconds: float) -> None:
    """Time, in which the control link is not silent."""
    robot.says(link.Ping(t=1))
    hall.world.clock.advance(seconds)


def long_jpeg(kilobytes: int) -> bytes:
    """A picture with comments of about this size before it."""
    return jpeg()[:2] + (b"\xff\xfe\x03\xfe" + bytes(1020)) * kilobytes + jpeg()[2:]


@pytest_twisted.ensureDeferred
async def test_a_robot_joins_a_stream_and_pictures_flow(hall: Hall) -> None:
    """Also a large one; each is acknowledged, and what is played is told."""
    end, stream, watcher = await joined(hall)
    assert stream.state is StreamState.OPEN
    end.says(link.Playing(width=32, height=24, quality=80))
    end.sends(encode_video(1, 1_700_000_000_500_000_000, jpeg()))
    large = jpeg()[:2] + (b"\xff\xfe\xff\xff" + bytes(65533)) * 60 + jpeg()[2:]
    end.sends(encode_video(2, 1_700_000_001_000_000_000, large))
    assert watcher.played == [link.Playing(width=32, height=24, quality=80)]
    assert [(each.number, each.stamp, len(each.body)) for each in watcher.pictures] == [
        (1, 1_700_000_000.5, len(jpeg())),
        (2, 1_700_000_001.0, len(large)),
    ]
    end.says(link.Ping(t=5))
    assert end.hears()[-3:] == [
        {"op": "took", "number": 1},
        {"op": "took", "number": 2},
        {"op": "pong", "t": 5, "at": hall.world.now_ns()},
    ]
    end.says(link.Bye(reason="restarting"))
    assert stream.state is StreamState.OPENING
    assert not end.transport.connected


@pytest_twisted.ensureDeferred
async def test_a_picture_in_parts_is_one_picture_and_each_part_is_answered(hall: Hall) -> None:
    """One that breaks off is not shown, whatever way the next one comes."""
    end, _, watcher = await joined(hall)
    body = long_jpeg(3)
    end.sends(encode_picture_part(1, 5, len(body), 0, body[:8]))
    end.sends(encode_picture_part(1, 5, len(body), 8, body[8:1032]))
    end.sends(encode_picture_part(2, 6, len(body), 0, body[:9]))
    end.sends(encode_picture_part(2, 6, len(body), 9, body[9:]))
    end.sends(encode_picture_part(3, 7, len(body), 0, body[:9]))
    end.sends(encode_video(4, 8, body))
    assert [(each.number, each.body) for each in watcher.pictures] == [(2, body), (4, body)]
    took = [(each["number"], each.get("upto")) for each in end.hears() if each["op"] == "took"]
    assert took == [(1, 8), (1, 1032), (2, 9), (2, None), (3, 9), (4, None)]


@pytest_twisted.ensureDeferred
async def test_a_picture_that_comes_in_parts_for_long_is_waited_for(hall: Hall) -> None:
    """Longer than for one of which nothing is there."""
    end, _, watcher, robot = await linked(hall)
    body = long_jpeg(12)
    for at in range(0, 10240, 1024):
        end.sends(encode_picture_part(1, 5, len(body), at, body[at : at + 1024]))
        passes(hall, robot, 4)
    assert watcher.error is None
    end.sends(encode_picture_part(1, 5, len(body), 10240, body[10240:]))
    assert [each.body for each in watcher.pictures] == [body]


@pytest.mark.parametrize("size", [1, 1023])
@pytest_twisted.ensureDeferred
async def test_parts_are_not_so_small_that_answers_cost_more_than_pictures(hall: Hall, size: int) -> None:
    """But for the last, and the first by which a robot measures the round trip."""
    end, stream, watcher = await joined(hall)
    body = long_jpeg(3)
    end.sends(encode_picture_part(1, 5, len(body), 0, body[:1]))
    end.sends(encode_picture_part(1, 5, len(body), 1, body[1 : 1 + size]))
    assert "at least 1024 bytes" in end.refusal()["reason"]
    assert stream.state is not StreamState.OPEN
    assert watcher.error is None


@pytest_twisted.ensureDeferred
async def test_a_robot_that_begins_ever_new_pictures_by_one_byte_is_cut(hall: Hall) -> None:
    """One a second is enough to measure the round trip."""
    end, stream, _, robot = await linked(hall)
    for number in range(20):
        end.sends(encode_picture_part(number, 5, 5000, 0, b"\xff"))
        passes(hall, robot, 1)
    assert stream.state is StreamState.OPEN
    for number in range(QUESTIONS_AT_ONCE + 1):
        end.sends(encode_picture_part(number, 5, 5000, 0, b"\xff"))
    assert "at least 1024 bytes" in end.refusal()["reason"]
    assert stream.state is not StreamState.OPEN


@pytest_twisted.ensureDeferred
async def test_a_part_of_what_was_given_up_ends_the_stream(hall: Hall) -> None:
    """The robot can't know any more what it sends."""
    end, stream, watcher = await joined(hall)
    body = jpeg()
    end.sends(encode_picture_part(1, 5, len(body), 0, body[:8]))
    end.sends(encode_video(2, 6, body))
    end.sends(encode_picture_part(1, 5, len(body), 8, body[8:]))
    assert "does not follow" in end.refusal()["reason"]
    assert len(watcher.pictures) == 1
    assert stream.state is not StreamState.OPEN


@pytest_twisted.ensureDeferred
async def test_the_ticket_of_a_stream_is_good_once(hall: Hall) -> None:
    """The stream that is open already goes on."""
    _, stream, _, ticket = await asked_to_show(hall)
    hall.dial().says(link.Join(version=PROTOCOL_VERSION, ticket=ticket))
    again = hall.dial()
    again.says(link.Join(version=PROTOCOL_VERSION, ticket=ticket))
    assert "unknown, used or too old" in again.refusal()["reason"]
    assert stream.state is StreamState.OPEN


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (encode_video(1, 1, b"<html><script>alert(1)</script></html>"), "this is no JPEG"),
        (encode_video(1, 1, jpeg() + b"<html>"), "6 bytes come after the end"),
        (encode_video(1, 1, b""), "this is no JPEG"),
        (encode_sample(1, 1, b"x"), "samples go over the channel link"),
        (encode_part(1, 1, 1, 0, b"x"), "samples go over the channel link"),
        ((limits.PICTURE_FRAME + 1).to_bytes(4, "big"), "at most 4194304"),
        (encode_picture_part(1, 1, limits.PICTURE_FRAME - 12, 0, b"x"), "at most 4194291"),
        (encode_picture_part(1, 1, 13, 0, b"<html></html>"), "this is no JPEG"),
        (encode_json(b'{"op":"graph"}'), "graph"),
        (encode_json(b'{"op":"ping","t":1,"x":"' + b"x" * limits.JSON_BODY + b'"}'), "JSON of more than"),
    ],
    ids=[
        "html",
        "more",
        "nothing",
        "sample",
        "part",
        "too large",
        "too large in parts",
        "html in parts",
        "another link's",
        "long JSON",
    ],
)
@pytest_twisted.ensureDeferred
async def test_what_has_no_place_on_a_streams_link_ends_it(hall: Hall, data: bytes, words: str) -> None:
    """In words to the robot, and no viewer gets any of it."""
    end, stream, watcher = await joined(hall)
    end.sends(data)
    assert words in end.refusal()["reason"]
    assert watcher.pictures == []
    assert stream.state is not StreamState.OPEN


@pytest.mark.parametrize(
    "lie",
    [
        '"width":0',
        '"width":-5',
        '"height":8193',
        '"width":1' + 30 * "0",
        '"quality":101',
        '"fps":-1',
        '"reduced":1e308',
        '"delay_ms":-1',
        '"source_fps":1e300',
    ],
)
@pytest_twisted.ensureDeferred
async def test_what_can_not_be_is_not_told_to_viewers(hall: Hall, lie: str) -> None:
    """Who reads it need not check it again."""
    end, stream, watcher = await joined(hall)
    rest = ",".join(each for each in ('"width":1', '"height":1', '"quality":1') if each[:4] != lie[:4])
    end.sends(encode_json(f'{{"op":"playing",{lie},{rest}}}'.encode()))
    assert lie.split('"')[1] in end.refusal()["reason"]
    assert watcher.played == []
    assert stream.state is StreamState.OPENING


@pytest_twisted.ensureDeferred
async def test_html_instead_of_a_picture_ends_the_stream(hall: Hall) -> None:
    """The viewer is told, and the robot is not asked again."""
    end, stream, watcher = await joined(hall)
    end.sends(encode_video(1, 1, b"<html></html>"))
    assert str(watcher.error).startswith("robot r2-d2 sent what is no picture")
    assert stream.state is StreamState.CLOSED
    assert list(hall.world.videos) == []


@pytest.mark.parametrize("picture", [encode_video(1, 1, jpeg()), encode_picture_part(1, 1, 9, 0, b"x")])
@pytest.mark.parametrize("where", ["opening", "control", "channel"])
@pytest_twisted.ensureDeferred
async def test_pictures_have_no_place_on_other_links(hall: Hall, where: str, picture: bytes) -> None:
    """Neither before the proof nor after it."""
    end = hall.dial() if where == "opening" else await hall.registered()
    if where == "channel":
        assert hall.presence is not None
        hall.world.channels.of(hall.presence).attach(Member())
        hall.world.clock.advance(0)
        (ask,) = [each for each in end.hears() if each["op"] == "open_channel"]
        end = hall.dial()
        end.says(link.Join(version=PROTOCOL_VERSION, ticket=ask["ticket"]))
    end.sends(picture)
    assert end.refusal()["reason"] == "pictures have a link of their own"


class Member:
    """Somebody who is there."""

    def tell(self, level: str, text: str, id: object = None) -> None:
        """Not asked."""


@pytest_twisted.ensureDeferred
async def test_what_cameras_a_robot_has_is_kept_and_told(hall: Hall) -> None:
    """To whoever follows what the relay knows of robots."""
    robot = await hall.registered()
    changes: list[None] = []
    hall.registry.on_change(lambda: changes.append(None))
    has = [link.Camera(name=CAMERA, type="sensor_msgs/msg/Image", width=640, height=480, fps=15.0)]
    robot.says(link.Cameras(cameras=has))
    assert hall.presence is not None
    assert hall.presence.cameras == tuple(has)
    assert changes
    robot.says(link.Cameras())
    assert hall.presence.cameras == ()


@pytest_twisted.ensureDeferred
async def test_losing_the_control_link_ends_the_streams_link(hall: Hall) -> None:
    """The viewer waits; the robot is asked again when it is back."""
    robot, stream, watcher, ticket = await asked_to_show(hall)
    end = hall.dial()
    end.says(link.Join(version=PROTOCOL_VERSION, ticket=ticket))
    end.sends(encode_video(1, 1, jpeg()))
    robot.breaks()
    assert end.hears()[-1]["op"] == "bye"
    assert not end.transport.connected
    assert stream.state is StreamState.WAITING
    assert watcher.error is None


@pytest_twisted.ensureDeferred
async def test_a_robot_that_is_busy_hears_nothing_more(hall: Hall) -> None:
    """Its link ends, and the viewer hears the reason."""
    end, stream, watcher = await joined(hall)
    end.sends(encode_json(json.dumps({"op": "not_playing", "reason": "too warm", "busy": True}).encode()))
    assert end.hears()[-1]["op"] == "bye"
    assert str(watcher.error) == "too warm"
    assert stream.state is StreamState.CLOSED
