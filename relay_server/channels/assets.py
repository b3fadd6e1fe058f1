"""Assets of a robot: files of its packages, such as meshes, fetched in parts over the channel's link.

The next part is requested when one has arrived, so samples pass between parts, and a slow link is not filled.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

from twisted.internet.defer import Deferred, fail

from relay_protocol import asset_uri, link
from relay_protocol.errors import NotFound, SwitchboardError, Unavailable
from relay_server.channels.link_state import RobotLinkState
from relay_server.common.clock import Timer, cancel

PART_SECONDS = 60.0
"""Seconds in which a part must arrive. On a slow link the parts of several assets arrive together."""

AT_A_TIME = 4
"""Most assets of one robot that are fetched at a time. The robot reads no more parts at a time."""

QUEUED = 256
"""Most assets of one robot that wait for their turn."""


class LargerThanReserved(Exception):
    """An asset has more bytes than the caller takes.

    :ivar size: of the asset, bytes
    """

    def __init__(self, size: int) -> None:
        super().__init__(f"the asset has {size} bytes")
        self.size = size


@dataclass
class _PendingAsset:
    """:param size: bytes; ``None`` before the first part
    :param waiting: most bytes that each caller takes
    """

    number: int
    name: asset_uri.AssetName
    uri: str
    size: int | None = None
    data: bytearray = field(default_factory=bytearray)
    version: str | None = None
    timer: Timer | None = None
    waiting: dict[Deferred[bytes], int] = field(default_factory=dict)


class RobotAssets:
    """Fetches assets of one robot; callers that want the same one at the same time share it."""

    def __init__(self, link_state: RobotLinkState) -> None:
        self._link_state = link_state
        self._numbers = itertools.count(1)
        self._queue: dict[asset_uri.AssetName, _PendingAsset] = {}
        self._running: dict[int, _PendingAsset] = {}
        """Also those that no caller waits for any more, until the robot has answered."""

    def fetch(self, uri: str, most: int) -> Deferred[bytes]:
        """The bytes of a file, by its URI; fails with the reason.

        A larger file fails with :class:`LargerThanReserved`. A caller that fetches it again at once shares what has
        been fetched.

        :param uri: such as ``package://turtlebot/meshes/base.stl``
        :param most: most bytes that the caller takes
        """
        try:
            name = asset_uri.parse(uri)
        except SwitchboardError as error:
            return fail(error)
        if self._link_state.link is None:
            return fail(Unavailable(f"robot {self._link_state.robot.name} is not connected"))
        pending = self._queue.get(name) or next(
            (each for each in self._running.values() if each.name == name and (each.waiting or each.data)),
            None,
        )
        if pending is None:
            if len(self._queue) >= QUEUED:
                return fail(Unavailable(f"{QUEUED} assets wait to be fetched from this robot; try again"))
            pending = self._queue[name] = _PendingAsset(next(self._numbers), name, uri)
        if pending.size is not None and pending.size > most:
            return fail(LargerThanReserved(pending.size))
        waiting: Deferred[bytes] = Deferred(lambda cancelled: self._cancelled(pending, cancelled))
        pending.waiting[waiting] = most
        self._begin_waiting()
        return waiting

    def _cancelled(self, pending: _PendingAsset, waiting: Deferred[bytes]) -> None:
        del pending.waiting[waiting]
        if not pending.waiting:
            pending.data.clear()
            # A robot that reads a part keeps its place until it answers, as it refuses more at a time.
            self._dequeue(pending)

    def _dequeue(self, pending: _PendingAsset) -> None:
        if self._queue.get(pending.name) is pending:
            del self._queue[pending.name]

    def part(self, message: link.AssetPart) -> None:
        """The robot has sent a part."""
        pending = self._running.get(message.number)
        if pending is None:
            return
        if not pending.waiting:
            self._end(pending, None)
            return
        if message.offset != len(pending.data):
            return
        if (pending.version, pending.size) not in ((None, None), (message.version, message.size)):
            self._end(pending, Unavailable(f"{pending.uri} was changed while it was fetched; fetch it again"))
            return
        pending.version, pending.size = message.version, message.size
        pending.data += message.data
        self._refuse_larger(pending, message.size)
        if not pending.waiting:
            self._end(pending, None)
        elif len(pending.data) > message.size or (not message.data and len(pending.data) < message.size):
            self._end(pending, Unavailable(f"the robot sent other bytes of {pending.uri} than it said"))
        elif len(pending.data) == message.size:
            self._end(pending, None)
        else:
            self._request(pending)

    def _refuse_larger(self, pending: _PendingAsset, size: int) -> None:
        for waiting, most in list(pending.waiting.items()):
            # An earlier one may have led to the cancellation of this one.
            if most < size and pending.waiting.pop(waiting, None) is not None:
                waiting.errback(LargerThanReserved(size))

    def refused(self, number: int, reason: str) -> None:
        """The robot does not send an asset."""
        pending = self._running.get(number)
        if pending is not None:
            self._end(pending, NotFound(f"{pending.uri[:200]}: {reason}"))

    def reset(self) -> None:
        """The link is lost."""
        for pending in [*self._running.values(), *self._queue.values()]:
            self._end(pending, Unavailable(f"robot {self._link_state.robot.name} lost its connection"))

    def _begin_waiting(self) -> None:
        while self._queue and len(self._running) < AT_A_TIME:
            pending = self._queue.pop(next(iter(self._queue)))
            self._running[pending.number] = pending
            self._request(pending)

    def _request(self, pending: _PendingAsset) -> None:
        cancel(pending.timer)
        pending.timer = self._link_state.clock.callLater(PART_SECONDS, self._timed_out, pending)
        self._link_state.send(link.GetAsset(number=pending.number, uri=pending.uri, offset=len(pending.data)))

    def _timed_out(self, pending: _PendingAsset) -> None:
        pending.timer = None
        self._end(pending, Unavailable(f"the robot sent nothing of {pending.uri} for {PART_SECONDS:g} s"))

    def _end(self, pending: _PendingAsset, error: SwitchboardError | None) -> None:
        cancel(pending.timer)
        self._running.pop(pending.number, None)
        self._dequeue(pending)
        data = bytes(pending.data) if error is None and pending.waiting else b""
        pending.data.clear()
        for each in list(pending.waiting):
            # An earlier one may have led to the cancellation of this one.
            if pending.waiting.pop(each, None) is not None:
                each.callback(data) if error is None else each.errback(error)
        if self._link_state.link is not None:
            self._begin_waiting()
