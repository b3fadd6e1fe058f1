"""The interface of the daemon to the motion code."""

from __future__ import annotations

from typing import Protocol

from twisted.internet.defer import Deferred

from relay_protocol import link


class RobotPort(Protocol):
    """The rest of the daemon, as :class:`robot_client.motion.order_handler.ControlOrderHandler` uses it."""

    def send(self, message: link.Message) -> None:
        """Send a message to the relay; it is discarded if the robot is not registered."""

    def alert(self, level: str, text: str, kind: str = "", about: str = "", over: bool = False) -> None:
        """Raise an alert, see :class:`robot_client.alerts.OnAlert`."""

    def find_topic(self, name: str) -> tuple[str, list[str]]:
        """The full name of a topic, and its types: none where it does not exist.

        :raises Invalid: the name is not valid
        """

    def cancel_goals(self, only_moving: bool) -> None:
        """Cancel the goals that the relay sent to the robot's actions; ``only_moving``: those that move the robot."""

    def goals_ended(self, seconds: float) -> Deferred[list[str]]:
        """Wait until all goals have ended that will end, or for ``seconds``; fires with :attr:`active_actions`."""

    @property
    def active_actions(self) -> list[str]:
        """Actions known to execute goals of the relay that move the robot."""

    @property
    def uncancelled_actions(self) -> list[str]:
        """Actions among :attr:`active_actions` whose goals were cancelled, but may not have ended."""

    def update_inhibition(self, topic: str) -> None:
        """Apply a change of :attr:`robot_client.motion.order_handler.ControlOrderHandler.inhibited` for a topic."""
