"""The websocket connection of an application to a robot."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
from collections.abc import Callable, Iterator
from typing import Any

import click

TOKEN = "SWITCHBOARD_TOKEN"  # noqa: S105 -- the name of the variable
CLOSE_SECONDS = 2.0
"""Longest wait for the relay's close frame, seconds."""

RETRYABLE_STATUS = (429, 500, 502, 503, 504)
"""HTTP status codes after which a retry may succeed."""

FINAL_CLOSE_CODES = (4400, 4401, 4403, 4404)
"""Websocket close codes after which a retry does not help (SPEC 1.4)."""


class Refused(Exception):
    """The relay refuses, and a retry does not help. The text says why."""


class Lost(Exception):
    """There is no connection; a retry may help. The text says why."""


class RosbridgeConnection:
    """Sends and receives rosbridge messages of one robot.

    :param connection: a :class:`robot_client.apps.blocking_websocket.BlockingWebsocket`
    """

    def __init__(self, connection: Any) -> None:
        self._connection = connection
        self._numbers = itertools.count(1)

    def send(self, **message: Any) -> None:
        """Send one rosbridge operation."""
        self._connection.send(json.dumps(message))

    def call(self, service: str, **args: Any) -> str:
        """Call a service, and return the ``id`` of its answer."""
        number = str(next(self._numbers))
        self.send(op="call_service", service=service, id=number, args=args)
        return number

    def receive(self, seconds: float) -> dict[str, Any] | None:
        """The next message, or ``None`` if none arrives within ``seconds``."""
        try:
            return dict(json.loads(self._connection.recv(timeout=seconds)))
        except TimeoutError:
            return None


class LivenessMonitor:
    """Checks by pings that the relay still answers, because a network can drop everything unnoticed.

    :param connection: to the robot
    :param clock: seconds, including suspends
    :param ping_seconds: interval of pings
    :param lost_seconds: time without a message after which the connection counts as lost
    """

    def __init__(
        self,
        connection: RosbridgeConnection,
        clock: Callable[[], float],
        ping_seconds: float,
        lost_seconds: float,
    ) -> None:
        self._connection = connection
        self._clock = clock
        self._ping_seconds = ping_seconds
        self._lost_seconds = lost_seconds
        self._received_at = self._pinged_at = clock()

    def receive(self, seconds: float) -> dict[str, Any] | None:
        """The next message that comes within this time.

        :raises Lost: nothing was received for ``lost_seconds``
        """
        message = self._connection.receive(seconds)
        now = self._clock()
        if message is not None:
            self._received_at = now
        if now - self._received_at > self._lost_seconds:
            raise Lost(f"the relay has not answered for {self._lost_seconds:g} s")
        if now - self._pinged_at >= self._ping_seconds:
            self._pinged_at = now
            self._connection.call("/relay/ping")
        return message


def access_token() -> str:
    """The access token from the environment.

    :raises click.ClickException: it is not set
    """
    found = os.environ.get(TOKEN, "")
    if not found:
        raise click.ClickException(
            f"set {TOKEN} to an access token; create one by: switchboard token create USER"
        )
    return found


@contextlib.contextmanager
def connected(url: str) -> Iterator[RosbridgeConnection]:
    """A connection to a robot, closed at the end.

    :param url: ``ws://relay/robots/NAME``
    :raises click.ClickException: no access token is set
    :raises Lost: it failed, and a retry may help
    :raises Refused: the relay refuses, and a retry does not help
    """
    from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus, InvalidURI

    from robot_client.apps.blocking_websocket import BlockingWebsocket

    headers = {"Authorization": f"Bearer {access_token()}"}
    try:
        with BlockingWebsocket(url, additional_headers=headers, close_timeout=CLOSE_SECONDS) as websocket:
            yield RosbridgeConnection(websocket)
    except InvalidURI as error:
        raise Refused(f"{url} is not the address of a robot: {error}") from None
    except InvalidStatus as error:
        code = error.response.status_code
        words = f"the relay at {url} answers {code}{_meaning(code)}"
        raise (Lost if code in RETRYABLE_STATUS else Refused)(words) from None
    except ConnectionClosed as error:
        final = error.rcvd is not None and error.rcvd.code in FINAL_CLOSE_CODES
        words = (error.rcvd.reason if error.rcvd is not None else "") or str(error)
        raise (Refused if final else Lost)(f"the connection to {url} is lost: {words}") from None
    except (OSError, InvalidHandshake) as error:
        raise Lost(f"the connection to {url} is lost: {error}") from None


def _meaning(code: int) -> str:
    words = {
        401: "the access token is not valid, or has expired",
        403: "the user has no right on this robot",
        404: "the robot does not exist, or the user has no right on it",
    }
    return f": {words[code]}" if code in words else ""


@contextlib.contextmanager
def errors_as_click() -> Iterator[None]:
    """Turn errors of a connection into error messages of the command, which exits with 1."""
    try:
        yield
    except (Lost, Refused) as error:
        raise click.ClickException(str(error)) from None
