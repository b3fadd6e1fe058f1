"""Single HTTP requests to a relay."""

from __future__ import annotations

import http.client
import json
import ssl
from typing import Any

ROBOT_BODIES: dict[str, Any] = {
    "topics/{name}": {"value": {"data": "x"}},
    "params/{name}": {"value": 1},
    "suppress": {"resource": "/mode", "ms": 100},
    "inhibit": {"resource": "/mode", "ms": 100},
    "hold": {"resource": "/mode", "ms": 100},
    "recordings": {"topics": ["/mode"]},
}
"""What is sent to the addresses of a robot, by their ends, where it is not an empty object."""


class Answer:
    """The answer to an HTTP request."""

    def __init__(self, response: http.client.HTTPResponse) -> None:
        self.status = response.status
        self.headers = response.headers
        self.body = response.read()

    @property
    def json(self) -> Any:
        """The decoded body."""
        return json.loads(self.body)

    @property
    def cookie(self) -> str:
        """The cookie it sets, in the form of the next request."""
        return str(self.headers["Set-Cookie"]).partition(";")[0]


def ask(
    port: int,
    method: str,
    path: str,
    body: Any = None,
    *,
    headers: dict[str, str] | None = None,
    token: str = "",
    tls: ssl.SSLContext | None = None,
) -> Answer:
    """An HTTP request on a new connection.

    :param body: sent as JSON, bytes unchanged
    :param token: an access token, sent as Bearer
    """
    sent = dict(headers or {})
    raw = body if isinstance(body, bytes) or body is None else json.dumps(body).encode()
    if raw is not None and raw is not body:
        sent.setdefault("Content-Type", "application/json")
    if token:
        sent["Authorization"] = f"Bearer {token}"
    if tls is None:
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    else:
        connection = http.client.HTTPSConnection("127.0.0.1", port, timeout=30, context=tls)
    try:
        connection.request(method, path, raw, sent)
        return Answer(connection.getresponse())
    finally:
        connection.close()


def log_in(port: int, user: str, password: str) -> str:
    """The cookie of a new session."""
    headers = {"Origin": f"http://127.0.0.1:{port}"}
    answer = ask(port, "POST", "/api/v1/session", {"user": user, "password": password}, headers=headers)
    assert answer.status == 200, answer.body
    return answer.cookie
