"""A robot's stream link, from its ticket to its end, as bytes on a connection."""

from __future__ import annotations

import json

import pytest
import pytest_twisted

from relay_protocol import PROTOCOL_VERSION, limits, link
from relay_protocol.frames import encode_json, encode_part, encode_sample, encode_video, encode_video_part
from relay_server.robots.link_handlers import SMALL_PARTS_BURST
from relay_server.video.stream import CameraStream, StreamState
from tests.worlds.robot_links import Robot, RobotLinkWorld
from tests.worlds.viewers import CAMERA, Watcher, jpeg


async def asked_to_show(scene: RobotLinkWorld) -> tuple[Robot, CameraStream, Watcher, str]:
    """A registered robot whose camera has a viewer, and its ticket."""
    robot = await scene.registered()
    robot.says(link.Cameras(cameras=[link.Camera(name=CAMERA)]))
    assert scene.presence is not None
    watcher = Watcher()
    stream = scene.world.videos.watch(scene.presence, CAMERA, link.VideoSettings(width=32), watcher)
    watcher.stream = stream
    scene.world.clock.advance(0)
    (ask,) = [each for each in robot.received() if each["op"] == "open_video"]
    assert (ask["camera"], ask["settings"]) == (CAMERA, {"width": 32})
    return robot, stream, watcher, ask["ticket"]


async def joined(scene: RobotLinkWorld) -> tuple[Robot, CameraStream, Watcher]:
    """An open stream link."""
    end, stream, watcher, _ = await linked(scene)
    return end, stream, watcher


async def linked(scene: RobotLinkWorld) -> tuple[Robot, CameraStream, Watcher, Robot]:
    """An open stream link, and the robot's control link."""
    robot, stream, watcher, ticket = await asked_to_show(scene)
    end = scene.dial()
    end.says(link.Join(version=PROTOCOL_VERSION, ticket=ticket))
    assert end.received()[0] == {"op": "joined", "channel": stream.name, "at": scene.world.now_ns()}
    return end, stream, watcher, robot


def passes(scene: RobotLinkWorld, robot: Robot, seconds: float) -> None:
    """Lets time pass while the control link is active."""
    robot.says(link.Ping(t=1))
    scene.world.clock.advance(seconds)


def long_jpeg(kilobytes: int) -> bytes:
    """A JPEG image with about this many bytes of comments."""
    return jpeg()[:2] + (b"\xff\xfe\x03\xfe" + bytes(1020)) * kilobytes + jpeg()[2:]


@pytest_twisted.ensureDeferred
async def test_a_robot_joins_a_stream_and_frames_flow(scene: RobotLinkWorld) -> None:
    """Large frames too; each is acknowledged, and the playback state is reported."""
    end, stream, watcher = await joined(scene)
    assert stream.state is StreamState.OPEN
    end.says(link.StreamStatus(width=32, height=24, quality=80))
    end.sends(encode_video(1, 1_700_000_000_500_000_000, jpeg()))
    large = jpeg()[:2] + (b"\xff\xfe\xff\xff" + bytes(65533)) * 60 + jpeg()[2:]
    end.sends(encode_video(2, 1_700_000_001_000_000_000, large))
    assert watcher.played == [link.StreamStatus(width=32, height=24, quality=80)]
    assert [(each.number, each.stamp, len(each.body)) for each in watcher.pictures] == [
        (1, 1_700_000_000.5, len(jpeg())),
        (2, 1_700_000_001.0, len(large)),
    ]
    end.says(link.Ping(t=5))
    assert end.received()[-3:] == [
        {"op": "frame_ack", "number": 1},
        {"op": "frame_ack", "number": 2},
        {"op": "pong", "t": 5, "at": scene.world.now_ns()},
    ]
    end.says(link.Bye(reason="restarting"))
    assert stream.state is StreamState.OPENING
    assert not end.transport.connected


