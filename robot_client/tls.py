"""TLS towards the relay: name and chain are checked, and what fails is said in words."""

from __future__ import annotations

import ipaddress
from pathlib import Path
from typing import Any, cast

from OpenSSL import SSL
from service_identity import VerificationError
from twisted.internet import error, ssl
from twisted.internet.endpoints import HostnameEndpoint, wrapClientTLS
from twisted.python.failure import Failure

from relay_protocol.errors import Invalid
from robot_client.reactors import Endpoint

CONNECT_SECONDS = 10.0
_PEM_END = b"-----END CERTIFICATE-----"


def is_loopback(host: str) -> bool:
    """Whether a host is this machine, where nobody listens in."""
    if host == "localhost" or host.endswith(".localhost"):
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def trust_root(ca: str) -> Any:
    """The authorities in a PEM file.

    :raises Invalid: no such file, or no certificate in it
    """
    try:
        text = Path(ca).read_bytes()
        blocks = [block + _PEM_END for block in text.split(_PEM_END)[:-1]]
        certificates = [ssl.Certificate.loadPEM(block) for block in blocks]
    except OSError as problem:
        raise Invalid(f"the CA file {ca} can't be read: {problem.strerror}") from None
    except SSL.Error:
        raise Invalid(f"the CA file {ca} holds something that is no certificate in PEM form") from None
    if not certificates:
        raise Invalid(f"the CA file {ca} holds no certificate in PEM form")
    return ssl.trustRootFromCertificates(certificates)  # type: ignore[no-untyped-call]


def endpoint(reactor: Any, host: str, port: int, tls: bool, ca: str = "", server_name: str = "") -> Endpoint:
    """Where to dial.

    :param ca: PEM file of the only authorities trusted; empty for the system's
    :param server_name: name the certificate must bear; empty for ``host``
    :raises Invalid: the CA file can't be used
    """
    plain: Any = HostnameEndpoint(reactor, host, port, timeout=CONNECT_SECONDS)
    if not tls:
        return cast(Endpoint, plain)
    options = ssl.optionsForClientTLS(
        server_name or host,
        trustRoot=trust_root(ca) if ca else None,
        extraCertificateOptions={"raiseMinimumTo": ssl.TLSVersion.TLSv1_2},
    )
    return cast(Endpoint, wrapClientTLS(options, plain))


def explain(failure: Failure) -> str:
    """Why a connection failed or ended, for a person."""
    problem = failure.value
    if isinstance(problem, VerificationError):
        return "the relay's certificate is for another name; nothing was said to it"
    if isinstance(problem, SSL.Error):
        return _explain_tls(problem)
    for kind, words in _WORDS.items():
        if isinstance(problem, kind):
            return words
    return f"the connection failed: {problem}"


_WORDS: dict[type[BaseException], str] = {
    error.ConnectionDone: "the relay closed the connection",
    error.ConnectionRefusedError: "nobody listens at the relay's address",
    error.DNSLookupError: "the relay's host name can't be resolved",
    error.TimeoutError: "the relay can't be reached: no answer in time",
    error.NoRouteError: "there is no route to the relay",
    error.ConnectionAborted: "the connection was cut on this side",
    error.ConnectionLost: "the connection to the relay broke",
}

_TLS_WORDS = {
    "certificate has expired": "the relay's certificate has expired; it must be renewed there",
    "not yet valid": "the relay's certificate is not valid yet; compare the clocks of both machines",
    "self-signed certificate": "the relay's certificate is of nobody this robot trusts; give its CA as --ca",
    "unable to get local issuer": "the relay's certificate is of a CA not trusted here; give it as --ca",
    "certificate verify failed": "the relay's certificate can't be verified; give its CA by --ca",
    "wrong version number": "the relay does not speak TLS on this port; for a trusted network say --no-tls",
    "unexpected eof": "the relay ended the TLS connection early; does it speak TLS on this port?",
}


def _explain_tls(problem: SSL.Error) -> str:
    text = str(problem).lower()
    for mark, words in _TLS_WORDS.items():
        if mark in text:
            return words
    if isinstance(problem, SSL.ZeroReturnError):
        return "the relay closed the connection"
    return "TLS with the relay failed"


def split_address(text: str, default_port: int = 9091) -> tuple[str, int]:
    """``host:port`` or ``[v6]:port`` in its parts.

    :raises Invalid: no host, or a port that is none
    """
    host, colon, port = text.rpartition(":")
    if not colon or text.endswith("]"):
        host, port = text, str(default_port)
    elif ":" in host and not host.startswith("["):
        host, port = text, str(default_port)  # a bare IPv6 address
    if not host.strip("[]") or not port.isascii() or not port.isdigit() or not 0 < int(port) < 65536:
        raise Invalid(f"'{text}' is no address; write host:port, as in relay.example:{default_port}")
    return host.strip("[]"), int(port)
