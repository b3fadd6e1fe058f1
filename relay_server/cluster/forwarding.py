"""Requests and websockets that one relay passes on to the robot's home, and what the home believes of them.

A forwarded request has the relays' common secret, the client's address and the client's principal in its header. The
first relay has authenticated the client; the home decides by its rights.
"""

from __future__ import annotations

import base64
import hmac
from collections.abc import Callable, Sequence
from io import BytesIO
from typing import Any, NamedTuple, TypeVar

import msgspec
from twisted.internet.address import IPv4Address, IPv6Address
from twisted.internet.defer import CancelledError, Deferred, DeferredList, TimeoutError
from twisted.internet.endpoints import HostnameEndpoint, wrapClientTLS
from twisted.internet.error import ConnectError, DNSLookupError
from twisted.internet.protocol import Factory, connectionDone
from twisted.internet.protocol import Protocol as TwistedProtocol
from twisted.internet.ssl import optionsForClientTLS
from twisted.python.failure import Failure
from twisted.web.client import (
    Agent,
    FileBodyProducer,
    HTTPConnectionPool,
    PartialDownloadError,
    RequestTransmissionFailed,
    ResponseDone,
    ResponseFailed,
    readBody,
)
from twisted.web.http import NOT_FOUND, OK, SWITCHING
from twisted.web.http_headers import Headers
from twisted.web.server import Request

from relay_protocol.errors import Refused, Unavailable
from relay_protocol.scopes import Scope
from relay_server.access import LOOKUP_SECONDS, NOT_LOOKED_UP, Access, Principal
from relay_server.cluster.homes import RobotHomes
from relay_server.cluster.relays import RelayInfo, check_compatible, lost, unreachable
from relay_server.cluster.shared_connection import UPGRADE, SharedConnection, SharedConnectionRequest
from relay_server.common import close_codes
from relay_server.common.clock import Clock, Timer, cancel, sleep
from relay_server.common.concurrency import detached, with_timeout
from relay_server.common.freshness_tokens import HEADER as FRESHNESS
from relay_server.common.socket_writer import FlushScheduler
from relay_server.common.tcp import NewsFlow, PushProducer
from relay_server.config import ClusterSettings
from relay_server.robots.registry import RobotRegistry

T = TypeVar("T")

CLUSTER_HEADER = "Switchboard-Cluster"
"""Header with the secret that all relays of the cluster have."""
CLIENT_HEADER = "Switchboard-Client"
"""Header with the address and the principal of the client, as base64 of JSON."""

CONNECT_SECONDS = 3.0
LIST_SECONDS = 5.0
"""Seconds in which another relay must have sent its part of a list."""
FORWARDED_SECONDS = 600.0
"""Additional time of a request that another relay answers, which has time limits of its own."""
WATCH_SECONDS = 5.0
"""Seconds between short requests to a relay whose answer is waited for, and in which it must answer them."""
STOP_WATCH_SECONDS = 0.5
"""The same while a stop waits, which is stored in the database if the relay is silent."""
ANYTHING = "/api/v1/cluster/alive"
"""A path that is answered without the database; any answer will do."""
SHARED = "/api/v1/cluster/streams"
"""A path for the requests for shared connections; what counts is the field ``Upgrade``."""
STALL_SECONDS = 30.0
"""Seconds without progress after which a client that takes no more of its answer is cut. While it takes nothing, the
end of the home's connection is not seen."""
IDLE_CONNECTIONS = 16
"""Most idle connections that are kept to another relay."""

_OF_CONNECTION = frozenset(
    {b"connection", b"keep-alive", b"te", b"trailer", b"transfer-encoding", b"upgrade", b"proxy-connection"}
)
"""Fields that concern one connection (RFC 9110 section 7.6.1)."""

_CREDENTIALS = frozenset(
    {b"authorization", b"cookie", CLUSTER_HEADER.lower().encode(), CLIENT_HEADER.lower().encode()}
)
"""Fields that the home does not get: it gets the principal."""

_CREDENTIAL_PARAMETERS = frozenset({"ticket", "token"})
"""Parameters that the home does not get."""

