"""Users whose connection ended while they held on to the stick: to connect anew is no letting go (SPEC section 1.7).

Libraries connect anew by themselves, go on commanding, and send what waited in their queues meanwhile. Nobody can tell
that from a program that was started anew, so it is judged by time and by how the connection ended.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import NamedTuple

from relay_protocol.errors import Refused
from relay_server.common.clock import Clock
from relay_server.control.lease import LeaseClient
from relay_server.control.types import LET_GO_SECONDS, USERS

HELD_SECONDS = 1.0
"""Who was heard last so soon after a command, or sooner, had not let go: what pings tell is not more exact."""

RETURN_SECONDS = 5.0
"""Who comes back later begins, as at a robot whose link was lost (SPEC section 2.5)."""

QUEUED_SECONDS = 300.0
"""What comes at once by a new connection may have waited for it, also so long."""


def held_on(client: LeaseClient, since: float) -> bool:
    """Whether a client that is gone had not let go when it was heard last.

    :param since: the clock at its latest command
    """
    return client.heard_driving() - since < HELD_SECONDS


class _Gone(NamedTuple):
    """A connection that is gone.

    :param commanded: the clock at its latest command
    :param ended: the clock when it was known to be gone; ``None`` where its user had let go, or has closed it himself
    """

    commanded: float
    ended: float | None


class ReconnectGuard:
    """By user, how his latest connection ended that had lost control by that."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._gone: OrderedDict[int, _Gone] = OrderedDict()

    def note(self, user: int, commanded: float, *, held_on: bool) -> None:
        """A connection is gone, or nothing comes from it any more.

        :param commanded: the clock at its latest command
        :param held_on: whether it is unknown that its user has let go
        """
        before = self._gone.pop(user, None)
        ended = self._clock.seconds() if held_on else None
        if before is not None:
            commanded = max(commanded, before.commanded)
            ended = before.ended if ended is None else ended
        self._gone[user] = _Gone(commanded, ended)
        while len(self._gone) > USERS:
            self._gone.popitem(last=False)

    def forget(self, user: int) -> None:
        """The user has asked for control in so many words, or has let go: what comes from now on he means."""
        self._gone.pop(user, None)

    def silent_since(self, client: LeaseClient) -> float | None:
        """From when on the client's silence counts as letting go; ``None`` where it need not.

        :raises Refused: what it says now may have waited for its connection
        """
        gone = self._gone.get(client.user)
        if gone is None:
            return None
        if gone.ended is None:
            return gone.commanded
        away = client.opened - gone.ended
        if away <= RETURN_SECONDS:
            # Nothing was heard of him while there was no connection: that is no silence of his.
            return max(gone.commanded, client.opened)
        if away <= QUEUED_SECONDS and self._clock.seconds() - client.opened < LET_GO_SECONDS:
            raise Refused(
                "your connection was lost while you drove, and what comes at once by a new one may have waited for it"
            )
        return None
