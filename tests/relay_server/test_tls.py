"""Certificates of the listeners, read again while they serve."""

from __future__ import annotations

import contextlib
import datetime
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from OpenSSL import SSL

from relay_protocol.errors import Invalid
from relay_server.listeners import ServerTls


def make(folder: Path, name: str) -> tuple[Path, Path]:
    """Makes a self-signed certificate and its key, as PEM files."""
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    now = datetime.datetime.now(datetime.UTC)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(hours=1))
        .not_valid_after(now + datetime.timedelta(hours=1))
        .sign(key, hashes.SHA256())
    )
    cert_file, key_file = folder / f"{name}.crt", folder / f"{name}.key"
    cert_file.write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
    key_file.write_bytes(
        key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
    )
    return cert_file, key_file


def handshake(other: SSL.Connection, newest: int = SSL.TLS1_3_VERSION) -> SSL.Connection:
    """The client side of a TLS connection in memory, after the handshake."""
    context = SSL.Context(SSL.TLS_CLIENT_METHOD)
    context.set_max_proto_version(newest)
    client = SSL.Connection(context, None)
    client.set_connect_state()
    other.set_accept_state()
    waiting = {client, other}
    for _ in range(20):
        for end, peer in ((client, other), (other, client)):
            try:
                end.do_handshake()
                waiting.discard(end)
            except SSL.WantReadError:
                pass
            with contextlib.suppress(SSL.WantReadError):
                peer.bio_write(end.bio_read(1 << 16))
        if not waiting:
            return client
    raise AssertionError("the handshake did not end")


def connection(tls: ServerTls) -> SSL.Connection:
    """The TLS connection that Twisted makes for a new client."""
    return tls.serverConnectionForTLS(None)


def name_of(server: SSL.Connection) -> str:
    """The common name that a client sees."""
    certificate = handshake(server).get_peer_certificate()
    assert certificate is not None
    return str(certificate.get_subject().CN)


def test_a_new_certificate_is_taken_up_by_reload(tmp_path: Path) -> None:
    """New connections get the new one; existing connections keep the old one."""
    cert, key = make(tmp_path, "old")
    tls = ServerTls(cert, key)
    before = connection(tls)
    new_cert, new_key = make(tmp_path, "new")
    cert.write_bytes(new_cert.read_bytes())
    key.write_bytes(new_key.read_bytes())
    tls.reload()
    assert name_of(connection(tls)) == "new"
    assert name_of(before) == "old"


@pytest.mark.parametrize("damage", ["missing", "junk", "another's key"])
def test_a_certificate_that_can_not_be_used_leaves_the_old_one(tmp_path: Path, damage: str) -> None:
    """The error of the reload has a reason, and nothing changes."""
    cert, key = make(tmp_path, "old")
    tls = ServerTls(cert, key)
    if damage == "missing":
        cert.unlink()
    elif damage == "junk":
        cert.write_text("no certificate")
    else:
        key.write_bytes(make(tmp_path, "other")[1].read_bytes())
    with pytest.raises(Invalid, match=r"old\.crt with the key old\.key can't be used"):
        tls.reload()
    assert name_of(connection(tls)) == "old"


def test_at_the_start_a_bad_certificate_is_an_error_with_a_reason(tmp_path: Path) -> None:
    """The error contains no path of the machine."""
    with pytest.raises(Invalid, match="PEM files") as reported:
        ServerTls(tmp_path / "none.crt", tmp_path / "none.key")
    assert str(tmp_path) not in str(reported.value)


def test_tls_below_1_2_is_refused(tmp_path: Path) -> None:
    """The minimum is 1.2."""
    tls = ServerTls(*make(tmp_path, "relay"))
    assert handshake(connection(tls), SSL.TLS1_2_VERSION).get_protocol_version_name() == "TLSv1.2"
    with pytest.raises(SSL.Error):
        handshake(connection(tls), SSL.TLS1_1_VERSION)
