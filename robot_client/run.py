"""Builds the daemon with all its parts, starts and stops it: its composition root."""

from __future__ import annotations

import os
import secrets
import time
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

from twisted.internet.defer import Deferred, DeferredList
from twisted.internet.threads import deferToThread, deferToThreadPool
from twisted.logger import Logger
from twisted.python.threadpool import ThreadPool

from relay_protocol.clocks import now_ns
from relay_protocol.errors import Unavailable
from robot_client.address_changes import AddressChanges
from robot_client.addresses import CHECK_SECONDS
from robot_client.camera.ipc import CameraSettings
from robot_client.camera.service import DaemonCameras
from robot_client.camera.supervisor import CameraSupervisor
from robot_client.config import RobotSettings
from robot_client.daemon import Daemon
from robot_client.device_state.manager import DeviceManager
from robot_client.device_state.readings import DeviceReadings
from robot_client.files.confirmed import ConfirmedFiles
from robot_client.files.uploader import FileUploader
from robot_client.link.addresses import RelayAddresses
from robot_client.link.backoff import Backoff
from robot_client.link.control_connection import ControlConnection
from robot_client.link.enrolment import Enrolment
from robot_client.link.links import ControlLink, Identity
from robot_client.link.tls import endpoint, split_address
from robot_client.modules.local_orders import LocalOrderServer
from robot_client.modules.processes import boot_id
from robot_client.modules.relay_requests import ModuleRequests
from robot_client.modules.supervisor import ModuleSupervisor
from robot_client.motion.guard_port import NoGuard
from robot_client.motion.guard_supervisor import GuardSupervisor
from robot_client.motion.hardware import Hardware
from robot_client.motion.stop_store import StopStore
from robot_client.offload.device import STATE_VARIABLE
from robot_client.periodic import PeriodicTasks, run_safely
from robot_client.platforms.base import Platform
from robot_client.systemd import Notifier
from robot_client.twisted_types import DialEndpoint

SHUTDOWN_SECONDS = 4.0
"""Longest time from :meth:`DaemonProcess.stop` until the platform is stopped."""


def agent() -> str:
    """Name and version of this software."""
    try:
        return f"switchboard-robot {metadata.version('robot-switchboard')}"
    except metadata.PackageNotFoundError:
        return "switchboard-robot"


FILE_THREADS = 2
"""Threads that read and hash files."""


