"""Guesses at a password from many networks."""

from __future__ import annotations

import http.client
import json
import re
from collections import Counter
from contextlib import closing
from pathlib import Path
from typing import Any

from relay_server.auth.account_limit import FAILURES_OF_ACCOUNT
from tests.worlds.relay_process import Relay

NETWORKS, EACH = 15, 10
HOME, ABROAD = "127.0.0.200", "127.0.0.201"
"""Each address of loopback is a network of its own."""


def tries(
    relay: Relay, user: str, password: str, source: str, path: str = "/api/v1/session"
) -> tuple[int, str]:
    """Logs in from an address; returns status and body without the seconds to wait."""
    connection = http.client.HTTPConnection(
        "127.0.0.1", relay.http_port, timeout=60, source_address=(source, 0)
    )
    headers = {"Origin": f"http://127.0.0.1:{relay.http_port}", "Content-Type": "application/json"}
    body = json.dumps({"user": user, "password": password})
    if path == "/oauth/token":
        headers["Content-Type"] = "application/x-www-form-urlencoded"
        body = f"grant_type=password&username={user}&password={password}"
    with closing(connection):
        connection.request("POST", path, body, headers)
        answer = connection.getresponse()
        return answer.status, re.sub(r"\d+ s", "… s", answer.read().decode())


def guesses(relay: Relay, user: str, path: str = "/api/v1/session") -> list[tuple[int, str]]:
    """Answers to 150 guesses from 15 networks."""
    return [
        tries(relay, user, f"guess{number}", f"127.0.0.{network + 2}", path)
        for network in range(NETWORKS)
        for number in range(EACH)
    ]


def test_many_networks_get_no_more_guesses_and_lock_no_user_out(tmp_path: Path) -> None:
    """An unknown account gets the same answers; its owner can log in from known networks, even after a
    restart of the relay.
    """
    relay = Relay(tmp_path)
    try:
        relay.user("ann", "correct horse")
        assert tries(relay, "ann", "correct horse", HOME)[0] == 200
        answers: dict[str, Any] = {user: guesses(relay, user) for user in ("ann", "nobody")}
        assert answers["ann"] == answers["nobody"]
        counted = Counter(status for status, _ in answers["ann"])
        assert counted == {401: FAILURES_OF_ACCOUNT, 429: NETWORKS * EACH - FAILURES_OF_ACCOUNT}
        assert tries(relay, "ann", "wrong", ABROAD, "/oauth/token")[0] == 429
        assert tries(relay, "ann", "correct horse", ABROAD)[0] == 429
        assert tries(relay, "ann", "correct horse", HOME)[0] == 200
        relay.stop()
        relay.start()
        assert Counter(status for status, _ in guesses(relay, "ann", "/oauth/token"))[429] > 100
        assert tries(relay, "ann", "correct horse", ABROAD)[0] == 429
        assert tries(relay, "ann", "wrong", HOME)[0] == 401
        assert tries(relay, "ann", "correct horse", HOME)[0] == 200
    finally:
        relay.stop()
