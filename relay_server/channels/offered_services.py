"""Services and actions that clients offer in a robot's graph: each name once, by one client."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

from relay_protocol import link, rosbridge
from relay_protocol.errors import Invalid, NotFound, Refused
from relay_protocol.rights import Operation
from relay_server.access import Permit
from relay_server.channels.definitions import Definitions
from relay_server.channels.link_state import RobotLinkState
from relay_server.channels.members import ChannelMember
from relay_server.channels.robot_requests import RequestPhase, RobotRequest
from relay_server.robots.registry import GraphMirror

MAX_OFFERS = 128
"""Most services of one connection; its actions are counted on their own."""

USER_OFFERS = 256
"""Most services of one user on one robot, over all connections; actions are counted on their own."""

RESERVED = ("/relay/", "/rosapi/")
"""Prefixes of the relay's own names."""


class ProviderPort(Protocol):
    """Sends calls and goals to a client that offers a service or action. Arguments are JSON."""

    def call_service(self, service: str, id: str, args: bytes) -> None:
        """Call the service; the client answers with this id."""

    def send_action_goal(self, action: str, id: str, type: str, args: bytes, feedback: bool) -> None:
        """Send the client a goal."""

    def cancel_action_goal(self, action: str, id: str) -> None:
        """Request the client to cancel a goal."""


class Provider(ChannelMember, Protocol):
    """A session that offers services or actions."""

    @property
    def name(self) -> str:
        """Name of its user."""

    @property
    def port(self) -> ProviderPort:
        """Port to which its calls and goals are sent."""


class Kind(NamedTuple):
    """The differences between services and actions.

    :param word: "service" or "action", for error texts
    :param advertise: makes the request to the robot to offer it, from its name, its type and the name of the user
    :param withdraw: makes the request to the robot to stop offering it
    :param provided: whether a node of the robot provides this name
    """

    word: str
    advertise: Callable[[str, str, str], link.Message]
    withdraw: Callable[[str], link.Message]
    provided: Callable[[GraphMirror, str], bool]

    @property
    def op(self) -> str:
        """Name of the request on the robot link."""
        return f"advertise_{self.word}"


SERVICES = Kind(
    "service",
    lambda name, type_name, user: link.AdvertiseService(service=name, type=type_name, user=user),
    lambda name: link.UnadvertiseService(service=name),
    lambda graph, name: name in graph.services and bool(graph.services[name].providers),
)
ACTIONS = Kind(
    "action",
    lambda name, type_name, user: link.AdvertiseAction(action=name, type=type_name, user=user),
    lambda name: link.UnadvertiseAction(action=name),
    lambda graph, name: name in graph.actions and bool(graph.actions[name].providers),
)


class OfferedService:
    """A service or action that a client offers.

    :param written: its name as the client writes it
    :param written_type: its type as the client writes it; calls and goals are sent with both
    :param id: of the client's operation
    """

    def __init__(
        self,
        name: str,
        written: str,
        type_name: str,
        written_type: str,
        member: Provider,
        id: rosbridge.Id = None,
    ) -> None:
        self.name = name
        self.id = id
        self.written = written
        self.type = type_name
        self.written_type = written_type
        self.member = member
        self.phase = RequestPhase.WAITING
        self.notified_error = ""
        """The error of which the client was last notified; empty: none."""


