"""Pictures of this robot's cameras: read, edited, encoded, sent at the pace of the uplink.

Only this module can be imported without numpy and OpenCV; the daemon goes no further.
"""

from __future__ import annotations

from importlib.util import find_spec

from relay_protocol.errors import Unavailable

INSTALL = "pip install 'robot-switchboard[video]'"

_NEEDED = {"numpy": "numpy", "cv2": "OpenCV"}


def check_installed() -> None:
    """See to it that the rest of this package can be imported.

    :raises Unavailable: names what is missing and how it is installed
    """
    missing = [name for module, name in _NEEDED.items() if find_spec(module) is None]
    if missing:
        raise Unavailable(f"this robot shows no pictures: it has no {' and no '.join(missing)} ({INSTALL})")
