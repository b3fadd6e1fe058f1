"""Announces the relay's robots on an MQTT broker, for Home Assistant and, by Homie 4, for openHAB.

It uses the relay's HTTP API with a token: whatever the token's user may not do, the broker's clients can't do either.
Services that move a robot are left out: a client of a broker can't show that it still means a command.
"""

from __future__ import annotations

import hashlib
import json
import re
import threading
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple, Protocol

from twisted.logger import Logger

from robot_client.platforms.mqtt.model import ANNOUNCED, slug

POLL_SECONDS = 2.0
SERVICES_EVERY = 15
"""Polls between two looks at a robot's services."""

MAX_ROBOTS = 200
MAX_SERVICES = 50
"""Services of one robot."""

MAX_WAITING = 50
"""Commands that wait to be sent to the relay; stops wait apart."""

MAX_AGE = 2.0
"""Seconds after which a command that waited is dropped; a stop never is."""

MAX_ANSWER = 8 * 1024 * 1024
REQUEST_SECONDS = 10.0
BASE = "switchboard"
STATUS = f"{BASE}/status"
ORIGIN = {"name": "Switchboard"}
TRIGGER = "std_srvs/srv/Trigger"
SET_BOOL = "std_srvs/srv/SetBool"


class AnnouncedService(NamedTuple):
    """A service that is announced.

    :param type: :data:`TRIGGER` or :data:`SET_BOOL`
    """

    name: str
    type: str


class RelayError(Exception):
    """The relay could not be asked, or refused. The text says why."""


class RelayApi:
    """The relay's HTTP API.

    :param url: ``https://relay.example.org``
    :param token: access token
    """

    def __init__(self, url: str, token: str) -> None:
        self._base = url.rstrip("/") + "/api/v1/robots"
        self._headers = {"Authorization": f"Bearer {token}", "Content-Type": "application/json"}

    def robots(self) -> list[dict[str, Any]]:
        """The robots on which the user has a right."""
        return self._pages("", "robots", MAX_ROBOTS)

    def services(self, robot: str) -> list[AnnouncedService]:
        """The services of a robot that can be announced."""
        path = f"/{urllib.parse.quote(robot)}/services"
        found = []
        for each in self._pages(path, "services", 10 * MAX_SERVICES):
            type = next((kind for kind in (TRIGGER, SET_BOOL) if kind in each["types"]), None)
            if type and not each["moves"] and not each["name"].startswith(("/relay/", "/rosapi/")):
                found.append(AnnouncedService(each["name"], type))
        return found[:MAX_SERVICES]

    def stop(self, robot: str) -> None:
        """Stop a robot."""
        self._request("POST", f"/{urllib.parse.quote(robot)}/stop", {"why": "a button on the MQTT broker"})

    def call(self, robot: str, service: str, args: dict[str, Any]) -> None:
        """Call a service."""
        self._request(
            "POST", f"/{urllib.parse.quote(robot)}/services{urllib.parse.quote(service)}", {"args": args}
        )

    def _pages(self, path: str, key: str, most: int) -> list[dict[str, Any]]:
        found: list[dict[str, Any]] = []
        after = ""
        while len(found) < most:
            page = self._request("GET", f"{path}?limit=200&after={urllib.parse.quote(after)}")
            found += page[key]
            after = page.get("next", "")
            if not after:
                break
        return found[:most]

    def _request(self, method: str, path: str, body: dict[str, Any] | None = None) -> Any:
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(  # noqa: S310  (the scheme is checked by the command line)
            self._base + path, data, self._headers, method=method
        )
        try:
            with urllib.request.urlopen(request, timeout=REQUEST_SECONDS) as answer:  # noqa: S310
                text = answer.read(MAX_ANSWER)
            return json.loads(text) if text else None
        except urllib.error.HTTPError as error:
            raise RelayError(f"the relay answers {error.code}: {_detail(error)}") from None
        except (OSError, ValueError) as error:
            raise RelayError(f"the relay can't be reached: {error}") from None


def _detail(error: urllib.error.HTTPError) -> str:
    try:
        return str(json.loads(error.read(4096))["detail"])[:300]
    except (OSError, ValueError, KeyError, TypeError):
        return error.reason


class MqttPublisher(Protocol):
    """The part of paho's client that is used."""

    def publish(self, topic: str, payload: str, qos: int = 0, retain: bool = False) -> Any:
        """Publish a message."""


class RelayPort(Protocol):
    """The part of :class:`RelayApi` that is used."""

    def robots(self) -> list[dict[str, Any]]:
        """The robots."""

    def services(self, robot: str) -> list[AnnouncedService]:
        """The services of a robot."""

    def stop(self, robot: str) -> None:
        """Stop a robot."""

    def call(self, robot: str, service: str, args: dict[str, Any]) -> None:
        """Call a service."""


