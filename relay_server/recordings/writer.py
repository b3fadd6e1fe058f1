"""Writes a recording in a thread of its own, behind a bounded queue, so that a slow disk never delays the
relay."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, Protocol

from twisted.logger import Logger

from relay_protocol.errors import SwitchboardError
from relay_protocol.limits import MIB
from relay_server.recordings.mcap_file import McapChannel, McapFile, McapFileFull

QUEUE_BYTES = 32 * MIB
QUEUE_MESSAGES = 10_000
"""Most bytes queued for the disk, including those being written. Further messages are dropped and counted.
"""

BATCH = 64
"""Messages that the thread takes at a time. They count as waiting until all of them are written."""

CHECK_SECONDS = 1.0
"""How often the free space is checked."""

FLUSH_SECONDS = (1.0, 10.0)
"""Most that a killed relay may lose, in seconds: at first, and of a recording that has run for long."""

FLUSH_SHARE = 1 / 60
"""The share of a recording's duration that may be lost, within these bounds. Each flush ends a chunk, whose
index stays in memory until the end."""

NEARLY_FULL = "the disk is nearly full"


class RecordedMessage(NamedTuple):
    """A message to be written.

    :param log_time: nanoseconds
    :param publish_time: nanoseconds
    :param body: as it came
    :param make: converts the body; runs in the writer's thread, may raise :class:`SwitchboardError`
    """

    track: McapChannel
    log_time: int
    publish_time: int
    body: bytes
    make: Callable[[bytes], bytes] | None = None


def flush_pause(age: float) -> float:
    """Seconds until the next flush of a recording that has run this many seconds."""
    least, most = FLUSH_SECONDS
    return min(most, max(least, age * FLUSH_SHARE))


class ReactorThread(Protocol):
    """The reactor, as threads use it."""

    def callFromThread(self, call: Callable[..., object], *args: object) -> None:
        """Call a function in the reactor's thread."""


class WriteOutcome(NamedTuple):
    """How writing ended.

    :param finished: whether the file is complete
    :param reason: why it ended, unless that was requested
    """

    finished: bool
    reason: str


class RecordingWriter:
    """The file of one recording, from its beginning to its end. Methods belong to the reactor's thread,
    except for the marked ones.

    :param path: of a file that does not exist yet
    :param limit: bytes of the file
    :param ros: whether messages are ROS 2 messages
    :param nearly_full: whether the disk is; called in the thread, may raise :class:`OSError`
    :param ended: called once, in the reactor's thread
    """

    log = Logger()

    def __init__(
        self,
        reactor: ReactorThread,
        path: Path,
        limit: int,
        ros: bool,
        nearly_full: Callable[[], bool],
        ended: Callable[[WriteOutcome], None],
    ) -> None:
        self._reactor = reactor
        self._path = path
        self._limit = limit
        self._ros = ros
        self._nearly_full = nearly_full
        self._ended = ended
        self._waiting: deque[RecordedMessage] = deque()
        self._waiting_bytes = 0
        self._in_batch = 0
        self._closing = False
        self._astonished = False
        self._changed = threading.Condition()
        self.bytes = 0
        self.messages = 0
        self.broken = 0
        """Messages that could not be converted."""
        self._thread = threading.Thread(target=self._run, name="recording", daemon=True)

    def start(self) -> None:
        """Create the file and start the thread."""
        self._thread.start()

    def put(self, message: RecordedMessage) -> bool:
        """Queue a message; false if there is no room for it."""
        with self._changed:
            if (
                self._closing
                or len(self._waiting) + self._in_batch >= QUEUE_MESSAGES
                or (self._waiting_bytes and self._waiting_bytes + len(message.body) > QUEUE_BYTES)
            ):
                return False
            self._waiting.append(message)
            self._waiting_bytes += len(message.body)
            self._changed.notify()
        return True

    def finish(self) -> None:
        """Write the queue, and finish the file."""
        with self._changed:
            self._closing = True
            self._changed.notify()

    # --- the thread ---------------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            outcome = self._write()
        except OSError as error:
            outcome = WriteOutcome(False, f"the file cannot be written: {error.strerror}")
        except Exception:
            self.log.failure("writing a recording failed")
            outcome = WriteOutcome(False, "the relay failed on it; see its log")
        self.finish()
        self._reactor.callFromThread(self._ended, outcome)

    def _write(self) -> WriteOutcome:
        reason = ""
        with self._path.open("xb") as stream:
            file = McapFile(stream, self._limit, self._ros)
            began = time.monotonic()
            check_at, flush_at = began + CHECK_SECONDS, began + flush_pause(0)
            while True:
                batch, closing = self._take(min(check_at, flush_at) - time.monotonic())
                try:
                    for message in batch:
                        self._add(file, message)
                except McapFileFull:
                    reason = "it has reached its size limit"
                    break
                self._mark_written(batch)
                if closing and not batch:
                    break
                now = time.monotonic()
                if now >= flush_at:
                    file.flush()
                    flush_at = now + flush_pause(now - began)
                if now >= check_at:
                    if self._nearly_full():
                        reason = NEARLY_FULL
                        break
                    check_at = now + CHECK_SECONDS
                self.bytes, self.messages = file.size, file.messages
            file.finish()
            self.bytes, self.messages = file.size, file.messages
        return WriteOutcome(True, reason)

    def _take(self, seconds: float) -> tuple[list[RecordedMessage], bool]:
        """Messages from the queue, after a wait of at most ``seconds``; and whether no more may come."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._closing, max(0.0, seconds))
            batch = [self._waiting.popleft() for _ in range(min(BATCH, len(self._waiting)))]
            self._in_batch = len(batch)
            return batch, self._closing

    def _mark_written(self, batch: list[RecordedMessage]) -> None:
        """These are written and no longer count as waiting."""
        with self._changed:
            self._in_batch = 0
            self._waiting_bytes -= sum(len(message.body) for message in batch)

    def _add(self, file: McapFile, message: RecordedMessage) -> None:
        body = message.body
        if message.make is not None:
            try:
                body = message.make(body)
            except SwitchboardError:
                self.broken += 1
                return
            except Exception:
                # Data from a robot must never end the file for all other data.
                if not self._astonished:
                    self._astonished = True
                    self.log.failure("a message of {topic} could not be converted", topic=message.track.topic)
                self.broken += 1
                return
        file.add(message.track, message.log_time, message.publish_time, body)
