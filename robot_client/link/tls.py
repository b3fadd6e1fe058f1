"""Endpoints for dialling the relay, with TLS or plain, and connection errors as text for people."""

from __future__ import annotations

import ipaddress
from pathlib import Path
from typing import Any, cast

from OpenSSL import SSL
from service_identity import CertificateError, VerificationError
from service_identity.hazmat import DNS_ID, IPAddress_ID, verify_service_identity
from service_identity.pyopenssl import extract_patterns
from twisted.internet import error, ssl
from twisted.internet.endpoints import HostnameEndpoint, wrapClientTLS
from twisted.internet.interfaces import IOpenSSLClientConnectionCreator
from twisted.python.failure import Failure
from zope.interface import implementer

from relay_protocol.errors import Invalid, Refused, SwitchboardError
from robot_client.twisted_types import DialEndpoint

CONNECT_SECONDS = 10.0
_PEM_END = b"-----END CERTIFICATE-----"


def is_loopback(host: str) -> bool:
    """Whether a host is this machine, so that plain connections can't be observed."""
    if host == "localhost" or host.endswith(".localhost"):
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def trust_root(ca: str) -> Any:
    """The authorities in a PEM file.

    :raises Invalid: the file can't be read or holds no certificate
    """
    try:
        text = Path(ca).read_bytes()
        blocks = [block + _PEM_END for block in text.split(_PEM_END)[:-1]]
        certificates = [ssl.Certificate.loadPEM(block) for block in blocks]
    except OSError as problem:
        raise Invalid(f"the CA file {ca} can't be read: {problem.strerror}") from None
    except SSL.Error:
        raise Invalid(f"the CA file {ca} holds a block that is not a certificate in PEM form") from None
    if not certificates:
        raise Invalid(f"the CA file {ca} holds no certificate in PEM form")
    return ssl.trustRootFromCertificates(certificates)


def endpoint(
    reactor: Any, host: str, port: int, tls: bool, ca: str = "", server_name: str = ""
) -> DialEndpoint:
    """The relay's endpoint.

    :param ca: PEM file of the only trusted authorities; empty for the system's
    :param server_name: name in the relay's certificate; empty for ``host``
    :raises Invalid: the CA file or the name can't be used
    """
    plain: Any = HostnameEndpoint(reactor, host, port, timeout=CONNECT_SECONDS)
    if not tls:
        return cast(DialEndpoint, plain)
    name = server_name or host
    trusted = trust_root(ca) if ca else None
    try:
        options = ssl.optionsForClientTLS(
            name,
            trustRoot=trusted,
            extraCertificateOptions={"raiseMinimumTo": ssl.TLSVersion.TLSv1_2},
        )
    except ValueError:  # also the base of idna's errors
        raise Invalid(f"'{name}' can't be the name in a certificate; set --server-name") from None
    return cast(DialEndpoint, wrapClientTLS(cast(Any, _ExplainingTls(options, name)), plain))


class CertificateRefused(Refused):
    """The relay's certificate was refused; nothing was sent to it."""


@implementer(IOpenSSLClientConnectionCreator)
class _ExplainingTls:
    """Twisted's TLS client with checks that give the reason of a failure; OpenSSL's error only says *failed*.

    :param inner: creates the connections
    :param name: name the certificate must have
    """

    def __init__(self, inner: Any, name: str) -> None:
        self._inner = inner
        self._name = name
        try:
            self._id: Any = IPAddress_ID(name)
        except ValueError:
            self._id = DNS_ID(name)

    def clientConnectionForTLS(self, protocol: Any) -> SSL.Connection:
        """Create a connection that checks chain and name."""
        connection: SSL.Connection = self._inner.clientConnectionForTLS(protocol)

        def check(_: SSL.Connection, certificate: Any, code: int, depth: int, good: int) -> bool:
            reason = self._problem(certificate, code, depth, bool(good))
            if reason:
                protocol.failVerification(Failure(CertificateRefused(reason)))
            return not reason

        connection.set_verify(SSL.VERIFY_PEER | SSL.VERIFY_FAIL_IF_NO_PEER_CERT, check)
        return connection

    def _problem(self, certificate: Any, code: int, depth: int, good: bool) -> str:
        """Describe the fault of one certificate of the chain; empty if it has none."""
        if not good:
            return _CHAIN_TEXTS.get(
                code, f"the relay's certificate can't be verified (OpenSSL's reason {code})"
            )
        if depth > 0:
            return ""
        try:
            verify_service_identity(extract_patterns(certificate), [self._id], [])
        except (VerificationError, CertificateError):
            return f"the relay's certificate is for another name than {self._name}; set --server-name if it is right"
        except Exception:  # an exception in OpenSSL's callback would be lost and the certificate accepted
            return "the relay's certificate can't be read"
        return ""


