"""The short-term memory: a million events asked, a thousand a second written beside ten readers, and a killed relay.

Nothing that was acknowledged may be missing after kill -9; a source that brings more than its share keeps no more.
"""

from __future__ import annotations

import http.client
import itertools
import json
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from bench.cpu import measured
from bench.relay import Relay
from bench.report import Options, Row
from relay_db import queries
from relay_db.base import canonical_json
from relay_db.engine import Database
from relay_db.queries import NewStoredEvent
from tests.worlds.processes import running
from tests.worlds.waiting import wait_for

EVENTS = "/api/v1/events"
SHARE = 5000
"""Events that a source may have."""

RATE = 1000.0
LOT = 10
"""Events a second, and in one request."""

WRITERS = 8
READERS = 10
PAUSE = 0.1
"""Seconds from an answer to a reader's next question."""

SOURCES = 24
GREEDY = "greedy"
EVERY = 4
"""Each fourth request brings events of one source."""

DAYS = 10.0
BAR_MS = 50.0

ASKS: dict[str, dict[str, str]] = {
    "the newest 100": {},
    "a kind, the last hour": {"kind": "k7", "last": "3600"},
    "a source and a kind": {"source": "filled3", "kind": "k7"},
    "a robot": {"robot": "rover"},
    "a user": {"user": "user5"},
    "a field, the last hour": {"kind": "k3", "data.person": "p3", "last": "3600"},
    "counted, the last minute": {"kind": "k3", "data.person": "p3", "last": "60", "count": "true"},
    "a field alone, of none": {"data.person": "nobody"},
    "kinds that begin so, of none": {"kind": "zz*"},
    "all counted": {"count": "true"},
    "a field counted": {"data.person": "p3", "count": "true"},
    "a user and a field, of none": {"user": "user5", "data.person": "nobody"},
    "a page a day back": {"until": "{yesterday}", "kind": "k9"},
}


class Asker:
    """One program with a connection that stays."""

    def __init__(self, port: int, token: str) -> None:
        self._connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
        self._headers = {"Authorization": f"Bearer {token}", "Content-Type": "application/json"}

    def ask(
        self, method: str, query: dict[str, str], body: Any = None, accept: str = ""
    ) -> tuple[int, bytes]:
        """One request; status and body."""
        headers = {**self._headers, **({"Accept": accept} if accept else {})}
        text = None if body is None else json.dumps(body)
        self._connection.request(method, f"{EVENTS}?{urlencode(query)}", text, headers)
        answer = self._connection.getresponse()
        return answer.status, answer.read()

    def close(self) -> None:
        """Hang up."""
        self._connection.close()


class Crew:
    """Threads that do something over and over until they are told to end, or the relay is gone."""

    def __init__(self, count: int, asker: Callable[[], Asker], work: Callable[[Asker], float]) -> None:
        """:param work: is done once; seconds until it is done again"""
        self._end = threading.Event()
        self.broken: list[str] = []
        self._threads = [
            threading.Thread(target=self._run, args=(asker, work), daemon=True) for _ in range(count)
        ]
        for each in self._threads:
            each.start()

    def _run(self, asker: Callable[[], Asker], work: Callable[[Asker], float]) -> None:
        asks = asker()
        try:
            while not self._end.wait(max(0.0, work(asks))):
                pass
        except (OSError, http.client.HTTPException) as error:
            self.broken.append(repr(error))
        finally:
            asks.close()

    def stop(self) -> None:
        """End."""
        self._end.set()
        for each in self._threads:
            each.join(60)


class Load:
    """What is written and asked at a time."""

    def __init__(self) -> None:
        self.kept: list[tuple[str, int]] = []
        self.took: list[float] = []
        self.asked: list[float] = []
        self.refused = 0
        self._numbers = itertools.count()
        self._begun = time.monotonic()

    def write(self, asker: Asker) -> float:
        """One request of so many events; it is due at its time, however long the others took."""
        number = next(self._numbers)
        source = GREEDY if number % EVERY == 0 else f"busy{number % SOURCES}"
        event = {
            "kind": f"k{number % 50}",
            "source": source,
            "data": {"n": number, "person": f"p{number % 97}"},
        }
        began = time.monotonic()
        status, body = asker.ask("POST", {}, [event] * LOT)
        self.took.append(time.monotonic() - began)
        if status == http.client.CREATED:
            self.kept += [(source, each["id"]) for each in json.loads(body)["events"]]
        else:
            self.refused += LOT
        return self._begun + (number + WRITERS) * LOT / RATE - time.monotonic()

    def ask(self, asker: Asker) -> float:
        """One question."""
        began = time.monotonic()
        status, _ = asker.ask("GET", {"kind": f"k{len(self.asked) % 50}", "last": "60"})
        assert status == http.client.OK, status
        self.asked.append(time.monotonic() - began)
        return PAUSE


def fill(relay: Relay, count: int) -> None:
    """So many events of the last days, written past the relay."""
    now = time.time()
    database = Database(f"sqlite:///{relay.data}/switchboard.db")
    with database.reading() as s:
        robot = queries.find_robot(s, "rover")
        assert robot is not None
    for first in range(0, count, 10_000):
        last = min(count, first + 10_000)
        with database.begin() as s:
            queries.store_events(
                s, [_event(n, now - DAYS * 86400 * (1 - n / count), robot.id) for n in range(first, last)]
            )
    database.close()


