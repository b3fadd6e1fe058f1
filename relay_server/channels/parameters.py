"""Parameters of a robot's nodes as they were read, shared by all clients of a channel and kept up to date by events.

It knows no rights: clients check theirs before they read, and before they pass values on.
"""

from __future__ import annotations

import itertools
from collections import OrderedDict
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

from twisted.internet.defer import Deferred
from twisted.logger import Logger

from relay_protocol import jsontext, rosbridge
from relay_protocol.errors import Refused, SwitchboardError, Unavailable
from relay_protocol.limits import NAME
from relay_server.access import keep_newest
from relay_server.channels.client_subscription import ClientSubscription
from relay_server.channels.link_state import RobotLinkState
from relay_server.channels.samples import Sample
from relay_server.channels.subscriptions import Subscriptions
from relay_server.common.clock import Clock, Timer, cancel

TOPIC = "/parameter_events"
TYPE = "rcl_interfaces/msg/ParameterEvent"

NAMES = 4096
"""Most parameters that are kept of one node."""

UNSET_NAMES = 256
"""Most parameters of one node that are kept as not set. Clients may request any name."""

KEPT_SECONDS = 60.0
"""Seconds after which parameters of a node are read again, in case that an event was lost.

All values are kept for as long after the last client has left.
"""

SILENT_SECONDS = 10.0
"""A node that did not answer n times in a row is left out of requests for all parameters, for n - 1 times as long.

For example, it is left out for 20 s after the third time. It is :data:`KEPT_SECONDS` at most. Apps request all
parameters every 15 s, and each silent node delays the answer.
"""

ParameterValue = dict[str, Any]
"""A ``rcl_interfaces/msg/ParameterValue`` in JSON, from the robot."""

Reader = Callable[[Sequence[str] | None], Coroutine[Deferred[Any], Any, dict[str, ParameterValue]]]
"""Reads some parameters of a node, or with ``None`` all; those that are not set are left out."""

_NO_USER = -1

_ReadKey = tuple[str, tuple[str, ...] | None]
"""A node, and the names of its parameters that are read; ``None``: all."""


class ParameterListener(Protocol):
    """A client that uses the cache."""

    def parameters_changed(self, node: str, changed: dict[str, ParameterValue | None]) -> None:
        """Parameters of a node have new values; ``None``: it was deleted."""


@dataclass(slots=True)
class _KnownNode:
    """:param all_read_at: seconds of the clock at which all its parameters were read; ``None``: they were not
    :param read_at: seconds of the clock at which each value arrived, by name
    :param unset_at: the same of parameters that are not set; the newest of them
    """

    all_read_at: float | None
    values: dict[str, ParameterValue] = field(default_factory=dict)
    read_at: dict[str, float] = field(default_factory=dict)
    unset_at: OrderedDict[str, float] = field(default_factory=OrderedDict)

    def apply(self, changed: dict[str, ParameterValue | None], now: float) -> None:
        """Keep values that have arrived; ``None``: it is not set.

        :param now: seconds of the clock
        """
        for name, value in changed.items():
            if value is None:
                self.values.pop(name, None)
                self.read_at.pop(name, None)
                if len(name) <= NAME:
                    keep_newest(self.unset_at, name, now, UNSET_NAMES)
                continue
            self.unset_at.pop(name, None)
            if name in self.values or len(self.values) < NAMES:
                self.values[name] = value
                self.read_at[name] = now

    def all_known_since(self, names: Sequence[str] | None) -> float | None:
        """Seconds of the clock at which the oldest of some values arrived; ``None``: one is not known.

        :param names: ``None`` for all
        """
        if names is None:
            return self.all_read_at
        found = (self.read_at.get(name, self.unset_at.get(name)) for name in names)
        times = [each for each in found if each is not None]
        return min(times, default=None) if len(times) == len(names) else None


