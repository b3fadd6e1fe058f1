"""The daemon's clock."""

from __future__ import annotations

from twisted.internet.task import Clock

from relay_protocol import identity
from relay_protocol.clocks import now_ns
from robot_client.config import RobotSettings, SafetySettings
from robot_client.link.identity import Enrolment
from robot_client.link.protocol import Identity
from robot_client.motion.stop_store import MemoryStopStore
from robot_client.platforms.memory import MemoryPlatform
from robot_client.run import Runner


def test_the_daemon_judges_commands_by_it() -> None:
    """The daemon, and with it every link's estimate and the watchdog, reads this clock."""
    me = Identity("r1", "relay-1", identity.generate_key())
    enrolment = Enrolment(relay="relay-1", robot="r1", address="127.0.0.1:1", tls=False)
    runner = Runner(
        Clock(),
        RobotSettings(safety=SafetySettings(guard=False)),
        enrolment,
        me,
        MemoryStopStore(),
        MemoryPlatform(),
    )
    assert runner.daemon._now is now_ns
    assert runner.daemon.motion._now is now_ns
