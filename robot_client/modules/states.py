"""The life of a module as a table."""

from __future__ import annotations

import enum


class ModuleState(str, enum.Enum):
    """State of a module."""

    STOPPED = "stopped"
    """It does not run, and is not meant to run."""
    WAITING = "waiting"
    """It waits for other modules to be ready."""
    STARTING = "starting"
    """Its process runs, but is not ready yet."""
    RUNNING = "running"
    """Its process runs and is ready."""
    STOPPING = "stopping"
    """Its processes have been asked to end."""
    BACKING_OFF = "backing_off"
    """It has ended, and is started again after a pause."""
    FAILED = "failed"
    """It has ended, and stays down until it is started by an order."""


class ModuleEvent(enum.Enum):
    """An event that may change the state of a module."""

    START = enum.auto()
    DEPENDENCIES_READY = enum.auto()
    READY = enum.auto()
    STOP = enum.auto()
    ENDED = enum.auto()
    """All its processes have ended, and the policy asks for no restart."""
    CRASHED = enum.auto()
    """All its processes have ended, and the policy asks for a restart; or the disk was full, whatever the policy."""
    FAILED = enum.auto()
    """All its processes have ended, but it has ended too often, or is never restarted."""
    RETRY = enum.auto()
    """The pause is over."""


_S, _E = ModuleState, ModuleEvent

TRANSITIONS: dict[tuple[ModuleState, ModuleEvent], ModuleState] = {
    (_S.STOPPED, _E.START): _S.WAITING,
    (_S.FAILED, _E.START): _S.WAITING,
    (_S.BACKING_OFF, _E.START): _S.WAITING,
    (_S.BACKING_OFF, _E.RETRY): _S.WAITING,
    (_S.WAITING, _E.DEPENDENCIES_READY): _S.STARTING,
    (_S.STARTING, _E.READY): _S.RUNNING,
    (_S.STARTING, _E.STOP): _S.STOPPING,
    (_S.RUNNING, _E.STOP): _S.STOPPING,
    (_S.WAITING, _E.STOP): _S.STOPPED,
    (_S.BACKING_OFF, _E.STOP): _S.STOPPED,
    (_S.FAILED, _E.STOP): _S.STOPPED,
    (_S.STARTING, _E.ENDED): _S.STOPPED,
    (_S.RUNNING, _E.ENDED): _S.STOPPED,
    (_S.STARTING, _E.CRASHED): _S.BACKING_OFF,
    (_S.RUNNING, _E.CRASHED): _S.BACKING_OFF,
    (_S.STARTING, _E.FAILED): _S.FAILED,
    (_S.RUNNING, _E.FAILED): _S.FAILED,
    (_S.STOPPING, _E.ENDED): _S.STOPPED,
    # Not stopped by an order: it was not ready in time, or its process ended and left others.
    (_S.STOPPING, _E.CRASHED): _S.BACKING_OFF,
    (_S.STOPPING, _E.FAILED): _S.FAILED,
}
"""The next state. An event that is not listed for a state changes nothing."""


def next_state(state: ModuleState, event: ModuleEvent) -> ModuleState:
    """The state after an event."""
    return TRANSITIONS.get((state, event), state)
