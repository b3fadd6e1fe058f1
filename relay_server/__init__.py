"""The relay: robots and clients dial in, and it connects clients with the robots that they may use.

A message of a client passes ``http/site`` (which URL), ``ws/`` (bytes to whole messages), ``sessions/`` (rights, age),
``channels/`` (publications and calls of one robot) and ``robots/`` (the robot's link); ``control/`` is asked on the
way.
A request passes ``http/router``, and then ``http.py`` and ``service.py`` in the folder of its feature.
"""

from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

try:
    VERSION = version("robot-switchboard")
except PackageNotFoundError:  # run from a source tree that was never installed
    VERSION = "0"

PORTAL = Path(__file__).parent / "portal"
"""Where the portal's build puts its files."""
