"""A small, correct robot: services, a received topic, and motion orders of the relay."""

from __future__ import annotations

import contextlib
import json
import socket
import ssl
import threading
import time
from collections.abc import Callable
from typing import Any

from relay_protocol import PROTOCOL_VERSION, link
from relay_protocol.frames import JsonFrame, SampleFrame, encode_video
from tests.worlds.fake_robot import FakeRobot
from tests.worlds.relay_process import Relay
from tests.worlds.waiting import PATIENCE, wait_for

TRIGGER = "std_srvs/srv/Trigger"
STRING = "std_msgs/msg/String"
ACTION = "small_msgs/action/Work"
HERE = "/base"
CAMERA = "/camera"

Service = Callable[["SmallRobot", Any], dict[str, Any] | None]
"""Answers a call; ``None``: never."""


class End(FakeRobot):
    """One side of a link; the robot handles all messages, orders included."""

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
    :param source: address that it connects from
    :param port: the relay's for robots, or that of a proxy
    :param context: of TLS, if the port has it
    :param actions: their names, with the text of the type of all, :data:`ACTION`
    """

    def __init__(
        self,
        relay: Relay,
        name: str,
        services: dict[str, Service],
        moving: tuple[str, ...] = (),
        source: str = "127.0.0.1",
        *,
        port: int = 0,
        context: ssl.SSLContext | None = None,
        actions: dict[str, str] | None = None,
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
        self._stopped_at = 0.0
        self.picture = b""
        """A JPEG that its camera shows; empty: it has no camera."""
        self.modules: list[str] = []
        """Its modules; without any it reports none."""
        self.module_orders: list[tuple[str, str]] = []
        """Orders that it has accepted: module and action."""
        self._source = source
        self._port = port
        self._context = context
        self._services = services
        self._actions = actions or {}
        self.goals: list[Any] = []
        """Arguments of the goals that it has reached."""
        self._moving = list(moving)
        self._key = name.encode().ljust(32, b"\0")[:32]
        self._links: list[End] = []
        self._threads: list[threading.Thread] = []
        code = relay.cli("robot", "add", name)["enrolment_code"]
        with self._dial() as enrolling:
            assert enrolling.enroll(name, code, self._key)["op"] == "enrolled"

    def comes(self) -> SmallRobot:
        """Connects and registers."""
        control = self._dial()
        assert control.register(self.name, self._key)["op"] == "welcome"
        motion = link.MotionPolicy(services=self._moving)
        control.send(link.Describe(platform="json", motion=motion))
        services = {name: link.Service(types=[TRIGGER], providers=[HERE]) for name in self._services}
        topics = {"/mode": link.Topic(types=[STRING], subscribers=[HERE])}
        actions = {name: link.Service(types=[ACTION], providers=[HERE]) for name in self._actions}
        control.send(
            link.Graph(full=True, topics=topics, services=services, actions=actions, nodes={HERE: {}})
        )
        if self.picture:
            control.send(link.Cameras(cameras=[link.Camera(name=CAMERA)]))
        if self.modules:
            modules = [link.ModuleInfo(name=each, kind="command", state="running") for each in self.modules]
            control.send(link.Modules(modules=modules))
        if self.stopped is not None:
            control.send(link.MotionState(stopped=link.Stopped(**self.stopped, since=self._stopped_at)))
        self._listen(control, self._order)
        wait_for(f"{self.name} is online", lambda: self.relay.state_of(self.name) != "offline")
        return self

    def goes(self) -> None:
        """Closes all links."""
        for each in self._links:
            with contextlib.suppress(OSError):
                each.socket.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join(10)
            assert not thread.is_alive()
        for each in self._links:
            each.socket.close()
        self._links, self._threads = [], []

    def _dial(self) -> End:
        return End(self._port or self.relay.robots_port, self._source, self._context)

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
        # Messages that arrived with the last answer.
        for message in end._heard:
            take(end, message)
        thread.start()

    def _order(self, control: End, message: dict[str, Any]) -> None:
        op = message["op"]
        if op == "open_channel":
            channel = self._dial()
            channel.send(link.Join(version=PROTOCOL_VERSION, ticket=message["ticket"]))
            self._listen(channel, self._asked)
            return
        if op == "open_video":
            end = self._dial()
            end.send(link.Join(version=PROTOCOL_VERSION, ticket=message["ticket"]))
            end.send(link.StreamStatus(width=32, height=24, quality=80))
            end.send_bytes(encode_video(1, time.time_ns(), self.picture))
            self._listen(end, lambda *_: None)
            return
        if op == "order_module":
            self.module_orders.append((message["module"], message["action"]))
            control.send(link.ModuleOrdered(request=message["request"]))
        elif op == "read_module_log":
            line = link.LogLine(at=1.0, stream="out", level="info", text=f"{message['module']} is up")
            control.send(link.ModuleLog(request=message["request"], lines=[line], next=9))
        elif op == "measure_processes":
            process = link.ProcessInfo(pid=7, parent=1, name="base", part="base", state="running")
            control.send(link.Processes(request=message["request"], at=1.0, processes=[process]))
        elif op == "control_grant":
            self.holders.append(message.get("holder", 0))
        elif op == "stop":
            self.stopped = {"by": message["by"], "why": message.get("why", "")}
            self._stopped_at = time.time()
        elif op == "resume":
            self.stopped = None
        if "id" in message:
            control.send(link.OrderResult(id=message["id"]))

    def _asked(self, channel: End, message: dict[str, Any]) -> None:
        op = message["op"]
        if op == "advertise":
            number, topic, kind = message["number"], message["topic"], message["type"]
            channel.send(link.Advertised(number=number, topic=topic, type=kind, encoding="json"))
        elif op == "get_type" and message["type"] == ACTION:
            channel.send(link.TypeDefinition(type=ACTION, text=next(iter(self._actions.values()))))
        elif op == "send_action_goal":
            self.goals.append(message["args"])
            channel.send(link.ActionResult(id=message["id"], status=4, result=True, values={}))
        elif op == "call_service":
            self.calls.append((message["service"], message.get("source", 0)))
            answer = self._services[message["service"]](self, message.get("args"))
            if answer is not None:
                channel.send(link.ServiceResponse(id=message["id"], result=True, values=answer))
