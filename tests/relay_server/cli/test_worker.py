"""Valid options of ``switchboard worker``."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from typing import Any

import pytest

from relay_server.offload import dask_worker
from relay_server.offload.dask_worker import WorkerOptions


@pytest.fixture
def served(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[WorkerOptions]]:
    """Options of the workers that were started."""
    found: list[WorkerOptions] = []

    async def serve(options: WorkerOptions, say: Any) -> None:
        found.append(options)

    monkeypatch.setattr(dask_worker, "serve_worker", serve)
    # The command's asyncio loop takes the file descriptor that notifies Twisted of ended processes.
    twisteds = signal.set_wakeup_fd(-1)
    yield found
    signal.set_wakeup_fd(twisteds, warn_on_full_buffer=False)


def test_a_worker_has_labels_and_limits(cli: Any, served: list[WorkerOptions]) -> None:
    options = (
        "--name",
        "one",
        "--processes",
        "4",
        "--memory-mib",
        "512",
        "--label",
        "GPU=2",
        "--label",
        "arm",
    )
    cli.ok("worker", "tcp://127.0.0.1:8786", *options)
    assert served == [
        WorkerOptions(
            scheduler="tcp://127.0.0.1:8786",
            name="one",
            processes=4,
            labels={"GPU": 2.0, "arm": 1.0},
            memory_mib=512,
        )
    ]


@pytest.mark.parametrize("label", ["GPU=", "GPU=0", "GPU=-1", "GPU=many", "GPU=inf", "GPU=nan", "=1"])
def test_a_label_is_a_name_and_a_number(cli: Any, served: list[WorkerOptions], label: str) -> None:
    assert "is no label" in cli.fails("worker", "tcp://127.0.0.1:8786", "--label", label)
    assert served == []


def test_a_scheduler_over_a_network_needs_certificates(cli: Any, served: list[WorkerOptions]) -> None:
    assert "use tls://" in cli.fails("worker", "tcp://10.0.0.5:8786")
    assert "three PEM files" in cli.fails("worker", "tls://10.0.0.5:8786")
    assert served == []
