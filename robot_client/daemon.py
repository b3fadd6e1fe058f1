"""The daemon: opens channels for the relay, carries out its orders, reports the robot's graph and health.

Channels are in :mod:`robot_client.channel.channel`, motion is in :mod:`robot_client.motion`, and the control link in
:mod:`robot_client.link.control_connection`.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from twisted.internet.defer import CancelledError, Deferred
from twisted.internet.protocol import Factory
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_protocol import link
from relay_protocol.clocks import now_ns
from relay_protocol.errors import SwitchboardError
from relay_protocol.limits import HEARTBEAT_SECONDS, MIB, ROBOT_FRAME
from robot_client.alerts import CONTROL, MODULE, AlertReporter
from robot_client.camera.service import DaemonCameras
from robot_client.channel.channel import ChannelConnection, RobotChannel
from robot_client.config import RobotSettings
from robot_client.device_state.manager import DeviceManager
from robot_client.files.uploader import FileUploader
from robot_client.graph_chunks import graph_chunks
from robot_client.link.control_connection import ControlConnection, Dial
from robot_client.link.links import ChannelLink
from robot_client.link.tls import explain
from robot_client.link.transport import LinkLost, LinkProtocol
from robot_client.machine import Machine, operating_system
from robot_client.modules.relay_requests import ModuleRequests
from robot_client.motion.active_goals import GOALS_END_SECONDS, ActiveGoals
from robot_client.motion.authority import Authority
from robot_client.motion.goal_canceller import GoalCanceller
from robot_client.motion.goal_topics import GoalTopics
from robot_client.motion.graph_zero_publisher import GraphZeroPublisher
from robot_client.motion.guard_port import GuardPort
from robot_client.motion.hardware import Hardware
from robot_client.motion.limits import limits_by_level
from robot_client.motion.link_loss_alert import LinkLossAlert
from robot_client.motion.motion_control import MotionControl
from robot_client.motion.order_handler import CHECK_EVERY, ControlOrderHandler
from robot_client.motion.request_gate import MotionRequestGate
from robot_client.motion.robot_port import RobotPort
from robot_client.motion.rules import rules_of
from robot_client.motion.stop_store import StopStore
from robot_client.periodic import PeriodicTasks, run_safely
from robot_client.platforms.base import GraphView, Platform, full_graph, graph_changes

MAX_CHANNELS = 64

SETTLE_SECONDS = 5.0
"""Seconds in which a new participant discovers the nodes that the one before knew."""


class Daemon(RobotPort):
    """Connects one platform to the relay.

    :param stop_store: stores a stop for the next start
    :param hardware: further means to stop the robot
    :param dial: gives the endpoint of an address
    :param agent: name and version of this software
    :param now: clock of :mod:`relay_protocol.clocks`, nanoseconds
    """

    def __init__(
        self,
        *,
        settings: RobotSettings,
        connection: ControlConnection,
        platform: Platform,
        guard: GuardPort,
        cameras: DaemonCameras,
        modules: ModuleRequests,
        files: FileUploader,
        device: DeviceManager,
        stop_store: StopStore,
        hardware: Hardware,
        clock: Any,
        dial: Dial,
        agent: str,
        now: Callable[[], int] = now_ns,
    ) -> None:
        self._settings = settings
        self._connection = connection
        self._platform = platform
        self._cameras = cameras
        self._modules = modules
        self._files = files
        self._device = device
        self._clock = clock
        self._dial = dial
        self._agent = agent
        self._now = now
        self._started = time.time()
        self._channels: dict[str, ChannelConnection] = {}
        self._dialling: dict[str, Deferred[Any]] = {}
        self._dropped_by_closed_channels = 0
        self._heartbeat = HEARTBEAT_SECONDS
        self._frame_limit = ROBOT_FRAME
        self._sample_limit = 0
        self._reported_graph: GraphView | None = None
        self._alerts = AlertReporter(connection, now)
        self._link_loss = LinkLossAlert(now)
        self._machine = Machine()
        self._platform_faulty = False
        self._graph_settles_at = clock.seconds()
        """Until then changes of the graph are not reported, as the platform does not know all of it."""
        self._log = Logger("daemon")
        self._build_motion(guard, stop_store, hardware)
        tasks = [
            (self._check_platform, 1.0 / settings.ros.graph_hz),
            (self.order_handler.check, CHECK_EVERY),
            (self._active_goals.retry_cancels, CHECK_EVERY),
            (files.check, 1.0),
            (device.measure, device.cycle_seconds),
            (self._report_health, settings.monitor.health_seconds),
        ]
        self._tasks = PeriodicTasks(tasks, clock)
        connection.listener = self

    def _build_motion(self, guard: GuardPort, stop_store: StopStore, hardware: Hardware) -> None:
        settings, connection, platform = self._settings, self._connection, self._platform
        clock, now = self._clock, self._now
        policy = settings.safety.policy
        self.authority = Authority()
        self.motion = MotionControl(policy, platform, clock, now, guard, self.authority, rules_of(settings))
        goal_canceller = GoalCanceller(policy, platform, clock)
        self._graph_zero_publisher = GraphZeroPublisher(policy, platform, clock, self.motion.may_be_commanded)
        self.order_handler = ControlOrderHandler(
            authority=self.authority,
            motion=self.motion,
            stop_store=stop_store,
            hardware=hardware,
            goal_canceller=goal_canceller,
            graph_zero_publisher=self._graph_zero_publisher,
            robot=self,
            clock=clock,
            now=now,
            wall=time.time,
        )
        self.order_handler.limits = limits_by_level(settings)
        self.order_handler.on_stopped = self._modules.robot_stopped
        self._modules.robot_stopped(self.authority.stopped is not None)
        self._active_goals = ActiveGoals(policy.actions, guard, goal_canceller, stop_store, clock, now)
        self.motion.link_proven_at = self._active_goals.link_proven_at = lambda: connection.answered or 0
        self.motion.on_motion_inputs_changed = connection.ping_often
        self._active_goals.on_active = self._motion_goals_active
        self._active_goals.on_changed = self.order_handler.state_changed
        self._gate = MotionRequestGate(policy, platform, self.authority, now, settings.safety.stop_service)
        self._goal_topics = GoalTopics(
            settings.safety.goal_topics, platform, self.authority, self.motion, clock, now
        )

    def start(self) -> None:
        """Start; the platform must be running."""
        self._tasks.start()
        self._connection.start()

    def stop(self) -> Deferred[Any]:
        """Stop the robot, then disconnect; fires when all connections are closed."""
        reason = "the robot's daemon is shutting down"
        self.motion.stop_moving_topics(reason)
        self._tasks.stop()
        self._close_channels(reason)
        self._files.stop(reason)
        motion_ended = self.motion_ended()
        closed = self._connection.stop(reason)
        return closed.addBoth(lambda result: motion_ended.addCallback(lambda _: result))

    def motion_ended(self) -> Deferred[Any]:
        """Fires when every zero is published, and all goals have ended or :data:`GOALS_END_SECONDS` are over."""
        goals = self._active_goals.goals_ended(GOALS_END_SECONDS)
        return self.motion.all_zeros_published().addCallback(lambda _: goals)

    @property
    def is_idle(self) -> bool:
        """Whether the robot stands still, and no call or goal is under way."""
        return (
            self.motion.is_still
            and not self._active_goals.active_actions
            and not self._graph_zero_publisher.is_busy
            and not any(each.channel.is_busy for each in self._channels.values())
        )

    def release_platform(self, reason: str) -> Deferred[Any]:
        """Close all channels, which the relay opens again; fires when their motion has ended."""
        self._close_channels(reason)
        return self.motion_ended()

    def renew_platform(self, reason: str) -> None:
        """Make the platform again; channels that were opened meanwhile are closed."""
        self._close_channels(reason)
        self._graph_settles_at = self._clock.seconds() + SETTLE_SECONDS
        self._platform.renew()

    def alert(self, level: str, text: str, kind: str = "", about: str = "", over: bool = False) -> None:
        """Log and report an alert, see :class:`~robot_client.alerts.OnAlert`."""
        {"error": self._log.error, "warning": self._log.warn}.get(level, self._log.info)("{text}", text=text)
        self._alerts.report(link.Alert(level=level, text=text, kind=kind, about=about, over=over))

    # --- control link --------------------------------------------------------------------------------------

    def on_link_up(self, welcome: link.Welcome) -> None:
        """Describe the robot to the relay."""
        self._heartbeat = welcome.heartbeat
        self._frame_limit = welcome.frame_limit
        self._sample_limit = min(welcome.sample_limit, self._settings.ros.largest_sample_mb * MIB)
        self._connection.send(self._description())
        self._alerts.registered()
        self._reported_graph = self._read_graph() or GraphView()
        self._send_graph(full_graph(self._reported_graph))
        self.order_handler.registered()
        self._cameras.update_graph(self._reported_graph)
        self._cameras.registered(welcome.heartbeat)
        self._modules.registered()
        self._files.registered(welcome.heartbeat)
        self._device.registered()
        self._report_health()

    def on_message(self, message: link.Message) -> None:
        """Carry out an order about control or modules, or open or close another link."""
        if self.order_handler.handle(message) or self._modules.handle(message):
            return
        if isinstance(message, link.OpenChannel):
            self._open_channel(message)
        elif isinstance(message, link.CloseChannel):
            self._close_channel(message.channel, "no client uses this channel any more")
        elif isinstance(message, link.OpenVideo):
            self._cameras.open(message)
        elif isinstance(message, link.CloseVideo):
            self._cameras.close(message)
        elif isinstance(message, link.OpenFileLink):
            self._files.open(message)

    def on_link_lost(self, reason: str, proved: int | None) -> None:
        """Stop the robot, since no client can control it; the relay opens channels again when the link is back."""
        driver = self._link_loss.driver_at_loss(proved)  # before zero is published, which changes it
        failed = "a step after the loss of the control link failed"
        run_safely(self._log, failed, self.order_handler.link_lost)
        run_safely(self._log, failed, self.motion.stop_moving_topics, "the control link is lost", True)
        self._reported_graph = None
        self._close_channels(reason)
        if driver is not None:
            text = (
                f"{driver or 'a client'} lost control while the robot moved: its link to the relay was lost"
            )
            run_safely(self._log, failed, self.alert, "error", text, CONTROL)
        self._cameras.link_lost(reason)
        self._device.link_lost()
        run_safely(self._log, failed, self._files.link_lost, reason)

    # --- for the control order handler -------------------------------------------------------------------------

    def send(self, message: link.Message) -> None:
        """See :class:`~robot_client.motion.robot_port.RobotPort`."""
        if isinstance(message, link.MotionState):
            self._link_loss.note_state(message, self.authority.user)
        self._connection.send(message)

    def find_topic(self, name: str) -> tuple[str, list[str]]:
        """See :class:`~robot_client.motion.robot_port.RobotPort`."""
        full = self._platform.full_name(name, "topic")
        found = self._reported_graph.topics.get(full) if self._reported_graph else None
        if found is None:  # a topic that has just appeared is not in the reported graph yet
            view = self._read_graph()
            found = view.topics.get(full) if view else None
        return full, found.types if found else []

    def cancel_goals(self, only_moving: bool) -> None:
        """Cancel the goals of all channels.

        :param only_moving: whether goals that don't move the robot continue
        """
        for connection in self._channels.values():
            connection.channel.cancel_goals(only_moving)

    def goals_ended(self, seconds: float) -> Deferred[list[str]]:
        """See :class:`~robot_client.motion.robot_port.RobotPort`."""
        return self._active_goals.goals_ended(seconds)

    @property
    def active_actions(self) -> list[str]:
        """See :class:`~robot_client.motion.robot_port.RobotPort`."""
        return self._active_goals.active_actions

    @property
    def uncancelled_actions(self) -> list[str]:
        """See :class:`~robot_client.motion.robot_port.RobotPort`."""
        return self._active_goals.uncancelled_actions

    def _motion_goals_active(self, active: bool) -> None:
        self._graph_zero_publisher.keep_ready(active)
        if active:
            self.motion.add_motion_input("goals")
        else:
            self.motion.remove_motion_input("goals")

    def update_inhibition(self, topic: str) -> None:
        """Apply the beginning or end of a topic's inhibition."""
        for connection in self._channels.values():
            connection.channel.update_inhibition(topic)
        self._cameras.inhibit(self.order_handler.inhibited)

    # --- channels ------------------------------------------------------------------------------------------

    def _open_channel(self, message: link.OpenChannel) -> None:
        self._close_channel(message.channel, "the relay opened it again")
        if len(self._channels) + len(self._dialling) >= MAX_CHANNELS:
            self._log.warn(
                "channel {name} is not opened: {count} channels are open, the most there may be",
                name=message.channel,
                count=MAX_CHANNELS,
            )
            return
        factory = Factory.forProtocol(lambda: self._build_channel_link(message))
        factory.noisy = False
        try:
            attempt = self._dial(message.address).connect(factory)
        except SwitchboardError as error:
            self._log.warn(
                "channel {name} can't be opened: {reason}", name=message.channel, reason=str(error)
            )
            return
        self._dialling[message.channel] = attempt
        attempt.addErrback(self._dial_failed, message.channel)
        attempt.addBoth(lambda _: self._dialled(message.channel, attempt))

    def _dialled(self, name: str, attempt: Deferred[Any]) -> None:
        if self._dialling.get(name) is attempt:
            del self._dialling[name]

    def _dial_failed(self, failure: Failure, name: str) -> None:
        if not isinstance(failure.value, CancelledError):
            self._log.warn("channel {name} can't be opened: {reason}", name=name, reason=explain(failure))

    def _build_channel_link(self, message: link.OpenChannel) -> LinkProtocol:
        channel_link = ChannelLink(message.ticket, self._now, self._heartbeat)

        def build(protocol: LinkProtocol) -> ChannelConnection:
            connection = ChannelConnection(message.channel, protocol, self._channel_lost)
            connection.channel = RobotChannel(
                name=message.channel,
                writer=connection,
                offset=channel_link.offset,
                platform=self._platform,
                motion=self.motion,
                clock=self._clock,
                frame_limit=self._frame_limit,
                gate=self._gate,
                inhibited=self.order_handler.inhibited,
                goal_topics=self._goal_topics,
                active_goals=self._active_goals,
                sample_limit=self._sample_limit,
                asset_roots=map(Path, self._settings.assets.roots),
            )
            self._channels[message.channel] = connection
            return connection

        return LinkProtocol(channel_link, build, self._clock)

    def _channel_lost(self, connection: ChannelConnection, reason: str) -> None:
        connection.channel.close()
        self._dropped_by_closed_channels += connection.channel.sample_queue.dropped
        if self._channels.get(connection.name) is connection:
            del self._channels[connection.name]
        self._log.info("channel {name} ended: {reason}", name=connection.name, reason=reason)

    def _close_channel(self, name: str, reason: str) -> None:
        attempt = self._dialling.pop(name, None)
        if attempt is not None:
            attempt.cancel()
        connection = self._channels.pop(name, None)
        if connection is not None:
            # At once, not when the connection is closed: motion must stop and subscriptions must end.
            run_safely(self._log, "a channel could not be closed", connection.channel.close)
            run_safely(
                self._log, "'bye' could not be sent on a channel", connection.send, link.Bye(reason=reason)
            )
            connection.protocol.end(LinkLost(reason), gently=True)

    def _close_channels(self, reason: str) -> None:
        for name in {*self._dialling, *self._channels}:
            run_safely(self._log, "a channel could not be closed", self._close_channel, name, reason)

    # --- reports to the relay ------------------------------------------------------------------------------

    def _description(self) -> link.Describe:
        facts = self._platform.facts()
        return link.Describe(
            host=socket.gethostname(),
            platform=facts.platform,
            distro=facts.distro,
            os=operating_system(),
            agent=self._agent,
            started=self._started,
            sim_time=facts.sim_time,
            motion=self._settings.safety.reported_policy,
            extra=facts.extra,
        )

    def _check_platform(self) -> None:
        """Report faults of the middleware and changes of the graph."""
        self._report_fault()
        if self._reported_graph is None:
            return
        view = self._read_graph()
        if view is None:
            return
        if self._clock.seconds() < self._graph_settles_at:
            return
        changes = graph_changes(self._reported_graph, view)
        self._reported_graph = view
        if changes is not None:
            self._send_graph(changes)
            self._cameras.update_graph(view)

    def _send_graph(self, graph: link.Graph) -> None:
        for chunk in graph_chunks(graph):
            self._connection.send(chunk)

    def _read_graph(self) -> GraphView | None:
        try:
            return self._platform.graph()
        except Exception:  # a failure must not end the periodic task
            self._log.failure("the graph could not be read")
            return None

    def _report_fault(self) -> None:
        fault = self._platform.fault()
        if fault is not None and not self._platform_faulty:
            self.alert("error", fault, MODULE, "middleware")
        elif fault is None and self._platform_faulty:
            self.alert("info", "the robot's middleware works again", MODULE, "middleware", over=True)
        self._platform_faulty = fault is not None

    def _report_health(self) -> None:
        self._alerts.flush()
        try:
            health = self._health()
        except Exception:  # a value that can't be read must end neither the periodic task nor a registration
            self._log.failure("the robot's health could not be read")
            return
        self._connection.send(health)

    def _health(self) -> link.Health:
        round_trip = self._connection.round_trip
        return link.Health(
            battery=self._battery(),
            cpu=self._machine.cpu(),
            memory=self._machine.memory(),
            rtt_ms=round(round_trip * 1000, 3) if round_trip is not None else None,
            stale_commands=self.motion.stale_commands + self._gate.stale,
            invalid_commands=self.motion.invalid_commands,
            unguarded_commands=self.motion.unguarded_commands,
            refused_commands=self.authority.refused,
            limited_commands=self.motion.limited_commands,
            watchdog_stops=self.motion.watchdog_stops,
            dropped_samples=self._platform.dropped
            + self._dropped_by_closed_channels
            + sum(each.channel.sample_queue.dropped for each in self._channels.values()),
        )

    def _battery(self) -> float | None:
        try:
            return self._platform.battery()
        except Exception:
            self._log.failure("the battery's charge could not be read")
            return None
