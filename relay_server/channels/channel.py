"""A channel: its life by the table of :mod:`~relay_server.channels.states`, and the messages that pass through it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from twisted.logger import Logger

from relay_protocol import link
from relay_protocol.errors import Unavailable
from relay_server.access import Permit
from relay_server.channels.advertisements import ACTIONS, SERVICES, ClientAdvertisements
from relay_server.channels.definitions import Definitions, Interfaces
from relay_server.channels.goals import ActionGoals
from relay_server.channels.payloads import PayloadCodec
from relay_server.channels.publications import Publications
from relay_server.channels.requests import RequestGateway
from relay_server.channels.robot_clock import RobotClock
from relay_server.channels.robot_link import ChannelPort, RobotLinkState, SessionPort, Subscriber
from relay_server.channels.service_calls import ClientServiceCalls, PendingRequests, ServiceCalls
from relay_server.channels.states import NEXT, ChannelEvent, ChannelState
from relay_server.channels.subscriptions import Subscriptions
from relay_server.common.clock import Clock, Timer, cancel
from relay_server.common.fair_queue import FairQueue
from relay_server.robots.graph import OwnEndpoints
from relay_server.robots.registry import RobotState

JOIN_SECONDS = 10.0
"""A robot that has not joined by then is asked again."""

REOPEN_SECONDS = 0.5
"""Pause before a broken channel link is asked for anew."""


class Channel:
    """Everything that goes on with one robot in use.

    :param linger: seconds it stays open after the last member
    :param issue_ticket: makes the ticket the robot joins with
    :param closed: called once, when it is over
    :param new_id: makes an unguessable text
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
        self.members: set[SessionPort] = set()
        self._timer: Timer | None = None
        self._idle: Timer | None = None
        self.wire = RobotLinkState(clock, robot)
        self.line = FairQueue(clock)
        """For what is made for clients when the robot has answered."""
        definitions = Definitions(self.wire, self._typed, self._untypeable)
        self._definitions = definitions
        self._interfaces = Interfaces(self.wire)
        self.subscriptions = Subscriptions(self.wire, definitions)
        self._robot_clock = RobotClock(clock, self.wire, self.subscriptions, wall_ns)
        self.now_ns = self._robot_clock.now_ns
        """The robot's time, nanoseconds."""
        self.publications = Publications(clock, self.wire, definitions, self.now_ns)
        bodies = PayloadCodec(self.wire, definitions, self.now_ns)
        errands = PendingRequests(clock, new_id)
        self.services = ClientAdvertisements(self.wire, definitions, SERVICES, errands.offer_ended)
        self.actions = ClientAdvertisements(self.wire, definitions, ACTIONS, errands.offer_ended)
        self.served = ClientServiceCalls(clock, self.wire, bodies, self.services, errands)
        self.goals = ActionGoals(self.wire, bodies, self.actions, errands)
        self._calls = ServiceCalls(clock, self.wire, bodies, self.services, self.served)
        self.asking = RequestGateway(
            clock, self.wire, lambda: self.state, self._calls, self.goals, definitions, self._interfaces
        )
        self._takers: dict[type, Callable[[Any], None]] = {
            link.Subscribed: self.subscriptions.subscribed,
            link.Lost: self.subscriptions.not_sent,
            link.Advertised: self.publications.advertised,
            link.ServiceResponse: self._calls.answered,
            link.Interfaces: self._interfaces.told,
            link.CallService: self.served.called,
            link.SendActionGoal: self.goals.graph_asks,
            link.CancelActionGoal: self.goals.graph_cancels,
            link.ActionFeedback: self.goals.robot_feedback,
            link.ActionResult: self.goals.robot_result,
            link.AdvertisedService: lambda message: self.services.advertised(message.service),
            link.AdvertisedAction: lambda message: self.actions.advertised(message.action),
            link.TypeDefinition: definitions.add,
            link.Failed: self._failed,
        }
        robot.watchers.append(self)

    # --- members ------------------------------------------------------------------------------------------

    def attach(self, member: SessionPort) -> None:
        """A session begins to use the robot."""
        self.members.add(member)
        if self._idle is not None:
            self._idle.cancel()
            self._idle = None
        if self.state is ChannelState.NEW:
            self._happen(ChannelEvent.WANTED)
            if self.robot.control is not None:
                self._happen(ChannelEvent.ROBOT_ONLINE)

    def detach(self, member: SessionPort) -> None:
        """A session has ended: what only it wanted is given back to the robot at once."""
        self.members.discard(member)
        self.subscriptions.forget(member)
        self.publications.forget(member)
        self.services.forget(member)
        self.actions.forget(member)
        self.goals.forget(member)
        if not self.members and self._idle is None and self.state is not ChannelState.CLOSED:
            self._idle = self._clock.callLater(self._linger, self._idle_over)

    def forget_denied(self, member: Subscriber, permit: Permit) -> None:
        """A session's rights have changed: what it may not give to the robot any more is taken back."""
        for part in (self.publications, self.services, self.actions):
            part.forget_denied(member, permit)

    def _idle_over(self) -> None:
        self._idle = None
        self._happen(ChannelEvent.SHUT)

    def shut(self) -> None:
        """Close at once, whoever is here."""
        if self._idle is not None:
            self._idle.cancel()
            self._idle = None
        self._happen(ChannelEvent.SHUT)

    # --- the robot ----------------------------------------------------------------------------------------

    def robot_online(self) -> None:
        """The robot has registered (again)."""
        self._happen(ChannelEvent.ROBOT_ONLINE)

    def robot_offline(self) -> None:
        """The control link is gone, and with it what the robot did for us."""
        self._happen(ChannelEvent.ROBOT_OFFLINE)

    def graph_changed(self) -> None:
        """The robot told of a change in its graph."""
        # Before anything is asked for by what is new.
        self._judge_again()
        self.subscriptions.graph_changed()
        self.publications.graph_changed()
        self.services.graph_changed()
        self.actions.graph_changed()

    def described(self) -> None:
        """The robot told facts about itself, or which cameras it has."""
        self._judge_again()
        if self.state is ChannelState.OPEN:
            self._robot_clock.follow()

    def _judge_again(self) -> None:
        for member in list(self.members):
            member.judge_again()

    def ends(self) -> OwnEndpoints:
        """What the robot has in its graph for our members."""
        return OwnEndpoints(
            self.publications.active(),
            self.subscriptions.active(),
            self.services.active(),
            self.actions.active(),
        )

    def joined(self, channel_link: ChannelPort) -> None:
        """The robot has come with our ticket."""
        if self.state is not ChannelState.OPENING:
            channel_link.close("this channel is not being opened")
            return
        self.wire.link = channel_link
        self._happen(ChannelEvent.JOINED)

    def link_lost(self, channel_link: ChannelPort) -> None:
        """The channel's link has ended."""
        if self.wire.link is channel_link:
            self._happen(ChannelEvent.LINK_LOST)

    def sample(self, number: int, body: bytes, stamp: int = 0) -> None:
        """Take a sample from the channel's link; this is the only entry for samples.

        :param stamp: the robot's wall clock when it came, nanoseconds since 1970; simulated time replaces it
        """
        time = self.now_ns() if self.robot.description.sim_time else stamp
        self.subscriptions.sample(number, body, time, stamp)

    def message(self, message: link.RobotChannel) -> None:
        """A message came over the channel's link."""
        take = self._takers.get(type(message))
        if take is not None:
            take(message)

    def _failed(self, message: link.Failed) -> None:
        reason = message.reason
        if message.what == "get_type":
            self._definitions.refused(message.ref, reason)
        elif message.what == "get_interfaces":
            self._interfaces.refused(reason)
        elif message.what == "send_action_goal":
            self.goals.robot_refused(message.ref, reason)
        elif message.what in (SERVICES.op, ACTIONS.op):
            offers = self.services if message.what == SERVICES.op else self.actions
            offers.refused(message.ref, reason)
        elif message.ref.isdecimal():
            refuse = {"subscribe": self.subscriptions.refused, "advertise": self.publications.refused}
            if message.what in refuse:
                refuse[message.what](int(message.ref), reason)

    def _typed(self, type_name: str) -> None:
        self.subscriptions.typed(type_name)
        self.publications.typed(type_name)

    def _untypeable(self, type_name: str, reason: str) -> None:
        self.subscriptions.type_refused(type_name, reason)
        self.publications.type_refused(type_name, reason)

    # --- life ---------------------------------------------------------------------------------------------

    def _happen(self, event: ChannelEvent) -> None:
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
            self._timer = self._clock.callLater(pause, self._ask_to_open)
        elif following is ChannelState.WAITING:
            # Also when the link had not opened yet: what was held must not be done when the robot is back.
            self.publications.lost()
            self.asking.not_opened(Unavailable(f"robot {self.robot.name} is offline"))
        elif following is ChannelState.OPEN:
            self._enter_open()
        elif following is ChannelState.CLOSED:
            self._end()

    def _ask_to_open(self) -> None:
        if self.robot.control is not None:
            ticket = self._issue_ticket(self)
            self.robot.control.send(link.OpenChannel(channel=self.name, ticket=ticket))
        self._timer = self._clock.callLater(JOIN_SECONDS, self._happen, ChannelEvent.LATE)

    def _enter_open(self) -> None:
        self._robot_clock.follow()
        self.subscriptions.opened()
        self.publications.opened()
        self.services.opened()
        self.actions.opened()
        self.asking.opened()

    def _leave_open(self, event: ChannelEvent) -> None:
        broken, self.wire.link = self.wire.link, None
        if broken is not None:
            broken.close(event.value)
        self.subscriptions.lost()
        self.publications.lost()
        self.services.lost()
        self.actions.lost()
        self.wire.asks.reset()
        self._definitions.reset()
        self._interfaces.reset()
        self._robot_clock.lost()
        self._calls.lost()
        self.served.lost()
        self.goals.lost()

    def _end(self) -> None:
        if self.robot.control is not None:
            self.robot.control.send(link.CloseChannel(channel=self.name))
        self.asking.not_opened(Unavailable("the channel was closed"))
        self.services.shut()
        self.actions.shut()
        self.robot.watchers.remove(self)
        self._closed(self)
