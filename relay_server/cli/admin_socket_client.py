"""Client of the relay's admin socket: HTTP over the Unix socket ``relay.sock`` in the data folder.

The other end is :mod:`relay_server.http.admin_socket`.
"""

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
from relay_server.common.data_dir import SENT_HEADER, SOCKET_NAME

_NOTIFY_SECONDS = 2.0
_STATUS_SECONDS = 5.0
_ANSWER_BYTES = 16 * 1024 * 1024
_LINE_SECONDS = 330.0
"""Longer than the longest time a robot may take for an order."""
_ORDER_SECONDS = 20.0
"""Longer than the relay waits for its database and for a robot to confirm that it stands."""
_UNSURE_SECONDS = 5.0
"""The relay may never answer an order to stop that it has not answered by then."""

_NO_RELAY = "no relay runs on the data folder {folder}; start one with 'switchboard serve', or give --data"
_PATH_BYTES = 107
"""Longest path of a Unix socket (unix(7): sun_path without its NUL)."""


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
    # A longer path is reached through a descriptor of its folder.
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
    """Notify the relay of a change in the database; false if none listens. The relay would also notice by
    itself."""
    try:
        status, _ = _request(folder, "POST", "/refresh", _NOTIFY_SECONDS)
    except (OSError, http.client.HTTPException):
        return False
    return status < http.client.BAD_REQUEST


def ask_status(folder: Path) -> dict[str, Any]:
    """The status of the relay and its robots.

    :raises Unavailable: no relay runs on this folder, or it does not answer
    """
    try:
        status, body = _request(folder, "GET", "/status", _STATUS_SECONDS)
    except (FileNotFoundError, ConnectionRefusedError, NotADirectoryError):
        raise Unavailable(_NO_RELAY.format(folder=folder.absolute())) from None
    except (PermissionError, OSError, http.client.HTTPException) as error:
        raise _no_answer_error(error, _STATUS_SECONDS) from None
    try:
        answer = json.loads(body)
    except ValueError:
        answer = None
    if status != http.client.OK or not isinstance(answer, dict):
        raise Unavailable(f"the relay on this data folder sent an unexpected answer (HTTP {status})")
    return answer


class NoRelay(Unavailable): ...


def send_order(
    folder: Path, what: str, order: dict[str, Any], unsure: Callable[[float], None] | None = None
) -> dict[str, Any]:
    """Have the relay carry out an order, and wait for its result.

    :param what: ``stop``, ``resume`` or ``modules``
    :param unsure: called with the seconds waited so far when no answer has come for some time; waiting goes
        on
    :raises NoRelay: none runs on this folder
    :raises Unavailable: the relay or a robot does not answer
    :raises SwitchboardError: the relay refuses
    """
    connection = _Connection(folder, _ORDER_SECONDS if unsure is None else _UNSURE_SECONDS)
    headers = _order_headers()
    try:
        try:
            connection.request("POST", f"/{what}", json.dumps(order), headers)
            answer = connection.getresponse()
        except TimeoutError:
            if unsure is None or connection.sock is None:
                raise
            unsure(_UNSURE_SECONDS)
            connection.sock.settimeout(_ORDER_SECONDS - _UNSURE_SECONDS)
            answer = connection.getresponse()
        body = answer.read(_ANSWER_BYTES)
    except (FileNotFoundError, ConnectionRefusedError, NotADirectoryError):
        raise NoRelay(_NO_RELAY.format(folder=folder.absolute())) from None
    except (OSError, http.client.HTTPException) as error:
        raise _no_answer_error(error, _ORDER_SECONDS) from None
    finally:
        connection.close()
    if answer.status != http.client.OK:
        raise _refusal_error(answer.status, body)
    return _parse_line(body)


def send_fleet_order(folder: Path, order: dict[str, Any], realm: str) -> Iterator[dict[str, Any]]:
    """Have the relay carry out an order to many robots; yields the lines of its answer as they come. Closing
    the generator ends the order.

    :param realm: the robots' realm
    :raises Unavailable: no relay runs on this folder, or it stopped before the order was done
    :raises Invalid: the order is not valid
    :raises NotFound: it matches no robot
    """
    connection = _Connection(folder, _LINE_SECONDS)
    headers = _order_headers()
    try:
        try:
            connection.request("POST", f"/fleet?realm={quote(realm)}", json.dumps(order), headers)
            answer = connection.getresponse()
            if answer.status != http.client.OK:
                raise _refusal_error(answer.status, answer.read(_ANSWER_BYTES))
            while line := answer.readline(_ANSWER_BYTES):
                yield _parse_line(line)
        except (FileNotFoundError, ConnectionRefusedError, NotADirectoryError):
            raise Unavailable(_NO_RELAY.format(folder=folder.absolute())) from None
        except (OSError, http.client.HTTPException) as error:
            raise _no_answer_error(error, _LINE_SECONDS) from None
    finally:
        connection.close()


def _order_headers() -> dict[str, str]:
    """Headers with the time of an order, so that a frozen or slow relay does not carry it out late."""
    return {"Content-Type": "application/json", SENT_HEADER: str(now_ns())}


def _parse_line(line: bytes) -> dict[str, Any]:
    try:
        decoded = json.loads(line)
    except ValueError:
        decoded = None
    if not isinstance(decoded, dict):
        raise Unavailable("the relay on this data folder sent an unexpected answer")
    return decoded


def _refusal_error(status: int, body: bytes) -> SwitchboardError:
    """The error in problem details (RFC 9457)."""
    try:
        decoded = json.loads(body)
    except ValueError:
        decoded = None
    detail = decoded.get("detail") if isinstance(decoded, dict) else None
    if not isinstance(detail, str):
        return Unavailable(f"the relay on this data folder sent an unexpected answer (HTTP {status})")
    kinds: dict[int, type[SwitchboardError]] = {400: Invalid, 404: NotFound, 409: Refused, 412: Refused}
    return kinds.get(status, Unavailable)(detail)


def _no_answer_error(error: Exception, waited: float) -> Unavailable:
    """The error for an answer that did not come.

    :param waited: seconds
    """
    if isinstance(error, TimeoutError):
        reason = f"no answer within {waited:g} s"
    else:
        reason = getattr(error, "strerror", None) or type(error).__name__
    return Unavailable(f"the relay on this data folder does not answer ({reason})")
