"""Servers that receive messages: HTTP with answers of the test, TLS, a mail server."""

from __future__ import annotations

import datetime
from collections.abc import Callable
from ipaddress import ip_address
from pathlib import Path
from typing import Any

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from twisted.internet import reactor
from twisted.internet.protocol import Factory, Protocol
from twisted.internet.ssl import Certificate, CertificateOptions, PrivateCertificate
from twisted.web.resource import Resource
from twisted.web.server import NOT_DONE_YET, Request, Site

REACTOR: Any = reactor


class WebhookResource(Resource):
    """Accepts posts, and answers with a status.

    :param status: 0: never
    """

    isLeaf = True

    def __init__(self, status: int = 204) -> None:
        super().__init__()
        self.status = status
        self.headers: dict[str, str] = {}
        self.got: list[tuple[Request, bytes]] = []

    def render(self, request: Request) -> Any:
        self.got.append((request, request.content.read()))
        if not self.status:
            return NOT_DONE_YET
        request.setResponseCode(self.status)
        for name, value in self.headers.items():
            request.setHeader(name, value)
        return b"" if self.status == 204 else b"x" * 100_000


def serve(webhook_receiver: Resource, host: str = "127.0.0.1", tls: CertificateOptions | None = None) -> Any:
    """A port chosen by the OS, which the test stops."""
    site = Site(webhook_receiver)
    site.noisy = False
    if tls is None:
        return REACTOR.listenTCP(0, site, interface=host)
    return REACTOR.listenSSL(0, site, tls, interface=host)


def raw(behave: Callable[[Any], None]) -> Any:
    """A server without HTTP: its reaction to received bytes."""

    class Rude(Protocol):
        def dataReceived(self, data: bytes) -> None:
            behave(self.transport)

    factory = Factory.forProtocol(Rude)
    factory.noisy = False
    return REACTOR.listenTCP(0, factory, interface="127.0.0.1")


def certificate(folder: Path, name: str) -> tuple[CertificateOptions, Certificate]:
    """A self-signed certificate for a name or an address: the server's, and the one that a client trusts."""
    pem = self_signed(name)
    return PrivateCertificate.loadPEM(pem).options(), Certificate.loadPEM(pem)


def self_signed(name: str) -> bytes:
    """A self-signed certificate for a name or an address, and its key (PEM)."""
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    now = datetime.datetime.now(datetime.UTC)
    whose: x509.GeneralName = x509.IPAddress(ip_address(name)) if name[0].isdigit() else x509.DNSName(name)
    made = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(hours=1))
        .not_valid_after(now + datetime.timedelta(hours=1))
        .add_extension(x509.SubjectAlternativeName([whose]), critical=False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
        .sign(key, hashes.SHA256())
    )
    return made.public_bytes(serialization.Encoding.PEM) + key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
