"""The connection to a real Mosquitto: password, TLS, sizes, reconnecting; the queue between the threads."""

from __future__ import annotations

import ipaddress
import queue
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import paho.mqtt.publish
import pytest
from cryptography import x509

from relay_protocol.errors import Invalid, Unavailable
from robot_client.platforms.mqtt import broker as broker_module
from robot_client.platforms.mqtt.broker import Inbox, MqttMessage, PahoBroker
from robot_client.platforms.mqtt.settings import PASSWORD_VARIABLE, MqttSettings, read_password
from tests.robot_client.link.test_tls import Authority
from tests.worlds.chaos_proxy import ChaosProxy
from tests.worlds.mosquitto import PASSWORD, USER, Mosquitto
from tests.worlds.waiting import PATIENCE


class Timer:
    """A call that the test makes."""

    def __init__(self, reactor: QueueReactor, call: Callable[[], None]) -> None:
        self._reactor = reactor
        self._call = call

    def active(self) -> bool:
        return self in self._reactor.timers

    def cancel(self) -> None:
        self._reactor.timers.remove(self)

    def __call__(self) -> None:
        if self.active():
            self.cancel()
        self._call()


class QueueReactor:
    """Runs what other threads ask for, and timers, in the test's thread."""

    def __init__(self) -> None:
        self._calls: queue.Queue[Callable[[], None]] = queue.Queue()
        self.timers: list[Timer] = []

    def seconds(self) -> float:
        return time.monotonic()

    def callFromThread(self, function: Callable[..., None], *arguments: Any) -> None:
        self._calls.put(lambda: function(*arguments))

    def callLater(self, _: float, function: Callable[..., None], *arguments: Any) -> Timer:
        timer = Timer(self, lambda: function(*arguments))
        self.timers.append(timer)
        return timer

    def until(self, condition: Callable[[], object]) -> None:
        end = time.monotonic() + PATIENCE
        while not condition():
            self._calls.get(timeout=end - time.monotonic())()


class Connected:
    """A broker's client, and what it reported."""

    def __init__(self, password: str | None = PASSWORD, **options: Any) -> None:
        self.reactor = QueueReactor()
        self.events: list[str] = []
        self.messages: list[MqttMessage] = []
        settings = MqttSettings(user=USER, **options)
        self.broker = PahoBroker(settings, password, lambda _: False, self.reactor, lambda: 0.5)
        self.broker.listener = self
        self.broker.start()

    def on_connected(self) -> None:
        self.events.append("connected")

    def on_lost(self, reason: str) -> None:
        self.events.append(reason)

    def on_refused(self, what: str) -> None:
        self.events.append(what)

    def on_waiting(self) -> None:
        while (message := self.broker.take()) is not None:
            self.messages.append(message)

    def next(self) -> str:
        """The next event."""
        self.reactor.until(lambda: self.events)
        return self.events.pop(0)


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    made = Authority(tmp_path_factory.mktemp("authority"), "home")
    made.server([x509.IPAddress(ipaddress.ip_address("127.0.0.1"))])
    return made


@pytest.fixture(scope="module")
def mosquitto(authority: Authority, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Mosquitto]:
    made = Mosquitto(tmp_path_factory.mktemp("broker"), certificate=authority.path.with_name("server.pem"))
    yield made
    made.stop()


@pytest.mark.parametrize("protocol", ["5", "3.1.1"])
def test_messages_in_both_directions(mosquitto: Mosquitto, protocol: str) -> None:
    client = Connected(broker=mosquitto.address, protocol=protocol)
    assert client.next() == "connected"
    client.broker.subscribe([f"echo/{protocol}"])
    client.broker.publish(f"echo/{protocol}", "hello", 1, True)
    client.reactor.until(lambda: client.messages)
    assert client.messages == [(f"echo/{protocol}", b"hello")]
    client.broker.stop()


def test_error_for_a_wrong_password_does_not_contain_it(mosquitto: Mosquitto) -> None:
    client = Connected("wrong", broker=mosquitto.address)
    assert client.next() == "the broker refused the connection: Not authorized"
    assert len(client.reactor.timers) == 1
    with pytest.raises(Unavailable):
        client.broker.publish("a", "b")
    client.broker.stop()


def test_tls(mosquitto: Mosquitto, authority: Authority) -> None:
    client = Connected(broker=mosquitto.tls_address, tls=True, ca=str(authority.path))
    assert client.next() == "connected"
    client.broker.stop()


def test_certificate_of_another_authority_is_refused(mosquitto: Mosquitto, tmp_path: Path) -> None:
    other = Authority(tmp_path, "other")
    client = Connected(broker=mosquitto.tls_address, tls=True, ca=str(other.path))
    assert client.next().startswith("the broker's certificate is not accepted")
    client.broker.stop()


def test_broker_that_is_not_there() -> None:
    client = Connected(broker="127.0.0.1:1")
    assert client.next() == "the broker can't be reached: Connection refused"
    (again,) = client.reactor.timers
    again()
    assert client.next().startswith("the broker can't be reached")
    client.broker.stop()


def test_command_of_a_lost_connection_is_not_sent_by_the_next_one(mosquitto: Mosquitto) -> None:
    client = Connected(broker=mosquitto.address)
    assert client.next() == "connected"
    mosquitto.freeze()
    client.broker.publish("late/command", "open", 1)
    mosquitto.stop()
    assert "lost" in client.next()
    mosquitto.start()
    watcher = Connected(broker=mosquitto.address)
    assert watcher.next() == "connected"
    watcher.broker.subscribe(["late/#"])
    client.reactor.timers.pop()()
    assert client.next() == "connected"
    client.broker.publish("late/marker", "x", 1)
    watcher.reactor.until(lambda: watcher.messages)
    assert watcher.messages == [("late/marker", b"x")]
    client.broker.stop()
    watcher.broker.stop()


