"""What is to be told goes together, is tried again, waits for the end of quiet hours, and is bounded."""

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
    MOST,
    PRESSED_SECONDS,
    RETRY_SECONDS,
    TOLD,
    UNJUDGED,
    Delivery,
    DeliveryContext,
)
from relay_server.alerts.message import NotificationMessage, Undelivered
from relay_server.alerts.store import AlertChange
from relay_server.alerts.types import AlertEvent
from tests.relay_server.alerts.made_up import alert, rule

NIGHT = {"from": "22:00", "to": "07:00", "zone": "UTC", "least": "error"}


def its_own(alert: AlertRecord) -> frozenset[str]:
    """No robot is shared here."""
    return frozenset({alert.realm})


class Scene:
    """One rule's way out, its time, and a receiver that fails when the test says so."""

    def __init__(self, wall: str = "2026-11-22 12:00:00") -> None:
        self.clock = Clock()
        self._wall = datetime.fromisoformat(wall).replace(tzinfo=UTC).timestamp()
        self.got: list[NotificationMessage] = []
        self.doubtful: list[bool] = []
        self.errors: list[Exception] = []
        self.hanging: list[Deferred[None]] = []
        self.hangs = False
        self.dumb = False
        self.unknown: set[str] = set()
        self.over: set[str] = set()
        self.asks = 0
        self._names = 0
        self.office = DeliveryContext(
            self.clock,
            self.wall,
            lambda: 0.0,
            self._name,
            self._send,
            self._known,
            self._lasts,
            its_own,
            self._room,
        )
        self.places = DeferredSemaphore(2)
        self.rooms = DeferredSemaphore(4)

    def wall(self) -> float:
        """Unix time."""
        return self._wall + self.clock.seconds()

    def delivery(self, **other: Any) -> Delivery:
        """Of a rule."""
        return Delivery(self.office, rule(**other), self.places)

    def wait(self, seconds: float) -> None:
        """Time goes by, in steps."""
        until = self.clock.seconds() + seconds
        while (left := until - self.clock.seconds()) > 1e-9:
            self.clock.advance(min(left, 0.25 if seconds < 600 else 30.0))

    def told(self) -> list[list[str]]:
        """What each message that arrived told."""
        return [[f"{each.alert.id} {each.event}" for each in message.notices] for message in self.got]

    def _name(self) -> str:
        self._names += 1
        return f"d{self._names}"

    @asynccontextmanager
    async def _room(self, rule: AlertRuleRecord, doubtful: bool) -> AsyncIterator[None]:
        async with self.rooms:
            self.doubtful.append(doubtful)
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
    """News of an alert."""
    return AlertChange(alert(id, **other), AlertEvent.BEGUN)


def ended(id: str = "a1", **other: Any) -> AlertChange:
    """Its end."""
    return AlertChange(alert(id, over=11.0, **other), AlertEvent.OVER)


def again() -> Undelivered:
    """It may work the next time."""
    return Undelivered("nobody answers", again=True)


@pytest.fixture
def scene() -> Scene:
    """Noon."""
    return Scene()


def test_the_first_alert_leaves_at_once_with_what_comes_with_it(scene: Scene) -> None:
    """Within a fifth of a second: one message."""
    way = scene.delivery()
    way.offer(begun("a1"))
    scene.clock.advance(0.1)
    way.offer(begun("a2"))
    assert scene.told() == []
    scene.clock.advance(0.1)
    assert scene.told() == [["a1 begun", "a2 begun"]]
    assert (way.status.sent, way.status.failed, way.status.last) == (1, 0, scene.wall())


def test_after_a_message_the_next_waits_and_tells_all_that_came(scene: Scene) -> None:
    """No more than one in the rule's time, however much happens; each alert once."""
    way = scene.delivery(group_s=60.0)
    for second in range(120):
        way.offer(begun("a1", level="warning"))
        way.offer(ended("a1", level="warning"))
        way.offer(begun(f"b{second % 3}", level="warning"))
        scene.wait(1)
    assert [len(each) for each in scene.told()] == [3, 5]
    scene.wait(60)
    assert len(scene.got) == 3


