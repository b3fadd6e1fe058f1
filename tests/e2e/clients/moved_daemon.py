"""``switchboard-robot`` on a machine that has the addresses in a file: FILE, then its own arguments."""

from __future__ import annotations

import socket
import sys
from pathlib import Path
from types import SimpleNamespace

import psutil

from robot_client import cli
from robot_client.platforms.ros2.platform import Ros2Platform


def main() -> None:
    file = Path(sys.argv.pop(1))

    def addresses() -> dict[str, list[SimpleNamespace]]:
        found = file.read_text().split()
        return {"wlan0": [SimpleNamespace(family=socket.AF_INET, address=each) for each in found]}

    psutil.net_if_addrs = addresses
    # The tests' own domain is limited to this machine, where no address matters.
    Ros2Platform.depends_on_addresses = lambda self: True  # type: ignore[method-assign]
    cli.main()


main()
