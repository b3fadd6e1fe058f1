"""A network camera without ROS, from its RTSP to viewers: real relay, daemon and camera process."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import psutil
import pytest

from tests.worlds.http_requests import Answer, ask
from tests.worlds.relay_process import Relay
from tests.worlds.robot_process import Robot
from tests.worlds.rtsp_camera import HEIGHT, WIDTH, RtspCamera
from tests.worlds.waiting import wait_for

LOGIN = "ann:s3cret"
SECRETS = ("s3cret", "rtsp:", "/front")
GONE = "camera /gate delivers no frames; trying again"
BACK = "camera /gate delivers frames again"


class Gate(NamedTuple):
    """A relay, a robot with only that camera, and a viewer."""

    relay: Relay
    robot: Robot
    camera: RtspCamera
    token: str

    def get(self, what: str) -> Answer:
        """The answer to a request below the robot's ``video``."""
        path = f"/robots/gatekeeper/video/{what}?topic=/gate"
        return ask(self.relay.http_port, "GET", path, token=self.token)

    def stream(self) -> cv2.VideoCapture:
        """A player of the stream."""
        port = self.relay.http_port
        wanted = {"robot": "gatekeeper", "for": "video", "camera": "/gate"}
        ticket = ask(port, "POST", "/api/v1/tickets", wanted, token=self.token).json["ticket"]
        address = f"http://127.0.0.1:{port}/robots/gatekeeper/video/stream?topic=/gate&ticket={ticket}"
        return cv2.VideoCapture(address, cv2.CAP_FFMPEG)

    def cameras(self) -> list[dict[str, Any]]:
        """Cameras that the relay knows."""
        return list(self.get("cameras").json["cameras"])

    @property
    def log(self) -> str:
        """The daemon's log."""
        return self.robot.daemon.log.read_text()


@pytest.fixture
def gate(tmp_path: Path) -> Iterator[Gate]:
    with ExitStack() as stack:
        camera = stack.enter_context(closing(RtspCamera(login=LOGIN)))
        settings = tmp_path / "robot.toml"
        settings.write_text(f'[cameras]\n"/gate" = "{camera.url}"\n')
        relay = Relay(tmp_path)
        stack.callback(relay.stop)
        robot = Robot(relay, "gatekeeper", daemon_env={"SWITCHBOARD_ROBOT_CONFIG": str(settings)})
        stack.callback(robot.stop)
        token = relay.user("ann")
        relay.cli("right", "grant", "ann", "gatekeeper", "viewer")
        made = Gate(relay, robot, camera, token)
        wait_for("its camera is known", made.cameras)
        yield made


def check(pixels: Any) -> None:
    """Checks the camera's picture: a red square in the upper left corner of a grey image."""
    assert pixels.shape == (HEIGHT, WIDTH, 3)
    blue, green, red = pixels[10 : HEIGHT // 2 - 10, 10 : WIDTH // 2 - 10].mean((0, 1))
    assert red > 180 and max(blue, green) < 40
    grey = pixels[HEIGHT // 2 + 10 : -30].mean((0, 1))
    assert np.abs(grey - 120).max() < 15


def test_a_camera_of_the_network_is_shown_and_found_again(gate: Gate) -> None:
    """Its frames arrive as a snapshot and as a stream. While it is away new requests get an error, and a
    stream continues when it returns. Neither viewers nor logs contain its address or password.
    """
    snapshot = gate.get("snapshot")
    assert snapshot.status == 200
    check(cv2.imdecode(np.frombuffer(snapshot.body, np.uint8), cv2.IMREAD_COLOR))
    player = gate.stream()
    try:
        for _ in range(5):
            there, pixels = player.read()
            assert there
            check(pixels)
        (seen,) = wait_for(
            "its size is known", lambda: [each for each in gate.cameras() if each["width"] == WIDTH]
        )
        assert (seen["name"], seen["type"], seen["encoding"]) == ("/gate", "", "bgr8")
        daemon = psutil.Process(gate.robot.daemon.popen.pid)
        commands = [each.cmdline() for each in (daemon, *daemon.children(recursive=True))]

        gate.camera.close()
        wait_for("its absence is told", lambda: GONE in gate.log)
        # For 0.5 s the last frame counts as new.
        while (late := gate.get("snapshot")).status == 200:
            pass
        assert (late.status, late.json["detail"]) == (504, "camera /gate has sent no frame for 10 s")
        assert gate.log.count(GONE) == 1
        with closing(RtspCamera(gate.camera.port, LOGIN)):
            wait_for("its return is told", lambda: BACK in gate.log)
            for _ in range(5):
                there, pixels = player.read()
                assert there
            check(pixels)
            with gate.relay.connect("gatekeeper", gate.token) as client:
                client.send(op="subscribe", topic="/relay/status")
                status = client.until(op="publish", topic="/relay/status")
    finally:
        player.release()
    reported = [json.dumps(each) for each in (seen, status, commands)]
    for secret in SECRETS:
        assert not [each for each in (*reported, gate.relay.log) if secret in each]
    assert "s3cret" not in gate.log
