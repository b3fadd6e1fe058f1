"""TLS towards the relay, with real certificates over real TCP."""

from __future__ import annotations

import datetime
import ipaddress
import socket
import ssl
import sys
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from subprocess import PIPE, Popen, run

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from relay_protocol.errors import Invalid
from robot_client import cli
from robot_client.link.enrolment import StateFolder
from robot_client.link.tls import is_loopback, split_address, trust_root
from tests.worlds.fake_relay import PATIENCE, FakeRelay

ENROLL = (sys.executable, "-m", "robot_client.cli", "enroll", "--robot", "r1", "--code", "c")
DAY = datetime.timedelta(days=1)


class Authority:
    """A CA of the test's own."""

    def __init__(self, folder: Path, name: str) -> None:
        self._folder = folder
        self._key = ec.generate_private_key(ec.SECP256R1())
        self._name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        certificate = self._sign(self._name, self._key.public_key(), x509.BasicConstraints(True, None), DAY)
        self.path = folder / f"{name}.pem"
        self.path.write_bytes(certificate.public_bytes(serialization.Encoding.PEM))

    def _sign(
        self,
        subject: x509.Name,
        key: ec.EllipticCurvePublicKey,
        extension: x509.ExtensionType,
        good: datetime.timedelta,
    ) -> x509.Certificate:
        now = datetime.datetime.now(datetime.timezone.utc)
        builder = x509.CertificateBuilder().subject_name(subject).issuer_name(self._name).public_key(key)
        builder = builder.serial_number(x509.random_serial_number())
        builder = builder.not_valid_before(now - 2 * DAY).not_valid_after(now + good)
        return builder.add_extension(extension, critical=False).sign(self._key, hashes.SHA256())

    def server(self, names: list[x509.GeneralName], good: datetime.timedelta = DAY) -> ssl.SSLContext:
        """A server's context with a certificate for these names."""
        key = ec.generate_private_key(ec.SECP256R1())
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "relay")])
        certificate = self._sign(subject, key.public_key(), x509.SubjectAlternativeName(names), good)
        path = self._folder / "server.pem"
        path.write_bytes(
            key.private_bytes(
                serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
            )
            + certificate.public_bytes(serialization.Encoding.PEM)
        )
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.load_cert_chain(path)
        return context


LOOPBACK = [x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]


@pytest.fixture
def ca(tmp_path: Path) -> Authority:
    return Authority(tmp_path, "ca")


@pytest.fixture
def relay() -> Iterator[FakeRelay]:
    with closing(FakeRelay()) as made:
        yield made


def enroll(relay: FakeRelay, state: Path, *arguments: str) -> tuple[int, str, bool]:
    """Enrol; return exit code, output, and whether the relay received anything."""
    process = Popen(
        [*ENROLL, "--relay", relay.address, "--state", str(state), *arguments],
        stdout=PIPE,
        stderr=PIPE,
        text=True,
    )
    answered = []

    def answer() -> None:
        try:
            answered.append(relay.enroll())
        except Exception:
            return

    thread = threading.Thread(target=answer, daemon=True)
    thread.start()
    out, err = process.communicate(timeout=PATIENCE)
    return process.returncode, out + err, bool(answered)


def test_own_ca_and_right_name_are_accepted(relay: FakeRelay, ca: Authority, tmp_path: Path) -> None:
    relay._tls = ca.server(LOOPBACK)
    code, said, answered = enroll(relay, tmp_path / "s", "--tls", "--ca", str(ca.path))
    assert code == 0, said
    assert answered
    enrolment, _ = StateFolder(tmp_path / "s").load()
    assert enrolment.ca == str(tmp_path / "s" / "ca.pem")
    assert Path(enrolment.ca).read_bytes() == ca.path.read_bytes()


def test_server_name_can_be_set(relay: FakeRelay, ca: Authority, tmp_path: Path) -> None:
    relay._tls = ca.server([x509.DNSName("relay.example")])
    code, said, _ = enroll(relay, tmp_path / "s", "--ca", str(ca.path), "--server-name", "relay.example")
    assert code == 0, said


def refused(relay: FakeRelay, tmp_path: Path, *arguments: str) -> str:
    code, said, answered = enroll(relay, tmp_path / "s", *arguments)
    assert code == 1
    assert not answered
    assert not (tmp_path / "s").exists()
    assert "Traceback" not in said
    return said


