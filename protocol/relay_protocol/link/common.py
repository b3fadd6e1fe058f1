"""Messages that both ends send: keepalive on every link, and service calls and goals on a channel link.

A call or goal goes to the end that offers the service or action.
"""

from __future__ import annotations

import msgspec

from relay_protocol.link.fields import Label, Name, Reasoned, Source, Stamp
from relay_protocol.message import Body, Message


class Ping(Message, frozen=True, kw_only=True):
    """The receiver answers at once with ``pong``.

    :param t: sender's monotonic clock, nanoseconds
    """

    t: int


class Pong(Message, frozen=True, kw_only=True):
    """The answer to ``ping``.

    :param t: as in the ping
    :param at: answering end's monotonic clock, nanoseconds
    """

    t: int
    at: int


class Bye(Reasoned, frozen=True, kw_only=True):
    """The sender closes this link on purpose."""

    reason: str


class CallService(Message, frozen=True, kw_only=True):
    """Call a service. The request is in ``cdr`` (base64) or, for a robot without CDR, in ``args``.

    :param id: chosen by the caller; the answer carries it
    :param timeout: seconds the caller waits for the answer; 0 when not given
    :param source: connection that calls; set by the relay
    :param stamp: the call was sent after this time of the relay's monotonic clock, nanoseconds; set by the relay,
        ``None`` when not known
    """

    id: Label
    service: Name
    type: Name
    timeout: float = 0.0
    source: Source = 0
    stamp: Stamp | None = None
    cdr: str | None = None
    args: Body = msgspec.UNSET


class ServiceResponse(Reasoned, frozen=True, kw_only=True):
    """The answer to ``call_service``.

    A ROS 2 service cannot report an error: when ``result`` is false, the caller in the robot's graph gets no answer.

    :param reason: why ``result`` is false
    """

    id: Label
    result: bool
    cdr: str | None = None
    values: Body = msgspec.UNSET
    reason: str = ""


class SendActionGoal(Message, frozen=True, kw_only=True):
    """Execute a goal. The answer is any number of ``action_feedback`` and exactly one ``action_result``.

    :param id: chosen by the sender; every message about this goal carries it
    :param feedback: whether to send ``action_feedback``
    :param source: connection that owns the goal; set by the relay
    :param stamp: as in :class:`CallService`
    """

    id: Label
    action: Name
    type: Name
    feedback: bool = False
    source: Source = 0
    stamp: Stamp | None = None
    cdr: str | None = None
    args: Body = msgspec.UNSET


class CancelActionGoal(Message, frozen=True, kw_only=True):
    """Cancel a goal. Its ``action_result`` still comes, also when the goal ended otherwise."""

    id: Label


class ActionFeedback(Message, frozen=True, kw_only=True):
    """Feedback of the end that executes the goal."""

    id: Label
    cdr: str | None = None
    values: Body = msgspec.UNSET


class ActionResult(Reasoned, frozen=True, kw_only=True):
    """The goal has ended.

    :param status: of ``action_msgs/msg/GoalStatus``: 4 succeeded, 5 canceled, 6 aborted; 0 when it never started
    :param result: whether ``cdr`` or ``values`` holds a result
    :param reason: why there is none
    """

    id: Label
    status: int
    result: bool
    cdr: str | None = None
    values: Body = msgspec.UNSET
    reason: str = ""


CommonChannel = (
    CallService
    | ServiceResponse
    | SendActionGoal
    | CancelActionGoal
    | ActionFeedback
    | ActionResult
    | Ping
    | Pong
    | Bye
)
"""What both ends may send on a channel link."""
