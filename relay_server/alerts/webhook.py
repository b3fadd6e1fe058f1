"""Sends messages to addresses that users chose, without giving access to the relay's own networks.

The name is resolved here, its addresses are judged, and the connection goes to exactly the address that was judged. No
redirect is followed, no proxy is used, and only the status of the answer counts.
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
from relay_server.alerts.egress import NOT_PERMITTED, EgressPolicy, unreachable
from relay_server.alerts.schemas import NotificationMessage, Undelivered

SEND_SECONDS = 10.0
CONNECT_SECONDS = 4.0
ANSWER_BYTES = 64 * KIB
"""Most bytes of an answer that are read, headers included."""

MAX_ADDRESSES = 3
"""Addresses of one name that are tried."""

RETRIED_STATUSES = frozenset({408, 425, 429})
"""Statuses below 500 after which a message is tried again (RFC 9110, RFC 8470, RFC 6585)."""

_PRINTABLE = re.compile(r"[\x21-\x7e]+\Z")
_HOST = re.compile(r"[A-Za-z0-9_]([A-Za-z0-9_.-]{0,251}[A-Za-z0-9_])?\.?\Z")

Resolve = Callable[[str, int, int], Awaitable[list[str]]]
"""Resolves a host and port for a user, see :meth:`NameResolver.addresses`."""


class WebhookTarget(NamedTuple):
    """A parsed address.

    :param target: path and query
    """

    tls: bool
    host: str
    port: int
    target: str

    @property
    def url(self) -> str:
        """The address in its one form, so that no other parser can read it differently."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{'https' if self.tls else 'http'}://{host}:{self.port}{self.target}"


def parse(url: str) -> WebhookTarget:
    """Parse the address of a webhook.

    :raises Invalid: it is not one
    """
    wrong = "a webhook's 'url' must be https://host/path, in ASCII, without a user, a password or a fragment"
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
            "no certificate can be valid for the host of this webhook's 'url'; use letters, digits and hyphens only"
        )
    query = f"?{parts.query}" if parts.query else ""
    return WebhookTarget(tls, host, port or (443 if tls else 80), (parts.path or "/") + query)


def _certifiable(host: str) -> bool:
    """Whether TLS accepts a host of this form (RFC 5890); the system resolves other names too."""
    try:
        optionsForClientTLS(host)
    except ValueError:  # also the base class of the idna package's error
        return False
    return True


def signature(secret: str, timestamp: str, body: bytes) -> str:
    """The value of ``Switchboard-Signature``: proves who sent the body, and when, to a receiver that has the secret."""
    signed = timestamp.encode() + b"." + body
    return "v1=" + hmac.new(secret.encode(), signed, hashlib.sha256).hexdigest()


