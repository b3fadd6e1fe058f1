"""The context that the parts of one Foxglove client share: its session, its statuses, and the sending of messages."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any, TypeVar

from twisted.internet.defer import CancelledError, Deferred
from twisted.logger import Logger

from relay_protocol import rosbridge
from relay_protocol.errors import SwitchboardError
from relay_server.common.clock import Clock
from relay_server.common.send_queue import SendQueue
from relay_server.foxglove.options import StreamOptions
from relay_server.foxglove.statuses import EVENT_SECONDS, StatusList
from relay_server.sessions.context import ClientContext
from relay_server.sessions.session import Session

Entry = TypeVar("Entry")

_AGE = re.compile(r"it may be \d+ ms old")


class FoxgloveContext:
    """One Foxglove client, as the parts of its port see it."""

    log = Logger()

    def __init__(self, clock: Clock, session: Session, send_queue: SendQueue, options: StreamOptions) -> None:
        self.clock = clock
        self.options = options
        self.session = session
        self.client: ClientContext = session.client
        self.send_queue = send_queue
        self.send: Callable[[bytes], None] = send_queue.send_reliable
        self.statuses = StatusList(self.send, clock.seconds)
        self._running: set[Deferred[None]] = set()

    def perform(self, operation: rosbridge.ClientOp) -> bool:
        """Carry out an operation by the session; a refusal becomes a status with the id of the operation.

        :returns: whether it was not refused
        """
        try:
            self.session.perform(operation)
        except SwitchboardError as error:
            self.refuse(operation, error)
            return False
        return True

    def refuse(self, operation: rosbridge.ClientOp, error: SwitchboardError) -> None:
        """Notify the client that an operation was refused, and count the refusal."""
        self.client.refuse(operation, error)
        self.statuses.end_later(str(operation.id))
        self.client.quota.count_refusal()

    def deny(self, text: str, id: str, level: str = "error") -> None:
        """Count something that is not carried out as a refusal, and show the reason."""
        self.client.count_refusal()
        self.show(level, text, id)

    def show(self, level: str, text: str, id: str) -> None:
        """Show an event, such as a refusal; see :class:`StatusList`.

        Measured ages are left out, as apps list every wording.
        """
        self.statuses.show(level, _AGE.sub("it may be too old", text), id, EVENT_SECONDS)

    def show_state(self, level: str, text: str, id: str) -> None:
        """Show a state until it is removed."""
        self.statuses.show(level, text, id)

    def first_entries(self, entries: list[Entry], most: int, op: str) -> list[Entry]:
        """As many entries of a message as are carried out; of a longer one the client is notified."""
        if len(entries) > most:
            text = (
                f"{op}: of {len(entries)} entries only the first {most} are carried out; send fewer at a time"
            )
            self.deny(text, "long-list")
        return entries[:most]

    def run(self, work: Any) -> None:
        """Run a coroutine until it or the session ends."""
        running: Deferred[None] = Deferred.fromCoroutine(work)
        self._running.add(running)
        running.addErrback(self._failed)
        running.addBoth(lambda _: self._running.discard(running))

    def _failed(self, failure: Any) -> None:
        if not failure.check(CancelledError):
            self.log.failure("a request of a Foxglove client failed", failure)

    def end(self) -> None:
        """The session is over: cancel what runs."""
        for running in list(self._running):
            running.cancel()
