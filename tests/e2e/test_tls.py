"""TLS of a real relay: who is trusted, what is refused in words, and certificates swapped while all goes on."""

from __future__ import annotations

import datetime
import ipaddress
import signal
import socket
import ssl
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from switchboard_client import Client
from switchboard_http import ask
from switchboard_processes import BIN
from switchboard_relay import Relay
from switchboard_robot import Robot
from switchboard_threads import Driver
from switchboard_waiting import PATIENCE, wait_for
from websockets.sync.client import connect

from relay_server import PORTAL

DAY = datetime.timedelta(days=1)


class Authority:
    """A CA of the test's own, with its certificate in a file."""

    def __init__(self, folder: Path, name: str) -> None:
        self._key = ec.generate_private_key(ec.SECP256R1())
        self._name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        own = self._sign(self._name, self._key.public_key(), x509.BasicConstraints(True, None), DAY)
        self.path = folder / f"{name}.pem"
        self.path.write_bytes(own.public_bytes(serialization.Encoding.PEM))

    def _sign(
        self, subject: x509.Name, key: Any, extension: x509.ExtensionType, good: datetime.timedelta
    ) -> x509.Certificate:
        now = datetime.datetime.now(datetime.UTC)
        builder = x509.CertificateBuilder().subject_name(subject).issuer_name(self._name).public_key(key)
        builder = builder.serial_number(x509.random_serial_number())
        builder = builder.not_valid_before(now - 2 * DAY).not_valid_after(now + good)
        return builder.add_extension(extension, critical=False).sign(self._key, hashes.SHA256())

    def certify(self, cert: Path, key: Path, *, host: bool = True, good: datetime.timedelta = DAY) -> int:
        """Write a server's certificate and key; returns its serial number.

        :param host: for 127.0.0.1, else only for ``elsewhere.example``
        :param good: how long from now on; negative when it has expired
        """
        private = ec.generate_private_key(ec.SECP256R1())
        names: list[x509.GeneralName] = [x509.DNSName("elsewhere.example")]
        if host:
            names.append(x509.IPAddress(ipaddress.ip_address("127.0.0.1")))
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "relay")])
        own = self._sign(subject, private.public_key(), x509.SubjectAlternativeName(names), good)
        cert.write_bytes(own.public_bytes(serialization.Encoding.PEM))
        key.write_bytes(
            private.private_bytes(
                serialization.Encoding.PEM,
                serialization.PrivateFormat.PKCS8,
                serialization.NoEncryption(),
            )
        )
        return own.serial_number


class House:
    """A relay that speaks TLS, a robot that trusts its CA, a driver."""

    def __init__(self, folder: Path) -> None:
        self.authority = Authority(folder, "authority")
        self.foreign = Authority(folder, "foreign")
        self.cert, self.key = folder / "cert.pem", folder / "key.pem"
        self.authority.certify(self.cert, self.key)
        self.relay = Relay(folder, "--tls-cert", str(self.cert), "--tls-key", str(self.key))
        trust = ("--tls", "--ca", str(self.authority.path))
        self.robot = Robot(self.relay, "rover", enroll_options=trust)
        self.token = self.relay.user("driver")
        self.relay.cli("right", "grant", "driver", "rover", "operator")

    @property
    def context(self) -> ssl.SSLContext:
        """What a client that trusts the CA uses."""
        return ssl.create_default_context(cafile=str(self.authority.path))

    def client(self) -> Client:
        """A websocket over TLS."""
        url = f"wss://127.0.0.1:{self.relay.http_port}/robots/rover"
        headers = {"Authorization": f"Bearer {self.token}"}
        return Client(connect(url, ssl=self.context, additional_headers=headers, open_timeout=PATIENCE))

    def reload(self, words: str) -> None:
        """SIGHUP, until the log has these words once more."""
        assert self.relay.process is not None
        before = self.relay.log.count(words)
        self.relay.process.signal(signal.SIGHUP)
        wait_for(f"the log says '{words}'", lambda: self.relay.log.count(words) > before)

    def serial(self, port: int) -> int:
        """Serial number of the certificate a new connection is shown."""
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.check_hostname = False
        context.verify_mode = ssl.CERT_NONE
        with (
            socket.create_connection(("127.0.0.1", port), timeout=10) as plain,
            context.wrap_socket(plain) as secure,
        ):
            shown = secure.getpeercert(binary_form=True)
            assert shown is not None
            return x509.load_der_x509_certificate(shown).serial_number

    def stop(self) -> None:
        """End everything."""
        self.robot.stop()
        self.relay.stop()


