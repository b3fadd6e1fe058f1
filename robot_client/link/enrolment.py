"""Enrolment: hand in the public key with a code of one use."""

from __future__ import annotations

import time
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.protocol import Factory

from relay_protocol import PROTOCOL_VERSION, link
from relay_protocol.errors import SwitchboardError
from robot_client.link.protocol import EnrolledAt, EnrolmentLink, Event
from robot_client.link.tls import explain
from robot_client.link.transport import LinkLost, LinkProtocol
from robot_client.twisted_types import DialEndpoint


class _EnrolmentAttempt:
    """One attempt; an :class:`~robot_client.link.transport.LinkOwner`."""

    def __init__(self, protocol: LinkProtocol, result: Deferred[link.Enrolled]) -> None:
        self._protocol = protocol
        self._result = result

    def on_event(self, event: Event) -> None:
        """The relay said yes."""
        if isinstance(event, EnrolledAt) and not self._result.called:
            self._protocol.end(LinkLost("enrolled"), gently=True)
            self._result.callback(event.enrolled)

    def on_lost(self, reason: SwitchboardError) -> None:
        """The relay said no, or nothing."""
        if not self._result.called:
            self._result.errback(reason)

    def on_pause(self) -> None:
        """One message needs no pause."""

    def on_resume(self) -> None:
        """See :meth:`on_pause`."""


def enroll(
    clock: Any, endpoint: DialEndpoint, robot: str, code: str, public_key: bytes, agent: str
) -> Deferred[link.Enrolled]:
    """Register a public key; fails with a sentence.

    :param code: of one use, from the relay's admin
    :param public_key: 32 raw bytes
    """
    result: Deferred[link.Enrolled] = Deferred()
    request = link.Enroll(
        version=PROTOCOL_VERSION,
        robot=robot,
        code=code,
        public_key=link.to_base64(public_key),
        agent=agent,
    )

    def make() -> LinkProtocol:
        return LinkProtocol(
            EnrolmentLink(request, time.monotonic_ns), lambda edge: _EnrolmentAttempt(edge, result), clock
        )

    factory = Factory.forProtocol(make)
    factory.noisy = False
    endpoint.connect(factory).addErrback(lambda failure: result.errback(LinkLost(explain(failure))))
    return result
