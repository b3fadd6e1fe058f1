"""Words and rules of control: what else is needed to say who moves a robot."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from relay_protocol.rights import Operation
from relay_server.access import Permit
from relay_server.config import RelaySettings
from relay_server.control.audit import Actor
from relay_server.control.lease import Lease, LeaseClient
from relay_server.control.stopping import StopState

ROBOT = "/"
"""The resource of the right to control: the robot as a whole."""

IMPLICIT = "its first command"
"""Why a program has control that has never asked for it."""

DESERTED_SECONDS = 2.0
"""A user's other connection takes control by a command when the one that has it has given none for so long."""

LET_GO_SECONDS = 0.5
"""Silence of this length is letting go, as on the robot (SPEC 2.5)."""

TAKES_A_SECOND = 5.0
TAKES_AT_ONCE = 20
"""How often a user takes control of a robot or asks for it; each time is put on record."""

REST_SECONDS = 10.0
"""Who was refused control asks the same holder for it again only after so long."""

USERS = 256
"""Users remembered for each robot; the longest quiet are forgotten first."""


class ControlRules(NamedTuple):
    """How control is handed out.

    :param explicit: no command takes a free robot; control is taken by ``/relay/take_control`` alone
    :param grace: seconds the holder has to answer a request, before an owner may take over
    :param idle: seconds without a command that moves, after which control is free again
    :param request: seconds the holder has to answer a request, before it lapses: others may ask then
    """

    explicit: bool = False
    grace: float = 30.0
    idle: float = 600.0
    request: float = 60.0

    @classmethod
    def of(cls, settings: RelaySettings) -> ControlRules:
        """As an operator has set them."""
        asked = settings.control_grace, settings.control_idle, settings.control_request
        return cls(settings.explicit_control, *asked)


class ControlReply(NamedTuple):
    """What becomes of something a client asks for.

    :param message: for people
    """

    success: bool
    message: str


class ControlSnapshot(NamedTuple):
    """All that decides whether a command passes. Replaced as a whole: while it is the same object, so is the answer."""

    lease: Lease
    suppressed: Mapping[str, frozenset[int]]
    stopped: StopState | None


def acts_for(permit: Permit, client: LeaseClient) -> bool:
    """Whether who has this permit may use this connection's control: it is his own, and his token is not for less."""
    own = client.user == permit.principal.user_id
    return own and (permit.principal.scope is None or permit.judge(Operation.CONTROL, ROBOT).allowed)


def actor_of(client: LeaseClient) -> Actor:
    """A client, as the record knows who does something."""
    return Actor(client.name, f"user:{client.name}", client.user, client.address, client.number)
