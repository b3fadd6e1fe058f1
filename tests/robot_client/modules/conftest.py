"""A daemon that has modules and nothing else."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from robot_client.modules import processes
from tests.worlds.module_daemon_process import Daemon, runners


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Daemon]]:
    started: list[Daemon] = []

    def begin(*modules: dict[str, Any], **options: Any) -> Daemon:
        started.append(Daemon(tmp_path, *modules, **options))
        return started[-1]

    yield begin
    for each in started:
        if each.process.poll() is None:
            each.kill()
        processes.send(runners(each.folder) + each.pids(), signal.SIGKILL)
