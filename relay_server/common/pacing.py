"""Keeps what is on its way to one receiver small, however much the kernel and the network would take.

A writer has a budget. What exceeds it comes here: it is written with a probe behind it (a ping, whose answer says that
everything before it has arrived), or, when the window is full, held back in the send queue, where newer samples still
replace older ones and small messages overtake large ones. A message larger than the window leaves piece by piece, so
that pings and the close frame go between its pieces. The window is :class:`relay_protocol.pacing.SendWindow`.

===================================  ==========================  ====================================================
What                                 overtakes                   but never
===================================  ==========================  ====================================================
pings, pongs, close frame, ``bye``,  everything that waits, and  what was written before. They change no order: a
``refused``                          pieces                      ``pong`` tells the time, an answer to a ping tells of
                                                                 what was written before the ping
control messages, answers            samples, commands           one another, a message that is being sent
commands of up to :data:`SEGMENT`    pieces of a sample or of a  an older command of their publication, another
                                     control message; control    message than in pieces
                                     messages that wait
small samples                        large samples               an older sample of their topic, control messages
===================================  ==========================  ====================================================

Stop, resume, control and suppress go over the control link of the robot, which is not paced, in the order they come. No
order holds between two links: so the robot judges each command by its stamp (SPEC 2.5).

On a fast connection this costs a subtraction a message, and a call to the kernel for every :data:`SPACING` bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any, Protocol

from relay_protocol.limits import KIB
from relay_protocol.pacing import FIRST, TARGET, SendWindow
from relay_server.common.clock import Clock, Timer, cancel
from relay_server.common.send_queue import SEGMENT, SendQueue
from relay_server.common.socket_writer import TransportWriter
from relay_server.common.tcp import unacknowledged

SPACING = (KIB, 256 * KIB)
"""Bytes between two probes: half of the window, a quarter on a thin connection, within these bounds."""

PIECE = 16 * KIB
"""Most bytes of a piece of a large message, and of a small message."""

MORE = 4 * KIB
"""Bytes of commands that may be sent beyond the window."""

STUCK_SECONDS = 3.0
"""A receiver that has answered no ping for so long takes nothing. Who only watches is pinged every 2 s."""

TRUSTED = (32 * KIB, 256 * KIB)
"""Bytes that may be taken for arrived by the kernel's word alone after a quick answer to a probe, and after several.

TCP's acknowledgements cost no answer, but come from the nearest proxy."""


class Pieces(Protocol):
    """A message that is taken piece by piece."""

    divided: bool
    """Whether commands may go between its pieces."""
    command: bool
    """Whether it is a command."""

    @property
    def left(self) -> int:
        """Bytes that were not taken; 0 at the end."""

    def take(self, most: int) -> bytes:
        """The next piece, with no more than about so many bytes."""


