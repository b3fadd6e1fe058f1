"""A channel for each robot in use: its lifecycle (table in :mod:`~relay_server.channels.states`) and its messages."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from twisted.logger import Logger

from relay_protocol import link
from relay_protocol.errors import Refused, Unavailable
from relay_server.access import Permit
from relay_server.channels.assets import RobotAssets
from relay_server.channels.definitions import Definitions, Interfaces
from relay_server.channels.encodings import PayloadCodec
from relay_server.channels.goals import ActionGoals
from relay_server.channels.link_state import ChannelLinkPort, RobotLinkState
from relay_server.channels.members import AttachedMember, ClientMember
from relay_server.channels.offered_services import ACTIONS, SERVICES, OfferedServices
from relay_server.channels.parameters import ParameterCache
from relay_server.channels.publications import Publications
from relay_server.channels.request_gateway import RequestGateway
from relay_server.channels.robot_clock import RobotClock
from relay_server.channels.service_calls import ClientServiceCalls, PendingRequests, ServiceCalls
from relay_server.channels.states import NEXT, ChannelEvent, ChannelState
from relay_server.channels.subscriptions import Subscriptions
from relay_server.common.clock import Clock, Timer, cancel
from relay_server.common.concurrency import FairQueue
from relay_server.common.connection_ids import unused_name
from relay_server.robots.registry import OwnEndpoints, RobotState
from relay_server.robots.tickets import Tickets

JOIN_SECONDS = 10.0
"""Seconds in which the robot must join; then it is requested again."""

REOPEN_SECONDS = 0.5
"""Pause before a broken channel link is opened again."""


class Channel:
    """One robot in use: its link, and its members: the sessions and recordings that use it.

    :param linger: seconds that it stays open after the last member
    :param issue_ticket: makes the ticket with which the robot joins
    :param closed: called once, when it is closed
    :param new_id: returns an unguessable text
    :param wall_ns: Unix time in nanoseconds
    """

    log = Logger()

    def __init__(
        self,
        clock: Clock,
        robot: RobotState,
        name: str,
        *,
        linger: float,
        issue_ticket: Callable[[Channel], str],
        closed: Callable[[Channel], None],
        new_id: Callable[[], str],
        wall_ns: Callable[[], int],
    ) -> None:
        self._clock = clock
        self.robot = robot
        self.name = name
        self._linger = linger
        self._issue_ticket = issue_ticket
        self._closed = closed
        self.state = ChannelState.NEW
        self.members: set[AttachedMember] = set()
        self._timer: Timer | None = None
        self._idle: Timer | None = None
        self.link_state = RobotLinkState(clock, robot)
        self.fair_queue = FairQueue(clock)
        """Spreads over reactor turns the work for clients that wait for the same answer of the robot."""
        definitions = Definitions(self.link_state, self._type_known, self._type_failed)
        self._definitions = definitions
        self._interfaces = Interfaces(self.link_state)
        self.assets = RobotAssets(self.link_state)
        self.subscriptions = Subscriptions(self.link_state, definitions)
        self.parameters = ParameterCache(clock, self.link_state, self.subscriptions)
        self.robot_clock = RobotClock(clock, self.link_state, self.subscriptions, wall_ns)
        self.now_ns = self.robot_clock.now_ns
        """The robot's time, nanoseconds."""
        self.publications = Publications(clock, self.link_state, definitions, self.now_ns)
        codec = PayloadCodec(self.link_state, definitions, self.now_ns)
        pending = PendingRequests(clock, new_id)
        self.services = OfferedServices(self.link_state, definitions, SERVICES, pending.offer_ended)
        self.actions = OfferedServices(self.link_state, definitions, ACTIONS, pending.offer_ended)
        self.client_calls = ClientServiceCalls(clock, self.link_state, codec, self.services, pending)
        self.goals = ActionGoals(self.link_state, codec, self.actions, pending)
        self._calls = ServiceCalls(clock, self.link_state, codec, self.services, self.client_calls)
        self.requests = RequestGateway(
            clock, self.link_state, lambda: self.state, self._calls, self.goals, definitions, self._interfaces
        )
        self._handlers = self._message_handlers()
        robot.observers.append(self)

    def _message_handlers(self) -> dict[type, Callable[[Any], None]]:
        return {
            link.Subscribed: self.subscriptions.subscribed,
            link.SamplesDropped: self.subscriptions.samples_dropped,
            link.Advertised: self.publications.advertised,
            link.ServiceResponse: self._calls.answered,
            link.Interfaces: self._interfaces.listed,
            link.AssetPart: self.assets.part,
            link.CallService: self.client_calls.call_from_graph,
            link.SendActionGoal: self.goals.goal_from_graph,
            link.CancelActionGoal: self.goals.cancel_from_graph,
            link.ActionFeedback: self.goals.robot_feedback,
            link.ActionResult: self.goals.robot_result,
            link.AdvertisedService: lambda message: self.services.advertised(message.service),
            link.AdvertisedAction: lambda message: self.actions.advertised(message.action),
            link.TypeDefinition: self._definitions.add,
            link.Failed: self._failed,
        }

    # --- members ------------------------------------------------------------------------------------------

    def attach(self, member: AttachedMember) -> None:
        """A member begins to use the robot."""
        self.members.add(member)
        if self._idle is not None:
            self._idle.cancel()
            self._idle = None
        if self.state is ChannelState.NEW:
            self._handle(ChannelEvent.ATTACHED)
            if self.robot.control_link is not None:
                self._handle(ChannelEvent.ROBOT_ONLINE)

    def detach(self, member: AttachedMember) -> None:
        """A member has left: withdraw what only it requested from the robot, at once."""
        self.members.discard(member)
        self.subscriptions.forget(member)
        self.publications.forget(member)
        self.services.forget(member)
        self.actions.forget(member)
        self.goals.forget(member)
        if not self.members and self._idle is None and self.state is not ChannelState.CLOSED:
            self._idle = self._clock.callLater(self._linger, self._idle_over)

    def forget_denied(self, member: ClientMember, permit: Permit) -> None:
        """Withdraw what a member has advertised and has no right to any more."""
        for part in (self.publications, self.services, self.actions):
            part.forget_denied(member, permit)

    def _idle_over(self) -> None:
        self._idle = None
        self._handle(ChannelEvent.CLOSE)

    def close(self) -> None:
        """Close at once, even if there are members."""
        if self._idle is not None:
            self._idle.cancel()
            self._idle = None
        self._handle(ChannelEvent.CLOSE)

    # --- the robot ----------------------------------------------------------------------------------------

    def robot_online(self) -> None:
        """The robot has registered, perhaps again."""
        self._handle(ChannelEvent.ROBOT_ONLINE)

    def robot_offline(self) -> None:
        """The control link is lost, and with it the robot's subscriptions and publishers for the relay."""
        self._handle(ChannelEvent.ROBOT_OFFLINE)

    def graph_changed(self) -> None:
        """The robot's graph has changed."""
        # First, so that nothing is requested to which a member has no right any more.
        self._recheck_rights()
        self.subscriptions.graph_changed()
        self.publications.graph_changed()
        self.parameters.graph_changed()
        self.services.graph_changed()
        self.actions.graph_changed()

    def described(self) -> None:
        """The robot's description or its cameras have changed."""
        self._recheck_rights()
        if self.state is ChannelState.OPEN:
            self.robot_clock.follow()

    def _recheck_rights(self) -> None:
        for member in list(self.members):
            member.recheck_rights()

    def own_endpoints(self) -> OwnEndpoints:
        """Endpoints that the robot has in its graph for the members."""
        return OwnEndpoints(
            self.publications.active(),
            self.subscriptions.active(),
            self.services.active(),
            self.actions.active(),
        )

    def joined(self, channel_link: ChannelLinkPort) -> None:
        """The robot has joined with the channel's ticket."""
        if self.state is not ChannelState.OPENING:
            channel_link.close("this channel is not being opened")
            return
        self.link_state.link = channel_link
        self._handle(ChannelEvent.JOINED)

    def link_lost(self, channel_link: ChannelLinkPort) -> None:
        """The channel's link is lost."""
        if self.link_state.link is channel_link:
            self._handle(ChannelEvent.LINK_LOST)

    def sample(self, number: int, body: bytes, frame_stamp: int = 0) -> None:
        """Pass a sample of the channel's link to its subscription. All samples enter here.

        :param number: of the subscription
        :param body: in the robot's encoding
        :param frame_stamp: the robot's wall clock when it received the sample, nanoseconds since 1970. With simulated
            time the sample's ROS time is that of the simulation instead.
        """
        ros_time_ns = self.now_ns() if self.robot.description.sim_time else frame_stamp
        subscription = self.subscriptions.by_number.get(number)
        # ``None``: the subscription has ended.
        if subscription is not None:
            subscription.sample(body, ros_time_ns, frame_stamp)

    async def asset(self, uri: str, most: int) -> bytes:
        """A file of the robot; see :meth:`RobotAssets.fetch`.

        :param most: most bytes that the caller takes
        :raises SwitchboardError: it can't be fetched
        :raises LargerThanReserved: it has more bytes
        """
        await self.requests.until_open()
        return await self.assets.fetch(uri, most)

    def message(self, message: link.RobotChannel) -> None:
        """Handle a message of the channel's link."""
        handle = self._handlers.get(type(message))
        if handle is not None:
            handle(message)

    def _failed(self, message: link.Failed) -> None:
        reason = message.reason
        if message.request == "get_type":
            self._definitions.refused(message.reference, reason)
        elif message.request == "get_interfaces":
            self._interfaces.refused(reason)
        elif message.request == "send_action_goal":
            self.goals.robot_refused(message.reference, reason)
        elif message.request in (SERVICES.op, ACTIONS.op):
            offered_services = self.services if message.request == SERVICES.op else self.actions
            offered_services.refused(message.reference, reason)
        elif message.reference.isdecimal():
            refuse = {
                "subscribe": self.subscriptions.refused,
                "advertise": self.publications.refused,
                "get_asset": self.assets.refused,
            }
            if message.request in refuse:
                refuse[message.request](int(message.reference), reason)

    def _type_known(self, type_name: str) -> None:
        self.subscriptions.type_known(type_name)
        self.publications.type_known(type_name)

    def _type_failed(self, type_name: str, reason: str) -> None:
        self.subscriptions.type_failed(type_name, reason)
        self.publications.type_failed(type_name, reason)

    # --- lifecycle ----------------------------------------------------------------------------------------

    def _handle(self, event: ChannelEvent) -> None:
        following = NEXT.get((self.state, event))
        if following is None:
            return
        before, self.state = self.state, following
        self.log.debug("channel {name}: {event}, now {state}", name=self.name, event=event, state=following)
        cancel(self._timer)
        self._timer = None
        if before is ChannelState.OPEN:
            self._leave_open(event)
        if following is ChannelState.OPENING:
            pause = REOPEN_SECONDS if event is ChannelEvent.LINK_LOST else 0.0
            self._timer = self._clock.callLater(pause, self._request_open)
        elif following is ChannelState.WAITING:
            # Even if the link was never open: queued messages must not be sent when the robot is back.
            self.publications.lost()
            self.requests.not_opened(Unavailable(f"robot {self.robot.name} is offline"))
        elif following is ChannelState.OPEN:
            self._enter_open()
        elif following is ChannelState.CLOSED:
            self._end()

    def _request_open(self) -> None:
        if self.robot.control_link is not None:
            ticket = self._issue_ticket(self)
            self.robot.control_link.send(link.OpenChannel(channel=self.name, ticket=ticket))
        self._timer = self._clock.callLater(JOIN_SECONDS, self._handle, ChannelEvent.JOIN_TIMEOUT)

    def _enter_open(self) -> None:
        self.robot_clock.follow()
        self.subscriptions.opened()
        self.publications.opened()
        self.services.opened()
        self.actions.opened()
        self.requests.opened()

    def _leave_open(self, event: ChannelEvent) -> None:
        broken, self.link_state.link = self.link_state.link, None
        if broken is not None:
            broken.close(event.value)
        self.subscriptions.lost()
        self.publications.lost()
        self.services.lost()
        self.actions.lost()
        self.link_state.robot_requests.reset()
        self._definitions.reset()
        self._interfaces.reset()
        self.assets.reset()
        self.robot_clock.lost()
        self._calls.lost()
        self.parameters.lost()
        self.client_calls.lost()
        self.goals.lost()

    def _end(self) -> None:
        if self.robot.control_link is not None:
            self.robot.control_link.send(link.CloseChannel(channel=self.name))
        self.requests.not_opened(Unavailable("the channel was closed"))
        self.services.close()
        self.actions.close()
        self.parameters.close()
        self.robot.observers.remove(self)
        self._closed(self)


