"""Talks to the relay that runs on a data folder: HTTP over its Unix socket ``relay.sock``."""

from __future__ import annotations

import http.client
import json
import os
import socket
from pathlib import Path
from typing import Any

from relay_protocol.errors import Unavailable

SOCKET_NAME = "relay.sock"

_KNOCK_SECONDS = 2.0
_ASK_SECONDS = 5.0
_ANSWER_BYTES = 16 * 1024 * 1024
_PATH_BYTES = 107
"""Longest path of a Unix socket (unix(7): sun_path, less its NUL)."""


class _Connection(http.client.HTTPConnection):
    def __init__(self, folder: Path, timeout: float) -> None:
        super().__init__("localhost", timeout=timeout)
        self._folder = folder

    def connect(self) -> None:
        connected = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            connected.settimeout(self.timeout)
            _connect(connected, self._folder)
        except BaseException:
            connected.close()
            raise
        self.sock = connected


def _connect(connected: socket.socket, folder: Path) -> None:
    path = os.fsencode(folder / SOCKET_NAME)
    if len(path) <= _PATH_BYTES:
        connected.connect(path)
        return
    # A longer one is reached through a descriptor of its folder.
    descriptor = os.open(folder, os.O_PATH | os.O_DIRECTORY)
    try:
        connected.connect(f"/proc/self/fd/{descriptor}/{SOCKET_NAME}")
    finally:
        os.close(descriptor)


def _request(folder: Path, method: str, target: str, timeout: float) -> tuple[int, bytes]:
    connection = _Connection(folder, timeout)
    try:
        connection.request(method, target)
        answer = connection.getresponse()
        return answer.status, answer.read(_ANSWER_BYTES)
    finally:
        connection.close()


def knock(folder: Path) -> bool:
    """Tell the relay to look at the database now; false if none listens (it would look by itself anyway)."""
    try:
        status, _ = _request(folder, "POST", "/refresh", _KNOCK_SECONDS)
    except (OSError, http.client.HTTPException):
        return False
    return status < http.client.BAD_REQUEST


def ask_status(folder: Path) -> dict[str, Any]:
    """What the relay says of itself and its robots.

    :raises Unavailable: no relay runs on this folder, or it doesn't answer
    """
    try:
        status, body = _request(folder, "GET", "/status", _ASK_SECONDS)
    except (FileNotFoundError, ConnectionRefusedError, NotADirectoryError):
        raise Unavailable(
            "no relay runs on this data folder; start one with 'switchboard serve', or give --data"
        ) from None
    except (PermissionError, OSError, http.client.HTTPException) as error:
        raise Unavailable(f"the relay on this data folder does not answer ({_reason(error)})") from None
    try:
        answer = json.loads(body)
    except ValueError:
        answer = None
    if status != http.client.OK or not isinstance(answer, dict):
        raise Unavailable(f"the relay on this data folder answered something else (HTTP {status})")
    return answer


def _reason(error: Exception) -> str:
    if isinstance(error, TimeoutError):
        return f"nothing came within {_ASK_SECONDS:g} s"
    return getattr(error, "strerror", None) or type(error).__name__
