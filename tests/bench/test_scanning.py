"""The program's own parts read scans through a recorder of their time."""

from __future__ import annotations

from typing import Any

from bench.scanning import SCAN, Kept, program
from robot_client.apps.collision_avoidance import ScanReading
from tests.worlds.memory_socket import Socket


def scan(sec: int, nanosec: int, distance: float) -> dict[str, Any]:
    """A message with one ray, in metres."""
    header = {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": "laser"}
    rays = {"ranges": [distance], "angle_min": 0.0, "angle_increment": 0.1}
    return {"op": "publish", "topic": SCAN, "msg": {"header": header, **rays}}


def test_the_stamp_is_of_the_scan_that_was_read_last() -> None:
    """In nanoseconds, also while another waits; the program's messages are passed on to the relay."""
    socket = Socket()
    kept = Kept(socket)
    link, _ = program(kept)
    assert {"op": "subscribe", "topic": SCAN}.items() <= socket.sent[-1].items()
    socket.coming += [scan(1_800_000_000, 123_456_789, 1.0), scan(1_800_000_001, 1, 2.0)]
    assert link.scan(1.0) == ScanReading([1.0], 0.0, 0.1)
    assert kept.stamp() == 1_800_000_000_123_456_789
    assert link.scan(1.0) == ScanReading([2.0], 0.0, 0.1)
    assert kept.stamp() == 1_800_000_001_000_000_001


def test_a_stamp_is_kept_while_nothing_comes() -> None:
    """A missing scan is None, and changes nothing."""
    socket = Socket()
    kept = Kept(socket)
    link, _ = program(kept)
    socket.coming.append(scan(5, 6, 1.0))
    link.scan(1.0)
    assert link.scan(0.01) is None
    assert kept.stamp() == 5_000_000_006
