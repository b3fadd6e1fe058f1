"""A relay with two realms, each with a robot ``mobile`` and an administrator ``root``, who is asked over HTTP."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from switchboard_http import Answer, ask
from switchboard_relay import Relay
from switchboard_small_robot import SmallRobot

LABS = ("lab1", "lab2")
REALM = "/api/v1/realm"


class TwoRealms:
    """See the module's text.

    :ivar tokens: by full names
    """

    def __init__(self, folder: Path) -> None:
        # Who tries all addresses there are asks more than a user may.
        self.relay = Relay(folder, "--requests-per-second", "0")
        self.tokens: dict[str, str] = {}
        self.robots: list[SmallRobot] = []
        for lab in LABS:
            self.relay.cli("realm", "add", lab)
            self.tokens[f"root@{lab}"] = self.relay.user(f"root@{lab}", admin=True)
            robot = SmallRobot(self.relay, f"mobile@{lab}", {"/where": lambda *_: {"message": "here"}})
            self.robots.append(robot.comes())

    def ask(self, who: str, method: str, path: str = "", body: Any = None, **headers: str) -> Answer:
        """What somebody is answered about his realm.

        :param headers: with ``_`` for ``-``
        """
        sent = {name.replace("_", "-"): value for name, value in headers.items()}
        port, token = self.relay.http_port, self.tokens[who] if who else ""
        return ask(port, method, f"{REALM}{path}", body, headers=sent, token=token)

    def do(self, method: str, path: str, body: Any = None, who: str = "root@lab1") -> Any:
        """Something that has to succeed."""
        answer = self.ask(who, method, path, body)
        assert answer.status < 300, answer.body
        return answer.json if answer.body else None

    def log(self) -> list[dict[str, Any]]:
        """The audit log."""
        told: list[dict[str, Any]] = self.relay.cli("audit", "list", "--limit", "1000")
        return told

    def stop(self) -> None:
        """End everything."""
        for each in self.robots:
            each.goes()
        self.relay.stop()
