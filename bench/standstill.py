"""How long a robot moves on after something has broken, by its own record. Prints a table, milliseconds.

.venv/bin/python bench/standstill.py --runs 10
"""

from __future__ import annotations

import argparse
import signal
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "harness"))

from switchboard_drive import Drive
from switchboard_harness import Driver

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


def main() -> None:
    """Run all faults in turn and print the table."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--runs", type=int, default=5, help="runs of each fault")
    runs = options.parse_args().runs
    table = Table("fault", "median ms", "worst ms", title=f"From the fault to standstill, {runs} runs each")
    with tempfile.TemporaryDirectory() as folder:
        drive = Drive(Path(folder))
        try:
            for name, (fault, repair) in FAULTS.items():
                times = [_once(drive, fault, repair) for _ in range(runs)]
                table.add_row(name, f"{statistics.median(times):.0f}", f"{max(times):.0f}")
                print(f"{name}: {', '.join(f'{each:.0f}' for each in times)}", file=sys.stderr)
        finally:
            drive.stop()
    Console().print(table)


def _once(drive: Drive, fault: Fault, repair: Repair) -> float:
    driver = drive.start_driving()
    since = time.monotonic_ns()
    fault(drive, driver)
    took = drive.standstill_ms(since)
    driver.stop()
    repair(drive)
    drive.robot.wait_online()
    return took


if __name__ == "__main__":
    main()