def test_wrong_name_is_refused(relay: FakeRelay, ca: Authority, tmp_path: Path) -> None:
    """Before anything is sent."""
    relay._tls = ca.server([x509.DNSName("other.example")])
    assert "another name" in refused(relay, tmp_path, "--tls", "--ca", str(ca.path))


def test_expired_certificate_is_refused(relay: FakeRelay, ca: Authority, tmp_path: Path) -> None:
    relay._tls = ca.server(LOOPBACK, good=-DAY)
    assert "has expired" in refused(relay, tmp_path, "--tls", "--ca", str(ca.path))


def test_foreign_ca_is_refused(relay: FakeRelay, ca: Authority, tmp_path: Path) -> None:
    relay._tls = Authority(tmp_path, "foreign").server(LOOPBACK)
    assert "not issued by an authority this robot trusts" in refused(
        relay, tmp_path, "--tls", "--ca", str(ca.path)
    )


def test_private_ca_is_refused_without_the_option(relay: FakeRelay, ca: Authority, tmp_path: Path) -> None:
    relay._tls = ca.server(LOOPBACK)
    assert "--ca" in refused(relay, tmp_path, "--tls")


def test_plain_relay_is_reported_to_a_tls_client(relay: FakeRelay, ca: Authority, tmp_path: Path) -> None:
    said = refused(relay, tmp_path, "--tls", "--ca", str(ca.path))
    assert "TLS" in said


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ([], "this is a port for browsers and clients; robots dial another one, 9091 by default"),
        (
            ["--tls"],
            "the relay does not use TLS on this port; check the port, and in a trusted network use --no-tls",
        ),
    ],
)
def test_a_port_that_is_none_for_robots_is_reported(
    tmp_path: Path, options: list[str], expected: str
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer() -> None:
            connection, _ = server.accept()
            connection.recv(65536)
            connection.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")
            connection.close()

        thread = threading.Thread(target=answer)
        thread.start()
        address = f"127.0.0.1:{server.getsockname()[1]}"
        command = [*ENROLL, "--relay", address, "--state", str(tmp_path / "s"), *options]
        done = run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)
        thread.join()
    assert f"Error: {expected}\n" in done.stderr


def test_missing_ca_file_is_reported(relay: FakeRelay, tmp_path: Path) -> None:
    """Before dialling."""
    assert "can't be read" in refused(relay, tmp_path, "--tls", "--ca", str(tmp_path / "none.pem"))


def test_file_without_a_certificate_is_reported(tmp_path: Path) -> None:
    (tmp_path / "x.pem").write_text("hello")
    with pytest.raises(Invalid, match="no certificate"):
        trust_root(str(tmp_path / "x.pem"))


@pytest.mark.parametrize(
    ("host", "loopback"),
    [
        ("127.0.0.1", True),
        ("localhost", True),
        ("::1", True),
        ("[::1]", True),
        ("10.0.0.1", False),
        ("relay", False),
    ],
)
def test_loopback_addresses_are_recognised(host: str, loopback: bool) -> None:
    assert is_loopback(host) is loopback


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("relay:99", ("relay", 99)),
        ("relay", ("relay", 9091)),
        ("[::1]:99", ("::1", 99)),
        ("[::1]", ("::1", 9091)),
        ("::1", ("::1", 9091)),
    ],
)
def test_addresses_are_split(text: str, parts: tuple[str, int]) -> None:
    """IPv6 too; the port may be missing."""
    assert split_address(text) == parts


@pytest.mark.parametrize("text", ["", ":99", "relay:", "relay:x", "relay:0", "relay:65536", "relay:٣"])
def test_invalid_address_is_refused(text: str) -> None:
    with pytest.raises(Invalid, match="not an address"):
        split_address(text)


def test_plain_link_to_another_machine_gives_a_warning(capsys: pytest.CaptureFixture[str]) -> None:
    for host, tls in (("127.0.0.1", False), ("relay.example", True)):
        cli.warn_if_plain(host, tls)
    assert capsys.readouterr().err == ""
    cli.warn_if_plain("relay.example", False)
    assert "not encrypted" in capsys.readouterr().err
