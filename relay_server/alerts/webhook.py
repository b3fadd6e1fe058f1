"""Messages to addresses that users chose, without a way into the networks of the relay.

A name is resolved here, all it stands for is judged, and the connection goes to the very address that was judged.
No redirect is followed, no proxy is used, little of the answer is read.
"""

from __future__ import annotations

import hashlib
import hmac
import io
import re
from collections.abc import Awaitable, Callable
from ipaddress import IPv6Address
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from OpenSSL.SSL import Error as TlsError
from service_identity import VerificationError
from twisted.internet.defer import CancelledError, Deferred
from twisted.internet.defer import TimeoutError as DeferTimeout
from twisted.internet.endpoints import TCP4ClientEndpoint, TCP6ClientEndpoint, wrapClientTLS
from twisted.internet.error import ConnectError, ConnectingCancelledError
from twisted.internet.interfaces import IStreamClientEndpoint
from twisted.internet.ssl import optionsForClientTLS, platformTrust
from twisted.protocols.policies import ProtocolWrapper, WrappingFactory
from twisted.web.client import Agent, FileBodyProducer
from twisted.web.http_headers import Headers
from twisted.web.iweb import IAgentEndpointFactory
from zope.interface import implementer

from relay_db.queries import AlertRuleRecord
from relay_protocol import jsontext
from relay_protocol.errors import Invalid
from relay_protocol.limits import KIB
from relay_server.alerts.egress import SPECIAL_NAMES, EgressPolicy, unreachable
from relay_server.alerts.message import NotificationMessage, Undelivered

SECONDS = 10.0
CONNECT_SECONDS = 4.0
ANSWER_BYTES = 64 * KIB
"""What of an answer is read, head and all."""

ADDRESSES = 3
"""Addresses of one name that are tried."""

AGAIN = frozenset({408, 425, 429})
"""Answers below 500 after which a message is sent again (RFC 9110, RFC 8470, RFC 6585)."""

_PRINTABLE = re.compile(r"[\x21-\x7e]+\Z")
_HOST = re.compile(r"[A-Za-z0-9_]([A-Za-z0-9_.-]{0,251}[A-Za-z0-9_])?\.?\Z")

Resolve = Callable[[str, int, int], Awaitable[list[str]]]
"""All addresses of a host and port, for a user. Raises :class:`Undelivered`."""


