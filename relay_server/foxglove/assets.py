"""Assets: files of the robot, such as meshes, that a client fetches by a URI."""

from __future__ import annotations

from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import NamedTuple

from twisted.internet.defer import Deferred, DeferredLock

from relay_protocol import limits
from relay_protocol.errors import SwitchboardError
from relay_protocol.limits import MIB
from relay_protocol.rights import Operation
from relay_server.channels.assets import LargerThanReserved
from relay_server.common.byte_budget import ByteBudget
from relay_server.foxglove import messages
from relay_server.foxglove.context import FoxgloveContext

ASSETS = 1024
"""Most requests for assets of one client that are not answered. The apps request all meshes of a robot at once."""

AT_A_TIME = 4
"""Most assets of one client that are fetched, or were fetched and wait to be sent."""

USER_BYTES = 2 * limits.ASSET
"""Most bytes of assets of one user, over all connections, that are fetched or not read yet."""

RELAY_BYTES = 512 * MIB
"""The same of all users together."""

DESCRIPTION = "/robot_description"
"""The topic that names a robot's meshes. The right to subscribe to it includes the meshes."""

FetchAsset = Callable[[str, int], Awaitable[bytes]]
"""Fetches an asset of at most so many bytes of the robot, by its URI.

Raises :class:`SwitchboardError` with the reason if it can't, and :class:`LargerThanReserved`.
"""


def asset_budget() -> ByteBudget:
    """The memory of one relay for assets."""
    return ByteBudget(USER_BYTES, RELAY_BYTES)


class AssetKey(NamedTuple):
    """Key of an asset that waits for a client to read."""

    request: int


@dataclass(slots=True)
class WaitingAsset:
    """An asset that waits for a client to read.

    :ivar body: ``None``: nothing is sent, but what was sent before has been read
    :ivar size: about that of the frame, bytes
    """

    request: int
    body: bytes | None
    size: int


class AssetRequests:
    """The assets that one client fetches.

    Requests wait in a queue, and a few are fetched at a time. The memory for each is reserved before it is fetched, and
    released when the client has read it. Assets are sent one after the other, each when the one before was read. So at
    most one waits in the send queue, which does not drop it.

    :param fetch: of the robot
    :param budget: of the relay
    :ivar reserved: bytes of memory for assets that are fetched or not read yet
    """

    def __init__(self, context: FoxgloveContext, fetch: FetchAsset, budget: ByteBudget) -> None:
        self._context = context
        self._fetch = fetch
        self._budget = budget
        self.reserved = 0
        self._queue: deque[messages.FetchAssetOp] = deque()
        """Those that are not being fetched yet."""
        self._running = 0
        """Requests that are being answered."""
        self._turns = DeferredLock()
        """Held while an asset is sent."""
        self._sending: Deferred[None] | None = None
        """Fires when what was queued last is written."""

    def fetch(self, operation: messages.FetchAssetOp) -> None:
        """Fetch an asset; the answer is the file or the reason why it can't be fetched."""
        if len(self._queue) + self._running >= ASSETS:
            self._deny(
                operation, f"{ASSETS} assets of this connection are being fetched already; wait for answers"
            )
            return
        self._queue.append(operation)
        if self._running < AT_A_TIME:
            self._running += 1
            self._context.run(self._answer_queue())

    async def _answer_queue(self) -> None:
        try:
            while self._queue:
                await self._answer(self._queue.popleft())
        finally:
            self._running -= 1

    async def _answer(self, operation: messages.FetchAssetOp) -> None:
        # Most files have one part; the size of others is known when it has come.
        size: int | None = limits.ASSET_PART
        try:
            while size is not None:
                self._require_right()
                size = await self._answer_within(size, operation)
        except SwitchboardError as error:
            self._deny(operation, str(error))

    def _deny(self, operation: messages.FetchAssetOp, reason: str) -> None:
        self._context.client.count_refusal()
        self._context.send(messages.asset_failure(operation.request_id, reason))

    async def _answer_within(self, size: int, operation: messages.FetchAssetOp) -> int | None:
        """Fetch an asset within so many bytes of memory, and send it.

        :returns: how many are needed, if these are too few
        """
        user = self._context.client.permit.principal.user_id
        await self._budget.reserve(user, size)
        self.reserved += size
        try:
            # The turn has the only reference to the bytes, so that they go when the frame is made.
            await self._turns.run(self._send, operation.request_id, await self._fetch(operation.uri, size))
        except LargerThanReserved as larger:
            return larger.size
        finally:
            self.reserved -= size
            self._budget.release(user, size)
        return None

    def _require_right(self) -> None:
        self._context.client.require(Operation.SUBSCRIBE, DESCRIPTION)

    def _send(self, request: int, body: bytes) -> Deferred[None]:
        """Send an asset; wait until it is read, however slowly the client reads: the apps fetch none again.

        :raises Refused: the client has lost the right to it meanwhile
        """
        self._require_right()
        sent = self._queue_message(request, body)
        # The send queue writes this when the connection has room again after the asset.
        return sent.addCallback(lambda _: self._queue_message(request, None))

    def _queue_message(self, request: int, body: bytes | None) -> Deferred[None]:
        sending = self._sending = Deferred[None]()
        # In turn with data, since a mesh may be larger than all that may wait as control messages.
        self._context.send_queue.send_undroppable(
            AssetKey(request), WaitingAsset(request, body, len(body or b""))
        )
        return sending

    def render(self, asset: WaitingAsset) -> bytes | None:
        """The frame of an asset that is written now."""
        sending, self._sending = self._sending, None
        if sending is not None:
            # Not at once: the send queue is in use, and the next asset may be at hand.
            self._context.clock.callLater(0, sending.callback, None)
        return None if asset.body is None else messages.asset(asset.request, asset.body)