@pytest_twisted.ensureDeferred
async def test_a_frame_in_parts_is_one_frame_and_each_part_is_answered(scene: RobotLinkWorld) -> None:
    """An interrupted frame is not shown; the next one may have any number of parts."""
    end, _, watcher = await joined(scene)
    body = long_jpeg(3)
    end.sends(encode_video_part(1, 5, len(body), 0, body[:8]))
    end.sends(encode_video_part(1, 5, len(body), 8, body[8:1032]))
    end.sends(encode_video_part(2, 6, len(body), 0, body[:9]))
    end.sends(encode_video_part(2, 6, len(body), 9, body[9:]))
    end.sends(encode_video_part(3, 7, len(body), 0, body[:9]))
    end.sends(encode_video(4, 8, body))
    assert [(each.number, each.body) for each in watcher.pictures] == [(2, body), (4, body)]
    took = [(each["number"], each.get("received")) for each in end.received() if each["op"] == "frame_ack"]
    assert took == [(1, 8), (1, 1032), (2, 9), (2, None), (3, 9), (4, None)]


@pytest_twisted.ensureDeferred
async def test_a_frame_that_comes_in_parts_for_long_is_waited_for(scene: RobotLinkWorld) -> None:
    """Longer than for a frame without any part."""
    end, _, watcher, robot = await linked(scene)
    body = long_jpeg(12)
    for at in range(0, 10240, 1024):
        end.sends(encode_video_part(1, 5, len(body), at, body[at : at + 1024]))
        passes(scene, robot, 4)
    assert watcher.error is None
    end.sends(encode_video_part(1, 5, len(body), 10240, body[10240:]))
    assert [each.body for each in watcher.pictures] == [body]


@pytest.mark.parametrize("size", [1, 1023])
@pytest_twisted.ensureDeferred
async def test_parts_are_not_so_small_that_answers_cost_more_than_frames(
    scene: RobotLinkWorld, size: int
) -> None:
    """Except the last one, and the first, which measures the round trip."""
    end, stream, watcher = await joined(scene)
    body = long_jpeg(3)
    end.sends(encode_video_part(1, 5, len(body), 0, body[:1]))
    end.sends(encode_video_part(1, 5, len(body), 1, body[1 : 1 + size]))
    assert "at least 1024 bytes" in end.refusal()["reason"]
    assert stream.state is not StreamState.OPEN
    assert watcher.error is None


@pytest_twisted.ensureDeferred
async def test_a_robot_that_begins_ever_new_frames_by_one_byte_is_cut(scene: RobotLinkWorld) -> None:
    """One per second is enough to measure the round trip."""
    end, stream, _, robot = await linked(scene)
    for number in range(20):
        end.sends(encode_video_part(number, 5, 5000, 0, b"\xff"))
        passes(scene, robot, 1)
    assert stream.state is StreamState.OPEN
    for number in range(SMALL_PARTS_BURST + 1):
        end.sends(encode_video_part(number, 5, 5000, 0, b"\xff"))
    assert "at least 1024 bytes" in end.refusal()["reason"]
    assert stream.state is not StreamState.OPEN


@pytest_twisted.ensureDeferred
async def test_a_part_of_what_was_given_up_ends_the_stream(scene: RobotLinkWorld) -> None:
    """The robot's state of the stream is wrong then."""
    end, stream, watcher = await joined(scene)
    body = jpeg()
    end.sends(encode_video_part(1, 5, len(body), 0, body[:8]))
    end.sends(encode_video(2, 6, body))
    end.sends(encode_video_part(1, 5, len(body), 8, body[8:]))
    assert "does not follow" in end.refusal()["reason"]
    assert len(watcher.pictures) == 1
    assert stream.state is not StreamState.OPEN


@pytest_twisted.ensureDeferred
async def test_the_ticket_of_a_stream_is_good_once(scene: RobotLinkWorld) -> None:
    """The open stream continues."""
    _, stream, _, ticket = await asked_to_show(scene)
    scene.dial().says(link.Join(version=PROTOCOL_VERSION, ticket=ticket))
    again = scene.dial()
    again.says(link.Join(version=PROTOCOL_VERSION, ticket=ticket))
    assert "unknown, used or too old" in again.refusal()["reason"]
    assert stream.state is StreamState.OPEN


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (encode_video(1, 1, b"<html><script>alert(1)</script></html>"), "not a JPEG"),
        (encode_video(1, 1, jpeg() + b"<html>"), "6 bytes follow the end"),
        (encode_video(1, 1, b""), "not a JPEG"),
        (encode_sample(1, 1, b"x"), "samples go over the channel link"),
        (encode_part(1, 1, 1, 0, b"x"), "samples go over the channel link"),
        ((limits.VIDEO_FRAME + 1).to_bytes(4, "big"), "at most 4194304"),
        (encode_video_part(1, 1, limits.VIDEO_FRAME - 12, 0, b"x"), "at most 4194291"),
        (encode_video_part(1, 1, 13, 0, b"<html></html>"), "not a JPEG"),
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
async def test_wrong_message_ends_the_link_of_a_stream(
    scene: RobotLinkWorld, data: bytes, words: str
) -> None:
    """The robot gets the reason, and viewers get nothing of the message."""
    end, stream, watcher = await joined(scene)
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
async def test_impossible_values_are_not_sent_to_viewers(scene: RobotLinkWorld, lie: str) -> None:
    """Viewers need not check values again."""
    end, stream, watcher = await joined(scene)
    rest = ",".join(each for each in ('"width":1', '"height":1', '"quality":1') if each[:4] != lie[:4])
    end.sends(encode_json(f'{{"op":"stream_status",{lie},{rest}}}'.encode()))
    assert lie.split('"')[1] in end.refusal()["reason"]
    assert watcher.played == []
    assert stream.state is StreamState.OPENING


