"""The robot's imports of the protocol package."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROBOT_NEEDS = "frames identity jsontext limits link message rights rosbridge errors"
PROTOCOL = Path(__file__).parents[2] / "protocol"


def test_the_robot_needs_nothing_of_the_servers() -> None:
    """All modules except the ROS types work without numpy, pybase64, cbor2 and rosbags."""
    program = f"""
import importlib, sys
sys.path.insert(0, {str(PROTOCOL)!r})
for name in ("numpy", "pybase64", "cbor2", "rosbags"):
    sys.modules[name] = None
for name in {ROBOT_NEEDS!r}.split():
    importlib.import_module("relay_protocol." + name)
"""
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)
