"""Commands that are refused because their speeds can't be read where speed is limited: a person is told which."""

from __future__ import annotations

from robot_client.alerts import AlertCondition, OnAlert
from robot_client.motion.goal_canceller import names
from robot_client.motion.governor import REMEDY
from robot_client.motion.typed_topic import TypedTopic

TOPICS = 64
"""Most that are remembered; of more nobody is told by name."""


class UnlimitedCommandAlert:
    """Tells it as long as one who drives has control.

    :param alert: tells a person
    """

    def __init__(self, alert: OnAlert) -> None:
        self._concern = AlertCondition(alert, "control", "limits")
        self._topics: set[str] = set()
        self._level = ""

    def refused(self, on: TypedTopic, level: str) -> None:
        """A command was refused.

        :param level: of who gave it, empty where that is not known
        """
        known = f"{on.topic} ({on.type})"
        if known in self._topics or len(self._topics) >= TOPICS:
            return
        self._topics.add(known)
        self._level = self._level or level
        whose = f"of the level '{self._level}'" if self._level else "of who drives"
        words = f"commands on {names(self._topics)} are refused: the speed {whose} is limited, and theirs can't be told"
        self._concern.tell(f"{words}: {REMEDY}", "")

    def over(self) -> None:
        """Control has changed, or the level of who has it."""
        self._topics.clear()
        self._level = ""
        self._concern.tell("", "nobody drives any more by commands whose speeds can't be told")
