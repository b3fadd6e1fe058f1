"""Bounds the bytes in flight to one receiver, as kernel and network would buffer far more.

A writer has a budget. A message that exceeds it comes here. It is written with a probe behind it (a ping, whose answer
shows that everything before it has arrived). When the window is full it waits in the send queue instead, where newer
samples replace older ones and small messages overtake large ones. A message larger than the window is sent in pieces,
so that pings and the close frame go between them. The window is :class:`relay_protocol.pacing.SendWindow`.

===================================  ==========================  ====================================================
Message                              overtakes                   but never
===================================  ==========================  ====================================================
pings, pongs, close frame, ``bye``,  everything that waits, and  what was written before. They change no order: a
``refused``                          pieces                      ``pong`` carries a time, and the answer to a ping is
                                                                 about what was written before the ping
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

SPACING = (KIB, 512 * KIB)
"""Bytes between two probes: half of the window, a quarter on a slow connection, within these bounds."""

PIECE = 16 * KIB
"""Most bytes of a piece of a large message, and most bytes of a message that counts as small."""

COMMAND_BYTES = 4 * KIB
"""Most bytes of commands that are sent beyond the window."""

STUCK_SECONDS = 3.0
"""Seconds without an answered ping after which a receiver counts as not reading. A viewer is pinged every 2 s."""

TRUSTED = (32 * KIB, 256 * KIB)
"""Most bytes that count as arrived by TCP's acknowledgement alone, after one quick answer to a probe and after several.