@pytest_twisted.ensureDeferred
async def test_html_instead_of_a_frame_ends_the_stream(scene: RobotLinkWorld) -> None:
    """The viewer gets the error, and the robot is not asked again."""
    end, stream, watcher = await joined(scene)
    end.sends(encode_video(1, 1, b"<html></html>"))
    assert str(watcher.error).startswith("robot r2-d2 sent a frame that is not an image")
    assert stream.state is StreamState.CLOSED
    assert list(scene.world.videos) == []


@pytest.mark.parametrize("picture", [encode_video(1, 1, jpeg()), encode_video_part(1, 1, 9, 0, b"x")])
@pytest.mark.parametrize("where", ["opening", "control", "channel"])
@pytest_twisted.ensureDeferred
async def test_frames_have_no_place_on_other_links(scene: RobotLinkWorld, where: str, picture: bytes) -> None:
    """Neither before the proof nor after it."""
    end = scene.dial() if where == "opening" else await scene.registered()
    if where == "channel":
        assert scene.presence is not None
        scene.world.channels.of(scene.presence).attach(Member())
        scene.world.clock.advance(0)
        (ask,) = [each for each in end.received() if each["op"] == "open_channel"]
        end = scene.dial()
        end.says(link.Join(version=PROTOCOL_VERSION, ticket=ask["ticket"]))
    end.sends(picture)
    assert end.refusal()["reason"] == "camera frames go over the link of a camera stream"


class Member:
    """A member of a channel."""

    def notify(self, level: str, text: str, id: object = None) -> None:
        """Ignores it."""


@pytest_twisted.ensureDeferred
async def test_cameras_of_a_robot_are_stored_and_listed(scene: RobotLinkWorld) -> None:
    """Observers of the robot are notified."""
    robot = await scene.registered()
    changes: list[None] = []
    scene.registry.on_change(lambda: changes.append(None))
    has = [link.Camera(name=CAMERA, type="sensor_msgs/msg/Image", width=640, height=480, fps=15.0)]
    robot.says(link.Cameras(cameras=has))
    assert scene.presence is not None
    assert scene.presence.cameras == tuple(has)
    assert changes
    robot.says(link.Cameras())
    assert scene.presence.cameras == ()


@pytest_twisted.ensureDeferred
async def test_losing_the_control_link_ends_the_streams_link(scene: RobotLinkWorld) -> None:
    """The viewer waits; the robot is asked again when it is back."""
    robot, stream, watcher, ticket = await asked_to_show(scene)
    end = scene.dial()
    end.says(link.Join(version=PROTOCOL_VERSION, ticket=ticket))
    end.sends(encode_video(1, 1, jpeg()))
    robot.breaks()
    assert end.received()[-1]["op"] == "bye"
    assert not end.transport.connected
    assert stream.state is StreamState.WAITING
    assert watcher.error is None


@pytest_twisted.ensureDeferred
async def test_a_busy_robot_gets_no_further_request(scene: RobotLinkWorld) -> None:
    """Its link ends, and the viewer gets the reason."""
    end, stream, watcher = await joined(scene)
    end.sends(encode_json(json.dumps({"op": "stream_refused", "reason": "too warm", "busy": True}).encode()))
    assert end.received()[-1]["op"] == "bye"
    assert str(watcher.error) == "too warm"
    assert stream.state is StreamState.CLOSED