_UNTRUSTED = "the relay's certificate is not issued by an authority this robot trusts; give its CA with --ca"
_CODES = SSL.X509VerificationCodes
_CHAIN_TEXTS = {
    _CODES.ERR_CERT_HAS_EXPIRED: "the relay's certificate has expired; renew it on the relay",
    _CODES.ERR_CERT_NOT_YET_VALID: "the relay's certificate is not valid yet; compare the clocks of both machines",
    _CODES.ERR_DEPTH_ZERO_SELF_SIGNED_CERT: _UNTRUSTED,
    _CODES.ERR_SELF_SIGNED_CERT_IN_CHAIN: _UNTRUSTED,
    _CODES.ERR_UNABLE_TO_GET_ISSUER_CERT_LOCALLY: _UNTRUSTED,
    _CODES.ERR_UNABLE_TO_VERIFY_LEAF_SIGNATURE: _UNTRUSTED,
}


def explain(failure: Failure) -> str:
    """The reason why a connection failed or ended, as text for people."""
    problem = failure.value
    if isinstance(problem, SwitchboardError):
        return str(problem)
    if isinstance(problem, SSL.Error):
        return _explain_tls(problem)
    if isinstance(problem, error.DNSLookupError):
        return f"the relay's host name can't be resolved ({problem})"
    for kind, text in _ERROR_TEXTS.items():
        if isinstance(problem, kind):
            return text
    return f"the connection failed: {problem}"


_ERROR_TEXTS: dict[type[BaseException], str] = {
    error.ConnectionDone: "the relay closed the connection",
    error.ConnectionRefusedError: "the relay's address refuses connections; check that the relay is running",
    error.TimeoutError: "the relay can't be reached: no answer in time",
    error.NoRouteError: "there is no route to the relay",
    error.ConnectionAborted: "the connection was cut on this side",
    error.ConnectionLost: "the connection to the relay broke",
}

_TLS_TEXTS = {
    "wrong version number": (
        "the relay does not use TLS on this port; check the port, and in a trusted network use --no-tls"
    ),
    "unexpected eof": "the relay ended the TLS connection early; check that it uses TLS on this port",
}


def _explain_tls(problem: SSL.Error) -> str:
    text = str(problem).lower()
    for mark, explanation in _TLS_TEXTS.items():
        if mark in text:
            return explanation
    if isinstance(problem, SSL.ZeroReturnError):
        return "the relay closed the connection"
    return "TLS with the relay failed"


def split_address(text: str, default_port: int = 9091) -> tuple[str, int]:
    """Split ``host:port`` or ``[v6]:port``.

    :raises Invalid: the host is missing or the port is not valid
    """
    host, colon, port = text.rpartition(":")
    if not colon or text.endswith("]"):
        host, port = text, str(default_port)
    elif ":" in host and not host.startswith("["):
        host, port = text, str(default_port)  # a bare IPv6 address
    if (
        not host.strip("[]")
        or any(each == "/" or each.isspace() for each in host)
        or not port.isascii()
        or not port.isdigit()
        or not 0 < int(port) < 65536
    ):
        raise Invalid(f"'{text}' is not an address; write host:port, as in relay.example:{default_port}")
    return host.strip("[]"), int(port)
