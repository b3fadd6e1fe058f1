"""A client that speaks the Foxglove protocol over a websocket: decodes its messages, and encodes the session's answers.

Its operations are carried out by the same :class:`~relay_server.sessions.session.Session` as those of rosbridge.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any

from twisted.logger import Logger

from relay_protocol import rosbridge
from relay_protocol.errors import PeerError, SwitchboardError
from relay_protocol.limits import KIB
from relay_protocol.rights import Operation
from relay_server.channels.client_subscription import SLOW_LINK, SLOW_ROBOT, ClientSubscription
from relay_server.channels.samples import Sample
from relay_server.common.byte_budget import ByteBudget
from relay_server.common.clock import PeriodicTimer
from relay_server.common.send_queue import DATA_PER_TOPIC
from relay_server.control import view
from relay_server.foxglove import messages
from relay_server.foxglove.assets import AssetKey, AssetRequests, WaitingAsset
from relay_server.foxglove.connection_graph import ConnectionGraph
from relay_server.foxglove.context import FoxgloveContext
from relay_server.foxglove.options import StreamOptions
from relay_server.foxglove.parameters import FoxgloveParameters
from relay_server.foxglove.publications import ENCODINGS, ClientPublications
from relay_server.foxglove.services import FoxgloveServices
from relay_server.foxglove.statuses import CHANNEL_PREFIX, LEVELS, SUBSCRIPTION_PREFIX
from relay_server.foxglove.topics import TopicChannels
from relay_server.sessions.session import Session
from relay_server.sessions.websocket_port import WebsocketContext, WebsocketPort

UPDATE_SECONDS = 1.0
"""Seconds between two comparisons of what is advertised with what there is; changes of the graph cause one at once."""

LARGE = 64 * KIB
"""Bytes. Of a topic with longer messages only the newest waits for a client that reads slowly, where it replaces the
others.
"""

SMALL = 4 * KIB
"""Bytes. The time to read shorter binary messages is not counted."""

TIME_SECONDS = 0.1
"""Least seconds between two messages with the simulated time of a robot."""

CALM_SECONDS = 60.0
"""Seconds since the last jump of simulated time after which another one begins a session.

