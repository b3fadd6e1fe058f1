"""What either end may say: on every link, and on a channel link, where whoever offers a service or an action is
called.
"""

from __future__ import annotations

import msgspec

from relay_protocol.link.fields import Label, Name, Reasoned, Source, Stamp
from relay_protocol.message import Body, Message


class Ping(Message, frozen=True, kw_only=True):
    """Either end: answer at once. ``t`` is the asker's monotonic clock in nanoseconds."""

    t: int


class Pong(Message, frozen=True, kw_only=True):
    """The answer: ``t`` as it came, ``at`` the answerer's monotonic clock in nanoseconds."""

    t: int
    at: int


class Bye(Reasoned, frozen=True, kw_only=True):
    """Either end: I am closing this link on purpose."""

    reason: str


class CallService(Message, frozen=True, kw_only=True):
    """Call a service. Arguments are ``cdr`` (base64) or, for a robot without CDR, ``args``.

    :param id: chosen by the caller; the answer carries it
    :param timeout: seconds the caller waits for the answer; 0 when it did not say
    :param source: from the relay, the connection that calls
    :param stamp: from the relay, its monotonic nanoseconds before which the call can't have been sent; ``None`` when
        it did not say
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
    """The answer to ``call_service``; ``reason`` when ``result`` is false.

    ROS 2 has no way to tell a caller that a service failed: a robot that gets ``result`` false lets its caller
    wait in vain.
    """

    id: Label
    result: bool
    cdr: str | None = None
    values: Body = msgspec.UNSET
    reason: str = ""


class SendActionGoal(Message, frozen=True, kw_only=True):
    """Pursue a goal. It is answered by exactly one ``action_result``, after any number of ``action_feedback``.

    :param id: chosen by the asker; everything about this goal carries it
    :param feedback: whether the asker wants ``action_feedback``
    :param source: from the relay, the connection whose goal it is
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
    """The asker wants the goal no more. Its ``action_result`` still comes, also when it ended otherwise."""

    id: Label


class ActionFeedback(Message, frozen=True, kw_only=True):
    """How far the goal has come, by the one who pursues it."""

    id: Label
    cdr: str | None = None
    values: Body = msgspec.UNSET


class ActionResult(Reasoned, frozen=True, kw_only=True):
    """The goal is over.

    :param status: of ``action_msgs/msg/GoalStatus``: 4 succeeded, 5 canceled, 6 aborted; 0 when it never began
    :param result: whether there is a result, in ``cdr`` or ``values``; else ``reason`` says why not
    """

    id: Label
    status: int
    result: bool
    cdr: str | None = None
    values: Body = msgspec.UNSET
    reason: str = ""


BothChannel = (
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
