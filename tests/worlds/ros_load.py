"""Load by a real ROS 2 publisher, and clients that count received messages."""

from __future__ import annotations

import itertools
import json
import os
import socket
import sys
import tempfile
from pathlib import Path
from typing import Any

import psutil
from websockets.frames import Frame, Opcode

from tests.worlds.client_threads import Listener
from tests.worlds.processes import Process, ros_environment
from tests.worlds.relay_process import Relay
from tests.worlds.robot_process import Robot
from tests.worlds.sync_client import Client
from tests.worlds.waiting import PATIENCE, readable, wait_for

PUBLISHER = Path(__file__).parents[1] / "e2e" / "clients" / "load.py"
STRING = "std_msgs/msg/String"
WINDOW = 100


class Publisher:
    """The node of ``tests/e2e/clients/load.py`` in a robot's domain.

    :param least: number of messages on ``/load/small``; it continues until :meth:`is_enough`
    :param rate: of them, at most
    :param window: how many it may be ahead of the client that notes what it has taken
    :ivar folder: of its files ``taken`` and ``enough``
    """

    def __init__(self, robot: Robot, least: int, rate: float, window: int = WINDOW) -> None:
        self.folder = Path(tempfile.mkdtemp(dir=robot.folder))
        self._command = [sys.executable, str(PUBLISHER), str(least), str(rate), str(window), str(self.folder)]
        self._robot = robot
        self.process: Process | None = None

    def start(self) -> None:
        environment = ros_environment(self._robot.domain)
        self.process = Process(self._command, self._robot.folder, "load", environment)

    def is_enough(self) -> None:
        """Ends the load."""
        (self.folder / "enough").touch()

    def known_to(self, client: Client) -> None:
        """Waits until a client sees its topics."""

        def known() -> bool:
            topics = client.call("/rosapi/topics")["values"]["topics"]
            return {"/load/small", "/load/big", "/load/unsure", "/load/burst", "/load/latched"} <= set(topics)

        wait_for("the load's topics are known", known, 60)

    def sent(self) -> dict[str, Any]:
        """Waits for its end; returns the number of sent messages by topic."""
        process = self.process
        assert process is not None
        wait_for("the publisher has a subscriber", lambda: "SUBSCRIBED" in process.said())
        wait_for("the publisher is done", lambda: "DONE" in process.said(), 3600)
        line = process.wait_to_say("DONE")
        return dict(json.loads(line.removeprefix("DONE")))

    def stop(self) -> None:
        if self.process is not None:
            self.process.stop()


class Counter(Listener):
    """A client that reads all messages of some topics and stores the numbers.

    :param topics: short name (``small`` for ``/load/small``) and ``throttle_rate`` in milliseconds
    :param publisher: waits for this client
    """

    def __init__(self, client: Client, topics: dict[str, int], publisher: Publisher | None = None) -> None:
        super().__init__(client)
        self._taken = (
            None if publisher is None else os.open(publisher.folder / "taken", os.O_CREAT | os.O_WRONLY)
        )
        self.numbers: dict[str, list[int]] = {name: [] for name in topics}
        client.send(op="set_level", level="error")
        for name, throttle in topics.items():
            client.send(op="subscribe", topic=f"/load/{name}", type=STRING, throttle_rate=throttle)
        self.start()

    def take(self, message: dict[str, Any]) -> None:
        """Stores its number."""
        if message["op"] == "publish":
            name = message["topic"].removeprefix("/load/")
            number = int(message["msg"]["data"].split()[0])
            self.numbers[name].append(number)
            if name == "small" and self._taken is not None:
                os.pwrite(self._taken, b"%09d" % number, 0)
        else:
            self.broken = message["msg"]

    def lost(self, name: str) -> list[int]:
        """Numbers missing between the first and the last received one."""
        numbers = self.numbers[name]
        return sorted(set(range(numbers[0], numbers[-1] + 1)) - set(numbers)) if numbers else []

    def last(self, name: str) -> int:
        """The last received number, -1 before any."""
        return self.numbers[name][-1] if self.numbers[name] else -1

    def in_order(self, name: str) -> bool:
        """Whether each number is greater than the one before."""
        numbers = self.numbers[name]
        return all(earlier < later for earlier, later in itertools.pairwise(numbers))


class Stalled:
    """A client that subscribes and then stops reading."""

    def __init__(self, relay: Relay, robot: str, token: str, topics: list[str]) -> None:
        self._socket = socket.create_connection(("127.0.0.1", relay.http_port), timeout=PATIENCE)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        self._socket.sendall(
            f"GET /robots/{robot} HTTP/1.1\r\nHost: relay\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            f"Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\nSec-WebSocket-Version: 13\r\n"
            f"Authorization: Bearer {token}\r\n\r\n".encode()
        )
        assert self._socket.recv(12) == b"HTTP/1.1 101"
        for name in topics:
            ask = json.dumps({"op": "subscribe", "topic": f"/load/{name}", "type": STRING})
            self._socket.sendall(Frame(Opcode.TEXT, ask.encode()).serialize(mask=True))

    def is_cut(self, relay: Relay, user: str) -> None:
        """Waits until the relay has disconnected it."""

        def gone() -> bool:
            return user not in [
                client["user"] for robot in relay.cli("status")["robots"] for client in robot["clients"]
            ]

        wait_for("the stalled client is cut", gone)

    def ended(self) -> bool:
        """Whether it finds a close frame that says why it was cut when it reads again."""
        tail = b""
        while readable(self._socket, PATIENCE):
            data = self._socket.recv(1 << 20)
            if not data:
                return False
            tail = tail[-200:] + data
            if b"nothing was taken for" in tail or b"no answer to pings for" in tail:
                return True
        return False

    def close(self) -> None:
        self._socket.close()


class Meter:
    """Memory and CPU time of processes, by name."""

    def __init__(self, **pids: int) -> None:
        self._processes = {name: psutil.Process(pid) for name, pid in pids.items()}

    def memory(self) -> dict[str, int]:
        """Resident bytes."""
        return {name: each.memory_info().rss for name, each in self._processes.items()}

    def cpu(self) -> dict[str, float]:
        """CPU seconds so far."""
        return {name: sum(each.cpu_times()[:2]) for name, each in self._processes.items()}


def meter_of(relay: Relay, robot: Robot) -> Meter:
    """Usage of relay, daemon and simulator."""
    assert relay.process is not None
    return Meter(relay=relay.process.popen.pid, daemon=robot.daemon.popen.pid, sim=robot.sim.popen.pid)


def status_of(relay: Relay, robot: str) -> dict[str, Any]:
    """A robot in ``switchboard status``."""
    return next(dict(each) for each in relay.cli("status")["robots"] if each["name"] == robot)
