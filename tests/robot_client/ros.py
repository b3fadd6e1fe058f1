"""Shared by tests with real ROS: a domain of their own, a peer process."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from twisted.internet import reactor, task

from tests.worlds.ros_domains import free_domain
from tests.worlds.waiting import freeze

PATIENCE = 60.0
CONFORMANCE = Path(__file__).parents[1] / "conformance"


@contextmanager
def domain() -> Iterator[dict[str, str]]:
    """An environment with an unused ROS domain, set for this process too."""
    ours = {"ROS_DOMAIN_ID": str(free_domain()), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    before = {name: os.environ.get(name) for name in ours}
    os.environ.update(ours)
    try:
        yield dict(os.environ)
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


async def until(true: Callable[[], Any], timeout: float = PATIENCE) -> None:
    """Runs the reactor until the condition holds."""
    deadline = time.monotonic() + timeout
    while not true():
        assert time.monotonic() < deadline, f"waited {timeout} s in vain"
        await task.deferLater(reactor, 0.02)


class Peer:
    """A node in another process."""

    def __init__(self, environment: dict[str, str]) -> None:
        self.record: list[dict[str, Any]] = []
        paths = os.pathsep.join(filter(None, (str(CONFORMANCE), environment.get("PYTHONPATH"))))
        self._process = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("ros_peer.py"))],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**environment, "PYTHONPATH": paths},
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        self.until(lambda: any("ready" in each for each in self.record))

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.startswith("{"):
                self.record.append(json.loads(line))
            else:  # the middleware's log, which warns of other processes' files
                sys.stderr.write(line)

    def do(self, *what: Any) -> None:
        """Runs a command, and waits until it is done."""
        assert self._process.stdin is not None
        done = len([each for each in self.record if "done" in each])
        self._process.stdin.write(json.dumps(what) + "\n")
        self._process.stdin.flush()
        self.until(lambda: len([each for each in self.record if "done" in each]) > done)

    def heard(self, topic: str) -> list[dict[str, Any]]:
        """Messages received on a topic so far."""
        return [each for each in list(self.record) if each.get("topic") == topic]

    def reported(self, what: str, name: str) -> list[dict[str, Any]]:
        """Reports about a name so far."""
        return [each for each in list(self.record) if each.get(what) == name]

    def kill(self) -> None:
        """Kills it, as a crash would."""
        self._process.kill()
        self._process.wait()
        self._finish()

    @contextmanager
    def frozen(self) -> Iterator[None]:
        """Freezes it for a while."""
        freeze(self._process.pid)
        try:
            yield
        finally:
            self._process.send_signal(signal.SIGCONT)

    def until(self, true: Callable[[], Any], timeout: float = PATIENCE) -> None:
        deadline = time.monotonic() + timeout
        while not true():
            assert self._process.poll() is None, "the peer ended"
            assert time.monotonic() < deadline, f"waited {timeout} s in vain"
            time.sleep(0.01)  # the expected event comes from another process

    def close(self) -> None:
        assert self._process.stdin is not None
        if self._process.stdin.closed:
            return
        self._process.stdin.close()
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._finish()

    def _finish(self) -> None:
        self._reader.join(5)
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        self._process.stdout.close()
