"""What cases are made of: which operation and which sentence of which document they check, and what became of them."""

from __future__ import annotations

import inspect
import itertools
import json
import secrets
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import pytest
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rosbridge_client import PATIENCE, Client
from websockets.exceptions import WebSocketException

MARK = "conformance_case"
ROSBRIDGE_SUITE = "rosbridge_suite"
WORDS = {
    "passed": "[green]passed[/]",
    "failed": "[bold red]FAILED[/]",
    "differs": "[yellow]differs as known[/]",
    "spec only": "[dim]SPEC only[/]",
    "not tried": "[dim]not tried[/]",
    "not offered": "[dim]not offered[/]",
}

NO_STATUS = "it sends no status, errors go to its node's log only (rosbridge_library/protocol.py, log)"
"""Why every case that reads a ``status`` differs on rosbridge_suite."""

SPEC_ONLY = "a rule of this project's SPEC.md, not of rosbridge v2"
"""What a case that cites SPEC.md alone, or first, says about a server that never promised it: nothing."""

FIXTURE_VERSION = 2
FIXTURE_PATIENCE = 10.0
"""Seconds a command of the fixture node waits, unless it is told to wait for less."""

_names = itertools.count(1)


def case(op: str, section: str, *, suite: str = "") -> pytest.MarkDecorator:
    """Make a test function a case.

    :param op: operation it belongs to in the table
    :param section: document and section it checks
    :param suite: how rosbridge_suite 2.1 is known to differ, with where that is seen; needless for a section of SPEC
    """
    return getattr(pytest.mark, MARK)(op=op, section=section, suite=suite)


def known_difference(mark: pytest.Mark, target: str) -> str:
    """Why a case may fail on this target; empty when it may not."""
    if target != ROSBRIDGE_SUITE:
        return ""
    known: str = mark.kwargs["suite"]
    return known or (SPEC_ONLY if mark.kwargs["section"].startswith("SPEC ") else "")


def not_tried(why: str) -> None:
    """End a case that can't be tried on this server."""
    pytest.skip(f"not tried: {why}")


def not_offered(why: str) -> None:
    """End a case about something this robot doesn't offer."""
    pytest.skip(f"not offered: {why}")


class Outcome(NamedTuple):
    """What became of one case."""

    op: str
    title: str
    section: str
    word: str
    remark: str


def outcome_of(item: pytest.Item, report: pytest.TestReport) -> Outcome | None:
    """The outcome a report tells, if it tells one."""
    mark = item.get_closest_marker(MARK)
    if (
        mark is None
        or (report.when != "call" and report.passed)
        or (report.when == "teardown" and report.skipped)
    ):
        return None
    params = getattr(item, "callspec", None)
    title = inspect.cleandoc(item.function.__doc__ or item.name)  # type: ignore[attr-defined]
    title = title.partition("\n")[0] + (f" [{params.id}]" if params else "")
    word, remark = report.outcome, ""
    if hasattr(report, "wasxfail"):
        word, remark = ("spec only" if report.wasxfail == SPEC_ONLY else "differs"), report.wasxfail
    elif report.skipped:
        text = str(report.longrepr[2] if isinstance(report.longrepr, tuple) else report.longrepr)
        word, _, remark = text.removeprefix("Skipped: ").partition(": ")
    elif report.failed:
        remark = str(report.longreprtext).strip().splitlines()[-1] if report.longreprtext else ""
        crash = getattr(report.longrepr, "reprcrash", None)
        remark = crash.message.partition("\n")[0] if crash else remark
    return Outcome(mark.kwargs["op"], title, mark.kwargs["section"], word, remark)


def table(outcomes: Iterable[Outcome]) -> None:
    """Print every case by operation, and the sum."""
    told = list(outcomes)
    places = {op: place for place, op in enumerate(dict.fromkeys(each.op for each in told))}
    told.sort(key=lambda each: places[each.op])
    view = Table(box=None, pad_edge=False, header_style="bold")
    for name, ratio in (("op", None), ("case", 5), ("section", 3), ("outcome", None), ("remark", 4)):
        view.add_column(name, ratio=ratio, overflow="fold", no_wrap=ratio is None)
    before = ""
    for each in told:
        if before and each.op != before:
            view.add_section()
        view.add_row(
            each.op if each.op != before else "",
            escape(each.title),
            each.section,
            WORDS.get(each.word, each.word),
            escape(each.remark),
        )
        before = each.op
    console = Console(width=None if Console().is_terminal else 200, highlight=False)
    console.print()
    console.print(view)
    sums = Counter(each.word for each in told)
    console.print("\n" + ", ".join(f"{sums[word]} {word}" for word in WORDS if sums[word]))


