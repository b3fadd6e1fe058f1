"""Notices between relays that the database has changed."""

from __future__ import annotations

import pytest
from twisted.internet.task import Clock

from relay_protocol.errors import Unavailable
from relay_server.cluster.bus import LocalBus
from relay_server.cluster.change_notices import SUBJECT, ChangeNotices


class Member:
    """One relay of a cluster.

    :ivar applied: how often it was asked to apply changes
    """

    def __init__(self, bus: LocalBus) -> None:
        self.applied = 0
        self.answers = True
        self.notices = ChangeNotices(bus)
        self.notices.apply = self._apply
        self.notices.start()

    async def _apply(self) -> None:
        self.applied += 1
        if not self.answers:
            raise Unavailable("the database does not answer")
        self.notices.applied(7)


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def bus(clock: Clock) -> LocalBus:
    return LocalBus(clock)


def test_each_change_is_applied_once_at_each_other_relay(bus: LocalBus, clock: Clock) -> None:
    """A relay does not repeat the notices of another, so notices end."""
    seen: list[bytes] = []
    bus.subscribe(SUBJECT, lambda _, body: seen.append(body))
    first, second, third = (Member(bus) for _ in range(3))
    first.notices.applied(7)
    first.notices.applied(7)
    first.notices.applied(6)
    clock.pump([1, 1, 1])
    assert [each.applied for each in (first, second, third)] == [0, 1, 1]
    assert seen == [b"7"]


@pytest.mark.parametrize("body", [b"", b"x", b"-1"])
def test_a_notice_that_is_no_revision_changes_nothing(bus: LocalBus, clock: Clock, body: bytes) -> None:
    member = Member(bus)
    bus.publish(SUBJECT, body)
    clock.advance(1)
    assert member.applied == 0


def test_polling_has_to_repeat_what_a_notice_could_not_apply(bus: LocalBus, clock: Clock) -> None:
    """A notice fails silently while the database does not answer, and after shutdown."""
    member = Member(bus)
    member.answers = False
    bus.publish(SUBJECT, b"7")
    clock.advance(1)
    assert member.applied == 1
    member.notices.stop()
    bus.publish(SUBJECT, b"8")
    clock.advance(1)
    assert member.applied == 1