_NEWEST_COUNTS = frozenset({b"multipart/x-mixed-replace", b"text/event-stream"})
"""Types of streams."""

_OF_FIRST_RELAY = _OF_CONNECTION | {b"cross-origin-resource-policy"}
"""Fields of the home's answer that the client does not get: whether it used a ticket is known to the first relay."""


class ForwardedClient(msgspec.Struct, frozen=True):
    """The client of a forwarded request. The fields between ``early`` and ``final`` are those of :class:`Principal`.

    :param address: its network address
    :param early: whether it may have sent messages before the home knew it; they are older than the home knows
    :param scope: as text; ``None`` for all rights of the user
    :param final: whether the relay answers by what it has itself, and asks no other relay
    :param older_ns: nanoseconds by which the request is older than its freshness token
    """

    address: str
    early: bool
    user_id: int
    name: str
    realm: str
    admin: bool
    token_id: int
    expires: float | None
    scope: str | None
    robot_id: int | None
    final: bool = False
    older_ns: int = 0

    @classmethod
    def of(
        cls, principal: Principal, address: str, *, early: bool = False, final: bool = False
    ) -> ForwardedClient:
        fields = {**vars(principal), "scope": None if principal.scope is None else str(principal.scope)}
        return cls(address=address, early=early, final=final, **fields)

    @classmethod
    def parse(cls, text: str) -> ForwardedClient:
        """:raises Refused: it is not what :meth:`__str__` makes"""
        try:
            return msgspec.json.decode(base64.b64decode(text, validate=True), type=cls)
        except ValueError:
            raise Refused(
                f"'{CLIENT_HEADER}' can't be read; all relays of a cluster run the same version"
            ) from None

    def __str__(self) -> str:
        return base64.b64encode(msgspec.json.encode(self)).decode()

    @property
    def principal(self) -> Principal:
        """The client's principal."""
        fields = msgspec.structs.asdict(self)
        del fields["address"], fields["early"], fields["final"], fields["older_ns"]
        return Principal(**{**fields, "scope": None if self.scope is None else Scope(self.scope)})


def check_secret(given: str | None, secret: str) -> None:
    """:raises Refused: it is not the secret of the cluster"""
    if given is None or not hmac.compare_digest(given.encode(), secret.encode()):
        raise Refused(
            "this port is for the other relays of the cluster; their secret did not come with the request"
        )


def without_credentials(target: str) -> str:
    """The path and query of a request without the credentials in it."""
    path, _, query = target.partition("?")
    kept = [each for each in query.split("&") if each.partition("=")[0] not in _CREDENTIAL_PARAMETERS]
    query = "&".join(kept)
    return f"{path}?{query}" if query else path


class RelayAnswer(NamedTuple):
    """The answer of another relay.

    :param freshness: a freshness token, or empty
    """

    status: int
    body: bytes
    freshness: str


