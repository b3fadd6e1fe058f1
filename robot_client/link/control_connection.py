"""The control connection: dials the relay, registers the robot, and dials again whenever the link is lost."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from twisted.internet.defer import Deferred
from twisted.internet.protocol import Factory
from twisted.logger import Logger

from relay_protocol import link
from relay_protocol.errors import SwitchboardError
from robot_client.link.addresses import RelayAddresses
from robot_client.link.backoff import Backoff
from robot_client.link.links import (
    ControlLink,
    Event,
    LinkEnded,
    MessageReceived,
    Registered,
    RelayRefused,
    WrongRelay,
)
from robot_client.link.tls import explain
from robot_client.link.transport import LinkLost, LinkProtocol
from robot_client.motion.command_age import LINK_PROOF_EVERY
from robot_client.periodic import run_safely
from robot_client.twisted_types import DelayedCall, DialEndpoint, ReactorClock

LOG_SAME_EVERY = 60.0
"""Seconds between two log lines with the same reason for a lost link."""

Dial = Callable[[str], DialEndpoint]
"""Returns the endpoint of an address; for an empty address, that of the control link."""


class ConnectionListener(Protocol):
    """Receives the events of the control link."""

    def on_link_up(self, welcome: link.Welcome) -> None:
        """The relay has registered the robot."""

    def on_message(self, message: link.Message) -> None:
        """The relay sent a message."""

    def on_link_lost(self, reason: str, proved: int | None) -> None:
        """A registered link was lost.

        :param proved: last value of :attr:`ControlConnection.answered`
        """


class ControlConnection:
    """Dials whenever there is no control link, until :meth:`stop`. Set :attr:`listener` before :meth:`start`.

    :param build_link: builds a new link for each attempt
    :param robot: name of the robot, for the log
    :param addresses: of relays; the next one is dialled after each failure
    """

    def __init__(
        self,
        *,
        dial: Dial,
        build_link: Callable[[], ControlLink],
        clock: ReactorClock,
        backoff: Backoff,
        robot: str,
        addresses: RelayAddresses,
    ) -> None:
        self.listener: ConnectionListener
        self._dial = dial
        self._build_link = build_link
        self._clock = clock
        self._backoff = backoff
        self._robot = robot
        self._addresses = addresses
        self._protocol: LinkProtocol | None = None
        self._pings_often = False
        self._registered_at: float | None = None
        self._retry: DelayedCall | None = None
        self._attempt: Deferred[Any] | None = None
        self._stopped: Deferred[None] | None = None
        self._logged_reason = ""
        self._logged_at = -LOG_SAME_EVERY
        self._log = Logger("link")

    def start(self) -> None:
        """Dial now."""
        self._retry = None
        factory = Factory.forProtocol(self._build_protocol)
        factory.noisy = False
        try:
            self._attempt = self._dial("").connect(factory)
        except SwitchboardError as error:
            # A setting that was valid before, such as a CA file that was removed.
            self.on_lost(error)
            return
        self._attempt.addErrback(lambda failure: self.on_lost(LinkLost(explain(failure))))

    def stop(self, reason: str) -> Deferred[None]:
        """Send ``bye`` and stop dialling; fires when the connection is closed."""
        done: Deferred[None] = Deferred()
        self._stopped = done
        if self._retry is not None:
            self._retry.cancel()
            self._retry = None
        if self._protocol is not None:
            self.send(link.Bye(reason=reason))
            self._protocol.end(LinkLost(reason), gently=True)
        elif self._attempt is not None:
            self._attempt.cancel()
        else:
            done.callback(None)
        return done

    @property
    def registered(self) -> bool:
        """Whether the robot is registered now."""
        return self._registered_at is not None

    @property
    def round_trip(self) -> float | None:
        """Latest round trip to the relay, seconds."""
        measured = self._protocol.link.offset.round_trip if self._protocol else None
        return measured / 1e9 if measured is not None else None

    @property
    def answered(self) -> int | None:
        """When the latest ping that the relay has answered was sent, nanoseconds of the link's clock."""
        return self._protocol.link.offset.answered if self._protocol and self.registered else None

    def ping_often(self, often: bool) -> None:
        """Ping at the interval that motion needs as proof of the link, or at the agreed heartbeat."""
        if often == self._pings_often:
            return
        self._pings_often = often
        if self._protocol is not None and self.registered:
            self._set_ping_interval(self._protocol)

    def _set_ping_interval(self, protocol: LinkProtocol) -> None:
        heartbeat = protocol.link.heartbeat
        protocol.ping_every(min(LINK_PROOF_EVERY, heartbeat) if self._pings_often else heartbeat)

    def send(self, message: link.Message) -> None:
        """Send a message; it is discarded if the robot is not registered."""
        if self._protocol is not None and self.registered:
            self._protocol.link.send(message)
            self._protocol.flush()

    def on_event(self, event: Event) -> None:
        """Handle an event of the link."""
        if isinstance(event, Registered):
            self._registered_at = self._clock.seconds()
            self._logged_reason = ""
            self._log.info("registered as {robot} at {relay}", robot=self._robot, relay=event.relay)
            if self._pings_often and self._protocol is not None:
                self._set_ping_interval(self._protocol)
            self.listener.on_link_up(event.welcome)
        elif isinstance(event, MessageReceived):
            self.listener.on_message(event.message)
        elif isinstance(event, LinkEnded) and self._protocol is not None:
            self._protocol.end(LinkLost(f"the relay closed the link: {event.reason}"), gently=True)

    def on_lost(self, reason: SwitchboardError) -> None:
        """Inform the listener, then wait and dial again."""
        proved = self.answered
        self._protocol = self._attempt = None
        lasted = 0.0
        if self._registered_at is not None:
            lasted = self._clock.seconds() - self._registered_at
            self._registered_at = None
            failed = "the loss of the link could not be handled completely"
            run_safely(self._log, failed, self.listener.on_link_lost, str(reason), proved)
        if self._stopped is not None:
            self._stopped.callback(None)
            return
        delay = self._delay(reason, lasted)
        lost = self._addresses.current
        self._addresses.advance()
        self._log_loss(str(reason), lost, delay)
        self._retry = self._clock.callLater(delay, self.start)

    def on_pause(self) -> None:
        """Do nothing: the few messages of the control link can wait in the transport."""

    def on_resume(self) -> None:
        """Do nothing, see :meth:`on_pause`."""

    def _build_protocol(self) -> LinkProtocol:
        protocol = LinkProtocol(self._build_link(), lambda _: self, self._clock)
        self._protocol = protocol
        return protocol

    def _delay(self, reason: SwitchboardError, lasted: float) -> float:
        if isinstance(reason, RelayRefused):
            return self._backoff.after_refusal(reason.retry_after)
        if isinstance(reason, WrongRelay):
            return self._backoff.after_refusal(None)
        return self._backoff.after_loss(lasted)

    def _log_loss(self, reason: str, lost: str, delay: float) -> None:
        now = self._clock.seconds()
        if reason == self._logged_reason and now - self._logged_at < LOG_SAME_EVERY:
            return
        self._logged_reason, self._logged_at = reason, now
        self._log.warn(
            "no link to the relay at {address}: {reason}; dialling again, first in {delay:.1f} s",
            address=lost,
            reason=reason,
            delay=delay,
        )