def _event(number: int, at: float, rover: int) -> NewStoredEvent:
    data = canonical_json({"n": number, "person": f"p{number % 97}"})
    robot = rover + number % 20 if number % 3 == 0 else None
    return NewStoredEvent(
        "default", at, f"filled{number % 250}", f"k{number % 50}", robot, f"user{number % 40}", data
    )


def asked(asker: Asker, times: int) -> dict[str, list[float]]:
    """Each question so often, in turn; milliseconds."""
    yesterday = str(int(time.time() - 86400))
    took: dict[str, list[float]] = {name: [] for name in ASKS}
    for _ in range(times):
        for name, query in ASKS.items():
            began = time.monotonic()
            status, _ = asker.ask(
                "GET", {key: each.format(yesterday=yesterday) for key, each in query.items()}
            )
            assert status == http.client.OK, (name, status)
            took[name].append((time.monotonic() - began) * 1e3)
    return {name: sorted(each) for name, each in took.items()}


def run(options: Options) -> list[Row]:
    """Questions at rest, questions and events under load, and what is left of it after kill -9."""
    count = int(options.pick(3000, 1_000_000))
    seconds = options.seconds or options.pick(1, 60)
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        relay = Relay(Path(folder), "--events-per-source", str(SHARE))
        with running(relay):
            relay.cli("robot", "add", "rover")
            people = [_user(relay, f"user-{number}") for number in range(1 + READERS + WRITERS)]
            fill(relay, count)
            rows = list(_at_rest(Asker(relay.http_port, people[0]), count, int(options.pick(2, 50))))
            rows += _under_load(relay, people, seconds)
    for row in rows:
        print(f"    {row.what}: {row.ours:.1f} {row.unit}", flush=True)
    return rows


def _user(relay: Relay, name: str) -> str:
    """Somebody who may see the robot; his token. One asks no more often than a user may."""
    token = relay.user(name)
    relay.cli("right", "grant", name, "rover", "viewer")
    return token


def _at_rest(asker: Asker, count: int, times: int) -> Iterator[Row]:
    took = asked(asker, times)
    worst = max(took, key=lambda name: _part(took[name], 0.99))
    told = ", ".join(
        f"{name} {_part(each, 0.5):.1f} / {_part(each, 0.99):.1f}" for name, each in took.items()
    )
    note = f"{count:,} events, each question {times} times; ms, p50 / p99: {told}"
    every = sorted(itertools.chain(*took.values()))
    yield Row("memory", "question at rest, median", "ms", _part(every, 0.5), note=note)
    yield Row(
        "memory", "question at rest, p99 of the slowest kind", "ms", _part(took[worst], 0.99), bar=BAR_MS
    )
    asker.close()


def _under_load(relay: Relay, people: list[str], seconds: float) -> Iterator[Row]:
    load, tokens = Load(), itertools.cycle(people)

    def asker() -> Asker:
        return Asker(relay.http_port, next(tokens))

    readers = Crew(READERS, asker, load.ask)
    writers = Crew(WRITERS, asker, load.write)
    with measured(relay.pid) as used:
        time.sleep(seconds)  # the length of the measurement
    broken = [*readers.broken, *writers.broken]
    assert not broken, broken
    kept = len(load.kept)
    relay.kill()
    writers.stop()
    readers.stop()
    relay.start()
    asks = asker()
    lost = len({number for source, number in load.kept if source != GREEDY} - set(_numbers(asks, "busy*")))
    greedy = {"source": GREEDY, "count": "true"}
    brought = sum(source == GREEDY for source, _ in load.kept)
    wait_for("the source has its share", lambda: _count(asks, greedy) <= SHARE)
    left = _count(asks, greedy)
    asks.close()
    wrote, read = sorted(load.took), sorted(load.asked)
    note = (
        f"{seconds:g} s, {len(load.kept):,} events acknowledged, {load.refused:,} refused, "
        f"{len(load.asked):,} questions; "
        f"one source brought {brought:,} and may have {SHARE:,}"
    )
    yield Row("memory", "events acknowledged", "/s", kept / seconds, note=note)
    yield Row("memory", f"{LOT} events → acknowledged, median", "ms", _part(wrote, 0.5) * 1e3)
    yield Row("memory", f"{LOT} events → acknowledged, p99", "ms", _part(wrote, 0.99) * 1e3)
    yield Row("memory", "question under load, median", "ms", _part(read, 0.5) * 1e3)
    yield Row("memory", "question under load, p99", "ms", _part(read, 0.99) * 1e3, bar=BAR_MS)
    yield Row("memory", "relay's processor under load", "%", used.seconds / seconds * 100)
    yield Row("memory", "acknowledged and lost by kill -9", "events", lost, bar=0)
    yield Row("memory", "events of a greedy source", "events", left, bar=SHARE)


def _numbers(asker: Asker, source: str) -> list[int]:
    _, body = asker.ask("GET", {"source": source}, accept="application/jsonl")
    return [json.loads(line)["id"] for line in body.splitlines()]


def _count(asker: Asker, query: dict[str, str]) -> int:
    _, body = asker.ask("GET", query)
    return int(json.loads(body)["count"])


def _part(values: list[float], part: float) -> float:
    return values[int(part * (len(values) - 1))]
