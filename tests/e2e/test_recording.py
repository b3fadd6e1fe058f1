"""Recordings of the simulated robot over HTTP; the files are read by MCAP's own library and rosbags."""

from __future__ import annotations

import base64
import json
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from rosbags.interfaces import QosDurability
from rosbags.rosbag2.storage_mcap import McapReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from relay_protocol.ros_types import TypeRegistry
from tests.worlds.http_requests import Answer, ask
from tests.worlds.relay_process import Relay
from tests.worlds.robot_process import Robot
from tests.worlds.waiting import wait_for

CAMERA = "/camera/image_raw"


class Recorder:
    """A user who records."""

    def __init__(self, relay: Relay, robot: str, token: str) -> None:
        self._relay = relay
        self._token = token
        self._path = f"/api/v1/robots/{robot}/recordings"

    def ask(self, method: str, path: str = "", body: Any = None, **headers: str) -> Answer:
        """Sends a request."""
        given = {name.replace("_", "-"): value for name, value in headers.items()}
        return ask(self._relay.http_port, method, self._path + path, body, headers=given, token=self._token)

    def start(self, *topics: str, **more: Any) -> str:
        """Starts a recording; returns its id."""
        answer = self.ask("POST", "", {"topics": topics, **more})
        assert answer.status == 201, answer.body
        assert answer.headers["Location"] == f"{self._path}/{answer.json['id']}"
        return str(answer.json["id"])

    def look(self, id: str) -> dict[str, Any]:
        """Its description."""
        return dict(self.ask("GET", f"/{id}").json)

    def until(self, id: str, messages: int) -> None:
        """Waits until the file has this many messages."""
        wait_for(f"{messages} messages", lambda: self.look(id)["messages"] >= messages)

    def stop(self, id: str) -> dict[str, Any]:
        """Stops it."""
        answer = self.ask("POST", f"/{id}/stop")
        assert answer.status == 200, answer.body
        return dict(answer.json)

    def fetch(self, id: str, folder: Path) -> Path:
        """Downloads it."""
        answer = self.ask("GET", f"/{id}/file")
        assert answer.status == 200, answer.body
        assert f'filename="rover-{id}.mcap"' in answer.headers["Content-Disposition"]
        path = folder / f"{id}.mcap"
        path.write_bytes(answer.body)
        return path


def read(path: Path) -> list[tuple[Any, Any, Any]]:
    """All messages with schema and channel; every checksum is verified."""
    with path.open("rb") as stream:
        list(StreamReader(stream, validate_crcs=True).records)
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        return list(reader.iter_messages())


@pytest.fixture
def operator(world: Any) -> Recorder:
    """A user who may record."""
    return Recorder(world.relay, "rover", world.operator)


def test_recording_has_what_a_subscriber_receives(world: Any, operator: Recorder, tmp_path: Path) -> None:
    """As the robot serialised it, readable with the definitions in the file."""
    id = operator.start("/odom", "tf")
    operator.until(id, 20)
    with world.relay.connect("rover", world.viewer) as client:
        client.send(op="subscribe", topic="/odom", type="nav_msgs/msg/Odometry")
        heard = [client.until(op="publish", topic="/odom")["msg"] for _ in range(10)]
        done = operator.stop(id)
    assert (done["state"], done["drops"], done["problems"]) == ("complete", 0, [])
    path = operator.fetch(id, tmp_path)
    messages = read(path)
    assert len(messages) == done["messages"]
    assert path.stat().st_size == done["bytes"]
    assert {channel.topic for _, channel, _ in messages} == {"/odom", "/tf"}
    types, recorded = TypeRegistry(), []
    for schema, channel, message in messages:
        assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
        types.add(schema.name, schema.data.decode())
        if channel.topic == "/odom":
            recorded.append(json.loads(types.to_json(schema.name, message.data)))
    # The messages received without loss are in the file in one piece.
    first = recorded.index(heard[0])
    assert recorded[first : first + len(heard)] == heard


