"""Shared by all tests: programs are forked; slow files start first, so that all workers end together."""

from __future__ import annotations

import gc
import os
from collections import defaultdict
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

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
"""Seconds and path of each file that takes at least :data:`NOTED` seconds, the longest first."""

NOTED = 5.0


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--note-seconds", action="store_true", help="write tests/seconds.txt from this run")


def pytest_configure(config: pytest.Config) -> None:
    gc.disable()
    if config.getoption("--note-seconds", False) and not hasattr(config, "workerinput"):
        config.pluginmanager.register(_Durations())


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    noted = {path: float(seconds) for seconds, path in map(str.split, SECONDS.read_text().splitlines())}
    items.sort(key=lambda item: -noted.get(_file(item.nodeid), 0.0))


def pytest_collection_finish() -> None:
    """Collected tests stay until the end: repeated garbage collection of them would cost seconds."""
    gc.freeze()
    gc.enable()


def _file(nodeid: str) -> str:
    return nodeid.partition("::")[0]


class _Durations:
    """Sums up the duration of each file, over all workers."""

    def __init__(self) -> None:
        self._of: defaultdict[str, float] = defaultdict(float)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self._of[_file(report.nodeid)] += report.duration

    def pytest_sessionfinish(self) -> None:
        longest = sorted(self._of.items(), key=lambda item: -item[1])
        lines = [f"{seconds:.0f} {path}\n" for path, seconds in longest if seconds >= NOTED]
        SECONDS.write_text("".join(lines))
