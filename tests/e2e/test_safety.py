"""After any failure during a drive, the robot stands within 0.5 s, by its own log.

The simulator keeps its last command forever, as many bases do: the daemon's watchdog or its guard stops it.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator

import psutil
import pytest

from tests.worlds.client_threads import Driver, Returning
from tests.worlds.driving import LET_GO_SECONDS, Drive
from tests.worlds.sync_client import Client
from tests.worlds.waiting import wait_for


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Drive]:
    """One drive for all faults: each test leaves it intact."""
    drive = Drive(tmp_path_factory.mktemp("drive"))
    try:
        yield drive
    finally:
        drive.stop()


@pytest.mark.parametrize("fault", ["client vanishes", "client link black hole", "client link reset"])
def test_the_robot_stands_when_its_driver_is_lost(drive: Drive, fault: str) -> None:
    """A client that disconnects, with or without a close, leaves the robot standing."""
    driver = drive.start_driving()
    act: dict[str, Callable[[], None]] = {
        "client vanishes": driver.stop,
        "client link black hole": drive.client_side.black_hole,
        "client link reset": drive.client_side.reset,
    }
    since = time.monotonic_ns()
    act[fault]()
    drive.stands_within_limit(since)
    driver.stop()
    drive.client_side.heal()
    drive.again()


@pytest.mark.parametrize("fault", ["robot link black hole", "robot link reset", "relay to robot only"])
def test_the_robot_stands_when_its_link_is_lost(drive: Drive, fault: str) -> None:
    """A robot without input stands, even if it has not noticed the dead link."""
    driver = drive.start_driving()
    act: dict[str, Callable[[], None]] = {
        "robot link black hole": drive.robot_side.black_hole,
        "robot link reset": drive.robot_side.reset,
        "relay to robot only": drive.robot_side.forward_down.clear,
    }
    since = time.monotonic_ns()
    act[fault]()
    drive.stands_within_limit(since)
    driver.stop()
    drive.robot_side.heal()
    drive.again()


def moves_only_after_release(drive: Drive, driver: Driver, since: int) -> None:
    """Continued commands across a fault move nothing for any time; a pause of 0.5 s is a release."""
    drive.robot.wait_online()
    # For 6 s: within 5 s the robot takes a new command for a continuation of earlier ones.
    enough = driver.sent + 60
    wait_for("it has been commanded on and on", lambda: driver.sent >= enough)
    assert [each for each in drive.robot.events("command", since) if each["v"] or each["w"]] == []
    assert drive.robot.events("moving", since) == []
    driver.let_go(LET_GO_SECONDS)
    wait_for("the robot moves for who has let go", lambda: drive.robot.events("moving", since))
    driver.stop()
    drive.stands()


def test_commanding_across_a_lost_robot_link_requires_a_release(drive: Drive) -> None:
    """The driver's connection stays open; when the robot is back, control is taken again."""
    driver = drive.start_driving()
    broken = time.monotonic_ns()
    drive.robot_side.black_hole()
    drive.stands_within_limit(broken)
    wait_for("its link is lost", lambda: drive.relay.state_of("rover") == "offline")
    healed = time.monotonic_ns()
    drive.robot_side.heal()
    moves_only_after_release(drive, driver, healed)
    assert driver.broken is None
    drive.again()


@pytest.mark.parametrize("away", [0.0, 1.5])
def test_commanding_across_a_lost_connection_requires_a_release(drive: Drive, away: float) -> None:
    """Even after an absence longer than the required pause: without a connection there is no release."""
    lost = 0

    def connect() -> Client:
        if lost:
            time.sleep(away)  # a library's delay before it reconnects
        return drive.relay.connect_by(drive.client_side.port, "rover", drive.token)

    driver = Returning(connect)
    drive.start_driving(driver)
    lost = time.monotonic_ns()
    drive.client_side.reset()
    drive.stands_within_limit(lost)
    stood = time.monotonic_ns()
    drive.client_side.heal()
    wait_for("the driver is back", lambda: driver.connections > 1)
    moves_only_after_release(drive, driver, stood)
    drive.again()


