"""Alerts that other relays of a cluster have written."""

from __future__ import annotations

from collections.abc import Collection

import pytest
from twisted.internet.task import Clock

from relay_db.queries import AlertRecord
from relay_server.cluster.alert_notices import MOST_RECORDS, SUBJECT, AlertNotices
from relay_server.cluster.bus import LocalBus


def alert(number: int) -> AlertRecord:
    return AlertRecord(
        id=f"a{number}", robot_id=number, robot="rover", realm="default", kind="offline", about="", level="error",
        text="x" * 500, first=1.5, last=2.5, report_count=1, notification_count=1, over=None, ack_by="ann",
        ack_at=2.0,
    )  # fmt: skip


class Member:
    """One relay of a cluster.

    :ivar taken: the alerts of other relays
    """

    def __init__(self, bus: LocalBus, name: str) -> None:
        self.taken: list[AlertRecord] = []
        self.notices = AlertNotices(bus, name)
        self.notices.take = self._take
        self.notices.start()

    def _take(self, alerts: Collection[AlertRecord]) -> None:
        self.taken += alerts


@pytest.fixture
def bus() -> LocalBus:
    return LocalBus(Clock())


def passes(bus: LocalBus) -> None:
    bus._clock.pump([1, 1])  # type: ignore[attr-defined]


def test_all_other_relays_get_what_one_has_written(bus: LocalBus) -> None:
    """In notices that are not too large for the bus."""
    first, second, third = (Member(bus, name) for name in "abc")
    sizes: list[int] = []
    bus.subscribe(SUBJECT, lambda _, body: sizes.append(len(body)))
    written = [alert(number) for number in range(2 * MOST_RECORDS + 1)]
    first.notices.written(written)
    passes(bus)
    assert (first.taken, second.taken, third.taken) == ([], written, written)
    assert (len(sizes), max(sizes) < 100_000) == (3, True)
    second.notices.stop()
    first.notices.written(written)
    passes(bus)
    assert second.taken == written


@pytest.mark.parametrize("body", [b"", b"{}", b'["a",[["x"]]]', b'["a",[{}]]'])
def test_a_notice_that_can_not_be_read_changes_nothing(bus: LocalBus, body: bytes) -> None:
    member = Member(bus, "b")
    bus.publish(SUBJECT, body)
    passes(bus)
    assert member.taken == []
