"""Alerts are sent together, retried, kept until quiet hours end, and bounded in number."""

from __future__ import annotations

from collections.abc import AsyncIterator, Collection
from contextlib import asynccontextmanager
from datetime import UTC, datetime
from typing import Any

import pytest
from twisted.internet.defer import Deferred, DeferredSemaphore
from twisted.internet.task import Clock
from twisted.logger import capturedLogs, formatEvent

from relay_db.queries import AlertRecord, AlertRuleRecord
from relay_protocol.errors import Unavailable
from relay_server.alerts import delivery as module
from relay_server.alerts.delivery import (
    MAX_DELIVERED,
    MAX_QUEUED,
    MAX_UNFILTERED,
    RETRY_SECONDS,
    URGENT_RETRY_SECONDS,
    Delivery,
    DeliveryContext,
)
from relay_server.alerts.schemas import NotificationMessage, Undelivered
from relay_server.alerts.store import AlertChange
from relay_server.alerts.types import AlertEvent
from tests.worlds.alerts import alert, rule

NIGHT = {"from": "22:00", "to": "07:00", "zone": "UTC", "least": "error"}


def its_own(alert: AlertRecord) -> frozenset[str]:
    """A robot that is not shared."""
    return frozenset({alert.realm})


class Scene:
    """Delivery for one rule, with a clock and a receiver that fails on request."""

    def __init__(self, wall: str = "2026-11-22 12:00:00") -> None:
        self.clock = Clock()
        self._wall = datetime.fromisoformat(wall).replace(tzinfo=UTC).timestamp()
        self.got: list[NotificationMessage] = []
        self.failing: list[bool] = []
        self.errors: list[Exception] = []
        self.hanging: list[Deferred[None]] = []
        self.hangs = False
        self.dumb = False
        self.unknown: set[str] = set()
        self.over: set[str] = set()
        self.asks = 0
        self._names = 0
        self.context = DeliveryContext(
            self.clock,
            self.wall,
            lambda: 0.0,
            self._name,
            self._send,
            self._known,
            self._lasts,
            its_own,
            self._slot,
        )
        self.user_slots = DeferredSemaphore(2)
        self.slots = DeferredSemaphore(4)

    def wall(self) -> float:
        """Unix time."""
        return self._wall + self.clock.seconds()

    def delivery(self, **other: Any) -> Delivery:
        """The delivery of a rule."""
        return Delivery(self.context, rule(**other), self.user_slots)

    def wait(self, seconds: float) -> None:
        """Lets time pass in steps."""
        until = self.clock.seconds() + seconds
        while (left := until - self.clock.seconds()) > 1e-9:
            self.clock.advance(min(left, 0.25 if seconds < 600 else 30.0))

    def reported(self) -> list[list[str]]:
        """Alert ids and events of each message that arrived."""
        return [[f"{each.alert.id} {each.event}" for each in message.notices] for message in self.got]

    def _name(self) -> str:
        self._names += 1
        return f"d{self._names}"

    @asynccontextmanager
    async def _slot(self, rule: AlertRuleRecord, failing: bool) -> AsyncIterator[None]:
        async with self.slots:
            self.failing.append(failing)
            yield

    async def _send(self, rule: AlertRuleRecord, message: NotificationMessage) -> None:
        if self.hangs:
            self.hanging.append(Deferred())
            await self.hanging[-1]
        if self.errors:
            raise self.errors.pop(0)
        self.got.append(message)

    async def _known(self, rule: AlertRuleRecord, alerts: Collection[AlertRecord]) -> set[str]:
        self.asks += 1
        if self.dumb:
            raise Unavailable("the database is locked")
        return {each.id for each in alerts} - self.unknown

    def _lasts(self, alert_id: str) -> bool:
        return alert_id not in self.over


def begun(id: str = "a1", **other: Any) -> AlertChange:
    """Notice of an alert that has begun."""
    return AlertChange(alert(id, **other), AlertEvent.BEGUN)


def ended(id: str = "a1", **other: Any) -> AlertChange:
    """Notice of an alert that has ended."""
    return AlertChange(alert(id, over=11.0, **other), AlertEvent.OVER)


def again() -> Undelivered:
    """An error after which a retry makes sense."""
    return Undelivered("nobody answers", again=True)


@pytest.fixture
def scene() -> Scene:
    """A scene at noon."""
    return Scene()


