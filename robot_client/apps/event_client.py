"""Events of the relay's short-term memory, asked and written over HTTP (SPEC section 1.14), and messages to a robot."""

from __future__ import annotations

import contextlib
import http.client
import json
import ssl
import uuid
from collections.abc import Iterator
from typing import Any, NamedTuple
from urllib.parse import quote, urlencode, urlsplit

from robot_client.apps.connection import AGAIN, Refused, token

SECONDS = 5.0
"""How long an answer is waited for."""
LONGEST = 4_000_000
"""Bytes of an answer that are read."""
PAGES = 100
MOST = 10_000
"""Pages of events that are asked for, many of which may be short or empty, and events that are taken."""


class Unanswered(Exception):
    """The relay has not answered, or not as it should; what was asked of it may have been done. The text says why."""


class RobotUrl(NamedTuple):
    """Where a robot is by HTTP.

    :ivar host: of the relay, with its port
    :ivar secure: whether by TLS
    :ivar prefix: of the path, before ``/api``
    :ivar robot: its name
    """

    host: str
    secure: bool
    prefix: str
    robot: str


def place(url: str) -> RobotUrl:
    """The same robot's addresses of HTTP.

    :param url: ``ws://relay/robots/NAME`` or ``wss://…``
    :raises Refused: it is something else
    """
    parts = urlsplit(url)
    prefix, found, robot = parts.path.rpartition("/robots/")
    robot = robot.strip("/")
    if parts.scheme not in ("ws", "wss") or not parts.netloc or not found or not robot or "/" in robot:
        raise Refused(f"{url} is no address of a robot: write ws://relay/robots/NAME")
    return RobotUrl(parts.netloc.rpartition("@")[2], parts.scheme == "wss", prefix, robot)


class EventClient:
    """Events about one robot.

    :param url: ``ws://relay/robots/NAME``
    :raises Refused: it is something else
    """

    def __init__(self, url: str) -> None:
        self._place = place(url)

    def events(self, kind: str, last: float, **data: str) -> list[dict[str, Any]]:
        """Events about the robot, the newest first.

        :param kind: exactly this, or with ``*`` at its end what begins so
        :param last: seconds
        :param data: fields of the events' data, and their text
        :raises Unanswered: not all of them are known now
        :raises Refused: the relay says no, and will until a person has done something
        """
        query = {"kind": kind, "robot": self._place.robot, "last": f"{last:g}", "limit": "1000"}
        query |= {f"data.{name}": text for name, text in data.items()}
        found: list[dict[str, Any]] = []
        for _ in range(PAGES):
            answer = self._ask("GET", f"/api/v1/events?{urlencode(query)}")
            with _as_told():
                found += [dict(each) for each in answer["events"]]
                if answer["next"] is None:
                    return found
                query["after"] = str(answer["next"])
            if len(found) >= MOST:
                break
        raise Unanswered(f"there are more than {PAGES} pages of events, or {MOST:,} events")

    def write(self, kind: str, **data: str) -> int:
        """Keep an event about the robot; its number, by which later ones have greater ones.

        :raises Unanswered: it may have been kept
        :raises Refused: the relay says no, and will until a person has done something
        """
        event = {"kind": kind, "robot": self._place.robot, "data": data}
        answer = self._ask("POST", "/api/v1/events", event)
        with _as_told():
            return int(answer["id"])

    def publish(self, topic: str, message: dict[str, Any], kind: str) -> None:
        """Have a message published by the robot, once.

        :param kind: its type
        :raises Unanswered: it may have been published
        :raises Refused: the relay says no, and will until a person has done something
        """
        path = f"/api/v1/robots/{quote(self._place.robot, safe='')}/topics/{quote(topic.strip('/'))}"
        self._ask("POST", path, {"value": message, "type": kind}, {"Idempotency-Key": uuid.uuid4().hex})

    def _ask(
        self, method: str, path: str, body: dict[str, Any] | None = None, more: dict[str, str] | None = None
    ) -> dict[str, Any]:
        headers = {"Authorization": f"Bearer {token()}", "Accept": "application/json", **(more or {})}
        sent = None
        if body is not None:
            sent = json.dumps(body).encode()
            headers["Content-Type"] = "application/json"
        connection = self._connection()
        try:
            connection.request(method, self._place.prefix + path, sent, headers)
            response = connection.getresponse()
            text = response.read(LONGEST)
        except (OSError, http.client.HTTPException) as error:
            raise Unanswered(f"the relay does not answer: {error or type(error).__name__}") from None
        finally:
            connection.close()
        if response.status >= 400:
            words = f"the relay answers {response.status}: {_detail(text)}"
            raise (Unanswered if response.status in (*AGAIN, 409) else Refused)(words)
        with _as_told():
            return dict(json.loads(text)) if text else {}

    def _connection(self) -> http.client.HTTPConnection:
        if self._place.secure:
            return http.client.HTTPSConnection(
                self._place.host, timeout=SECONDS, context=ssl.create_default_context()
            )
        return http.client.HTTPConnection(self._place.host, timeout=SECONDS)


@contextlib.contextmanager
def _as_told() -> Iterator[None]:
    """An answer that is none of the relay's, in words."""
    try:
        yield
    except (ValueError, TypeError, KeyError):
        raise Unanswered("what answers is no relay") from None


def _detail(text: bytes) -> str:
    """What problem details (RFC 9457) say."""
    try:
        told = json.loads(text)
        return str(told.get("detail") or told.get("title") or "no reason given")[:300]
    except (ValueError, AttributeError):
        return "no reason given"
