"""The alert about commands that are refused because speed is limited and theirs can't be read."""

from __future__ import annotations

from robot_client.alerts import AlertCondition, OnAlert
from robot_client.motion.goal_canceller import list_names
from robot_client.motion.speed_limiter import REMEDY
from robot_client.motion.typed_topic import TypedTopic

TOPICS = 64
"""Most topics remembered; further ones are not named."""


class UnlimitedCommandAlert:
    """Keeps the alert while the client whose commands are refused has control.

    :param alert: receives the alert
    """

    def __init__(self, alert: OnAlert) -> None:
        self._condition = AlertCondition(alert, "control", "limits")
        self._topics: set[str] = set()
        self._level = ""

    def refused(self, topic: TypedTopic, level: str) -> None:
        """Note a refused command.

        :param level: of its sender; empty: unknown
        """
        name = f"{topic.name} ({topic.type})"
        if name in self._topics or len(self._topics) >= TOPICS:
            return
        self._topics.add(name)
        self._level = self._level or level
        whose = f"of the level '{self._level}'" if self._level else "of the client in control"
        reason = f"the speed {whose} is limited, and theirs can't be read"
        self._condition.update(f"commands on {list_names(self._topics)} are refused: {reason}: {REMEDY}", "")

    def end(self) -> None:
        """End the alert, as control or the holder's level has changed."""
        self._topics.clear()
        self._level = ""
        self._condition.update("", "no client drives by commands whose speed can't be read any more")