def test_the_first_alert_is_sent_with_those_that_come_with_it(scene: Scene) -> None:
    """Alerts within 0.2 s are sent as one message."""
    delivery = scene.delivery()
    delivery.offer(begun("a1"))
    scene.clock.advance(0.1)
    delivery.offer(begun("a2"))
    assert scene.reported() == []
    scene.clock.advance(0.1)
    assert scene.reported() == [["a1 begun", "a2 begun"]]
    assert (delivery.status.sent, delivery.status.failed, delivery.status.last) == (1, 0, scene.wall())


def test_the_next_message_waits_and_has_all_new_alerts(scene: Scene) -> None:
    """A rule sends at most one message in its interval, with each new alert once."""
    delivery = scene.delivery(group_s=60.0)
    for second in range(120):
        delivery.offer(begun("a1", level="warning"))
        delivery.offer(ended("a1", level="warning"))
        delivery.offer(begun(f"b{second % 3}", level="warning"))
        scene.wait(1)
    assert [len(each) for each in scene.reported()] == [3, 5]
    scene.wait(60)
    assert len(scene.got) == 3


def test_alerts_that_the_rule_excludes_are_not_sent(scene: Scene) -> None:
    delivery = scene.delivery(kinds=("battery",))
    delivery.offer(begun())
    scene.wait(5)
    assert (scene.got, scene.asks, delivery.waiting) == ([], 0, 0)


def test_a_failed_message_is_tried_again_under_its_name(scene: Scene) -> None:
    """Pauses between tries grow; alerts that arrive meanwhile wait for the next message."""
    delivery = scene.delivery(group_s=5.0)
    scene.errors = [again(), again()]
    delivery.offer(begun("a1"))
    scene.wait(1)
    delivery.offer(begun("a2", level="warning"))
    scene.wait(RETRY_SECONDS[0])
    assert scene.got == []
    scene.wait(RETRY_SECONDS[1])
    assert (scene.reported(), scene.got[0].delivery) == ([["a1 begun"]], "d1")
    assert scene.failing == [False, True, True]
    scene.wait(5)
    assert scene.reported()[1] == ["a2 begun"]
    assert scene.got[1].delivery == "d2"
    assert delivery.status.failed == 0


def test_an_unreachable_target_is_given_up_after_some_tries(scene: Scene) -> None:
    """The failure is counted with its reason; the next message is tried as usual."""
    delivery = scene.delivery()
    scene.errors = [again() for _ in range(len(RETRY_SECONDS) + 1)]
    delivery.offer(begun("a1"))
    scene.wait(sum(RETRY_SECONDS) + 100)
    assert (scene.got, scene.errors) == ([], [])
    assert (delivery.status.failed, delivery.status.reason) == (1, "nobody answers")
    delivery.offer(begun("a2"))
    scene.wait(100)
    assert scene.reported() == [["a2 begun"]]


def test_permanent_failures_are_not_tried_again(scene: Scene) -> None:
    """A receiver that refuses is not called six times."""
    delivery = scene.delivery()
    scene.errors = [Undelivered("status 404", again=False)]
    delivery.offer(begun("a1"))
    scene.wait(100)
    assert (scene.got, len(scene.failing), delivery.status.failed) == ([], 1, 1)