def test_rosbags_reads_the_file(operator: Recorder, tmp_path: Path) -> None:
    """As an MCAP rosbag2 file, with types from the file only; latched topics are marked."""
    id = operator.start("/odom", "/scan", "/tf_static")
    operator.until(id, 30)
    done = operator.stop(id)
    path = operator.fetch(id, tmp_path)
    store = get_typestore(Stores.EMPTY)
    for schema, _, _ in read(path):
        store.register(
            {
                name: definition
                for name, definition in get_types_from_msg(schema.data.decode(), schema.name).items()
                if name not in store.types
            }
        )
    reader = McapReader(path)
    reader.open()
    try:
        found = [
            store.deserialize_cdr(bytes(raw), connection.msgtype)
            for connection, _, raw in reader.messages(reader.connections)
        ]
        latched = {
            connection.topic: [each.durability for each in connection.ext.offered_qos_profiles]
            for connection in reader.connections
        }
    finally:
        reader.close()
    assert len(found) == done["messages"]
    assert {type(each).__name__ for each in found} == {
        "nav_msgs__msg__Odometry",
        "sensor_msgs__msg__LaserScan",
        "tf2_msgs__msg__TFMessage",
    }
    assert latched == {"/odom": [], "/scan": [], "/tf_static": [QosDurability.TRANSIENT_LOCAL]}


def test_a_download_goes_on_where_it_broke_off(operator: Recorder, tmp_path: Path) -> None:
    """As curl and browsers do it: the rest of the same file, if it is unchanged."""
    id = operator.start("/odom")
    operator.until(id, 20)
    operator.stop(id)
    whole = operator.fetch(id, tmp_path).read_bytes()
    head = operator.ask("HEAD", f"/{id}/file")
    assert (head.status, head.headers["Content-Length"], head.body) == (200, str(len(whole)), b"")
    begun, tag = whole[:1000], head.headers["ETag"]
    rest = operator.ask("GET", f"/{id}/file", Range=f"bytes={len(begun)}-", If_Range=tag)
    assert (rest.status, begun + rest.body) == (206, whole)
    again = operator.ask("GET", f"/{id}/file", Range=f"bytes={len(begun)}-", If_Range='"another"')
    assert (again.status, again.body) == (200, whole)
    assert operator.ask("GET", f"/{id}/file", Range=f"bytes={len(whole)}-").status == 416


def test_a_cameras_images_are_recorded(operator: Recorder, tmp_path: Path) -> None:
    """As CompressedImage, each a JPEG of the camera's size."""
    id = operator.start(cameras=[CAMERA])
    operator.until(id, 5)
    operator.stop(id)
    types = TypeRegistry()
    for schema, channel, message in read(operator.fetch(id, tmp_path)):
        assert channel.topic == f"{CAMERA}/compressed"
        types.add(schema.name, schema.data.decode())
        fields = json.loads(types.to_json("sensor_msgs/msg/CompressedImage", message.data))
        assert fields["format"] == "jpeg"
        stamp = fields["header"]["stamp"]
        assert stamp["sec"] * 10**9 + stamp["nanosec"] == message.log_time
        picture = cv2.imdecode(np.frombuffer(base64.b64decode(fields["data"]), np.uint8), cv2.IMREAD_COLOR)
        assert picture is not None and picture.shape[2] == 3


def test_it_ends_by_its_limits(operator: Recorder) -> None:
    """By its time limit here; the result says so."""
    id = operator.start("/odom", seconds=5)
    done = wait_for("its end", lambda: (found := operator.look(id))["state"] == "complete" and found)
    assert done["reason"] == "its time is over"
    assert done["messages"] > 5
    assert operator.ask("DELETE", f"/{id}").status == 204
    assert operator.ask("GET", f"/{id}").status == 404


