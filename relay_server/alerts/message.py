"""What a rule tells: one message with all alerts that came together, for programs and for people."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from relay_db.queries import AlertRecord
from relay_protocol.errors import SwitchboardError
from relay_protocol.text import inert
from relay_server.alerts import types as kinds
from relay_server.alerts.types import AlertEvent

SHOWN = 20
"""Alerts a message for people has lines for; the rest is a number."""


class AlertNotice(NamedTuple):
    """An alert as it was when there was news of it.

    :param event: ``begun``, ``worse``, ``over`` or ``test``
    """

    alert: AlertRecord
    event: str

    @property
    def ends(self) -> bool:
        """Whether it tells that the alert is over."""
        return self.event == AlertEvent.OVER.value

    @property
    def alarms(self) -> bool:
        """Whether it tells of an error that nobody should have to wait for."""
        return not self.ends and kinds.severity(self.alert.level) >= kinds.severity("error")


@dataclass(frozen=True)
class NotificationMessage:
    """What goes out at once.

    :param delivery: names it, the same in each try
    :param left_out: notices that found no room
    """

    delivery: str
    notices: Sequence[AlertNotice]
    left_out: int = 0

    @property
    def title(self) -> str:
        """For a subject or a heading."""
        if len(self.notices) == 1:
            return line(self.notices[0])
        return f"{len(self.notices) + self.left_out} alerts"

    @property
    def text(self) -> str:
        """For people, a line each."""
        lines = [f"{line(each)}: {inert(each.alert.text)}" for each in self.notices[:SHOWN]]
        rest = len(self.notices) - len(lines) + self.left_out
        return "\n".join([*lines, *([f"and {rest} more"] if rest else [])])

    def fields(self, relay: str, rule: int) -> dict[str, Any]:
        """For programs (SPEC section 1.10)."""
        return {
            "relay": relay,
            "delivery": self.delivery,
            "rule": rule,
            "alerts": [{**view(each.alert), "event": each.event} for each in self.notices],
            "left_out": self.left_out,
        }


class Undelivered(SwitchboardError):
    """A message did not arrive; the words say why, without anything secret.

    :param again: whether it may arrive later
    """

    code = "undelivered"

    def __init__(self, reason: str, *, again: bool) -> None:
        super().__init__(reason)
        self.again = again


def view(alert: AlertRecord) -> dict[str, Any]:
    """An alert as everybody who may know of it sees it (SPEC section 1.10)."""
    return {
        "id": alert.id,
        "robot": alert.robot,
        "kind": alert.kind,
        "about": alert.about,
        "level": alert.level,
        "text": alert.text,
        "first": alert.first,
        "last": alert.last,
        "count": alert.times,
        "state": "open" if alert.over is None else "over",
        "over": alert.over,
        "acknowledged": None if alert.ack_at is None else {"by": alert.ack_by, "at": alert.ack_at},
    }


def line(notice: AlertNotice) -> str:
    """What has happened in a few words."""
    alert = notice.alert
    about = f" {alert.about}" if alert.about else ""
    over = " is over" if notice.ends else ""
    return inert(f"{alert.robot}: {alert.level}: {alert.kind}{about}{over}")
