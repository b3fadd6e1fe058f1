"""The relay: robots dial in on one side, people on the other, and it connects those who may."""

from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

try:
    VERSION = version("robot-switchboard")
except PackageNotFoundError:  # run from a source tree that was never installed
    VERSION = "0"

PORTAL = Path(__file__).parent / "portal"
"""Where the portal's build puts its files."""