class OfferedServices:
    """Keeps the robot's service or action servers equal to what clients offer.

    :param ended: called with each one that has ended, and the reason
    """

    def __init__(
        self,
        link_state: RobotLinkState,
        definitions: Definitions,
        kind: Kind,
        ended: Callable[[OfferedService, str], None],
    ) -> None:
        self._link_state = link_state
        self._definitions = definitions
        self._kind = kind
        self._ended = ended
        self._offered: dict[str, OfferedService] = {}

    def find_usable(self, name: str) -> OfferedService | None:
        """The service or action that a client offers under a name.

        :returns: ``None``: there is none, the robot refused it, or has the name itself
        """
        offered = self._offered.get(name)
        return None if offered is None or offered.phase is RequestPhase.FAILED else offered

    def active(self) -> tuple[tuple[str, str], ...]:
        """Names that the robot offers for clients, with their types."""
        return tuple(
            (each.name, each.type) for each in self._offered.values() if each.phase is RequestPhase.ACTIVE
        )

    def check(self, offered: OfferedService) -> None:
        """:raises NotFound: the client does not offer it any more"""
        if self.find_usable(offered.name) is not offered:
            raise NotFound(f"the client that offered {offered.name} does not offer it any more")

    def advertise(
        self,
        member: Provider,
        name: str,
        written: str,
        type_name: str,
        written_type: str,
        id: rosbridge.Id = None,
    ) -> None:
        """Offer a service or action of a client. A repetition can only change the spelling.

        :raises Refused: the name is the relay's own, or the client or its user has too many
        :raises Invalid: the name is taken, or there is no type
        """
        word = self._kind.word
        if f"{name}/".startswith(RESERVED):
            raise Refused(f"{name}: names under /relay and /rosapi are the relay's own")
        if "/_action/" in name:
            raise Refused(f"{name}: ROS keeps names with /_action/ for the parts of actions")
        if not type_name:
            raise Invalid(f"{word} {name} needs a type")
        former = self._offered.get(name)
        if former is not None and former.member is member and former.type == type_name:
            former.written, former.written_type = written, written_type
            return
        if former is not None:
            whose = "you offer" if former.member is member else "another client offers"
            raise Invalid(f"{whose} the {word} {name} already")
        if self._kind.provided(self._link_state.robot.graph, name):
            raise Invalid(f"the robot offers the {word} {name} itself")
        self._check_room(member)
        self._link_state.reserve_name()
        offered = self._offered[name] = OfferedService(name, written, type_name, written_type, member, id)
        self._advertise_on_robot(offered)

    def unadvertise(self, member: Provider, name: str) -> None:
        """Withdraw what a client offers under a name.

        :raises Invalid: it has none of this name
        """
        offered = self._offered.get(name)
        if offered is None or offered.member is not member:
            raise Invalid(f"you do not offer the {self._kind.word} {name}")
        self._end(offered, f"the client that offered {name} has withdrawn it")

    def forget(self, member: ChannelMember) -> None:
        """End what a client offered, as it has left."""
        for offered in list(self._offered.values()):
            if offered.member is member:
                self._end(offered, f"the client that offered {offered.name} has left")

    def forget_denied(self, member: ChannelMember, permit: Permit) -> None:
        """End what a client offers and has no right to offer any more."""
        for offered in list(self._offered.values()):
            if offered.member is member:
                decision = permit.decide(Operation.PROVIDE, offered.name)
                if not decision.allowed:
                    self._end(offered, f"the client that offered {offered.name} may not do so any more")
                    member.notify("error", f"unadvertised {offered.name}: {decision.reason}", offered.id)

    def close(self) -> None:
        """End all, as the channel is closed."""
        for offered in list(self._offered.values()):
            self._end(offered, "the channel was closed")

    def opened(self) -> None:
        """The channel is open: advertise on the robot."""
        for offered in list(self._offered.values()):
            if self._provided(offered):
                self._give_up_name(offered)
            else:
                self._advertise_on_robot(offered)

    def lost(self) -> None:
        """The link is lost, and with it the robot's servers."""
        for offered in self._offered.values():
            offered.phase = RequestPhase.WAITING

    def graph_changed(self) -> None:
        """End those whose names the robot has itself now, and try again those that it refused."""
        for offered in list(self._offered.values()):
            if self._provided(offered):
                self._give_up_name(offered)
            elif offered.phase is RequestPhase.FAILED:
                self._advertise_on_robot(offered)

    def advertised(self, name: str) -> None:
        """The robot has carried out a request to advertise."""
        offered = self._answered(name)
        if offered is not None:
            offered.phase = RequestPhase.ACTIVE
            offered.notified_error = ""
        self._link_state.robot_requests.answered((self._kind.op, name))

    def refused(self, name: str, reason: str) -> None:
        """The robot has refused a request to advertise."""
        offered = self._answered(name)
        if offered is not None:
            self._fail(offered, reason)
        self._link_state.robot_requests.answered((self._kind.op, name))

    def _answered(self, name: str) -> OfferedService | None:
        """The one that an answer of the robot is for; ``None`` if a newer one has the name."""
        offered = self._offered.get(name)
        return offered if offered is not None and offered.phase is RequestPhase.REQUESTED else None

    def _check_room(self, member: Provider) -> None:
        mine = sum(offered.member is member for offered in self._offered.values())
        if mine >= MAX_OFFERS:
            raise Refused(f"at most {MAX_OFFERS} {self._kind.word}s can be offered on one connection")
        if sum(offered.member.user == member.user for offered in self._offered.values()) >= USER_OFFERS:
            raise Refused(f"you offer {USER_OFFERS} {self._kind.word}s on this robot, the most one user may")

    def _advertise_on_robot(self, offered: OfferedService) -> None:
        if self._link_state.link is None:
            return
        offered.phase = RequestPhase.WAITING
        self._definitions.request(offered.type)
        message = self._kind.advertise(offered.name, offered.type, offered.member.name)

        def on_sent() -> None:
            offered.phase = RequestPhase.REQUESTED

        self._link_state.robot_requests.put(RobotRequest((self._kind.op, offered.name), message, on_sent))

    def _fail(self, offered: OfferedService, reason: str) -> None:
        offered.phase = RequestPhase.FAILED
        if offered.notified_error != reason:
            offered.notified_error = reason
            offered.member.notify("error", f"{self._kind.op} {offered.name}: {reason}", offered.id)

    def _provided(self, offered: OfferedService) -> bool:
        return self._kind.provided(self._link_state.robot.graph, offered.name)

    def _give_up_name(self, offered: OfferedService) -> None:
        """Withdraw a name that the robot has itself now, so that no client answers calls to it."""
        if offered.phase is RequestPhase.FAILED:
            return
        reason = f"the robot offers the {self._kind.word} {offered.name} itself"
        self._withdraw(offered)
        self._fail(offered, reason)
        self._ended(offered, reason)

    def _end(self, offered: OfferedService, reason: str) -> None:
        del self._offered[offered.name]
        self._link_state.names_in_use -= 1
        self._withdraw(offered)
        self._ended(offered, reason)

    def _withdraw(self, offered: OfferedService) -> None:
        self._link_state.robot_requests.withdraw((self._kind.op, offered.name))
        if offered.phase in (RequestPhase.REQUESTED, RequestPhase.ACTIVE):
            self._link_state.send(self._kind.withdraw(offered.name))
