"""Malformed messages of workers and device managers."""

from __future__ import annotations

import os
import shutil
import signal
import sys
from pathlib import Path
from typing import Any

import pytest

from relay_server.offload.call_processes import CallProcesses
from relay_server.offload.pebble_engine import _ProgressPort
from relay_server.offload.runner import decode_outcome
from robot_client.offload.device import STATE_FILE, Device
from tests.worlds import offload_functions
from tests.worlds.processes import Process, running
from tests.worlds.waiting import wait_for


@pytest.mark.parametrize(
    "body", [b"", b"\xc1", b"\x81\xa4code\xa2\xff\xfe", b"\x81\xa1x" + b"\x91" * 100_000, None]
)
def test_a_worker_that_sends_no_outcome_counts_as_crashed(body: Any) -> None:
    assert decode_outcome(body).code == "crashed"


def test_progress_that_can_not_be_read_is_left_out() -> None:
    reports: list[Any] = []
    port = _ProgressPort(reports.append)
    for datagram in (b"\x93\x01\xcb" + bytes(8) + b"\xa2\xff\xfe", b"\xc1"):
        port.datagramReceived(datagram, None)
    port.datagramReceived(b"\x93\x01\xcb" + bytes(8) + b"\xa2ok", None)
    assert [each.text for each in reports] == ["ok"]


@pytest.mark.parametrize("state", [b'{"at":1e18,"critical":{"\xff":true}}', b"", b"[" * 100_000])
def test_a_state_that_can_not_be_read_is_none(tmp_path: Path, state: bytes) -> None:
    (tmp_path / STATE_FILE).write_bytes(state)
    assert Device(tmp_path).state() is None


OWNER = """
import sys, time
from pathlib import Path
from relay_protocol.functions import encode_value
from relay_server.offload.call_processes import CallProcesses
from relay_server.offload.runner import WorkerCall

if __name__ == "__main__":
    processes = CallProcesses(1, Path(sys.argv[1]))
    print(processes.progress_socket, flush=True)
    arguments = encode_value({"number": sys.argv[2], "forever": True})
    processes.run(WorkerCall(number=1, name="leave_child", version=1, arguments=arguments, memory_mib=256,
                             max_result=100), 600)
    time.sleep(600)
"""


def test_what_is_left_of_a_killed_owner_is_ended_by_the_next(tmp_path: Path) -> None:
    """Its processes end with it, but not what functions have started. That of a living owner stays."""
    functions, script = tmp_path / "functions", tmp_path / "owner.py"
    functions.mkdir()
    shutil.copy(offload_functions.__file__, functions)
    script.write_text(OWNER)
    children, owners = [], []
    for name in ("killed", "living"):
        command = [sys.executable, str(script), str(functions), str(tmp_path / name)]
        owners.append(Process(command, tmp_path, name, dict(os.environ)))
    with running(*owners):
        for name in ("killed", "living"):
            wait_for("a child is started", (tmp_path / name).exists)
            children.append(Path("/proc") / (tmp_path / name).read_text().strip())
        folder = Path(owners[0].said().strip()).parent
        owners[0].kill()
        assert [each.exists() for each in children] == [True, True]
        CallProcesses(1).stop()
        wait_for("it is ended", lambda: not children[0].exists())
        assert children[1].exists()
        assert not folder.exists()
        os.kill(int(children[1].name), signal.SIGKILL)
