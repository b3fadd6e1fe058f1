"""The connection to the MQTT broker: paho's client in a thread, bounded queues, reconnecting.

Each attempt has a client of its own, so that no command of an earlier connection is sent later.
"""

from __future__ import annotations

import socket
import ssl
import struct
import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Any, NamedTuple, Protocol

import paho.mqtt.client as paho
from paho.mqtt.enums import CallbackAPIVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from twisted.logger import Logger

from relay_protocol.errors import Unavailable
from robot_client.link.backoff import Backoff
from robot_client.platforms.mqtt.settings import MqttSettings

MAX_PACKET = 512 * 1024
"""Bytes of a message from the broker. With MQTT 5 the broker does not send larger ones."""

MAX_WAITING = 50_000
"""Messages that wait for the reactor; then the oldest is dropped."""

MAX_WAITING_BYTES = 32 * 1024 * 1024
MAX_UNSENT = 1000
"""Commands that the broker has not confirmed yet."""

COMMAND_EXPIRY = 10
"""Seconds after which the broker drops a command for a device that is not connected (MQTT 5)."""

CONFIRM_SECONDS = 2.0
"""Seconds in which the broker must have read a command; then the connection is cut, so that no command of it comes
through later."""

PROBE = "switchboard/none"
"""A topic without subscription: a request to unsubscribe it is answered once all commands before have been read."""

KEEPALIVE = 20
CONNECT_SECONDS = 10.0
TOPICS_PER_REQUEST = 100


class MqttMessage(NamedTuple):
    """A message from the broker."""

    topic: str
    payload: bytes


class BrokerListener(Protocol):
    """Receives what happens at the broker, on the reactor's thread."""

    def on_connected(self) -> None:
        """The broker accepted the connection; nothing is subscribed yet."""

    def on_lost(self, reason: str) -> None:
        """The connection was lost, or could not be made."""

    def on_refused(self, what: str) -> None:
        """The broker refuses a command or a subscription, which its rules do not allow."""

    def on_waiting(self) -> None:
        """Messages wait in :meth:`BrokerPort.take`."""


class BrokerPort(Protocol):
    """The broker as the platform uses it. All on the reactor's thread."""

    listener: BrokerListener

    @property
    def dropped(self) -> int:
        """Messages that were dropped because they came too fast."""

    def start(self) -> None:
        """Connect, and connect again whenever the connection is lost."""

    def stop(self) -> None:
        """Disconnect."""

    def take(self) -> MqttMessage | None:
        """The next message; ``None``: there is none."""

    def subscribe(self, topics: Iterable[str]) -> None:
        """Subscribe; retained messages come again also for topics that are subscribed already."""

    def unsubscribe(self, topics: Iterable[str]) -> None:
        """End subscriptions."""

    def publish(
        self, topic: str, payload: str, qos: int = 0, retain: bool = False, *, stops: bool = False
    ) -> None:
        """Publish a message.

        :param stops: whether it stops something; then it is sent however much waits
        :raises Unavailable: there is no connection, or too much waits for it
        """