TCP's acknowledgements cost no answer, but come from the nearest proxy.
"""


class Pieces(Protocol):
    """A message that is sent in pieces."""

    divided: bool
    """Whether commands may go between its pieces."""
    command: bool
    """Whether it is a command."""

    @property
    def left(self) -> int:
        """Bytes that are left; 0 at the end."""

    def take(self, most: int) -> bytes:
        """The next piece, of about ``most`` bytes at most."""


class Pacer:
    """Stands between the send queue and the writer of one connection.

    :param seconds: monotonic, without the time for which the reactor stood still
    :param probe: sends a ping now, of which :meth:`probe_sent` is called, and later :meth:`probe_answered`
    :param pieces: divides a message
    :param tcp: the TCP connection, for the kernel's figures; ``None`` in memory
    """

    __slots__ = (
        "_answered_at",
        "_clock",
        "_credit",
        "_granted",
        "_large_timer",
        "_pieces",
        "_probe",
        "_probed",
        "_seconds",
        "_send_queue",
        "_tcp",
        "_trust",
        "_unfinished",
        "_writer",
        "window",
    )

    def __init__(
        self,
        writer: TransportWriter,
        send_queue: SendQueue,
        clock: Clock,
        seconds: Callable[[], float],
        probe: Callable[[], None],
        pieces: Callable[[bytes], Pieces],
        tcp: Any,
    ) -> None:
        self.window = SendWindow()
        self._writer = writer
        self._send_queue = send_queue
        self._clock = clock
        self._seconds = seconds
        self._probe = probe
        self._pieces = pieces
        self._tcp = tcp
        self._unfinished: Pieces | None = None
        """The message that is being sent in pieces."""
        self._probed = 0
        """Bytes sent before the latest probe."""
        self._trust = self._credit = 0
        self._large_timer: Timer | None = None
        self._answered_at = float("-inf")
        """Seconds at which a ping was answered last, or the window became full after that."""
        send_queue.receiver_reads = self._receiver_reads
        self._granted = writer.budget = FIRST // 2
        writer.over_budget = self._over_budget

    def probe_sent(self, key: Hashable) -> None:
        """A ping is being sent, behind what was written before.

        :param key: its payload or time, which its answer repeats
        """
        self._account()
        self.window.probe(key, self._seconds(), full=self._send_queue.window_full)
        self._probed = self.window.sent

    def probe_answered(self, key: Hashable) -> None:
        """A ping was answered."""
        self._account()
        window = self.window
        now = self._seconds()
        if not window.answered(key, now):
            return
        self._answered_at = now
        quick = window.delay < TARGET / 4 and not window.limited
        self._trust = self._credit = min(TRUSTED[1], max(TRUSTED[0], 2 * self._trust)) if quick else 0
        self._send_queue.set_limits(round(window.size) if window.limited else None, window.rate)
        if self._send_queue.window_full:
            self.continue_sending()
        else:
            self._grant(now)

    def continue_sending(self) -> None:
        """Send what waits, as far as the window allows; called when there may be room."""
        send_queue, window = self._send_queue, self.window
        if not send_queue.window_full or send_queue.paused_since is not None:
            return
        now = self._seconds()
        while (rest := self._unfinished) is not None:
            self.send_commands()
            room = window.room(now)
            if room < min(SPACING[0], rest.left) or send_queue.paused_since is not None:
                break
            self._write(rest.take(int(min(room, PIECE, self._spacing))))
            if not rest.left:
                self._unfinished = None
            if window.sent - self._probed >= self._spacing:
                self._probe()
        if self._unfinished is None and window.room(now) > 0:
            self._grant(now)
            send_queue.window_has_room()
            self._schedule_large()
        else:
            self.send_commands()
            if not window.probed:
                self._probe()

    def send_commands(self) -> None:
        """Send commands that wait, oldest first, before what else waits for the window, and between pieces."""
        send_queue = self._send_queue
        while send_queue.window_full and send_queue.paused_since is None and self._may_go_between():
            command = send_queue.take_command()
            if command is None:
                break
            self._write(command)

    def stop(self) -> Pieces | None:
        """The connection ends: send nothing of what is held back.

        :returns: the message that was being sent in pieces
        """
        unfinished, self._unfinished = self._unfinished, None
        cancel(self._large_timer)
        self._large_timer = None
        return unfinished

    # --- inside -------------------------------------------------------------------------------------------

    def _may_go_between(self) -> bool:
        return (self._unfinished is None or self._unfinished.divided) and self._may_send_command()

    def _may_send_command(self) -> bool:
        return self.window.flight <= self.window.size + COMMAND_BYTES

    def _receiver_reads(self) -> bool:
        return self._seconds() - self._answered_at <= STUCK_SECONDS

    @property
    def _spacing(self) -> float:
        part = 4 if self.window.limited else 2
        return min(SPACING[1], max(SPACING[0], self.window.size / part))

    def _over_budget(self, data: bytes) -> None:
        """Send or hold back a message that exceeds the writer's budget."""
        window, size = self.window, len(data)
        self._account()
        now = self._seconds()
        room = window.room(now, small=size <= PIECE)
        if size <= room or (size <= SEGMENT and room > 0):
            self._put_measured(data, now)
            return
        pieces = self._pieces(data)
        if size <= SEGMENT and pieces.command and self._may_send_command():
            self._put_measured(data, now)
            return
        self._unfinished = pieces
        self._answered_at = now
        self._send_queue.window_filled(large=size > window.size)
        self.continue_sending()

    def _put_measured(self, data: bytes, now: float) -> None:
        """Send a message, with a probe behind it unless TCP's acknowledgement is enough."""
        trusted = self._trusts(len(data))
        self._write(data)
        if not trusted:
            self._probe()
        self._grant(now)

    def _trusts(self, size: int) -> bool:
        """Whether TCP's acknowledgement is enough for a message; it is not if too many bytes are unacknowledged."""
        if self._tcp is None or self._credit < size:
            return False
        left = unacknowledged(self._tcp)
        if left > self._spacing:
            return False
        self._credit -= self.window.all_arrived(but=left)
        return True

    def _write(self, data: bytes) -> None:
        self._writer.write_beyond_budget(data)
        self.window.sent += len(data)

    def _account(self) -> None:
        """Count the bytes that were written within the budget."""
        self.window.sent += self._granted - self._writer.budget
        self._granted = self._writer.budget

    def _grant(self, now: float) -> None:
        spacing = self._spacing
        if self._credit > spacing:
            # The kernel is asked next, instead of a probe.
            spacing = max(spacing, TRUSTED[0])
        room = min(self.window.room(now, small=True), spacing)
        self._granted = self._writer.budget = max(0, int(room))

    def _schedule_large(self) -> None:
        """Allow large samples again some time after one that has delayed others."""
        opens = self._send_queue.large_allowed_in
        if opens > 0:
            cancel(self._large_timer)
            self._large_timer = self._clock.callLater(opens, self._allow_large)

    def _allow_large(self) -> None:
        self._large_timer = None
        self._send_queue.allow_large()
