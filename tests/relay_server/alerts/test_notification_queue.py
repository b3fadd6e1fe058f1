"""Notifications wait in order, each once; the least severe is dropped first."""

from __future__ import annotations

from relay_server.alerts.delivery import NotificationQueue
from relay_server.alerts.schemas import AlertNotice
from tests.worlds.alerts import alert


def notice(id: str, level: str = "warning", event: str = "begun", robot: int = 1) -> AlertNotice:
    """Notice of an alert."""
    return AlertNotice(alert(id, level=level, robot_id=robot), event)


def ids(heap: NotificationQueue) -> list[str]:
    """Waiting notices, in order."""
    return [f"{each.notice.alert.id} {each.notice.event}" for each in heap]


def test_the_same_news_waits_once_since_it_came_first() -> None:
    """The latest text counts, and the notice moves to the end."""
    heap = NotificationQueue(5)
    heap.put(notice("a"), 1.0)
    heap.put(notice("b"), 2.0)
    heap.put(notice("a", "error"), 3.0)
    assert ids(heap) == ["b begun", "a begun"]
    assert [each.since for each in heap] == [2.0, 1.0]
    assert [each.alert.level for each in heap.take()] == ["warning", "error"]
    assert len(heap) == 0


def test_the_least_severe_is_dropped_then_an_end_then_the_oldest() -> None:
    heap = NotificationQueue(3)
    for each in (notice("old"), notice("bad", "error"), notice("well", event="over")):
        assert heap.put(each, 0.0) == 0
    assert heap.put(notice("new"), 0.0) == 1
    assert ids(heap) == ["old begun", "bad begun", "new begun"]
    assert heap.put(notice("mild", "info"), 0.0) == 1
    assert ids(heap) == ["old begun", "bad begun", "new begun"]
    assert heap.put(notice("worse", "error"), 0.0) == 1
    assert ids(heap) == ["bad begun", "new begun", "worse begun"]


def test_a_fair_queue_drops_from_the_robot_with_the_most() -> None:
    heap = NotificationQueue(3, fair=True)
    heap.put(notice("mine", "info"), 0.0)
    for number, level in enumerate(("error", "warning", "error")):
        heap.put(notice(f"x{number}", level, robot=2), 0.0)
    assert ids(heap) == ["mine begun", "x0 begun", "x2 begun"]


def test_dropping_returns_the_latest_version() -> None:
    heap = NotificationQueue(3)
    heap.put(notice("a"), 1.0)
    heap.put(notice("a", "error"), 2.0)
    dropped = heap.drop(notice("a"))
    assert dropped is not None
    assert (dropped.notice.alert.level, dropped.since) == ("error", 1.0)
    assert heap.drop(notice("a")) is None
