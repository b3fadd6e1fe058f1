"""Shared by all tests: programs are forked, slow files start first, and a test that never ends fails."""

from __future__ import annotations

import gc
import os
import re
from functools import cache
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from tests.durations import Durations, ProcessorSeconds, file_of
from tests.time_limit import SECONDS as TEST_SECONDS
from tests.time_limit import TimeLimit
from tests.worlds import processes

processes.forking = True

# The load of the machine that runs the tests raises no alert of a robot.
for _component in ("BATTERY", "CPU", "DISK", "MEMORY", "SIGNAL", "TEMPERATURE"):
    os.environ[f"SWITCHBOARD_ROBOT_OFFLOAD_CRITICAL_{_component}"] = "null"

# A busy machine fails no test: no example has a time limit. Each run has the same examples, so that only a
# change makes a test fail; `--hypothesis-profile=search` looks for new ones.
_UNTIMED = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("search", _UNTIMED, max_examples=3000)
settings.register_profile("same", _UNTIMED, derandomize=True, database=None)
settings.load_profile("same")

SECONDS = Path(__file__).with_name("seconds.txt")
"""Seconds, processor seconds and path of each slow file, the slowest first: a copy of ``build/seconds.txt``."""


def pytest_configure(config: pytest.Config) -> None:
    gc.disable()
    if config.getoption("--other-relay"):
        from tests.worlds.other_relay import install

        install()
    processor = ProcessorSeconds(config)
    config.pluginmanager.register(processor)
    config.pluginmanager.register(TimeLimit(TEST_SECONDS))
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(Durations(processor))


QUICK_FOLDERS = ("db", "protocol", "relay_server", "robot_client")
QUICK_SECONDS = 2.0
"""Most seconds of a file that ``make quick`` runs."""

REAL_PARTS = re.compile(
    r"\brclpy\b|\bsubprocess\b|worlds\.\w*(process|ros_|browser|postgresql|mosquitto|nats|dask)"
)
"""Test files with these use ROS, a browser or processes."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--quick", action="store_true", help="only files that need no ROS, browser or process")
    parser.addoption(
        "--other-relay", action="store_true", help="clients connect to another relay than robots"
    )


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """With ``--quick``, leave out slow files and those with real parts."""
    if not config.getoption("--quick") or not collection_path.is_file():
        return None
    path = collection_path.relative_to(config.rootpath)
    if path.parts[1] not in QUICK_FOLDERS or _noted().get(path.as_posix(), 0.0) > QUICK_SECONDS:
        return True
    return True if REAL_PARTS.search(collection_path.read_text()) else None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    noted = _noted()
    items.sort(key=lambda item: -noted.get(file_of(item.nodeid), 0.0))


@cache
def _noted() -> dict[str, float]:
    lines = [line.split() for line in SECONDS.read_text().splitlines()]
    return {path: float(seconds) for seconds, _, path in lines}


def pytest_collection_finish() -> None:
    """Collected tests stay until the end: repeated garbage collection of them would cost seconds."""
    gc.freeze()
    gc.enable()
