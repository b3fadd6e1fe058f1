"""Alerts and rules for tests."""

from __future__ import annotations

from typing import Any

from relay_db.queries import AlertRecord, AlertRuleRecord
from relay_server.alerts.schemas import AlertNotice, NotificationMessage

SECRET = "0123456789abcdef"


def alert(id: str = "a1", **other: Any) -> AlertRecord:
    """An alert of an offline robot."""
    made = AlertRecord(
        id, 1, "rover", "default", "offline", "", "error", "nothing comes", 10.0, 10.5, 1, 1, None, None, None
    )
    return made._replace(**other)


def rule(**other: Any) -> AlertRuleRecord:
    """A webhook rule for all alerts."""
    made = AlertRuleRecord(
        7, 3, "ann", "default", "", "*", (), "warning", "webhook", "http://127.0.0.1/hook", SECRET, True, 60.0,
        None, 1.0,
    )  # fmt: skip
    return made._replace(**other)


def message(*notices: AlertNotice, left_out: int = 0) -> NotificationMessage:
    """A message with one notice by default."""
    return NotificationMessage("d1", notices or (AlertNotice(alert(), "begun"),), left_out)