class _NodeReads:
    """The reads of one node that have begun, and the values that have come since the first of them.

    :ivar latest: by name, the number at which a value came and the value; ``None``: it is not set. The number of a
        value that was read is that of the beginning of its read
    """

    __slots__ = ("latest", "running")

    def __init__(self) -> None:
        self.running = 0
        self.latest: dict[str, tuple[int, ParameterValue | None]] = {}

    def note(self, number: int, values: dict[str, ParameterValue | None]) -> None:
        """Note values, unless later ones are known."""
        for name, value in values.items():
            came, _ = self.latest.get(name, (0, None))
            if came < number and (came or len(self.latest) < NAMES):
                self.latest[name] = (number, value)

    def later_than(self, number: int) -> dict[str, ParameterValue | None]:
        """The values that came after a number."""
        return {name: value for name, (came, value) in self.latest.items() if came > number}


class _Silence(NamedTuple):
    """:param times: requests in a row that the node did not answer
    :param until: seconds of the clock until which it is left out
    """

    times: int
    until: float


class ParameterCache:
    """Values of parameters, and one subscription to ``/parameter_events`` while clients use them."""

    log = Logger()
    user = _NO_USER
    plain_instead = 0
    queued_bytes = 0

    def __init__(self, clock: Clock, link_state: RobotLinkState, subscriptions: Subscriptions) -> None:
        self._clock = clock
        self._link_state = link_state
        self._subscriptions = subscriptions
        self._nodes: dict[str, _KnownNode] = {}
        self._silent: dict[str, _Silence] = {}
        self._reads: dict[str, _NodeReads] = {}
        self._numbers = itertools.count(1)
        """Of reads and events, in the order in which they begin and arrive."""
        self._running: dict[_ReadKey, Deferred[SwitchboardError | None]] = {}
        """Reads that wait for the robot. They end with the error, and go on when the client that began one leaves."""
        self._listeners: set[ParameterListener] = set()
        self._following = False
        self._end_timer: Timer | None = None

    # --- clients ------------------------------------------------------------------------------------------

    def follow(self, listener: ParameterListener) -> None:
        """A client uses the cache from now on."""
        if listener in self._listeners:
            return
        self._listeners.add(listener)
        cancel(self._end_timer)
        if not self._following:
            subscription = ClientSubscription(self._clock, self, TOPIC)
            subscription.add(rosbridge.Subscribe(topic=TOPIC))
            try:
                self._subscriptions.add(self, subscription, TYPE, None)
                self._following = True
            except SwitchboardError as error:
                self.notify("error", str(error))

    def unfollow(self, listener: ParameterListener) -> None:
        """A client has left."""
        if listener in self._listeners:
            self._listeners.remove(listener)
            if not self._listeners:
                self._end_timer = self._clock.callLater(KEPT_SECONDS, self._end)

    def _end(self) -> None:
        self.lost()
        if self._following:
            self._following = False
            self._subscriptions.remove(self, TOPIC)

    # --- the channel --------------------------------------------------------------------------------------

    def lost(self) -> None:
        """Forget all values, as changes are missed."""
        self._nodes.clear()
        self._silent.clear()

    def graph_changed(self) -> None:
        """Forget nodes that are gone."""
        services = self._link_state.robot.graph.services
        for nodes in (self._nodes, self._silent):
            for node in [each for each in nodes if f"{each}/get_parameters" not in services]:
                del nodes[node]

    def close(self) -> None:
        """The channel was closed."""
        cancel(self._end_timer)

    # --- reading ------------------------------------------------------------------------------------------

    def values(self, node: str) -> dict[str, ParameterValue]:
        """The known parameters of a node, by name."""
        known = self._nodes.get(node)
        return {} if known is None else known.values

    def is_silent(self, node: str) -> bool:
        """Whether a node is left out now; see :data:`SILENT_SECONDS`."""
        return node in self._silent and self._clock.seconds() < self._silent[node].until

    def knows(self, node: str, names: Sequence[str] | None) -> bool:
        """Whether parameters of a node need not be read; ``None``: all."""
        known = self._nodes.get(node)
        if known is None or not self._following:
            return False
        since = known.all_known_since(names)
        return since is not None and self._clock.seconds() < since + KEPT_SECONDS

    async def read(self, node: str, names: Sequence[str] | None, reader: Reader) -> None:
        """Read parameters of a node that are not known; clients that want the same at the same time share one read.

        :param reader: for the client that calls this
        :raises SwitchboardError: the node does not answer, or not with parameters; the client may not read them
        """
        key = (node, None if names is None else tuple(names))
        while not self.knows(node, names):
            running = self._running.get((node, None)) or self._running.get(key)
            mine = running is None
            error = await _outcome(self._begin(key, reader) if running is None else running)
            if error is None:
                return
            # A refusal concerns the client that began the read.
            if mine or not isinstance(error, Refused):
                raise error

    async def read_again(self, node: str, names: Sequence[str], reader: Reader) -> None:
        """Read parameters of a node that a client has set; see :meth:`read`."""
        error = await self._read((node, tuple(names)), reader)
        if error is not None:
            raise error

    def _begin(self, key: _ReadKey, reader: Reader) -> Deferred[SwitchboardError | None]:
        def ended(result: Any) -> Any:
            del self._running[key]
            return result

        running = self._running[key] = Deferred.fromCoroutine(self._read(key, reader))
        return running.addBoth(ended)

    async def _read(self, key: _ReadKey, reader: Reader) -> SwitchboardError | None:
        node, names = key
        number = next(self._numbers)
        reads = self._reads.setdefault(node, _NodeReads())
        reads.running += 1
        try:
            values = await reader(names)
        except Refused as error:
            return error
        except SwitchboardError as error:
            self._nodes.pop(node, None)
            if isinstance(error, Unavailable) and self._link_state.link is not None:
                self._count_silence(node)
            return error
        finally:
            reads.running -= 1
            if not reads.running:
                del self._reads[node]
        self._silent.pop(node, None)
        read: dict[str, ParameterValue | None] = {**dict.fromkeys(names or ()), **values}
        # The node may have answered before a change whose event, or whose read, has arrived already.
        later = reads.later_than(number)
        reads.note(number, read)
        now = self._clock.seconds()
        known = self._nodes.get(node)
        if known is None or names is None:
            known = self._nodes[node] = _KnownNode(now if names is None else None)
        known.apply(read | later, now)
        return None

    def _count_silence(self, node: str) -> None:
        times = self._silent[node].times + 1 if node in self._silent else 1
        seconds = min(SILENT_SECONDS * (times - 1), KEPT_SECONDS)
        self._silent[node] = _Silence(times, self._clock.seconds() + seconds)

    # --- events -------------------------------------------------------------------------------------------

    def deliver(self, subscription: ClientSubscription, sample: Sample) -> None:
        """Keep the values of an event, and notify the clients."""
        body = sample.json()
        if isinstance(body, SwitchboardError):
            return
        try:
            event = jsontext.decode_any(body)
            node = str(event["node"])
            fresh = [*event["new_parameters"], *event["changed_parameters"]]
            changed: dict[str, ParameterValue | None] = {str(each["name"]): each["value"] for each in fresh}
            changed |= {str(each["name"]): None for each in event["deleted_parameters"]}
        except (TypeError, KeyError, SwitchboardError):
            return
        if node in self._reads:
            self._reads[node].note(next(self._numbers), changed)
        if node in self._nodes:
            self._nodes[node].apply(changed, self._clock.seconds())
        for listener in list(self._listeners):
            listener.parameters_changed(node, changed)

    def warn_of_drops(self, text: str, id: rosbridge.Id = None) -> None:
        """Log it."""
        self.notify("warning", text)

    def notify(self, level: str, text: str, id: rosbridge.Id = None) -> None:
        """Log a status."""
        self.log.warn(
            "the parameters of {robot}: {text}",
            robot=self._link_state.robot.full,
            text=text,
            severity=level,
        )

    def dropped(self, subscription: ClientSubscription) -> None:
        """Nothing: no sample is queued here."""


def _outcome(
    running: Deferred[SwitchboardError | None],
) -> Deferred[SwitchboardError | None]:
    """Fires as a read does; cancelling it does not cancel the read."""
    waiting: Deferred[SwitchboardError | None] = Deferred()

    def done(result: Any) -> Any:
        if not waiting.called:
            waiting.callback(result)
        return result

    running.addBoth(done)
    return waiting
