"""A robot's services as processes beside it, read and used only through the relay."""

from __future__ import annotations

import json
import math
import socket
import wave
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image

from robot_client.sim.world import default
from tests.robot_client.services.test_battery import LAPTOP, supply
from tests.robot_client.services.test_gps import sentence
from tests.robot_client.services.test_ros import picture, repeated
from tests.worlds.face_images import EILEEN, people, scene
from tests.worlds.http_requests import Answer, ask
from tests.worlds.processes import running
from tests.worlds.relay_process import Relay
from tests.worlds.robot_process import Robot
from tests.worlds.service_process import TopicWatcher, service
from tests.worlds.sync_client import Client
from tests.worlds.waiting import wait_for

ROVER = "/api/v1/robots/rover"
CAMERA = ("--camera-size", "640x480", "--camera-fps", "5")
CHARGER = 7
"""The number of the marker that is beside the simulated robot's charger."""
TURNS = -0.3
"""Radians per second: the charger stays in the camera's view for four seconds."""
MOMENT_S = 0.1
"""Who drives says so ten times a second, and hears in between."""


class Site:
    """A relay with a robot, an operator, a viewer, and a user without a right."""

    def __init__(self, relay: Relay, robot: Robot) -> None:
        self.relay = relay
        self.robot = robot
        self.operator, self.viewer, self.stranger = (
            relay.user(name) for name in ("operator", "viewer", "stranger")
        )
        for level in ("operator", "viewer"):
            relay.cli("right", "grant", level, "rover", level)

    def ask(self, token: str, method: str, path: str, body: Any = None) -> Answer:
        """A request about the robot."""
        return ask(self.relay.http_port, method, f"{ROVER}/{path}", body, token=token)

    def reads(
        self,
        topic: str,
        like: Callable[[Any], Any] = lambda _: True,
        meanwhile: Callable[[], object] = lambda: None,
    ) -> Any:
        """The viewer's reading of a topic once it is as expected, with an action before each reading."""

        def read() -> list[Any]:
            meanwhile()
            answer = self.ask(self.viewer, "GET", f"topics/{topic}?wait=0.5")
            value = answer.json.get("value") if answer.status == 200 else None
            return [value] if value is not None and like(value) else []

        return wait_for(f"it is read on /{topic}", read)[0]

    def status(self) -> Any:
        """The robot in the viewer's list."""
        answer = ask(self.relay.http_port, "GET", "/api/v1/robots", token=self.viewer)
        return next(each for each in answer.json["robots"] if each["name"] == "rover")

    def diagnosed(self, name: str, words: str) -> None:
        """Waits until a node reports this on ``/diagnostics``, by the viewer's websocket."""
        with self.relay.connect("rover", self.viewer) as client:
            client.send(op="subscribe", topic="/diagnostics")

            def said() -> bool:
                message = client.until(op="publish", topic="/diagnostics")["msg"]
                return any(each["name"] == name and words in each["message"] for each in message["status"])

            wait_for(f"{name} says: {words}", said)

    def refuses(self, method: str, path: str, body: Any, status: int, words: str) -> None:
        """A request of the viewer is refused with a reason."""
        answer = self.ask(self.viewer, method, path, body)
        assert answer.status == status, answer.body
        assert words in answer.json["detail"]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """One for all; each test ends its service."""
    relay = Relay(tmp_path_factory.mktemp("site"))
    with running(relay):
        robot = Robot(relay, "rover", camera=True, sim_options=(*CAMERA, "--no-battery"))
        with running(robot):
            yield Site(relay, robot)


def test_the_charge_of_a_battery_is_in_the_robots_status(site: Site, tmp_path: Path) -> None:
    """From Linux: when it falls, the list of robots shows that, and /diagnostics reports it as low."""
    folder = supply(tmp_path / "supplies" / "BAT0", **LAPTOP)
    words = ("battery", "--folder", str(folder.parent), "--period", "0.1")
    with service(site.robot.domain, tmp_path, *words):
        reported = site.reads("battery_state", lambda each: each["location"] == "BAT0")
        assert (reported["percentage"], reported["voltage"]) == pytest.approx((0.57, 11.4))
        wait_for("the status has it", lambda: site.status()["battery"] == pytest.approx(0.57))
        supply(folder, capacity="15")
        wait_for("it falls", lambda: site.status()["battery"] == pytest.approx(0.15))
        site.diagnosed("battery", "low: 15 %")


