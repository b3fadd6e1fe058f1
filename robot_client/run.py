"""The one place where the daemon is put together."""

from __future__ import annotations

import os
import secrets
from importlib import metadata
from typing import Any

from twisted.internet.defer import Deferred, DeferredList
from twisted.logger import Logger

from relay_protocol.clocks import now_ns
from relay_protocol.errors import Unavailable
from robot_client.camera.ipc import CameraSettings
from robot_client.camera.service import DaemonCameras
from robot_client.camera.supervisor import CameraSupervisor
from robot_client.config import RobotSettings
from robot_client.daemon import Daemon
from robot_client.link.backoff import Backoff
from robot_client.link.connection import ControlConnection
from robot_client.link.identity import Enrolment
from robot_client.link.protocol import ControlLink, Identity
from robot_client.link.tls import endpoint, split_address
from robot_client.motion.guard_port import NoGuard
from robot_client.motion.guard_supervisor import GuardSupervisor
from robot_client.motion.hardware import Hardware
from robot_client.motion.stop_store import StopStore
from robot_client.platforms.base import Platform
from robot_client.systemd import Notifier
from robot_client.twisted_types import DialEndpoint

LEAVE_SECONDS = 4.0


def agent() -> str:
    """Name and version of this software."""
    try:
        return f"switchboard-robot {metadata.version('robot-switchboard')}"
    except metadata.PackageNotFoundError:
        return "switchboard-robot"


def make_ros(reactor: Any, settings: RobotSettings, suffix: str) -> Platform:
    """The ROS 2 platform.

    :raises Unavailable: there is no rclpy
    """
    try:
        from robot_client.platforms.ros2.platform import Ros2Platform
    except ImportError as error:
        raise Unavailable(
            f"no ROS 2 found ({error}): source /opt/ros/<distro>/setup.bash or install the extra 'ros'"
        ) from None
    return Ros2Platform(
        reactor,
        f"switchboard_{suffix}",
        guard=f"switchboard_guard_{suffix}",
        executor=settings.ros.executor,
        battery=settings.ros.battery,
        sim_time=settings.ros.use_sim_time,
        diagnostics=settings.monitor.diagnostics,
    )


class Runner:
    """One run of the daemon.

    :param reactor: its clock must be monotonic
    :param latch: where a stop is kept
    """

    def __init__(
        self,
        reactor: Any,
        settings: RobotSettings,
        enrolment: Enrolment,
        me: Identity,
        latch: StopStore,
        platform: Platform | None = None,
    ) -> None:
        suffix = secrets.token_hex(3)
        self.reactor = reactor
        self.platform = platform or make_ros(reactor, settings, suffix)
        self.keeper: GuardSupervisor | None = None
        if settings.safety.guard:
            self.keeper = GuardSupervisor(
                reactor,
                f"switchboard_guard_{suffix}",
                settings.safety.stop_within_ms,
                settings.ros.use_sim_time,
                {
                    each.name: settings.safety.times(each.name).stop_within_ms
                    for each in settings.safety.topic
                },
            )
        self.cameras = CameraSupervisor(
            reactor,
            CameraSettings(
                address=enrolment.address,
                tls=enrolment.tls,
                ca=enrolment.ca,
                server_name=enrolment.server_name,
                # Begins like the daemon's own, so that the graph is told without it.
                node=f"switchboard_{suffix}_camera",
                streams=settings.video.streams,
                target=settings.video.target_ms / 1000,
            ),
        )
        self._enrolment = enrolment
        connection = ControlConnection(
            self._dial,
            lambda: ControlLink(me, agent(), now_ns),
            reactor,
            Backoff(secrets.SystemRandom().random),
            me.robot,
            enrolment.address,
        )
        self.daemon = Daemon(
            settings,
            connection,
            self.platform,
            self.keeper or NoGuard(),
            DaemonCameras(settings.cameras, self.cameras, connection.say, reactor),
            latch,
            Hardware(settings.safety.switches, self.platform, reactor),
            reactor,
            self._dial,
            agent(),
            now_ns,
        )
        self._notifier = Notifier(reactor, os.environ, lambda: self.platform.trouble() is None)
        self._log = Logger("daemon")

    def start(self) -> None:
        """Begin.

        :raises Unavailable: the platform can't start
        """
        self.platform.start()
        self.cameras.on_alert = self.platform.on_alert = self.daemon.alert
        if self.keeper is not None:
            self.keeper.on_alert = self.daemon.alert
            self.keeper.start()
        self.daemon.start()
        self._notifier.start()

    def stop(self) -> Deferred[Any]:
        """Stop the robot and leave, within seconds whatever hangs."""
        self._log.info("leaving")
        self._notifier.stop()
        leaving: list[Deferred[Any]] = [self.daemon.stop(), self.cameras.stop()]
        if self.keeper is not None:
            # It watches until the last zero is said, and ends the goals that are left then.
            leave = self.keeper.stop
            leaving.append(self.daemon.settled().addCallback(lambda _: leave()))
        gone = DeferredList(leaving, consumeErrors=True)
        gone.addTimeout(LEAVE_SECONDS, self.reactor)
        return gone.addBoth(lambda _: self.platform.stop())

    def _dial(self, address: str) -> DialEndpoint:
        host, port = split_address(address or self._enrolment.address)
        own = self._enrolment
        return endpoint(self.reactor, host, port, own.tls, own.ca, own.server_name)