With each ``serverInfo`` Lichtblick requests all parameters, and requests them once more every 15 s from then on.
"""

TIME_KEY = "time"
"""Key in the send queue of the message with the simulated time."""

NEWS = "news"
"""Id of statuses about no operation, such as a lost control."""

DISTRO = "jazzy"
"""The ROS 2 distribution that is named of a robot that has not been online yet."""

CAPABILITIES = ("parameters", "parametersSubscribe", "services", "connectionGraph", "assets")
"""Capabilities of every client, within its rights."""

PUBLISH, TIME = "clientPublish", "time"
"""Capabilities for a client that may publish, and for a robot with simulated time."""


class FoxglovePort(WebsocketPort):
    """The port of a session whose client speaks Foxglove (:class:`relay_server.sessions.ports.ClientPort`).

    It is an observer of the robot too, as it advertises what the robot's graph has.

    :param run_id: differs from one run of the relay to the next
    :param options: of the URL
    :param asset_budget: memory of the relay for assets
    """

    log = Logger()

    def __init__(
        self, context: WebsocketContext, run_id: str, options: StreamOptions, asset_budget: ByteBudget
    ) -> None:
        super().__init__(context)
        self._asset_budget = asset_budget
        self._options = options
        self._run_id = run_id
        self._info: dict[str, Any] = {}
        """Fields of the latest ``serverInfo`` but the metadata, which are no reason to send it again."""
        self._began = False
        self._dropped = 0
        """Samples dropped for this client, when they were last compared."""
        self._lost: dict[str, dict[str, int]] = {}
        """Samples that the robot did not send when they were last compared, by reason and topic."""
        self._unsent: dict[str, int] = {}
        """Messages of this client that were dropped on the way to the robot when they were last compared, by topic."""
        self._time_ns = 0
        """The simulated time that was sent last since the latest ``serverInfo``, nanoseconds."""
        self._jumps = 0
        """Jumps of the simulated time when the connection began, or a session because of one."""
        self._jumped_at = -CALM_SECONDS
        """The clock's seconds at the latest jump."""

    def attach(self, session: Session) -> None:
        """Set the session that carries out the client's operations; once, before :meth:`start`."""
        super().attach(session)
        self._context = context = FoxgloveContext(self._clock, session, self.send_queue, self._options)
        self._topics = TopicChannels(context)
        self._publications = ClientPublications(context)
        self._services = FoxgloveServices(context)
        self._parameters = FoxgloveParameters(context)
        self._graph = ConnectionGraph(context)
        self._assets = AssetRequests(context, session.client.channel.asset, self._asset_budget)
        self._timer = PeriodicTimer(self._update, UPDATE_SECONDS)
        self._time_timer: PeriodicTimer | None = None

    # --- the websocket ------------------------------------------------------------------------------------

    def start(self) -> None:
        """Begin the session, and pings; introduce the robot."""
        super().start()
        self._client.robot.observers.append(self)
        robot_clock = self._client.channel.robot_clock
        robot_clock.on_jump.append(self._time_jumped)
        self._jumps = robot_clock.jumps
        self._began = True
        self._timers.start(self._timer)

    def message(self, data: bytes, *, earliest_sent: int | None = None) -> None:
        """One text message of the client.

        :param earliest_sent: of its first frame, if other messages came in between; ``None``: :attr:`earliest_sent`
        """
        self._dated(self._text, data, self._age.earliest_sent if earliest_sent is None else earliest_sent)

    def binary_message(self, payload: bytes, *, earliest_sent: int) -> None:
        """One binary message of the client.

        :param earliest_sent: of its first frame
        """
        self._dated(self._binary, payload, earliest_sent)

    def _dated(self, handle: Callable[[bytes], None], data: bytes, earliest_sent: int) -> None:
        if not self.session.closed:
            with self._age.as_of(min(earliest_sent, self._age.earliest_sent)):
                handle(data)

    def _text(self, data: bytes) -> None:
        try:
            self._quota.check()
            with self._quota.timed():
                operation = messages.decode_text(data)
                self._malformed = 0
                _HANDLERS[type(operation)](self, operation)
        except SwitchboardError as error:
            self._unreadable(error)

    def _binary(self, data: bytes) -> None:
        try:
            message = messages.decode_binary(data)
        except SwitchboardError as error:
            self._unreadable(error)
            return
        self._malformed = 0
        if len(data) <= SMALL:
            self._handle(message)
            return
        # Reading a long message takes time that counts.
        with self._quota.timed():
            self._handle(message)

    def _handle(self, message: messages.ClientMessage | messages.ServiceCallMessage) -> None:
        if isinstance(message, messages.ClientMessage):
            self._publications.publish(message)
        else:
            self._services.call(message)

    def _unreadable(self, error: SwitchboardError) -> None:
        # A text that is too costly, or a quota that is used up, does not count as malformed.
        self._malformed += isinstance(error, PeerError)
        self._context.deny(f"a message was not carried out: {error}", "message")
        self._close_malformed(f"could not be read: {error}")

    # --- what there is ------------------------------------------------------------------------------------

    def _update(self) -> None:
        """Bring what the client knows up to date."""
        if self.session.closed:
            return
        self._introduce()
        self._follow_clock()
        self._show_control()
        self._show_drops()
        self._show_thinning()
        self._context.statuses.remove_ended()
        self._topics.update()
        self._services.update()
        self._graph.update()

    def _introduce(self) -> None:
        """Send ``serverInfo``, first of all and when something in it has changed."""
        client = self._client
        robot = client.robot
        cdr = "cdr" in robot.encodings or not robot.encodings
        metadata = {"robot": robot.full}
        if cdr:
            # With it, clients load the common definitions of ROS 2.
            metadata["ROS_DISTRO"] = robot.description.distro or DISTRO
        # A link that was lost and is back is no reason to begin a session.
        robot_run = robot.description.started or robot.registrations
        info = {
            "name": robot.full,
            "capabilities": self._capabilities(),
            "supportedEncodings": list(ENCODINGS) if cdr else ["json"],
            "sessionId": f"{self._run_id}-{robot.robot_id}-{robot_run}-{self._jumps}",
        }
        if info == self._info:
            return
        another = info["sessionId"] != self._info.get("sessionId")
        self._info = info
        self._context.send(messages.text("serverInfo", **info, metadata=metadata))
        if another:
            # With a new session clients forget the statuses that they have shown.
            self._context.statuses.repeat()
        # At each serverInfo Lichtblick forgets the time, and all types but the common ones.
        self._time_ns = 0
        self._send_time()
        self._topics.announce_again()
        self._services.announce_again()

    def _capabilities(self) -> list[str]:
        client = self._client
        found = list(CAPABILITIES)
        if client.permit.rules.may_allow(Operation.PUBLISH):
            found.append(PUBLISH)
        if client.robot.description.sim_time:
            found.append(TIME)
        return found

    def _follow_clock(self) -> None:
        """Send the robot's time from now on, or no more, as its description has changed."""
        simulated = self._client.robot.description.sim_time
        if simulated and self._time_timer is None:
            self._time_timer = PeriodicTimer(self._send_time, TIME_SECONDS)
            self._timers.start(self._time_timer)
        elif not simulated and self._time_timer is not None:
            self._time_timer.stop()
            self._time_timer = None

    def _send_time(self) -> None:
        """Send the time of a robot with simulated time if it is another one; only the newest waits."""
        client = self._client
        now_ns = client.channel.now_ns() if client.robot.description.sim_time else 0
        if now_ns and now_ns != self._time_ns:
            self._time_ns = now_ns
            self.send_queue.send_undroppable(TIME_KEY, messages.time(now_ns))

    def _time_jumped(self, seconds: float) -> None:
        """The simulated time has jumped; if back, begin a session at once, before samples with the new time come.

        With two publishers of ``/clock``, or a recording that is played in a loop, it jumps again and again. Then only
        the time is sent, which apps follow backwards too.
        """
        if seconds > 0:
            return
        now, before = self._clock.seconds(), self._jumped_at
        self._jumped_at = now
        if now - before >= CALM_SECONDS:
            self._jumps = self._client.channel.robot_clock.jumps
            self._introduce()
        elif now - before >= TIME_SECONDS:
            self._send_time()

    def _show_drops(self) -> None:
        """Show that samples were dropped since the last time."""
        dropped, before = self.send_queue.dropped, self._dropped
        self._dropped = dropped
        if dropped > before:
            advice = _NOT_READ if self.send_queue.rate is None else _SLOW
            self._context.show("warning", f"messages are dropped: {advice}", "drops")
        for reason, (id, words) in _ROBOT_DROPS.items():
            lost = self._client.channel.subscriptions.losses_of_topics(self._client, reason)
            lost_before, self._lost[reason] = self._lost.get(reason, {}), lost
            # Samples that were lost before the client subscribed do not count.
            if any(count > lost_before.get(topic, count) for topic, count in lost.items()):
                self._context.show("warning", f"messages are dropped: {words}", id)
        unsent, unsent_before = dict(self._client.channel.publications.dropped(self._client)), self._unsent
        self._unsent = unsent
        if any(count > unsent_before.get(topic, 0) for topic, count in unsent.items()):
            self._context.show(
                "warning", f"messages that you publish are dropped: {_THIN_DOWNLINK}", "publish-drops"
            )

    def _show_thinning(self) -> None:
        """Show that clouds have more points than the options of this client ask for."""
        topics = self._client.channel.subscriptions.less_thinned(self._client)
        if topics:
            words = f"{', '.join(sorted(topics))}: not thinned as asked, since other clients need more points"
            self._context.show_state("warning", words, "thinning")
        else:
            self._context.statuses.remove("thinning")

    def _show_control(self) -> None:
        """Show who controls the robot, and whether it is stopped or offline."""
        client, context = self._client, self._context
        snapshot = client.controller.snapshot
        holder = view.holder(snapshot)
        if snapshot.stopped is not None:
            context.show_state(
                "warning", "the robot is stopped; it takes no commands until it is resumed", "control"
            )
        elif holder and not snapshot.lease.held_by(client):
            context.show_state("info", f"the robot is controlled by {holder}", "control")
        else:
            context.statuses.remove("control")
        if client.robot.control_link is None:
            context.show_state("warning", f"robot {client.robot.full} is offline", "robot")
        else:
            context.statuses.remove("robot")

    # --- RobotObserver ------------------------------------------------------------------------------------

    def robot_online(self) -> None:
        """The robot has registered (again)."""
        self._update()

    def robot_offline(self) -> None:
        """The control link is gone."""
        self._update()

    def graph_changed(self) -> None:
        """The mirror of the robot's graph has changed."""
        self._update()

    def described(self) -> None:
        """The robot has sent facts about itself."""
        self._update()

    # --- ClientPort: samples ------------------------------------------------------------------------------

    def deliver(self, subscription: ClientSubscription, sample: Sample) -> None:
        """Send a sample, or queue it."""
        queue = self.send_queue
        if queue.passing:
            frame = self._topics.frame(subscription, sample)
            if frame is not None:
                queue.write(frame)
            return
        # Of a latched topic each publisher has a sample, and all must arrive.
        subscriptions, topic = self._client.channel.subscriptions, subscription.topic
        newest_only = (
            sample.size > LARGE and not subscriptions.latched(topic) and not self._topics.is_cumulative(topic)
        )
        depth = 1 if newest_only else DATA_PER_TOPIC
        queue.send_droppable(subscription, sample, depth, lasting=subscriptions.lasting(topic))

    def _render(self, key: ClientSubscription | AssetKey, message: Sample | WaitingAsset) -> bytes | None:
        if isinstance(message, WaitingAsset):
            return self._assets.render(message)
        return self._topics.frame(key, message) if isinstance(key, ClientSubscription) else None

    @property
    def waiting_bytes(self) -> int:
        """Bytes that wait for the client, with the memory for its assets."""
        return super().waiting_bytes + self._assets.reserved

    # --- ClientPort: answers ------------------------------------------------------------------------------

    def status(self, level: str, text: str, id: rosbridge.Id = None) -> None:
        """Show a status."""
        if level not in LEVELS or self.session.closed:
            return
        if id is None:
            self._context.show(level, text, NEWS)
        elif str(id).startswith((SUBSCRIPTION_PREFIX, CHANNEL_PREFIX)):
            self._context.show_state(level, text, str(id))
        elif level != "error" or not self._services.is_pending(str(id)):
            # The failure of a call is shown with its answer.
            self._context.show(level, text, self._services.status_id(str(id)))

    def warn_of_drops(self, text: str, id: rosbridge.Id = None) -> None:
        """Nothing: :meth:`_show_drops` shows it for as long as it lasts."""

    def service_response(self, call: rosbridge.CallService, result: bool, values: bytes) -> None:
        """Answer a call."""
        self._services.answer(str(call.id), result, values)

    def action_feedback(self, key: object, goal: rosbridge.SendActionGoal, values: bytes) -> None:
        """Nothing: such a client sends no goals."""

    def action_result(self, goal: rosbridge.SendActionGoal, status: int, result: bool, values: bytes) -> None:
        """Nothing: such a client sends no goals."""

    def call_service(self, service: str, id: str, args: bytes) -> None:
        """Nothing: such a client offers no services."""

    def send_action_goal(self, action: str, id: str, type: str, args: bytes, feedback: bool) -> None:
        """Nothing: such a client offers no actions."""

    def cancel_action_goal(self, action: str, id: str) -> None:
        """Nothing: such a client offers no actions."""

    # --- ClientPort: the connection -----------------------------------------------------------------------

    def rights_changed(self) -> None:
        """The client's rights have changed: advertise what it may use now."""
        super().rights_changed()
        self._update()

    def ended(self) -> None:
        """The session is over."""
        super().ended()
        self._timer.stop()
        if self._time_timer is not None:
            self._time_timer.stop()
        self._context.end()
        self._topics.end()
        self._services.end()
        self._parameters.end()
        if self._began:
            self._client.robot.observers.remove(self)
            self._client.channel.robot_clock.on_jump.remove(self._time_jumped)

    def _sample_dropped(self, key: Hashable, source: int) -> None:
        """Nothing: :meth:`_show_drops` shows it."""