@dataclass
class Server:
    """The rosbridge server that is checked.

    :param url: its websocket
    :param token: an access token, empty where none is needed
    :param target: ``rosbridge_suite`` where its known differences are to be counted as such
    :param patience: seconds an answer may take
    """

    url: str
    token: str = ""
    target: str = ""
    patience: float = PATIENCE
    about: dict[str, Any] = field(default_factory=dict)

    def connect(self, **options: Any) -> Client:
        """A client that is logged in."""
        return Client(self.url, self.token, self.patience, **options)

    @property
    def http_url(self) -> str:
        """The same address for HTTP."""
        return "http" + self.url.removeprefix("ws")

    @property
    def fixture_patience(self) -> float:
        """Seconds the fixture node waits for what a command is about: less than the answer may take."""
        return min(FIXTURE_PATIENCE, self.patience * 2 / 3)

    def look_for_fixture(self) -> str:
        """Find the fixture node behind the server, and have it wait no longer than the suite; else, what is missing."""
        with self.connect() as client:
            client.send("subscribe", topic="/conformance/about", type="std_msgs/msg/String")
            try:
                about = client.until("publish", min(15.0, 4 * self.patience), topic="/conformance/about")
            except AssertionError:
                return (
                    "the fixture node is not to be seen: start tests/conformance/fixture_node.py on the robot "
                    "(same ROS_DOMAIN_ID as the server)"
                )
            self.about = json.loads(about["msg"]["data"])
            if self.about["version"] != FIXTURE_VERSION:
                return "the fixture node is of another version: start it again from this checkout"
            words = ["patience", str(self.fixture_patience)]
            client.values("/conformance/do", {"prefixes": words, "depth": 0})
        return ""

    def lives(self) -> bool:
        """Whether a new client is served."""
        try:
            with self.connect() as client:
                client.lives()
        except (AssertionError, OSError, WebSocketException):
            return False
        return True

    def needs_examples(self) -> None:
        """End the case where the robot has no ``example_interfaces``."""
        if not self.about.get("example_interfaces"):
            not_tried("example_interfaces missing on the robot")

    def needs_token(self) -> None:
        """End the case where the server is open to everybody."""
        if not self.token:
            not_tried("no TOKEN was given")


class Hand:
    """The fixture node on the robot, told what to do over a connection of its own."""

    def __init__(self, server: Server) -> None:
        self._client = server.connect()
        self.waits = server.fixture_patience
        """Seconds the fixture node waits for what a command is about."""
        self._limit = self.waits + min(5.0, server.patience)
        self._open: list[tuple[str, str]] = []

    def close(self) -> None:
        """Take away what was made, and leave."""
        try:
            for kind, topic in self._open:
                self.do("end", kind, topic)
        finally:
            self._client.close()

    def ask(self, command: str, *words: str) -> str:
        """Send a command; the id its answer will have."""
        call_id = f"hand-{next(_names)}"
        args = {"prefixes": [command, *words], "depth": 0}
        self._client.send(
            "call_service", id=call_id, service="/conformance/do", args=args, timeout=self._limit
        )
        return call_id

    def answer(self, call_id: str, seconds: float | None = None) -> list[str]:
        """What a command gave.

        :param seconds: of a command that waits for more than one thing
        """
        told = self._client.until("service_response", seconds or self._limit, id=call_id)
        assert told["result"] is True, f"/conformance/do failed: {told.get('values')}"
        names: list[str] = told["values"]["result"]["names"]
        assert names[:1] != ["error"], names
        return names

    def do(self, command: str, *words: str) -> list[str]:
        """Have something done; see ``fixture_node.py`` for the commands."""
        return self.answer(self.ask(command, *words))

    def topic(self, name: str, type_name: str, profile: str = "reliable") -> None:
        """Let a topic appear."""
        self.do("publisher", name, type_name, profile)
        self._open.append(("publisher", name))

    def publish(self, name: str, *messages: Any) -> None:
        """Publish on it as soon as somebody listens."""
        count = self.do("publish", name, *(json.dumps(each) for each in messages))
        assert count != ["0"], f"the server did not subscribe to {name}"

    def vanish(self, name: str) -> None:
        """Take a topic away."""
        self._open.remove(("publisher", name))
        self.do("end", "publisher", name)

    def listen(self, name: str, type_name: str, profile: str = "reliable") -> None:
        """Record a topic."""
        self.do("listen", name, type_name, profile)
        self._open.append(("subscription", name))

    def heard(self, name: str, count: int) -> list[Any]:
        """Wait until so many messages came, and return all."""
        found = [json.loads(each) for each in self.do("heard", name, str(count), str(self.waits))]
        assert len(found) >= count, f"the robot heard {len(found)} messages on {name}, not {count}"
        return found

    def publishers(self, name: str, count: int) -> list[dict[str, Any]]:
        """Wait until a topic has so many publishers in the robot's graph, and return what is known of them."""
        found = [json.loads(each) for each in self.do("publishers", name, str(count))]
        assert len(found) == count, f"{name} has {len(found)} publishers in the robot's graph, not {count}"
        return found


def fresh_name(word: str = "topic") -> str:
    """A name nobody has used, also not in an earlier run."""
    return f"/conformance/{word}_{secrets.token_hex(3)}_{next(_names)}"
