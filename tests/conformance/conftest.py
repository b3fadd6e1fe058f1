"""Options, fixtures and the table of the conformance suite; see docs/conformance.md."""

from __future__ import annotations

import json
import os
from collections.abc import Generator, Iterator
from typing import Any

import conformance_suite as suite
import pytest
from rosbridge_client import Client
from websockets.exceptions import WebSocketException

_outcomes = pytest.StashKey[list[suite.Outcome]]()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Where and what is checked."""
    group = parser.getgroup("conformance")
    group.addoption("--url", default="", help="websocket of the rosbridge server to check; without: our own")
    token = os.environ.get("CONFORMANCE_TOKEN", "")
    group.addoption("--token", default=token, help="access token for it; better CONFORMANCE_TOKEN")
    group.addoption("--target", default="", help="rosbridge_suite: count its known differences as such")
    group.addoption("--table", action="store_true", help="print the table of cases")
    group.addoption("--listen", default="", help="HOST:PORT for a robot to dial; without: our own robots")
    group.addoption("--robot-name", default="robot-under-test", help="the name it has to dial with")
    group.addoption("--patience", type=float, default=300.0, help="seconds to wait for it to dial")


def pytest_configure(config: pytest.Config) -> None:
    """The mark of a case."""
    config.addinivalue_line("markers", f"{suite.MARK}(op, section, suite): a case of the conformance suite")
    config.stash.setdefault(_outcomes, [])


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Generator[None, Any, None]:
    """Count known differences as such, and note what became of each case."""
    report = (yield).get_result()
    mark = item.get_closest_marker(suite.MARK)
    if mark is not None and report.failed and report.when == "call":
        known = mark.kwargs["suite"]
        if known and item.config.getoption("--target", "") == suite.ROSBRIDGE_SUITE:
            report.outcome = "skipped"
            report.wasxfail = known
    outcome = suite.outcome_of(item, report)
    if outcome is not None:
        item.config.stash[_outcomes].append(outcome)


def pytest_terminal_summary(config: pytest.Config) -> None:
    """The table."""
    asked = any(config.getoption(name, "") for name in ("--url", "--table", "--listen"))
    if asked and config.stash[_outcomes]:
        suite.table(config.stash[_outcomes])


@pytest.fixture(scope="session")
def server(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[suite.Server]:
    """The server to check, with the fixture node behind it; our own one without ``--url``."""
    url = request.config.getoption("--url", "")
    if url:
        target = request.config.getoption("--target", "")
        found = suite.Server(url.rstrip("/"), request.config.getoption("--token", ""), target)
        try:
            _look_for_fixture(found)
        except (OSError, WebSocketException) as error:
            pytest.exit(f"{url} can't be reached: {error}", returncode=2)
        yield found
    else:
        from our_server import OurServer

        ours = OurServer(tmp_path_factory.mktemp("conformance"))
        try:
            _look_for_fixture(ours.server)
            yield ours.server
        finally:
            ours.stop()


def _look_for_fixture(server: suite.Server) -> None:
    with server.connect() as client:
        client.send("subscribe", topic="/conformance/about", type="std_msgs/msg/String")
        try:
            about = client.until("publish", 15, topic="/conformance/about")["msg"]["data"]
        except AssertionError:
            pytest.exit(
                "the fixture node is not to be seen: start tests/conformance/fixture_node.py on the robot "
                "(same ROS_DOMAIN_ID as the server)",
                returncode=2,
            )
    server.about = json.loads(about)


@pytest.fixture
def client(server: suite.Server) -> Iterator[Client]:
    """A client of its own for each case."""
    with server.connect() as connected:
        yield connected


@pytest.fixture
def told(server: suite.Server) -> Iterator[Client]:
    """A client that wants to hear of every error."""
    with server.connect() as connected:
        connected.send("set_level", level="error")
        yield connected


@pytest.fixture
def hand(server: suite.Server) -> Iterator[suite.Hand]:
    """What the robot's side does for a case."""
    made = suite.Hand(server)
    try:
        yield made
    finally:
        made.close()


@pytest.fixture
def topic() -> str:
    """A topic nobody has used."""
    return suite.fresh_name()
