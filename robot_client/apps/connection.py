"""The way to a robot that all applications take: its websocket, with a token, and what is said there."""

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
"""How long a relay that does not answer its goodbye is waited for."""

AGAIN = (429, 500, 502, 503, 504)
"""Answers of HTTP that may be others in a while."""

FINAL = (4400, 4401, 4403, 4404)
"""Codes of closing that stay what they are until a person has done something (SPEC section 1.4)."""


class Refused(Exception):
    """The relay does not let it; the text says why."""


class Lost(Exception):
    """There is no connection, or no longer; there may be one in a while. The text says why."""


class RosbridgeConnection:
    """Messages to a robot and from it.

    :param connection: a websocket of the ``websockets`` library
    """

    def __init__(self, connection: Any) -> None:
        self._connection = connection
        self._numbers = itertools.count(1)

    def say(self, **message: Any) -> None:
        """One operation of rosbridge."""
        self._connection.send(json.dumps(message))

    def call(self, service: str, **args: Any) -> str:
        """Call a service; the ``id`` its answer will have."""
        number = str(next(self._numbers))
        self.say(op="call_service", service=service, id=number, args=args)
        return number

    def hear(self, seconds: float) -> dict[str, Any] | None:
        """The next message that comes within this time."""
        try:
            return dict(json.loads(self._connection.recv(timeout=seconds)))
        except TimeoutError:
            return None


class LivenessCheck:
    """Whether the relay still answers by a line. It is asked now and then, for a network may swallow all in silence.

    :param line: to the robot
    :param clock: seconds, suspends included
    :param beat: seconds from one question to the next
    :param silent: seconds without a word of the relay after which there is no connection
    """

    def __init__(
        self, line: RosbridgeConnection, clock: Callable[[], float], beat: float, silent: float
    ) -> None:
        self._line = line
        self._clock = clock
        self._beat = beat
        self._silent = silent
        self._heard_at = self._asked_at = clock()

    def hear(self, seconds: float) -> dict[str, Any] | None:
        """The next message that comes within this time.

        :raises Lost: nothing has come for long
        """
        message = self._line.hear(seconds)
        now = self._clock()
        if message is not None:
            self._heard_at = now
        if now - self._heard_at > self._silent:
            raise Lost(f"the relay has not answered for {self._silent:g} s")
        if now - self._asked_at >= self._beat:
            self._asked_at = now
            self._line.call("/relay/ping")
        return message


def token() -> str:
    """What proves to the relay who this is.

    :raises click.ClickException: there is none
    """
    found = os.environ.get(TOKEN, "")
    if not found:
        raise click.ClickException(f"set {TOKEN}: switchboard token create USER")
    return found


@contextlib.contextmanager
def connected(url: str) -> Iterator[RosbridgeConnection]:
    """A line to a robot, closed in order at the end.

    :param url: ``ws://relay/robots/NAME``
    :raises click.ClickException: there is no token
    :raises Lost: it can't be made now, or broke
    :raises Refused: the relay says no, and will until a person has done something
    """
    from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus, InvalidURI
    from websockets.sync.client import connect

    headers = {"Authorization": f"Bearer {token()}"}
    try:
        with connect(url, additional_headers=headers, close_timeout=CLOSE_SECONDS) as connection:
            yield RosbridgeConnection(connection)
    except InvalidURI as error:
        raise Refused(f"{url} is no address of a robot: {error}") from None
    except InvalidStatus as error:
        code = error.response.status_code
        words = f"the relay at {url} answers {code}{_meaning(code)}"
        raise (Lost if code in AGAIN else Refused)(words) from None
    except ConnectionClosed as error:
        final = error.rcvd is not None and error.rcvd.code in FINAL
        words = (error.rcvd.reason if error.rcvd is not None else "") or str(error)
        raise (Refused if final else Lost)(f"the connection to {url} is lost: {words}") from None
    except (OSError, InvalidHandshake) as error:
        raise Lost(f"the connection to {url} is lost: {error}") from None


def _meaning(code: int) -> str:
    words = {
        401: "the token is not good, or not any more",
        403: "the token's user has no right on this robot",
        404: "there is no such robot, or no right on it",
    }
    return f": {words[code]}" if code in words else ""


@contextlib.contextmanager
def in_words() -> Iterator[None]:
    """What the way to the robot raises, as what a command says before it ends with 1."""
    try:
        yield
    except (Lost, Refused) as error:
        raise click.ClickException(str(error)) from None
