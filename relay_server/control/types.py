"""Values and rules of control."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from relay_protocol.rights import Operation
from relay_server.access import Permit
from relay_server.config import RelaySettings
from relay_server.control.lease import Lease, LeaseClient
from relay_server.control.stopping import StopState

ROBOT = "/"
"""The resource of the right to control: the robot as a whole."""

IMPLICIT = "its first command"
"""The recorded reason where a command acquired control."""

DESERTED_SECONDS = 2.0
"""Seconds without a moving command of the holder, after which a command of another connection of its user acquires
control."""

TAKES_A_SECOND = 5.0
TAKES_AT_ONCE = 20
"""Rate and burst at which a user may take or request control of a robot, as each time is recorded."""

REFUSED_SECONDS = 10.0
"""Seconds before a user who was refused control can ask the same holder again."""

USERS = 256
"""Most users remembered for each robot; the least recent are forgotten first."""


class ControlRules(NamedTuple):
    """Settings of control.

    :param explicit: whether control has to be taken explicitly; else the first command to a free robot acquires it
    :param grace: seconds the holder has to answer a request before an owner may take over
    :param idle: seconds without a moving command after which control ends
    :param request: seconds the holder has to answer a request before it lapses
    """

    explicit: bool = False
    grace: float = 30.0
    idle: float = 600.0
    request: float = 60.0

    @classmethod
    def of(cls, settings: RelaySettings) -> ControlRules:
        """Take the rules from the relay's settings."""
        times = settings.control_grace, settings.control_idle, settings.control_request
        return cls(settings.explicit_control, *times)


class ControlReply(NamedTuple):
    """The answer to a request about control.

    :param message: for display
    """

    success: bool
    message: str


class ControlSnapshot(NamedTuple):
    """Everything that decides whether a command passes.

    It is replaced as a whole when it changes, so that holders of the same object need not check again.

    :param lease: which client has control of the robot
    :param suppressing: by topic, the numbers of the clients that suppress the commands of all others; theirs pass
        without control
    :param stopped: the stop that holds; ``None``: the robot may move
    """

    lease: Lease
    suppressing: Mapping[str, frozenset[int]]
    stopped: StopState | None


def acts_for(permit: Permit, client: LeaseClient) -> bool:
    """Whether the bearer of this permit may act for a connection: it belongs to the same user, and the scope of the
    token allows control."""
    own = client.user == permit.principal.user_id
    return own and (permit.principal.scope is None or permit.decide(Operation.CONTROL, ROBOT).allowed)
