"""The lease of one robot: a table of states, and a value that every change replaces as a whole (SPEC 1.7)."""

from __future__ import annotations

import enum
from collections.abc import Hashable
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

from relay_protocol.rights import Level
from relay_server.access import Permit


class LeaseState(enum.Enum):
    """The state of control."""

    FREE = "free"
    ASKING = "asking"
    """A client is to get control; until the robot confirms, no client has it."""
    RELEASING = "releasing"
    """No client is to have control; the robot has not confirmed."""
    HELD = "held"
    REQUESTED = "requested"
    """Held, and requested by another client."""


class LeaseEvent(enum.Enum):
    """Events that change the state of control."""

    GIVE = "give"
    """A client is to get control."""
    FREE = "free"
    """Control is to end."""
    DONE = "done"
    """The robot has confirmed."""
    FAILED = "failed"
    """The robot has not confirmed."""
    REQUEST = "request"
    WITHDRAW = "withdraw"
    """The request has ended."""
    LOST = "lost"
    """The robot's link is lost."""


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
    """One client connection, as far as control needs it.

    :ivar number: identifies the connection as a source of commands
    :ivar address: network address, for display
    :ivar opened: when it was opened, seconds of the relay's clock
    """

    number: int
    opened: float
    permit: Permit
    address: str

    @property
    def name(self) -> str:
        """The name of its user."""

    @property
    def user(self) -> int:
        """The id of its user."""

    def notify(self, level: str, text: str) -> None:
        """Send a status message, if the client receives messages of this level."""

    def last_motion_at(self) -> float:
        """Time of its latest moving command, by the relay's clock; now, while one of its goals moves the robot."""

    def last_command_at(self) -> float:
        """Time of its latest command, including zero and refused ones, seconds of the relay's clock."""

    def last_alive_while_driving(self) -> float:
        """When it last proved to be alive while it drove, seconds of the relay's clock. Infinite once it has released
        the controls: on each topic its latest command that passed was zero."""

    def control_changed(self) -> None:
        """Called when the holder of control has changed: waiting commands are sent or dropped."""


def owns(client: LeaseClient) -> bool:
    """Whether the client is an owner of the robot by its current rights."""
    return client.permit.rules.level is Level.OWNER


class Holder(NamedTuple):
    """A client that has control, or is to get it.

    :param since: Unix time, seconds
    :param implicit: whether a command acquired it, and the client has not taken it explicitly since
    """

    client: LeaseClient
    since: float
    implicit: bool = False


class ControlRequest(NamedTuple):
    """A request for control, while another client has it.

    :param since: Unix time, seconds
    :param until: Unix time from which an owner takes over by asking again
    """

    client: LeaseClient
    since: float
    until: float
    why: str


@dataclass(frozen=True)
class Lease:
    """The holder of control of a robot, the next one, and the request.

    Only commands of ``holder`` pass. It is ``None`` until the robot has confirmed.

    :param pending_holder: the holder once the robot has confirmed
    """

    state: LeaseState = LeaseState.FREE
    holder: Holder | None = None
    pending_holder: Holder | None = None
    request: ControlRequest | None = None

    @property
    def settled(self) -> bool:
        """Whether no confirmation of the robot is pending."""
        return self.state not in (LeaseState.ASKING, LeaseState.RELEASING)

    def held_by(self, client: LeaseClient) -> bool:
        """Whether this connection has control."""
        return self.holder is not None and self.holder.client is client

    def requested_by(self, client: LeaseClient) -> bool:
        """Whether this connection requests control."""
        return self.request is not None and self.request.client is client

    def pending_for(self, client: LeaseClient) -> bool:
        """Whether this connection has control once the robot has confirmed."""
        return self.pending_holder is not None and self.pending_holder.client is client

    def give(self, client: LeaseClient, now: float, implicit: bool = False) -> Lease:
        """The lease when this client is to get control; it ends the request."""
        return Lease(self._next_state(LeaseEvent.GIVE), pending_holder=Holder(client, now, implicit))

    def made_explicit(self) -> Lease:
        """The lease when the holder has taken control explicitly."""
        assert self.holder is not None
        return replace(self, holder=self.holder._replace(implicit=False))

    def free(self) -> Lease:
        """The lease when control is to end."""
        return Lease(self._next_state(LeaseEvent.FREE))

    def done(self, now: float) -> Lease:
        """The lease when the robot has confirmed."""
        state = self._next_state(LeaseEvent.DONE)
        pending = self.pending_holder
        return Lease(state, holder=None if pending is None else pending._replace(since=now))

    def failed(self) -> Lease:
        """The lease when the robot has not confirmed."""
        return Lease(self._next_state(LeaseEvent.FAILED))

    def requested(self, request: ControlRequest) -> Lease:
        """The lease when a client requests control; it ends an earlier request."""
        return replace(self, state=self._next_state(LeaseEvent.REQUEST), request=request)

    def withdrawn(self) -> Lease:
        """The lease when the request has ended."""
        return replace(self, state=self._next_state(LeaseEvent.WITHDRAW), request=None)

    def lost(self) -> Lease:
        """The lease when the robot's link is lost."""
        return Lease(self._next_state(LeaseEvent.LOST))

    def _next_state(self, event: LeaseEvent) -> LeaseState:
        following = NEXT.get((self.state, event))
        if following is None:
            raise ValueError(f"'{event.value}' can't happen while control is {self.state.value}")
        return following


FREE = Lease()
"""No client has control."""