def test_what_the_rule_does_not_want_is_not_told(scene: Scene) -> None:
    """Nothing even begins."""
    way = scene.delivery(kinds=("battery",))
    way.offer(begun())
    scene.wait(5)
    assert (scene.got, scene.asks, way.waiting) == ([], 0, 0)


def test_a_failed_message_is_tried_again_under_its_name(scene: Scene) -> None:
    """After growing pauses; what comes meanwhile waits for the next message."""
    way = scene.delivery(group_s=5.0)
    scene.errors = [again(), again()]
    way.offer(begun("a1"))
    scene.wait(1)
    way.offer(begun("a2", level="warning"))
    scene.wait(RETRY_SECONDS[0])
    assert scene.got == []
    scene.wait(RETRY_SECONDS[1])
    assert (scene.told(), scene.got[0].delivery) == ([["a1 begun"]], "d1")
    assert scene.doubtful == [False, True, True]
    scene.wait(5)
    assert scene.told()[1] == ["a2 begun"]
    assert scene.got[1].delivery == "d2"
    assert way.status.failed == 0


def test_a_dead_target_is_given_up_after_some_tries(scene: Scene) -> None:
    """It is counted with the reason; the next message is tried all the same."""
    way = scene.delivery()
    scene.errors = [again() for _ in range(len(RETRY_SECONDS) + 1)]
    way.offer(begun("a1"))
    scene.wait(sum(RETRY_SECONDS) + 100)
    assert (scene.got, scene.errors) == ([], [])
    assert (way.status.failed, way.status.reason) == (1, "nobody answers")
    way.offer(begun("a2"))
    scene.wait(100)
    assert scene.told() == [["a2 begun"]]


def test_what_is_hopeless_is_not_tried_again(scene: Scene) -> None:
    """A receiver that refuses is not asked six times."""
    way = scene.delivery()
    scene.errors = [Undelivered("status 404", again=False)]
    way.offer(begun("a1"))
    scene.wait(100)
    assert (scene.got, len(scene.doubtful), way.status.failed) == ([], 1, 1)