def test_a_fix_of_a_receiver_is_read(site: Site, tmp_path: Path) -> None:
    """Degrees and metres from NMEA over TCP; without a fix there are no coordinates; without a right nothing
    is read.
    """
    here = sentence("GNGGA,120000,5005.400,N,01425.000,E,2,09,1.5,200.0,M,44.0,M,,") + b"\r\n"
    lost = sentence("GNGGA,120001,,,,,0,00,,,M,,M,,") + b"\r\n"
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        with service(site.robot.domain, tmp_path, "gps", address), server.accept()[0] as receiver:
            # Sentences from before the relay's subscription are lost, and a receiver repeats them.
            fix = site.reads(
                "fix", lambda each: each["status"]["status"] == 1, lambda: receiver.sendall(here)
            )
            assert (fix["latitude"], fix["longitude"]) == pytest.approx((50.09, 14.4166667), abs=1e-6)
            assert fix["altitude"] == pytest.approx(244.0)
            assert site.ask(site.stranger, "GET", "topics/fix").status == 404
            gone = site.reads(
                "fix", lambda each: each["status"]["status"] == -1, lambda: receiver.sendall(lost)
            )
            assert gone["latitude"] is None


def test_the_nearest_obstacle_of_the_scan_is_read(site: Site, tmp_path: Path) -> None:
    """At the distance of the simulator's scanner; later subscribers get the proximity state too."""
    with service(site.robot.domain, tmp_path, "obstacles", "--near", "9"):
        poses = site.reads("obstacles/places", lambda each: each["poses"])["poses"]
        distances = [math.hypot(each["position"]["x"], each["position"]["y"]) for each in poses]
        assert distances == sorted(distances)
        scan = site.reads("scan")
        measured = min(each for each in scan["ranges"] if each is not None and each >= scan["range_min"])
        assert distances[0] == pytest.approx(measured, abs=0.1)
        assert site.reads("obstacles/near")["data"] is True
        rays = site.reads("obstacles")["ranges"]
        assert len(rays) == 12
        assert min(filter(None, rays)) == pytest.approx(measured, abs=0.1)
        body = {"value": {"data": False}}
        site.refuses("PUT", "topics/obstacles/near", body, 403, "viewer")


