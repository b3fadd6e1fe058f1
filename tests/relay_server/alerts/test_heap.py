"""What waits is in its order, once each, and the mildest gives way."""

from __future__ import annotations

from relay_server.alerts.delivery import NotificationQueue
from relay_server.alerts.message import AlertNotice
from tests.relay_server.alerts.made_up import alert


def notice(id: str, level: str = "warning", event: str = "begun", robot: int = 1) -> AlertNotice:
    """News of an alert."""
    return AlertNotice(alert(id, level=level, robot_id=robot), event)


def ids(heap: NotificationQueue) -> list[str]:
    """What waits, in its order."""
    return [f"{each.notice.alert.id} {each.notice.event}" for each in heap]


def test_the_same_news_waits_once_since_it_came_first() -> None:
    """Its latest words count, and its place is that of the latest."""
    heap = NotificationQueue(5)
    heap.put(notice("a"), 1.0)
    heap.put(notice("b"), 2.0)
    heap.put(notice("a", "error"), 3.0)
    assert ids(heap) == ["b begun", "a begun"]
    assert [each.since for each in heap] == [2.0, 1.0]
    assert [each.alert.level for each in heap.take()] == ["warning", "error"]
    assert len(heap) == 0


def test_the_mildest_gives_way_then_an_end_then_the_oldest() -> None:
    """Also when it is the latest; one each time there are too many."""
    heap = NotificationQueue(3)
    for each in (notice("old"), notice("bad", "error"), notice("well", event="over")):
        assert heap.put(each, 0.0) == 0
    assert heap.put(notice("new"), 0.0) == 1
    assert ids(heap) == ["old begun", "bad begun", "new begun"]
    assert heap.put(notice("mild", "info"), 0.0) == 1
    assert ids(heap) == ["old begun", "bad begun", "new begun"]
    assert heap.put(notice("worse", "error"), 0.0) == 1
    assert ids(heap) == ["bad begun", "new begun", "worse begun"]


def test_where_it_is_fair_who_has_most_gives_way() -> None:
    """Whatever it tells; of his own the mildest."""
    heap = NotificationQueue(3, fair=True)
    heap.put(notice("mine", "info"), 0.0)
    for number, level in enumerate(("error", "warning", "error")):
        heap.put(notice(f"x{number}", level, robot=2), 0.0)
    assert ids(heap) == ["mine begun", "x0 begun", "x2 begun"]


def test_what_is_dropped_is_given_back_as_it_was_last() -> None:
    """And nothing, when it is not there."""
    heap = NotificationQueue(3)
    heap.put(notice("a"), 1.0)
    heap.put(notice("a", "error"), 2.0)
    dropped = heap.drop(notice("a"))
    assert dropped is not None
    assert (dropped.notice.alert.level, dropped.since) == ("error", 1.0)
    assert heap.drop(notice("a")) is None
