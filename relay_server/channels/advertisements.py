"""Services and actions that clients offer to a robot's graph: each name once, by one client."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

from relay_protocol import link, rosbridge
from relay_protocol.errors import Invalid, NotFound, Refused
from relay_protocol.rights import Operation
from relay_server.access import Permit
from relay_server.channels.definitions import Definitions
from relay_server.channels.robot_link import Request, RobotLinkState, Subscriber
from relay_server.channels.topics import RequestPhase
from relay_server.robots.graph import GraphMirror

OFFERS = 128
"""Services, and again actions, that one connection may offer."""

USER_OFFERS = 256
"""Services, and again actions, of one robot that one user may offer, over all connections."""

RESERVED = ("/relay/", "/rosapi/")
"""How the names begin that are the relay's own."""


class Provider(Subscriber, Protocol):
    """A session that offers something."""

    @property
    def name(self) -> str:
        """The user's name."""

    def say(self, message: bytes) -> None:
        """Queue a message that must not be lost, JSON."""


class Kind(NamedTuple):
    """What tells services from actions.

    :param word: what people call it
    :param advertise: the request that has the robot offer it; takes name, type and who offers it
    :param withdraw: the request that ends that
    :param provided: whether a node of the robot provides this name
    """

    word: str
    advertise: Callable[[str, str, str], link.Message]
    withdraw: Callable[[str], link.Message]
    provided: Callable[[GraphMirror, str], bool]

    @property
    def op(self) -> str:
        """The request's name on the link."""
        return f"advertise_{self.word}"


SERVICES = Kind(
    "service",
    lambda name, type_name, who: link.AdvertiseService(service=name, type=type_name, source=who),
    lambda name: link.UnadvertiseService(service=name),
    lambda graph, name: name in graph.services and bool(graph.services[name].providers),
)
ACTIONS = Kind(
    "action",
    lambda name, type_name, who: link.AdvertiseAction(action=name, type=type_name, source=who),
    lambda name: link.UnadvertiseAction(action=name),
    lambda graph, name: name in graph.actions and bool(graph.actions[name].providers),
)


class ClientAdvertisement:
    """A service or action of a client.

    :param written: its name as the client writes it
    :param written_type: its type as the client writes it; rosbridge hands both back so
    :param id: of the client's request
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
        self.trouble = ""
        """Why the robot can't offer it, as the client was told."""


