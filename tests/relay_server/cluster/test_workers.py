"""Workers: how connections are shared out, and when a worker is started again."""

from __future__ import annotations

import select
import socket
from contextlib import ExitStack
from pathlib import Path

import pytest
from twisted.internet.error import ProcessDone, ProcessTerminated
from twisted.internet.task import Clock
from twisted.python.failure import Failure

from relay_protocol.errors import Invalid
from relay_server.cluster import workers
from relay_server.cluster.workers import (
    LAST_RESTART_SECONDS,
    WorkerOutput,
    WorkerProcess,
    data_of,
    open_sockets,
)
from relay_server.config import ClusterSettings, ListenAddress, RelaySettings, WorkerSettings
from tests.worlds.waiting import PATIENCE


def test_connections_of_one_address_reach_one_worker() -> None:
    """Over many addresses, each worker gets some."""
    with ExitStack() as stack:
        sockets = [stack.enter_context(each) for each in open_sockets(ListenAddress("127.0.0.1", 0), 3)]
        reached = {}
        for address in [f"127.0.0.{number}" for number in range(1, 40)] * 2:
            with socket.create_connection(sockets[0].getsockname(), PATIENCE, (address, 0)):
                (ready,) = select.select(sockets, [], [], PATIENCE)[0]
                ready.accept()[0].close()
            assert reached.setdefault(address, ready) is ready
        assert set(reached.values()) == set(sockets)


def test_a_port_that_another_relay_shares_is_taken() -> None:
    with ExitStack() as stack:
        sockets = [stack.enter_context(each) for each in open_sockets(ListenAddress("127.0.0.1", 0), 2)]
        with pytest.raises(Invalid, match=r"cannot listen on 127\.0\.0\.1"):
            open_sockets(ListenAddress("127.0.0.1", sockets[0].getsockname()[1]), 2)


def test_the_pause_before_a_restart_grows() -> None:
    """It is short again for a worker that has run for some time."""
    clock = Clock()
    worker = WorkerProcess(2, clock, lambda worker: object())
    pauses = []
    for lasted in (0, 0, 1, 1, 1, 1, 100):
        worker.start()
        clock.advance(lasted)
        pauses.append(worker.ended())
    assert pauses == [1, 2, 4, 8, 16, LAST_RESTART_SECONDS, 1]
    assert worker.process is None


def test_output_is_passed_on_in_whole_lines() -> None:
    lines: list[bytes] = []
    output = WorkerOutput(lines.append, lambda code: None)
    for data in (b"a", b"b\nREADY", b" x\n", b"end"):
        output.outReceived(data)
    assert lines == [b"ab", b"READY x"]


@pytest.mark.parametrize(
    ("status", "code"),
    [(ProcessTerminated(exitCode=3), 3), (ProcessTerminated(signal=9), -9), (ProcessDone(0), 0)],
)
def test_an_exit_has_the_code_or_the_signal(status: Exception, code: int) -> None:
    codes: list[int] = []
    WorkerOutput(lambda line: None, codes.append).processExited(Failure(status))
    assert codes == [code]


def test_each_worker_has_a_folder() -> None:
    assert [data_of(number, Path("/data")) for number in (1, 2)] == [Path("/data"), Path("/data/workers/2")]


def test_a_worker_has_its_share(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A folder and a port of its own; together they record no more than one relay would."""
    monkeypatch.setattr(workers, "_end_with", lambda parent: None)
    worker = WorkerSettings(
        number=2, count=4, http=3, robots=4, group="g", name="fleet.example.org", parent=1
    )
    loopback = ListenAddress("127.0.0.1", 0)
    cluster = ClusterSettings(("nats://x",), ListenAddress("127.0.0.1", 9092), "127.0.0.1", "s")
    settings = RelaySettings(tmp_path, "postgresql://db/relay", loopback, loopback, cluster=cluster)
    mine = workers.settings_of(worker, settings)
    assert mine.data == tmp_path / "workers" / "2"
    assert mine.data.stat().st_mode & 0o777 == 0o700
    assert mine.name == "fleet.example.org"
    assert mine.recordings == settings.recordings // 4
    assert mine.cluster is not None
    assert (mine.cluster.listen.port, mine.cluster.group) == (9093, "g")
