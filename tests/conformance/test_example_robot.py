"""The robots of docs/examples at a real relay: enrolled, viewed, driven, called."""

from __future__ import annotations

import datetime
import ipaddress
import os
import ssl
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from robots_under_test import EXAMPLE, SENSOR

from robot_client.apps.blocking_websocket import BlockingWebsocket
from tests.worlds.processes import Process
from tests.worlds.relay_process import Relay
from tests.worlds.sync_client import Client
from tests.worlds.waiting import wait_for

NAME = "tin-man"


def command(relay: Relay, code: str, state: Path, program: Path = EXAMPLE) -> list[str]:
    """The command line of the robot."""
    return [sys.executable, str(program), "127.0.0.1", str(relay.robots_port), NAME, code, str(state)]


class World:
    """A relay with the robot, and an operator."""

    def __init__(self, folder: Path) -> None:
        self.relay = Relay(folder)
        code = self.relay.cli("robot", "add", NAME)["enrolment_code"]
        self._command = command(self.relay, code, folder / "robot.json")
        self._folder = folder
        self.token = self.relay.user("driver")
        self.relay.cli("right", "grant", "driver", NAME, "operator")
        self.robot = Process(self._command, folder, "robot")
        self.wait()

    def wait(self) -> None:
        """Waits until it is online."""
        wait_for("the robot is online", lambda: self.relay.state_of(NAME) != "offline")

    def restart(self) -> None:
        """Starts it again, without a code."""
        self.robot.stop()
        self.robot = Process(self._command, self._folder, "robot")

    def stop(self) -> None:
        self.robot.stop()
        self.relay.stop()


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """One relay and one robot for all."""
    made = World(tmp_path_factory.mktemp("example"))
    try:
        yield made
    finally:
        made.stop()


@pytest.fixture
def client(world: World) -> Iterator[Client]:
    """A rosbridge client of the robot."""
    with world.relay.connect(NAME, world.token) as connected:
        yield connected


def speed(client: Client) -> float:
    """The next speed of its motors."""
    return float(client.until(op="publish", topic="/cmd_vel/heard")["msg"]["linear"]["x"])


def drive(client: Client) -> None:
    """Drives until it moves; an earlier drive needs no release."""
    assert client.call("/relay/take_control")["values"]["success"]
    client.send(op="subscribe", topic="/cmd_vel/heard")
    for _ in range(200):
        client.drive(0.2)
        if speed(client) == 0.2:
            return
    raise AssertionError("it did not move")


def test_its_graph_is_known(client: Client) -> None:
    """Clients see its topics with their types."""
    values = client.call("/rosapi/topics")["values"]
    assert dict(zip(values["topics"], values["types"], strict=True))["/temperature"] == "std_msgs/msg/Float64"


def test_its_sensor_is_watched(client: Client) -> None:
    """A subscriber gets its samples."""
    client.send(op="subscribe", topic="/temperature", type="std_msgs/msg/Float64")
    assert 19 <= client.until(op="publish", topic="/temperature")["msg"]["data"] <= 21


def test_its_service_is_called(client: Client) -> None:
    """A call is answered, and one of a missing service gets a reason."""
    assert client.call("/beep")["values"] == {"success": True, "message": "beep"}
    assert client.call("/no_such_service")["result"] is False


def test_it_is_driven_and_stops_by_itself(client: Client) -> None:
    """Commands move it; when they cease it stands, and reports so."""
    drive(client)
    wait_for("it stands", lambda: speed(client) == 0)


def test_it_stops_when_its_driver_leaves(world: World, client: Client) -> None:
    """When the only driver disconnects it stands."""
    client.send(op="subscribe", topic="/cmd_vel/heard")
    with world.relay.connect(NAME, world.token) as driver:
        drive(driver)
    wait_for("it stands", lambda: speed(client) == 0)


def test_it_comes_back(world: World) -> None:
    """After a restart it needs no new code, and its clients continue."""
    with world.relay.connect(NAME, world.token) as client:
        client.send(op="subscribe", topic="/temperature", type="std_msgs/msg/Float64")
        client.until(op="publish", topic="/temperature")
        world.restart()
        assert client.until(30, op="publish", topic="/temperature")


