"""The status messages of actions."""

from __future__ import annotations

from collections.abc import Iterable

from action_msgs.msg import GoalInfo, GoalStatus, GoalStatusArray
from builtin_interfaces.msg import Time
from rclpy.serialization import serialize_message
from unique_identifier_msgs.msg import UUID

# Each byte of these nanoseconds would be the status of an active goal.
STAMP = Time(sec=2**31 - 1, nanosec=0x01010101)


def published(goals: Iterable[tuple[bytes, int]]) -> bytes:
    """An ``action_msgs/msg/GoalStatusArray`` as CDR.

    :param goals: the id of each, sixteen bytes, and its status
    """
    reported = [
        GoalStatus(goal_info=GoalInfo(goal_id=UUID(uuid=list(id)), stamp=STAMP), status=status)
        for id, status in goals
    ]
    return bytes(serialize_message(GoalStatusArray(status_list=reported)))
