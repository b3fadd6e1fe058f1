"""The bus of a cluster over NATS: core messages and requests, and leases in a key-value bucket of JetStream.

The client of NATS runs on asyncio, so it has a thread and a loop of its own; calls and callbacks change threads here.
Needs servers of version 2.10 or newer: older ones take longer than a lease to notice that another server is frozen.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, TypeVar

from nats.aio.client import Client
from nats.aio.msg import Msg
from nats.aio.subscription import Subscription
from nats.errors import Error, NoRespondersError
from nats.js.errors import APIError, KeyNotFoundError, KeyWrongLastSequenceError, NotFoundError
from nats.js.kv import KeyValue
from nats.js.manager import JetStreamManager
from twisted.internet.defer import CancelledError, Deferred
from twisted.internet.task import LoopingCall
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_protocol.errors import SwitchboardError, Unavailable
from relay_server.cluster.bus import (
    LEASE_SECONDS,
    BusLease,
    LeaseUnavailable,
    OnState,
    Receive,
    RequestRefused,
    check_body,
    check_pattern,
    check_subject,
    no_responder,
    reply_of,
    timed_out,
)

T = TypeVar("T")

BUCKET = "switchboard_leases"
REPLICAS = 3
"""Servers that store each lease, where there are so many."""
PREFIX = "sb."
"""Begins all subjects, so that other users of the servers are not disturbed."""
REFUSED = "Switchboard-Refused"
"""Header of a reply that is an error; the body is its text."""

CONNECT_SECONDS = 2
START_SECONDS = 3.0
"""Seconds that :meth:`NatsBus.start` waits for the first connection."""
WRITE_SECONDS = 8.0
"""Seconds that a read or write of a lease may take; writes stop for about 6 s when a server is lost."""
RENEWALS = 4
"""Times that a lease is renewed during its duration."""
PENDING_BYTES = 1 << 20
"""Most bytes that wait in this process for a slow server."""


class NatsBus:
    """A :class:`~relay_server.cluster.bus.ClusterBus` over NATS.

    :param servers: addresses, ``nats://[user:password@]host:port`` or ``tls://…``
    :param replicas: servers that store each lease; ``None``: 3 if that many servers are known, else 1
    :param lease_seconds: until the lease of a dead relay ends
    """

    log = Logger()

    def __init__(
        self,
        reactor: Any,
        servers: Sequence[str],
        replicas: int | None = None,
        lease_seconds: float = LEASE_SECONDS,
    ) -> None:
        self.connected = False
        self._reactor = reactor
        self._servers = list(servers)
        self._replicas = replicas
        self._lease_seconds = lease_seconds
        self._listeners: list[OnState] = []
        self._subscriptions: list[_NatsSubscription] = []
        self._client = Client()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="nats", daemon=True)
        self._bucket: KeyValue | None = None
        self._stopped = False

    async def start(self) -> None:
        """See :meth:`ClusterBus.start`."""
        self._thread.start()
        connecting = self._deferred(self._connect())
        waiting: Deferred[None] = Deferred()
        connecting.addBoth(lambda result: None if waiting.called else waiting.callback(None))
        timer = self._reactor.callLater(START_SECONDS, waiting.callback, None)
        await waiting
        if timer.active():
            timer.cancel()
        if not self.connected:
            self.log.error("no server of the bus answers; it is tried again: {servers}", servers=self._shown)

    async def stop(self) -> None:
        """See :meth:`ClusterBus.stop`."""
        self._stopped = True
        try:
            await self._deferred(self._disconnect())
        finally:
            self._loop.call_soon_threadsafe(self._loop.stop)
        await _in_thread(self._reactor, self._thread.join)
        self._loop.close()

    def publish(self, subject: str, body: bytes) -> None:
        """See :meth:`ClusterBus.publish`."""
        check_subject(subject)
        check_body(body)
        if self.connected:
            self._background(self._client.publish(PREFIX + subject, body))

    def subscribe(self, pattern: str, receive: Receive, queue: str = "") -> Callable[[], None]:
        """See :meth:`ClusterBus.subscribe`."""
        check_pattern(pattern)
        subscription = _NatsSubscription(pattern, receive, queue)
        self._subscriptions.append(subscription)
        self._background(self._subscribe(subscription))

        def end() -> None:
            if subscription in self._subscriptions:
                self._subscriptions.remove(subscription)
                subscription.ended = True
                self._background(self._unsubscribe(subscription))

        return end

    async def request(self, subject: str, body: bytes, timeout: float) -> bytes:
        """See :meth:`ClusterBus.request`."""
        check_subject(subject)
        check_body(body)
        try:
            reply = await self._connected(self._client.request(PREFIX + subject, body, timeout=timeout))
        except NoRespondersError:
            raise no_responder(subject) from None
        except (Error, TimeoutError, asyncio.TimeoutError):
            raise Unavailable(timed_out(subject, timeout)) from None
        if reply.headers and REFUSED in reply.headers:
            raise RequestRefused(reply.data.decode("utf-8", "replace"))
        return bytes(reply.data)

    async def lease(self, key: str, value: bytes) -> BusLease:
        """See :meth:`ClusterBus.lease`."""
        check_subject(key)
        bucket = await self._leases_bucket()
        try:
            revision = await self._connected(bucket.create(key, value), WRITE_SECONDS)
        except KeyWrongLastSequenceError:
            raise LeaseUnavailable(f"another relay has the lease {key}") from None
        except (Error, TimeoutError, asyncio.TimeoutError) as error:
            raise _no_answer(error) from None
        return _NatsLease(self, bucket, key, value, revision, self._lease_seconds)

    async def leases(self, prefix: str) -> dict[str, bytes]:
        """See :meth:`ClusterBus.leases`."""
        check_subject(prefix)
        bucket = await self._leases_bucket()
        try:
            manager = self._client.jsm(timeout=WRITE_SECONDS)
            return await self._connected(_entries(manager, bucket, prefix), WRITE_SECONDS)
        except (Error, TimeoutError, asyncio.TimeoutError) as error:
            raise _no_answer(error) from None

    def on_state(self, listener: OnState) -> None:
        """See :meth:`ClusterBus.on_state`."""
        self._listeners.append(listener)

    # --- the reactor's thread -----------------------------------------------------------------------------

    @property
    def _shown(self) -> str:
        """The servers without passwords."""
        return ", ".join(each.rpartition("@")[2] for each in self._servers)

    def _changed(self, connected: bool) -> None:
        if connected == self.connected or (self._stopped and connected):
            return
        self.connected = connected
        if not self._stopped:
            words = "the bus is connected" if connected else "the bus is disconnected"
            self.log.info(words + ": {servers}", servers=self._shown)
        for listener in list(self._listeners):
            listener(connected)

    async def _connected(self, work: Coroutine[Any, Any, T], seconds: float | None = None) -> T:
        """Run work in the other thread.

        :param seconds: after which it is cancelled
        :raises Unavailable: the bus is disconnected
        :raises TimeoutError: the time is over
        """
        if not self.connected:
            work.close()
            raise Unavailable(f"the bus between the relays is disconnected ({self._shown})")
        return await self._deferred(work if seconds is None else asyncio.wait_for(work, seconds))

    async def _leases_bucket(self) -> KeyValue:
        if self._bucket is None:
            try:
                self._bucket = await self._connected(self._open_bucket())
            except (Error, TimeoutError, asyncio.TimeoutError) as error:
                raise _no_answer(error) from None
        return self._bucket

    def _deferred(self, work: Coroutine[Any, Any, T]) -> Deferred[T]:
        """Run work in the other thread; cancelling the result cancels it."""
        future = asyncio.run_coroutine_threadsafe(work, self._loop)

        def cancel(_: object) -> None:
            future.cancel()

        result: Deferred[T] = Deferred(cancel)

        def done() -> None:
            if result.called:
                return
            if future.cancelled():
                result.errback(CancelledError())
                return
            error = future.exception()
            if error is None:
                result.callback(future.result())
            else:
                result.errback(error)

        future.add_done_callback(lambda _: self._in_reactor(done))
        return result

    def _background(self, work: Coroutine[Any, Any, object]) -> None:
        self._deferred(work).addErrback(self._failed)

    def _failed(self, failure: Failure) -> None:
        if not failure.check(Error, CancelledError, TimeoutError):
            self.log.failure("the bus failed", failure)

    def _received(self, subscription: _NatsSubscription, message: Msg) -> None:
        if subscription.ended:
            if message.reply:
                self._refused(message, Failure(Unavailable("the receiver has ended its subscription")))
            return
        subject = message.subject.removeprefix(PREFIX)
        reply = Deferred.fromCoroutine(reply_of(subscription.receive, subject, message.data))
        if message.reply:
            reply.addCallbacks(
                lambda body: self._background(self._client.publish(message.reply, body)),
                lambda failure: self._refused(message, failure),
            )
        reply.addErrback(
            lambda failure: (
                self.log.failure("a message of the bus could not be handled", failure)
                if not failure.check(SwitchboardError)
                else None
            )
        )

    def _refused(self, message: Msg, failure: Failure) -> None:
        failure.trap(SwitchboardError)
        text = str(failure.value).encode()
        self._background(self._client.publish(message.reply, text, headers={REFUSED: "1"}))

    # --- the thread of NATS -------------------------------------------------------------------------------

    def _in_reactor(self, call: Callable[..., object], *arguments: object) -> None:
        self._reactor.callFromThread(call, *arguments)

    async def _connect(self) -> None:
        async def lost() -> None:
            self._in_reactor(self._changed, False)

        async def again() -> None:
            self._in_reactor(self._changed, True)

        async def failed(error: Exception) -> None:
            """Connections that fail are tried again; the change of state is reported."""

        await self._client.connect(
            self._servers,
            name="switchboard",
            disconnected_cb=lost,
            reconnected_cb=again,
            error_cb=failed,
            max_reconnect_attempts=-1,
            reconnect_time_wait=0.2,  # type: ignore[arg-type]  # asyncio.sleep takes it
            connect_timeout=CONNECT_SECONDS,
            ping_interval=2,
            max_outstanding_pings=2,
            pending_size=PENDING_BYTES,
        )
        await again()

    async def _disconnect(self) -> None:
        if self._client.is_connected:
            # A server that stands still takes nothing more.
            with suppress(Error, TimeoutError, asyncio.TimeoutError):
                await self._client.flush(1)
        for task in asyncio.all_tasks(self._loop):
            if task is not asyncio.current_task() and not self._client.is_connected:
                task.cancel()
        await self._client.close()

    async def _subscribe(self, subscription: _NatsSubscription) -> None:
        async def receive(message: Msg) -> None:
            self._in_reactor(self._received, subscription, message)

        if not subscription.ended:
            subscription.made = await self._client.subscribe(
                PREFIX + subscription.pattern, queue=subscription.queue, cb=receive
            )

    async def _unsubscribe(self, subscription: _NatsSubscription) -> None:
        if subscription.made is not None:
            await subscription.made.unsubscribe()

    async def _open_bucket(self) -> KeyValue:
        stream = self._client.jetstream(timeout=WRITE_SECONDS)
        # Also those that the first one has named: often only the name of the cluster is given.
        known = REPLICAS if len(self._client.servers) >= REPLICAS else 1
        wanted = self._replicas or known
        try:
            bucket = await stream.key_value(BUCKET)
        except NotFoundError:
            return await self._new_bucket(stream, wanted)
        await self._add_copies(stream, wanted)
        return bucket

    async def _new_bucket(self, stream: Any, replicas: int) -> KeyValue:
        settings = {"bucket": BUCKET, "ttl": self._lease_seconds, "max_value_size": 4096}
        try:
            bucket: KeyValue = await stream.create_key_value(replicas=replicas, **settings)
        except APIError as error:
            if replicas == 1 or self._replicas is not None:
                raise
            self.log.warn("leases are stored by one server of the bus: {reason}", reason=str(error))
            bucket = await stream.create_key_value(replicas=1, **settings)
        return bucket

    async def _add_copies(self, stream: Any, replicas: int) -> None:
        """Have more servers store the leases than when they were first stored."""
        config = (await stream.stream_info(f"KV_{BUCKET}")).config
        if (config.num_replicas or 1) >= replicas:
            return
        config.num_replicas = replicas
        try:
            await stream.update_stream(config)
        except APIError as error:
            self.log.warn("leases are stored by one server of the bus: {reason}", reason=str(error))


@dataclass
class _NatsSubscription:
    pattern: str
    receive: Receive
    queue: str
    made: Subscription | None = None
    ended: bool = False


class _NatsLease:
    """See :class:`BusLease`. The reactor's thread renews it, so a relay whose reactor hangs loses it."""

    log = Logger()

    def __init__(
        self, bus: NatsBus, bucket: KeyValue, key: str, value: bytes, revision: int, seconds: float
    ) -> None:
        self.on_lost: Callable[[], None] = lambda: None
        self._bus = bus
        self._bucket = bucket
        self._key = key
        self._value = value
        self._revision = revision
        self._seconds = seconds
        self._renewed = bus._reactor.seconds()
        self._loop = LoopingCall(self._renew)
        self._loop.clock = bus._reactor
        self._loop.start(seconds / RENEWALS, now=False)

    async def release(self) -> None:
        """See :meth:`BusLease.release`."""
        if self._loop.running:
            self._loop.stop()
            try:
                await self._bus._connected(self._bucket.delete(self._key, last=self._revision))
            except (Error, TimeoutError, asyncio.TimeoutError, SwitchboardError) as error:
                self.log.info("the lease {key} could not be released: {error!r}", key=self._key, error=error)

    def _renew(self) -> Deferred[None]:
        return Deferred.fromCoroutine(self._renew_once())

    async def _renew_once(self) -> None:
        now = self._bus._reactor.seconds()
        left = self._renewed + self._seconds - now
        if left <= 0:
            self._lost("it was not renewed in time")
            return
        try:
            await self._update(now, left)
        except KeyNotFoundError:
            self._lost("it has ended")
        except (Error, TimeoutError, asyncio.TimeoutError, Unavailable, CancelledError) as error:
            self.log.info("the lease {key} could not be renewed: {error!r}", key=self._key, error=error)

    async def _update(self, now: float, left: float) -> None:
        renewal = self._bucket.update(self._key, self._value, last=self._revision)
        try:
            self._revision = await self._bus._connected(renewal, left)
            self._renewed = now
        except KeyWrongLastSequenceError:
            # Another relay has it, or an earlier renewal was carried out but not confirmed.
            entry = await self._bus._connected(self._bucket.get(self._key), left)
            if entry.value != self._value or entry.revision is None:
                self._lost("another relay has it")
            else:
                self._revision = entry.revision

    def _lost(self, reason: str) -> None:
        if self._loop.running:
            self._loop.stop()
            self.log.error("the lease {key} is lost: {reason}", key=self._key, reason=reason)
            self.on_lost()


def _no_answer(error: BaseException) -> Unavailable:
    return Unavailable(f"the servers of the bus do not answer: {error!r}")


async def _entries(manager: JetStreamManager, bucket: KeyValue, prefix: str) -> dict[str, bytes]:
    """Values below a prefix. ``KeyValue.keys`` and ``watch`` would report none while entries are on their way."""
    begin = f"$KV.{BUCKET}."
    info = await manager.stream_info(f"KV_{BUCKET}", subjects_filter=f"{begin}{prefix}.>")
    found = {}
    for subject in info.state.subjects or ():
        key = subject.removeprefix(begin)
        try:
            found[key] = (await bucket.get(key)).value or b""
        except KeyNotFoundError:
            continue
    return found


def _in_thread(reactor: Any, call: Callable[[], object]) -> Awaitable[object]:
    """Run a blocking call in a thread of its own."""
    done: Deferred[object] = Deferred()
    threading.Thread(
        target=lambda: reactor.callFromThread(done.callback, call()), name="bus", daemon=True
    ).start()
    return done
