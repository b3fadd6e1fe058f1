"""The rest of the robot, as the helm sees it."""

from __future__ import annotations

from typing import Protocol

from twisted.internet.defer import Deferred

from relay_protocol import link


class RobotPort(Protocol):
    """What the helm needs of the rest of the robot."""

    def say(self, message: link.Message) -> None:
        """Tell the relay, if it is there."""

    def alert(self, level: str, text: str, kind: str = "", about: str = "", over: bool = False) -> None:
        """Tell a person, see :class:`robot_client.alerts.OnAlert`."""

    def topic(self, name: str) -> tuple[str, list[str]]:
        """The full name of a topic, and its types: none where it does not exist.

        :raises Invalid: it is no name
        """

    def cancel_goals(self, only_moving: bool) -> None:
        """Cancel what the robot's actions pursue for the relay."""

    def standing(self, seconds: float) -> Deferred[list[str]]:
        """Fires with :attr:`pursued` when that is nothing, or nothing that can be waited for, or in so many seconds."""

    @property
    def pursued(self) -> list[str]:
        """The actions that pursue something for the relay that moves the robot, as far as is known."""

    @property
    def overdue(self) -> list[str]:
        """Those among them whose goals were to end, and may not have."""

    def silence(self, topic: str) -> None:
        """What :attr:`robot_client.motion.orders.OrderHandler.silent` says of a topic has changed."""
