"""What a page is told, and when."""

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
from relay_server.http.live_updates import LiveUpdates
from relay_server.http.update_sources import COALESCE_SECONDS, Sources

ANN = Principal(1, "ann", "main", False, 1, None)
Rows = list[dict[str, Any]]


class Room:
    """A page, and what it is told of; the database may be made to hang or to fail."""

    def __init__(self) -> None:
        self.clock = Clock()
        self.told: list[tuple[str, Any]] = []
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
        self.telling = LiveUpdates(
            self.clock, self, self._principal, Sources(self.clock, sources, self._on_change)
        )

    def begin(self) -> Deferred[None]:
        """Tell from now on."""
        return Deferred.fromCoroutine(self.telling.run())

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
        """Something changed."""
        for listener in list(self.listeners):
            listener()

    def renamed(self, name: str) -> None:
        """There is another robot."""
        self.robots = [{"name": name}]
        self.changed()

    def passes(self, seconds: float) -> None:
        """Time, in small steps that add up without a remainder."""
        for _ in range(round(seconds * 16)):
            self.clock.advance(1 / 16)

    def events(self) -> list[str]:
        """Names of what was told since the last time."""
        names = [name for name, _ in self.told]
        self.told.clear()
        return names

    # --- Page ---------------------------------------------------------------------------------------------

    def tell(self, event: str, body: bytes) -> None:
        """One event."""
        self.told.append((event, json.loads(body)))
        self.at.append(self.clock.seconds())
        if len(self.at) == self.full_after:
            self.telling.pause()

    def moves(self) -> bool:
        return self.moving

    moving = False

    def cut(self) -> None:
        """It takes nothing."""
        self.cuts += 1


@pytest.fixture
def room() -> Room:
    """Nothing was told yet."""
    return Room()


def test_everything_is_told_at_once(room: Room) -> None:
    """Each list under its name."""
    room.begin()
    assert room.told == [("robots", {"robots": [{"name": "rover"}]}), ("alerts", {"alerts": []})]


def test_changes_in_quick_succession_are_told_once(room: Room) -> None:
    """The first of them waits no longer than the others."""
    room.begin()
    room.passes(COALESCE_SECONDS)
    room.events()
    room.changed()
    assert room.events() == []
    room.renamed("one")
    assert room.events() == []
    room.passes(COALESCE_SECONDS)
    assert room.events() == ["robots"]
    for number in range(10):
        room.renamed(f"robot {number}")
    assert room.events() == []
    room.passes(COALESCE_SECONDS)
    assert room.events() == ["robots"]
    room.passes(COALESCE_SECONDS)
    assert room.events() == []


def test_what_is_nothing_new_is_told_only_when_it_is_time(room: Room) -> None:
    """Others come and go all the time: whoever sees nothing of them learns nothing of when they do."""
    room.begin()
    for _ in range(130):
        room.changed()
        room.alerts = list(room.alerts)
        room.passes(1 / 16)
    assert [name for name, _ in room.told] == ["robots", "alerts", "robots", "robots"]
    assert room.at == [0.0, 0.0, module.QUIET_SECONDS, 2 * module.QUIET_SECONDS]


def test_what_passes_is_no_news_before_it_is_time(room: Room) -> None:
    """When something last came from a robot is other at each look, whoever has caused it; it is told then."""
    room.alerts = [{"id": "a1", "count": 1}]
    room.begin()
    room.events()
    for number in range(16):
        room.robots = [{"name": "rover", "last_seen": float(number), "rtt_ms": number / 4}]
        room.alerts = [{"id": "a1", "count": number}]
        room.changed()
        room.passes(0.25)
    assert [name for name, _ in room.told] == ["robots", "alerts"]
    assert room.at[2:] == [module.QUIET_SECONDS] * 2


def test_that_the_database_is_away_is_told_again_only_when_it_is_time(room: Room) -> None:
    """At once as soon as it is known; then by the last telling, whoever wakes meanwhile, as what there is after it."""
    room.begin()
    room.passes(1.0)
    room.error = Unavailable("the database does not answer")
    room.events()
    for _ in range(16 * 7):
        room.changed()
        room.passes(1 / 16)
    assert room.events() == ["unknown"] * 3
    assert room.at[-3:] == [1.0, 1.0 + module.QUIET_SECONDS, 1.0 + 2 * module.QUIET_SECONDS]
    room.error = None
    room.changed()
    room.passes(COALESCE_SECONDS)
    assert room.events() == ["robots"]