def test_recording_needs_the_right(world: Any, operator: Recorder) -> None:
    """Neither recording nor downloading without it; an unauthenticated client gets the usual answer."""
    id = operator.start("/odom")
    viewer = Recorder(world.relay, "rover", world.viewer)
    assert viewer.ask("POST", "", {"topics": ["/odom"]}).status == 403
    assert viewer.ask("GET").json == {"recordings": [], "next": None}
    stranger = Recorder(world.relay, "rover", world.stranger)
    for method, path in (
        ("GET", f"/{id}"),
        ("GET", f"/{id}/file"),
        ("POST", f"/{id}/stop"),
        ("DELETE", f"/{id}"),
    ):
        assert viewer.ask(method, path).status == 404
        assert stranger.ask(method, path).status == 404
    assert operator.ask("GET", f"/{id}/file").status == 503
    assert operator.ask("PUT", f"/{id}").status == 405
    assert operator.ask("GET", f"/{id}/nothing").status == 404
    assert operator.ask("POST", "", {"topics": ["/odom"], "megabytes": 0}).status == 400
    operator.stop(id)


@pytest.fixture
def own(tmp_path: Path) -> Iterator[tuple[Relay, Robot, str]]:
    """A relay and a robot that the test may kill, and a user who may record."""
    relay = Relay(tmp_path)
    try:
        robot = Robot(relay, "rover")
        try:
            token = relay.user("operator")
            relay.cli("right", "grant", "operator", "rover", "operator")
            yield relay, robot, token
        finally:
            robot.stop()
    finally:
        relay.stop()


def test_a_recording_outlives_its_robot_and_its_relay(own: tuple[Relay, Robot, str], tmp_path: Path) -> None:
    """A restarted daemon continues in the same file; a killed relay's file is readable after its next start;
    a stopped relay finishes the file; a revoked right ends the recording.
    """
    relay, robot, token = own
    recorder = Recorder(relay, "rover", token)
    wait_for("the graph", lambda: recorder.ask("POST", "", {"topics": ["/odom"], "seconds": 1}).status == 201)
    id = recorder.start("/odom")
    recorder.until(id, 10)
    robot.daemon.signal(signal.SIGKILL)
    robot.daemon.stop()
    robot.start_daemon()
    before = recorder.look(id)["messages"]
    recorder.until(id, before + 200)
    relay.kill()
    relay.start()
    wait_for("it is recovered", lambda: recorder.look(id)["state"] == "recovered")
    # About a second in memory is lost, of 20 to 50 messages per second.
    assert len(read(recorder.fetch(id, tmp_path))) >= before + 20
    robot.wait_online()
    id = recorder.start("/odom")
    recorder.until(id, 10)
    assert relay.stop() == 0
    relay.start()
    done = recorder.look(id)
    assert (done["state"], done["reason"]) == ("complete", "the relay is going down")
    assert len(read(recorder.fetch(id, tmp_path))) == done["messages"]
    robot.wait_online()
    id = recorder.start("/odom")
    recorder.until(id, 10)
    relay.cli("right", "revoke", "operator", "rover")
    relay.cli("right", "grant", "operator", "rover", "operator")
    done = wait_for("its end", lambda: (found := recorder.look(id)).get("state") == "complete" and found)
    assert "revoked" in done["reason"]


def test_recordings_go_with_their_robot(own: tuple[Relay, Robot, str]) -> None:
    """A running one is stopped; one of a robot removed without a relay is deleted at the next start."""
    relay, robot, token = own
    recorder = Recorder(relay, "rover", token)
    wait_for("the graph", lambda: recorder.ask("POST", "", {"topics": ["/odom"], "seconds": 1}).status == 201)
    folder = relay.data / "recordings"
    recorder.until(recorder.start("/odom"), 10)
    asked = relay.run_cli("robot", "remove", "rover", stdin="n\n")
    assert "its 2 recordings (" in asked.stderr
    assert relay.cli("robot", "remove", "rover", "--yes")["recordings"] == 2
    wait_for("the recordings are gone", lambda: list(folder.iterdir()) == [])
    robot.stop()
    other = Robot(relay, "tank")
    try:
        relay.cli("right", "grant", "operator", "tank", "operator")
        recorder = Recorder(relay, "tank", token)
        wait_for("the graph", lambda: recorder.ask("POST", "", {"topics": ["/odom"]}).status == 201)
        relay.stop()
        relay.cli("robot", "remove", "tank", "--yes")
        assert len(list(folder.iterdir())) == 2
        relay.start()
        assert list(folder.iterdir()) == []
    finally:
        other.stop()