class Inbox:
    """Messages between paho's thread and the reactor.

    Discovery messages are never dropped for states: of those the newest of each topic is kept.

    :param is_config: whether a topic is one of discovery
    """

    def __init__(self, is_config: Callable[[str], bool]) -> None:
        self.dropped = 0
        self._is_config = is_config
        self._lock = threading.Lock()
        self._configs: OrderedDict[str, bytes] = OrderedDict()
        self._config_bytes = 0
        self._states: deque[MqttMessage] = deque()
        self._state_bytes = 0

    def put(self, topic: str, payload: bytes) -> None:
        """Add a message; payloads over :data:`MAX_PACKET` are cut, and refused by their size later."""
        payload = payload[: MAX_PACKET + 1]
        with self._lock:
            if self._is_config(topic):
                self._put_config(topic, payload)
            else:
                self._states.append(MqttMessage(topic, payload))
                self._state_bytes += len(payload)
                while len(self._states) > MAX_WAITING or self._state_bytes > MAX_WAITING_BYTES:
                    self._state_bytes -= len(self._states.popleft().payload)
                    self.dropped += 1

    def _put_config(self, topic: str, payload: bytes) -> None:
        before = len(self._configs.get(topic, b""))
        full = len(self._configs) >= MAX_WAITING and topic not in self._configs
        if full or self._config_bytes - before + len(payload) > MAX_WAITING_BYTES:
            self.dropped += 1
            return
        self._configs[topic] = payload
        self._config_bytes += len(payload) - before

    def take(self) -> MqttMessage | None:
        """The next message, those of discovery first."""
        with self._lock:
            if self._configs:
                topic, payload = self._configs.popitem(last=False)
                self._config_bytes -= len(payload)
                return MqttMessage(topic, payload)
            if not self._states:
                return None
            message = self._states.popleft()
            self._state_bytes -= len(message.payload)
            return message

    def clear(self) -> None:
        """Forget everything."""
        with self._lock:
            self._configs.clear()
            self._states.clear()
            self._config_bytes = self._state_bytes = 0


class PahoBroker:
    """A broker by paho.

    :param password: ``None`` for none
    :param is_config: see :class:`Inbox`
    :param reactor: for timers, and for calls from the thread
    :param random: for the delays, in [0, 1)
    """

    listener: BrokerListener

    def __init__(
        self,
        settings: MqttSettings,
        password: str | None,
        is_config: Callable[[str], bool],
        reactor: Any,
        random: Callable[[], float],
    ) -> None:
        self._settings = settings
        self._password = password
        self._reactor = reactor
        self._inbox = Inbox(is_config)
        self._backoff = Backoff(random)
        self._attempt: _Attempt | None = None
        self._retry: Any = None
        self._connected_at: float | None = None
        self._scheduled = threading.Event()
        self._probe = 0
        """Number of the request that the broker answers once it has read the commands before it; 0: none."""
        self._probe_timer: Any = None
        self._unproven = False
        """Whether commands were sent after that request."""
        self._log = Logger("mqtt")

    @property
    def dropped(self) -> int:
        """Messages that were dropped because they came too fast."""
        return self._inbox.dropped

    def start(self) -> None:
        self._retry = None
        self._inbox.clear()
        self._attempt = attempt = _Attempt(self._settings, self._password, self)
        attempt.start()

    def stop(self) -> None:
        if self._retry is not None:
            self._retry.cancel()
            self._retry = None
        attempt, self._attempt = self._attempt, None
        self._end_probe()
        if attempt is not None:
            attempt.end()

    def take(self) -> MqttMessage | None:
        message = self._inbox.take()
        if message is None:
            self._scheduled.clear()
            # One may have come between both calls, and have found itself announced.
            message = self._inbox.take()
        return message

    def subscribe(self, topics: Iterable[str]) -> None:
        for some in _groups(topics):
            if self._attempt is not None and self._connected_at is not None:
                self._attempt.client.subscribe([(each, self._settings.qos) for each in some])

    def unsubscribe(self, topics: Iterable[str]) -> None:
        for some in _groups(topics):
            if self._attempt is not None and self._connected_at is not None:
                self._attempt.client.unsubscribe(some)

    def publish(
        self, topic: str, payload: str, qos: int = 0, retain: bool = False, *, stops: bool = False
    ) -> None:
        if self._attempt is None or self._connected_at is None:
            raise Unavailable("the gateway is not connected to the MQTT broker")
        self._attempt.publish(topic, payload, qos, retain, stops)
        if self._probe:
            self._unproven = True
        else:
            self._send_probe(self._attempt)

    def _send_probe(self, attempt: _Attempt) -> None:
        self._unproven = False
        self._probe = attempt.probe()
        if self._probe:
            self._probe_timer = self._reactor.callLater(CONFIRM_SECONDS, self._not_read, attempt)

    def read(self, attempt: _Attempt, number: int) -> None:
        """The broker has read what was sent before this request."""
        if attempt is not self._attempt or number != self._probe:
            return
        self._end_probe()
        if self._unproven:
            self._send_probe(attempt)

    def _end_probe(self) -> None:
        self._probe = 0
        timer, self._probe_timer = self._probe_timer, None
        if timer is not None and timer.active():
            timer.cancel()

    def _not_read(self, attempt: _Attempt) -> None:
        self._probe_timer = None
        if attempt is self._attempt:
            attempt.abort(f"the broker has not read a command within {CONFIRM_SECONDS:g} s")

    # --- from the thread -----------------------------------------------------------------------------------

    def received(self, attempt: _Attempt, topic: str, payload: bytes) -> None:
        """A message arrived; called in the attempt's thread."""
        if attempt is not self._attempt:
            return
        self._inbox.put(topic, payload)
        if not self._scheduled.is_set():
            self._scheduled.set()
            self.call(self._waiting)

    def call(self, function: Callable[..., None], *arguments: Any) -> None:
        """Call a function on the reactor's thread."""
        self._reactor.callFromThread(function, *arguments)

    # --- on the reactor's thread -----------------------------------------------------------------------------

    def _waiting(self) -> None:
        if self._attempt is not None:
            self.listener.on_waiting()

    def connected(self, attempt: _Attempt) -> None:
        """The broker accepted the connection."""
        if attempt is self._attempt:
            self._connected_at = self._reactor.seconds()
            self._log.info("connected to the MQTT broker at {address}", address=self._settings.broker)
            self.listener.on_connected()

    def refused(self, attempt: _Attempt, what: str) -> None:
        """The broker refused something."""
        if attempt is self._attempt:
            self.listener.on_refused(what)

    def lost(self, attempt: _Attempt, reason: str) -> None:
        """The connection ended, or could not be made; try again later."""
        if attempt is not self._attempt:
            return
        self._attempt = None
        self._end_probe()
        lasted = 0.0 if self._connected_at is None else self._reactor.seconds() - self._connected_at
        self._connected_at = None
        self._scheduled.clear()
        delay = self._backoff.after_loss(lasted)
        self._retry = self._reactor.callLater(delay, self.start)
        self.listener.on_lost(reason)


