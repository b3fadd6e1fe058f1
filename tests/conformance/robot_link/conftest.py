"""The robot under test: one that connects with ``--listen``, otherwise the project's own ones."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest
from link_relay import ENROLMENT_CODE, PATIENCE, PATIENCE_TO_DIAL, Link, LinkRelay
from robot_tasks import Wheels
from robots_under_test import ROBOTS

from tests.worlds.machine_pauses import Pulse

GRAPH_SECONDS = 5.0
"""For the graph of a robot that may have nothing to drive."""


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Every case for every robot."""
    if "relay" in metafunc.fixturenames:
        case = metafunc.function.__name__
        ours = [name for name, each in ROBOTS.items() if case not in each.lacks]
        robots = ["dialled"] if metafunc.config.getoption("--listen", "") else ours
        metafunc.parametrize("relay", robots, indirect=True, scope="session")


@pytest.fixture
def channel(relay: LinkRelay) -> Iterator[Link]:
    """A new channel link for each case."""
    with relay.channel() as link:
        yield link


@pytest.fixture
def drive(relay: LinkRelay) -> Iterator[Wheels]:
    """A robot that can be driven."""
    with relay.channel() as watching, relay.channel() as driving, Pulse() as pulse:
        yield Wheels(relay, driving, watching, held_up=pulse.held_up)


@pytest.fixture(scope="session")
def relay(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[LinkRelay]:
    """A relay of the suite with the robot enrolled and registered."""
    listen = request.config.getoption("--listen", "")
    if listen:
        yield from _dialled(request.config, listen)
        return
    made = LinkRelay("robot-under-test")
    robot = ROBOTS[request.param](tmp_path_factory.mktemp(request.param), made.robot, made.port)
    try:
        made.enrol(PATIENCE_TO_DIAL)
        robot.run()
        if robot.graph_grows:
            _wait_for_graph(made, PATIENCE)
        yield made
    finally:
        robot.stop()
        made.close()


def _dialled(config: pytest.Config, listen: str) -> Iterator[LinkRelay]:
    host, _, port = listen.rpartition(":")
    made = LinkRelay(config.getoption("--robot-name"), host or "0.0.0.0", int(port))
    patience = config.getoption("--patience")
    capture = config.pluginmanager.getplugin("capturemanager")
    with capture.global_and_fixture_disabled():
        print(
            f"\nEnrol and start your robot now: relay {made.host}:{made.port} (plain TCP), robot {made.robot}, "
            f"enrolment code {ENROLMENT_CODE}. Waiting {patience:g} s for it to dial …",
            flush=True,
        )
    try:
        made.enrol(patience)
        made.register(patience)
        _wait_for_graph(made, GRAPH_SECONDS)
        yield made
    finally:
        made.close()


def _wait_for_graph(made: LinkRelay, seconds: float) -> None:
    """A daemon may know little of its graph at first."""
    assert made.control
    made.facts()
    until = time.monotonic() + seconds
    while time.monotonic() < until and not any(name.endswith("/heard") for name in made.graph["topics"]):
        time.sleep(0.02)
