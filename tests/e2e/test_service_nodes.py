"""A robot's services as processes beside it, read and used through the relay alone."""

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
from switchboard_client import Client
from switchboard_http import Answer, ask
from switchboard_processes import running
from switchboard_relay import Relay
from switchboard_robot import Robot
from switchboard_waiting import wait_for

from robot_client.sim.worlds import default
from tests.robot_client.services.onlooker import Onlooker, service
from tests.robot_client.services.pictures_of_people import EILEEN, people, scene
from tests.robot_client.services.test_battery import LAPTOP, supply
from tests.robot_client.services.test_gps import sentence
from tests.robot_client.services.test_ros import picture, repeated

ROVER = "/api/v1/robots/rover"
CAMERA = ("--camera-size", "640x480", "--camera-fps", "5")
CHARGER = 7
"""The number of the marker that is beside the simulated robot's charger."""
TURNS = -0.3
"""Radians per second: the charger stays in the camera's view for four seconds."""
MOMENT_S = 0.1
"""Who drives says so ten times a second, and hears in between."""


class Site:
    """A relay with a robot, somebody who operates it, somebody who only looks, and somebody without a right."""

    def __init__(self, relay: Relay, robot: Robot) -> None:
        self.relay = relay
        self.robot = robot
        self.operator, self.viewer, self.stranger = (
            relay.user(name) for name in ("operator", "viewer", "stranger")
        )
        for level in ("operator", "viewer"):
            relay.cli("right", "grant", level, "rover", level)

    def ask(self, token: str, method: str, path: str, body: Any = None) -> Answer:
        """One request about the robot."""
        return ask(self.relay.http_port, method, f"{ROVER}/{path}", body, token=token)

    def reads(
        self,
        topic: str,
        like: Callable[[Any], Any] = lambda _: True,
        meanwhile: Callable[[], object] = lambda: None,
    ) -> Any:
        """What who only looks reads of a topic, as soon as it is as wanted; something is done before each reading."""

        def read() -> list[Any]:
            meanwhile()
            answer = self.ask(self.viewer, "GET", f"topics/{topic}?wait=0.5")
            value = answer.json.get("value") if answer.status == 200 else None
            return [value] if value is not None and like(value) else []

        return wait_for(f"it is read on /{topic}", read)[0]

    def status(self) -> Any:
        """The robot as who only looks has it in his list."""
        answer = ask(self.relay.http_port, "GET", "/api/v1/robots", token=self.viewer)
        return next(each for each in answer.json["robots"] if each["name"] == "rover")

    def diagnosed(self, name: str, words: str) -> None:
        """Wait until a node says this of itself on ``/diagnostics``, as who only looks hears it by websocket."""
        with self.relay.connect("rover", self.viewer) as client:
            client.send(op="subscribe", topic="/diagnostics")

            def said() -> bool:
                message = client.until(op="publish", topic="/diagnostics")["msg"]
                return any(each["name"] == name and words in each["message"] for each in message["status"])

            wait_for(f"{name} says: {words}", said)

    def refuses(self, method: str, path: str, body: Any, status: int, words: str) -> None:
        """A request of who only looks is refused, in words that say why."""
        answer = self.ask(self.viewer, method, path, body)
        assert answer.status == status, answer.body
        assert words in answer.json["detail"]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """One for all; each test ends the service that it runs."""
    relay = Relay(tmp_path_factory.mktemp("site"))
    with running(relay):
        robot = Robot(relay, "rover", camera=True, sim_options=CAMERA)
        with running(robot):
            yield Site(relay, robot)


def test_the_charge_of_a_battery_is_in_the_robots_status(site: Site, tmp_path: Path) -> None:
    """As Linux tells it: when it falls, the list of robots shows that, and /diagnostics says that it is low."""
    folder = supply(tmp_path / "supplies" / "BAT0", **LAPTOP)
    words = ("battery", "--folder", str(folder.parent), "--period", "0.1")
    with service(site.robot.domain, tmp_path, *words):
        # The simulator has a battery, too, on the same topic: whoever spoke last is read.
        told = site.reads("battery_state", lambda each: each["location"] == "BAT0")
        assert (told["percentage"], told["voltage"]) == pytest.approx((0.57, 11.4))
        wait_for("the status has it", lambda: site.status()["battery"] == pytest.approx(0.57))
        supply(folder, capacity="15")
        wait_for("it falls", lambda: site.status()["battery"] == pytest.approx(0.15))
        site.diagnosed("battery", "low: 15 %")


def test_a_fix_of_a_receiver_is_read(site: Site, tmp_path: Path) -> None:
    """Degrees and metres from NMEA over TCP; without a fix there are no coordinates; a stranger reads nothing."""
    here = sentence("GNGGA,120000,5005.400,N,01425.000,E,2,09,1.5,200.0,M,44.0,M,,") + b"\r\n"
    lost = sentence("GNGGA,120001,,,,,0,00,,,M,,M,,") + b"\r\n"
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        with service(site.robot.domain, tmp_path, "gps", address), server.accept()[0] as receiver:
            # Nobody hears what was said before the relay had asked for it: a receiver says it again and again.
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
    """As far away as the simulator's scanner measures it; that something is near is read by who comes later."""
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