def robot_id(name: str) -> str:
    """An id in topics for the name of a robot; names that differ have ids that differ."""
    plain = slug(name)
    if plain == name:
        return plain
    return f"{plain[:50]}_{hashlib.sha256(name.encode()).hexdigest()[:6]}"


class Announcer:
    """Announces robots, publishes their state, and carries out commands.

    :param homie: first level of Homie's topics; empty for none
    :param run: runs a function in another thread: stops (true) apart from all else
    """

    def __init__(
        self,
        api: RelayPort,
        client: MqttPublisher,
        prefix: str,
        homie: str,
        run: Callable[[bool, Callable[[], None]], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._api = api
        self._client = client
        self._prefix = prefix
        self._homie = homie
        self._run = run
        self._clock = clock
        self._polls = 0
        self._services: dict[str, list[AnnouncedService]] = {}
        self._published: dict[str, str] = {}
        self._commands: dict[str, Callable[[str], None]] = {}
        self._renew = threading.Event()
        self._waiting = 0
        self._lock = threading.Lock()
        self._log = Logger("announce")

    @property
    def command_topics(self) -> list[str]:
        """The topics on which commands come."""
        return [f"{BASE}/+/+/set", *([f"{self._homie}/+/robot/+/set"] if self._homie else [])]

    def connected(self) -> None:
        """The broker may have lost everything: publish all of it at the next poll."""
        self._renew.set()
        self._client.publish(STATUS, "online", 1, True)

    def poll(self) -> None:
        """Ask the relay, and publish what changed.

        :raises RelayError: the relay could not be asked
        """
        robots = [each for each in self._api.robots() if each["platform"] != "mqtt"]
        topics: dict[str, str] = {}
        for robot in robots:
            name, online = robot["name"], robot["state"] != "offline"
            if online and (self._polls % SERVICES_EVERY == 0 or name not in self._services):
                self._learn_services(name)
            topics.update(self._describe(robot, online, self._services.get(name, [])))
        self._polls += 1
        self._commands = {
            topic: command
            for robot in robots
            for topic, command in self._commands_of(robot["name"], self._services.get(robot["name"], []))
        }
        if self._renew.is_set():
            self._renew.clear()
            self._published.clear()
        for topic in sorted(self._published.keys() - topics.keys()):
            self._client.publish(topic, "", 1, True)
            del self._published[topic]
        for topic, payload in topics.items():
            if self._published.get(topic) != payload:
                self._published[topic] = payload
                self._client.publish(topic, payload, 1, True)

    def _learn_services(self, robot: str) -> None:
        """One robot whose services can't be asked for keeps those of before, and holds up no other."""
        try:
            self._services[robot] = self._api.services(robot)
        except RelayError as error:
            self._log.warn("{robot}: {error}", robot=robot, error=str(error), limited=f"services of {robot}")

    def _describe(
        self, robot: dict[str, Any], online: bool, services: list[AnnouncedService]
    ) -> dict[str, str]:
        """All retained topics of a robot. Homie's ``$state`` is the last, as devices do it."""
        id = robot_id(robot["name"])
        battery = robot.get("battery")
        charge = "" if battery is None else f"{battery * 100:.0f}"
        base = f"{BASE}/{id}"
        topics = {
            f"{base}/online": "ON" if online else "OFF",
            f"{base}/stopped": "ON" if robot.get("stopped") else "OFF",
        }
        if charge:
            topics[f"{base}/battery"] = charge
        if self._prefix:
            config = self._home_assistant(robot["name"], id, bool(charge), services)
            topics[f"{self._prefix}/device/{ANNOUNCED}{id}/config"] = json.dumps(config)
        if self._homie:
            topics.update(self._homie_topics(robot["name"], id, online, charge, topics, services))
        return topics

    def _home_assistant(
        self, name: str, id: str, battery: bool, services: list[AnnouncedService]
    ) -> dict[str, Any]:
        components: dict[str, dict[str, Any]] = {
            "online": {
                "p": "binary_sensor",
                "dev_cla": "connectivity",
                "name": "Online",
                "stat_t": "~/online",
            },
            "stopped": {"p": "binary_sensor", "dev_cla": "problem", "name": "Stopped", "stat_t": "~/stopped"},
            "stop": {"p": "button", "name": "Stop", "cmd_t": "~/stop/set"},
        }
        if battery:
            components["battery"] = {
                "p": "sensor", "dev_cla": "battery", "unit_of_meas": "%", "stat_cla": "measurement",
                "name": "Battery", "stat_t": "~/battery",
            }  # fmt: skip
        for service in services:
            key = _service_id(service.name)
            kind = "button" if service.type == TRIGGER else "switch"
            components[key] = {"p": kind, "name": service.name, "cmd_t": f"~/{key}/set"}
        for key, component in components.items():
            component["uniq_id"] = f"{ANNOUNCED}{id}_{key}"
        return {
            "dev": {"ids": [f"{ANNOUNCED}{id}"], "name": name, "mf": "Switchboard"},
            "o": ORIGIN,
            "~": f"{BASE}/{id}",
            "avty_t": STATUS,
            "cmps": components,
        }

    def _homie_topics(
        self,
        name: str,
        id: str,
        online: bool,
        charge: str,
        states: dict[str, str],
        services: list[AnnouncedService],
    ) -> dict[str, str]:
        device = f"{self._homie}/{_homie_id(ANNOUNCED + id)}"
        properties: dict[str, tuple[str, str | None]] = {
            "online": ("boolean", "true" if online else "false"),
            "stopped": ("boolean", "true" if states[f"{BASE}/{id}/stopped"] == "ON" else "false"),
            "stop": ("boolean", None),
        }
        if charge:
            properties["battery"] = ("float", charge)
        for service in services:
            properties[_homie_id(_service_id(service.name))] = ("boolean", None)
        topics = {
            f"{device}/$homie": "4.0.0",
            f"{device}/$name": name,
            f"{device}/$extensions": "",
            f"{device}/$nodes": "robot",
            f"{device}/robot/$name": name,
            f"{device}/robot/$type": "robot",
            f"{device}/robot/$properties": ",".join(properties),
        }
        for key, (datatype, value) in properties.items():
            base = f"{device}/robot/{key}"
            topics[f"{base}/$name"] = key
            topics[f"{base}/$datatype"] = datatype
            if value is None:
                topics[f"{base}/$settable"] = "true"
                topics[f"{base}/$retained"] = "false"
            else:
                topics[base] = value
        topics[f"{device}/$state"] = "ready"
        return topics

    def _commands_of(
        self, name: str, services: list[AnnouncedService]
    ) -> list[tuple[str, Callable[[str], None]]]:
        id = robot_id(name)
        keys: dict[str, Callable[[str], None]] = {"stop": lambda payload: self._stop(name, payload)}
        for service in services:
            keys[_service_id(service.name)] = partial(self._call, name, service)
        found = [(f"{BASE}/{id}/{key}/set", command) for key, command in keys.items()]
        if self._homie:
            device = f"{self._homie}/{_homie_id(ANNOUNCED + id)}/robot"
            found += [(f"{device}/{_homie_id(key)}/set", command) for key, command in keys.items()]
        return found

    def received(self, topic: str, payload: str, retained: bool) -> None:
        """Take a command. A retained one was meant for another time, and is ignored."""
        command = None if retained else self._commands.get(topic)
        if command is not None:
            command(payload)

    def _stop(self, robot: str, payload: str) -> None:
        if payload in ("PRESS", "true"):
            self._run(True, lambda: self._logged(f"stop of {robot}", lambda: self._api.stop(robot)))

    def _call(self, robot: str, service: AnnouncedService, payload: str) -> None:
        values = {"PRESS": True, "ON": True, "true": True, "OFF": False, "false": False}
        if payload not in values or (service.type == TRIGGER and not values[payload]):
            return
        args = {"data": values[payload]} if service.type == SET_BOOL else {}
        received = self._clock()
        with self._lock:
            if self._waiting >= MAX_WAITING:
                self._log.warn(
                    "{count} commands wait; one for {robot} is dropped", count=MAX_WAITING, robot=robot
                )
                return
            self._waiting += 1

        def call() -> None:
            with self._lock:
                self._waiting -= 1
            if self._clock() - received > MAX_AGE:
                self._log.warn("a command for {robot} waited too long, and is dropped", robot=robot)
                return
            self._logged(f"{service.name} of {robot}", lambda: self._api.call(robot, service.name, args))

        self._run(False, call)

    def _logged(self, what: str, action: Callable[[], None]) -> None:
        try:
            action()
        except RelayError as error:
            self._log.warn("{what}: {error}", what=what, error=str(error))


def _service_id(name: str) -> str:
    """An id for a service; it never is one of the robot's own."""
    return f"service_{slug(name.strip('/').replace('/', '_'))}"


def _homie_id(text: str) -> str:
    return re.sub("[^a-z0-9]+", "-", text.lower()).strip("-")


class Workers:
    """Threads for commands; stops have threads of their own."""

    def __init__(self) -> None:
        self._stops = ThreadPoolExecutor(4, "stop")
        self._calls = ThreadPoolExecutor(4, "call")

    def run(self, stop: bool, function: Callable[[], None]) -> None:
        """Run a function in a thread."""
        (self._stops if stop else self._calls).submit(function)
