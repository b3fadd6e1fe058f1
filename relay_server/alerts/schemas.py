"""Alerts, and the rules by which users are notified, as the HTTP API and webhooks send them (SPEC 1.10).

One message of a rule: all alerts that are sent together, as JSON for webhooks and as text for people.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Self

import msgspec
from msgspec import UNSET, UnsetType

from relay_db.queries import AlertRecord
from relay_protocol.errors import SwitchboardError
from relay_protocol.text import escape_unprintable
from relay_server.alerts import types as kinds
from relay_server.alerts.rules import Quiet
from relay_server.alerts.types import AlertEvent

Severity = Literal["info", "warning", "error"]


class Acknowledgement(msgspec.Struct):
    """The user who looks after an alert, since when (Unix seconds)."""

    by: str | None
    at: float


class AlertSummary(msgspec.Struct):
    """The fields of an alert that webhooks and users get; see :class:`AlertInfo`."""

    id: str
    robot: str
    kind: str
    about: str
    level: Severity
    text: str
    first: float
    last: float
    count: int
    state: Literal["open", "over"]
    over: float | None
    acknowledged: Acknowledgement | None

    @classmethod
    def of(cls, alert: AlertRecord, **more: Any) -> Self:
        """The alert of a record; ``more`` are the fields that a subclass adds."""
        return cls(
            id=alert.id,
            robot=alert.robot,
            kind=alert.kind,
            about=alert.about,
            # The table takes no other levels.
            level=alert.level,  # type: ignore[arg-type]
            text=alert.text,
            first=alert.first,
            last=alert.last,
            count=alert.report_count,
            state="open" if alert.over is None else "over",
            over=alert.over,
            acknowledged=None if alert.ack_at is None else Acknowledgement(alert.ack_by, alert.ack_at),
            **more,
        )


class AlertInfo(AlertSummary):
    """An alert as one user sees it.

    :param about: the part of the robot
    :param first: Unix seconds of the first report
    :param last: Unix seconds of the latest report
    :param over: Unix seconds of the end; null while it is open
    :param notification_count: how often users were notified that it began, came back, became worse or ended
    :param notify: whether the user's rules for the portal want it shown
    """

    may_acknowledge: bool
    notification_count: int
    notify: bool


class AlertNews(AlertSummary):
    """An alert in a webhook's message.

    :param event: ``begun``, ``worse``, ``over`` or ``test``
    """

    event: str


class WebhookMessage(msgspec.Struct):
    """The body of a webhook's request.

    :param relay: the relay's name
    :param delivery: id of the message, the same in each try
    :param rule: number of the rule
    :param left_out: alerts for which there was no room
    """

    relay: str
    delivery: str
    rule: int
    alerts: list[AlertNews]
    left_out: int


class AlertPage(msgspec.Struct):
    """A page of alerts, the latest first.

    :param next: the ``before`` of the next page; null on the last one
    """

    alerts: list[AlertInfo]
    next: str | None


class AlertsUpdate(msgspec.Struct):
    """The live update ``alerts``: open alerts, and those that ended recently, the latest first."""

    alerts: list[AlertInfo]


class RuleStatus(msgspec.Struct):
    """Counts of the messages of a rule.

    :param reason: why the latest failure failed
    :param last: Unix seconds of the latest message that arrived
    """

    sent: int = 0
    failed: int = 0
    reason: str = ""
    last: float | None = None


class RuleInfo(msgspec.Struct):
    """A rule by which the caller is notified of alerts.

    :param url: its scheme and host only
    :param notify_end: whether ends of alerts are sent too
    :param group_s: least seconds between two messages
    :param secret: only in the answer to the request that added the rule, if the relay made the secret
    """

    id: int
    label: str
    robots: str
    kinds: list[str]
    level: str
    channel: str
    url: str
    notify_end: bool
    group_s: float
    quiet: Quiet | None
    status: RuleStatus
    secret: str | UnsetType = UNSET


class RuleList(msgspec.Struct):
    """The caller's rules, and the values that a rule may have here."""

    rules: list[RuleInfo]
    kinds: list[str]
    levels: list[str]
    channels: list[str]
    schemes: list[str]


class RuleTest(msgspec.Struct):
    """Whether a test message arrived, else why not."""

    ok: bool
    reason: str


MAX_LINES = 20
"""Alerts that the text of a message has lines for; further ones are counted."""


class AlertNotice(NamedTuple):
    """An alert as it was when the event happened.

    :param event: ``begun``, ``worse``, ``over`` or ``test``
    """

    alert: AlertRecord
    event: str

    @property
    def ends(self) -> bool:
        """Whether the alert is over."""
        return self.event == AlertEvent.OVER.value

    @property
    def alarms(self) -> bool:
        """Whether this is an error that lasts: it must not wait."""
        return not self.ends and kinds.severity(self.alert.level) >= kinds.severity("error")


@dataclass(frozen=True)
class NotificationMessage:
    """One message.

    :param delivery: its id, the same in each try
    :param left_out: notices for which there was no room
    """

    delivery: str
    notices: Sequence[AlertNotice]
    left_out: int = 0

    @property
    def title(self) -> str:
        """For a subject or a heading."""
        if len(self.notices) == 1:
            return headline(self.notices[0])
        return f"{len(self.notices) + self.left_out} alerts"

    @property
    def text(self) -> str:
        """A line for each alert, for :data:`MAX_LINES` at most."""
        lines = [
            f"{headline(each)}: {escape_unprintable(each.alert.text)}" for each in self.notices[:MAX_LINES]
        ]
        rest = len(self.notices) - len(lines) + self.left_out
        return "\n".join([*lines, *([f"and {rest} more"] if rest else [])])

    def webhook(self, relay: str, rule: int) -> WebhookMessage:
        """The body of a webhook's request.

        :param relay: the relay's name
        :param rule: number of the rule
        """
        alerts = [AlertNews.of(each.alert, event=each.event) for each in self.notices]
        return WebhookMessage(relay, self.delivery, rule, alerts, self.left_out)


class Undelivered(SwitchboardError):
    """A message did not arrive. The text says why, without anything secret.

    :param again: whether it may arrive later
    """

    code = "undelivered"

    def __init__(self, reason: str, *, again: bool) -> None:
        super().__init__(reason)
        self.again = again


def headline(notice: AlertNotice) -> str:
    """Robot, level, kind and part of an alert, and whether it is over, as one line."""
    alert = notice.alert
    about = f" {alert.about}" if alert.about else ""
    over = " is over" if notice.ends else ""
    return escape_unprintable(f"{alert.robot}: {alert.level}: {alert.kind}{about}{over}")