class Forwarder:
    """Passes requests and connections on to other relays.

    :param reactor: Twisted's
    """

    def __init__(self, reactor: Any, settings: ClusterSettings) -> None:
        self.websockets: set[Any] = set()
        """Open websockets of clients; see :class:`relay_server.cluster.websockets.ForwardedWebSocket`."""
        self._reactor = reactor
        self._settings = settings
        self._pool = HTTPConnectionPool(reactor)
        self._pool.maxPersistentPerHost = IDLE_CONNECTIONS
        self._agent = Agent.usingEndpointFactory(reactor, self, self._pool)
        self._flushes = FlushScheduler(reactor)
        self._shared: dict[str, SharedConnection] = {}
        """Open shared connections by the id of the other relay."""
        self._closed = False
        self._connecting: dict[str, list[Deferred[SharedConnection]]] = {}
        """Those that wait for one, by the id of the other relay."""

    def leave(self, reason: str) -> None:
        """Close the websockets of all clients.

        :param reason: in words
        """
        for each in list(self.websockets):
            each.close(close_codes.GOING_AWAY, reason)

    def robot_moved(self, robot_id: int, relay: str) -> None:
        """Close the websockets that are forwarded to the relay which a robot was connected to before.

        :param relay: id of the one that it has connected to
        """
        for each in list(self.websockets):
            if each.robot_id == robot_id and each.relay_id != relay:
                each.close(close_codes.UNAVAILABLE, "the robot has connected to another relay; connect again")

    async def close(self) -> None:
        """Close idle connections, and the shared ones."""
        self._closed = True
        shared, self._shared = self._shared, {}
        for each in shared.values():
            each.close()
        await self._pool.closeCachedConnections()

    async def open_stream(self, relay: RelayInfo, protocol: Any) -> None:
        """Open a stream of bytes to another relay's listener, on the connection that all of them share.

        :raises Unavailable: it can't be reached, or does not accept
        """
        shared = self._shared.get(relay.id)
        if shared is None:
            shared = await self._share(relay)
        shared.open(protocol)

    def _share(self, relay: RelayInfo) -> Deferred[SharedConnection]:
        """A new shared connection to a relay; callers that come meanwhile get the same one."""
        waiting: Deferred[SharedConnection] = Deferred()
        callers = self._connecting.setdefault(relay.id, [])
        callers.append(waiting)
        if len(callers) == 1:
            detached(self._connect(relay)).addBoth(self._connected, relay)
        return waiting

    async def _connect(self, relay: RelayInfo) -> SharedConnection:
        answered: Deferred[int] = Deferred()

        def done(status: int) -> None:
            if not answered.called:
                answered.callback(status)

        shared = SharedConnection(self._reactor, self._flushes)
        fields = {
            "Host": relay.address,
            "Connection": "Upgrade",
            "Upgrade": UPGRADE,
            CLUSTER_HEADER: self._settings.secret,
        }
        lines = [f"GET {SHARED} HTTP/1.1", *(f"{name}: {value}" for name, value in fields.items()), "", ""]
        request = SharedConnectionRequest(shared, "\r\n".join(lines).encode(), done)
        endpoint = self.endpoint(relay.host, relay.port)
        try:
            await endpoint.connect(Factory.forProtocol(lambda: request))
        except Exception:
            raise unreachable(relay) from None
        late = f"the relay that the robot is connected to did not answer in time ({relay.address})"
        try:
            status = await with_timeout(self._reactor, CONNECT_SECONDS, answered, late)
        except Unavailable:
            request.transport.abortConnection()
            raise
        if not status:
            raise unreachable(relay)
        if status != SWITCHING:
            raise Unavailable(
                f"the relay that the robot is connected to answered {status} to a request for a shared "
                f"connection ({relay.address})"
            )
        return shared

    def _connected(self, result: SharedConnection | Failure, relay: RelayInfo) -> None:
        if isinstance(result, SharedConnection):
            if self._closed:
                result.close()
            else:
                self._shared[relay.id] = result
            result.on_lost = lambda: self._shared.pop(relay.id, None)
        for each in self._connecting.pop(relay.id):
            if not each.called:
                each.callback(result)

    def endpoint(self, host: str, port: int) -> Any:
        """The client endpoint of another relay."""
        endpoint: Any = HostnameEndpoint(self._reactor, host.encode(), port, timeout=CONNECT_SECONDS)
        return wrapClientTLS(optionsForClientTLS(host), endpoint) if self._settings.tls else endpoint

    def endpointForURI(self, uri: Any) -> Any:
        """See ``IAgentEndpointFactory``."""
        return self.endpoint(uri.host.decode().strip("[]"), uri.port)

    def headers(self, client: ForwardedClient) -> dict[str, str]:
        """The header fields that a forwarded request has beside its own."""
        return {CLUSTER_HEADER: self._settings.secret, CLIENT_HEADER: str(client)}

    async def ask(
        self, method: str, path: str, body: bytes, relay: RelayInfo, client: ForwardedClient
    ) -> tuple[int, bytes]:
        """Send a request of this relay's own to another one, for a client; returns the status and body of the answer.

        :param body: JSON, or empty
        :raises Unavailable: the other relay can't be reached, or is of another version
        """
        answer = await self._ask(method, path, body, relay, client, readBody)
        return answer.status, answer.body

    async def ask_lines(
        self,
        path: str,
        body: bytes,
        relay: RelayInfo,
        client: ForwardedClient,
        token: str,
        on_line: Callable[[bytes], None],
        watch_seconds: float = WATCH_SECONDS,
    ) -> RelayAnswer:
        """As :meth:`ask`, of a POST whose answer is lines; their body is not returned.

        :param token: a freshness token of the other relay, or empty
        :param on_line: gets each line as soon as it has come
        :param watch_seconds: as :data:`WATCH_SECONDS`
        """

        def read(response: Any) -> Deferred[bytes]:
            return _AnswerLines(on_line).read(response) if response.code == OK else readBody(response)

        return await self._ask("POST", path, body, relay, client, read, token, watch_seconds)

    async def _ask(
        self,
        method: str,
        path: str,
        body: bytes,
        relay: RelayInfo,
        client: ForwardedClient,
        read: Callable[[Any], Deferred[bytes]],
        token: str = "",
        watch_seconds: float = WATCH_SECONDS,
    ) -> RelayAnswer:
        check_compatible(relay)
        fields = Headers({"Content-Type": ["application/json"]})
        for name, value in self.headers(client).items():
            fields.setRawHeaders(name, [value])
        if token:
            fields.setRawHeaders(FRESHNESS, [token])
        url = f"http://{relay.address}{path}".encode()
        try:
            producer = FileBodyProducer(BytesIO(body)) if body else None
            sending = self._agent.request(method.encode(), url, fields, producer)
            response = await self._while_it_answers(relay, sending, watch_seconds)
            made = response.headers.getRawHeaders(FRESHNESS, [""])[0]
            text = await self._while_it_answers(relay, read(response), watch_seconds)
            return RelayAnswer(response.code, text, made)
        except (ConnectError, DNSLookupError, TimeoutError):
            raise unreachable(relay) from None
        except (RequestTransmissionFailed, ResponseFailed, PartialDownloadError):
            raise lost(relay) from None

    async def _while_it_answers(self, relay: RelayInfo, waiting: Deferred[T], watch_seconds: float) -> T:
        """Wait for another relay, whose time limits are not known here, for as long as it answers anything at all.

        :param watch_seconds: as :data:`WATCH_SECONDS`
        :raises Unavailable: it stands still
        """
        silent = False
        watching: Deferred[None] = Deferred.fromCoroutine(self._watch(relay, watch_seconds))

        def end(_: Any) -> None:
            nonlocal silent
            silent = True
            waiting.cancel()

        watching.addCallbacks(end, lambda failure: failure.trap(CancelledError))
        try:
            return await waiting
        except Exception:
            # Also of a connection that was not established yet, which has an error of its own when it is cancelled.
            if silent:
                raise lost(relay) from None
            raise
        finally:
            watching.cancel()

    async def _watch(self, relay: RelayInfo, seconds: float) -> None:
        """Return when a relay does not answer a short request in time."""
        answers = True
        while answers:
            await sleep(self._reactor, seconds)
            answers = await self.answers(relay, seconds)

    async def answers(self, relay: RelayInfo, seconds: float = WATCH_SECONDS) -> bool:
        """Whether a relay answers a short request in time."""
        fields = Headers({CLUSTER_HEADER: [self._settings.secret]})
        asking = self._agent.request(b"GET", f"http://{relay.address}{ANYTHING}".encode(), fields)
        asking.addTimeout(seconds, self._reactor)
        try:
            await readBody(await asking)
        except CancelledError:
            raise
        except Exception:
            return False
        return True

    async def ask_all(
        self, method: str, path: str, body: bytes, relays: Sequence[RelayInfo], client: ForwardedClient
    ) -> list[bytes]:
        """As :meth:`ask`, of several relays; returns the bodies of their answers.

        A relay that refuses, or does not answer in time, is left out.
        """
        asked = [
            Deferred.fromCoroutine(
                with_timeout(
                    self._reactor,
                    LIST_SECONDS,
                    self.ask(method, path, body, relay, client),
                    "the other relay does not answer",
                )
            )
            for relay in relays
        ]
        answers = await DeferredList(asked, consumeErrors=True)
        return [answer[1] for success, answer in answers if success and answer[0] == OK]

    async def forward(
        self,
        request: Request,
        body: bytes,
        relay: RelayInfo,
        client: ForwardedClient,
        seconds: float | None = None,
        *,
        found_only: bool = False,
        watch_seconds: float = WATCH_SECONDS,
    ) -> bool:
        """Pass a request on, and its answer back as it comes.

        :param body: of the request
        :param seconds: in which the head of the answer must come; ``None``: the request has its own limit
        :param found_only: do not pass the answer back if it is 404
        :param watch_seconds: as :data:`WATCH_SECONDS`
        :returns: whether the answer was passed back
        :raises Unavailable: the other relay can't be reached, is of another version, or does not answer in time
        """
        check_compatible(relay)
        fields = Headers()
        for name, values in request.requestHeaders.getAllRawHeaders():
            if name.lower() not in _OF_CONNECTION | _CREDENTIALS | {b"content-length", b"expect"}:
                fields.setRawHeaders(name, values)
        for name, value in self.headers(client).items():
            fields.setRawHeaders(name, [value])
        producer = FileBodyProducer(BytesIO(body)) if body else None
        url = f"http://{relay.address}{without_credentials(request.uri.decode('latin-1'))}".encode("latin-1")
        sending = self._agent.request(request.method, url, fields, producer)
        if seconds is not None:
            sending.addTimeout(seconds, self._reactor)
        try:
            response = await self._while_it_answers(relay, sending, watch_seconds)
        except (ConnectError, DNSLookupError, TimeoutError):
            raise unreachable(relay) from None
        except (RequestTransmissionFailed, ResponseFailed):
            raise lost(relay) from None
        if found_only and response.code == NOT_FOUND:
            await readBody(response)
            return False
        if request._disconnected:
            return True
        request.setResponseCode(response.code, response.phrase)
        for name, values in response.headers.getAllRawHeaders():
            if name.lower() == b"vary":
                # This relay has a line of its own.
                for value in values:
                    request.responseHeaders.addRawHeader(name, value)
            elif name.lower() not in _OF_FIRST_RELAY:
                request.responseHeaders.setRawHeaders(name, values)
        if request.method != b"HEAD":
            await _AnswerPipe(request, self._reactor).run(response)
        return True


