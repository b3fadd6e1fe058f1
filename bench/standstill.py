"""How long a robot moves on after something has broken, by its own record, in milliseconds.

A real relay, daemon and simulated robot, driven in circles through proxies that can be broken.
"""

from __future__ import annotations

import signal
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from switchboard_drive import LIMIT_MS, SIM_STEP_MS, Drive
from switchboard_threads import Driver

from bench.report import Options, Row

Fault = Callable[[Drive, Driver], None]
Repair = Callable[[Drive], None]


def _nothing(drive: Drive) -> None:
    """Heals by itself."""


FAULTS: dict[str, tuple[Fault, Repair]] = {
    "client goes silent": (lambda drive, driver: driver.stop(), _nothing),
    "client link: black hole": (
        lambda drive, driver: drive.client_side.black_hole(),
        lambda drive: drive.client_side.heal(),
    ),
    "client link: reset": (lambda drive, driver: drive.client_side.reset(), _nothing),
    "robot link: black hole": (
        lambda drive, driver: drive.robot_side.black_hole(),
        lambda drive: drive.robot_side.heal(),
    ),
    "robot link: relay to robot only": (
        lambda drive, driver: drive.robot_side.forward_down.clear(),
        lambda drive: drive.robot_side.heal(),
    ),
    "robot link: reset": (lambda drive, driver: drive.robot_side.reset(), _nothing),
    "relay frozen (SIGSTOP)": (
        lambda drive, driver: drive.relay.freeze(),
        lambda drive: drive.relay.thaw(),
    ),
    "relay killed (SIGKILL)": (lambda drive, driver: drive.relay.kill(), lambda drive: drive.relay.start()),
    "daemon frozen (SIGSTOP)": (
        lambda drive, driver: drive.robot.daemon.signal(signal.SIGSTOP),
        lambda drive: drive.robot.daemon.signal(signal.SIGCONT),
    ),
    "daemon killed (SIGKILL)": (
        lambda drive, driver: drive.robot.daemon.kill(),
        lambda drive: drive.robot.start_daemon(),
    ),
}


def run(options: Options) -> list[Row]:
    """All faults in turn, some times each; the worst counts."""
    names = list(FAULTS)[: 1 if options.quick else None]
    runs = int(options.pick(1, 4))
    rows = []
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        drive = Drive(Path(folder))
        try:
            for name in names:
                times = [_once(drive, *FAULTS[name]) for _ in range(runs)]
                print(f"    {name}: {', '.join(f'{each:.0f}' for each in times)} ms", flush=True)
                rows.append(
                    Row(
                        "standstill",
                        f"standstill, worst of {runs}: {name}",
                        "ms",
                        max(times),
                        bar=LIMIT_MS + SIM_STEP_MS,
                        note=f"{name}: median {statistics.median(times):.0f} ms",
                    )
                )
        finally:
            drive.stop()
    return rows


def _once(drive: Drive, fault: Fault, repair: Repair) -> float:
    driver = drive.start_driving()
    since = time.monotonic_ns()
    fault(drive, driver)
    took = drive.standstill_ms(since)
    driver.stop()
    repair(drive)
    drive.robot.wait_online()
    return took
