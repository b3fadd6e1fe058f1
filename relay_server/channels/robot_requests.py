"""Requests to the robot to subscribe, advertise or offer: their state, and a queue that bounds how many are open."""

from __future__ import annotations

import enum
from collections.abc import Callable
from typing import NamedTuple

from relay_protocol import link
from relay_server.common.clock import Clock, Timer, cancel

OPEN_REQUESTS = 64
"""Most requests to a robot without an answer at a time; further ones are queued."""

ANSWER_SECONDS = 5.0
"""Seconds after which a request without an answer no longer counts as open."""


class RequestPhase(enum.Enum):
    """State of a subscription, publication or advertisement on the robot."""

    WAITING = "waiting"
    """Not requested: the robot is offline, or the topic's type is not known yet."""
    REQUESTED = "requested"
    ACTIVE = "active"
    FAILED = "failed"


Key = tuple[str, int | str]
"""A request's op, and the number or name that it concerns."""


class RobotRequest(NamedTuple):
    """A request to the robot.

    :param key: a newer request with the same key replaces one that is queued
    :param on_sent: called when it is sent
    """

    key: Key
    message: link.Message
    on_sent: Callable[[], None]


class RobotRequestQueue:
    """Requests to the robot: at most :data:`OPEN_REQUESTS` without an answer, so that no client can flood its link.

    :param send: sends one over the link
    """

    def __init__(self, clock: Clock, send: Callable[[link.Message], None]) -> None:
        self._clock = clock
        self._send = send
        self._open: dict[Key, float] = {}
        self._waiting: dict[Key, RobotRequest] = {}
        self._timer: Timer | None = None

    def put(self, request: RobotRequest) -> None:
        """Send a request now, or queue it until there is room; it replaces a queued one with the same key."""
        if request.key in self._open or len(self._open) >= OPEN_REQUESTS:
            self._waiting[request.key] = request
            self._schedule_timeout()
        else:
            self._transmit(request)

    def answered(self, key: Key) -> None:
        """Handle that the robot has answered, also with a refusal."""
        if self._open.pop(key, None) is not None:
            self._send_waiting()

    def withdraw(self, key: Key) -> bool:
        """Remove a queued request; returns whether the robot knows of one with this key."""
        waited = self._waiting.pop(key, None) is not None
        return not waited or key in self._open

    def reset(self) -> None:
        """Forget all requests, as the link is gone."""
        self._open.clear()
        self._waiting.clear()
        cancel(self._timer)
        self._timer = None

    def _transmit(self, request: RobotRequest) -> None:
        self._open[request.key] = self._clock.seconds()
        self._send(request.message)
        request.on_sent()

    def _send_waiting(self) -> None:
        for key in list(self._waiting):
            if len(self._open) >= OPEN_REQUESTS:
                break
            if key not in self._open:
                self._transmit(self._waiting.pop(key))

    def _schedule_timeout(self) -> None:
        if self._timer is None:
            self._timer = self._clock.callLater(ANSWER_SECONDS, self._timed_out)

    def _timed_out(self) -> None:
        """Send the next requests although the robot has not answered older ones."""
        self._timer = None
        oldest = self._clock.seconds() - ANSWER_SECONDS
        self._open = {key: since for key, since in self._open.items() if since > oldest}
        self._send_waiting()
        if self._waiting:
            self._schedule_timeout()
