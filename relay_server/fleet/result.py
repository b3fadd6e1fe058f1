"""What becomes of an order on one robot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from relay_protocol import jsontext
from relay_protocol.limits import KIB

VALUES_BYTES = 64 * KIB
"""A longer answer of one robot is not passed on."""


@dataclass(frozen=True)
class TaskOutcome:
    """How it ended.

    :param message: why it is not ok, or what the robot says
    :param values: what a service answered
    :param pending: it will be done as soon as the robot is back
    """

    ok: bool
    message: str = ""
    values: Any = None
    pending: bool = False

    @classmethod
    def of_service(cls, values: Any) -> TaskOutcome:
        """What a service answered; one that says itself that it failed has failed."""
        said = values if isinstance(values, dict) else {}
        message = said.get("message")
        ok = said.get("success") is not False
        if len(jsontext.encode(values)) > VALUES_BYTES:
            return cls(ok, f"the answer has more than {VALUES_BYTES // KIB} KiB and is not shown")
        words = message if isinstance(message, str) else ""
        return cls(ok, words if ok else words or "the service says that it has not succeeded", values)


@dataclass(frozen=True)
class TaskResult:
    """How it ended on one robot.

    :param seconds: how long it took
    """

    robot: str
    outcome: TaskOutcome
    seconds: float

    def told(self) -> dict[str, Any]:
        """A line of the answer."""
        return {
            "robot": self.robot,
            "ok": self.outcome.ok,
            "message": self.outcome.message,
            "values": self.outcome.values,
            "pending": self.outcome.pending,
            "seconds": round(self.seconds, 3),
        }
