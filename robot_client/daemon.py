"""The daemon: a control link for ever, channels as the relay asks for them, graph and health told."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from typing import Any

from twisted.internet.defer import CancelledError, Deferred
from twisted.internet.protocol import Factory
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_protocol import link
from relay_protocol.clocks import now_ns
from relay_protocol.errors import SwitchboardError
from relay_protocol.limits import HEARTBEAT_SECONDS, MIB, ROBOT_FRAME
from robot_client.alerts import CONTROL, MODULE, AlertMemory
from robot_client.camera.service import DaemonCameras
from robot_client.channel.channel import ChannelConnection, RobotChannel
from robot_client.config import RobotSettings
from robot_client.graph_chunks import parts
from robot_client.link.connection import ControlConnection, Dial
from robot_client.link.protocol import ChannelLink
from robot_client.link.tls import explain
from robot_client.link.transport import LinkLost, LinkProtocol
from robot_client.monitor import Machine, operating_system
from robot_client.motion.active_goals import FAREWELL, ActiveGoals
from robot_client.motion.authority import Authority
from robot_client.motion.gate import MotionGate
from robot_client.motion.goal_canceller import GoalCanceller
from robot_client.motion.goal_topics import GoalTopics
from robot_client.motion.guard_port import GuardPort
from robot_client.motion.hardware import Hardware
from robot_client.motion.limits import limits_told
from robot_client.motion.link_loss_alert import LinkLossAlert
from robot_client.motion.motion import MotionControl
from robot_client.motion.orders import LOOK_EVERY, OrderHandler
from robot_client.motion.robot_port import RobotPort
from robot_client.motion.rules import rules_of
from robot_client.motion.stop_store import StopStore
from robot_client.periodic import PeriodicTasks, run_safely
from robot_client.platforms.base import GraphView, Platform, difference, whole

MAX_CHANNELS = 64


class Daemon(RobotPort):
    """Everything between the relay and one platform.

    :param latch: where a stop is kept
    :param hardware: what else there is to stop
    :param dial: endpoints by address
    :param now: clock of :mod:`relay_protocol.clocks`, nanoseconds
    """

    def __init__(
        self,
        settings: RobotSettings,
        connection: ControlConnection,
        platform: Platform,
        guard: GuardPort,
        cameras: DaemonCameras,
        latch: StopStore,
        hardware: Hardware,
        clock: Any,
        dial: Dial,
        agent: str,
        now: Callable[[], int] = now_ns,
    ) -> None:
        policy = settings.safety.policy
        self.authority = Authority()
        self.motion = MotionControl(policy, platform, clock, now, guard, self.authority, rules_of(settings))
        sweep = GoalCanceller(policy, platform, clock, self.motion.commanded)
        self.helm = OrderHandler(
            self.authority, self.motion, latch, hardware, sweep, self, clock, now, time.time
        )
        self.helm.limits = limits_told(settings)
        self._pursuits = ActiveGoals(policy.actions, guard, sweep, latch, clock, now)
        self.motion.proof = self._pursuits.proof = lambda: connection.answered or 0
        self.motion.on_commanded = connection.prove
        self._pursuits.on_pursuing = self._goals_pursued
        self._pursuits.on_changed = self.helm.changed
        self._gate = MotionGate(policy, platform, self.authority, now, settings.safety.stop_call)
        self._goal_topics = GoalTopics(
            settings.safety.goal_topics, platform, self.authority, self.motion, clock, now
        )
        self._settings = settings
        self._connection = connection
        self._platform = platform
        self._cameras = cameras
        self._clock = clock
        self._dial = dial
        self._agent = agent
        self._now = now
        self._started = time.time()
        self._ends: dict[str, ChannelConnection] = {}
        self._opening: dict[str, Deferred[Any]] = {}
        self._dropped = 0
        self._heartbeat = HEARTBEAT_SECONDS
        self._frame_limit = ROBOT_FRAME
        self._sample_limit = 0
        self._told: GraphView | None = None
        self._alerts = AlertMemory(connection, now)
        self._driven = LinkLossAlert(now)
        self._machine = Machine()
        self._troubled = False
        rounds = [
            (self._look_at_graph, 1.0 / settings.ros.graph_hz),
            (self.helm.look, LOOK_EVERY),
            (self._pursuits.look, LOOK_EVERY),
            (self._tell_health, settings.monitor.health_seconds),
        ]
        self._rounds = PeriodicTasks(rounds, clock)
        self._log = Logger("daemon")
        connection.follower = self

    def start(self) -> None:
        """Begin; the platform runs already."""
        self._rounds.start()
        self._connection.start()

    def stop(self) -> Deferred[Any]:
        """Stop the robot, then leave; fires when all connections are gone."""
        self.motion.stop_all("the daemon is leaving")
        self._rounds.stop()
        self._close_channels("the robot's daemon is leaving")
        settled = self.settled()
        gone = self._connection.stop("the robot's daemon is leaving")
        return gone.addBoth(lambda result: settled.addCallback(lambda _: result))

    def settled(self) -> Deferred[Any]:
        """Fires when every zero is said and every goal has ended, or has had the time to."""
        goals = self._pursuits.standing(FAREWELL)
        return self.motion.finish().addCallback(lambda _: goals)

    def alert(self, level: str, text: str, kind: str = "", about: str = "", over: bool = False) -> None:
        """Tell a person, now or when the relay can be reached again; again at each registration while it lasts."""
        {"error": self._log.error, "warning": self._log.warn}.get(level, self._log.info)("{text}", text=text)
        self._alerts.tell(link.Alert(level=level, text=text, kind=kind, about=about, over=over))

    # --- control link --------------------------------------------------------------------------------------

    def on_registered(self, welcome: link.Welcome) -> None:
        """Describe the robot."""
        self._heartbeat = welcome.heartbeat
        self._frame_limit = welcome.frame_limit
        self._sample_limit = min(welcome.sample_limit, self._settings.ros.largest_sample_mb * MIB)
        self._connection.say(self._description())
        self._alerts.registered()
        self._told = self._read_graph() or GraphView()
        self._tell_graph(whole(self._told))
        self.helm.registered()
        self._cameras.look(self._told)
        self._cameras.registered(welcome.heartbeat)
        self._tell_health()

    def on_order(self, message: link.Message) -> None:
        """The relay wants a channel or a camera opened or closed, or something about motion."""
        if self.helm.order(message):
            return
        if isinstance(message, link.OpenChannel):
            self._open(message)
        elif isinstance(message, link.CloseChannel):
            self._close(message.channel, "nobody is left on this channel")
        elif isinstance(message, link.OpenVideo):
            self._cameras.open(message)
        elif isinstance(message, link.CloseVideo):
            self._cameras.close(message)

    def on_unregistered(self, reason: str, proved: int | None) -> None:
        """Without a control link nobody may drive; channels are joined anew."""
        driver = self._driven.lost(proved)  # before zero is said, which changes it
        failed = "after the loss of the control link something could not be done"
        run_safely(self._log, failed, self.helm.unregistered)
        run_safely(self._log, failed, self.motion.stop_all, "the control link is lost", True)
        self._told = None
        self._close_channels(reason)
        if driver is not None:
            words = (
                f"{driver or 'somebody'} lost control while the robot moved: its link to the relay was lost"
            )
            run_safely(self._log, failed, self.alert, "error", words, CONTROL)
        self._cameras.unregistered(reason)

    # --- for the helm --------------------------------------------------------------------------------------

    def say(self, message: link.Message) -> None:
        """Tell the relay, if it is there."""
        if isinstance(message, link.Safety):
            self._driven.said(message, self.authority.user)
        self._connection.say(message)

    def topic(self, name: str) -> tuple[str, list[str]]:
        """The full name of a topic, and its types."""
        full = self._platform.full_name(name, "topic")
        found = self._told.topics.get(full) if self._told else None
        if found is None:  # what has just appeared is not told yet
            view = self._read_graph()
            found = view.topics.get(full) if view else None
        return full, found.types if found else []

    def cancel_goals(self, only_moving: bool) -> None:
        """Cancel what the robot's actions pursue, on all channels."""
        for end in self._ends.values():
            end.channel.cancel_goals(only_moving)

    def standing(self, seconds: float) -> Deferred[list[str]]:
        """Fires when no goal that moves the robot is pursued, or in so many seconds; with the actions that still do."""
        return self._pursuits.standing(seconds)

    @property
    def pursued(self) -> list[str]:
        """The actions that pursue a goal that moves the robot."""
        return self._pursuits.pursued

    @property
    def overdue(self) -> list[str]:
        """The actions that may pursue a goal which was to end."""
        return self._pursuits.overdue

    def _goals_pursued(self, pursued: bool) -> None:
        if pursued:
            self.motion.attend("goals")
        else:
            self.motion.leave("goals")

    def silence(self, topic: str) -> None:
        """A topic is to say nothing from now on, or something again."""
        for end in self._ends.values():
            end.channel.silence(topic)
        self._cameras.silence(self.helm.silent)

    # --- channels ------------------------------------------------------------------------------------------

    def _open(self, message: link.OpenChannel) -> None:
        self._close(message.channel, "it is opened anew")
        if len(self._ends) + len(self._opening) >= MAX_CHANNELS:
            self._log.warn(
                "channel {name} is not opened: there are {count}", name=message.channel, count=MAX_CHANNELS
            )
            return
        factory = Factory.forProtocol(lambda: self._make_channel(message))
        factory.noisy = False
        try:
            attempt = self._dial(message.address).connect(factory)
        except SwitchboardError as error:
            self._log.warn("channel {name} can't be opened: {why}", name=message.channel, why=str(error))
            return
        self._opening[message.channel] = attempt
        attempt.addErrback(self._unreachable, message.channel)
        attempt.addBoth(lambda _: self._opened(message.channel, attempt))

    def _opened(self, name: str, attempt: Deferred[Any]) -> None:
        if self._opening.get(name) is attempt:
            del self._opening[name]

    def _unreachable(self, failure: Failure, name: str) -> None:
        if not isinstance(failure.value, CancelledError):
            self._log.warn("channel {name} can't be opened: {why}", name=name, why=explain(failure))

    def _make_channel(self, message: link.OpenChannel) -> LinkProtocol:
        channel_link = ChannelLink(message.ticket, self._now, self._heartbeat)

        def make_end(protocol: LinkProtocol) -> ChannelConnection:
            end = ChannelConnection(message.channel, protocol, self._gone)
            end.channel = RobotChannel(
                message.channel,
                end,
                channel_link.offset,
                self._platform,
                self.motion,
                self._clock,
                self._frame_limit,
                self._gate,
                self.helm.silent,
                goal_topics=self._goal_topics,
                pursuits=self._pursuits,
                sample_limit=self._sample_limit,
            )
            self._ends[message.channel] = end
            return end

        return LinkProtocol(channel_link, make_end, self._clock)

    def _gone(self, end: ChannelConnection, reason: str) -> None:
        end.channel.close()
        self._dropped += end.channel.uplink.dropped
        if self._ends.get(end.name) is end:
            del self._ends[end.name]
        self._log.info("channel {name} ended: {reason}", name=end.name, reason=reason)

    def _close(self, name: str, why: str) -> None:
        attempt = self._opening.pop(name, None)
        if attempt is not None:
            attempt.cancel()
        end = self._ends.pop(name, None)
        if end is not None:
            # At once, not when the connection is gone: what moves must stop, what is subscribed must end.
            run_safely(self._log, "a channel could not be closed", end.channel.close)
            run_safely(self._log, "goodbye could not be said on a channel", end.say, link.Bye(reason=why))
            end.protocol.end(LinkLost(why), gently=True)

    def _close_channels(self, why: str) -> None:
        for name in {*self._opening, *self._ends}:
            run_safely(self._log, "a channel could not be closed", self._close, name, why)

    # --- what the relay is told ----------------------------------------------------------------------------

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
            motion=self._settings.safety.told,
            extra=facts.extra,
        )

    def _look_at_graph(self) -> None:
        self._look_for_trouble()
        if self._told is None:
            return
        view = self._read_graph()
        if view is None:
            return
        changes = difference(self._told, view)
        self._told = view
        if changes is not None:
            self._tell_graph(changes)
            self._cameras.look(view)

    def _tell_graph(self, graph: link.Graph) -> None:
        for part in parts(graph):
            self._connection.say(part)

    def _read_graph(self) -> GraphView | None:
        try:
            return self._platform.graph()
        except Exception:  # a look that fails must not be the last one
            self._log.failure("the graph could not be read")
            return None

    def _look_for_trouble(self) -> None:
        trouble = self._platform.trouble()
        if trouble is not None and not self._troubled:
            self.alert("error", trouble, MODULE, "middleware")
        elif trouble is None and self._troubled:
            self.alert("info", "the robot's middleware serves again", MODULE, "middleware", over=True)
        self._troubled = trouble is not None

    def _tell_health(self) -> None:
        self._alerts.look()
        try:
            health = self._health()
        except Exception:  # a figure that can't be had must end neither this loop nor a registration
            self._log.failure("the robot's health could not be told")
            return
        self._connection.say(health)

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
            + self._dropped
            + sum(each.channel.uplink.dropped for each in self._ends.values()),
        )

    def _battery(self) -> float | None:
        try:
            return self._platform.battery()
        except Exception:
            self._log.failure("the battery's charge could not be read")
            return None
