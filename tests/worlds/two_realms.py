"""A relay with two realms, each with a robot ``mobile`` and an administrator ``root``, by HTTP."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tests.worlds.http_requests import Answer, ask
from tests.worlds.relay_process import Relay
from tests.worlds.small_robot import SmallRobot

LABS = ("lab1", "lab2")
REALM = "/api/v1/realm"


class TwoRealms:
    """See the module's docstring.

    :ivar tokens: by full names
    """

    def __init__(self, folder: Path) -> None:
        # Trying all addresses exceeds a user's rate limit.
        self.relay = Relay(folder, "--requests-per-second", "0")
        self.tokens: dict[str, str] = {}
        self.robots: list[SmallRobot] = []
        for lab in LABS:
            self.relay.cli("realm", "add", lab)
            self.tokens[f"root@{lab}"] = self.relay.user(f"root@{lab}", admin=True)
            robot = SmallRobot(self.relay, f"mobile@{lab}", {"/where": lambda *_: {"message": "here"}})
            self.robots.append(robot.comes())

    def ask(self, who: str, method: str, path: str = "", body: Any = None, **headers: str) -> Answer:
        """The answer to a user's request about their realm.

        :param headers: with ``_`` for ``-``
        """
        sent = {name.replace("_", "-"): value for name, value in headers.items()}
        port, token = self.relay.http_port, self.tokens[who] if who else ""
        return ask(port, method, f"{REALM}{path}", body, headers=sent, token=token)

    def do(self, method: str, path: str, body: Any = None, who: str = "root@lab1") -> Any:
        """A request that must succeed."""
        answer = self.ask(who, method, path, body)
        assert answer.status < 300, answer.body
        return answer.json if answer.body else None

    def log(self) -> list[dict[str, Any]]:
        """The audit log."""
        reported: list[dict[str, Any]] = self.relay.cli("audit", "list", "--limit", "1000")
        return reported

    def stop(self) -> None:
        for each in self.robots:
            each.goes()
        self.relay.stop()
