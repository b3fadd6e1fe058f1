"""Cases: the operation and the sentence of the document that each checks, and their results."""

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

SPEC_ONLY = "a rule of this project's SPEC, not of rosbridge v2"
"""What a case that cites the SPEC alone, or first, says about a server that never promised it: nothing."""

FIXTURE_VERSION = 2
FIXTURE_PATIENCE = 20.0
"""Seconds a command of the fixture node waits, unless it is told to wait for less."""

_names = itertools.count(1)


def case(op: str, section: str, *, suite: str = "") -> pytest.MarkDecorator:
    """Makes a test function a case.

    :param op: operation it belongs to in the table
    :param section: document and section it checks
    :param suite: the known difference of rosbridge_suite 2.1, with its source; not needed for a section of
        SPEC
    """
    return getattr(pytest.mark, MARK)(op=op, section=section, suite=suite)


def known_difference(mark: pytest.Mark, target: str) -> str:
    """Why a case may fail on this target; empty if it may not."""
    if target != ROSBRIDGE_SUITE:
        return ""
    known: str = mark.kwargs["suite"]
    return known or (SPEC_ONLY if mark.kwargs["section"].startswith("SPEC ") else "")


def not_tried(why: str) -> None:
    """Ends a case that cannot be tried on this server."""
    pytest.skip(f"not tried: {why}")


def not_offered(why: str) -> None:
    """Ends a case about a feature that this robot lacks."""
    pytest.skip(f"not offered: {why}")


class Outcome(NamedTuple):
    """The result of one case."""

    op: str
    title: str
    section: str
    word: str
    remark: str


def outcome_of(item: pytest.Item, report: pytest.TestReport) -> Outcome | None:
    """The result in a report, if it has one."""
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
    """Prints every case by operation, and the sum."""
    reported = list(outcomes)
    places = {op: place for place, op in enumerate(dict.fromkeys(each.op for each in reported))}
    reported.sort(key=lambda each: places[each.op])
    view = Table(box=None, pad_edge=False, header_style="bold")
    for name, ratio in (("op", None), ("case", 5), ("section", 3), ("outcome", None), ("remark", 4)):
        view.add_column(name, ratio=ratio, overflow="fold", no_wrap=ratio is None)
    before = ""
    for each in reported:
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
    sums = Counter(each.word for each in reported)
    console.print("\n" + ", ".join(f"{sums[word]} {word}" for word in WORDS if sums[word]))


@dataclass
class Server:
    """The rosbridge server under test.

    :param url: its websocket
    :param token: an access token, empty if none is needed
    :param target: ``rosbridge_suite`` to count its known differences as such
    :param patience: timeout of an answer in seconds
    """

    url: str
    token: str = ""
    target: str = ""
    patience: float = PATIENCE
    about: dict[str, Any] = field(default_factory=dict)
    has_rosapi: bool = False
    """Whether rosapi answered at the start. Of rosbridge_suite it is a process of its own."""

    def connect(self, **options: Any) -> Client:
        """A client that is logged in."""
        return Client(self.url, self.token, self.patience, **options)

    @property
    def http_url(self) -> str:
        """The same address for HTTP."""
        return "http" + self.url.removeprefix("ws")

    @property
    def fixture_patience(self) -> float:
        """Timeout of the fixture node's commands in seconds: less than that of an answer."""
        return min(FIXTURE_PATIENCE, self.patience * 2 / 3)

    def look_for_fixture(self) -> str:
        """Finds the fixture node behind the server, and sets its timeout; otherwise returns what is missing."""
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
            self.has_rosapi = self._answers(client, "/rosapi/get_time")
        return ""

    def silent_part(self) -> str:
        """What does not serve a new client: the server, or rosapi if it did at the start; empty: both do."""
        try:
            with self.connect() as client:
                client.lives()
                return "rosapi" if self.has_rosapi and not self._answers(client, "/rosapi/get_time") else ""
        except (AssertionError, OSError, WebSocketException):
            return "the server"

    @staticmethod
    def _answers(client: Client, service: str) -> bool:
        try:
            client.values(service)
        except AssertionError:
            return False
        return True

    def needs_rosapi(self) -> None:
        """Ends the case if rosapi did not answer at the start."""
        if not self.has_rosapi:
            not_tried("rosapi did not answer at the start")

    def needs_examples(self) -> None:
        """Ends the case if the robot has no ``example_interfaces``."""
        if not self.about.get("example_interfaces"):
            not_tried("example_interfaces missing on the robot")

    def needs_token(self) -> None:
        """Ends the case if the server needs no token."""
        if not self.token:
            not_tried("no TOKEN was given")


class Hand:
    """The fixture node on the robot, controlled over a separate connection."""

    def __init__(self, server: Server) -> None:
        self._client = server.connect()
        self.waits = server.fixture_patience
        """Seconds the fixture node waits for what a command is about."""
        self._limit = self.waits + min(5.0, server.patience)
        self._open: list[tuple[str, str]] = []

    def close(self) -> None:
        """Removes its endpoints, and disconnects."""
        try:
            for kind, topic in self._open:
                self.do("end", kind, topic)
        finally:
            self._client.close()

    def ask(self, command: str, *words: str) -> str:
        """Sends a command; returns the id of its answer."""
        call_id = f"hand-{next(_names)}"
        args = {"prefixes": [command, *words], "depth": 0}
        self._client.send(
            "call_service", id=call_id, service="/conformance/do", args=args, timeout=self._limit
        )
        return call_id

    def answer(self, call_id: str, seconds: float | None = None) -> list[str]:
        """The result of a command.

        :param seconds: of a command that waits for more than one event
        """
        reported = self._client.until("service_response", seconds or self._limit, id=call_id)
        assert reported["result"] is True, f"/conformance/do failed: {reported.get('values')}"
        names: list[str] = reported["values"]["result"]["names"]
        assert names[:1] != ["error"], names
        return names

    def do(self, command: str, *words: str) -> list[str]:
        """Runs a command; see ``fixture_node.py`` for the commands."""
        return self.answer(self.ask(command, *words))

    def topic(self, name: str, type_name: str, profile: str = "reliable") -> None:
        """Makes a topic."""
        self.do("publisher", name, type_name, profile)
        self._open.append(("publisher", name))

    def publish(self, name: str, *messages: Any) -> None:
        """Publishes on it as soon as it has a subscriber."""
        count = self.do("publish", name, *(json.dumps(each) for each in messages))
        assert count != ["0"], f"the server did not subscribe to {name}"

    def vanish(self, name: str) -> None:
        """Removes a topic."""
        self._open.remove(("publisher", name))
        self.do("end", "publisher", name)

    def listen(self, name: str, type_name: str, profile: str = "reliable") -> None:
        """Records a topic."""
        self.do("listen", name, type_name, profile)
        self._open.append(("subscription", name))

    def heard(self, name: str, count: int) -> list[Any]:
        """Waits for this many messages; returns all."""
        found = [json.loads(each) for each in self.do("heard", name, str(count), str(self.waits))]
        assert len(found) >= count, f"the robot heard {len(found)} messages on {name}, not {count}"
        return found

    def publishers(self, name: str, count: int) -> list[dict[str, Any]]:
        """Waits until a topic has this many publishers in the robot's graph; returns their properties."""
        found = [json.loads(each) for each in self.do("publishers", name, str(count))]
        assert len(found) == count, f"{name} has {len(found)} publishers in the robot's graph, not {count}"
        return found


def fresh_name(word: str = "topic") -> str:
    """An unused name, also across runs."""
    return f"/conformance/{word}_{secrets.token_hex(3)}_{next(_names)}"
