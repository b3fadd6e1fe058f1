"""Pictures of this robot's cameras: read, edited, encoded, sent at the pace of the uplink.

The daemon's side is :mod:`~robot_client.camera.service` (which cameras there are, what the relay wants) and
:mod:`~robot_client.camera.supervisor` (the process); the rest runs in the process,
    :mod:`~robot_client.camera.main`. What
needs numpy and OpenCV is imported there, after :func:`check_installed`.
"""

from __future__ import annotations

from importlib import import_module

from relay_protocol.errors import Unavailable

INSTALL = "pip install 'robot-switchboard[video]'"

_NEEDED = {"numpy": "numpy", "cv2": "OpenCV"}


def check_installed() -> None:
    """See to it that the rest of this package can be imported.

    :raises Unavailable: names what is missing or can't be loaded, and how it is installed
    """
    for module, name in _NEEDED.items():
        try:
            import_module(module)
        except ImportError as error:
            raise Unavailable(f"this robot shows no pictures without {name}: {error} ({INSTALL})") from None