_NOT_READ = "this client does not read fast enough"
_SLOW = "this connection is too slow; subscribe to fewer or smaller topics"
_ROBOT_DROPS = {
    SLOW_LINK: (
        "uplink-drops",
        "the robot's link is too thin for what is subscribed; subscribe to fewer or smaller topics",
    ),
    SLOW_ROBOT: (
        "robot-drops",
        "the robot's computer is too busy to send them; subscribe to fewer or smaller topics",
    ),
}
"""Ids and texts of statuses about samples that the robot did not send, by reason."""

_THIN_DOWNLINK = "the robot's link is too slow; publish less often, or smaller messages"
"""Reasons of drops, without figures, as apps list every wording."""


_HANDLERS: dict[type, Callable[[FoxglovePort, Any], None]] = {
    messages.SubscribeOp: lambda port, operation: port._topics.subscribe(operation),
    messages.UnsubscribeOp: lambda port, operation: port._topics.unsubscribe(operation),
    messages.AdvertiseOp: lambda port, operation: port._publications.advertise(operation),
    messages.UnadvertiseOp: lambda port, operation: port._publications.unadvertise(operation),
    messages.GetParametersOp: lambda port, operation: port._parameters.get(operation),
    messages.SetParametersOp: lambda port, operation: port._parameters.set(operation),
    messages.SubscribeParametersOp: lambda port, operation: port._parameters.subscribe(operation),
    messages.UnsubscribeParametersOp: lambda port, operation: port._parameters.unsubscribe(operation),
    messages.SubscribeGraphOp: lambda port, operation: port._graph.subscribe(),
    messages.UnsubscribeGraphOp: lambda port, operation: port._graph.unsubscribe(),
    messages.FetchAssetOp: lambda port, operation: port._assets.fetch(operation),
}