class ClientAdvertisements:
    """Keeps what the robot offers in step with what clients offer.

    :param ended: called with each offer that is over, and why
    """

    def __init__(
        self,
        wire: RobotLinkState,
        definitions: Definitions,
        kind: Kind,
        ended: Callable[[ClientAdvertisement, str], None],
    ) -> None:
        self._wire = wire
        self._definitions = definitions
        self._kind = kind
        self._ended = ended
        self._offers: dict[str, ClientAdvertisement] = {}

    def standing(self, name: str) -> ClientAdvertisement | None:
        """The offer of this name, unless the robot could not make it good, or has it itself."""
        offer = self._offers.get(name)
        return None if offer is None or offer.phase is RequestPhase.FAILED else offer

    def active(self) -> tuple[tuple[str, str], ...]:
        """Names the robot offers for us, with their types."""
        return tuple(
            (each.name, each.type) for each in self._offers.values() if each.phase is RequestPhase.ACTIVE
        )

    def check(self, offer: ClientAdvertisement) -> None:
        """:raises NotFound: the offer is over"""
        if self.standing(offer.name) is not offer:
            raise NotFound(f"the client that offered {offer.name} does so no more")

    def advertise(
        self,
        member: Provider,
        name: str,
        written: str,
        type_name: str,
        written_type: str,
        id: rosbridge.Id = None,
    ) -> None:
        """A client offers something. The same once more changes its spelling at most.

        :raises Refused: the name is the relay's own; the client or its user offers too much
        :raises Invalid: the name is taken, or there is no type
        """
        word = self._kind.word
        if f"{name}/".startswith(RESERVED):
            raise Refused(f"{name}: names under /relay and /rosapi are the relay's own")
        if "/_action/" in name:
            raise Refused(f"{name}: ROS keeps names with /_action/ for the parts of actions")
        if not type_name:
            raise Invalid(f"{word} {name} needs a type")
        former = self._offers.get(name)
        if former is not None and former.member is member and former.type == type_name:
            former.written, former.written_type = written, written_type
            return
        if former is not None:
            whose = "you offer" if former.member is member else "another client offers"
            raise Invalid(f"{whose} the {word} {name} already")
        if self._kind.provided(self._wire.robot.graph, name):
            raise Invalid(f"the robot offers the {word} {name} itself")
        self._check_room(member)
        self._wire.take_name()
        offer = self._offers[name] = ClientAdvertisement(name, written, type_name, written_type, member, id)
        self._ask(offer)

    def unadvertise(self, member: Provider, name: str) -> None:
        """A client takes its offer back.

        :raises Invalid: it has none of this name
        """
        offer = self._offers.get(name)
        if offer is None or offer.member is not member:
            raise Invalid(f"you do not offer the {self._kind.word} {name}")
        self._end(offer, f"the client that offered {name} has withdrawn it")

    def forget(self, member: Subscriber) -> None:
        """A client has gone."""
        for offer in list(self._offers.values()):
            if offer.member is member:
                self._end(offer, f"the client that offered {offer.name} has left")

    def forget_denied(self, member: Subscriber, permit: Permit) -> None:
        """A client's rights have changed: what it may not offer any more is taken back."""
        for offer in list(self._offers.values()):
            if offer.member is member:
                verdict = permit.judge(Operation.PROVIDE, offer.name)
                if not verdict.allowed:
                    self._end(offer, f"the client that offered {offer.name} may not do so any more")
                    member.tell("error", f"unadvertised {offer.name}: {verdict.reason}", offer.id)

    def shut(self) -> None:
        """The channel is over."""
        for offer in list(self._offers.values()):
            self._end(offer, "the channel was closed")

    def opened(self) -> None:
        """The robot is there: offer everything."""
        for offer in list(self._offers.values()):
            if self._provided(offer):
                self._give_way(offer)
            else:
                self._ask(offer)

    def lost(self) -> None:
        """The robot's side is gone."""
        for offer in self._offers.values():
            offer.phase = RequestPhase.WAITING

    def graph_changed(self) -> None:
        """What the robot has itself now gives way to it; what it could not offer may be possible now."""
        for offer in list(self._offers.values()):
            if self._provided(offer):
                self._give_way(offer)
            elif offer.phase is RequestPhase.FAILED:
                self._ask(offer)

    def advertised(self, name: str) -> None:
        """The robot offers it."""
        offer = self._answered(name)
        if offer is not None:
            offer.phase = RequestPhase.ACTIVE
            offer.trouble = ""
        self._wire.asks.answered((self._kind.op, name))

    def refused(self, name: str, reason: str) -> None:
        """The robot can't offer it."""
        offer = self._answered(name)
        if offer is not None:
            self._fail(offer, reason)
        self._wire.asks.answered((self._kind.op, name))

    def _answered(self, name: str) -> ClientAdvertisement | None:
        """The offer an answer of the robot is about: not one that was made of this name since."""
        offer = self._offers.get(name)
        return offer if offer is not None and offer.phase is RequestPhase.ASKED else None

    def _check_room(self, member: Provider) -> None:
        mine = sum(offer.member is member for offer in self._offers.values())
        if mine >= OFFERS:
            raise Refused(f"at most {OFFERS} {self._kind.word}s can be offered on one connection")
        if sum(offer.member.user == member.user for offer in self._offers.values()) >= USER_OFFERS:
            raise Refused(f"you offer {USER_OFFERS} {self._kind.word}s on this robot, the most one user may")

    def _ask(self, offer: ClientAdvertisement) -> None:
        if self._wire.link is None:
            return
        offer.phase = RequestPhase.WAITING
        self._definitions.want(offer.type)
        message = self._kind.advertise(offer.name, offer.type, offer.member.name)

        def sent() -> None:
            offer.phase = RequestPhase.ASKED

        self._wire.asks.ask(Request((self._kind.op, offer.name), message, sent))

    def _fail(self, offer: ClientAdvertisement, reason: str) -> None:
        offer.phase = RequestPhase.FAILED
        if offer.trouble != reason:
            offer.trouble = reason
            offer.member.tell("error", f"{self._kind.op} {offer.name}: {reason}", offer.id)

    def _provided(self, offer: ClientAdvertisement) -> bool:
        return self._kind.provided(self._wire.robot.graph, offer.name)

    def _give_way(self, offer: ClientAdvertisement) -> None:
        """Who calls what the robot has must not be answered by a client that was there before it."""
        if offer.phase is RequestPhase.FAILED:
            return
        reason = f"the robot offers the {self._kind.word} {offer.name} itself"
        self._withdraw(offer)
        self._fail(offer, reason)
        self._ended(offer, reason)

    def _end(self, offer: ClientAdvertisement, reason: str) -> None:
        del self._offers[offer.name]
        self._wire.names -= 1
        self._withdraw(offer)
        self._ended(offer, reason)

    def _withdraw(self, offer: ClientAdvertisement) -> None:
        self._wire.asks.withdraw((self._kind.op, offer.name))
        if offer.phase in (RequestPhase.ASKED, RequestPhase.ACTIVE):
            self._wire.send(self._kind.withdraw(offer.name))