class Channels:
    """Opens channels on demand, and assigns the links with which robots join to them.

    :param new_ticket: returns an unguessable text, for tickets and for ids of requests to clients
    :param wall_ns: Unix time in nanoseconds
    """

    def __init__(
        self,
        clock: Clock,
        *,
        linger: float,
        new_ticket: Callable[[], str],
        wall_ns: Callable[[], int],
    ) -> None:
        self._clock = clock
        self._linger = linger
        self._new_ticket = new_ticket
        self._wall_ns = wall_ns
        self._channels: dict[int, Channel] = {}
        self._tickets: Tickets[Channel] = Tickets(clock, new_ticket)

    def __iter__(self) -> Iterator[Channel]:
        return iter(list(self._channels.values()))

    def of(self, robot: RobotState) -> Channel:
        """The robot's channel; a new one if there is none."""
        channel = self._channels.get(robot.robot_id)
        if channel is None:
            channel = self._channels[robot.robot_id] = Channel(
                self._clock,
                robot,
                unused_name(f"{robot.name}#", (each.name for each in self)),
                linger=self._linger,
                issue_ticket=self._tickets.issue,
                closed=self._forget,
                new_id=self._new_ticket,
                wall_ns=self._wall_ns,
            )
        return channel

    def find(self, robot: RobotState) -> Channel | None:
        """The robot's channel, if it has one."""
        return self._channels.get(robot.robot_id)

    def redeem(self, ticket: str) -> Channel:
        """The channel of a ticket; the ticket is used up.

        :raises Refused: the ticket is unknown, used or too old
        """
        channel = self._tickets.redeem(ticket)
        if channel is None:
            raise Refused("the channel ticket is unknown, used or too old")
        return channel

    def _forget(self, channel: Channel) -> None:
        if self._channels.get(channel.robot.robot_id) is channel:
            del self._channels[channel.robot.robot_id]
        self._tickets.withdraw(channel)