class WebhookTransport:
    """Sends messages as HTTP requests.

    :param policy: decides which addresses may be reached
    :param wall: Unix time in seconds
    :param trust: root certificates; ``None`` for those of the system
    :ivar relay: the relay's name, for receivers
    """

    def __init__(
        self,
        reactor: Any,
        resolve: Resolve,
        policy: EgressPolicy,
        wall: Callable[[], float],
        trust: Any = None,
    ) -> None:
        self._reactor = reactor
        self._resolve = resolve
        self._policy = policy
        self.relay = ""
        self._wall = wall
        self._trust = trust

    def check(self, url: str) -> None:
        """Check an address of a webhook. The addresses of its host are judged at each message.

        :raises Invalid: it is not valid
        """
        parse(url)

    async def send(self, rule: AlertRuleRecord, message: NotificationMessage) -> None:
        """Deliver one message.

        :raises Undelivered: it was not accepted
        """
        try:
            target = parse(rule.url)
        except Invalid as error:
            raise Undelivered(str(error), again=False) from None
        body = jsontext.encode(message.webhook(self.relay, rule.id))
        sending = Deferred.fromCoroutine(
            self._send(target, rule.user_id, self._headers(rule, message, body), body)
        )
        try:
            status = await sending.addTimeout(SEND_SECONDS, self._reactor)
        except DeferTimeout:
            raise Undelivered(f"{target.host} did not answer within {SEND_SECONDS:g} s", again=True) from None
        if not 200 <= status < 300:
            again = status >= 500 or status in RETRIED_STATUSES
            raise Undelivered(f"{target.host} answered with the status {status}", again=again)

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

    async def _send(self, target: WebhookTarget, user: int, headers: Headers, body: bytes) -> int:
        """Send a request; returns the status of the answer."""
        found = await self._resolve(target.host, target.port, user)
        permitted = self._policy.permitted(found)
        if not permitted:
            raise unreachable(target.host, NOT_PERMITTED)
        for address in permitted[:MAX_ADDRESSES]:
            endpoint = self._endpoint(target, address)
            agent = Agent.usingEndpointFactory(self._reactor, _FixedEndpoint(endpoint))
            try:
                answer = await agent.request(
                    b"POST", target.url.encode("ascii"), headers, FileBodyProducer(io.BytesIO(body))
                )
            except ConnectError:
                continue
            except Exception as error:  # a peer can make the client fail in many ways
                raise _no_answer(target, error) from None
            finally:
                # Also after an answer, since only its status is read.
                endpoint.cut()
            return int(answer.code)
        raise Undelivered(f"{target.host} does not accept connections on port {target.port}", again=True)

    def _endpoint(self, target: WebhookTarget, address: str) -> _LimitedEndpoint:
        kind: Any = TCP6ClientEndpoint if ":" in address else TCP4ClientEndpoint
        endpoint = kind(self._reactor, address, target.port, timeout=CONNECT_SECONDS)
        if target.tls:
            trust = platformTrust() if self._trust is None else self._trust
            endpoint = wrapClientTLS(optionsForClientTLS(target.host, trustRoot=trust), endpoint)
        return _LimitedEndpoint(endpoint)


def _no_answer(target: WebhookTarget, error: Exception) -> Exception:
    """The error for an answer that did not come; a cancelled request stays cancelled."""
    causes = [error, *(reason.value for reason in getattr(error, "reasons", ()))]
    if any(isinstance(each, (CancelledError, ConnectingCancelledError)) for each in causes):
        return CancelledError()
    words = "closed the connection before it answered"
    if any(isinstance(each, (TlsError, VerificationError)) for each in causes):
        words = "has no certificate for this name that the relay trusts, or does not speak TLS"
    return Undelivered(f"{target.host} {words}", again=True)


@implementer(IAgentEndpointFactory)
class _FixedEndpoint:
    """Connects to the address that was judged, whatever the URL says."""

    def __init__(self, endpoint: Any) -> None:
        self._endpoint = endpoint

    def endpointForURI(self, uri: Any) -> Any:
        return self._endpoint


class _LimitedConnection(ProtocolWrapper):
    """A connection that is closed when more than :data:`ANSWER_BYTES` arrive."""

    _left = ANSWER_BYTES

    def dataReceived(self, data: bytes) -> None:
        self._left -= len(data)
        if self._left < 0:
            self.abortConnection()
        else:
            inner: Any = self.wrappedProtocol
            inner.dataReceived(data)


@implementer(IStreamClientEndpoint)
class _LimitedEndpoint:
    """An endpoint for one connection, with a limit of received bytes."""

    def __init__(self, inner: Any) -> None:
        self._inner = inner
        self._connection: Any = None

    def connect(self, factory: Any) -> Any:
        wrapping = WrappingFactory(factory)
        wrapping.protocol = _LimitedConnection
        wrapping.noisy = factory.noisy = False
        return self._inner.connect(wrapping).addCallback(self._connected)

    def _connected(self, wrapped: Any) -> Any:
        self._connection = wrapped
        return wrapped.wrappedProtocol

    def cut(self) -> None:
        """End the connection at once, if there is one."""
        if self._connection is not None:
            self._connection.abortConnection()
