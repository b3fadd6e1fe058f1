"""The interface of the guard to motion control."""

from __future__ import annotations

from typing import Protocol

from robot_client.motion.typed_topic import TypedTopic


class GuardPort(Protocol):
    """Is notified of every motion command (its topic, whether it moves, when), to stop the robot when the daemon can't.

    Goals are passed like commands, under the name that :func:`robot_client.motion.guard_protocol.cancelling` gives.
    """

    def add_topic(self, topic: TypedTopic) -> None:
        """Announce that commands may come on this topic."""

    def forget(self, topic: TypedTopic) -> None:
        """Announce that no more commands will come on this topic."""

    def set_zero_template(self, topic: TypedTopic, zero_template: bytes) -> None:
        """Set the zero template of the next commands on this topic, see ``Platform.zero_template``."""

    def note_command(self, topic: TypedTopic, moving: bool, at: int) -> None:
        """Note that a command is about to move this topic, or that zero was published.

        :param moving: whether it was other than zero
        :param at: clock of :mod:`relay_protocol.clocks`, nanoseconds
        """

    def ready(self, topic: TypedTopic) -> bool:
        """Whether the guard could stop this topic now."""


class NoGuard:
    """Used where the settings turn the guard off: motion does not wait for one."""

    def add_topic(self, topic: TypedTopic) -> None:
        """Do nothing."""

    def forget(self, topic: TypedTopic) -> None:
        """Do nothing."""

    def set_zero_template(self, topic: TypedTopic, zero_template: bytes) -> None:
        """Do nothing."""

    def note_command(self, topic: TypedTopic, moving: bool, at: int) -> None:
        """Do nothing."""

    def ready(self, topic: TypedTopic) -> bool:
        """Return true: there is nothing to wait for."""
        return True