def test_a_database_that_does_not_answer_is_asked_again(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing is told to somebody of whom nobody knows what he may know."""
    answers = [Unavailable("locked")]

    async def known(rule: AlertRuleRecord, alerts: Collection[AlertRecord]) -> set[str]:
        if answers:
            raise answers.pop()
        return {each.id for each in alerts}

    office = DeliveryContext(
        scene.clock, scene.wall, lambda: 0.0, lambda: "d1", scene._send, known, scene._lasts, its_own
    )
    way = Delivery(office, rule(), scene.places)
    way.offer(begun())
    scene.wait(1)
    assert scene.got == []
    scene.wait(3)
    assert scene.told() == [["a1 begun"]]


def test_who_has_lost_the_right_is_told_nothing(scene: Scene) -> None:
    """It is judged as the message leaves, and before each further try."""
    way = scene.delivery()
    scene.unknown = {"a1"}
    way.offer(begun("a1"))
    way.offer(begun("a2"))
    scene.wait(1)
    assert scene.told() == [["a2 begun"]]
    scene.errors = [again()]
    way.offer(begun("a3", level="warning"))
    scene.wait(61)
    scene.unknown = {"a3"}
    scene.wait(60)
    assert len(scene.got) == 1
    assert way.waiting == 0


@pytest.mark.parametrize("wait", ["places", "rooms"])
def test_who_loses_the_right_while_a_message_waits_is_told_nothing(scene: Scene, wait: str) -> None:
    """Behind messages that hang, his own or others' on the same way; what he may still know of is told."""
    semaphore: DeferredSemaphore = getattr(scene, wait)
    taken = [semaphore.acquire() for _ in range(semaphore.limit)]
    way = scene.delivery()
    way.offer(begun("a1"))
    way.offer(begun("a2"))
    scene.wait(30)
    assert scene.got == []
    scene.unknown = {"a1"}
    for _ in taken:
        semaphore.release()
    assert scene.told() == [["a2 begun"]]
    assert semaphore.tokens == semaphore.limit


def test_an_error_waits_for_no_pause(scene: Scene) -> None:
    """Whatever was told a moment before, by the rule as it comes; what waited goes with it."""
    way = scene.delivery()
    way.offer(begun("control", level="error"))
    scene.wait(3)
    way.offer(begun("hot", level="warning"))
    scene.wait(1)
    assert scene.told() == [["control begun"]]
    way.offer(begun("offline", level="error"))
    scene.wait(0.25)
    assert scene.told() == [["control begun"], ["hot begun", "offline begun"]]
    way.offer(ended("offline", level="error"))
    scene.wait(59)
    assert len(scene.got) == 2
    scene.wait(1)
    assert scene.told()[2:] == [["offline over"]]


def test_what_is_worse_than_all_that_was_told_last_waits_for_no_pause(scene: Scene) -> None:
    """What is as bad does."""
    way = scene.delivery(level="info")
    way.offer(begun("a", level="info"))
    scene.wait(1)
    way.offer(begun("b", level="warning"))
    scene.wait(1)
    way.offer(begun("c", level="warning"))
    scene.wait(30)
    assert scene.told() == [["a begun"], ["b begun"]]
    scene.wait(31)
    assert scene.told()[2:] == [["c begun"]]


def test_errors_that_come_together_leave_together(scene: Scene) -> None:
    """Also within the pause: one message."""
    way = scene.delivery()
    way.offer(begun("a"))
    scene.wait(5)
    way.offer(begun("b"))
    scene.clock.advance(0.1)
    way.offer(begun("c"))
    scene.wait(1)
    assert scene.told() == [["a begun"], ["b begun", "c begun"]]


def test_errors_make_no_flood(scene: Scene) -> None:
    """Three messages more at once, and one in ten seconds after that; all errors are told, and all wait alike."""
    way = scene.delivery()
    for number in range(600):
        way.offer(begun(f"a{number}"))
        scene.wait(0.5)
    assert len(scene.got) <= 1 + 3 + 300 / 10
    scene.wait(11)
    told = [each for message in scene.told() for each in message]
    assert told == [f"a{number} begun" for number in range(600)]
    assert scene.got[-1].left_out == 0


def test_a_new_error_has_a_message_that_failed_tried_again_sooner(scene: Scene) -> None:
    """Once in half a minute, so that it does not wait for a receiver that is back; then it leaves at once."""
    way = scene.delivery()
    scene.errors = [again() for _ in range(5)]
    way.offer(begun("a"))
    scene.wait(170)
    assert scene.errors == []
    back = scene.clock.seconds()
    way.offer(begun("urgent"))
    while len(scene.got) < 2:
        scene.wait(1)
        assert scene.clock.seconds() - back < 31
    assert scene.told() == [["a begun"], ["urgent begun"]]


def test_errors_that_wait_do_not_use_up_the_tries_of_what_failed(scene: Scene) -> None:
    """It is given up no sooner than without them, and the receiver has a bounded number of tries."""
    way = scene.delivery()
    scene.errors = [again() for _ in range(1000)]
    way.offer(begun("a"))
    way_out = sum(RETRY_SECONDS) * 0.8
    scene.wait(1)
    way.offer(begun("b"))
    while not way.status.failed:
        scene.wait(10)
    assert way_out < scene.clock.seconds() < sum(RETRY_SECONDS) + 60
    assert len(scene.doubtful) <= 6 + sum(RETRY_SECONDS) / PRESSED_SECONDS


def test_what_waits_is_bounded(scene: Scene) -> None:
    """The mildest give way, among equals ends and then the oldest, and how many did is told."""
    way = scene.delivery(level="info")
    way.offer(begun("old", level="info"))
    way.offer(begun("bad", level="error"))
    way.offer(ended("bad", level="error"))
    for number in range(MOST + 30):
        way.offer(begun(f"a{number}", level="warning"))
    assert way.waiting == MOST
    scene.wait(1)
    told = scene.told()[0]
    assert told[:2] == ["bad begun", "bad over"]
    assert (told[2], told[-1]) == ("a32 begun", f"a{MOST + 29} begun")
    assert scene.got[0].left_out == 33


def test_alerts_of_other_peoples_robots_take_no_place(scene: Scene) -> None:
    """However many there are, and how bad: what somebody may know of stays, and he is not told their number."""
    way = scene.delivery()
    scene.unknown = {f"x{number}" for number in range(2 * MOST)}
    way.offer(begun("mine", level="warning"))
    for number in range(2 * MOST):
        way.offer(begun(f"x{number}", level="error", robot_id=2))
    assert way.waiting == 1
    scene.wait(1)
    assert scene.told() == [["mine begun"]]
    for number in range(MOST + 5):
        way.offer(begun(f"mine{number}", level="warning"))
        way.offer(begun(f"x{number}", level="error", robot_id=2))
    scene.wait(61)
    assert [message.left_out for message in scene.got] == [0, 5]


def test_alerts_of_another_realm_are_not_even_judged(scene: Scene) -> None:
    """However many, while the database does not answer: they take no place of those of one's own."""
    way = scene.delivery(realm="lab1", user="toad")
    scene.dumb = True
    for number in range(UNJUDGED + 50):
        way.offer(begun(f"x{number}", robot_id=number))
    assert (way.waiting, scene.asks) == (0, 0)
    way.offer(begun("mine", realm="lab1"))
    assert way.waiting == 1
    scene.dumb = False
    scene.wait(3)
    assert scene.told() == [["mine begun"]]


def test_the_log_says_of_which_realm_he_is_who_was_not_told(scene: Scene) -> None:
    """Users of several realms may have one name."""
    way = scene.delivery(realm="lab1", user="toad")
    scene.errors = [Undelivered("no such page", again=False)]
    with capturedLogs() as logs:
        way.offer(begun(realm="lab1"))
        scene.wait(1)
    assert "by rule 7 of toad@lab1: no such page" in str(formatEvent(logs[-1]))


def test_while_the_database_does_not_answer_a_robot_does_not_push_out_anothers_alerts(scene: Scene) -> None:
    """Nothing is judged then, what waits is bounded, and nothing of it is counted."""
    way = scene.delivery()
    scene.dumb = True
    way.offer(begun("mine", level="warning"))
    for number in range(UNJUDGED + 50):
        way.offer(begun(f"x{number}", level="error", robot_id=2))
    assert way.waiting == UNJUDGED
    scene.wait(30)
    assert scene.got == []
    scene.unknown = {f"x{number}" for number in range(UNJUDGED + 50)}
    scene.dumb = False
    scene.wait(3)
    assert scene.told() == [["mine begun"]]
    assert scene.got[0].left_out == 0


def test_quiet_hours_hold_what_still_lasts_at_their_end(scene: Scene) -> None:
    """What is over by then is not told; the worst is told at once."""
    scene = Scene("2026-11-22 22:30:00")
    way = scene.delivery(quiet=NIGHT)
    way.offer(begun("a1", level="warning"))
    way.offer(begun("a2", level="warning"))
    way.offer(begun("a3", level="error"))
    scene.wait(1)
    assert scene.told() == [["a3 begun"]]
    way.offer(ended("a2", level="warning"))
    scene.over.add("a2")
    scene.wait(8 * 3600)
    assert scene.told() == [["a3 begun"]]
    scene.wait(3600)
    assert scene.told()[1:] == [["a1 begun"]]
    assert way.waiting == 0


def test_the_end_of_what_was_told_before_is_told_after_quiet_hours() -> None:
    """Nobody goes on worrying."""
    scene = Scene("2026-11-22 21:59:00")
    way = scene.delivery(quiet={**NIGHT, "least": "none"})
    way.offer(begun("a1"))
    scene.wait(3600)
    scene.over.add("a1")
    way.offer(ended("a1"))
    scene.wait(7 * 3600)
    assert scene.told() == [["a1 begun"]]
    scene.wait(2 * 3600)
    assert scene.told()[1:] == [["a1 over"]]


def test_the_end_is_told_though_it_came_back_within_quiet_hours() -> None:
    """It was told before them; what began and ended within them alone is not."""
    scene = Scene("2026-11-22 21:59:00")
    way = scene.delivery(quiet={**NIGHT, "least": "none"})
    way.offer(begun("a1"))
    scene.wait(3600)
    for each in ("a1", "a2"):
        way.offer(ended(each))
        way.offer(begun(each))
        way.offer(ended(each))
    scene.over |= {"a1", "a2"}
    scene.wait(9 * 3600)
    assert scene.told() == [["a1 begun"], ["a1 over"]]
    assert way.waiting == 0


@pytest.mark.parametrize("past", [0.0, 30.0])
def test_the_end_of_what_was_only_put_aside_is_not_told(past: float) -> None:
    """Whether it comes in quiet hours or just after, it says nothing to who never heard that it began."""
    scene = Scene("2026-11-22 06:59:00")
    way = scene.delivery(quiet=NIGHT)
    way.offer(begun("a1", level="warning"))
    way.offer(begun("a2", level="warning"))
    scene.wait(59)
    # Into a message that leaves as the quiet hours have ended.
    scene.wait(0.9)
    scene.over = {"a1"}
    way.offer(ended("a1", level="warning"))
    scene.wait(past)
    way.offer(begun("a3", level="warning"))
    scene.wait(90)
    told = [each for message in scene.told() for each in message]
    assert sorted(told) == ["a2 begun", "a3 begun"]
    scene.over.add("a2")
    way.offer(ended("a2", level="warning"))
    scene.wait(61)
    assert scene.told()[-1] == ["a2 over"]


def test_the_end_of_what_got_worse_unheard_is_not_told(scene: Scene) -> None:
    """Though an end of that level may be told in quiet hours."""
    scene = Scene("2026-11-22 23:00:00")
    way = scene.delivery(quiet=NIGHT)
    way.offer(begun("a1", level="warning"))
    scene.wait(1)
    way.offer(ended("a1", level="error"))
    scene.over.add("a1")
    scene.wait(10 * 3600)
    assert scene.got == []
    assert way.waiting == 0


def test_what_is_remembered_as_told_is_bounded(scene: Scene) -> None:
    """An end that was told is forgotten, and of the others the oldest."""
    way = scene.delivery(group_s=5.0)
    for number in range(TOLD + 50):
        way.offer(begun(f"a{number}"))
        if number % 100 == 99:
            scene.wait(6)
    scene.wait(6)
    assert len(way._told) == TOLD
    way.offer(ended(f"a{TOLD}"))
    scene.wait(6)
    assert len(way._told) == TOLD - 1


def test_a_delivery_that_is_closed_tells_nothing_more(scene: Scene) -> None:
    """Neither what waits nor what is under way; nothing is left on the clock."""
    way = scene.delivery()
    scene.hangs = True
    way.offer(begun("a1"))
    scene.wait(1)
    way.offer(begun("a2"))
    way.close()
    scene.wait(100)
    assert scene.got == []
    assert scene.clock.getDelayedCalls() == []
    assert scene.places.tokens == 2


def test_a_delivery_that_is_closed_asks_nothing_more(scene: Scene) -> None:
    """Neither who may know of what, while the database does not answer."""
    way = scene.delivery()
    scene.dumb = True
    way.offer(begun("a1"))
    scene.wait(1)
    way.close()
    scene.dumb = False
    asks = scene.asks
    scene.wait(100)
    assert (scene.got, scene.asks, way.waiting) == ([], asks, 0)
    assert scene.clock.getDelayedCalls() == []


def test_one_user_has_two_messages_under_way_at_most(scene: Scene) -> None:
    """However many rules he has; the others wait their turn."""
    scene.hangs = True
    ways = [scene.delivery() for _ in range(5)]
    for way in ways:
        way.offer(begun("a1"))
    scene.wait(1)
    assert len(scene.hanging) == 2
    scene.hanging[0].callback(None)
    scene.wait(1)
    assert len(scene.hanging) == 3
    for way in ways:
        way.close()


def test_a_test_says_why_it_did_not_arrive(scene: Scene) -> None:
    """In words, or not at all."""
    told: list[str] = []
    scene.errors = [again()]
    for _ in range(2):
        Deferred.fromCoroutine(module.test(scene.office, rule(), scene.places)).addCallback(told.append)
    assert told == ["nobody answers", ""]
    assert scene.told() == [["test test"]]
