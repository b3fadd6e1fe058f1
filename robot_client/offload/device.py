"""The state of the device, as the daemon's device manager publishes it on this machine."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import msgspec

STATE_FILE = "device.json"
"""In the robot's state folder."""

MAX_AGE = 180.0
"""Seconds after which a state does not count: the device manager does not run."""

STATE_VARIABLE = "SWITCHBOARD_ROBOT_STATE"
"""Environment variable with the robot's state folder."""

WIRELESS = ("signal", "quality")
"""Components of which a critical value means that the network is too bad to offload."""


Where = Literal["auto", "here", "cloud"]
"""Where functions run; ``auto``: by the state of the device."""


class DeviceState(msgspec.Struct, frozen=True):
    """The state that the device manager publishes once a cycle.

    :param at: Unix seconds
    :param critical: by component: ``battery``, ``cpu``, ``memory``, ``disk``, ``temperature``, ``signal``, ``quality``
    :param readings: by component, in its unit
    :param where: where the robot's settings want functions to run
    """

    at: float
    critical: dict[str, bool] = {}
    readings: dict[str, float] = {}
    where: Where = "auto"


def publish(folder: Path, state: DeviceState) -> None:
    """Publish a state; readers see the old or the new one, never a part.

    :param folder: the robot's state folder
    """
    pending = folder / f"{STATE_FILE}.{os.getpid()}"
    pending.write_bytes(msgspec.json.encode(state))
    pending.replace(folder / STATE_FILE)


class Device:
    """This device.

    :param folder: the robot's state folder; without it, as ``SWITCHBOARD_ROBOT_STATE`` says
    """

    def __init__(self, folder: Path | None = None, wall: Callable[[], float] = time.time) -> None:
        self._folder = folder
        self._wall = wall

    def state(self) -> DeviceState | None:
        """The latest state; ``None`` if none is published, or it is too old."""
        folder = self._folder or state_folder()
        if folder is None:
            return None
        try:
            state = msgspec.json.decode((folder / STATE_FILE).read_bytes(), type=DeviceState)
        except (OSError, ValueError, RecursionError):
            return None
        # One from the future is not new either: the clock was set back, as on a robot whose clock has no battery.
        return state if abs(self._wall() - state.at) <= MAX_AGE else None

    def where(self) -> Where:
        """Where the robot's settings want functions to run; ``auto`` if the state is not known."""
        state = self.state()
        return "auto" if state is None else state.where

    def critical(self, component: str = "") -> bool:
        """Whether a component is critical; without one, whether any is. False if the state is not known."""
        state = self.state()
        if state is None:
            return False
        return state.critical.get(component, False) if component else any(state.critical.values())


def state_folder() -> Path | None:
    """The robot's state folder, as ``SWITCHBOARD_ROBOT_STATE`` says."""
    text = os.environ.get(STATE_VARIABLE, "")
    return Path(text) if text else None


device = Device()
"""The device of this program."""