def test_a_database_that_does_not_answer_is_asked_again(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers = [Unavailable("locked")]

    async def known(rule: AlertRuleRecord, alerts: Collection[AlertRecord]) -> set[str]:
        if answers:
            raise answers.pop()
        return {each.id for each in alerts}

    context = DeliveryContext(
        scene.clock, scene.wall, lambda: 0.0, lambda: "d1", scene._send, known, scene._lasts, its_own
    )
    delivery = Delivery(context, rule(), scene.user_slots)
    delivery.offer(begun())
    scene.wait(1)
    assert scene.got == []
    scene.wait(3)
    assert scene.reported() == [["a1 begun"]]


def test_no_message_after_the_right_is_lost(scene: Scene) -> None:
    """The right is checked when the message leaves, and before each retry."""
    delivery = scene.delivery()
    scene.unknown = {"a1"}
    delivery.offer(begun("a1"))
    delivery.offer(begun("a2"))
    scene.wait(1)
    assert scene.reported() == [["a2 begun"]]
    scene.errors = [again()]
    delivery.offer(begun("a3", level="warning"))
    scene.wait(61)
    scene.unknown = {"a3"}
    scene.wait(60)
    assert len(scene.got) == 1
    assert delivery.waiting == 0


@pytest.mark.parametrize("wait", ["user_slots", "slots"])
def test_waiting_message_is_dropped_when_the_right_is_lost(scene: Scene, wait: str) -> None:
    semaphore: DeferredSemaphore = getattr(scene, wait)
    taken = [semaphore.acquire() for _ in range(semaphore.limit)]
    delivery = scene.delivery()
    delivery.offer(begun("a1"))
    delivery.offer(begun("a2"))
    scene.wait(30)
    assert scene.got == []
    scene.unknown = {"a1"}
    for _ in taken:
        semaphore.release()
    assert scene.reported() == [["a2 begun"]]
    assert semaphore.tokens == semaphore.limit


def test_an_error_waits_for_no_pause(scene: Scene) -> None:
    delivery = scene.delivery()
    delivery.offer(begun("control", level="error"))
    scene.wait(3)
    delivery.offer(begun("hot", level="warning"))
    scene.wait(1)
    assert scene.reported() == [["control begun"]]
    delivery.offer(begun("offline", level="error"))
    scene.wait(0.25)
    assert scene.reported() == [["control begun"], ["hot begun", "offline begun"]]
    delivery.offer(ended("offline", level="error"))
    scene.wait(59)
    assert len(scene.got) == 2
    scene.wait(1)
    assert scene.reported()[2:] == [["offline over"]]


def test_a_worse_alert_than_in_the_last_message_skips_the_pause(scene: Scene) -> None:
    delivery = scene.delivery(level="info")
    delivery.offer(begun("a", level="info"))
    scene.wait(1)
    delivery.offer(begun("b", level="warning"))
    scene.wait(1)
    delivery.offer(begun("c", level="warning"))
    scene.wait(30)
    assert scene.reported() == [["a begun"], ["b begun"]]
    scene.wait(31)
    assert scene.reported()[2:] == [["c begun"]]


def test_errors_that_come_together_leave_together(scene: Scene) -> None:
    delivery = scene.delivery()
    delivery.offer(begun("a"))
    scene.wait(5)
    delivery.offer(begun("b"))
    scene.clock.advance(0.1)
    delivery.offer(begun("c"))
    scene.wait(1)
    assert scene.reported() == [["a begun"], ["b begun", "c begun"]]


def test_errors_make_no_flood(scene: Scene) -> None:
    delivery = scene.delivery()
    for number in range(600):
        delivery.offer(begun(f"a{number}"))
        scene.wait(0.5)
    assert len(scene.got) <= 1 + 3 + 300 / 10
    scene.wait(11)
    reported = [each for message in scene.reported() for each in message]
    assert reported == [f"a{number} begun" for number in range(600)]
    assert scene.got[-1].left_out == 0


def test_a_new_error_has_a_message_that_failed_tried_again_sooner(scene: Scene) -> None:
    """At most once in 30 s, so that errors need not wait for a receiver that works again."""
    delivery = scene.delivery()
    scene.errors = [again() for _ in range(5)]
    delivery.offer(begun("a"))
    scene.wait(170)
    assert scene.errors == []
    back = scene.clock.seconds()
    delivery.offer(begun("urgent"))
    while len(scene.got) < 2:
        scene.wait(1)
        assert scene.clock.seconds() - back < 31
    assert scene.reported() == [["a begun"], ["urgent begun"]]


def test_waiting_errors_do_not_use_up_tries(scene: Scene) -> None:
    """Delivery is given up no sooner than without them, and the number of tries stays bounded."""
    delivery = scene.delivery()
    scene.errors = [again() for _ in range(1000)]
    delivery.offer(begun("a"))
    way_out = sum(RETRY_SECONDS) * 0.8
    scene.wait(1)
    delivery.offer(begun("b"))
    while not delivery.status.failed:
        scene.wait(10)
    assert way_out < scene.clock.seconds() < sum(RETRY_SECONDS) + 60
    assert len(scene.failing) <= 6 + sum(RETRY_SECONDS) / URGENT_RETRY_SECONDS


def test_queues_are_bounded(scene: Scene) -> None:
    delivery = scene.delivery(level="info")
    delivery.offer(begun("old", level="info"))
    delivery.offer(begun("bad", level="error"))
    delivery.offer(ended("bad", level="error"))
    for number in range(MAX_QUEUED + 30):
        delivery.offer(begun(f"a{number}", level="warning"))
    assert delivery.waiting == MAX_QUEUED
    scene.wait(1)
    reported = scene.reported()[0]
    assert reported[:2] == ["bad begun", "bad over"]
    assert (reported[2], reported[-1]) == ("a32 begun", f"a{MAX_QUEUED + 29} begun")
    assert scene.got[0].left_out == 33


def test_alerts_of_other_peoples_robots_take_no_place(scene: Scene) -> None:
    delivery = scene.delivery()
    scene.unknown = {f"x{number}" for number in range(2 * MAX_QUEUED)}
    delivery.offer(begun("mine", level="warning"))
    for number in range(2 * MAX_QUEUED):
        delivery.offer(begun(f"x{number}", level="error", robot_id=2))
    assert delivery.waiting == 1
    scene.wait(1)
    assert scene.reported() == [["mine begun"]]
    for number in range(MAX_QUEUED + 5):
        delivery.offer(begun(f"mine{number}", level="warning"))
        delivery.offer(begun(f"x{number}", level="error", robot_id=2))
    scene.wait(61)
    assert [message.left_out for message in scene.got] == [0, 5]


def test_alerts_of_another_realm_are_not_even_judged(scene: Scene) -> None:
    """While the database does not answer, their number does not matter: they take no places in this realm's
    queue.
    """
    delivery = scene.delivery(realm="lab1", user="toad")
    scene.dumb = True
    for number in range(MAX_UNFILTERED + 50):
        delivery.offer(begun(f"x{number}", robot_id=number))
    assert (delivery.waiting, scene.asks) == (0, 0)
    delivery.offer(begun("mine", realm="lab1"))
    assert delivery.waiting == 1
    scene.dumb = False
    scene.wait(3)
    assert scene.reported() == [["mine begun"]]


def test_the_log_names_user_and_realm_of_a_failed_rule(scene: Scene) -> None:
    """Users of several realms may have the same name."""
    delivery = scene.delivery(realm="lab1", user="toad")
    scene.errors = [Undelivered("no such page", again=False)]
    with capturedLogs() as logs:
        delivery.offer(begun(realm="lab1"))
        scene.wait(1)
    assert "by rule 7 of toad@lab1: no such page" in str(formatEvent(logs[-1]))


def test_while_the_database_does_not_answer_a_robot_does_not_push_out_anothers_alerts(scene: Scene) -> None:
    """No rule is judged then; the queue is bounded, and its alerts are not counted."""
    delivery = scene.delivery()
    scene.dumb = True
    delivery.offer(begun("mine", level="warning"))
    for number in range(MAX_UNFILTERED + 50):
        delivery.offer(begun(f"x{number}", level="error", robot_id=2))
    assert delivery.waiting == MAX_UNFILTERED
    scene.wait(30)
    assert scene.got == []
    scene.unknown = {f"x{number}" for number in range(MAX_UNFILTERED + 50)}
    scene.dumb = False
    scene.wait(3)
    assert scene.reported() == [["mine begun"]]
    assert scene.got[0].left_out == 0


def test_quiet_hours_hold_alerts_that_last_until_their_end(scene: Scene) -> None:
    scene = Scene("2026-11-22 22:30:00")
    delivery = scene.delivery(quiet=NIGHT)
    delivery.offer(begun("a1", level="warning"))
    delivery.offer(begun("a2", level="warning"))
    delivery.offer(begun("a3", level="error"))
    scene.wait(1)
    assert scene.reported() == [["a3 begun"]]
    delivery.offer(ended("a2", level="warning"))
    scene.over.add("a2")
    scene.wait(8 * 3600)
    assert scene.reported() == [["a3 begun"]]
    scene.wait(3600)
    assert scene.reported()[1:] == [["a1 begun"]]
    assert delivery.waiting == 0


def test_the_end_of_a_delivered_alert_is_sent_after_quiet_hours() -> None:
    scene = Scene("2026-11-22 21:59:00")
    delivery = scene.delivery(quiet={**NIGHT, "least": "none"})
    delivery.offer(begun("a1"))
    scene.wait(3600)
    scene.over.add("a1")
    delivery.offer(ended("a1"))
    scene.wait(7 * 3600)
    assert scene.reported() == [["a1 begun"]]
    scene.wait(2 * 3600)
    assert scene.reported()[1:] == [["a1 over"]]


def test_the_end_is_sent_although_the_alert_came_back_in_quiet_hours() -> None:
    scene = Scene("2026-11-22 21:59:00")
    delivery = scene.delivery(quiet={**NIGHT, "least": "none"})
    delivery.offer(begun("a1"))
    scene.wait(3600)
    for each in ("a1", "a2"):
        delivery.offer(ended(each))
        delivery.offer(begun(each))
        delivery.offer(ended(each))
    scene.over |= {"a1", "a2"}
    scene.wait(9 * 3600)
    assert scene.reported() == [["a1 begun"], ["a1 over"]]
    assert delivery.waiting == 0


@pytest.mark.parametrize("past", [0.0, 30.0])
def test_the_end_of_a_held_alert_is_not_sent(past: float) -> None:
    scene = Scene("2026-11-22 06:59:00")
    delivery = scene.delivery(quiet=NIGHT)
    delivery.offer(begun("a1", level="warning"))
    delivery.offer(begun("a2", level="warning"))
    scene.wait(59)
    # Into a message that leaves as the quiet hours have ended.
    scene.wait(0.9)
    scene.over = {"a1"}
    delivery.offer(ended("a1", level="warning"))
    scene.wait(past)
    delivery.offer(begun("a3", level="warning"))
    scene.wait(90)
    reported = [each for message in scene.reported() for each in message]
    assert sorted(reported) == ["a2 begun", "a3 begun"]
    scene.over.add("a2")
    delivery.offer(ended("a2", level="warning"))
    scene.wait(61)
    assert scene.reported()[-1] == ["a2 over"]


def test_the_end_of_an_alert_that_became_worse_while_held_is_not_sent(scene: Scene) -> None:
    scene = Scene("2026-11-22 23:00:00")
    delivery = scene.delivery(quiet=NIGHT)
    delivery.offer(begun("a1", level="warning"))
    scene.wait(1)
    delivery.offer(ended("a1", level="error"))
    scene.over.add("a1")
    scene.wait(10 * 3600)
    assert scene.got == []
    assert delivery.waiting == 0


def test_the_list_of_delivered_alerts_is_bounded(scene: Scene) -> None:
    delivery = scene.delivery(group_s=5.0)
    for number in range(MAX_DELIVERED + 50):
        delivery.offer(begun(f"a{number}"))
        if number % 100 == 99:
            scene.wait(6)
    scene.wait(6)
    assert len(delivery._delivered) == MAX_DELIVERED
    delivery.offer(ended(f"a{MAX_DELIVERED}"))
    scene.wait(6)
    assert len(delivery._delivered) == MAX_DELIVERED - 1


def test_a_closed_delivery_sends_nothing(scene: Scene) -> None:
    delivery = scene.delivery()
    scene.hangs = True
    delivery.offer(begun("a1"))
    scene.wait(1)
    delivery.offer(begun("a2"))
    delivery.close()
    scene.wait(100)
    assert scene.got == []
    assert scene.clock.getDelayedCalls() == []
    assert scene.user_slots.tokens == 2


def test_a_delivery_that_is_closed_asks_nothing_more(scene: Scene) -> None:
    delivery = scene.delivery()
    scene.dumb = True
    delivery.offer(begun("a1"))
    scene.wait(1)
    delivery.close()
    scene.dumb = False
    asks = scene.asks
    scene.wait(100)
    assert (scene.got, scene.asks, delivery.waiting) == ([], asks, 0)
    assert scene.clock.getDelayedCalls() == []


def test_user_has_two_messages_in_flight_at_most(scene: Scene) -> None:
    scene.hangs = True
    deliveries = [scene.delivery() for _ in range(5)]
    for delivery in deliveries:
        delivery.offer(begun("a1"))
    scene.wait(1)
    assert len(scene.hanging) == 2
    scene.hanging[0].callback(None)
    scene.wait(1)
    assert len(scene.hanging) == 3
    for delivery in deliveries:
        delivery.close()


def test_a_failed_test_message_has_the_reason(scene: Scene) -> None:
    """The reason is given in words, if there is one."""
    reported: list[str] = []
    scene.errors = [again()]
    for _ in range(2):
        Deferred.fromCoroutine(module.send_test(scene.context, rule(), scene.user_slots)).addCallback(
            reported.append
        )
    assert reported == ["nobody answers", ""]
    assert scene.reported() == [["test test"]]
