"""Who moves one robot: a table of states, and a value that every change replaces as a whole (SPEC section 1.7)."""

from __future__ import annotations

import enum
from collections.abc import Hashable
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

from relay_protocol.rights import Level
from relay_server.access import Permit


class LeaseState(enum.Enum):
    """How far control has come."""

    FREE = "free"
    ASKING = "asking"
    """The robot has been told who is to have it, and nobody has it before it answers."""
    RELEASING = "releasing"
    """The robot has been told that nobody has it any more."""
    HELD = "held"
    REQUESTED = "requested"
    """Held, and somebody else asks for it."""


class LeaseEvent(enum.Enum):
    """What may happen to it."""

    GIVE = "give"
    """Somebody is to have it."""
    FREE = "free"
    """Nobody is to have it any more."""
    DONE = "done"
    """The robot obeys."""
    FAILED = "failed"
    """It has not said that it does."""
    REQUEST = "request"
    WITHDRAW = "withdraw"
    """Nobody asks for it any more."""
    LOST = "lost"
    """The robot's link is gone, and with it whoever held control."""


NEXT = {
    (LeaseState.FREE, LeaseEvent.GIVE): LeaseState.ASKING,
    (LeaseState.ASKING, LeaseEvent.DONE): LeaseState.HELD,
    (LeaseState.ASKING, LeaseEvent.FAILED): LeaseState.FREE,
    (LeaseState.ASKING, LeaseEvent.FREE): LeaseState.RELEASING,
    (LeaseState.HELD, LeaseEvent.GIVE): LeaseState.ASKING,
    (LeaseState.HELD, LeaseEvent.FREE): LeaseState.RELEASING,
    (LeaseState.HELD, LeaseEvent.REQUEST): LeaseState.REQUESTED,
    (LeaseState.REQUESTED, LeaseEvent.REQUEST): LeaseState.REQUESTED,
    (LeaseState.REQUESTED, LeaseEvent.WITHDRAW): LeaseState.HELD,
    (LeaseState.REQUESTED, LeaseEvent.GIVE): LeaseState.ASKING,
    (LeaseState.REQUESTED, LeaseEvent.FREE): LeaseState.RELEASING,
    (LeaseState.RELEASING, LeaseEvent.DONE): LeaseState.FREE,
    (LeaseState.RELEASING, LeaseEvent.FAILED): LeaseState.FREE,
    **{(state, LeaseEvent.LOST): LeaseState.FREE for state in LeaseState},
}


class LeaseClient(Hashable, Protocol):
    """One connection, as control knows it.

    :ivar number: the source of its commands
    :ivar name: its user's
    :ivar user: that user's number
    :ivar address: where it is, for people
    :ivar opened: the relay's clock when it came
    """

    number: int
    opened: float
    permit: Permit
    address: str

    @property
    def name(self) -> str:
        """Its user's name."""

    @property
    def user(self) -> int:
        """Whose it is."""

    def tell(self, level: str, text: str) -> None:
        """Report something in words, to clients that want to hear it."""

    def driving_since(self) -> float:
        """The relay's clock at its latest command that moves; now, while something it asked for moves the robot."""

    def commanding_since(self) -> float:
        """The same for its latest command, were it a zero or one that did not pass."""

    def heard_driving(self) -> float:
        """The relay's clock when it last proved that it is there; endless once it has let go: its latest commands that
        passed, one on each topic, were zero."""

    def control_changed(self) -> None:
        """Who moves the robot has changed: what waited for it goes, or never will."""


def owns(client: LeaseClient) -> bool:
    """Whether the client is an owner of the robot, by its rights as they stand."""
    return client.permit.rules.level is Level.OWNER


class Holder(NamedTuple):
    """Somebody has control, or is to have it.

    :param since: Unix time, seconds
    :param implicit: whether a command took it, and nobody who can be asked has said that he wants it
    """

    client: LeaseClient
    since: float
    implicit: bool = False


class ControlRequest(NamedTuple):
    """Somebody asks for it.

    :param since: Unix time, seconds
    :param until: Unix time from which an owner takes over by asking again
    """

    client: LeaseClient
    since: float
    until: float
    why: str


@dataclass(frozen=True)
class Lease:
    """Who has control of a robot, who is about to get it, who asks for it.

    Commands of ``holder`` pass, and of nobody else: there is none before the robot has said that it obeys him.

    :param coming: who is to have it when the robot has answered
    """

    state: LeaseState = LeaseState.FREE
    holder: Holder | None = None
    coming: Holder | None = None
    request: ControlRequest | None = None

    @property
    def settled(self) -> bool:
        """Whether no answer of the robot is waited for."""
        return self.state not in (LeaseState.ASKING, LeaseState.RELEASING)

    def held_by(self, client: LeaseClient) -> bool:
        """Whether this connection moves the robot."""
        return self.holder is not None and self.holder.client is client

    def requested_by(self, client: LeaseClient) -> bool:
        """Whether this connection asks for control."""
        return self.request is not None and self.request.client is client

    def coming_to(self, client: LeaseClient) -> bool:
        """Whether this connection is to have control when the robot has answered."""
        return self.coming is not None and self.coming.client is client

    def give(self, client: LeaseClient, now: float, implicit: bool = False) -> Lease:
        """The robot is being told that this client is to have it. Who asked for it asks no more."""
        return Lease(self._after(LeaseEvent.GIVE), coming=Holder(client, now, implicit))

    def meant(self) -> Lease:
        """Who has control has said that he wants it."""
        assert self.holder is not None
        return replace(self, holder=self.holder._replace(implicit=False))

    def free(self) -> Lease:
        """The robot is being told that nobody has it."""
        return Lease(self._after(LeaseEvent.FREE))

    def done(self, now: float) -> Lease:
        """The robot obeys."""
        state = self._after(LeaseEvent.DONE)
        coming = self.coming
        return Lease(state, holder=None if coming is None else coming._replace(since=now))

    def failed(self) -> Lease:
        """It has not said that it does."""
        return Lease(self._after(LeaseEvent.FAILED))

    def requested(self, request: ControlRequest) -> Lease:
        """Somebody asks for it, in the place of who asked before."""
        return replace(self, state=self._after(LeaseEvent.REQUEST), request=request)

    def withdrawn(self) -> Lease:
        """Nobody asks for it any more."""
        return replace(self, state=self._after(LeaseEvent.WITHDRAW), request=None)

    def lost(self) -> Lease:
        """The robot's link is gone."""
        return Lease(self._after(LeaseEvent.LOST))

    def _after(self, event: LeaseEvent) -> LeaseState:
        following = NEXT.get((self.state, event))
        if following is None:
            raise ValueError(f"'{event.value}' can't happen while control is {self.state.value}")
        return following


FREE = Lease()
"""Nobody has it."""