@pytest.fixture(scope="module")
def house(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    """One house for all; tests that swap the certificate swap a good one back."""
    house = House(tmp_path_factory.mktemp("tls"))
    try:
        yield house
    finally:
        house.stop()


READ_AGAIN = "the TLS certificate was read again"


@pytest.fixture
def swapped(house: House) -> Iterator[None]:
    """Puts a good certificate back."""
    yield
    house.authority.certify(house.cert, house.key)
    house.reload(READ_AGAIN)


def enroll(house: House, folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """Try to enroll a robot over TLS; what ``switchboard-robot enroll`` says."""
    command = [str(BIN / "switchboard-robot"), "enroll", "--relay", f"127.0.0.1:{house.relay.robots_port}"]
    command += ["--robot", "newcomer", "--code", "-", "--state", str(folder / "state"), "--tls", *options]
    return subprocess.run(
        command, input="AAAA-BBBB-CCCC-DDDD", capture_output=True, text=True, timeout=60, check=False
    )


def refused(done: subprocess.CompletedProcess[str], words: str) -> None:
    """It failed for this reason, in a sentence."""
    assert done.returncode != 0
    assert words in done.stderr
    assert "Traceback" not in done.stderr


def test_pages_and_websockets_come_over_tls(house: House) -> None:
    """With the CA, https and wss work, say HSTS, and set cookies that never go over plain HTTP."""
    port = house.relay.http_port
    answer = ask(port, "GET", "/healthz", tls=house.context)
    assert answer.json == {"status": "ok"}
    assert "max-age=" in answer.headers["Strict-Transport-Security"]
    body = {"user": "driver", "password": "correct horse"}
    origin = {"Origin": f"https://127.0.0.1:{port}"}
    login = ask(port, "POST", "/api/v1/session", body, headers=origin, tls=house.context)
    assert login.status == 200
    assert "secure" in login.headers["Set-Cookie"].lower()
    with house.client() as client:
        assert client.call("/relay/ping", {"robot": True})["result"]


def test_pipelined_requests_are_answered_in_order_over_tls(house: House) -> None:
    """Answers of many pieces, taken slowly, arrive whole."""
    assets = Path(PORTAL) / "assets"
    file = max(assets.iterdir(), key=lambda each: each.stat().st_size)
    request = f"GET /assets/{file.name} HTTP/1.1\r\nHost: x\r\n"
    received = b""
    with (
        socket.create_connection(("127.0.0.1", house.relay.http_port), timeout=PATIENCE) as plain,
        house.context.wrap_socket(plain, server_hostname="127.0.0.1") as secure,
    ):
        secure.sendall((f"{request}\r\n" * 3 + f"{request}Connection: close\r\n\r\n").encode())
        while data := secure.recv(5000):
            received += data
    assert received.count(file.read_bytes()) == 4


def test_who_does_not_trust_the_ca_does_not_connect(house: House) -> None:
    """The relay's certificate is of its own CA, so the system's store is not enough."""
    with pytest.raises(ssl.SSLCertVerificationError):
        ask(house.relay.http_port, "GET", "/healthz", tls=ssl.create_default_context())


def test_a_robot_is_driven_over_tls(house: House) -> None:
    """Enrolled with --ca, the robot runs over TLS: control link, channel link and all."""
    driver = Driver(house.client())
    driver.start()
    try:
        wait_for("the robot moves", house.robot.moving)
    finally:
        driver.stop()
    wait_for("the robot stands", lambda: not house.robot.moving())


def test_a_robot_refuses_a_ca_it_was_not_given(house: House, tmp_path: Path) -> None:
    """A relay of a foreign CA is refused in words, and the code is not told to it."""
    refused(
        enroll(house, tmp_path, "--ca", str(house.foreign.path)), "of nobody this robot trusts; give its CA"
    )


def test_a_robot_refuses_a_certificate_for_another_name(house: House, tmp_path: Path) -> None:
    """The name in the certificate must be the one that was dialled or asked for."""
    trust = ("--ca", str(house.authority.path))
    refused(enroll(house, tmp_path, *trust, "--server-name", "other.example"), "for another name")
    # The right name gets as far as the code.
    refused(enroll(house, tmp_path, *trust, "--server-name", "elsewhere.example"), "code is wrong")


@pytest.mark.usefixtures("swapped")
def test_a_robot_refuses_a_certificate_for_another_address(house: House, tmp_path: Path) -> None:
    """A certificate that does not name the address dialled is refused in words."""
    house.authority.certify(house.cert, house.key, host=False)
    house.reload(READ_AGAIN)
    refused(enroll(house, tmp_path, "--ca", str(house.authority.path)), "for another name")


@pytest.mark.usefixtures("swapped")
def test_a_robot_refuses_an_expired_certificate(house: House, tmp_path: Path) -> None:
    """An expired certificate is refused in words that say what to do."""
    house.authority.certify(house.cert, house.key, good=-DAY)
    house.reload(READ_AGAIN)
    refused(enroll(house, tmp_path, "--ca", str(house.authority.path)), "expired; it must be renewed")


@pytest.mark.parametrize("listener", ["http_port", "robots_port"])
def test_tls_1_1_is_refused(house: House, listener: str) -> None:
    """A client that speaks nothing newer gets the alert for its version; 1.2 is taken."""

    def shake(version: ssl.TLSVersion) -> str:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.check_hostname = False
        context.verify_mode = ssl.CERT_NONE
        context.set_ciphers("ALL:@SECLEVEL=0")
        context.minimum_version = context.maximum_version = version
        with (
            socket.create_connection(("127.0.0.1", getattr(house.relay, listener)), timeout=10) as plain,
            context.wrap_socket(plain) as secure,
        ):
            return str(secure.version())

    with pytest.warns(DeprecationWarning), pytest.raises(ssl.SSLError) as alert:
        shake(ssl.TLSVersion.TLSv1_1)
    assert alert.value.reason == "TLSV1_ALERT_PROTOCOL_VERSION"
    assert shake(ssl.TLSVersion.TLSv1_2) == "TLSv1.2"


def test_sighup_swaps_the_certificate_and_drops_nothing(house: House) -> None:
    """New connections see the new certificate; the robot and the client that are there stay as they are."""
    ports = (house.relay.http_port, house.relay.robots_port)
    with house.client() as client:
        client.send(op="subscribe", topic="/odom", type="nav_msgs/msg/Odometry")
        client.until(op="publish")
        offline = house.relay.log.count("is offline")
        new = house.authority.certify(house.cert, house.key)
        assert all(house.serial(port) != new for port in ports)
        house.reload(READ_AGAIN)
        assert all(house.serial(port) == new for port in ports)
        assert client.call("/relay/ping", {"robot": True})["result"]
        client.until(op="publish", topic="/odom")
        with house.client() as other:
            assert other.call("/relay/ping")["result"]
        assert house.relay.log.count("is offline") == offline


def test_a_certificate_that_can_not_be_used_changes_nothing(house: House) -> None:
    """SIGHUP with a broken file is told in the log, and the old certificate stays in use."""
    old = house.serial(house.relay.http_port)
    good = house.cert.read_bytes()
    house.cert.write_text("no certificate")
    try:
        house.reload("the old certificate stays in use")
        assert house.serial(house.relay.http_port) == old
    finally:
        house.cert.write_bytes(good)
    assert ask(house.relay.http_port, "GET", "/healthz", tls=house.context).status == 200


def test_who_speaks_no_tls_is_cut_and_disturbs_nobody(house: House) -> None:
    """Plain HTTP, plain frames and silence end by themselves; the relay has no trouble with them."""
    since = len(house.relay.log)
    begun = time.monotonic()
    opened = []
    for port in (house.relay.http_port, house.relay.robots_port):
        for first in (b"GET / HTTP/1.1\r\nHost: x\r\n\r\n", b"\x00\x00\x00\x02\x00{", b""):
            plain = socket.create_connection(("127.0.0.1", port), timeout=30)
            plain.sendall(first)
            opened.append(plain)
    for plain in opened:
        try:
            while plain.recv(4096):
                pass
        except ConnectionError:
            pass
        plain.close()
    assert time.monotonic() - begun < 25
    with house.client() as client:
        assert client.call("/relay/ping", {"robot": True})["result"]
    assert "Traceback" not in house.relay.log[since:]
