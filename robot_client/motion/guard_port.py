"""Who is told of every motion command beside the robot itself."""

from __future__ import annotations

from typing import Protocol

from robot_client.motion.typed_topic import TypedTopic


class GuardPort(Protocol):
    """Who is told of every motion command, to act when the daemon can't.

    And of goals, as of commands: :func:`robot_client.motion.guard_protocol.cancelling` says by what name.
    """

    def topic(self, on: TypedTopic) -> None:
        """Commands may come on this topic."""

    def forget(self, on: TypedTopic) -> None:
        """No more commands will come on this topic."""

    def shape(self, on: TypedTopic, rest: bytes) -> None:
        """What commands on this topic look like from now on when they are zero, see ``Platform.resting``."""

    def command(self, on: TypedTopic, moving: bool, at: int) -> None:
        """A command went out; ``at`` is the clock in nanoseconds."""

    def ready(self, on: TypedTopic) -> bool:
        """Whether it could stop this topic now."""


class NoGuard:
    """Nobody is told, by choice: motion does not wait for a guard."""

    def topic(self, on: TypedTopic) -> None:
        """Pass over."""

    def forget(self, on: TypedTopic) -> None:
        """Pass over."""

    def shape(self, on: TypedTopic, rest: bytes) -> None:
        """Pass over."""

    def command(self, on: TypedTopic, moving: bool, at: int) -> None:
        """Pass over."""

    def ready(self, on: TypedTopic) -> bool:
        """Nothing to wait for."""
        return True
