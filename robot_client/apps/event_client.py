"""Events of the relay's short-term memory, asked and written over HTTP (SPEC 1.14), and messages to a robot."""

from __future__ import annotations

import contextlib
import http.client
import json
import ssl
import uuid
from collections.abc import Iterator
from typing import Any, NamedTuple
from urllib.parse import quote, urlencode, urlsplit

from robot_client.apps.connection import RETRYABLE_STATUS, Refused, access_token

ANSWER_SECONDS = 5.0
"""How long an answer is waited for."""
MAX_ANSWER_BYTES = 4_000_000
"""Bytes of an answer that are read."""
MAX_PAGES = 100
MAX_EVENTS = 10_000
"""Pages of events that are asked for, many of which may be short or empty, and events that are taken."""


class EventLogUnavailable(Exception):
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


def robot_url(url: str) -> RobotUrl:
    """The same robot's addresses of HTTP.

    :param url: ``ws://relay/robots/NAME`` or ``wss://…``
    :raises Refused: it is something else
    """
    parts = urlsplit(url)
    prefix, found, robot = parts.path.rpartition("/robots/")
    robot = robot.strip("/")
    if parts.scheme not in ("ws", "wss") or not parts.netloc or not found or not robot or "/" in robot:
        raise Refused(f"{url} is not the address of a robot: write ws://relay/robots/NAME")
    return RobotUrl(parts.netloc.rpartition("@")[2], parts.scheme == "wss", prefix, robot)


class EventClient:
    """Events about one robot.

    :param url: ``ws://relay/robots/NAME``
    :raises Refused: it is something else
    """

    def __init__(self, url: str) -> None:
        self._robot = robot_url(url)

    def events(self, kind: str, last: float, **data: str) -> list[dict[str, Any]]:
        """Events about the robot, the newest first.

        :param kind: exactly this, or with ``*`` at its end what begins so
        :param last: seconds
        :param data: fields of the events' data, and their text
        :raises EventLogUnavailable: not all of them are known now
        :raises Refused: the relay refuses, and a retry does not help
        """
        query = {"kind": kind, "robot": self._robot.robot, "last": f"{last:g}", "limit": "1000"}
        query |= {f"data.{name}": text for name, text in data.items()}
        found: list[dict[str, Any]] = []
        for _ in range(MAX_PAGES):
            answer = self._request("GET", f"/api/v1/events?{urlencode(query)}")
            with _malformed_as_no_answer():
                found += [dict(each) for each in answer["events"]]
                if answer["next"] is None:
                    return found
                query["after"] = str(answer["next"])
            if len(found) >= MAX_EVENTS:
                break
        raise EventLogUnavailable(
            f"there are more than {MAX_PAGES} pages of events, or {MAX_EVENTS:,} events"
        )

    def write(self, kind: str, **data: str) -> int:
        """Keep an event about the robot; its number, by which later ones have greater ones.

        :raises EventLogUnavailable: it may have been kept
        :raises Refused: the relay refuses, and a retry does not help
        """
        event = {"kind": kind, "robot": self._robot.robot, "data": data}
        answer = self._request("POST", "/api/v1/events", event)
        with _malformed_as_no_answer():
            return int(answer["id"])

    def publish(self, topic: str, message: dict[str, Any], kind: str) -> None:
        """Have a message published by the robot, once.

        :param kind: its type
        :raises EventLogUnavailable: it may have been published
        :raises Refused: the relay refuses, and a retry does not help
        """
        path = f"/api/v1/robots/{quote(self._robot.robot, safe='')}/topics/{quote(topic.strip('/'))}"
        self._request("POST", path, {"value": message, "type": kind}, {"Idempotency-Key": uuid.uuid4().hex})

    def _request(
        self, method: str, path: str, body: dict[str, Any] | None = None, more: dict[str, str] | None = None
    ) -> dict[str, Any]:
        headers = {"Authorization": f"Bearer {access_token()}", "Accept": "application/json", **(more or {})}
        sent = None
        if body is not None:
            sent = json.dumps(body).encode()
            headers["Content-Type"] = "application/json"
        connection = self._connection()
        try:
            connection.request(method, self._robot.prefix + path, sent, headers)
            response = connection.getresponse()
            text = response.read(MAX_ANSWER_BYTES)
        except (OSError, http.client.HTTPException) as error:
            raise EventLogUnavailable(f"the relay does not answer: {error or type(error).__name__}") from None
        finally:
            connection.close()
        if response.status >= 400:
            words = f"the relay answers {response.status}: {_detail(text)}"
            raise (EventLogUnavailable if response.status in (*RETRYABLE_STATUS, 409) else Refused)(words)
        with _malformed_as_no_answer():
            return dict(json.loads(text)) if text else {}

    def _connection(self) -> http.client.HTTPConnection:
        if self._robot.secure:
            return http.client.HTTPSConnection(
                self._robot.host, timeout=ANSWER_SECONDS, context=ssl.create_default_context()
            )
        return http.client.HTTPConnection(self._robot.host, timeout=ANSWER_SECONDS)


@contextlib.contextmanager
def _malformed_as_no_answer() -> Iterator[None]:
    """An answer that is none of the relay's, in words."""
    try:
        yield
    except (ValueError, TypeError, KeyError):
        raise EventLogUnavailable("what answers is no relay") from None


def _detail(text: bytes) -> str:
    """What problem details (RFC 9457) say."""
    try:
        problem = json.loads(text)
        return str(problem.get("detail") or problem.get("title") or "no reason given")[:300]
    except (ValueError, AttributeError):
        return "no reason given"
