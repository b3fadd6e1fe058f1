"""Alerts: what people should know of a robot though nobody looks, and how they are told."""

from relay_server.alerts.desk import AlertDesk
from relay_server.alerts.house import AlertHouse
from relay_server.alerts.position import Position
from relay_server.alerts.rules import Ask

__all__ = ["AlertDesk", "AlertHouse", "Ask", "Position"]
