"""The MQTT platform: the devices of a broker as one robot.

Device ``lamp`` is the node ``/lamp``. Its states are latched topics below ``/lamp/``, its commands topics that end in
``/set``, and services. Everything runs on the reactor's thread; only :mod:`robot_client.platforms.mqtt.broker` has
another one.
"""

from __future__ import annotations

import re
import secrets
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from typing import Any

from twisted.internet.defer import Deferred, fail, succeed
from twisted.logger import Logger

from relay_protocol import link
from relay_protocol.errors import Invalid, NotFound, SwitchboardError, Unavailable
from relay_protocol.limits import NAME
from robot_client.alerts import MODULE, AlertCondition, OnAlert, ignore_alert
from robot_client.motion.typed_topic import TypedTopic
from robot_client.platforms.base import (
    AdvertisementHandle,
    Check,
    CommandEffect,
    Facts,
    GoalHandle,
    GraphView,
    OnCall,
    OnCancel,
    OnChange,
    OnDropped,
    OnGoal,
    OnLatched,
    OnSample,
    Platform,
)
from robot_client.platforms.definitions import normalise
from robot_client.platforms.mqtt import home_assistant, homie, messages
from robot_client.platforms.mqtt.broker import BrokerPort, MqttMessage
from robot_client.platforms.mqtt.devices import (
    GATEWAY,
    DeviceNames,
    DeviceRegistry,
    MqttDevice,
    ProblemList,
)
from robot_client.platforms.mqtt.live_device import LiveDevice, NamedElement
from robot_client.platforms.mqtt.messages import BOOL, TEXT, TRIGGER
from robot_client.platforms.mqtt.model import DeviceCall, StateCommand
from robot_client.platforms.mqtt.settings import MqttSettings
from robot_client.platforms.mqtt.templates import MissingValue

DEVICES_AT_ONCE = 50
"""Devices that are built in one turn."""

TURN_SECONDS = 0.01
"""Time for messages before other work of the reactor gets its turn."""

SETTLE_SECONDS = 0.2
"""Time in which the discovery messages of a device may still arrive, before it is built."""

STOP_DEVICES = "/stop_devices"
"""Service that stops all covers; called at a stop of the robot."""

CONNECTED = f"/{GATEWAY}/connected"
PROBLEMS = f"/{GATEWAY}/problems"
SET = "/set"

_NAME = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+\Z")


def is_config_topic(settings: MqttSettings) -> Callable[[str], bool]:
    """Whether a topic is one of discovery."""
    home, prefix = settings.discovery_prefix + "/", settings.homie + "/"

    def is_config(topic: str) -> bool:
        if settings.discovery_prefix and topic.startswith(home) and topic.endswith("/config"):
            return True
        return bool(settings.homie) and topic.startswith(prefix) and topic.rpartition("/")[2].startswith("$")

    return is_config


class MqttSubscription:
    """A subscription of a topic."""

    def __init__(
        self, platform: MqttPlatform, topic: str, type: str, on_sample: OnSample, on_change: OnChange
    ) -> None:
        self.topic = topic
        self.type = type
        self.on_dropped: OnDropped = lambda count: None
        self.unmatched: list[str] = []
        self.stamp = 0
        self.latched = True
        self.publishers = 0
        self.on_sample = on_sample
        self.on_change = on_change
        self._platform = platform
        self._on_end: Callable[[], None] | None = None

    @property
    def stamps_id(self) -> str:
        """Id of this run, as each value has a stamp of its own."""
        return self._platform.run

    def request_latched(self, on_latched: OnLatched, on_end: Callable[[], None]) -> None:
        self._on_end = on_end
        self._platform.later(self._send_latched, on_latched, on_end)

    def _send_latched(self, on_latched: OnLatched, on_end: Callable[[], None]) -> None:
        if self._on_end is not on_end:
            return
        self._on_end = None
        known = self._platform.value(self.topic, self.type)
        if known is not None:
            on_latched(*known)
        on_end()

    def close(self) -> None:
        self._on_end = None
        self._platform.unsubscribe(self)


