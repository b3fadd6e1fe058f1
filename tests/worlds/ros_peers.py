"""ROS 2 nodes in a robot's graph that publish and subscribe on request."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.worlds.processes import ros_environment
from tests.worlds.waiting import PATIENCE, wait_for

SCRIPT = Path(__file__).parents[1] / "e2e" / "clients" / "speaking.py"
LATCHED = {"depth": 1, "durability": "transient_local"}


class Speakers:
    """Any number of nodes in one process."""

    def __init__(self, domain: int) -> None:
        self.record: list[dict[str, Any]] = []
        self._process = subprocess.Popen(
            [sys.executable, str(SCRIPT)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=ros_environment(domain),
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        wait_for("nodes are there", self._ready)

    def publish(self, node: str, topic: str, *texts: str, **qos: Any) -> None:
        """Publishes; the first call of a node sets the options."""
        self._do("publish", node, topic, qos or LATCHED, texts)

    def subscribe(self, node: str, topic: str, **qos: Any) -> None:
        self._do("subscribe", node, topic, qos)

    def serve(self, node: str, service: str, **qos: Any) -> None:
        """Offers a Trigger."""
        self._do("serve", node, service, qos)

    def end(self, node: str) -> None:
        """Removes a node from the graph."""
        self._do("end", node)

    def heard(self, node: str) -> list[str]:
        """Texts that a node has received so far."""
        return [each["text"] for each in list(self.record) if each.get("node") == node]

    def _do(self, *what: Any) -> None:
        assert self._process.stdin is not None
        done = self._done()
        self._process.stdin.write(json.dumps(what) + "\n")
        self._process.stdin.flush()
        deadline = time.monotonic() + PATIENCE
        while self._done() == done:
            assert self._process.poll() is None, "the nodes have ended"
            assert time.monotonic() < deadline
            time.sleep(0.005)  # the expected event comes from another process

    def _ready(self) -> bool:
        assert self._process.poll() is None, "the nodes have ended"
        return any("ready" in each for each in list(self.record))

    def _done(self) -> int:
        return sum("done" in each for each in list(self.record))

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.startswith("{"):
                self.record.append(json.loads(line))

    def close(self) -> None:
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.close()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._reader.join(5)
        self._process.stdout.close()


@contextmanager
def speakers(domain: int) -> Iterator[Speakers]:
    """Nodes for the duration of a block."""
    made = Speakers(domain)
    try:
        yield made
    finally:
        made.close()
