"""Options, fixtures and the table of the conformance suite; see docs/reference/conformance.md."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import conformance_suite as suite
import pytest
from rosbridge_client import Client
from websockets.exceptions import WebSocketException

_outcomes = pytest.StashKey[list[suite.Outcome]]()
_watch = pytest.StashKey["Watch"]()
_failed = pytest.StashKey[bool]()

FOREIGN_PATIENCE = 6.0
"""Seconds for an answer of a server that was named. rosbridge_server gives up a call after 5 s."""

RESTART_SECONDS = 60.0
"""A server that was started again has so long to serve."""


class Watch:
    """Checks after each failure whether the server under test still serves, and restarts it otherwise.

    :param restart: shell command that restarts it, and returns; if empty, the remaining cases are not tried. With it
        each file of cases has a fresh server
    """

    def __init__(self, server: suite.Server, restart: str) -> None:
        self._server = server
        self._restart = restart
        self._suspect = ""
        self._file: Path | None = None
        self.dead = ""
        """What does not serve any more, and since which case."""

    def begin(self, file: Path) -> None:
        """A case of a file is next."""
        before, self._file = self._file, file
        if self._restart and before not in (None, file):
            self._start_again(f"the start for {file.name}")

    def suspect(self, case: str) -> None:
        """A case has failed."""
        self._suspect = case

    def look(self) -> None:
        """Checks the server, if a case has failed since."""
        case, self._suspect = self._suspect, ""
        if not case or not (silent := self._server.silent_part()):
            return
        if self._restart:
            self._start_again(case)
        else:
            self.dead = f"{silent} has not answered any more since {case}"

    def _start_again(self, since: str) -> None:
        subprocess.run(self._restart, shell=True, check=False, timeout=RESTART_SECONDS)
        until = time.monotonic() + RESTART_SECONDS
        while silent := self._server.silent_part():
            if time.monotonic() > until:
                self.dead = f"{silent} has not answered any more since {since}"
                return
            time.sleep(0.5)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Options for the server, the target and the robot."""
    group = parser.getgroup("conformance")
    group.addoption("--url", default="", help="websocket of the rosbridge server to check; without: our own")
    token = os.environ.get("CONFORMANCE_TOKEN", "")
    group.addoption("--token", default=token, help="access token for it; better CONFORMANCE_TOKEN")
    group.addoption("--target", default="", help="rosbridge_suite: count its known differences as such")
    group.addoption("--table", action="store_true", help="print the table of cases")
    group.addoption("--listen", default="", help="HOST:PORT for a robot to dial; without: our own robots")
    group.addoption("--robot-name", default="robot-under-test", help="the name it has to dial with")
    group.addoption("--answers-within", type=float, help="seconds for an answer; 6 with --url, else 30")
    group.addoption("--restart", default="", help="shell command that starts the server again when it hangs")
    group.addoption("--patience", type=float, default=300.0, help="seconds to wait for it to dial")


def pytest_configure(config: pytest.Config) -> None:
    """The mark of a case."""
    config.addinivalue_line("markers", f"{suite.MARK}(op, section, suite): a case of the conformance suite")
    config.stash.setdefault(_outcomes, [])


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Generator[None, Any, None]:
    """Counts known differences as such, and stores the result of each case."""
    report = (yield).get_result()
    mark = item.get_closest_marker(suite.MARK)
    if mark is not None and report.failed:
        watch = item.config.stash.get(_watch, None)
        if watch is not None:
            watch.suspect(item.name)
        known = suite.known_difference(mark, item.config.getoption("--target", ""))
        if report.when == "teardown" and item.stash.get(_failed, False):
            report.outcome = "passed"  # a failed cleanup after a failure is not another one
        elif known:
            report.outcome = "skipped"
            report.wasxfail = known
        item.stash[_failed] = True
    outcome = suite.outcome_of(item, report)
    if outcome is not None:
        item.config.stash[_outcomes].append(outcome)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Continues only with a server that serves."""
    watch = item.config.stash.get(_watch, None)
    if watch is not None:
        watch.look()
        watch.begin(item.path)
        if watch.dead:
            suite.not_tried(watch.dead)


def pytest_terminal_summary(config: pytest.Config) -> None:
    """Prints the table."""
    asked = any(config.getoption(name, "") for name in ("--url", "--table", "--listen"))
    if asked and config.stash[_outcomes]:
        suite.table(config.stash[_outcomes])


@pytest.fixture(scope="session")
def server(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[suite.Server]:
    """The server to check, with the fixture node behind it; our own one without ``--url``."""
    option = request.config.getoption
    url = option("--url", "")
    if url:
        patience = option("--answers-within", None) or FOREIGN_PATIENCE
        found = suite.Server(url.rstrip("/"), option("--token", ""), option("--target", ""), patience)
        try:
            missing = found.look_for_fixture()
        except (AssertionError, OSError, WebSocketException) as error:
            pytest.exit(f"{url} can't be reached: {error}", returncode=2)
        if missing:
            pytest.exit(missing, returncode=2)
        request.config.stash[_watch] = Watch(found, option("--restart", ""))
        yield found
    else:
        from our_server import OurServer

        ours = OurServer(tmp_path_factory.mktemp("conformance"))
        try:
            missing = ours.server.look_for_fixture()
            assert not missing, missing
            yield ours.server
        finally:
            ours.stop()


@pytest.fixture
def client(server: suite.Server, request: pytest.FixtureRequest) -> Iterator[Client]:
    """A new client for each case."""
    mark = request.node.get_closest_marker(suite.MARK)
    if mark is not None and mark.kwargs["op"].startswith("rosapi"):
        server.needs_rosapi()
    with server.connect() as connected:
        yield connected


@pytest.fixture
def reported(server: suite.Server) -> Iterator[Client]:
    """A client that receives all errors."""
    with server.connect() as connected:
        connected.send("set_level", level="error")
        yield connected


@pytest.fixture
def hand(server: suite.Server) -> Iterator[suite.Hand]:
    """The robot's side of a case."""
    made = suite.Hand(server)
    try:
        yield made
    finally:
        made.close()


@pytest.fixture
def topic() -> str:
    """An unused topic."""
    return suite.fresh_name()
