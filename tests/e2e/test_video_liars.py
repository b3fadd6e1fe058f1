"""Robots that show what is no picture, or may show none any more: their viewers get real pictures and an end."""

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
from switchboard_fake_robot import FakeRobot
from switchboard_http import ask
from switchboard_pulse import Pulse
from switchboard_relay import Relay
from switchboard_waiting import PATIENCE, wait_for

from relay_protocol import PROTOCOL_VERSION, identity, link
from relay_protocol.frames import encode_video

CAMERA = "/front/image"
JPEG = cv2.imencode(".jpg", np.zeros((24, 32, 3), np.uint8))[1].tobytes()
OTHER = cv2.imencode(".jpg", np.full((48, 64, 3), 90, np.uint8))[1].tobytes()
PATH = f"/robots/liar/video/{{}}?topic={CAMERA}"
HTML = b"<!doctype html><script>alert(document.cookie)</script>"


@dataclass
class Shed:
    """A relay, somebody who may see all of the robot ``liar``, and that robot's key."""

    relay: Relay
    token: str
    key: bytes

    @property
    def fingerprint(self) -> str:
        """Of the robot's key."""
        return identity.fingerprint(identity.public_half(self.key))

    @contextlib.contextmanager
    def robot(self) -> Iterator[FakeRobot]:
        """Its control link; one camera is there."""
        with FakeRobot(self.relay.robots_port) as robot:
            assert robot.register("liar", self.key)["op"] == "welcome"
            robot.send(link.Cameras(cameras=[link.Camera(name=CAMERA)]))
            yield robot

    @contextlib.contextmanager
    def showing(self, control: FakeRobot) -> Iterator[FakeRobot]:
        """The link of the stream the robot is asked for."""
        asked = control.until("open_video")
        assert asked["camera"] == CAMERA
        with FakeRobot(self.relay.robots_port) as end:
            end.send(link.Join(version=PROTOCOL_VERSION, ticket=asked["ticket"]))
            assert end.until("joined")["channel"] == asked["stream"]
            yield end


@contextlib.contextmanager
def within_a_second(viewer: Viewer) -> Iterator[None]:
    """What is done here ends a viewer's stream within a second of its end, by a machine that goes on."""
    with Pulse() as pulse:
        yield
        begun = time.monotonic()
        viewer.join(PATIENCE)
        assert not viewer.is_alive()
        assert time.monotonic() - begun < 1 + pulse.lost()


class Viewer(threading.Thread):
    """Reads a stream to its end."""

    def __init__(self, shed: Shed) -> None:
        super().__init__()
        self.seen = b""
        self._shed = shed
        self.start()

    def run(self) -> None:
        """In a thread; a stream that has begun may end by a reset."""
        connection = http.client.HTTPConnection("127.0.0.1", self._shed.relay.http_port, timeout=20)
        connection.request(
            "GET", PATH.format("stream"), headers={"Authorization": f"Bearer {self._shed.token}"}
        )
        with contextlib.closing(connection), contextlib.suppress(ConnectionResetError):
            answer = connection.getresponse()
            while data := answer.read1():
                self.seen += data

    def sees_a_picture(self) -> None:
        """Wait for the first."""
        wait_for("a picture comes", lambda: JPEG in self.seen)


@pytest.fixture
def shed(tmp_path: Any) -> Iterator[Shed]:
    """One relay for each test: robots are removed."""
    relay = Relay(tmp_path)
    try:
        token = relay.user("ann")
        key = identity.generate_key()
        code = relay.cli("robot", "add", "liar")["enrolment_code"]
        with FakeRobot(relay.robots_port) as robot:
            assert robot.enroll("liar", code, key)["op"] == "enrolled"
        relay.cli("right", "grant", "ann", "liar", "viewer")
        yield Shed(relay, token, key)
    finally:
        relay.stop()


def test_html_never_reaches_a_viewer(shed: Shed) -> None:
    """The robot is told why it is cut. Who has seen real pictures stays, and sees those that come by another link."""
    with shed.robot() as control:
        viewer = Viewer(shed)
        with shed.showing(control) as end:
            end.send(link.Playing(width=32, height=24, quality=80))
            end.send_bytes(encode_video(1, time.time_ns(), JPEG))
            assert end.until("took")["number"] == 1
            viewer.sees_a_picture()
            end.send_bytes(encode_video(2, time.time_ns(), HTML))
            refused = end.until("refused")
            assert refused["code"] == "malformed"
            assert "this is no JPEG" in refused["reason"]
            assert end.ended()
        told = ask(shed.relay.http_port, "GET", "/api/v1/robots/liar/cameras", token=shed.token).json
        (stream,) = told["cameras"][0]["streams"]
        assert "this is no JPEG" in stream["playing"]["trouble"]
        with shed.showing(control) as end:
            end.send_bytes(encode_video(1, time.time_ns(), OTHER))
            assert end.until("took")["number"] == 1
            wait_for("another picture comes", lambda: OTHER in viewer.seen)
            shed.relay.cli("right", "revoke", "ann", "liar")
        viewer.join(PATIENCE)
        assert not viewer.is_alive()
        assert b"script" not in viewer.seen
        assert control.until("close_video")


def test_who_asked_for_a_snapshot_and_got_html_is_told_in_words(shed: Shed) -> None:
    """An error, as JSON, that shows nothing of what came."""
    with shed.robot() as control, ThreadPoolExecutor(1) as pool:
        snapshot = pool.submit(ask, shed.relay.http_port, "GET", PATH.format("snapshot"), token=shed.token)
        with shed.showing(control) as end:
            end.send_bytes(encode_video(1, time.time_ns(), HTML))
            assert end.until("refused")
        answer = snapshot.result(PATIENCE)
        assert answer.status == 503
        assert "sent what is no picture" in str(answer.json)
        assert b"script" not in answer.body


@pytest.mark.parametrize("how", ["revoked", "removed"])
def test_a_robot_whose_key_is_not_accepted_any_more_is_not_seen_any_more(shed: Shed, how: str) -> None:
    """Its streams end within a second, and so do its links."""
    with shed.robot() as control:
        viewer = Viewer(shed)
        with shed.showing(control) as end:
            end.send_bytes(encode_video(1, time.time_ns(), JPEG))
            viewer.sees_a_picture()
            with within_a_second(viewer):
                if how == "revoked":
                    shed.relay.cli("robot", "keys", "liar", "--revoke", shed.fingerprint)
                else:
                    shed.relay.cli("robot", "remove", "liar", "--yes")
            assert end.ended()
        assert control.ended()


@pytest.mark.parametrize("how", ["right", "pattern", "token"])
def test_a_viewer_whose_right_is_revoked_sees_no_more(shed: Shed, how: str) -> None:
    """Within a second; the robot, which nobody watches any more, is told to stop."""
    with shed.robot() as control:
        viewer = Viewer(shed)
        with shed.showing(control) as end:
            end.send_bytes(encode_video(1, time.time_ns(), JPEG))
            viewer.sees_a_picture()
            tokens = [str(each["id"]) for each in shed.relay.cli("token", "list") if each["user"] == "ann"]
            with within_a_second(viewer):
                if how == "right":
                    shed.relay.cli("right", "revoke", "ann", "liar")
                elif how == "pattern":
                    shed.relay.cli("right", "grant", "ann", "liar", "viewer", "--deny", f"view:{CAMERA}")
                else:
                    shed.relay.cli("token", "revoke", *tokens)
            assert control.until("close_video")
    answer = ask(shed.relay.http_port, "GET", PATH.format("stream"), token=shed.token)
    assert answer.status == (401 if how == "token" else 404)
