"""TLS of a real relay: trust, refusals with reasons, and certificates replaced during operation."""

from __future__ import annotations

import re
import shutil
import signal
import socket
import ssl
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509

from relay_server import PORTAL
from robot_client.apps.blocking_websocket import BlockingWebsocket
from robot_client.apps.connection import TOKEN, connected
from tests.worlds.certificates import DAY, Authority
from tests.worlds.client_threads import Driver
from tests.worlds.doc_examples import examples
from tests.worlds.doc_scene import ROOT
from tests.worlds.http_requests import ask
from tests.worlds.processes import BIN
from tests.worlds.relay_process import Relay
from tests.worlds.robot_process import Robot
from tests.worlds.sync_client import Client
from tests.worlds.waiting import PATIENCE, wait_for


class World:
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
        """The context of a client that trusts the CA."""
        return ssl.create_default_context(cafile=str(self.authority.path))

    def client(self) -> Client:
        """A websocket over TLS."""
        url = f"wss://127.0.0.1:{self.relay.http_port}/robots/rover"
        headers = {"Authorization": f"Bearer {self.token}"}
        return Client(
            BlockingWebsocket(url, ssl=self.context, additional_headers=headers, open_timeout=PATIENCE)
        )

    def reload(self, words: str) -> None:
        """Sends SIGHUP until the log has these words once more."""
        assert self.relay.process is not None
        before = self.relay.log.count(words)
        self.relay.process.signal(signal.SIGHUP)
        wait_for(f"the log says '{words}'", lambda: self.relay.log.count(words) > before)

    def serial(self, port: int) -> int:
        """The serial number of the certificate for a new connection."""
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
        self.robot.stop()
        self.relay.stop()


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """One world for all; tests that replace the certificate restore it."""
    world = World(tmp_path_factory.mktemp("tls"))
    try:
        yield world
    finally:
        world.stop()


READ_AGAIN = "the TLS certificate was read again"


@pytest.fixture
def swapped(world: World) -> Iterator[None]:
    """Restores a valid certificate."""
    yield
    world.authority.certify(world.cert, world.key)
    world.reload(READ_AGAIN)