def test_a_connection_on_which_the_broker_reads_no_command_is_cut(mosquitto: Mosquitto) -> None:
    """The network stands still, and the connection does not end by itself."""
    direct = Connected(broker=mosquitto.address)
    assert direct.next() == "connected"
    direct.broker.subscribe(["blind/set"])
    proxy = ChaosProxy(mosquitto.port)
    client = Connected(broker=f"127.0.0.1:{proxy.port}")
    assert client.next() == "connected"
    client.broker.publish("blind/set", "first")
    client.broker.publish("blind/set", "second")
    direct.reactor.until(lambda: len(direct.messages) == 2)
    client.reactor.until(lambda: not client.reactor.timers)
    proxy.black_hole()
    client.broker.publish("blind/set", "OPEN")
    (late,) = client.reactor.timers
    late()
    assert client.next() == "the broker has not read a command within 2 s"
    proxy.reset()
    proxy.heal()
    # A new connection, by the timer of the next attempt.
    client.reactor.timers[0]()
    assert client.next() == "connected"
    client.broker.publish("blind/set", "last")
    direct.reactor.until(lambda: len(direct.messages) == 3)
    assert [each.payload for each in direct.messages] == [b"first", b"second", b"last"]
    for each in (client, direct):
        each.broker.stop()
    proxy.close()


def test_what_the_rules_of_the_broker_refuse_is_reported(tmp_path: Path) -> None:
    broker = Mosquitto(tmp_path / "strict", rules=["topic readwrite allowed/#"])
    client = Connected(broker=broker.address)
    assert client.next() == "connected"
    client.broker.publish("forbidden", "x", 1)
    assert client.next() == "the broker refuses a command: Not authorized"
    client.broker.publish("allowed/x", "x", 1)
    client.reactor.until(lambda: not client.reactor.timers)
    assert client.events == []
    client.broker.stop()
    broker.stop()


def test_too_many_commands_are_refused(mosquitto: Mosquitto, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(broker_module, "MAX_UNSENT", 3)
    client = Connected(broker=mosquitto.address)
    assert client.next() == "connected"
    mosquitto.freeze()
    with pytest.raises(Unavailable, match="wait for the MQTT broker"):
        for _ in range(4):
            client.broker.publish("a", "b", 1)
    # What stops something is sent all the same.
    client.broker.publish("a", "STOP", 1, stops=True)
    mosquitto.thaw()
    client.broker.stop()


def test_huge_message_is_kept_away_by_the_broker(mosquitto: Mosquitto) -> None:
    client = Connected(broker=mosquitto.address)
    assert client.next() == "connected"
    client.broker.subscribe(["big/#"])
    auth = {"username": USER, "password": PASSWORD}
    messages = [("big/one", b"x" * 2_000_000, 1, False), ("big/two", b"y", 1, False)]
    paho.mqtt.publish.multiple(messages, "127.0.0.1", mosquitto.port, auth=auth)
    client.reactor.until(lambda: client.messages)
    assert client.messages == [("big/two", b"y")]
    client.broker.stop()


def test_queue_keeps_configurations_and_drops_the_oldest_states(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(broker_module, "MAX_WAITING", 3)
    inbox = Inbox(lambda topic: topic.startswith("config"))
    for number in range(5):
        inbox.put("state", b"%d" % number)
        inbox.put("config/1", b"%d" % number)
    assert inbox.dropped == 2
    found = []
    while (message := inbox.take()) is not None:
        found.append(message)
    assert found == [("config/1", b"4"), ("state", b"2"), ("state", b"3"), ("state", b"4")]


def test_queue_is_bounded_in_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(broker_module, "MAX_WAITING_BYTES", 100)
    inbox = Inbox(lambda topic: topic.startswith("config"))
    for number in range(10):
        inbox.put("state", b"x" * 40)
        inbox.put(f"config/{number}", b"x" * 40)
    assert inbox.dropped == 8 + 8
    inbox.clear()
    assert inbox.take() is None


def test_password_from_a_file_or_the_environment(tmp_path: Path) -> None:
    file = tmp_path / "password"
    file.write_text("secret\n")
    settings = MqttSettings(password_file=str(file))
    file.chmod(0o644)
    with pytest.raises(Invalid, match="chmod 600"):
        read_password(settings, {})
    file.chmod(0o600)
    assert read_password(settings, {PASSWORD_VARIABLE: "other"}) == "secret"
    assert read_password(MqttSettings(), {PASSWORD_VARIABLE: "other"}) == "other"
    assert read_password(MqttSettings(), {}) is None
    with pytest.raises(Invalid, match="can't be read"):
        read_password(MqttSettings(password_file=str(tmp_path / "none")), {})


@pytest.mark.parametrize(
    "options",
    [
        {"broker": "a b"},
        {"broker": "x:99999"},
        {"ca": "x.pem"},
        {"discovery_prefix": "a/#"},
        {"homie": "a/b"},
    ],
)
def test_settings_that_are_refused(options: dict[str, str]) -> None:
    with pytest.raises(ValueError, match="mqtt"):
        MqttSettings(**options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("options", "address"),
    [
        ({}, ("127.0.0.1", 1883)),
        ({"tls": True, "broker": "mqtt.example.org"}, ("mqtt.example.org", 8883)),
        ({"broker": "[::1]:1884"}, ("::1", 1884)),
    ],
)
def test_address_of_the_broker(options: dict[str, Any], address: tuple[str, int]) -> None:
    settings = MqttSettings(**options)
    assert (settings.host, settings.port) == address
