"""A robot that does little, but honestly: services, a topic that is heard, and what the relay orders about motion."""

from __future__ import annotations

import contextlib
import json
import socket
import threading
from collections.abc import Callable
from typing import Any

from switchboard_fake_robot import FakeRobot
from switchboard_relay import Relay
from switchboard_waiting import PATIENCE, wait_for

from relay_protocol import PROTOCOL_VERSION, link
from relay_protocol.frames import JsonFrame, SampleFrame

TRIGGER = "std_srvs/srv/Trigger"
STRING = "std_msgs/msg/String"
HERE = "/base"

Service = Callable[["SmallRobot", Any], dict[str, Any] | None]
"""Answers a call; ``None``: never."""


class End(FakeRobot):
    """One end of a link that leaves all messages to the robot, its orders too."""

    def receive(self, seconds: float = PATIENCE) -> dict[str, Any] | None:
        """The next message, ``None`` at the end of the connection."""
        self.socket.settimeout(seconds)
        while not self._heard:
            data = self.socket.recv(65536)
            if not data:
                return None
            frames = self._decoder.feed(data)
            self._heard += [json.loads(each.body) for each in frames if isinstance(each, JsonFrame)]
        return self._heard.pop(0)


class SmallRobot:
    """Speaks JSON, in threads of this process: one for its control link, one for each channel.

    :param services: by name; each is a Trigger
    :param moving: names of those that move it
    """

    def __init__(
        self, relay: Relay, name: str, services: dict[str, Service], moving: tuple[str, ...] = ()
    ) -> None:
        self.relay = relay
        self.name = name
        self.heard: list[Any] = []
        """Messages on its topic ``/mode``."""
        self.calls: list[tuple[str, int]] = []
        """What was called, and by which source."""
        self.holders: list[int] = []
        """Who had control of it, one after the other."""
        self.stopped: dict[str, str] | None = None
        self._services = services
        self._moving = list(moving)
        self._key = name.encode().ljust(32, b"\0")[:32]
        self._links: list[End] = []
        self._threads: list[threading.Thread] = []
        code = relay.cli("robot", "add", name)["enrolment_code"]
        with End(relay.robots_port) as enrolling:
            assert enrolling.enroll(name, code, self._key)["op"] == "enrolled"

    def comes(self) -> SmallRobot:
        """Dial, and be online."""
        control = End(self.relay.robots_port)
        assert control.register(self.name, self._key)["op"] == "welcome"
        motion = link.MotionPolicy(services=self._moving)
        control.send(link.Describe(platform="json", motion=motion))
        services = {name: link.Service(types=[TRIGGER], providers=[HERE]) for name in self._services}
        topics = {"/mode": link.Topic(types=[STRING], subscribers=[HERE])}
        control.send(link.Graph(full=True, topics=topics, services=services, nodes={HERE: {}}))
        self._listen(control, self._order)
        wait_for(f"{self.name} is online", lambda: self.relay.state_of(self.name) != "offline")
        return self

    def goes(self) -> None:
        """Hang up everywhere."""
        for each in self._links:
            with contextlib.suppress(OSError):
                each.socket.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join(10)
            assert not thread.is_alive()
        for each in self._links:
            each.socket.close()
        self._links, self._threads = [], []

    def _listen(self, end: End, take: Callable[[End, dict[str, Any]], None]) -> None:
        def loop() -> None:
            end.socket.settimeout(60)
            with contextlib.suppress(OSError):
                while data := end.socket.recv(65536):
                    for frame in end._decoder.feed(data):
                        if isinstance(frame, SampleFrame):
                            self.heard.append(json.loads(frame.body))
                        elif isinstance(frame, JsonFrame):
                            message = json.loads(frame.body)
                            if message["op"] == "ping":
                                end.send(link.Pong(t=message["t"], at=1))
                            else:
                                take(end, message)

        thread = threading.Thread(target=loop, name=self.name, daemon=True)
        self._links.append(end)
        self._threads.append(thread)
        # What came with the answer to the last question.
        for message in end._heard:
            take(end, message)
        thread.start()

    def _order(self, control: End, message: dict[str, Any]) -> None:
        op = message["op"]
        if op == "open_channel":
            channel = End(self.relay.robots_port)
            channel.send(link.Join(version=PROTOCOL_VERSION, ticket=message["ticket"]))
            self._listen(channel, self._asked)
            return
        if op == "control":
            self.holders.append(message.get("holder", 0))
        elif op == "stop":
            self.stopped = {"by": message["by"], "why": message.get("why", "")}
        elif op == "resume":
            self.stopped = None
        if "id" in message:
            control.send(link.Done(id=message["id"]))

    def _asked(self, channel: End, message: dict[str, Any]) -> None:
        op = message["op"]
        if op == "advertise":
            number, topic, kind = message["number"], message["topic"], message["type"]
            channel.send(link.Advertised(number=number, topic=topic, type=kind, encoding="json"))
        elif op == "call_service":
            self.calls.append((message["service"], message.get("source", 0)))
            answer = self._services[message["service"]](self, message.get("args"))
            if answer is not None:
                channel.send(link.ServiceResponse(id=message["id"], result=True, values=answer))
