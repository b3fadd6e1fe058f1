"""Robots that send invalid frames, or are not allowed any more: viewers get only real pictures and an end."""

from __future__ import annotations

import contextlib
import http.client
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import pytest

from relay_protocol import PROTOCOL_VERSION, identity, link
from relay_protocol.frames import encode_video
from tests.worlds.fake_robot import FakeRobot
from tests.worlds.http_requests import ask
from tests.worlds.relay_process import Relay
from tests.worlds.waiting import PATIENCE, wait_for

CAMERA = "/front/image"
JPEG = cv2.imencode(".jpg", np.zeros((24, 32, 3), np.uint8))[1].tobytes()
OTHER = cv2.imencode(".jpg", np.full((48, 64, 3), 90, np.uint8))[1].tobytes()
PATH = f"/robots/liar/video/{{}}?topic={CAMERA}"
HTML = b"<!doctype html><script>alert(document.cookie)</script>"


@dataclass
class World:
    """A relay, a viewer with all rights on the robot ``liar``, and that robot's key."""

    relay: Relay
    token: str
    key: bytes

    @property
    def fingerprint(self) -> str:
        """The fingerprint of the robot's key."""
        return identity.fingerprint(identity.public_half(self.key))

    @contextlib.contextmanager
    def robot(self) -> Iterator[FakeRobot]:
        """Its control link, with one camera."""
        with FakeRobot(self.relay.robots_port) as robot:
            assert robot.register("liar", self.key)["op"] == "welcome"
            robot.send(link.Cameras(cameras=[link.Camera(name=CAMERA)]))
            yield robot

    @contextlib.contextmanager
    def showing(self, control: FakeRobot) -> Iterator[FakeRobot]:
        """The link of the requested stream."""
        asked = control.until("open_video")
        assert asked["camera"] == CAMERA
        with FakeRobot(self.relay.robots_port) as end:
            end.send(link.Join(version=PROTOCOL_VERSION, ticket=asked["ticket"]))
            assert end.until("joined")["channel"] == asked["stream"]
            yield end


@contextlib.contextmanager
def ended_by_this(viewer: Viewer) -> Iterator[None]:
    """The block ends a viewer's stream."""
    yield
    viewer.join(PATIENCE)
    assert not viewer.is_alive()


class Viewer(threading.Thread):
    """Reads a stream to its end."""

    def __init__(self, world: World) -> None:
        super().__init__()
        self.seen = b""
        self._shed = world
        self.start()

    def run(self) -> None:
        """Runs in a thread; a stream that has begun may end by a reset."""
        connection = http.client.HTTPConnection("127.0.0.1", self._shed.relay.http_port, timeout=20)
        connection.request(
            "GET", PATH.format("stream"), headers={"Authorization": f"Bearer {self._shed.token}"}
        )
        with contextlib.closing(connection), contextlib.suppress(ConnectionResetError):
            answer = connection.getresponse()
            while data := answer.read1():
                self.seen += data

    def sees_a_picture(self) -> None:
        """Waits for the first frame."""
        wait_for("a picture comes", lambda: JPEG in self.seen)


@pytest.fixture
def world(tmp_path: Any) -> Iterator[World]:
    """One relay for each test: robots are removed."""
    relay = Relay(tmp_path)
    try:
        token = relay.user("ann")
        key = identity.generate_key()
        code = relay.cli("robot", "add", "liar")["enrolment_code"]
        with FakeRobot(relay.robots_port) as robot:
            assert robot.enroll("liar", code, key)["op"] == "enrolled"
        relay.cli("right", "grant", "ann", "liar", "viewer")
        yield World(relay, token, key)
    finally:
        relay.stop()


def test_html_never_reaches_a_viewer(world: World) -> None:
    """The robot gets the reason of its disconnection. Viewers with real frames stay, and get those of the
    next link.
    """
    with world.robot() as control:
        viewer = Viewer(world)
        with world.showing(control) as end:
            end.send(link.StreamStatus(width=32, height=24, quality=80))
            end.send_bytes(encode_video(1, time.time_ns(), JPEG))
            assert end.until("frame_ack")["number"] == 1
            viewer.sees_a_picture()
            end.send_bytes(encode_video(2, time.time_ns(), HTML))
            refused = end.until("refused")
            assert refused["code"] == "malformed"
            assert "not a JPEG" in refused["reason"]
            assert end.ended()
        reported = ask(world.relay.http_port, "GET", "/api/v1/robots/liar/cameras", token=world.token).json
        (stream,) = reported["cameras"][0]["streams"]
        assert "not a JPEG" in stream["stream_status"]["problem"]
        with world.showing(control) as end:
            end.send_bytes(encode_video(1, time.time_ns(), OTHER))
            assert end.until("frame_ack")["number"] == 1
            wait_for("another picture comes", lambda: OTHER in viewer.seen)
            world.relay.cli("right", "revoke", "ann", "liar")
        viewer.join(PATIENCE)
        assert not viewer.is_alive()
        assert b"script" not in viewer.seen
        assert control.until("close_video")


def test_html_instead_of_a_snapshot_is_reported(world: World) -> None:
    """The error is JSON without any of the robot's bytes."""
    with world.robot() as control, ThreadPoolExecutor(1) as pool:
        snapshot = pool.submit(ask, world.relay.http_port, "GET", PATH.format("snapshot"), token=world.token)
        with world.showing(control) as end:
            end.send_bytes(encode_video(1, time.time_ns(), HTML))
            assert end.until("refused")
        answer = snapshot.result(PATIENCE)
        assert answer.status == 503
        assert "sent a frame that is not an image" in str(answer.json)
        assert b"script" not in answer.body


@pytest.mark.parametrize("how", ["revoked", "removed"])
def test_a_robot_whose_key_is_not_accepted_any_more_is_not_seen_any_more(world: World, how: str) -> None:
    """Its streams end within a second, and so do its links."""
    with world.robot() as control:
        viewer = Viewer(world)
        with world.showing(control) as end:
            end.send_bytes(encode_video(1, time.time_ns(), JPEG))
            viewer.sees_a_picture()
            with ended_by_this(viewer):
                if how == "revoked":
                    world.relay.cli("robot", "keys", "liar", "--revoke", world.fingerprint)
                else:
                    world.relay.cli("robot", "remove", "liar", "--yes")
            assert end.ended()
        assert control.ended()


@pytest.mark.parametrize("how", ["right", "pattern", "token"])
def test_a_viewer_whose_right_is_revoked_sees_no_more(world: World, how: str) -> None:
    """Within a second; without viewers the robot is asked to stop."""
    with world.robot() as control:
        viewer = Viewer(world)
        with world.showing(control) as end:
            end.send_bytes(encode_video(1, time.time_ns(), JPEG))
            viewer.sees_a_picture()
            tokens = [str(each["id"]) for each in world.relay.cli("token", "list") if each["user"] == "ann"]
            with ended_by_this(viewer):
                if how == "right":
                    world.relay.cli("right", "revoke", "ann", "liar")
                elif how == "pattern":
                    world.relay.cli("right", "grant", "ann", "liar", "viewer", "--deny", f"view:{CAMERA}")
                else:
                    world.relay.cli("token", "revoke", *tokens)
            assert control.until("close_video")
    answer = ask(world.relay.http_port, "GET", PATH.format("stream"), token=world.token)
    assert answer.status == (401 if how == "token" else 404)