@pytest.mark.parametrize("who_is_first", ["driver", "robot"])
def test_commanding_across_a_relay_restart_requires_a_release(drive: Drive, who_is_first: str) -> None:
    """By a new connection, before or after the robot's: commands without a receiver are no release."""
    killed = 0

    def connect() -> Client:
        if killed and who_is_first == "robot":
            drive.robot.wait_online()
        return drive.relay.connect_by(drive.client_side.port, "rover", drive.token)

    driver = Returning(connect)
    drive.start_driving(driver)
    killed = time.monotonic_ns()
    drive.relay.kill()
    drive.stands_within_limit(killed)
    stood = time.monotonic_ns()
    if who_is_first == "driver":
        drive.robot_side.black_hole()
    drive.relay.start()
    wait_for("the driver is back", lambda: driver.connections > 1)
    enough = driver.sent + 3
    wait_for("he commands", lambda: driver.sent >= enough)
    if who_is_first == "driver":
        drive.robot_side.heal()
    moves_only_after_release(drive, driver, stood)
    drive.again()


def test_no_command_from_before_a_partition_is_executed_after_it(drive: Drive) -> None:
    """Commands that a network delayed for two seconds arrive and are dropped."""
    driver = drive.start_driving()
    drive.robot_side.forward_down.clear()
    time.sleep(1.5)  # commands pile up on their way to the robot
    driver.stop()
    time.sleep(0.6)  # the last of them exceeds its deadline
    healed = time.monotonic_ns()
    drive.robot_side.heal()
    with drive.relay.connect("rover", drive.token) as client:
        # The answer arrives after all delayed messages.
        wait_for("the robot answers", lambda: client.call("/relay/ping", {"robot": True})["result"])
    late = [each for each in drive.robot.events("command", healed) if each["v"] or each["w"]]
    assert late == []
    assert not drive.robot.moving()
    drive.again()


def test_the_robot_stands_when_the_relay_freezes_and_nothing_old_is_executed_when_it_wakes(
    drive: Drive,
) -> None:
    """Commands that waited in a frozen relay's sockets have exceeded their deadline, and the relay notices."""
    driver = drive.start_driving()
    since = time.monotonic_ns()
    drive.relay.freeze()
    try:
        drive.stands_within_limit(since)
        time.sleep(1.0)  # the client goes on sending into the frozen relay's socket
        driver.stop()
        time.sleep(0.6)  # the last command exceeds its deadline
    finally:
        woken = time.monotonic_ns()
        drive.relay.thaw()
    drive.robot.wait_online()
    with drive.relay.connect("rover", drive.token) as client:
        wait_for("the robot answers", lambda: client.call("/relay/ping", {"robot": True})["result"])
    late = [each for each in drive.robot.events("command", woken) if each["v"] or each["w"]]
    assert late == []
    drive.again()


def test_the_robot_stands_when_the_relay_is_killed_and_all_is_back_after_its_restart(drive: Drive) -> None:
    """After kill -9 of the relay the robot stands; a new relay on the same data gets the robot back."""
    driver = drive.start_driving()
    since = time.monotonic_ns()
    drive.relay.kill()
    drive.stands_within_limit(since)
    driver.stop()
    drive.relay.start()
    drive.again()


def test_the_robot_stands_when_its_daemon_is_killed(drive: Drive) -> None:
    """After kill -9 of the daemon its guard stops the robot."""
    driver = drive.start_driving()
    since = time.monotonic_ns()
    drive.robot.daemon.kill()
    drive.stands_within_limit(since)
    driver.stop()
    drive.robot.start_daemon()
    drive.again()


def test_the_robot_stands_when_its_daemon_freezes(drive: Drive) -> None:
    """The guard stops the robot of a frozen daemon with open links; the daemon recovers when it continues."""
    driver = drive.start_driving()
    since = time.monotonic_ns()
    drive.robot.daemon.freeze()
    try:
        drive.stands_within_limit(since)
        driver.stop()
        time.sleep(0.6)  # the last command exceeds its deadline
    finally:
        woken = time.monotonic_ns()
        drive.robot.daemon.signal(signal.SIGCONT)
    drive.robot.wait_online()
    with drive.relay.connect("rover", drive.token) as client:
        wait_for("the robot answers", lambda: client.call("/relay/ping", {"robot": True})["result"])
    late = [each for each in drive.robot.events("command", woken) if each["v"] or each["w"]]
    assert late == []
    drive.again()


def test_frozen_daemons_memory_is_not_waited_for(drive: Drive) -> None:
    """Daemon and guard use no shared memory with other nodes: a process frozen with a lock would block the
    base.
    """
    daemon = psutil.Process(drive.robot.daemon.popen.pid)
    guards = [each for each in daemon.children() if "robot_client.motion.guard" in each.cmdline()]
    assert guards
    for process in (daemon, *guards):
        mapped = [each.path for each in process.memory_maps() if "/dev/shm/fast" in each.path]
        assert mapped == []
