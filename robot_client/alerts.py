"""Alerts for people: raised by parts of the daemon, sent to the relay until it has received them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import NamedTuple, Protocol

from relay_protocol import link

STARTUP_NS = 5_000_000_000
"""Nanoseconds after its start in which a daemon finds faults; diagnostics come once a second. Only then does it notify
the relay that its report is complete."""

MAX_ALERTS = 300
"""Most active alerts that are remembered, and most messages that may have to be sent again."""

MODULE = "module"
"""Kind of alerts about the daemon's own parts."""

CONTROL = "control"
"""Kind of alerts about control. Without a part it is a single event, such as a loss of control during
motion. It never ends, and is not repeated once it has arrived."""


class OnAlert(Protocol):
    """A receiver of alerts."""

    def __call__(self, level: str, text: str, kind: str = "", about: str = "", over: bool = False) -> None:
        """Report a fault or an event to people (SPEC 2.4, ``alert``).

        :param level: ``info``, ``warning`` or ``error``
        :param kind: ``module``, ``diagnostics``, …
        :param about: the part of the robot
        :param over: whether the alert of this kind and part has ended
        """


def ignore_alert(level: str, text: str, kind: str = "", about: str = "", over: bool = False) -> None:
    """An :class:`OnAlert` that does nothing."""


class AlertCondition:
    """One condition that raises an alert when it begins or changes, and ends it when it is over.

    :param kind: as for :class:`OnAlert`
    :param about: the part of the robot
    """

    def __init__(self, alert: OnAlert, kind: str, about: str) -> None:
        self.text = ""
        """Text of the alert while the condition lasts, else empty."""
        self._alert = alert
        self._kind = kind
        self._about = about

    def update(self, text: str, resolved: str) -> None:
        """Set the condition; an alert is sent only if it changed.

        :param text: describes the fault; empty if there is none
        :param resolved: text to send when the condition ends
        """
        before, self.text = self.text, text
        if text and text != before:
            self._alert("error", text, self._kind, self._about)
        elif before and not text:
            self._alert("info", resolved, self._kind, self._about, over=True)


class AlertLink(Protocol):
    """The control link, as far as alerts need it."""

    @property
    def registered(self) -> bool:
        """Whether the robot is registered now."""

    @property
    def answered(self) -> int | None:
        """When the latest ping that the relay has answered was sent, nanoseconds."""

    def send(self, message: link.Message) -> None:
        """Send a message."""


class _UnconfirmedAlert(NamedTuple):
    """An alert that may not have arrived; ``sent_at`` in nanoseconds, ``None`` if it was not sent yet."""

    message: link.Alert
    sent_at: int | None


class AlertReporter:
    """Sends alerts to the relay. At each registration it sends those again that are active or may not have arrived.

    A dead link is noticed only after seconds. An alert has arrived if a ping that was sent after it was
    answered.

    :param now: the clock of :attr:`AlertLink.answered`, nanoseconds
    """

    def __init__(self, control_link: AlertLink, now: Callable[[], int]) -> None:
        self._link = control_link
        self._now = now
        self._active: dict[tuple[str, str], link.Alert] = {}
        self._unconfirmed: deque[_UnconfirmedAlert] = deque(maxlen=MAX_ALERTS)
        self._started = now()
        self._completion_due = False
        """Whether the relay is still to be notified, for this registration, that the report is complete."""
        self._remembers_all = True
        """Whether all active alerts are in :attr:`_active`."""

    def report(self, message: link.Alert) -> None:
        """Send an alert now, or at the next registration if there is no link."""
        self._forget_confirmed()
        if message.kind and (message.kind, message.about) != (CONTROL, ""):
            self._remember(message)
        registered = self._link.registered
        self._unconfirmed.append(_UnconfirmedAlert(message, self._now() if registered else None))
        if registered:
            self._link.send(message)

    def flush(self) -> None:
        """Forget alerts that have arrived, and end the report if that is due; to be called every few seconds."""
        self._forget_confirmed()
        self._send_completion()

    def registered(self) -> None:
        """Report everything again, since the relay may be another one (SPEC 2.4,
        ``active_alerts_sent``)."""
        unconfirmed = [each.message for each in self._unconfirmed]
        active = [each for each in self._active.values() if each not in unconfirmed]
        self._unconfirmed.clear()
        for message in (*active, *unconfirmed):
            self._unconfirmed.append(_UnconfirmedAlert(message, self._now()))
            self._link.send(message)
        self._completion_due = self._remembers_all
        self._send_completion()

    def _forget_confirmed(self) -> None:
        answered = self._link.answered
        while answered is not None and self._unconfirmed:
            sent_at = self._unconfirmed[0].sent_at
            if sent_at is None or sent_at >= answered:
                return
            self._unconfirmed.popleft()

    def _send_completion(self) -> None:
        """The relay ends all alerts that were not reported by then, so not before :data:`STARTUP_NS`."""
        started = self._now() - self._started >= STARTUP_NS
        if self._completion_due and started and self._link.registered:
            self._completion_due = False
            self._link.send(link.ActiveAlertsSent())

    def _remember(self, message: link.Alert) -> None:
        key = (message.kind, message.about)
        if message.over:
            self._active.pop(key, None)
            self._remembers_all = self._remembers_all or not self._active
            # After the end has been sent, the beginning must not be sent again.
            remaining = [
                each
                for each in self._unconfirmed
                if each.sent_at is None or (each.message.kind, each.message.about) != key
            ]
            self._unconfirmed = deque(remaining, MAX_ALERTS)
        elif key in self._active or len(self._active) < MAX_ALERTS:
            self._active[key] = message
        else:
            self._remembers_all = False
