"""A websocket in memory, as the applications use one."""

from __future__ import annotations

import json
from typing import Any


class Socket:
    """Stores sent messages, and returns prepared ones.

    :ivar reached: whether the robot answers pings
    """

    def __init__(self) -> None:
        self.reached = False
        self.sent: list[dict[str, Any]] = []
        self.coming: list[dict[str, Any]] = []

    def send(self, text: str) -> None:
        """Stores a message of a program."""
        self.sent.append(json.loads(text))
        if self.reached and self.sent[-1].get("service") == "/relay/ping":
            self.answer()

    def recv(self, timeout: float) -> str:
        """The next prepared message."""
        if not self.coming:
            raise TimeoutError
        return json.dumps(self.coming.pop(0))

    def asked(self, service: str = "") -> list[dict[str, Any]]:
        """Calls, of a service or all."""
        return [
            each for each in self.sent if each["op"] == "call_service" and service in ("", each["service"])
        ]

    def answer(self, success: bool = True, result: bool = True, service: str = "") -> None:
        """Answers the latest call."""
        values: Any = {"success": success, "message": "" if success else "no"} if result else "you may not"
        number = self.asked(service)[-1]["id"]
        self.coming.append({"op": "service_response", "id": number, "result": result, "values": values})

    def driven(self) -> list[tuple[float, float]]:
        """Speed and turn of the commands."""
        return [
            (each["msg"]["linear"]["x"], each["msg"]["angular"]["z"])
            for each in self.sent
            if each["op"] == "publish"
        ]

    def control(self, holder: str = "", stopped: str = "", you: bool = False, limits: Any = None) -> None:
        """Prepares a message about control."""
        reported = {
            "holder": {"user": holder, "you": you} if holder else None,
            "request": None,
            "stopped": {"by": stopped} if stopped else None,
            "limits": limits or {},
            "you": {"may_control": True},
        }
        self.coming.append({"op": "publish", "topic": "/relay/control", "msg": reported})

    def status(self, level: str) -> None:
        """Prepares a status with this level."""
        self.coming.append({"op": "publish", "topic": "/relay/status", "msg": {"level": level}})