def test_a_sensor_is_watched(world: World, tmp_path: Path) -> None:
    """The robot that only measures serves subscribers, refuses other requests with a reason, and reconnects
    without a code.
    """
    name = "thermometer"
    code = world.relay.cli("robot", "add", name)["enrolment_code"]
    world.relay.cli("right", "grant", "driver", name, "operator")
    start = command(world.relay, code, tmp_path / "sensor.json", SENSOR)
    start[start.index(NAME)] = name
    robot = Process(start, tmp_path, "sensor")
    try:
        wait_for("the sensor is online", lambda: world.relay.state_of(name) != "offline")
        with world.relay.connect(name, world.token) as client:
            client.send(op="subscribe", topic="/temperature", type="std_msgs/msg/Float32")
            assert 19 <= client.until(op="publish", topic="/temperature")["msg"]["data"] <= 21
            assert client.call("/no_such_service")["result"] is False
            robot.stop()
            robot = Process(start, tmp_path, "sensor")
            assert client.until(30, op="publish", topic="/temperature")
    finally:
        robot.stop()


def self_signed(folder: Path) -> tuple[str, str]:
    """Certificate and key of 127.0.0.1, in files."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "relay")])
    now = datetime.datetime.now(datetime.UTC)
    address = x509.IPAddress(ipaddress.ip_address("127.0.0.1"))
    builder = x509.CertificateBuilder().subject_name(name).issuer_name(name).public_key(key.public_key())
    builder = builder.serial_number(x509.random_serial_number())
    builder = builder.not_valid_before(now - datetime.timedelta(1)).not_valid_after(
        now + datetime.timedelta(1)
    )
    builder = builder.add_extension(x509.BasicConstraints(True, None), critical=True)
    builder = builder.add_extension(x509.SubjectAlternativeName([address]), critical=False)
    own = builder.sign(key, hashes.SHA256())
    cert_file, key_file = folder / "cert.pem", folder / "key.pem"
    cert_file.write_bytes(own.public_bytes(serialization.Encoding.PEM))
    plain = serialization.NoEncryption()
    key_file.write_bytes(
        key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, plain)
    )
    return str(cert_file), str(key_file)


def test_it_speaks_tls(tmp_path: Path) -> None:
    """With its line for TLS it serves with a trusted certificate, and gives the reason otherwise."""
    program = tmp_path / "tls_robot.py"
    program.write_text(
        EXAMPLE.read_text().replace("# With TLS: ", "").replace("import socket", "import socket, ssl")
    )
    cert, key = self_signed(tmp_path)
    relay = Relay(tmp_path, "--tls-cert", cert, "--tls-key", key)
    code = relay.cli("robot", "add", NAME)["enrolment_code"]
    start = command(relay, code, tmp_path / "robot.json", program)
    stranger = Process(start, tmp_path, "stranger")
    trusting = None
    try:
        assert stranger.popen.wait(20) != 0
        assert "CERTIFICATE_VERIFY_FAILED" in stranger.said()
        trusting = Process(start, tmp_path, "trusting", {**os.environ, "SSL_CERT_FILE": cert})
        wait_for("the robot is online", lambda: relay.state_of(NAME) != "offline")
        token = relay.user("driver")
        relay.cli("right", "grant", "driver", NAME, "operator")
        url, trust = relay.url(NAME).replace("ws:", "wss:"), ssl.create_default_context(cafile=cert)
        headers = {"Authorization": f"Bearer {token}"}
        connecting = BlockingWebsocket(url, ssl=trust, additional_headers=headers, close_timeout=1)
        with Client(connecting) as client:
            drive(client)
            wait_for("it stands", lambda: speed(client) == 0)
    finally:
        for each in (trusting, stranger, relay):
            if each is not None:
                each.stop()


@pytest.mark.parametrize("program", [EXAMPLE, SENSOR], ids=["json_robot", "sensor_robot"])
def test_a_wrong_code_is_refused_with_a_reason(world: World, tmp_path: Path, program: Path) -> None:
    """With an invalid code it ends, and stores no key."""
    state = tmp_path / "robot.json"
    stranger = Process(command(world.relay, "guess", state, program), tmp_path, "stranger")
    try:
        assert stranger.popen.wait(20) != 0
        assert "enrolment code" in stranger.said() + stranger.log.read_text()
        assert "Traceback" not in stranger.log.read_text()
        assert not state.exists()
    finally:
        stranger.stop()


def test_it_ends_in_order(world: World) -> None:
    """A robot that gets a signal during a drive exits with status 0."""
    with world.relay.connect(NAME, world.token) as client:
        drive(client)
        assert world.robot.stop() == 0
    world.restart()
    world.wait()