class Pacer:
    """Between the send queue and the writer of one connection.

    :param seconds: monotonic, without the time for which the reactor stood still
    :param probe: sends a ping now; the edge reports each ping by :meth:`probing`, and its answer by :meth:`answered`
    :param pieces: divides a message
    :param tcp: the connection, for what the kernel knows; ``None`` in memory
    """

    __slots__ = (
        "_answered_at",
        "_clock",
        "_credit",
        "_granted",
        "_opening",
        "_outbox",
        "_pieces",
        "_probe",
        "_probed",
        "_rest",
        "_seconds",
        "_tcp",
        "_trust",
        "_writer",
        "window",
    )

    def __init__(
        self,
        writer: TransportWriter,
        outbox: SendQueue,
        clock: Clock,
        seconds: Callable[[], float],
        probe: Callable[[], None],
        pieces: Callable[[bytes], Pieces],
        tcp: Any,
    ) -> None:
        self.window = SendWindow()
        self._writer = writer
        self._outbox = outbox
        self._clock = clock
        self._seconds = seconds
        self._probe = probe
        self._pieces = pieces
        self._tcp = tcp
        self._rest: Pieces | None = None
        """What is left of the message that is being sent."""
        self._probed = 0
        """Bytes sent when the latest probe was."""
        self._trust = self._credit = 0
        self._opening: Timer | None = None
        self._answered_at = float("-inf")
        """When a ping was answered last, or the window became full since."""
        outbox.taking = self._taking
        self._granted = writer.budget = FIRST // 2
        writer.spent = self._spent

    def probing(self, key: Hashable) -> None:
        """A ping is sent, behind what was written before."""
        self._account()
        self.window.probe(key, self._seconds(), full=self._outbox.held)
        self._probed = self.window.sent

    def answered(self, key: Hashable) -> None:
        """A ping was answered."""
        self._account()
        window = self.window
        now = self._seconds()
        if not window.answered(key, now):
            return
        self._answered_at = now
        quick = window.delay < TARGET / 4 and not window.limited
        self._trust = self._credit = min(TRUSTED[1], max(TRUSTED[0], 2 * self._trust)) if quick else 0
        self._outbox.limit(round(window.size) if window.limited else None, window.rate)
        if self._outbox.held:
            self.go_on()
        else:
            self._grant()

    def go_on(self) -> None:
        """Send what was held back, as far as the window allows; called when there may be room."""
        outbox, window = self._outbox, self.window
        if not outbox.held or outbox.paused_since is not None:
            return
        now = self._seconds()
        while (rest := self._rest) is not None:
            self.commands()
            room = window.room(now)
            if room < min(SPACING[0], rest.left) or outbox.paused_since is not None:
                break
            self._put(rest.take(int(min(room, PIECE, self._spacing))))
            if not rest.left:
                self._rest = None
            if window.sent - self._probed >= self._spacing:
                self._probe()
        if self._rest is None and window.room(now) > 0:
            self._grant()
            outbox.release()
            self._open_later()
        else:
            self.commands()
            if not window.probed:
                self._probe()

    def commands(self) -> None:
        """Send commands that wait, oldest first, ahead of what the window holds up, and between pieces of a message."""
        outbox = self._outbox
        while outbox.held and outbox.paused_since is None and self._may_go_between():
            command = outbox.take_command()
            if command is None:
                break
            self._put(command)

    def stop(self) -> None:
        """The connection ends; nothing more is sent but what is urgent."""
        self._rest = None
        cancel(self._opening)
        self._opening = None

    # --- inside -------------------------------------------------------------------------------------------

    def _may_go_between(self) -> bool:
        return (self._rest is None or self._rest.divided) and self._has_more()

    def _has_more(self) -> bool:
        return self.window.flight <= self.window.size + MORE

    def _taking(self) -> bool:
        return self._seconds() - self._answered_at <= STUCK_SECONDS

    @property
    def _spacing(self) -> float:
        part = 4 if self.window.limited else 2
        return min(SPACING[1], max(SPACING[0], self.window.size / part))

    def _spent(self, data: bytes) -> None:
        """The budget does not reach for this."""
        window, size = self.window, len(data)
        self._writer.budget += size
        self._account()
        room = window.room(self._seconds(), small=size <= PIECE)
        pieces = self._pieces(data)
        if size <= room or (size <= SEGMENT and (room > 0 or (pieces.command and self._has_more()))):
            trusted = self._trusts(size)
            self._put(data)
            if not trusted:
                self._probe()
            self._grant()
            return
        self._rest = pieces
        self._answered_at = self._seconds()
        self._outbox.hold(large=size > window.size)
        self.go_on()

    def _trusts(self, size: int) -> bool:
        """Whether the kernel's word that everything before has arrived is enough."""
        if self._tcp is None or self._credit < size or unacknowledged(self._tcp):
            return False
        self._credit -= size + round(self._spacing)
        self.window.all_arrived()
        return True

    def _put(self, data: bytes) -> None:
        self._writer.urgent(data)
        self.window.sent += len(data)

    def _account(self) -> None:
        """Count what was written within the budget."""
        self.window.sent += self._granted - self._writer.budget
        self._granted = self._writer.budget

    def _grant(self) -> None:
        room = min(self.window.room(self._seconds(), small=True), self._spacing)
        self._granted = self._writer.budget = max(0, int(room))

    def _open_later(self) -> None:
        """Large samples wait for some time behind one that has held up others."""
        opens = self._outbox.opens_in
        if opens > 0:
            cancel(self._opening)
            self._opening = self._clock.callLater(opens, self._open)

    def _open(self) -> None:
        self._opening = None
        self._outbox.open()
