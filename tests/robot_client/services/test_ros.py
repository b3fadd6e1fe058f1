"""The services as processes in a real ROS 2 graph."""

from __future__ import annotations

import math
import os
import signal
import socket
import time
import wave
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import orjson
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseArray
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import BatteryState, CameraInfo, CompressedImage, Image, LaserScan, NavSatFix
from std_msgs.msg import Bool, String
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from robot_client.services.main import COMMAND
from robot_client.sim.camera import to_jpeg
from tests.robot_client.services.test_battery import LAPTOP, supply
from tests.robot_client.services.test_gps import sentence
from tests.robot_client.services.test_markers import LENS, SIZE, drawn
from tests.worlds.face_images import EILEEN, people, scene
from tests.worlds.forked_programs import run_command
from tests.worlds.ros_domains import free_domain
from tests.worlds.service_process import TopicWatcher, service

LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@pytest.fixture(scope="module")
def domain() -> int:
    return free_domain()


@pytest.fixture
def onlooker(domain: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[TopicWatcher]:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    onlooker = TopicWatcher(domain)
    onlooker.watch_health()
    yield onlooker
    onlooker.close()


def level(wanted: bytes) -> Any:
    return lambda status: status.level == wanted


def repeated(action: Callable[[], object], seconds: float) -> Callable[[], None]:
    """The same action, at most so often."""
    last = -math.inf

    def act() -> None:
        nonlocal last
        if time.monotonic() >= last + seconds:
            last = time.monotonic()
            action()

    return act


def picture(pixels: np.ndarray, encoding: str, frame: str) -> Image:
    message = Image(encoding=encoding, height=pixels.shape[0], width=pixels.shape[1])
    message.step = pixels.shape[1] * pixels.itemsize
    message.header.frame_id = frame
    message.data.frombytes(pixels.tobytes())
    return message


def test_obstacles_of_a_scan(onlooker: TopicWatcher, domain: int, tmp_path: Path) -> None:
    """An obstacle is in its sector; without it, the sector is clear."""
    onlooker.watch("/r1/obstacles", LaserScan)
    onlooker.watch("/r1/obstacles/places", PoseArray)
    onlooker.watch("/r1/obstacles/near", Bool, LATCHED)
    scans = onlooker.node.create_publisher(LaserScan, "/scan", qos_profile_sensor_data)
    scan = LaserScan(angle_min=-math.pi, angle_increment=math.radians(1), range_min=0.1, range_max=10.0)
    scan.header.frame_id = "laser"
    scan.ranges = [math.inf] * 360
    scan.ranges[180 + 20] = 0.4
    with service(domain, tmp_path, "obstacles", "--namespace", "r1", "--near", "0.5", "--sectors", "8"):
        say = {"meanwhile": lambda: scans.publish(scan)}
        seen = onlooker.newest("/r1/obstacles", **say)
        assert seen.header.frame_id == "laser" and len(seen.ranges) == 8
        assert seen.angle_min + 4 * seen.angle_increment == pytest.approx(0.0, abs=1e-5)
        assert seen.ranges[4] == pytest.approx(0.4)
        assert sum(map(math.isinf, seen.ranges)) == 7
        (pose,) = onlooker.newest("/r1/obstacles/places", **say).poses
        place = (0.4 * math.cos(math.radians(20)), 0.4 * math.sin(math.radians(20)))
        assert (pose.position.x, pose.position.y) == pytest.approx(place, abs=1e-4)
        assert onlooker.until(
            "near", lambda: [each.data for each in onlooker.heard["/r1/obstacles/near"]][-1:] == [True]
        )
        assert "20° to the left" in onlooker.health("r1/obstacles", level(DiagnosticStatus.WARN)).message
        near = onlooker.heard["/r1/obstacles/near"]
        near.clear()
        scan.ranges[180 + 20] = -math.inf
        onlooker.health(
            "r1/obstacles", lambda status: "0.10 m away, 20° to the left" in status.message, **say
        )
        scan.ranges = [math.nan] * 360
        blind = onlooker.health("r1/obstacles", level(DiagnosticStatus.ERROR), **say).message
        assert blind == "none of the 360 rays of the scan has a measurement"
        assert near == []
        scan.ranges = [math.inf] * 360
        scan.ranges[180 + 20] = 2.0
        onlooker.newest("/r1/obstacles/near", lambda each: not each.data, **say)


def test_obstacles_of_depth(onlooker: TopicWatcher, domain: int, tmp_path: Path) -> None:
    """Of a depth image with its CameraInfo; an image without depth gives none."""
    onlooker.watch("/obstacles", LaserScan)
    onlooker.watch("/obstacles/near", Bool, LATCHED)
    depth = onlooker.node.create_publisher(Image, "/depth/image", qos_profile_sensor_data)
    info = onlooker.node.create_publisher(CameraInfo, "/depth/camera_info", qos_profile_sensor_data)
    pixels = np.full((48, 64), 3000, np.uint16)
    pixels[:, 50:] = 800
    message = picture(pixels, "16UC1", "depth_optical_frame")
    calibration = CameraInfo(height=48, width=64, k=[60.0, 0, 31.5, 0, 60.0, 23.5, 0, 0, 1.0])

    def publish() -> None:
        info.publish(calibration)
        depth.publish(message)

    with service(domain, tmp_path, "obstacles", "--depth", "/depth/image", "--sectors", "3"):
        seen = onlooker.newest("/obstacles", meanwhile=publish)
        assert seen.header.frame_id == "depth_frame"
        assert list(seen.ranges) == pytest.approx([0.8 * math.hypot(1, 18.5 / 60), 3.0, 3.02], rel=0.02)
        near = onlooker.heard["/obstacles/near"]
        message.data = picture(np.full((48, 64), 300, np.uint16), "16UC1", "").data
        onlooker.until("near", lambda: [each.data for each in near][-1:] == [True], publish)
        message.data = picture(np.zeros((48, 64), np.uint16), "16UC1", "").data
        blind = "fewer than 20 pixels of the 64×48 depth image have a measurement"
        said = onlooker.health("obstacles", lambda status: status.message == blind, publish)
        assert said.level == DiagnosticStatus.ERROR and near[-1].data
        message.encoding = "rgb8"
        onlooker.until(
            "a complaint",
            lambda: any("no depth" in each.status[0].message for each in onlooker.heard["/diagnostics"]),
            publish,
        )


def test_battery_of_this_machine(onlooker: TopicWatcher, domain: int, tmp_path: Path) -> None:
    onlooker.watch("/battery_state", BatteryState)
    folder = supply(tmp_path / "supplies" / "BAT0", **LAPTOP)
    with service(domain, tmp_path, "battery", "--folder", str(folder.parent), "--period", "0.1"):
        state = onlooker.newest("/battery_state")
        assert (state.percentage, state.voltage, state.current) == pytest.approx((0.57, 11.4, -2.0))
        assert (state.location, state.serial_number, state.present) == ("BAT0", "4711", True)
        assert math.isfinite(state.temperature)
        onlooker.health("battery", level(DiagnosticStatus.OK))
        supply(folder, capacity="15")
        assert "low: 15 %" in onlooker.health("battery", level(DiagnosticStatus.WARN)).message
        (folder / "type").unlink()
        assert "there is no battery" in onlooker.health("battery", level(DiagnosticStatus.ERROR)).message


def test_battery_of_a_topic(onlooker: TopicWatcher, domain: int, tmp_path: Path) -> None:
    states = onlooker.node.create_publisher(BatteryState, "/base/battery", 10)
    state = BatteryState(voltage=18.3, percentage=math.nan)
    with service(domain, tmp_path, "battery", "--topic", "/base/battery", "--volts", "18", "24"):
        reported = onlooker.health("battery", level(DiagnosticStatus.ERROR), lambda: states.publish(state))
        assert reported.message == "nearly empty: 5 %, charge it now"
        assert {each.key: each.value for each in reported.values}["volts"] == "18.30"


def test_gps_of_a_receiver(onlooker: TopicWatcher, domain: int, tmp_path: Path) -> None:
    """With covariances; bad sentences are counted."""
    onlooker.watch("/fix", NavSatFix)
    here = sentence("GNGGA,120000,5005.400,N,01425.000,E,2,09,1.5,200.0,M,44.0,M,,") + b"\r\n"
    lost = sentence("GNGGA,120001,,,,,0,00,,,M,,M,,") + b"\r\n"
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        with service(domain, tmp_path, "gps", address, "--frame", "antenna"), server.accept()[0] as receiver:
            receiver.sendall(b"$GPGGA,noise\r\n")
            fix = onlooker.newest("/fix", meanwhile=repeated(lambda: receiver.sendall(here), 0.1))
            assert fix.header.frame_id == "antenna"
            assert (fix.latitude, fix.longitude) == pytest.approx((50.09, 14.4166667), abs=1e-6)
            assert fix.altitude == pytest.approx(244.0)
            assert (fix.status.status, fix.position_covariance_type) == (1, 1)
            assert list(fix.position_covariance)[::4] == pytest.approx([2.25, 2.25, 9.0])
            reported = onlooker.health("gps", level(DiagnosticStatus.OK))
            assert {each.key: each.value for each in reported.values}["bad_sentences"] == "1"
            receiver.sendall(lost)
            assert math.isnan(onlooker.newest("/fix", lambda each: each.status.status == -1).latitude)


def test_markers_of_a_camera(onlooker: TopicWatcher, domain: int, tmp_path: Path) -> None:
    """Within two per cent; without a CameraInfo the diagnostics give the reason."""
    onlooker.watch("/markers", MarkerArray)
    onlooker.watch("/markers/seen", String)
    images = onlooker.node.create_publisher(Image, "/camera/image_raw", qos_profile_sensor_data)
    infos = onlooker.node.create_publisher(CameraInfo, "/camera/camera_info", qos_profile_sensor_data)
    at = (-0.3, 0.1, 1.2)
    message = picture(drawn(7, at), "mono8", "camera_optical_frame")
    info = CameraInfo(height=480, width=640, k=[LENS.fx, 0.0, LENS.cx, 0.0, LENS.fy, LENS.cy, 0.0, 0.0, 1.0])
    with service(domain, tmp_path, "markers", "--size", str(SIZE)):
        onlooker.until(
            "a complaint",
            lambda: any(
                "waiting for /camera/camera_info" in each.status[0].message
                for each in onlooker.heard["/diagnostics"]
            ),
            lambda: images.publish(message),
        )

        def publish() -> None:
            infos.publish(info)
            images.publish(message)

        (marker,) = onlooker.newest("/markers", lambda each: each.markers, meanwhile=publish).markers
        place = marker.pose.position
        assert (marker.id, marker.ns, marker.header.frame_id) == (7, "4X4_50", "camera_optical_frame")
        assert (place.x, place.y, place.z) == pytest.approx(at, rel=0.02)
        reported = orjson.loads(onlooker.newest("/markers/seen", meanwhile=publish).data)
        (seen,) = reported["markers"]
        assert seen["id"] == 7
        assert seen["distance"] == pytest.approx(math.hypot(*at), rel=0.02)
        assert seen["bearing"] == pytest.approx(math.atan2(0.3, 1.2), abs=0.01)


def test_markers_of_compressed_images(onlooker: TopicWatcher, domain: int, tmp_path: Path) -> None:
    """A broken image is reported."""
    onlooker.watch("/markers/seen", String)
    topic = "/camera/image_raw/compressed"
    images = onlooker.node.create_publisher(CompressedImage, topic, qos_profile_sensor_data)
    whole = CompressedImage(format="jpeg", data=to_jpeg(drawn(3, (0.0, 0.0, 0.9))))
    broken = CompressedImage(format="jpeg", data=b"\xff\xd8\xff nothing")
    words = ("--image", topic, "--compressed", "--view", "75", "--size", str(SIZE))
    with service(domain, tmp_path, "markers", *words):
        onlooker.until(
            "a complaint",
            lambda: any("JPEG" in each.status[0].message for each in onlooker.heard["/diagnostics"]),
            lambda: images.publish(broken),
        )
        reported = orjson.loads(
            onlooker.newest("/markers/seen", meanwhile=lambda: images.publish(whole)).data
        )
        (seen,) = reported["markers"]
        assert (seen["id"], seen["distance"]) == (3, pytest.approx(0.9, rel=0.02))


def test_faces_of_a_camera(onlooker: TopicWatcher, domain: int, tmp_path: Path) -> None:
    onlooker.watch("/faces", MarkerArray)
    onlooker.watch("/faces/seen", String)
    images = onlooker.node.create_publisher(Image, "/camera/image_raw", qos_profile_sensor_data)
    people(tmp_path / "people")
    message = picture(scene(EILEEN, 0.8, (120, 40)), "mono8", "camera_optical_frame")
    words = ("--people", str(tmp_path / "people"), "--view", "75", "--rate", "20")
    with service(domain, tmp_path, "faces", *words):
        publish = repeated(lambda: images.publish(message), 0.05)
        (marker,) = onlooker.newest("/faces", lambda each: each.markers, meanwhile=publish).markers
        assert (marker.text, marker.header.frame_id) == ("eileen", "camera_optical_frame")
        reported = orjson.loads(onlooker.newest("/faces/seen", meanwhile=publish).data)
        (seen,) = reported["faces"]
        assert (reported["frame"], seen["name"]) == ("camera_optical_frame", "eileen")
        place = marker.pose.position
        assert seen["distance"] == pytest.approx(math.hypot(place.x, place.y, place.z), abs=0.01)
        assert "sees eileen" in onlooker.health("faces", level(DiagnosticStatus.OK), publish).message
        message.data = picture(np.full((480, 640), 128, np.uint8), "mono8", "").data
        onlooker.newest("/faces/seen", lambda each: not orjson.loads(each.data)["faces"], meanwhile=publish)


def test_speech_into_a_file(onlooker: TopicWatcher, domain: int, tmp_path: Path) -> None:
    """Texts are spoken in order and reported; cancelled ones are not."""
    onlooker.watch("/said", String)
    onlooker.watch("/speaking", Bool, LATCHED)
    says = onlooker.node.create_publisher(String, "/say", 10)
    hush = onlooker.node.create_client(Trigger, "/say/cancel")
    texts = ["I am there.", "The battery is low, so I drive to the charger now."]
    with service(domain, tmp_path, "speech", "--out", str(tmp_path / "said.wav")):
        # Messages before DDS has matched both are lost; a short pause leaves time for the rest.
        warm = repeated(lambda: says.publish(String(data="ready")), 1.0)
        onlooker.until("it is heard", lambda: onlooker.heard["/said"], warm)
        for text in texts:
            says.publish(String(data=text))

        def reported() -> list[str]:
            return [each.data for each in onlooker.heard["/said"] if each.data in texts]

        onlooker.until("both are said", lambda: reported() == texts)
        onlooker.until(
            "silence", lambda: onlooker.heard["/speaking"] and not onlooker.heard["/speaking"][-1].data
        )
        onlooker.until("the service", hush.service_is_ready)
        asked = hush.call_async(Trigger.Request())
        onlooker.until("its answer", asked.done)
        assert (asked.result().success, asked.result().message) == (True, "no text was waiting")
    with wave.open(str(tmp_path / "said.wav")) as file:
        sound = np.frombuffer(file.readframes(file.getnframes()), np.int16).astype(float)
        assert 2 < len(sound) / file.getframerate() < 15
    assert np.abs(sound).max() > 3000


def test_service_ends_cleanly_by_sigint(domain: int, tmp_path: Path) -> None:
    """Exit code 0, and an empty stderr."""
    folder = supply(tmp_path / "BAT0", **LAPTOP)
    with service(domain, tmp_path, "battery", "--folder", str(folder)) as process:
        process.signal(signal.SIGINT)
        assert process.popen.wait(60) == 0
        assert process.log.read_text() == ""


@pytest.mark.parametrize(
    ("words", "code", "reported"),
    [
        (["battery", "--folder", "/nowhere"], 1, "No such file"),
        (["battery", "--namespace", "a b"], 2, "'a b' is not a ROS namespace"),
    ],
)
def test_errors_are_sentences_on_stderr(domain: int, words: list[str], code: int, reported: str) -> None:
    environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    done = run_command([COMMAND, *words], env=environment)
    assert done.returncode == code
    assert reported in done.stderr and "Traceback" not in done.stderr