def test_the_nearest_obstacle_of_a_picture_of_depth_is_read(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A second camera measures depth: first a wall, then a post before it on the right, as far away as it is."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    onlooker = Onlooker(site.robot.domain)
    try:
        depths = onlooker.node.create_publisher(Image, "/front/depth", qos_profile_sensor_data)
        infos = onlooker.node.create_publisher(CameraInfo, "/front/camera_info", qos_profile_sensor_data)
        pixels = np.full((48, 64), 3000, np.uint16)
        lens = CameraInfo(height=48, width=64, k=[60.0, 0, 31.5, 0, 60.0, 23.5, 0, 0, 1.0])

        def show() -> None:
            infos.publish(lens)
            depths.publish(picture(pixels, "16UC1", "front_optical_frame"))

        def front(message: Any) -> bool:
            """Another test's node may have said something on that topic before."""
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
        onlooker.close()


def test_the_marker_of_the_charger_is_found_by_turning(site: Site, tmp_path: Path) -> None:
    """The operator turns the robot by websocket until its camera sees marker 7, as far away as it is."""
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
            told = hears(driver, "/markers/seen")
            # Of so many walls a corner may look like another marker for a moment.
            found = json.loads(told["data"])["markers"] if told else []
            return next((each for each in found if each["id"] == CHARGER), None)

        marker = wait_for("the marker is seen", seen)
        assert site.robot.events("moving")
        driver.drive(0.0)
        wait_for("the robot stands", lambda: not site.robot.moving())
        assert driver.call("/relay/release_control")["values"]["success"]
    assert marker["distance"] == pytest.approx(to_charger(), rel=0.15)


def hears(client: Client, topic: str) -> Any:
    """What comes on a topic within a moment, or nothing."""
    try:
        return client.until(MOMENT_S, op="publish", topic=topic)["msg"]
    except TimeoutError:
        return None


def to_charger() -> float:
    """Metres from where the robot begins to the charger."""
    world = default()
    (charger,) = world.chargers
    wall = world.segments[charger.wall]
    share = charger.along / math.hypot(wall.x2 - wall.x1, wall.y2 - wall.y1)
    x, y = wall.x1 + share * (wall.x2 - wall.x1), wall.y1 + share * (wall.y2 - wall.y1)
    return math.hypot(x - world.start.x, y - world.start.y)


def test_a_face_at_a_camera_is_told_by_name(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another camera of the robot's shows Eileen; who only looks reads who it is, and where."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    onlooker = Onlooker(site.robot.domain)
    try:
        images = onlooker.node.create_publisher(Image, "/door/image_raw", qos_profile_sensor_data)
        message = picture(scene(EILEEN, 0.8, (120, 40)), "mono8", "door_optical_frame")
        show = repeated(lambda: images.publish(message), 0.1)
        folder = people(tmp_path / "people")
        words = ("faces", "--image", "/door/image_raw", "--view", "75", "--people", str(folder))
        with service(site.robot.domain, tmp_path, *words):

            def told() -> Any:
                answer = site.ask(site.viewer, "GET", "topics/faces/seen?wait=0.2")
                return json.loads(answer.json["value"]["data"])["faces"] if answer.status == 200 else None

            (face,) = onlooker.until("the face is read", told, show)
    finally:
        onlooker.close()
    assert face["name"] == "eileen" and 0 < face["distance"] < 5


def test_a_sentence_is_said_for_who_may_speak(site: Site, tmp_path: Path) -> None:
    """An operator's text is heard in the file and told to all; who only looks neither speaks nor silences."""
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

        # Until both ends have found each other what is said gets lost; not too often, or there is no end to it.
        say = repeated(speak, 2.0)

        def heard() -> bool:
            say()
            return bool(hears(listener, "/said") == text["value"])

        wait_for("it is said", heard)
        site.refuses("POST", "topics/say", text, 403, "viewer")
        hushed = wait_for("the service is known", lambda: hush(site))
        assert hushed["success"] is True
        # Of what he may not call he is not told that it is there.
        site.refuses("POST", "services/say/hush", {}, 404, "you have no right on it")
    with wave.open(str(sound)) as file:
        samples = np.frombuffer(file.readframes(file.getnframes()), np.int16).astype(float)
        assert len(samples) / file.getframerate() > 0.5
    assert np.abs(samples).max() > 3000


def hush(site: Site) -> Any:
    """What the service answers, once the relay knows it."""
    answer = site.ask(site.operator, "POST", "services/say/hush", {})
    return answer.json["values"] if answer.status == 200 else None
