"""A ROS 2 robot keeps its stop when its daemon or the relay fail."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.worlds.client_threads import Driver
from tests.worlds.driving import Drive
from tests.worlds.waiting import wait_for


@pytest.fixture
def drive(tmp_path: Path) -> Iterator[Drive]:
    """A robot that can be driven."""
    drive = Drive(tmp_path)
    try:
        yield drive
    finally:
        drive.stop()


def test_stop_outlives_a_killed_daemon_and_a_killed_relay(drive: Drive) -> None:
    """kill -9 of the daemon, then of the relay too: continued commands move nothing until the robot is
    resumed.
    """
    driver = drive.start_driving()
    stopped = drive.relay.cli("stop", "rover", "--why", "a child on the floor")
    assert stopped is not None
    drive.stands()
    driver.stop()
    drive.robot.daemon.kill()
    drive.relay.kill()
    since = time.monotonic_ns()
    drive.robot.start_daemon()
    drive.relay.start()
    drive.robot.wait_online()
    another = Driver(drive.relay.connect_by(drive.client_side.port, "rover", drive.token))
    another.start()
    try:
        time.sleep(3)  # guard and channel are ready within that time
        assert [each for each in drive.robot.events("command", since) if each["v"] or each["w"]] == []
        drive.relay.cli("resume", "rover")
        time.sleep(1)  # the commands go on without a pause
        assert [each for each in drive.robot.events("command", since) if each["v"] or each["w"]] == []
    finally:
        another.stop()
    wait_for("he has let go", lambda: not another.is_alive())
    drive.again()
