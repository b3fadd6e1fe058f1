"""Which goals actions pursue, as they publish it themselves.

What they answer to a request to cancel all says nothing of those they refuse, nor of one they accept a moment later.
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

AFTER = 0.1
"""Seconds an action has to publish what an answer of its has changed; also, a stop has more urgent things to do."""

SETTLED = 0.5
"""Seconds that are waited for a goal which was on its way to an action when that was asked to cancel all."""

WITHIN = 1.0
"""Seconds a publisher has to be found, and to send its latest word: one that never had a goal has none."""

_QOS = link.QoS(reliability="reliable", durability="transient_local", history="keep_last", depth=1)

_GOING = frozenset((1, 2))
"""Accepted and executing; a goal that is being cancelled (3) is on its way to its end (action_msgs/msg/GoalStatus)."""


class GoalStatusReader:
    """Listens for a moment to what actions publish.

    :param clock: for timers
    """

    def __init__(self, platform: Platform, clock: Any) -> None:
        self._platform = platform
        self._clock = clock
        self._log = Logger("statuses")

    def going(self, action: str) -> Deferred[frozenset[bytes]]:
        """Find out which goals an action has that nobody has cancelled.

        :return: fires with their ids as soon as there are any, else after :data:`SETTLED`, and where nothing is heard
            after :data:`AFTER` and :data:`WITHIN`; empty where that can't be found out
        """
        settled = self._clock.seconds() + SETTLED
        after: Deferred[None] = Deferred(lambda _: timer.cancel())
        timer = self._clock.callLater(AFTER, after.callback, None)
        return after.addCallback(lambda _: self._listen(action, settled))

    def _listen(self, action: str, settled: float) -> Deferred[frozenset[bytes]]:
        found: Deferred[frozenset[bytes]] = Deferred()
        until: list[DelayedCall] = []

        def hear(body: bytes) -> None:
            if found.called:
                return
            left = settled - self._clock.seconds()
            ids = going(body)
            if ids or left <= 0:
                found.callback(ids)
            elif not until:
                until.append(self._clock.callLater(left, found.callback, frozenset()))

        def leave(result: Any) -> Any:
            for timer in until:
                if timer.active():
                    timer.cancel()
            # Not from within its own sample.
            self._clock.callLater(0, source.close)
            return result

        try:
            source: SubscriptionHandle = self._platform.subscribe(
                action + STATUS, STATUS_TYPE, _QOS, hear, lambda: None
            )
        except Exception:  # the rest of the stop must not hang on it
            self._log.failure("the goals of {action} can't be listened to", action=action)
            return succeed(frozenset())
        found.addTimeout(WITHIN, self._clock, onTimeoutCancel=lambda *_: frozenset())
        return found.addBoth(leave)


def going(body: bytes) -> frozenset[bytes]:
    """The goals of a status array that are neither at their end nor being cancelled.

    :param body: CDR; what is cut short tells of no more than it holds
    :return: their ids, 16 bytes each
    """
    if len(body) < 8:
        return frozenset()
    count = int.from_bytes(body[4:8], "little" if body[1] & 1 else "big")
    at = 8
    ids = set()
    for _ in range(count):
        id = body[at : at + 16]
        at = (
            at + 16 + 3
        ) // 4 * 4 + 8  # the id, then the time of the goal, which begins at a multiple of four
        if at >= len(body):
            break
        if body[at] in _GOING:
            ids.add(id)
        at += 1
    return frozenset(ids)
