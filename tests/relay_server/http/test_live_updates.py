"""Updates of one page: their contents and their times."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest
from twisted.internet.defer import CancelledError, Deferred
from twisted.internet.task import Clock

from relay_protocol.errors import Unavailable
from relay_server.access import BadCredentials, Principal
from relay_server.http import live_updates as module
from relay_server.http.live_updates import COALESCE_SECONDS, LiveUpdates, Sources

ANN = Principal(1, "ann", "main", False, 1, None)
Rows = list[dict[str, Any]]


class Page:
    """A page that keeps its updates; its database can hang or fail."""

    def __init__(self) -> None:
        self.clock = Clock()
        self.sent: list[tuple[str, Any]] = []
        self.at: list[float] = []
        self.cuts = 0
        self.robots: Rows = [{"name": "rover"}]
        self.alerts: Rows = []
        self.answers: Deferred[None] | None = None
        self.error: Exception | None = None
        self.listeners: list[Callable[[], None]] = []
        self.full_after = 1000
        self.during: Callable[[], None] = lambda: None
        sources = {"robots": self._robots, "alerts": self._alerts}
        self.updates = LiveUpdates(
            self.clock, self, self._principal, Sources(self.clock, sources, self._on_change)
        )

    def begin(self) -> Deferred[None]:
        return Deferred.fromCoroutine(self.updates.run())

    async def _principal(self) -> Principal:
        if self.answers is not None:
            await self.answers
        if self.error is not None:
            raise self.error
        return ANN

    async def _robots(self, principal: Principal) -> Rows:
        assert principal is ANN
        return self.robots

    async def _alerts(self, principal: Principal) -> Rows:
        self.during()
        return self.alerts

    def _on_change(self, listener: Callable[[], None]) -> Callable[[], None]:
        self.listeners.append(listener)
        return lambda: self.listeners.remove(listener)

    def changed(self) -> None:
        for listener in list(self.listeners):
            listener()

    def renamed(self, name: str) -> None:
        self.robots = [{"name": name}]
        self.changed()

    def passes(self, seconds: float) -> None:
        """Advance the clock in small steps that add up without a remainder."""
        for _ in range(round(seconds * 16)):
            self.clock.advance(1 / 16)

    def events(self) -> list[str]:
        """Names of the events since the last call."""
        names = [name for name, _ in self.sent]
        self.sent.clear()
        return names

    # --- UpdateSink ---------------------------------------------------------------------------------------

    def send(self, event: str, body: bytes) -> None:
        self.sent.append((event, json.loads(body)))
        self.at.append(self.clock.seconds())
        if len(self.at) == self.full_after:
            self.updates.pause()

    def made_progress(self) -> bool:
        return False

    def cut(self) -> None:
        self.cuts += 1


@pytest.fixture
def page() -> Page:
    return Page()


def test_all_lists_are_sent_at_once(page: Page) -> None:
    page.begin()
    assert page.sent == [("robots", {"robots": [{"name": "rover"}]}), ("alerts", {"alerts": []})]


def test_changes_in_quick_succession_are_sent_once(page: Page) -> None:
    """The first of them is not delayed."""
    page.begin()
    page.passes(COALESCE_SECONDS)
    page.events()
    page.changed()
    assert page.events() == []
    page.renamed("one")
    assert page.events() == []
    page.passes(COALESCE_SECONDS)
    assert page.events() == ["robots"]
    for number in range(10):
        page.renamed(f"robot {number}")
    assert page.events() == []
    page.passes(COALESCE_SECONDS)
    assert page.events() == ["robots"]
    page.passes(COALESCE_SECONDS)
    assert page.events() == []


def test_a_change_that_is_hidden_from_the_reader_sends_nothing(page: Page) -> None:
    """Equal lists are repeated at fixed times only, so the reader learns nothing of other users."""
    page.begin()
    for _ in range(130):
        page.changed()
        page.alerts = list(page.alerts)
        page.passes(1 / 16)
    assert [name for name, _ in page.sent] == ["robots", "alerts", "robots", "robots"]
    assert page.at == [0.0, 0.0, module.QUIET_SECONDS, 2 * module.QUIET_SECONDS]


def test_passing_fields_alone_are_sent_when_an_update_is_due(page: Page) -> None:
    """``last_seen`` differs at each look-up, for reasons that may be hidden from the reader."""
    page.alerts = [{"id": "a1", "count": 1}]
    page.begin()
    page.events()
    for number in range(16):
        page.robots = [{"name": "rover", "last_seen": float(number), "rtt_ms": number / 4}]
        page.alerts = [{"id": "a1", "count": number}]
        page.changed()
        page.passes(0.25)
    assert [name for name, _ in page.sent] == ["robots", "alerts"]
    assert page.at[2:] == [module.QUIET_SECONDS] * 2


def test_a_failing_database_is_reported_at_once_and_then_at_fixed_times(page: Page) -> None:
    page.begin()
    page.passes(1.0)
    page.error = Unavailable("the database does not answer")
    page.events()
    for _ in range(16 * 7):
        page.changed()
        page.passes(1 / 16)
    assert page.events() == ["unknown"] * 3
    assert page.at[-3:] == [1.0, 1.0 + module.QUIET_SECONDS, 1.0 + 2 * module.QUIET_SECONDS]
    page.error = None
    page.changed()
    page.passes(COALESCE_SECONDS)
    assert page.events() == ["robots"]


@pytest.mark.parametrize("woken", [False, True])
def test_a_late_look_up_is_reported_a_fixed_time_after_the_last_update(page: Page, woken: bool) -> None:
    """The start of the look-up does not count: a hidden change may have caused it."""
    page.begin()
    page.passes(1.0)
    page.answers = Deferred()
    if woken:
        page.changed()
    page.passes(module.STREAM_SECONDS)
    assert page.at[2:] == [module.QUIET_SECONDS + module.LOOKUP_SECONDS]
    assert page.sent[-1][0] == module.UNKNOWN


def test_a_change_during_a_look_up_causes_another_one(page: Page) -> None:
    begun = False

    def change() -> None:
        nonlocal begun
        if not begun:
            begun = True
            page.renamed("digger")

    page.during = change
    page.begin()
    page.events()
    page.passes(COALESCE_SECONDS)
    assert page.events() == ["robots"]


def test_only_the_robots_are_repeated_without_a_change(page: Page) -> None:
    page.begin()
    page.events()
    page.passes(COALESCE_SECONDS + module.QUIET_SECONDS)
    assert page.events() == ["robots"]
    page.alerts = [{"id": "a1"}]
    page.passes(COALESCE_SECONDS + module.QUIET_SECONDS)
    assert page.events() == ["robots", "alerts"]


@pytest.mark.parametrize("hangs", [False, True])
def test_silence_is_bounded_for_any_state_of_the_database(page: Page, hangs: bool) -> None:
    page.begin()
    page.passes(12.0)
    if hangs:
        page.answers = Deferred()
    else:
        page.error = Unavailable("the database does not answer")
    page.passes(30.0)
    gaps = [after - before for before, after in zip(page.at, page.at[1:], strict=False)]
    assert max(gaps) <= module.STREAM_SECONDS
    assert page.sent[-1] == (module.UNKNOWN, {"reason": "the database does not answer"})
    page.error = None
    if page.answers is not None:
        page.answers.callback(None)
    page.passes(module.STREAM_SECONDS)
    assert page.sent[-1][0] == "robots"


def test_a_look_up_that_hangs_is_the_only_one(page: Page) -> None:
    """Further ones would wait behind it, each in a slot that other users need."""
    looks = 0
    looked = page._principal

    def counted() -> Any:
        nonlocal looks
        looks += 1
        return looked()

    page.updates = LiveUpdates(page.clock, page, counted, Sources(page.clock, {}, page._on_change))
    page.answers = Deferred()
    page.begin()
    for _ in range(20):
        page.changed()
        page.passes(1.0)
    assert looks == 1
    assert set(page.events()) == {module.UNKNOWN}


def test_it_ends_with_the_credentials(page: Page) -> None:
    """The error gives the reason, and nothing is left behind."""
    running = page.begin()
    page.passes(COALESCE_SECONDS)
    page.error = BadCredentials("your session has ended")
    page.changed()
    failed: list[str] = []
    running.addErrback(lambda failure: failed.append(str(failure.value)))
    assert failed == ["your session has ended"]
    assert page.listeners == []
    assert not page.clock.getDelayedCalls()


@pytest.mark.parametrize("when", ["asleep", "waiting", "looking"])
def test_a_page_that_leaves_leaves_nothing_behind(page: Page, when: str) -> None:
    if when == "looking":
        page.answers = Deferred()
    running = page.begin()
    if when == "waiting":
        page.passes(COALESCE_SECONDS + 0.5)
    running.addErrback(lambda failure: failure.trap(CancelledError))
    running.cancel()
    assert page.listeners == []
    assert not page.clock.getDelayedCalls()


def test_a_page_that_accepts_nothing_gets_no_updates_and_is_cut(page: Page) -> None:
    page.begin()
    page.events()
    page.updates.pause()
    page.updates.pause()
    for _ in range(8):
        page.changed()
        page.passes(0.5)
    assert (page.events(), page.cuts) == ([], 0)
    page.passes(1.5)
    assert (page.events(), page.cuts) == ([], 1)


def test_a_page_that_accepts_bytes_again_is_updated_at_once(page: Page) -> None:
    """It gets the present state and the lists that it missed."""
    page.full_after = 1
    page.begin()
    assert page.events() == ["robots"]
    page.passes(1.0)
    page.updates.resume()
    assert page.events() == ["robots", "alerts"]
    page.passes(module.STALL_SECONDS * 2)
    assert page.cuts == 0
