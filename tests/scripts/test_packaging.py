"""The installed packages are the existing ones."""

from __future__ import annotations

import configparser
from pathlib import Path

ROOT = Path(__file__).parents[2]
SOURCES = {
    "relay_protocol": ROOT / "protocol/relay_protocol",
    "relay_db": ROOT / "db/relay_db",
    "relay_server": ROOT / "relay_server",
    "robot_client": ROOT / "robot_client",
}


def test_every_package_is_installed_and_no_other() -> None:
    settings = configparser.ConfigParser()
    settings.read(ROOT / "setup.cfg")
    listed = settings["options"]["packages"].split()
    found = [
        ".".join((name, *init.parent.relative_to(folder).parts))
        for name, folder in SOURCES.items()
        for init in folder.rglob("__init__.py")
    ]
    assert sorted(listed) == sorted(found)
