"""How a navigation ends: Nav2's error codes, with a sentence for people. Pure."""

from __future__ import annotations

import enum
from typing import NamedTuple

from relay_protocol.errors import SwitchboardError


class ErrorCode(enum.IntEnum):
    """Codes of Nav2's controller (100 to 199, nav2_msgs/FollowPath) and planner (200 to 299, ComputePathToPose)."""

    NONE = 0
    FOLLOW_UNKNOWN = 100
    FOLLOW_TF_ERROR = 102
    FAILED_TO_MAKE_PROGRESS = 105
    NO_VALID_CONTROL = 106
    PLAN_UNKNOWN = 200
    START_OUTSIDE_MAP = 203
    GOAL_OUTSIDE_MAP = 204
    GOAL_OCCUPIED = 206
    NO_VALID_PATH = 208


class NavigationError(SwitchboardError):
    """A goal can't be reached.

    :param error_code: for programs
    :param message: for people
    """

    def __init__(self, error_code: ErrorCode, message: str) -> None:
        super().__init__(message)
        self.error_code = error_code


class GoalEnd(enum.Enum):
    """How a goal ended."""

    SUCCEEDED = "succeeded"
    ABORTED = "aborted"
    CANCELED = "canceled"


class NavigationOutcome(NamedTuple):
    """The end of a goal."""

    end: GoalEnd
    code: ErrorCode = ErrorCode.NONE
    message: str = ""
