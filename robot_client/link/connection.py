"""The control connection, kept for ever: dialled, registered, lost, dialled again."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from twisted.internet.defer import Deferred
from twisted.internet.protocol import Factory
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_protocol import link
from relay_protocol.errors import SwitchboardError
from robot_client.link.backoff import Backoff
from robot_client.link.protocol import (
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
from robot_client.motion.safety import PROOF_EVERY
from robot_client.periodic import run_safely
from robot_client.twisted_types import DelayedCall, DialEndpoint, ReactorClock

LOG_SAME_EVERY = 60.0

Dial = Callable[[str], DialEndpoint]
"""Gives the endpoint of an address; an empty one is the control link's."""


class ConnectionListener(Protocol):
    """Who lives by the control link."""

    def on_registered(self, welcome: link.Welcome) -> None:
        """The relay knows us now."""

    def on_order(self, message: link.Message) -> None:
        """The relay wants something."""

    def on_unregistered(self, reason: str, proved: int | None) -> None:
        """A registered link is gone.

        :param proved: what :attr:`ControlConnection.answered` was at last
        """


class ControlConnection:
    """Dials until told to stop.

    :param make_link: a fresh link for each attempt
    :param address: for the log
    """

    def __init__(
        self,
        dial: Dial,
        make_link: Callable[[], ControlLink],
        clock: ReactorClock,
        backoff: Backoff,
        robot: str,
        address: str,
    ) -> None:
        self.follower: ConnectionListener
        self._dial = dial
        self._make_link = make_link
        self._clock = clock
        self._backoff = backoff
        self._robot = robot
        self._address = address
        self._protocol: LinkProtocol | None = None
        self._often = False
        self._registered_at: float | None = None
        self._retry: DelayedCall | None = None
        self._attempt: Deferred[Any] | None = None
        self._stopped: Deferred[None] | None = None
        self._last_words = ("", -LOG_SAME_EVERY)
        self._log = Logger("link")

    def start(self) -> None:
        """Dial now."""
        self._retry = None
        factory = Factory.forProtocol(self._make_protocol)
        factory.noisy = False
        try:
            self._attempt = self._dial("").connect(factory)
        except (
            SwitchboardError
        ) as error:  # settings that stopped being usable, such as a CA file that is gone
            self.on_lost(error)
            return
        self._attempt.addErrback(self._unreachable)

    def stop(self, reason: str) -> Deferred[None]:
        """Say goodbye and dial no more; fires when the connection is gone."""
        done: Deferred[None] = Deferred()
        self._stopped = done
        if self._retry is not None:
            self._retry.cancel()
            self._retry = None
        if self._protocol is not None:
            self.say(link.Bye(reason=reason))
            self._protocol.end(LinkLost(reason), gently=True)
        elif self._attempt is not None:
            self._attempt.cancel()
        else:
            done.callback(None)
        return done

    @property
    def registered(self) -> bool:
        """Whether the relay knows us now."""
        return self._registered_at is not None

    @property
    def round_trip(self) -> float | None:
        """Round trip to the relay, seconds."""
        measured = self._protocol.link.offset.round_trip if self._protocol else None
        return measured / 1e9 if measured is not None else None

    @property
    def answered(self) -> int | None:
        """When the latest ping that the relay has answered was sent, nanoseconds of the link's clock."""
        return self._protocol.link.offset.answered if self._protocol and self.registered else None

    def prove(self, often: bool) -> None:
        """Ping so often that the link is known to work both ways, or as agreed again."""
        if often == self._often:
            return
        self._often = often
        if self._protocol is not None and self.registered:
            self._pace(self._protocol)

    def _pace(self, protocol: LinkProtocol) -> None:
        agreed = protocol.link.heartbeat
        protocol.ping_every(min(PROOF_EVERY, agreed) if self._often else agreed)

    def say(self, message: link.Message) -> None:
        """Send a message, if registered; what is said meanwhile is not kept."""
        if self._protocol is not None and self.registered:
            self._protocol.link.say(message)
            self._protocol.flush()

    def on_event(self, event: Event) -> None:
        """The relay said something."""
        if isinstance(event, Registered):
            self._registered_at = self._clock.seconds()
            self._last_words = ("", -LOG_SAME_EVERY)
            self._log.info("registered as {robot} at {relay}", robot=self._robot, relay=event.relay)
            if self._often and self._protocol is not None:
                self._pace(self._protocol)
            self.follower.on_registered(event.welcome)
        elif isinstance(event, MessageReceived):
            self.follower.on_order(event.message)
        elif isinstance(event, LinkEnded) and self._protocol is not None:
            self._protocol.end(LinkLost(f"the relay closed the link: {event.reason}"), gently=True)

    def on_lost(self, reason: SwitchboardError) -> None:
        """The attempt failed or the link is gone: tell, then wait and dial again."""
        proved = self.answered
        self._protocol = self._attempt = None
        lasted = 0.0
        if self._registered_at is not None:
            lasted = self._clock.seconds() - self._registered_at
            self._registered_at = None
            run_safely(
                self._log,
                "not all could be done that the loss of the link asks for",
                self.follower.on_unregistered,
                str(reason),
                proved,
            )
        if self._stopped is not None:
            self._stopped.callback(None)
            return
        delay = self._delay(reason, lasted)
        self._tell(str(reason), delay)
        self._retry = self._clock.callLater(delay, self.start)

    def on_pause(self) -> None:
        """The control link carries little; what it carries may wait."""

    def on_resume(self) -> None:
        """See :meth:`on_pause`."""

    def _make_protocol(self) -> LinkProtocol:
        protocol = LinkProtocol(self._make_link(), lambda _: self, self._clock)
        self._protocol = protocol
        return protocol

    def _unreachable(self, failure: Failure) -> None:
        self.on_lost(LinkLost(explain(failure)))

    def _delay(self, reason: SwitchboardError, lasted: float) -> float:
        if isinstance(reason, RelayRefused):
            return self._backoff.after_refusal(reason.retry_after)
        if isinstance(reason, WrongRelay):
            return self._backoff.after_refusal(None)
        return self._backoff.after_loss(lasted)

    def _tell(self, reason: str, delay: float) -> None:
        words, when = self._last_words
        now = self._clock.seconds()
        if reason == words and now - when < LOG_SAME_EVERY:
            return
        self._last_words = (reason, now)
        self._log.warn(
            "no link to the relay at {address}: {reason}; trying again, first in {delay:.1f} s",
            address=self._address,
            reason=reason,
            delay=delay,
        )
