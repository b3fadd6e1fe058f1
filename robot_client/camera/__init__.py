"""Frames of this robot's cameras: captured, transformed, encoded, and sent at the rate that the uplink
carries.

In the daemon run :mod:`~robot_client.camera.service` (the list of cameras, the relay's requests) and
:mod:`~robot_client.camera.supervisor` (the camera process). Everything else runs in that process,
:mod:`~robot_client.camera.main`. Modules that need numpy and OpenCV are imported there, after
    :func:`check_installed`.
"""

from __future__ import annotations

from importlib import import_module

from relay_protocol.errors import Unavailable

INSTALL = "pip install 'robot-switchboard[video]'"

_REQUIRED = {"numpy": "numpy", "cv2": "OpenCV"}


def check_installed() -> None:
    """Check that the modules which need numpy and OpenCV can be imported.

    :raises Unavailable: names the package that can't be loaded, and how to install it
    """
    for module, name in _REQUIRED.items():
        try:
            import_module(module)
        except ImportError as error:
            raise Unavailable(f"this robot can't show cameras without {name}: {error} ({INSTALL})") from None
