"""Waiting for what comes by itself."""

from __future__ import annotations

import selectors
import socket
import time
from collections.abc import Callable
from typing import Any

PATIENCE = 60.0
"""Seconds for what comes at once: a machine that runs tests may stand still for a while."""


def wait_for(what: str, condition: Callable[[], Any], seconds: float = PATIENCE) -> Any:
    """Poll until ``condition`` gives something true, and return it; fail by name when it does not."""
    until = time.monotonic() + seconds
    while True:
        found = condition()
        if found:
            return found
        if time.monotonic() > until:
            raise AssertionError(f"not within {seconds:g} s: {what}")
        time.sleep(0.02)


def readable(connection: socket.socket, seconds: float) -> bool:
    """Whether bytes (or the end) can be read within this time."""
    with selectors.DefaultSelector() as selector:
        selector.register(connection, selectors.EVENT_READ)
        return bool(selector.select(seconds))
