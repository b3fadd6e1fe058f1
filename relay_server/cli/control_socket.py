"""Talks to the relay that runs on a data folder: HTTP over its Unix socket ``relay.sock``."""

from __future__ import annotations

import http.client
import json
import os
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

from relay_protocol.clocks import now_ns
from relay_protocol.errors import Invalid, NotFound, Refused, SwitchboardError, Unavailable

SOCKET_NAME = "relay.sock"

_SENT_HEADER = "Switchboard-Sent"
"""When an order was given, by the machine's clock."""

_KNOCK_SECONDS = 2.0
_ASK_SECONDS = 5.0
_ANSWER_BYTES = 16 * 1024 * 1024
_LINE_SECONDS = 330.0
"""The longest a robot may take for an order, and some more."""
_MOTION_SECONDS = 20.0
"""Longer than the relay waits for its database, and a robot has to confirm that it stands."""
_SURE_SECONDS = 5.0
"""A relay that has not answered an order to stop by then may never do so."""

_NO_RELAY = "no relay runs on this data folder; start one with 'switchboard serve', or give --data"
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


def notify_relay(folder: Path) -> bool:
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
        raise Unavailable(_NO_RELAY) from None
    except (PermissionError, OSError, http.client.HTTPException) as error:
        raise _unanswered(error, _ASK_SECONDS) from None
    try:
        answer = json.loads(body)
    except ValueError:
        answer = None
    if status != http.client.OK or not isinstance(answer, dict):
        raise Unavailable(f"the relay on this data folder answered something else (HTTP {status})")
    return answer


class NoRelay(Unavailable):
    """No relay runs on this data folder."""


def order_motion(
    folder: Path, what: str, order: dict[str, Any], unsure: Callable[[float], None] | None = None
) -> dict[str, Any]:
    """Have the relay stop robots, or resume one.

    :param what: ``stop`` or ``resume``
    :param unsure: called when no answer has come for some time, with the seconds; the answer is still waited for
    :raises NoRelay: none runs on this folder
    :raises Unavailable: it does not answer, or a robot does not
    :raises SwitchboardError: it says no, in its own words
    """
    connection = _Connection(folder, _MOTION_SECONDS if unsure is None else _SURE_SECONDS)
    headers = _dated()
    try:
        try:
            connection.request("POST", f"/{what}", json.dumps(order), headers)
            answer = connection.getresponse()
        except TimeoutError:
            if unsure is None or connection.sock is None:
                raise
            unsure(_SURE_SECONDS)
            connection.sock.settimeout(_MOTION_SECONDS - _SURE_SECONDS)
            answer = connection.getresponse()
        body = answer.read(_ANSWER_BYTES)
    except (FileNotFoundError, ConnectionRefusedError, NotADirectoryError):
        raise NoRelay(_NO_RELAY) from None
    except (OSError, http.client.HTTPException) as error:
        raise _unanswered(error, _MOTION_SECONDS) from None
    finally:
        connection.close()
    if answer.status != http.client.OK:
        raise _refusal(answer.status, body)
    return _line(body)


def give_order(folder: Path, order: dict[str, Any], realm: str) -> Iterator[dict[str, Any]]:
    """Have the relay carry out an order to many robots; its lines as they come. Who stops reading ends the order.

    :param realm: whose robots are meant
    :raises Unavailable: no relay runs on this folder, or it went away before the order was done
    :raises Invalid: the order makes no sense
    :raises NotFound: it means no robot
    """
    connection = _Connection(folder, _LINE_SECONDS)
    headers = _dated()
    try:
        try:
            connection.request("POST", f"/fleet?realm={quote(realm)}", json.dumps(order), headers)
            answer = connection.getresponse()
            if answer.status != http.client.OK:
                raise _refusal(answer.status, answer.read(_ANSWER_BYTES))
            while line := answer.readline(_ANSWER_BYTES):
                yield _line(line)
        except (FileNotFoundError, ConnectionRefusedError, NotADirectoryError):
            raise Unavailable(_NO_RELAY) from None
        except (OSError, http.client.HTTPException) as error:
            raise _unanswered(error, _LINE_SECONDS) from None
    finally:
        connection.close()


def _dated() -> dict[str, str]:
    """Headers of an order that is given now: a relay that is frozen, or slow, does not do later what was meant now."""
    return {"Content-Type": "application/json", _SENT_HEADER: str(now_ns())}


def _line(line: bytes) -> dict[str, Any]:
    try:
        said = json.loads(line)
    except ValueError:
        said = None
    if not isinstance(said, dict):
        raise Unavailable("the relay on this data folder answered something else")
    return said


def _refusal(status: int, body: bytes) -> SwitchboardError:
    """What the relay says in problem details."""
    try:
        said = json.loads(body)
    except ValueError:
        said = None
    detail = said.get("detail") if isinstance(said, dict) else None
    if not isinstance(detail, str):
        return Unavailable(f"the relay on this data folder answered something else (HTTP {status})")
    kinds: dict[int, type[SwitchboardError]] = {400: Invalid, 404: NotFound, 409: Refused, 412: Refused}
    return kinds.get(status, Unavailable)(detail)


def _unanswered(error: Exception, waited: float) -> Unavailable:
    """What is told when no answer came.

    :param waited: how long it was waited for, seconds
    """
    if isinstance(error, TimeoutError):
        reason = f"nothing came within {waited:g} s"
    else:
        reason = getattr(error, "strerror", None) or type(error).__name__
    return Unavailable(f"the relay on this data folder does not answer ({reason})")