class RequestForwarding:
    """Finds the requests whose robot is at another relay, and forwards them.

    :param access: finds the robot that a principal means by a name
    :param others: all other relays of the cluster
    """

    def __init__(
        self,
        clock: Clock,
        access: Access,
        robots: RobotRegistry,
        homes: RobotHomes,
        forwarder: Forwarder,
        others: Callable[[], Sequence[RelayInfo]],
    ) -> None:
        self.homes = homes
        self._others = others
        self.forwarder = forwarder
        self._clock = clock
        self._access = access
        self._robots = robots

    async def relay_of(self, principal: Principal, robot: str, *, from_memory: bool) -> RelayInfo | None:
        """The other relay that a robot is at; ``None``: it is here or nowhere, or the principal has no right on it.

        :param from_memory: whether the database is asked only if memory does not show the right, and not for long
        :raises SwitchboardError: the credentials have ended, or the database does not answer
        """
        if not from_memory:
            return await self._look_up(principal, robot)
        for known in self._robots:
            if known.name == robot and self._access.may_stop_at_once(principal, known):
                return self.homes.elsewhere(known.robot_id)
        return await with_timeout(self._clock, LOOKUP_SECONDS, self._look_up(principal, robot), NOT_LOOKED_UP)

    async def _look_up(self, principal: Principal, robot: str) -> RelayInfo | None:
        found = await self._access.permit_by_name(principal, robot)
        if found is None:
            return None
        record, permit = found
        self._access.release(permit)
        return self.homes.elsewhere(record.id)

    def find(self, relay: str) -> RelayInfo | None:
        """Another relay of the cluster by its id; ``None``: there is none, or it is this one."""
        return next((each for each in self._others() if each.id == relay), None)

    async def forward_to_others(
        self, request: Request, body: bytes, principal: Principal, address: str
    ) -> bool:
        """Have a request answered by the other relay that has what it names, such as a recording.

        :returns: false: no other relay has it
        :raises Unavailable: a relay that could have it can't be reached
        """
        client = ForwardedClient.of(principal, address, final=True)
        missing: Unavailable | None = None
        for relay in self._others():
            try:
                if await self.forwarder.forward(request, body, relay, client, found_only=True):
                    return True
            except Unavailable as error:
                if request.startedWriting:
                    raise
                missing = error
        if missing is not None:
            raise missing
        return False

    async def lists(self, path: str, principal: Principal, address: str) -> list[bytes]:
        """The parts of a list that the other relays have: JSON. A relay that does not answer is left out.

        :param path: and query, of a GET
        """
        client = ForwardedClient.of(principal, address, final=True)
        return await self.forwarder.ask_all("GET", path, b"", self._others(), client)