class DaemonProcess:
    """The daemon with all its parts: platform, guard, cameras, modules.

    :param reactor: its clock must be monotonic
    :param stop_store: stores a stop for the next start
    :param modules: folder of the modules' logs and runs
    :param platform: ``None`` for ROS 2
    """

    def __init__(
        self,
        reactor: Any,
        settings: RobotSettings,
        enrolment: Enrolment,
        identity: Identity,
        stop_store: StopStore,
        modules: Path,
        platform: Platform | None = None,
    ) -> None:
        suffix = secrets.token_hex(3)
        self.reactor = reactor
        self._enrolment = enrolment
        self._addresses = RelayAddresses(enrolment.address)
        self._file_threads = ThreadPool(1, FILE_THREADS, "files")
        self._log = Logger("daemon")
        self.platform = platform or build_ros_platform(reactor, settings, suffix)
        self.guard = build_guard(reactor, settings, suffix) if settings.safety.guard else None
        self.cameras = build_cameras(reactor, settings, enrolment, suffix)
        connection = self._build_connection(identity)
        self.modules = self._build_modules(settings, modules)
        self._local_orders = LocalOrderServer(self.modules, modules)
        self.device = self._build_device(settings, modules.parent, connection)
        requests = ModuleRequests(
            self.modules,
            modules,
            send=connection.send,
            clock=reactor,
            in_thread=lambda *work: deferToThreadPool(reactor, reactor.getThreadPool(), *work),
            other_roots=self._process_roots,
            wall=time.time,
        )
        self.daemon = Daemon(
            settings=settings,
            connection=connection,
            platform=self.platform,
            guard=self.guard or NoGuard(),
            cameras=self._build_cameras(settings, connection),
            modules=requests,
            files=self._build_files(settings, modules.parent, connection),
            device=self.device,
            stop_store=stop_store,
            hardware=Hardware(settings.safety.switches, self.platform, reactor),
            clock=reactor,
            dial=self._dial,
            agent=agent(),
        )
        self._address_changes = PeriodicTasks(
            [(AddressChanges(self, alert=self._alert).check, CHECK_SECONDS)]
            if self.platform.depends_on_addresses()
            else [],
            reactor,
        )
        self._notifier = Notifier(reactor, os.environ, lambda: self.platform.fault() is None)

    def start(self, before_modules: Callable[[], object] = lambda: None) -> None:
        """Start everything.

        :param before_modules: called before the first module is taken over or started
        :raises Unavailable: the platform can't start
        """
        self.platform.start()
        self.cameras.on_alert = self.platform.on_alert = self.daemon.alert
        if self.guard is not None:
            self.guard.on_alert = self.daemon.alert
            self.guard.start()
        self._file_threads.start()
        run_safely(self._log, "the robot's computer can't be measured", self.device.measure)
        self.daemon.start()
        before_modules()
        run_safely(self._log, "the modules can't be started", self.modules.start)
        self._local_orders.start(self.reactor)
        self._address_changes.start()
        self._notifier.start()

    def stop(self) -> Deferred[Any]:
        """Stop the robot and everything else, within :data:`SHUTDOWN_SECONDS` even if a part hangs."""
        self._log.info("shutting down")
        self._notifier.stop()
        self._address_changes.stop()
        stopping: list[Deferred[Any]] = [self.daemon.stop(), self.cameras.stop(), self.modules.stop()]
        stopping.append(self._local_orders.stop())
        if self.guard is not None:
            # The guard runs until the last zero is published, then cancels the remaining goals.
            stop_guard = self.guard.stop
            stopping.append(self.daemon.motion_ended().addCallback(lambda _: stop_guard()))
        stopped = DeferredList(stopping, consumeErrors=True)
        stopped.addTimeout(SHUTDOWN_SECONDS, self.reactor)
        stopped.addBoth(lambda _: deferToThread(self._file_threads.stop))
        return stopped.addBoth(lambda _: self.platform.stop())

    @property
    def is_idle(self) -> bool:
        """See :class:`~robot_client.address_changes.RenewableRobot`."""
        return self.daemon.is_idle

    @property
    def nodes(self) -> frozenset[str]:
        """See :class:`~robot_client.address_changes.RenewableRobot`."""
        return self.platform.graph().nodes

    def release_platform(self, reason: str) -> Deferred[Any]:
        """See :class:`~robot_client.address_changes.RenewableRobot`."""
        return self.daemon.release_platform(reason)

    def renew_platform(self, reason: str) -> None:
        """See :class:`~robot_client.address_changes.RenewableRobot`."""
        self.daemon.renew_platform(reason)
        self.cameras.renew()
        if self.guard is not None:
            self.guard.renew()

    def _alert(self, level: str, text: str, kind: str = "", about: str = "", over: bool = False) -> None:
        self.daemon.alert(level, text, kind, about, over)

    def _process_roots(self) -> dict[int, str]:
        roots = {os.getpid(): "daemon"}
        for part, pid in (
            ("guard", None if self.guard is None else self.guard.pid),
            ("camera", self.cameras.pid),
        ):
            if pid is not None:
                roots[pid] = part
        return roots

    def _build_connection(self, identity: Identity) -> ControlConnection:
        return ControlConnection(
            dial=self._dial,
            build_link=lambda: ControlLink(identity, agent(), now_ns),
            clock=self.reactor,
            backoff=Backoff(secrets.SystemRandom().random),
            robot=identity.robot,
            addresses=self._addresses,
        )

    def _build_device(
        self, settings: RobotSettings, state: Path, connection: ControlConnection
    ) -> DeviceManager:
        folders = (state, *(Path(each.folder) for each in settings.file_group))
        return DeviceManager(
            settings.offload,
            DeviceReadings(folders, self.platform.battery),
            state,
            send=connection.send,
            publish=self.platform.publish_device,
            alert=self._alert,
        )

    def _build_modules(self, settings: RobotSettings, folder: Path) -> ModuleSupervisor:
        return ModuleSupervisor(
            settings.module,
            folder,
            reactor=self.reactor,
            # Programs find the robot's key and the state of its computer there (robot_client.offload).
            environment={**os.environ, STATE_VARIABLE: str(folder.parent.absolute())},
            graph=self.platform,
            alert=self._alert,
            boot=boot_id(),
        )

    def _build_cameras(self, settings: RobotSettings, connection: ControlConnection) -> DaemonCameras:
        return DaemonCameras(
            settings.cameras,
            self.cameras,
            connection.send,
            self.reactor,
            address=lambda: self._addresses.current,
        )

    def _build_files(
        self, settings: RobotSettings, state: Path, connection: ControlConnection
    ) -> FileUploader:
        return FileUploader(
            settings.file_group,
            ConfirmedFiles(state / "confirmed-files.db"),
            send=connection.send,
            dial=self._dial,
            clock=self.reactor,
            in_thread=lambda *work: deferToThreadPool(self.reactor, self._file_threads, *work),
            full=lambda: self.device.full,
            now=now_ns,
            alert=self._alert,
        )

    def _dial(self, address: str) -> DialEndpoint:
        own = self._enrolment
        host, port = split_address(address or self._addresses.current)
        return endpoint(self.reactor, host, port, own.tls, own.ca, own.server_name)


def build_ros_platform(reactor: Any, settings: RobotSettings, suffix: str) -> Platform:
    """The ROS 2 platform.

    :param suffix: ends the names of this run's nodes, so that DDS does not take them for those of an
        earlier run
    :raises Unavailable: rclpy is not installed
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


def build_guard(reactor: Any, settings: RobotSettings, suffix: str) -> GuardSupervisor:
    """The supervisor of the guard process."""
    safety = settings.safety
    return GuardSupervisor(
        reactor,
        f"switchboard_guard_{suffix}",
        safety.stop_within_ms,
        settings.ros.use_sim_time,
        {each.name: safety.times(each.name).stop_within_ms for each in safety.topic},
    )


def build_cameras(
    reactor: Any, settings: RobotSettings, enrolment: Enrolment, suffix: str
) -> CameraSupervisor:
    """The supervisor of the camera process."""
    return CameraSupervisor(
        reactor,
        CameraSettings(
            address=RelayAddresses(enrolment.address).current,
            tls=enrolment.tls,
            ca=enrolment.ca,
            server_name=enrolment.server_name,
            # Starts like the name of the daemon's node, so that it is left out of the graph too.
            node=f"switchboard_{suffix}_camera",
            streams=settings.video.max_streams,
            target=settings.video.target_delay_ms / 1000,
        ),
    )
