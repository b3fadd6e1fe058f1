"""Notes whether a client drove the robot when its link was lost, for an alert later. ``daemon.py`` stops the robot.

A relay that still runs knows this by itself (SPEC 1.10). A relay that was restarted has no holder any more.
"""

from __future__ import annotations

from collections.abc import Callable

from relay_protocol import link
from robot_client.motion.authority import NO_SOURCE


class LinkLossAlert:
    """Tracks from the reported motion states whether a client drives the robot.

    :param now: the clock of the links, nanoseconds
    """

    def __init__(self, now: Callable[[], int]) -> None:
        self._now = now
        self._driven = False
        self._last_driven = 0
        """When a client last drove the robot, nanoseconds."""
        self._user = ""

    def note_state(self, state: link.MotionState, user: str) -> None:
        """Note a motion state that is sent to the relay.

        :param user: name of the user that has control
        """
        driven = state.moving and state.holder != NO_SOURCE
        if self._driven:
            self._last_driven = self._now()
        if driven:
            self._user = user
        self._driven = driven

    def driver_at_loss(self, proved: int | None) -> str | None:
        """Return the name of the user who drove the robot when the lost link was last known to work; ``None``: none.

        The robot may stand still by now: it stops when its channels end, and when the link is no longer proved.

        :param proved: when the latest ping was sent that the relay has answered, nanoseconds; ``None``: none was
        """
        driven = self._driven or (proved is not None and self._last_driven >= proved)
        self._driven, self._last_driven = False, 0
        return self._user if driven else None