def test_the_nearest_obstacle_of_an_image_of_depth_is_read(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A second camera measures depth: first a wall, then a post before it on the right, at their distances."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    watcher = TopicWatcher(site.robot.domain)
    try:
        depths = watcher.node.create_publisher(Image, "/front/depth", qos_profile_sensor_data)
        infos = watcher.node.create_publisher(CameraInfo, "/front/camera_info", qos_profile_sensor_data)
        pixels = np.full((48, 64), 3000, np.uint16)
        lens = CameraInfo(height=48, width=64, k=[60.0, 0, 31.5, 0, 60.0, 23.5, 0, 0, 1.0])

        def show() -> None:
            infos.publish(lens)
            depths.publish(picture(pixels, "16UC1", "front_optical_frame"))

        def front(message: Any) -> bool:
            """Another test's node may have published on that topic before."""
            return bool(message["header"]["frame_id"] == "front_frame")

        words = ("obstacles", "--depth", "/front/depth", "--sectors", "3", "--near", "1")
        with service(site.robot.domain, tmp_path, *words):
            assert site.reads("obstacles", front, show)["ranges"] == pytest.approx(
                [3.02, 3.0, 3.02], rel=0.02
            )
            site.reads("obstacles/near", lambda each: not each["data"], show)
            pixels[:, 50:] = 800
            site.reads("obstacles/near", lambda each: each["data"], show)
            post = 0.8 * math.hypot(1, 18.5 / 60)
            rays = site.reads("obstacles", lambda each: front(each) and each["ranges"][0] < 1, show)["ranges"]
            assert rays == pytest.approx([post, 3.0, 3.02], rel=0.02)
            places = site.reads("obstacles/places", lambda each: front(each) and each["poses"], show)
            nearest = places["poses"][0]["position"]
            assert (nearest["x"], nearest["y"]) == pytest.approx((0.8, -0.8 * 18.5 / 60), rel=0.02)
    finally:
        watcher.close()


def test_the_marker_of_the_charger_is_found_by_turning(site: Site, tmp_path: Path) -> None:
    """The operator turns the robot by websocket until its camera sees marker 7, at its distance."""
    words = ("markers", "--view", "75", "--size", "0.4")
    with (
        service(site.robot.domain, tmp_path, *words),
        site.relay.connect("rover", site.operator) as driver,
    ):
        site.reads("markers/seen")
        driver.send(op="subscribe", topic="/markers/seen")
        wait_for("control", lambda: driver.call("/relay/take_control")["values"]["success"])

        def seen() -> Any:
            driver.drive(0.0, TURNS)
            reported = received(driver, "/markers/seen")
            # A corner of these walls may look like another marker for a moment.
            found = json.loads(reported["data"])["markers"] if reported else []
            return next((each for each in found if each["id"] == CHARGER), None)

        marker = wait_for("the marker is seen", seen)
        assert site.robot.events("moving")
        driver.drive(0.0)
        wait_for("the robot stands", lambda: not site.robot.moving())
        assert driver.call("/relay/release_control")["values"]["success"]
    assert marker["distance"] == pytest.approx(to_charger(), rel=0.15)


def received(client: Client, topic: str) -> Any:
    """The next message on a topic within a short time, or None."""
    try:
        return client.until(MOMENT_S, op="publish", topic=topic)["msg"]
    except TimeoutError:
        return None


def to_charger() -> float:
    """Metres from the robot's start to the charger."""
    world = default()
    (charger,) = world.chargers
    wall = world.segments[charger.wall]
    share = charger.along / math.hypot(wall.x2 - wall.x1, wall.y2 - wall.y1)
    x, y = wall.x1 + share * (wall.x2 - wall.x1), wall.y1 + share * (wall.y2 - wall.y1)
    return math.hypot(x - world.start.x, y - world.start.y)


def test_a_face_at_a_camera_is_recognised_by_name(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another camera of the robot shows Eileen; the viewer reads the name and the position."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    watcher = TopicWatcher(site.robot.domain)
    try:
        images = watcher.node.create_publisher(Image, "/door/image_raw", qos_profile_sensor_data)
        message = picture(scene(EILEEN, 0.8, (120, 40)), "mono8", "door_optical_frame")
        show = repeated(lambda: images.publish(message), 0.1)
        folder = people(tmp_path / "people")
        words = ("faces", "--image", "/door/image_raw", "--view", "75", "--people", str(folder))
        with service(site.robot.domain, tmp_path, *words):

            def reported() -> Any:
                answer = site.ask(site.viewer, "GET", "topics/faces/seen?wait=0.2")
                return json.loads(answer.json["value"]["data"])["faces"] if answer.status == 200 else None

            (face,) = watcher.until("the face is read", reported, show)
    finally:
        watcher.close()
    assert face["name"] == "eileen" and 0 < face["distance"] < 5


def test_a_sentence_is_spoken_for_users_with_the_right(site: Site, tmp_path: Path) -> None:
    """An operator's text is written to the file and published; the viewer can neither speak nor cancel."""
    text = {"value": {"data": "I am there."}, "type": "std_msgs/msg/String"}
    sound = tmp_path / "said.wav"
    with (
        service(site.robot.domain, tmp_path, "speech", "--out", str(sound)),
        site.relay.connect("rover", site.viewer) as listener,
    ):
        listener.send(op="subscribe", topic="/said", type="std_msgs/msg/String")

        def speak() -> None:
            answer = site.ask(site.operator, "POST", "topics/say", text)
            assert answer.status == 204, answer.body

        # Messages before DDS has matched both are lost; the pause between repetitions lets each one end.
        say = repeated(speak, 2.0)

        def heard() -> bool:
            say()
            return bool(received(listener, "/said") == text["value"])

        wait_for("it is said", heard)
        site.refuses("POST", "topics/say", text, 403, "viewer")
        cancelled = wait_for("the service is known", lambda: cancel_speech(site))
        assert cancelled["success"] is True
        # A service without the right is not disclosed.
        site.refuses("POST", "services/say/cancel", {}, 404, "you have no right on it")
    with wave.open(str(sound)) as file:
        samples = np.frombuffer(file.readframes(file.getnframes()), np.int16).astype(float)
        assert len(samples) / file.getframerate() > 0.5
    assert np.abs(samples).max() > 3000


def cancel_speech(site: Site) -> Any:
    """The service's answer, once the relay knows it."""
    answer = site.ask(site.operator, "POST", "services/say/cancel", {})
    return answer.json["values"] if answer.status == 200 else None