class MqttCommandPublisher:
    """Publishes on the topic of a command."""

    def __init__(self, platform: MqttPlatform, topic: TypedTopic) -> None:
        self.unmatched: list[str] = []
        self._platform = platform
        self._topic = topic

    def publish(self, body: bytes) -> None:
        self._platform.set_state(self._topic, body)

    def close(self) -> None:
        """Nothing is open at the broker for it."""


class MqttPlatform(Platform):
    """The devices of one broker.

    :param names: the names of devices
    :param reactor: for timers
    :param wall: nanoseconds since 1970
    """

    encoding = "cdr"

    def __init__(
        self,
        settings: MqttSettings,
        broker: BrokerPort,
        names: DeviceNames,
        reactor: Any,
        wall: Callable[[], int] = time.time_ns,
    ) -> None:
        self.on_alert: OnAlert = ignore_alert
        self.run = secrets.token_hex(8)
        self._settings = settings
        self._broker = broker
        self._is_config = is_config_topic(settings)
        self._reactor = reactor
        self._wall = wall
        self._problems = ProblemList()
        self._registry = DeviceRegistry(names, self._problems, settings.devices)
        self._homie = homie.HomieDevices(settings.homie)
        self._configs: dict[str, int] = {}
        """Hashes of the payloads of discovery messages that are in use."""
        self._live: dict[str, LiveDevice] = {}
        self._routes: dict[str, dict[str, None]] = defaultdict(dict)
        """Names of devices by the MQTT topics they listen to."""
        self._values: dict[str, tuple[str, int, bytes]] = {}
        """Type, stamp and body of the last value, by topic."""
        self._subscriptions: dict[str, list[MqttSubscription]] = defaultdict(list)
        self._graph: GraphView | None = None
        self._connected = False
        self._last_stamp = 0
        self._work: Iterator[None] | None = None
        self._turn: Any = None
        self._settle: Any = None
        self._after_samples: list[Callable[[], None]] = []
        self._running = False
        self._outage = AlertCondition(self._alert, MODULE, "mqtt broker")
        self._log = Logger("mqtt")
        broker.listener = self

    # --- lifecycle -----------------------------------------------------------------------------------------

    @property
    def dropped(self) -> int:
        return self._broker.dropped

    def start(self) -> None:
        self._running = True
        self._set_value(CONNECTED, BOOL, False)
        self._publish_problems()
        self._broker.start()

    def stop(self) -> None:
        self._running = False
        for timer in (self._turn, self._settle):
            if timer is not None:
                timer.cancel()
        self._turn = self._settle = None
        self._subscriptions.clear()
        self._broker.stop()

    def facts(self) -> Facts:
        return Facts("mqtt", extra={"broker": f"{self._settings.host}:{self._settings.port}"})

    def fault(self) -> str | None:
        return None

    def battery(self) -> float | None:
        return None

    def publish_device(self, state: link.DeviceReport) -> None:
        """Nothing: the computer is the gateway's, and a device has no graph."""

    def later(self, call: Callable[..., None], *arguments: Any) -> None:
        """Call on the next turn of the reactor."""
        self._reactor.callLater(0, call, *arguments)

    def _alert(self, level: str, text: str, kind: str = "", about: str = "", over: bool = False) -> None:
        self.on_alert(level, text, kind, about, over)

    # --- broker --------------------------------------------------------------------------------------------

    def on_connected(self) -> None:
        """Subscribe to discovery, and to what is known already."""
        self._connected = True
        self._problems.set("broker", [])
        self._outage.update("", "the MQTT broker is connected again")
        settings = self._settings
        topics = list(self._routes)
        if settings.discovery_prefix:
            prefix = settings.discovery_prefix
            topics += [f"{prefix}/+/+/config", f"{prefix}/+/+/+/config"]
        if settings.homie:
            topics += homie.subscriptions(settings.homie)
        self._broker.subscribe(topics)
        if settings.discovery_prefix and settings.birth:
            self._broker.publish(f"{settings.discovery_prefix}/status", home_assistant.BIRTH)
        self._set_value(CONNECTED, BOOL, True)
        self._update_available()

    def on_lost(self, reason: str) -> None:
        """Say that nothing is known to be there."""
        self._connected = False
        self._outage.update(f"no MQTT broker at {self._settings.broker}: {reason}", "")
        self._set_value(CONNECTED, BOOL, False)
        for live in self._live.values():
            live.forget_availability()
        self._update_available()

    def on_refused(self, what: str) -> None:
        """Say that the broker refuses something, until the next connection."""
        self._problems.set("broker", [what])
        self._publish_problems()

    def on_waiting(self) -> None:
        """Read messages, in turns."""
        if self._running and self._turn is None:
            self._take_turn()

    def _take_turn(self) -> None:
        self._turn = None
        end = self._reactor.seconds() + TURN_SECONDS
        if self._work is None:
            self._work = self._handle_all()
        done = False
        try:
            while not done and self._reactor.seconds() < end:
                done = next(self._work, True) is True
        except Exception:
            # The message is lost, those behind it are not.
            self._log.failure("a message from the MQTT broker could not be handled")
            self._work = None
        if done:
            self._work = None
        else:
            self._turn = self._reactor.callLater(0.001, self._take_turn)
        self._samples_done()

    def _samples_done(self) -> None:
        calls, self._after_samples = self._after_samples, []
        for call in calls:
            call()
        self._publish_problems()

    def _handle_all(self) -> Iterator[None]:
        """Handle all messages that wait; yields after each step of bounded work."""
        while (message := self._broker.take()) is not None:
            if self._is_config(message.topic):
                self._handle_config(message)
                yield
            # Homie's $state is both: part of the description, and the availability.
            for name in list(self._routes.get(message.topic, ())):
                live = self._live.get(name)
                if live is not None:
                    yield from self._handle_state(live, message)
            yield

    def _handle_state(self, live: LiveDevice, message: MqttMessage) -> Iterator[None]:
        topic, payload = message
        try:
            if live.availability_message(topic, payload):
                self._problems.set(live.device.available_topic, [])
        except Invalid as error:
            self._problems.set(live.device.available_topic, [str(error)])
        self._set_available(live)
        for named in live.elements.get(topic, ()):
            self._read_state(named, payload)
            yield

    def _read_state(self, named: NamedElement, payload: bytes) -> None:
        element = named.element
        assert element.source is not None
        try:
            value = element.source.value(payload)
        except MissingValue:
            # Devices publish some of their values at a time.
            return
        except Invalid as error:
            self._problems.set(named.topic, [str(error)])
            return
        self._problems.set(named.topic, [])
        if value is not None:
            self._set_value(named.topic, element.type, value)

    # --- discovery -----------------------------------------------------------------------------------------

    def _handle_config(self, message: MqttMessage) -> None:
        topic, payload = message
        try:
            if self._homie.handle(topic, payload):
                self._expect_changes()
                return
            where = home_assistant.parse_topic(topic, self._settings.discovery_prefix)
            if where is not None:
                self._handle_home_assistant(topic, where, payload)
        except Invalid as error:
            self._problems.set(topic, [str(error)])

    def _handle_home_assistant(self, topic: str, where: home_assistant.ConfigTopic, payload: bytes) -> None:
        digest = hash(payload)
        if self._configs.get(topic) == digest:
            return
        self._configs.pop(topic, None)
        if not payload:
            self._registry.set_part(topic, None)
            self._problems.set(topic, [])
        else:
            try:
                part = home_assistant.parse_config(where, payload)
            except Invalid:
                self._registry.set_part(topic, None)
                self._expect_changes()
                raise
            self._registry.set_part(topic, part)
            self._problems.set(topic, part.problems)
            self._configs[topic] = digest
        self._expect_changes()

    def _expect_changes(self) -> None:
        if self._settle is None and self._running:
            self._settle = self._reactor.callLater(SETTLE_SECONDS, self._apply_changes)

    def _apply_changes(self) -> None:
        self._settle = None
        for source, part in self._homie.take_changed(DEVICES_AT_ONCE):
            try:
                self._registry.set_part(source, part)
                self._problems.set(source, part.problems if part is not None else [])
            except Invalid as error:
                self._problems.set(source, [str(error)])
        added: dict[str, None] = {}
        removed: dict[str, None] = {}
        changes = self._registry.flush(DEVICES_AT_ONCE).devices
        for name, device in changes.items():
            self._replace(name, device, added, removed)
        if changes:
            self._graph = None
            self._broker.unsubscribe([each for each in removed if each not in self._routes])
            self._broker.subscribe(added)
            self._update_publishers()
        self._publish_problems()
        if self._homie.has_changed or self._registry.has_changed:
            self._settle = self._reactor.callLater(0.001, self._apply_changes)

    def _replace(
        self, name: str, device: MqttDevice | None, added: dict[str, None], removed: dict[str, None]
    ) -> None:
        """Replace a device.

        :param added: receives the MQTT topics to subscribe
        :param removed: receives those that it no longer needs
        """
        before = self._live.pop(name, None)
        if before is not None:
            for topic in before.device.mqtt_topics():
                self._routes[topic].pop(name, None)
                if not self._routes[topic]:
                    del self._routes[topic]
                    removed[topic] = None
            self._forget_values(before.device, device)
        if device is None:
            return
        self._live[name] = live = LiveDevice(device)
        for topic in sorted(device.mqtt_topics()):
            self._routes[topic][name] = None
            added[topic] = None
        self._set_available(live)

    def _forget_values(self, before: MqttDevice, after: MqttDevice | None) -> None:
        for topic, element in before.elements.items():
            kept = after.elements.get(topic) if after is not None else None
            if kept is None or kept.type != element.type:
                self._values.pop(topic, None)
                self._problems.set(topic, [])
        if after is None:
            self._values.pop(before.available_topic, None)

    # --- values --------------------------------------------------------------------------------------------

    def _set_available(self, live: LiveDevice) -> None:
        available = self._connected and live.available
        topic = live.device.available_topic
        known = self._values.get(topic)
        body = messages.encode(BOOL, available)
        if known is None or known[2] != body:
            self._set_value(topic, BOOL, available)

    def _update_available(self) -> None:
        for live in self._live.values():
            self._set_available(live)
        self._samples_done()

    def _publish_problems(self) -> None:
        if self._problems.changed or PROBLEMS not in self._values:
            self._set_value(PROBLEMS, TEXT, self._problems.json())

    def _set_value(self, topic: str, type: str, value: Any) -> None:
        self._last_stamp = max(self._last_stamp + 1, self._wall())
        body = messages.encode(type, value)
        self._values[topic] = (type, self._last_stamp, body)
        for subscription in list(self._subscriptions.get(topic, ())):
            if subscription.type == type:
                subscription.stamp = self._last_stamp
                subscription.on_sample(body)

    def value(self, topic: str, type: str) -> tuple[int, bytes] | None:
        """Stamp and body of a topic's last value."""
        known = self._values.get(topic)
        return (known[1], known[2]) if known is not None and known[0] == type else None

    # --- graph ---------------------------------------------------------------------------------------------

    def graph(self) -> GraphView:
        if self._graph is None:
            self._graph = self._build_graph()
        return self._graph

    def endpoints(self, name: str, kind: str) -> frozenset[bytes]:
        view = self.graph()
        full = self.full_name(name, kind)
        if kind == "service":
            nodes = view.services[full].providers if full in view.services else []
        else:
            nodes = view.topics[full].publishers if full in view.topics else []
        return frozenset(each.encode() for each in nodes)

    def _build_graph(self) -> GraphView:
        own = f"/{GATEWAY}"
        topics = {
            CONNECTED: link.Topic(types=[BOOL], publishers=[own]),
            PROBLEMS: link.Topic(types=[TEXT], publishers=[own]),
        }
        services = {STOP_DEVICES: link.Service(types=[TRIGGER], providers=[own])}
        for live in self._live.values():
            node = f"/{live.device.name}"
            topics[live.device.available_topic] = link.Topic(types=[BOOL], publishers=[node])
            for topic, element in live.device.elements.items():
                if element.source is not None:
                    topics[topic] = link.Topic(types=[element.type], publishers=[node])
                if element.command is not None:
                    topics[topic + SET] = link.Topic(types=[element.type], subscribers=[node])
            for name, call in live.device.calls.items():
                services[name] = link.Service(types=[call.type], providers=[node])
        nodes = frozenset([own, *(f"/{name}" for name in self._live)])
        return GraphView(topics=topics, services=services, nodes=nodes)

    def full_name(self, name: str, kind: str) -> str:
        full = "/" + name.removeprefix("/")
        if len(full) > NAME or not _NAME.match(full):
            raise Invalid(f"'{name[:80]}' is not a valid {kind} name")
        return full

    def resolve(self, topic: str, type: str) -> TypedTopic:
        full = self.full_name(topic, "topic")
        known = self.graph().topics.get(full)
        if known is None:
            raise NotFound(f"no device has the topic {full}")
        if type and normalise(type) not in known.types:
            raise Invalid(f"the topic {full} is of type {known.types[0]}, not {type}")
        return TypedTopic(full, known.types[0])

    def definition(self, type: str) -> link.TypeDefinition:
        return messages.definition(normalise(type, "srv" if type.startswith("std_srvs") else "msg"))

    def interfaces(self) -> list[str]:
        return sorted(messages.TYPES)

    # --- subscriptions -------------------------------------------------------------------------------------

    def subscribe(
        self, topic: str, type: str, qos: link.QoS | None, on_sample: OnSample, on_change: OnChange
    ) -> MqttSubscription:
        full = self.full_name(topic, "topic")
        if full in self.graph().topics or not type:
            full, type = self.resolve(topic, type)
        subscription = MqttSubscription(self, full, normalise(type), on_sample, on_change)
        subscription.publishers = self._publishers(full)
        self._subscriptions[full].append(subscription)
        self.later(self._send_first, subscription)
        return subscription

    def _send_first(self, subscription: MqttSubscription) -> None:
        """Send the last value, unless a newer one was sent or the subscription was closed."""
        known = self.value(subscription.topic, subscription.type)
        subscribed = subscription in self._subscriptions.get(subscription.topic, ())
        if known is not None and subscribed and subscription.stamp == 0:
            subscription.stamp, body = known
            subscription.on_sample(body)

    def unsubscribe(self, subscription: MqttSubscription) -> None:
        """Forget a subscription."""
        known = self._subscriptions.get(subscription.topic, [])
        if subscription in known:
            known.remove(subscription)
            if not known:
                del self._subscriptions[subscription.topic]

    def _publishers(self, topic: str) -> int:
        known = self.graph().topics.get(topic)
        return len(known.publishers) if known is not None else 0

    def _update_publishers(self) -> None:
        for topic, subscriptions in list(self._subscriptions.items()):
            count = self._publishers(topic)
            for each in list(subscriptions):
                if each.publishers != count:
                    each.publishers = count
                    each.on_change()

    def after_samples(self, call: Callable[[], None]) -> None:
        if not self._after_samples:
            self.later(self._samples_done)
        self._after_samples.append(call)

    # --- commands ------------------------------------------------------------------------------------------

    def advertise(
        self,
        topic: str,
        type: str,
        latch: bool,
        qos: link.QoS | None,
        queue_size: int = 0,
        on_change: OnChange = lambda: None,
    ) -> MqttCommandPublisher:
        resolved = self.resolve(topic, type)
        if self._command(resolved.name) is None:
            raise Invalid(f"no device takes commands on {resolved.name}; topics of commands end in {SET}")
        return MqttCommandPublisher(self, resolved)

    def _device_of(self, name: str) -> MqttDevice | None:
        live = self._live.get(name.split("/")[1])
        return live.device if live is not None else None

    def _command(self, topic: str) -> StateCommand | None:
        device = self._device_of(topic)
        element = device.elements.get(topic.removesuffix(SET)) if device and topic.endswith(SET) else None
        return element.command if element is not None else None

    def set_state(self, topic: TypedTopic, body: bytes) -> None:
        """Send a command; one that can't be sent is a problem of its topic."""
        try:
            command = self._command(topic.name)
            if command is None:
                raise NotFound(f"{topic.name} is gone")
            payload = command.payload(messages.decode(topic.type, body))
            self._broker.publish(command.topic, payload, command.qos, command.retain)
        except SwitchboardError as error:
            self._problems.set(topic.name, [str(error)])
        else:
            self._problems.set(topic.name, [])
        self._publish_problems()

    def call(
        self, service: str, type: str, request: bytes, timeout: float, check: Check | None = None
    ) -> Deferred[bytes]:
        try:
            name = self.full_name(service, "service")
            known = self.graph().services.get(name)
            if known is None:
                raise NotFound(f"there is no service {name} on any device")
            if type and normalise(type, "srv") not in known.types:
                raise Invalid(f"the service {name} is of type {known.types[0]}, not {type}")
            value = messages.decode(known.types[0], request)
            if check is not None:
                check()
            text = self._stop_devices() if name == STOP_DEVICES else self._call_device(name, value)
        except SwitchboardError as error:
            return fail(error)
        return succeed(messages.response(True, text))

    def _call_device(self, name: str, value: Any) -> str:
        device = self._device_of(name)
        call = device.calls.get(name) if device is not None else None
        if call is None:
            raise NotFound(f"there is no service {name} on any device")
        self._send(call, value)
        return "sent to the broker"

    def _send(self, call: DeviceCall, value: Any) -> None:
        self._broker.publish(call.topic, call.payload(value), call.qos, call.retain, stops=call.stops)

    def _stop_devices(self) -> str:
        """Send each cover a stop, whatever becomes of the others.

        :raises Unavailable: some got none
        """
        stops = [call for live in self._live.values() for call in live.device.calls.values() if call.stops]
        failed = []
        for call in stops:
            try:
                self._send(call, None)
            except SwitchboardError as error:
                failed.append(str(error))
        if failed:
            raise Unavailable(f"{len(failed)} of {len(stops)} covers were sent no stop: {failed[0]}")
        return f"{len(stops)} covers were sent a stop"

    def prepare_call(self, service: str, type: str) -> None:
        """Nothing needs to be prepared."""

    def classify_command(self, type: str, body: bytes) -> CommandEffect:
        try:
            messages.decode(type, body)
        except Invalid:
            return CommandEffect.INVALID
        return CommandEffect.MOVING

    def zero_template(self, type: str, body: bytes) -> bytes:
        return b""

    def zero_command(self, type: str, template: bytes = b"") -> bytes:
        raise Invalid(f"there is no command of type {type} that means standstill")

    # --- what devices do not have --------------------------------------------------------------------------

    def advertise_service(self, service: str, type: str, on_call: OnCall) -> AdvertisementHandle:
        raise Invalid("MQTT devices call no services, so none can be advertised to them")

    def advertise_action(
        self, action: str, type: str, on_goal: OnGoal, on_cancel: OnCancel
    ) -> AdvertisementHandle:
        raise Invalid("MQTT devices use no actions, so none can be advertised to them")

    def send_goal(self, action: str, type: str, goal: bytes, on_feedback: OnSample | None) -> GoalHandle:
        raise NotFound(f"there is no action {action} on any device")
