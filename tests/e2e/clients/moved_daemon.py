"""``switchboard-robot`` on a machine whose only address is that in a file: FILE, then its own arguments."""

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
        return {"wlan0": [SimpleNamespace(family=socket.AF_INET, address=file.read_text())]}

    psutil.net_if_addrs = addresses
    # The tests' own domain is limited to this machine, where no address matters.
    Ros2Platform.depends_on_addresses = lambda self: True  # type: ignore[method-assign]
    cli.main()


main()