class _AnswerLines(TwistedProtocol):
    """Passes on the lines of an answer's body as they come."""

    transport: Any

    def __init__(self, on_line: Callable[[bytes], None]) -> None:
        self._on_line = on_line
        self._rest = b""
        self._done: Deferred[bytes] = Deferred(lambda _: self.transport.stopProducing())

    def read(self, response: Any) -> Deferred[bytes]:
        """Fires with nothing when the body is complete, and fails with what has cut it."""
        response.deliverBody(self)
        return self._done

    def dataReceived(self, data: bytes) -> None:
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            self._on_line(line)

    def connectionLost(self, reason: Failure = connectionDone) -> None:
        if self._done.called:
            return
        if reason.check(ResponseDone):
            self._done.callback(b"")
        else:
            self._done.errback(reason)


class _AnswerPipe(TwistedProtocol):
    """Writes the body of an answer to the request that it answers, as fast as its client reads.

    Of streams whose newest part counts little waits here, so that the home can drop what comes too late.
    """

    transport: Any

    def __init__(self, request: Request, clock: Any) -> None:
        self._request = request
        self._clock = clock
        self._flow: PushProducer = PushProducer(self)
        self._news: NewsFlow | None = None
        self._stalled: Timer | None = None
        self._done: Deferred[None] = Deferred(self._stop)

    async def run(self, response: Any) -> None:
        """Wait until the body is complete.

        :raises ConnectionError: it was cut
        """
        (kind,) = response.headers.getRawHeaders(b"content-type", [b""])[:1]
        if kind.partition(b";")[0] in _NEWEST_COUNTS:
            self._flow = self._news = NewsFlow(self, self._clock, self._request.transport)
        response.deliverBody(self)
        try:
            await self._done
        finally:
            cancel(self._stalled)
            if self._news is not None:
                self._news.end()

    def _stop(self, _: object) -> None:
        self.transport.stopProducing()

    def pause(self) -> None:
        """The client's transport is full."""
        cancel(self._stalled)
        self._stalled = self._clock.callLater(STALL_SECONDS, self._stall)
        self.transport.pauseProducing()

    def resume(self) -> None:
        """The client takes bytes again."""
        cancel(self._stalled)
        self.transport.resumeProducing()

    def _stall(self) -> None:
        if self._news is not None and self._news.made_progress():
            self._stalled = self._clock.callLater(STALL_SECONDS, self._stall)
        else:
            self._request.transport.abortConnection()

    def connectionMade(self) -> None:
        self._request.registerProducer(self._flow, True)

    def dataReceived(self, data: bytes) -> None:
        self._request.write(data)

    def connectionLost(self, reason: Failure = connectionDone) -> None:
        self._request.unregisterProducer()
        if self._done.called:
            return
        if reason.check(ResponseDone):
            self._done.callback(None)
        else:
            self._done.errback(Unavailable("the connection to the robot's relay was lost during the answer"))


def client_address(client: ForwardedClient) -> IPv4Address | IPv6Address:
    """The address of a client as Twisted has it."""
    kind = IPv6Address if ":" in client.address else IPv4Address
    return kind("TCP", client.address, 0)
