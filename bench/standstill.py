"""How long a robot moves on after something has broken, by its own record, in milliseconds.

A real relay, daemon and simulated robot, driven in circles through proxies that can be broken. Each command says when
it was sent, so the record tells as well whether any was carried out too late. After each fault everything heals, and
what was held up arrives: the robot must not move by it. A client that was frozen goes on commanding when it is thawed,
and may; what it said before must not be carried out any more. A tab that was away for more than half a second finds its
key still held: that moves nothing until it is pressed anew. A program whose connection broke connects anew and goes on
commanding, as libraries do: that moves nothing before it lets go.
"""

from __future__ import annotations

import contextlib
import signal
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.driving import DriverProcess, TimedDriver, ages_ms, connected, sent_before
from bench.report import Options, Row, Unavailable
from bench.tab import FAULTS as tab_faults
from bench.tab import Tab, struck
from tests.worlds.driving import LIMIT_MS, SIM_STEP_MS, Drive

HELD_BACK = 0.6
"""Seconds until what is held up by a fault is older than any command may be."""

COMES_BACK = 1.5
"""Seconds for which a driver commands who has come back."""

Strike = Callable[[Drive, Any], None]
Heal = Callable[[Drive], None]


def _nothing(drive: Drive) -> None:
    """Heals by itself."""


def _client_heals(drive: Drive) -> None:
    drive.client_side.heal()


def _robot_heals(drive: Drive) -> None:
    drive.robot_side.heal()


@dataclass(frozen=True)
class Fault:
    """Something that breaks.

    :param strike: breaks it; takes the drive and the driver
    :param heal: mends it
    :param process: whether the driver must be a process of its own
    :param goes_on: whether the driver may rightly go on when it is mended
    :param parts: whether robot and relay part by it, after which who drove lets go first
    :param returns: whether the driver comes back by another connection, and commands at once
    """

    name: str
    strike: Strike
    heal: Heal = _nothing
    process: bool = False
    goes_on: bool = False
    parts: bool = False
    returns: bool = False


FAULTS = (
    Fault("client goes silent", lambda drive, driver: driver.fall_silent()),
    Fault("client killed (SIGKILL)", lambda drive, driver: driver.popen.kill(), process=True, returns=True),
    Fault(
        "client frozen (SIGSTOP)",
        lambda drive, driver: driver.popen.send_signal(signal.SIGSTOP),
        process=True,
        goes_on=True,
    ),
    Fault("client link: black hole", lambda drive, driver: drive.client_side.black_hole(), _client_heals),
    Fault(
        "client link: client to relay only",
        lambda drive, driver: drive.client_side.forward_up.clear(),
        _client_heals,
    ),
    Fault(
        "client link: relay to client only",
        lambda drive, driver: drive.client_side.forward_down.clear(),
        _client_heals,
    ),
    Fault("client link: reset", lambda drive, driver: drive.client_side.reset(), returns=True),
    Fault(
        "robot link: black hole",
        lambda drive, driver: drive.robot_side.black_hole(),
        _robot_heals,
        parts=True,
    ),
    Fault(
        "robot link: relay to robot only",
        lambda drive, driver: drive.robot_side.forward_down.clear(),
        _robot_heals,
        parts=True,
    ),
    Fault(
        "robot link: robot to relay only",
        lambda drive, driver: drive.robot_side.forward_up.clear(),
        _robot_heals,
        parts=True,
    ),
    Fault("robot link: reset", lambda drive, driver: drive.robot_side.reset(), parts=True),
    Fault(
        "relay frozen (SIGSTOP)",
        lambda drive, driver: drive.relay.freeze(),
        lambda drive: drive.relay.thaw(),
        parts=True,
    ),
    Fault(
        "relay killed (SIGKILL)",
        lambda drive, driver: drive.relay.kill(),
        lambda drive: drive.relay.start(),
        parts=True,
    ),
    Fault(
        "daemon frozen (SIGSTOP)",
        lambda drive, driver: drive.robot.daemon.signal(signal.SIGSTOP),
        lambda drive: drive.robot.daemon.signal(signal.SIGCONT),
        parts=True,
    ),
    Fault(
        "daemon killed (SIGKILL)",
        lambda drive, driver: drive.robot.daemon.kill(),
        lambda drive: drive.robot.start_daemon(),
        parts=True,
    ),
)


@dataclass
class Tally:
    """What all runs together have shown.

    :ivar ages: of all commands that were carried out, milliseconds
    :ivar looked: runs in which it was looked whether the robot moves again by itself
    :ivar moved: those of them in which it did
    :ivar frozen: runs among them in which the driver went on commanding anew
    :ivar held: runs among them in which a key was held in a tab all the time
    :ivar returned: runs among them in which the driver came back and commanded
    """

    ages: list[float]
    looked: int = 0
    moved: int = 0
    frozen: int = 0
    held: int = 0
    returned: int = 0

    def look(self, name: str, moved: bool) -> None:
        """One more run in which it was looked, after the fault of this name."""
        self.looked += 1
        self.moved += moved
        if moved:
            print(f"    {name}: moved again by itself", flush=True)