class _Attempt:
    """One connection with its client and its thread."""

    def __init__(self, settings: MqttSettings, password: str | None, owner: PahoBroker) -> None:
        self._settings = settings
        self._owner = owner
        self._reason = "the connection was closed"
        self._unsent = 0
        self._unsent_lock = threading.Lock()
        self._ended = False
        self._version_5 = settings.protocol == "5"
        self.client = client = paho.Client(
            CallbackAPIVersion.VERSION2,
            client_id=settings.client_id,
            protocol=paho.MQTTv5 if self._version_5 else paho.MQTTv311,
            clean_session=None if self._version_5 else True,
            reconnect_on_failure=False,
        )
        client.connect_timeout = CONNECT_SECONDS
        if settings.user:
            client.username_pw_set(settings.user, password)
        client.on_connect = self._on_connect
        client.on_disconnect = self._on_disconnect
        client.on_message = self._on_message
        client.on_publish = self._on_publish
        client.on_subscribe = self._on_subscribe
        client.on_unsubscribe = self._on_unsubscribe

    def start(self) -> None:
        """Connect, in a thread."""
        threading.Thread(target=self._run, name="mqtt", daemon=True).start()

    def end(self) -> None:
        """Disconnect; the thread ends by itself."""
        self._ended = True
        self.client.disconnect()

    def abort(self, reason: str) -> None:
        """Cut the connection: what the network has not taken yet is dropped."""
        self._reason = reason
        connection: Any = self.client.socket()
        if connection is not None:
            with suppress(OSError):
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                connection.shutdown(socket.SHUT_RDWR)

    def probe(self) -> int:
        """Send a request that the broker answers after it has read all commands; its number, or 0."""
        result, number = self.client.unsubscribe(PROBE)
        return number if result == paho.MQTT_ERR_SUCCESS and number is not None else 0

    def publish(self, topic: str, payload: str, qos: int, retain: bool, stops: bool) -> None:
        """See :meth:`BrokerPort.publish`."""
        with self._unsent_lock:
            if self._unsent >= MAX_UNSENT and not stops:
                raise Unavailable(f"{MAX_UNSENT} commands wait for the MQTT broker; try again later")
            self._unsent += 1
        properties = None
        if self._version_5 and not retain:
            properties = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
            properties.MessageExpiryInterval = COMMAND_EXPIRY
        info = self.client.publish(topic, payload, qos, retain, properties)
        if info.rc != paho.MQTT_ERR_SUCCESS:
            self._confirmed()
            raise Unavailable("the MQTT broker takes no messages now")

    def _confirmed(self) -> None:
        with self._unsent_lock:
            self._unsent = max(0, self._unsent - 1)

    def _run(self) -> None:
        try:
            self._connect()
            if not self._ended:
                self.client.loop_forever()
        except (OSError, ssl.SSLError, ValueError) as error:
            self._reason = _words(error)
        self._owner.call(self._owner.lost, self, self._reason)

    def _connect(self) -> None:
        settings = self._settings
        if settings.tls:
            context = ssl.create_default_context(cafile=settings.ca or None)
            context.minimum_version = ssl.TLSVersion.TLSv1_2
            if settings.certificate:
                context.load_cert_chain(settings.certificate, settings.key or None)
            self.client.tls_set_context(context)
        properties = None
        if self._version_5:
            properties = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
            properties.MaximumPacketSize = MAX_PACKET
        self.client.connect(settings.host, settings.port, KEEPALIVE, properties=properties)

    def _on_connect(self, client: Any, _data: Any, _flags: Any, code: Any, _properties: Any) -> None:
        if code.is_failure:
            self._reason = f"the broker refused the connection: {code}"
            client.disconnect()
        else:
            self._owner.call(self._owner.connected, self)

    def _on_disconnect(self, _client: Any, _data: Any, _flags: Any, code: Any, _properties: Any) -> None:
        if code.is_failure and not self._reason.startswith(("the broker refused", "the broker has not")):
            self._reason = f"the connection was lost: {code}"

    def _on_message(self, _client: Any, _data: Any, message: Any) -> None:
        try:
            topic = message.topic
        except UnicodeDecodeError:
            return
        self._owner.received(self, topic, bytes(message.payload))

    def _on_unsubscribe(self, _client: Any, _data: Any, number: int, *_: Any) -> None:
        self._owner.call(self._owner.read, self, number)

    def _on_publish(self, _client: Any, _data: Any, _id: int, code: Any, _properties: Any) -> None:
        self._confirmed()
        if code.is_failure:
            self._owner.call(self._owner.refused, self, f"the broker refuses a command: {code}")

    def _on_subscribe(self, _client: Any, _data: Any, _id: int, codes: Any, _properties: Any) -> None:
        refused = [each for each in codes if each.is_failure]
        if refused:
            words = f"the broker refuses {len(refused)} of {len(codes)} subscriptions: {refused[0]}"
            self._owner.call(self._owner.refused, self, words)


def _words(error: Exception) -> str:
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"the broker's certificate is not accepted: {error.verify_message}"
    if isinstance(error, socket.gaierror):
        return "the broker's name can't be resolved"
    if isinstance(error, TimeoutError):
        return f"the broker did not answer within {CONNECT_SECONDS:g} s"
    return f"the broker can't be reached: {getattr(error, 'strerror', None) or error}"


def _groups(topics: Iterable[str]) -> list[list[str]]:
    every = list(topics)
    return [every[start : start + TOPICS_PER_REQUEST] for start in range(0, len(every), TOPICS_PER_REQUEST)]
