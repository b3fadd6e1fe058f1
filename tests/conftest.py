"""Shared by all tests: programs are forked; slow files start first, so that all workers end together."""

from __future__ import annotations

import gc
import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from tests.durations import Durations, ProcessorSeconds, file_of
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
"""Seconds, processor seconds and path of each slow file, the slowest first."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--note-seconds", action="store_true", help="write tests/seconds.txt from this run")


def pytest_configure(config: pytest.Config) -> None:
    gc.disable()
    processor = ProcessorSeconds(config)
    config.pluginmanager.register(processor)
    if not hasattr(config, "workerinput"):
        noted = SECONDS if config.getoption("--note-seconds", False) else None
        config.pluginmanager.register(Durations(processor, noted))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    lines = [line.split() for line in SECONDS.read_text().splitlines()]
    noted = {path: float(seconds) for seconds, _, path in lines}
    items.sort(key=lambda item: -noted.get(file_of(item.nodeid), 0.0))


def pytest_collection_finish() -> None:
    """Collected tests stay until the end: repeated garbage collection of them would cost seconds."""
    gc.freeze()
    gc.enable()
