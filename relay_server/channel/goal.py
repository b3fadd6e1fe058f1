"""One goal from its asking to its end, and the two who may ask for it: a client, the robot's graph."""

from __future__ import annotations

import enum
from abc import ABC, abstractmethod
from typing import NamedTuple, Protocol

from twisted.internet.defer import CancelledError, Deferred
from twisted.python.failure import Failure

from relay_protocol import jsontext, link
from relay_protocol.errors import SwitchboardError
from relay_server.channel.bodies import Bodies
from relay_server.channel.wire import ChannelLink, Commander


class Status(enum.IntEnum):
    """How a goal ended: ``action_msgs/msg/GoalStatus``, and 0 for one that never began."""

    NEVER_BEGAN = 0
    SUCCEEDED = 4
    CANCELED = 5
    ABORTED = 6


STATUSES = frozenset(Status)


class End(NamedTuple):
    """How a goal ended.

    :param body: the result, see :class:`Bodies`; ``None`` when there is none
    :param reason: why there is none
    """

    status: int
    body: bytes | None = None
    reason: str = ""


class Asker(Protocol):
    """A session, as one of its goals uses it."""

    def feedback(self, values: bytes) -> None:
        """How far the goal has come, JSON."""

    def unreadable(self, words: str) -> None:
        """Something that came of the goal can't be handed on, and why."""

    def ended(self, status: int, result: bool, values: bytes) -> None:
        """The goal is over; called once.

        :param values: JSON: the result, or a string that says why there is none
        """


class Goal(ABC):
    """One goal from its asking to its end.

    :param wants_feedback: whether the asker does
    """

    def __init__(self, action: str, wants_feedback: bool) -> None:
        self.action = action
        self.type = ""
        self.wants_feedback = wants_feedback
        self.beginning: Deferred[None] | None = None
        self.pursuer: Pursuer | None = None
        self.over = False
        self._cancelled = False

    def cancel(self) -> None:
        """The asker wants it no more; its end still comes."""
        if not self.over:
            self._withdraw()

    def progress(self, body: bytes) -> None:
        """Feedback has come, a body."""
        if self.wants_feedback and not self.over:
            self.tell_feedback(body)

    def end(self, end: End) -> None:
        """It is over; whatever comes later is passed over."""
        if not self.over:
            self.over = True
            self.tell_end(end)

    def abandon(self) -> None:
        """The asker has gone: cancel it, and tell nobody of its end."""
        if self.over:
            return
        self.over = True
        self._withdraw()
        if self.pursuer is not None:
            self.pursuer.forget()

    def _withdraw(self) -> None:
        if self._cancelled:
            return
        self._cancelled = True
        if self.pursuer is not None:
            self.pursuer.cancel()
        elif self.beginning is not None:
            self.beginning.cancel()

    @abstractmethod
    def tell_feedback(self, body: bytes) -> None:
        """Hand feedback to the asker."""

    @abstractmethod
    def tell_end(self, end: End) -> None:
        """Hand the end to the asker."""


class Pursuer(Protocol):
    """Who pursues a goal."""

    def cancel(self) -> None:
        """The goal is not wanted any more."""

    def forget(self) -> None:
        """Nor is its end."""


class ClientGoal(Goal):
    """A goal that a client asked for."""

    def __init__(
        self, member: Commander, asker: Asker, bodies: Bodies, action: str, wants_feedback: bool
    ) -> None:
        super().__init__(action, wants_feedback)
        self.member = member
        self._asker = asker
        self._bodies = bodies

    def tell_feedback(self, body: bytes) -> None:
        """In JSON; what can't be read is left out."""
        try:
            values = self._bodies.to_client(f"{self.type}_Feedback", body)
        except SwitchboardError as error:
            self._asker.unreadable(f"feedback of {self.action} is left out: {error}")
            return
        self._asker.feedback(values)

    def tell_end(self, end: End) -> None:
        """In JSON, or in words."""
        if end.body is None:
            self._asker.ended(end.status, False, jsontext.encode(end.reason))
            return
        try:
            values = self._bodies.to_client(f"{self.type}_Result", end.body)
        except SwitchboardError as error:
            self._asker.ended(
                Status.ABORTED, False, jsontext.encode(f"the result of {self.action} can't be read: {error}")
            )
        else:
            self._asker.ended(end.status, True, values)


class GraphGoal(Goal):
    """A goal of the robot's graph for an action that a client offers.

    :param origin: the link it came over, the only one on which its id means anything
    """

    def __init__(self, message: link.SendActionGoal, origin: ChannelLink, bodies: Bodies) -> None:
        super().__init__(message.action, message.feedback)
        self._id = message.id
        self._origin = origin
        self._bodies = bodies

    def tell_feedback(self, body: bytes) -> None:
        """The newest counts: a client that tells more than the robot's link takes must not break the link."""
        self._origin.newest(
            f"feedback {self._id}", link.ActionFeedback(id=self._id, **self._bodies.values(body))
        )

    def tell_end(self, end: End) -> None:
        """With the result, or with the reason for none."""
        fields = {} if end.body is None else self._bodies.values(end.body)
        self._origin.send(
            link.ActionResult(
                id=self._id, status=end.status, result=end.body is not None, reason=end.reason, **fields
            )
        )


def why_not_begun(failure: Failure, action: str) -> End:
    """What the asker is told of a goal that could not be begun."""
    if failure.check(CancelledError):
        return End(Status.CANCELED, None, "the goal was cancelled before it began")
    if failure.check(SwitchboardError):
        return End(Status.NEVER_BEGAN, None, failure.getErrorMessage())
    return End(Status.NEVER_BEGAN, None, f"the relay failed on this goal of {action}; its log tells more")


def failed(status: int, reason: str) -> End:
    """An end without a result: nobody can have succeeded without one."""
    return End(Status.ABORTED if status == Status.SUCCEEDED else status, None, reason)
