"""The daemon's clock."""

from __future__ import annotations

from pathlib import Path

from twisted.internet.task import Clock

from relay_protocol import identity
from relay_protocol.clocks import now_ns
from robot_client.config import RobotSettings, SafetySettings
from robot_client.link.enrolment import Enrolment
from robot_client.link.links import Identity
from robot_client.motion.stop_store import MemoryStopStore
from robot_client.run import DaemonProcess
from tests.worlds.memory_platform import MemoryPlatform


def test_daemon_and_motion_use_the_shared_clock() -> None:
    me = Identity("r1", "relay-1", identity.generate_key())
    enrolment = Enrolment(relay="relay-1", robot="r1", address="127.0.0.1:1", tls=False)
    process = DaemonProcess(
        Clock(),
        RobotSettings(safety=SafetySettings(guard=False)),
        enrolment,
        me,
        MemoryStopStore(),
        Path("/nowhere"),
        MemoryPlatform(),
    )
    assert process.daemon._now is now_ns
    assert process.daemon.motion._now is now_ns
