"""A relay that sends alerts to the tests' own receivers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from relay_protocol import identity
from tests.worlds.fake_robot import FakeRobot
from tests.worlds.http_requests import ask
from tests.worlds.relay_process import Relay
from tests.worlds.webhook_server import WebhookServer


@dataclass
class AlertWorld:
    """A relay that may send to this machine, with the tests' own robot and users."""

    relay: Relay
    webhook_receiver: WebhookServer
    admin: str
    viewer: str
    keys: dict[str, bytes]

    def ask(self, method: str, path: str, body: Any = None, *, token: str = "") -> Any:
        """A request about alerts, which must succeed."""
        answer = ask(self.relay.http_port, method, f"/api/v1/alerts{path}", body, token=token or self.admin)
        assert answer.status < 300, answer.body
        return answer.json if answer.body else None

    def alerts(self, token: str = "", query: str = "?open=true") -> list[dict[str, Any]]:
        """Alerts that a user sees."""
        return list(self.ask("GET", query, token=token)["alerts"])

    def modules(self, robot: str) -> list[dict[str, Any]]:
        """Open alerts of a robot's modules."""
        return [each for each in self.alerts(query=f"?robot={robot}&open=true") if each["kind"] == "module"]

    def rule(self, **fields: Any) -> dict[str, Any]:
        """A webhook rule of the administrator."""
        return dict(
            self.ask(
                "POST",
                "/rules",
                {"channel": "webhook", "url": self.webhook_receiver.url, "group_s": 5, **fields},
            )
        )

    def robot(self, name: str) -> FakeRobot:
        """A registered robot with messages of the test."""
        if name not in self.keys:
            self.keys[name] = identity.generate_key()
            code = self.relay.cli("robot", "add", name)["enrolment_code"]
            with FakeRobot(self.relay.robots_port) as robot:
                assert robot.enroll(name, code, self.keys[name])["op"] == "enrolled"
            self.relay.cli("right", "grant", "viewer", name, "viewer")
        robot = FakeRobot(self.relay.robots_port)
        assert robot.register(name, self.keys[name])["op"] == "welcome"
        return robot
