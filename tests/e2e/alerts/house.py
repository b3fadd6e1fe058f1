"""A relay that sends alerts to receivers of the tests' own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from switchboard_fake_robot import FakeRobot
from switchboard_hook import Hook
from switchboard_http import ask
from switchboard_relay import Relay

from relay_protocol import identity


@dataclass
class House:
    """A relay that may send to this machine, with a robot of the tests' own and people."""

    relay: Relay
    hook: Hook
    admin: str
    viewer: str
    keys: dict[str, bytes]

    def ask(self, method: str, path: str, body: Any = None, *, token: str = "") -> Any:
        """One request about alerts; the answer must be a good one."""
        answer = ask(self.relay.http_port, method, f"/api/v1/alerts{path}", body, token=token or self.admin)
        assert answer.status < 300, answer.body
        return answer.json if answer.body else None

    def alerts(self, token: str = "", query: str = "?open=true") -> list[dict[str, Any]]:
        """What somebody sees."""
        return list(self.ask("GET", query, token=token)["alerts"])

    def modules(self, robot: str) -> list[dict[str, Any]]:
        """What lasts of a robot's modules."""
        return [each for each in self.alerts(query=f"?robot={robot}&open=true") if each["kind"] == "module"]

    def rule(self, **fields: Any) -> dict[str, Any]:
        """A webhook of the administrator's."""
        return dict(
            self.ask("POST", "/rules", {"channel": "webhook", "url": self.hook.url, "group_s": 5, **fields})
        )

    def robot(self, name: str) -> FakeRobot:
        """A robot that says what the test wants, registered."""
        if name not in self.keys:
            self.keys[name] = identity.generate_key()
            code = self.relay.cli("robot", "add", name)["enrolment_code"]
            with FakeRobot(self.relay.robots_port) as robot:
                assert robot.enroll(name, code, self.keys[name])["op"] == "enrolled"
            self.relay.cli("right", "grant", "viewer", name, "viewer")
        robot = FakeRobot(self.relay.robots_port)
        assert robot.register(name, self.keys[name])["op"] == "welcome"
        return robot
