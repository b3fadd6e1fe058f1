"""Which goals actions execute, by their status topics.

The response to a request to cancel all goals shows neither goals that the action refuses to cancel, nor one that it
accepts a moment later.
"""

from __future__ import annotations

from typing import Any

from twisted.internet.defer import Deferred, succeed
from twisted.logger import Logger

from relay_protocol import link
from robot_client.platforms.base import Platform, SubscriptionHandle
from robot_client.twisted_types import DelayedCall

STATUS = "/_action/status"
STATUS_TYPE = "action_msgs/msg/GoalStatusArray"

READ_AFTER = 0.1
"""Seconds from an action's answer until its status is read: it has to publish first, and a stop has urgent work."""

NEW_GOAL_SECONDS = 0.5
"""Seconds to wait for a goal that was being sent while the action was asked to cancel all goals."""

STATUS_SECONDS = 1.0
"""Seconds to discover the publisher and receive its latest status; an action that never had a goal sends none."""

_QOS = link.QoS(reliability="reliable", durability="transient_local", history="keep_last", depth=1)

_ACTIVE = frozenset((1, 2))
"""Accepted and executing (action_msgs/msg/GoalStatus); a goal that is being cancelled (3) is about to end."""


class GoalStatusReader:
    """Subscribes to the status topics of actions for a short time.

    :param clock: for timers
    """

    def __init__(self, platform: Platform, clock: Any) -> None:
        self._platform = platform
        self._clock = clock
        self._log = Logger("goals")

    def active_goals(self, action: str) -> Deferred[frozenset[bytes]]:
        """Read which goals an action has that are not cancelled.

        :return: fires with their ids as soon as there are any, else after :data:`NEW_GOAL_SECONDS`; without any status,
            after :data:`READ_AFTER` plus :data:`STATUS_SECONDS`. Empty also where the status can't be read
        """
        until = self._clock.seconds() + NEW_GOAL_SECONDS
        after: Deferred[None] = Deferred(lambda _: timer.cancel())
        timer = self._clock.callLater(READ_AFTER, after.callback, None)
        return after.addCallback(lambda _: self._subscribe(action, until))

    def _subscribe(self, action: str, until: float) -> Deferred[frozenset[bytes]]:
        found: Deferred[frozenset[bytes]] = Deferred()
        timers: list[DelayedCall] = []

        def receive(body: bytes) -> None:
            if found.called:
                return
            left = until - self._clock.seconds()
            ids = active_goals(body)
            if ids or left <= 0:
                found.callback(ids)
            elif not timers:
                timers.append(self._clock.callLater(left, found.callback, frozenset()))

        def leave(result: Any) -> Any:
            for timer in timers:
                if timer.active():
                    timer.cancel()
            # Deferred, as this may run inside the callback of its own sample.
            self._clock.callLater(0, subscription.close)
            return result

        try:
            subscription: SubscriptionHandle = self._platform.subscribe(
                action + STATUS, STATUS_TYPE, _QOS, receive, lambda: None
            )
        except Exception:  # the other parts of a stop must not depend on it
            self._log.failure("the goals of {action} can't be listened to", action=action)
            return succeed(frozenset())
        found.addTimeout(STATUS_SECONDS, self._clock, onTimeoutCancel=lambda *_: frozenset())
        return found.addBoth(leave)


def active_goals(body: bytes) -> frozenset[bytes]:
    """The goals of a status array that have neither ended nor are being cancelled.

    :param body: action_msgs/msg/GoalStatusArray in CDR; of a truncated one, only complete entries count
    :return: their ids, 16 bytes each
    """
    if len(body) < 8:
        return frozenset()
    count = int.from_bytes(body[4:8], "little" if body[1] & 1 else "big")
    offset = 8
    ids = set()
    for _ in range(count):
        id = body[offset : offset + 16]
        offset = (offset + 16 + 3) // 4 * 4 + 8  # the id, then the stamp of the goal, aligned to 4 bytes
        if offset >= len(body):
            break
        if body[offset] in _ACTIVE:
            ids.add(id)
        offset += 1
    return frozenset(ids)
