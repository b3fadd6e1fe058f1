"""Whether somebody drove the robot when its link was lost: a person is told so, as soon as a relay can be reached.

A relay that goes on knows it by itself (SPEC section 1.10). One that was killed has forgotten who had control.
"""

from __future__ import annotations

from collections.abc import Callable

from relay_protocol import link
from robot_client.motion.authority import NOBODY


class LinkLossAlert:
    """Listens to what the relay is told of who moves the robot.

    :param now: the clock of the links, nanoseconds
    """

    def __init__(self, now: Callable[[], int]) -> None:
        self._now = now
        self._driven = False
        self._until = 0
        """When somebody last drove it."""
        self._user = ""

    def said(self, told: link.Safety, user: str) -> None:
        """The relay is told how it is.

        :param user: who has control, by name
        """
        driven = told.moving and told.holder != NOBODY
        if self._driven:
            self._until = self._now()
        if driven:
            self._user = user
        self._driven = driven

    def lost(self, proved: int | None) -> str | None:
        """The link is gone; who drove the robot when it was last known to work, by name.

        The robot may stand by now: it stops when its channels end, and when nothing proves the link any more.

        :param proved: when the latest ping was sent that the relay has answered, nanoseconds; ``None``: none was
        """
        driven = self._driven or (proved is not None and self._until >= proved)
        self._driven, self._until = False, 0
        return self._user if driven else None
