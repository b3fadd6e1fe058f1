"""Malformed messages of workers and device managers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from relay_server.offload.pebble_engine import _ProgressPort
from relay_server.offload.runner import decode_outcome
from robot_client.offload.device import STATE_FILE, Device


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