def enroll(world: World, folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """Tries to enrol a robot over TLS; returns the output of ``switchboard-robot enroll``."""
    command = [str(BIN / "switchboard-robot"), "enroll", "--relay", f"127.0.0.1:{world.relay.robots_port}"]
    command += ["--robot", "newcomer", "--code", "-", "--state", str(folder / "state"), "--tls", *options]
    return subprocess.run(
        command, input="AAAA-BBBB-CCCC-DDDD", capture_output=True, text=True, timeout=60, check=False
    )


def refused(done: subprocess.CompletedProcess[str], words: str) -> None:
    """It failed for this reason, in one line."""
    assert done.returncode != 0
    assert words in done.stderr
    assert "Traceback" not in done.stderr


def test_pages_and_websockets_come_over_tls(world: World) -> None:
    """With the CA, https and wss work, send HSTS, and set cookies that are never sent over plain HTTP."""
    port = world.relay.http_port
    answer = ask(port, "GET", "/healthz", tls=world.context)
    assert answer.json == {"status": "ok"}
    assert "max-age=" in answer.headers["Strict-Transport-Security"]
    headers = {"Authorization": f"Bearer {world.relay.user('root', admin=True)}"}
    figures = ask(port, "GET", "/metrics", headers=headers, tls=world.context).body.decode()
    (ends,) = re.findall(r"^switchboard_certificate_expires_seconds (\S+)", figures, re.M)
    assert 0 < float(ends) - time.time() <= DAY.total_seconds()
    body = {"user": "driver", "password": "correct horse"}
    origin = {"Origin": f"https://127.0.0.1:{port}"}
    login = ask(port, "POST", "/api/v1/session", body, headers=origin, tls=world.context)
    assert login.status == 200
    assert "secure" in login.headers["Set-Cookie"].lower()
    assert login.cookie.startswith("__Host-switchboard_")
    with world.client() as client:
        assert client.call("/relay/ping", {"robot": True})["result"]


def test_pipelined_requests_are_answered_in_order_over_tls(world: World) -> None:
    """Answers of many pieces, read slowly, arrive whole."""
    assets = Path(PORTAL) / "assets"
    file = max(assets.iterdir(), key=lambda each: each.stat().st_size)
    request = f"GET /assets/{file.name} HTTP/1.1\r\nHost: x\r\n"
    received = b""
    with (
        socket.create_connection(("127.0.0.1", world.relay.http_port), timeout=PATIENCE) as plain,
        world.context.wrap_socket(plain, server_hostname="127.0.0.1") as secure,
    ):
        secure.sendall((f"{request}\r\n" * 3 + f"{request}Connection: close\r\n\r\n").encode())
        while data := secure.recv(5000):
            received += data
    assert received.count(file.read_bytes()) == 4


def test_a_program_reads_and_writes_tls_in_one_thread(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """OpenSSL allows no more; otherwise a connection hangs now and then when a session ticket comes."""
    threads: set[int] = set()

    class Watched(ssl.SSLObject):
        def read(self, *arguments: Any) -> Any:
            threads.add(threading.get_ident())
            return super().read(*arguments)

        def write(self, data: Any) -> int:
            threads.add(threading.get_ident())
            return super().write(data)

    class WatchedSocket(ssl.SSLSocket):
        def read(self, *arguments: Any) -> Any:
            threads.add(threading.get_ident())
            return super().read(*arguments)

        def sendall(self, *arguments: Any) -> None:
            threads.add(threading.get_ident())
            return super().sendall(*arguments)

    monkeypatch.setattr(ssl.SSLContext, "sslobject_class", Watched)
    monkeypatch.setattr(ssl.SSLContext, "sslsocket_class", WatchedSocket)
    monkeypatch.setenv("SSL_CERT_FILE", str(world.authority.path))
    monkeypatch.setenv(TOKEN, world.token)
    with connected(f"wss://127.0.0.1:{world.relay.http_port}/robots/rover") as program:
        number = program.call("/relay/ping")
        while (answer := program.receive(PATIENCE)) is not None and answer.get("id") != number:
            pass
        assert answer is not None
        assert answer["result"]
    assert len(threads) == 1


def test_robot_that_does_not_trust_the_ca_does_not_connect(world: World) -> None:
    """The relay's certificate is of its own CA, which the system's store does not have."""
    with pytest.raises(ssl.SSLCertVerificationError):
        ask(world.relay.http_port, "GET", "/healthz", tls=ssl.create_default_context())


def test_a_robot_is_driven_over_tls(world: World) -> None:
    """Enrolled with --ca, the robot uses TLS for its control link and its channel link."""
    driver = Driver(world.client())
    driver.start()
    try:
        wait_for("the robot moves", world.robot.moving)
    finally:
        driver.stop()
    wait_for("the robot stands", lambda: not world.robot.moving())


def test_a_robot_refuses_a_ca_it_was_not_given(world: World, tmp_path: Path) -> None:
    """A relay of a foreign CA is refused with a reason, and does not receive the code."""
    refused(
        enroll(world, tmp_path, "--ca", str(world.foreign.path)),
        "not issued by an authority this robot trusts; give its CA",
    )


def test_a_robot_refuses_a_certificate_for_another_name(world: World, tmp_path: Path) -> None:
    """The certificate must have the dialled or given name."""
    trust = ("--ca", str(world.authority.path))
    refused(enroll(world, tmp_path, *trust, "--server-name", "other.example"), "for another name")
    # With the right name, only the code is refused.
    refused(enroll(world, tmp_path, *trust, "--server-name", "elsewhere.example"), "code is wrong")


@pytest.mark.usefixtures("swapped")
def test_a_robot_refuses_a_certificate_for_another_address(world: World, tmp_path: Path) -> None:
    """A certificate without the dialled address is refused with a reason."""
    world.authority.certify(world.cert, world.key, host=False)
    world.reload(READ_AGAIN)
    refused(enroll(world, tmp_path, "--ca", str(world.authority.path)), "for another name")


@pytest.mark.usefixtures("swapped")
def test_a_robot_refuses_an_expired_certificate(world: World, tmp_path: Path) -> None:
    """The error says what to do."""
    world.authority.certify(world.cert, world.key, good=-DAY)
    world.reload(READ_AGAIN)
    refused(enroll(world, tmp_path, "--ca", str(world.authority.path)), "expired; renew it on the relay")


@pytest.mark.usefixtures("swapped")
def test_a_robot_trusts_the_documented_authority(world: World, tmp_path: Path) -> None:
    """The commands of docs/operate/tls.md make files by which relay and robot connect."""
    for line in examples(ROOT / "docs/operate/tls.md"):
        if line.text.startswith("openssl "):
            subprocess.run(
                ["bash", "-c", line.text], cwd=tmp_path, check=True, capture_output=True, timeout=60
            )
    shutil.copy(tmp_path / "chain.pem", world.cert)
    shutil.copy(tmp_path / "key.pem", world.key)
    world.reload(READ_AGAIN)
    trust = ("--ca", str(tmp_path / "ca.pem"), "--server-name", "robots.example.org")
    refused(enroll(world, tmp_path, *trust), "code is wrong")
    context = ssl.create_default_context(cafile=str(tmp_path / "ca.pem"))
    with (
        socket.create_connection(("127.0.0.1", world.relay.http_port), timeout=10) as plain,
        context.wrap_socket(plain, server_hostname="robots.example.org") as secure,
    ):
        assert secure.getpeercert()


ROSLIBPY = """
import sys

import roslibpy

ros = roslibpy.Ros(URL, headers={"Authorization": "Bearer TOKEN"})
try:
    ros.run(timeout=10)
except Exception:
    pass
print(ros.is_connected, flush=True)
ros.terminate()
"""


def test_roslibpy_checks_the_certificate_as_documented(world: World, tmp_path: Path) -> None:
    """It connects to no relay of another authority or name, and so sends no token there."""
    (block,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs/operate/tls.md").read_text("utf-8"), re.S)
    url = f'"wss://127.0.0.1:{world.relay.http_port}/robots/rover"'
    connects = ROSLIBPY.replace("URL", url).replace("TOKEN", world.token)
    programs = []
    for authority, name in (
        (world.authority, "elsewhere.example"),
        (world.authority, "other.example"),
        (world.foreign, "elsewhere.example"),
    ):
        folder = tmp_path / f"{len(programs)}"
        folder.mkdir()
        shutil.copy(authority.path, folder / "ca.pem")
        text = block.replace("robots.example.org", name) + connects
        programs.append(
            subprocess.Popen([sys.executable, "-c", text], cwd=folder, stdout=subprocess.PIPE, text=True)
        )
    assert [each.communicate(timeout=PATIENCE)[0].strip() for each in programs] == ["True", "False", "False"]


@pytest.mark.parametrize("listener", ["http_port", "robots_port"])
def test_tls_1_1_is_refused(world: World, listener: str) -> None:
    """An older client gets the alert for its version; 1.2 is accepted."""

    def shake(version: ssl.TLSVersion) -> str:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.check_hostname = False
        context.verify_mode = ssl.CERT_NONE
        context.set_ciphers("ALL:@SECLEVEL=0")
        context.minimum_version = context.maximum_version = version
        with (
            socket.create_connection(("127.0.0.1", getattr(world.relay, listener)), timeout=10) as plain,
            context.wrap_socket(plain) as secure,
        ):
            return str(secure.version())

    with pytest.warns(DeprecationWarning), pytest.raises(ssl.SSLError) as alert:
        shake(ssl.TLSVersion.TLSv1_1)
    assert alert.value.reason == "TLSV1_ALERT_PROTOCOL_VERSION"
    assert shake(ssl.TLSVersion.TLSv1_2) == "TLSv1.2"


def test_sighup_swaps_the_certificate_and_drops_nothing(world: World) -> None:
    """New connections get the new certificate; existing connections of robot and client stay."""
    ports = (world.relay.http_port, world.relay.robots_port)
    with world.client() as client:
        client.send(op="subscribe", topic="/odom", type="nav_msgs/msg/Odometry")
        client.until(op="publish")
        offline = world.relay.log.count("is offline")
        new = world.authority.certify(world.cert, world.key)
        assert all(world.serial(port) != new for port in ports)
        world.reload(READ_AGAIN)
        assert all(world.serial(port) == new for port in ports)
        assert client.call("/relay/ping", {"robot": True})["result"]
        client.until(op="publish", topic="/odom")
        with world.client() as other:
            assert other.call("/relay/ping")["result"]
        assert world.relay.log.count("is offline") == offline


def test_a_certificate_that_can_not_be_used_changes_nothing(world: World) -> None:
    """After SIGHUP with a broken file the log has an error, and the old certificate stays in use."""
    old = world.serial(world.relay.http_port)
    good = world.cert.read_bytes()
    world.cert.write_text("no certificate")
    try:
        world.reload("the old certificate stays in use")
        assert world.serial(world.relay.http_port) == old
    finally:
        world.cert.write_bytes(good)
    assert ask(world.relay.http_port, "GET", "/healthz", tls=world.context).status == 200


def test_client_without_tls_is_cut_and_disturbs_no_other(world: World) -> None:
    """Plain HTTP, plain frames and silence end by themselves without effect on the relay."""
    since = len(world.relay.log)
    opened = []
    for port in (world.relay.http_port, world.relay.robots_port):
        for first in (b"GET / HTTP/1.1\r\nHost: x\r\n\r\n", b"\x00\x00\x00\x02\x00{", b""):
            plain = socket.create_connection(("127.0.0.1", port), timeout=PATIENCE)
            plain.sendall(first)
            opened.append(plain)
    for plain in opened:
        try:
            while plain.recv(4096):
                pass
        except ConnectionError:
            pass
        plain.close()
    with world.client() as client:
        assert client.call("/relay/ping", {"robot": True})["result"]
    assert "Traceback" not in world.relay.log[since:]
