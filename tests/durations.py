"""Seconds that each test file takes, and processor seconds of it and of all processes it starts."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import psutil
import pytest

NOTED = 1.0
"""Files that take at least so many seconds are written to :data:`WRITTEN`."""

WRITTEN = Path("build/seconds.txt")
"""Seconds, processor seconds and path of each slow file, the slowest first."""

SHOWN = 10


def file_of(nodeid: str) -> str:
    """The path of a test's file."""
    return nodeid.partition("::")[0]


class ProcessorSeconds:
    """Runs in each process that runs tests: processor seconds of each file, measured when the next one begins."""

    def __init__(self, config: pytest.Config) -> None:
        self.by_file: Counter[str] = Counter()
        self._config = config
        self._process = psutil.Process()
        self._used = 0.0

    def pytest_collection_finish(self) -> None:
        """Called before the first test."""
        self._used = self._total()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_teardown(self, item: pytest.Item, nextitem: pytest.Item | None) -> Any:
        """Called with each test; the last one of a file ends its fixtures."""
        done = yield
        if nextitem is None or file_of(nextitem.nodeid) != file_of(item.nodeid):
            total = self._total()
            self.by_file[file_of(item.nodeid)] += max(0.0, total - self._used)
            self._used = total
        return done

    @pytest.hookimpl(wrapper=True)
    def pytest_sessionfinish(self) -> Any:
        """Hand the figures to the process that prints them."""
        if (output := getattr(self._config, "workeroutput", None)) is not None:
            output["processor_seconds"] = dict(self.by_file)
        return (yield)

    def _total(self) -> float:
        """Of this process and all below it; what a process reaped counts with it."""
        total = 0.0
        for process in [self._process, *self._process.children(recursive=True)]:
            try:
                total += sum(process.cpu_times()[:4])
            except psutil.NoSuchProcess:
                continue
        return total


class Durations:
    """Runs in the process that prints: sums up files over all workers, and prints the slowest.

    :param own: processor seconds of tests that run in this process
    """

    def __init__(self, own: ProcessorSeconds) -> None:
        self._seconds: Counter[str] = Counter()
        self._processor: Counter[str] = own.by_file

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Called for each phase of each test."""
        self._seconds[file_of(report.nodeid)] += report.duration

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node: Any) -> None:
        """Called when a worker has ended."""
        self._processor.update(getattr(node, "workeroutput", {}).get("processor_seconds", {}))

    def pytest_terminal_summary(self, terminalreporter: Any) -> None:
        """Print the slowest files."""
        terminalreporter.section("slowest files")
        processor = sum(self._processor.values())
        terminalreporter.write_line(
            f"all {len(self._seconds)} files: {self._seconds.total():.0f} s, {processor:.0f} s of processor"
        )
        for path, seconds in self._seconds.most_common(SHOWN):
            terminalreporter.write_line(
                f"{seconds:5.0f} s  {self._processor[path]:5.0f} s of processor  {path}"
            )
        WRITTEN.parent.mkdir(exist_ok=True)
        WRITTEN.write_text(
            "".join(
                f"{seconds:.0f} {self._processor[path]:.0f} {path}\n"
                for path, seconds in self._seconds.most_common()
                if seconds >= NOTED
            )
        )