def run(options: Options) -> list[Row]:
    """All faults in turn, some times each; the worst counts."""
    runs = options.runs or int(options.pick(1, 50))
    faults = FAULTS[:1] if options.quick else FAULTS
    tally = Tally([])
    rows = []
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        drive = Drive(Path(folder))
        try:
            for fault in faults:
                times = [_once(drive, fault, tally) for _ in range(runs)]
                rows.append(_row(fault.name, times))
            if not options.quick:
                rows += _of_tabs(drive, runs, tally)
        finally:
            drive.stop()
    return rows + _sum(tally)


def _row(name: str, times: list[float]) -> Row:
    print(f"    {name}: {', '.join(f'{each:.0f}' for each in times)} ms", flush=True)
    return Row(
        "standstill",
        f"standstill, worst of {len(times)}: {name}",
        "ms",
        max(times),
        bar=LIMIT_MS + SIM_STEP_MS,
        note=f"{name}: median {statistics.median(times):.0f} ms",
    )


def _sum(tally: Tally) -> list[Row]:
    late = [each for each in tally.ages if each > LIMIT_MS + SIM_STEP_MS]
    note = (
        f"{len(tally.ages)} commands were carried out, the oldest {max(tally.ages):.0f} ms after it was sent"
    )
    words = (
        f"commands carried out more than {LIMIT_MS} ms (and one step of {SIM_STEP_MS}) after they were sent"
    )
    return [
        Row("standstill", words, "commands", len(late), bar=0, note=note),
        Row(
            "standstill",
            f"of {tally.looked} runs: moved again by itself",
            "runs",
            tally.moved,
            bar=0,
            note=f"looked at when all had healed, {HELD_BACK} s after the standstill or later, and what was held up "
            f"had come; in {tally.frozen} runs by commands from before the client was frozen, which goes on with new "
            f"ones, in {tally.held} with a key that was held in the tab all the time, in {tally.returned} by a driver "
            f"who came back {HELD_BACK} s later and commanded for {COMES_BACK} s",
        ),
    ]


def _once(drive: Drive, fault: Fault, tally: Tally) -> float:
    """One fault: from it to the standstill, milliseconds."""
    port = drive.client_side.port
    driver: Any = (
        DriverProcess(port, "rover", drive.token)
        if fault.process
        else TimedDriver(connected(port, "rover", drive.token), pauses=fault.parts)
    )
    begun = time.monotonic_ns()
    drive.start_driving(driver)
    broken = time.monotonic_ns()
    fault.strike(drive, driver)
    took = drive.standstill_ms(broken)
    driver.fall_silent()
    time.sleep(HELD_BACK)  # what is held up is too old now, whenever it arrives
    fault.heal(drive)
    thawed = time.monotonic_ns()
    if fault.goes_on:
        driver.popen.send_signal(signal.SIGCONT)
    _settle(drive)
    if fault.returns:
        tally.returned += 1
        _come_back(drive)
    if fault.goes_on:
        tally.frozen += 1
        tally.look(fault.name, sent_before(thawed, drive.robot.events("command", thawed)))
    else:
        tally.look(fault.name, bool(drive.robot.events("moving", broken)))
    driver.stop()
    drive.stands()
    tally.ages += ages_ms(drive.robot.events("command", begun))
    return took


def _come_back(drive: Drive) -> None:
    """By another connection, with the stick where it was."""
    driver = TimedDriver(connected(drive.client_side.port, "rover", drive.token), asks=False)
    driver.start()
    time.sleep(COMES_BACK)
    driver.stop()


def _settle(drive: Drive) -> None:
    """Wait until the robot answers, behind everything that was held up on the way to it."""
    drive.robot.wait_online()
    with drive.relay.connect("rover", drive.token) as client:
        drive.answers(client)


def _of_tabs(drive: Drive, runs: int, tally: Tally) -> list[Row]:
    """The portal in a browser whose tab is not looked at any more. Without a browser or portal there are no rows."""
    found: dict[str, list[float]] = {name: [] for name in tab_faults}
    with contextlib.ExitStack() as stack:
        try:
            tab = stack.enter_context(Tab.opened(drive))
        except Unavailable as reason:
            print(f"    not measured: tabs: {reason}", flush=True)
            return []
        try:
            for name, fault in tab_faults.items():
                for _ in range(runs):
                    tab.drive()
                    at = struck(tab, fault)
                    found[name].append(drive.standstill_ms(at))
                    time.sleep(HELD_BACK)  # what lasts less than half a second a page may go on after
                    tab.recover()
                    time.sleep(HELD_BACK)  # the key is still held, and nothing must come of it
                    tally.held += 1
                    tally.look(name, bool(drive.robot.events("moving", at)))
                    tab.let_go()
        except AssertionError as reason:
            # What was measured before, in an hour perhaps, is not lost with it; each row says of how many runs it is.
            print(f"    cut short: tabs: {reason}", flush=True)
    return [_row(name, times) for name, times in found.items() if times]
