"""A real robot for measurements: the daemon, a ROS 2 publisher, and a count of the bytes between daemon and relay."""

from __future__ import annotations

import contextlib
import json
import socket
import subprocess
import sys
import threading
from typing import Any

from switchboard_domains import free_domain
from switchboard_processes import BIN, Process, ros_environment
from switchboard_proxy import ChaosProxy
from switchboard_waiting import wait_for

from bench import ROOT
from bench.relay import Relay
from bench.report import Unavailable

SETTLE_SECONDS = 8.0
"""A daemon that has just come up is busy for some seconds with what it finds."""


class CountingProxy(ChaosProxy):
    """A proxy between robot and relay that counts what comes from the robot."""

    def __init__(self, target: int) -> None:
        self.up = 0
        self._relay = target
        super().__init__(target)

    def _pump(self, source: socket.socket, sink: socket.socket, gate: threading.Event) -> None:
        if gate is not self.forward_up:
            super()._pump(source, sink, gate)
            return
        try:
            while data := source.recv(1 << 18):
                sink.sendall(data)
                self.up += len(data)
        except OSError:
            pass
        finally:
            for each in (source, sink):
                with contextlib.suppress(OSError):
                    each.shutdown(socket.SHUT_RDWR)
            source.close()


class Publisher:
    """``bench/ros_publisher.py``, running.

    :param streams: as it takes them
    """

    def __init__(self, environment: dict[str, str], streams: list[dict[str, Any]]) -> None:
        self._popen = subprocess.Popen(
            [sys.executable, "-m", "bench.ros_publisher", json.dumps(streams)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
            cwd=ROOT,
        )
        assert self._popen.stdout is not None
        if self._popen.stdout.readline().strip() != "READY":
            self.stop()
            raise Unavailable("the ROS 2 publisher does not start; see above")

    def sent(self) -> dict[str, int]:
        """Messages published so far, by topic."""
        assert self._popen.stdin is not None and self._popen.stdout is not None
        self._popen.stdin.write("\n")
        self._popen.stdin.flush()
        return dict(json.loads(self._popen.stdout.readline()))

    def stop(self) -> None:
        """End and reap it."""
        assert self._popen.stdin is not None and self._popen.stdout is not None
        self._popen.stdin.close()
        try:
            self._popen.wait(10)
        except subprocess.TimeoutExpired:
            self._popen.kill()
            self._popen.wait()
        self._popen.stdout.close()


class RealRobot:
    """A daemon, enrolled and online, in a ROS domain of its own, with a publisher beside it."""

    def __init__(self, relay: Relay, name: str, streams: list[dict[str, Any]]) -> None:
        self.name = name
        self.relay = relay
        self.folder = relay.folder / name
        self.folder.mkdir()
        self.environment = ros_environment(free_domain())
        self.proxy = CountingProxy(relay.robots_port)
        self.publisher = Publisher(self.environment, streams)
        state = str(self.folder / "state")
        code = relay.cli("robot", "add", name)["enrolment_code"]
        enroll = [str(BIN / "switchboard-robot"), "enroll", "--relay", f"127.0.0.1:{self.proxy.port}"]
        enroll += ["--robot", name, "--code", "-", "--state", state]
        subprocess.run(enroll, input=code, text=True, capture_output=True, timeout=60, check=True)
        run = [str(BIN / "switchboard-robot"), "run", "--state", state]
        self.daemon = Process(run, self.folder, "daemon", self.environment)
        wait_for(f"{name} is online", lambda: relay.state_of(name) != "offline", 30)

    @property
    def pid(self) -> int:
        """The daemon; its guard is its child."""
        return self.daemon.popen.pid

    def viewer(self, user: str) -> str:
        """A token of somebody who may watch."""
        token = self.relay.user(user)
        self.relay.cli("right", "grant", user, self.name, "viewer")
        return token

    def stop(self) -> None:
        """End all."""
        self.daemon.stop()
        self.publisher.stop()
        self.proxy.close()