class WebhookTarget(NamedTuple):
    """Where a message goes."""

    tls: bool
    host: str
    port: int
    target: str

    @property
    def url(self) -> str:
        """Put together again, so that nobody reads it otherwise."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{'https' if self.tls else 'http'}://{host}:{self.port}{self.target}"


def parse(url: str) -> WebhookTarget:
    """Read the address of a webhook.

    :raises Invalid: it is none, in words
    """
    wrong = "a webhook's 'url' is https://host/path, in ASCII, without a user, a password or a fragment"
    if not _PRINTABLE.match(url) or "\\" in url or "#" in url:
        raise Invalid(wrong)
    try:
        parts = urlsplit(url)
        host, port = parts.hostname or "", parts.port
        if "[" in parts.netloc:
            host = str(IPv6Address(host))
    except ValueError:
        raise Invalid(wrong) from None
    named = (":" in host and "%" not in host) or _HOST.match(host)
    if parts.scheme not in ("http", "https") or "@" in parts.netloc or not named or port == 0:
        raise Invalid(wrong)
    tls = parts.scheme == "https"
    if tls and not _certifiable(host):
        raise Invalid(
            "no certificate can be for the host of this webhook's 'url'; names have letters, digits and hyphens"
        )
    query = f"?{parts.query}" if parts.query else ""
    return WebhookTarget(tls, host, port or (443 if tls else 80), (parts.path or "/") + query)


def _certifiable(host: str) -> bool:
    """Whether TLS knows hosts of this form (RFC 5890): there are names that the system resolves all the same."""
    try:
        optionsForClientTLS(host)
    except ValueError:  # that of the idna package is one
        return False
    return True


def signature(secret: str, timestamp: str, body: bytes) -> str:
    """What proves to a receiver who knows the secret that the relay sent this body then."""
    signed = timestamp.encode() + b"." + body
    return "v1=" + hmac.new(secret.encode(), signed, hashlib.sha256).hexdigest()


class Webhooks:
    """Sends messages as HTTP requests.

    :param reactor: Twisted's
    :param fence: says which addresses may be reached
    :param wall: Unix time in seconds
    :param trust: whose certificates count; ``None`` for those the system trusts
    """

    def __init__(
        self,
        reactor: Any,
        resolve: Resolve,
        fence: EgressPolicy,
        wall: Callable[[], float],
        trust: Any = None,
    ) -> None:
        self._reactor = reactor
        self._resolve = resolve
        self._fence = fence
        self.relay = ""
        """Its name, for those who are told."""
        self._wall = wall
        self._trust = trust

    def check(self, url: str) -> None:
        """Whether this can be the address of a webhook; what its name stands for is judged at each message.

        :raises Invalid: it can't
        """
        parse(url)

    async def send(self, rule: AlertRuleRecord, message: NotificationMessage) -> None:
        """Deliver one message.

        :raises Undelivered: it was not taken
        """
        try:
            place = parse(rule.url)
        except Invalid as error:
            raise Undelivered(str(error), again=False) from None
        body = jsontext.encode(message.fields(self.relay, rule.id))
        sending = Deferred.fromCoroutine(
            self._send(place, rule.user_id, self._headers(rule, message, body), body)
        )
        try:
            status = await sending.addTimeout(SECONDS, self._reactor)
        except DeferTimeout:
            raise Undelivered(f"{place.host} did not answer within {SECONDS:g} s", again=True) from None
        if not 200 <= status < 300:
            again = status >= 500 or status in AGAIN
            raise Undelivered(f"{place.host} answered with the status {status}", again=again)

    def _headers(self, rule: AlertRuleRecord, message: NotificationMessage, body: bytes) -> Headers:
        timestamp = str(int(self._wall()))
        return Headers(
            {
                "Content-Type": ["application/json"],
                "User-Agent": ["switchboard"],
                "Switchboard-Delivery": [message.delivery],
                "Switchboard-Timestamp": [timestamp],
                "Switchboard-Signature": [signature(rule.secret, timestamp, body)],
            }
        )

    async def _send(self, place: WebhookTarget, user: int, headers: Headers, body: bytes) -> int:
        """The status of the answer."""
        found = await self._resolve(place.host, place.port, user)
        good = self._fence.passed(found)
        if not good:
            raise unreachable(place.host, SPECIAL_NAMES)
        for address in good[:ADDRESSES]:
            endpoint = self._endpoint(place, address)
            agent = Agent.usingEndpointFactory(self._reactor, _Straight(endpoint))
            try:
                answer = await agent.request(
                    b"POST", place.url.encode("ascii"), headers, FileBodyProducer(io.BytesIO(body))
                )
            except ConnectError:
                continue
            except Exception as error:  # what a peer does makes the client fail in many ways
                raise _broken(place, error) from None
            finally:
                # Also after an answer: what it says beside its status is not read.
                endpoint.cut()
            return int(answer.code)
        raise Undelivered(f"nobody answers at {place.host}, port {place.port}", again=True)

    def _endpoint(self, place: WebhookTarget, address: str) -> _Frugal:
        kind: Any = TCP6ClientEndpoint if ":" in address else TCP4ClientEndpoint
        endpoint = kind(self._reactor, address, place.port, timeout=CONNECT_SECONDS)
        if place.tls:
            trust = platformTrust() if self._trust is None else self._trust
            endpoint = wrapClientTLS(optionsForClientTLS(place.host, trustRoot=trust), endpoint)
        return _Frugal(endpoint)


def _broken(place: WebhookTarget, error: Exception) -> Exception:
    """Why there is no answer, in words; or that nobody waits for it any more."""
    causes = [error, *(reason.value for reason in getattr(error, "reasons", ()))]
    if any(isinstance(each, (CancelledError, ConnectingCancelledError)) for each in causes):
        return CancelledError()
    words = "hung up before it answered"
    if any(isinstance(each, (TlsError, VerificationError)) for each in causes):
        words = "has no certificate for this name that the relay trusts, or speaks no TLS"
    return Undelivered(f"{place.host} {words}", again=True)


@implementer(IAgentEndpointFactory)
class _Straight:
    """To the address that was judged, whatever the URL says."""

    def __init__(self, endpoint: Any) -> None:
        self._endpoint = endpoint

    def endpointForURI(self, uri: Any) -> Any:
        return self._endpoint


class _Counted(ProtocolWrapper):
    """A connection that is cut when too much comes."""

    _left = ANSWER_BYTES

    def dataReceived(self, data: bytes) -> None:
        self._left -= len(data)
        if self._left < 0:
            self.abortConnection()
        else:
            inner: Any = self.wrappedProtocol
            inner.dataReceived(data)


@implementer(IStreamClientEndpoint)
class _Frugal:
    """An endpoint for one connection that takes little, and can be cut."""

    def __init__(self, inner: Any) -> None:
        self._inner = inner
        self._connection: Any = None

    def connect(self, factory: Any) -> Any:
        wrapping = WrappingFactory(factory)
        wrapping.protocol = _Counted
        wrapping.noisy = factory.noisy = False
        return self._inner.connect(wrapping).addCallback(self._connected)

    def _connected(self, wrapped: Any) -> Any:
        self._connection = wrapped
        return wrapped.wrappedProtocol

    def cut(self) -> None:
        """End the connection at once, if there is one."""
        if self._connection is not None:
            self._connection.abortConnection()