@pytest.mark.parametrize("woken", [False, True])
def test_that_a_look_takes_long_is_told_by_the_last_telling(room: Room, woken: bool) -> None:
    """Not by when the look began, which may have been at what somebody else did."""
    room.begin()
    room.passes(1.0)
    room.answers = Deferred()
    if woken:
        room.changed()
    room.passes(module.STREAM_SECONDS)
    assert room.at[2:] == [module.QUIET_SECONDS + module.LOOK_SECONDS]
    assert room.told[-1][0] == module.UNKNOWN


def test_what_changes_while_it_is_looked_up_is_told_after_it(room: Room) -> None:
    """It may have come too late for what was looked up already."""
    begun = False

    def change() -> None:
        nonlocal begun
        if not begun:
            begun = True
            room.renamed("digger")

    room.during = change
    room.begin()
    room.events()
    room.passes(COALESCE_SECONDS)
    assert room.events() == ["robots"]


def test_other_events_are_told_when_they_are_another_list(room: Room) -> None:
    """Robots are told without news as well."""
    room.begin()
    room.events()
    room.passes(COALESCE_SECONDS + module.QUIET_SECONDS)
    assert room.events() == ["robots"]
    room.alerts = [{"id": "a1"}]
    room.passes(COALESCE_SECONDS + module.QUIET_SECONDS)
    assert room.events() == ["robots", "alerts"]


@pytest.mark.parametrize("hangs", [False, True])
def test_something_is_told_in_time_whatever_the_database_does(room: Room, hangs: bool) -> None:
    """Whoever hears nothing for longer knows that the relay is lost."""
    room.begin()
    room.passes(12.0)
    if hangs:
        room.answers = Deferred()
    else:
        room.error = Unavailable("the database does not answer")
    room.passes(30.0)
    gaps = [after - before for before, after in zip(room.at, room.at[1:], strict=False)]
    assert max(gaps) <= module.STREAM_SECONDS
    assert room.told[-1] == (module.UNKNOWN, {"reason": "the database does not answer"})
    room.error = None
    if room.answers is not None:
        room.answers.callback(None)
    room.passes(module.STREAM_SECONDS)
    assert room.told[-1][0] == "robots"


def test_a_look_that_hangs_is_the_only_one(room: Room) -> None:
    """Others would wait behind it, each in a place that somebody else needs."""
    looks = 0
    looked = room._principal

    def counted() -> Any:
        nonlocal looks
        looks += 1
        return looked()

    room.telling = LiveUpdates(room.clock, room, counted, Sources(room.clock, {}, room._on_change))
    room.answers = Deferred()
    room.begin()
    for _ in range(20):
        room.changed()
        room.passes(1.0)
    assert looks == 1
    assert set(room.events()) == {module.UNKNOWN}


def test_it_ends_with_the_credentials(room: Room) -> None:
    """The edge is told why, and nothing is left behind."""
    running = room.begin()
    room.passes(COALESCE_SECONDS)
    room.error = BadCredentials("your session has ended")
    room.changed()
    failed: list[str] = []
    running.addErrback(lambda failure: failed.append(str(failure.value)))
    assert failed == ["your session has ended"]
    assert room.listeners == []
    assert not room.clock.getDelayedCalls()


@pytest.mark.parametrize("when", ["asleep", "waiting", "looking"])
def test_who_leaves_leaves_nothing_behind(room: Room, when: str) -> None:
    """Neither a listener nor a timer, at whatever moment."""
    if when == "looking":
        room.answers = Deferred()
    running = room.begin()
    if when == "waiting":
        room.passes(COALESCE_SECONDS + 0.5)
    running.addErrback(lambda failure: failure.trap(CancelledError))
    running.cancel()
    assert room.listeners == []
    assert not room.clock.getDelayedCalls()


def test_a_page_that_takes_nothing_is_told_nothing_and_cut(room: Room) -> None:
    """Nothing piles up for it meanwhile."""
    room.begin()
    room.events()
    room.telling.pause()
    room.telling.pause()
    for _ in range(8):
        room.changed()
        room.passes(0.5)
    assert (room.events(), room.cuts) == ([], 0)
    room.passes(1.5)
    assert (room.events(), room.cuts) == ([], 1)


def test_a_page_that_takes_again_is_told_at_once(room: Room) -> None:
    """What is now, and what it has missed."""
    room.full_after = 1
    room.begin()
    assert room.events() == ["robots"]
    room.passes(1.0)
    room.telling.resume()
    assert room.events() == ["robots", "alerts"]
    room.passes(module.STALL_SECONDS * 2)
    assert room.cuts == 0
