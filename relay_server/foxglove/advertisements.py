"""The shared part of topics and services: each is advertised once with its definition, and withdrawn when it ends."""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, NamedTuple

from relay_protocol.limits import KIB
from relay_protocol.rights import Rules
from relay_protocol.ros_types import TypeRegistry
from relay_server.common.clock import Timer, cancel
from relay_server.foxglove.context import FoxgloveContext
from relay_server.foxglove.definitions import DefinitionRequests
from relay_server.relay_node.visible_graph import VisibleGraph, visible_graph
from relay_server.sessions.context import ClientContext

ENTRIES_AT_ONCE = 100
"""Most channels or services that are announced in one message."""

ANNOUNCED_BYTES = 128 * KIB
"""Most bytes of definitions in one message; a single definition may be longer."""

MESSAGES_AT_ONCE = 4
"""Most messages in one reactor turn."""

ANNOUNCE_SECONDS = 0.02
"""Seconds until announcements continue, when there are many or the client does not read."""

OBJECT_SCHEMA = '{"type":"object","properties":{}}'
"""JSON Schema of topics and services whose messages are JSON. The apps refuse a schema without ``properties``."""


class UpdateState(NamedTuple):
    """Everything that decides what is advertised. Each part is replaced as a whole when it changes."""

    graph: VisibleGraph
    known: bool
    types: TypeRegistry
    rules: Rules
    encodings: tuple[str, ...]

    @classmethod
    def of(cls, client: ClientContext) -> UpdateState:
        """The state as it is now."""
        robot = client.robot
        rules = client.permit.rules
        return cls(visible_graph(client), robot.graph.known, robot.types, rules, robot.encodings)

    def equals(self, other: UpdateState) -> bool:
        """Whether all parts are the same objects."""
        return all(mine is theirs for mine, theirs in zip(self, other, strict=True))


class PacedAnnouncer:
    """Announces channels or services in messages of bounded size, no faster than the client reads.

    :param encode: makes the websocket frames that announce some entries
    """

    def __init__(self, context: FoxgloveContext, encode: Callable[[list[dict[str, Any]]], bytes]) -> None:
        self._context = context
        self._encode = encode
        self._waiting: dict[int, tuple[int, Callable[[], dict[str, Any]]]] = {}
        """By its number: bytes of the definition, and the function that makes the entry."""
        self._announced: set[int] = set()
        self._timer: Timer | None = None

    def add(self, number: int, size: int, entry: Callable[[], dict[str, Any]]) -> None:
        """Announce an entry with the next :meth:`flush`.

        :param size: bytes of its definition
        """
        self._waiting[number] = size, entry

    def withdraw(self, number: int) -> bool:
        """Forget an entry; returns whether it was announced before."""
        self._waiting.pop(number, None)
        announced = number in self._announced
        self._announced.discard(number)
        return announced

    def flush_soon(self) -> None:
        """Announce what waits in the next reactor turn, if :meth:`flush` is not called before."""
        if self._waiting:
            cancel(self._timer)
            self._timer = self._context.clock.callLater(0, self.flush)

    def flush(self) -> None:
        """Announce what waits, as far as the client reads."""
        cancel(self._timer)
        self._timer = None
        for _ in range(MESSAGES_AT_ONCE):
            if not self._waiting or self._context.send_queue.waiting_bytes >= ANNOUNCED_BYTES:
                break
            entries: list[dict[str, Any]] = []
            size = 0
            for number in list(islice(self._waiting, ENTRIES_AT_ONCE)):
                length, entry = self._waiting[number]
                if entries and size + length > ANNOUNCED_BYTES:
                    break
                del self._waiting[number]
                self._announced.add(number)
                size += length
                entries.append(entry())
            self._context.send(self._encode(entries))
        if self._waiting:
            self._timer = self._context.clock.callLater(ANNOUNCE_SECONDS, self.flush)

    def end(self) -> None:
        """The session is over."""
        cancel(self._timer)
        self._waiting.clear()


@dataclass(slots=True)
class Advertisement:
    """A topic or service as it is advertised.

    :param number: of the channel or service; none is used twice on one connection
    :param encoding: ``cdr`` or ``json``
    :param schema: hash of the definitions' texts
    :param types: where its definitions were found last
    """

    number: int
    name: str
    type: str
    encoding: str
    schema: int
    types: TypeRegistry

    @property
    def schema_encoding(self) -> str:
        """The language of the definitions."""
        return "ros2msg" if self.encoding == "cdr" else "jsonschema"


class Advertisements(ABC):
    """The topics or the services that are advertised to one client; a subclass says which, and with what.

    :param status_id: of the status that names what is left out
    :param encode: makes the websocket frames that announce some entries
    :param encode_withdrawal: makes the websocket frames that withdraw some numbers
    """

    own_names: Collection[str]
    """Names that the relay itself offers; they do not end with the robot's graph."""

    parts: Sequence[str]
    """Suffixes of the types whose definitions are announced, such as ``_Request``."""

    def __init__(
        self,
        context: FoxgloveContext,
        status_id: str,
        encode: Callable[[list[dict[str, Any]]], bytes],
        encode_withdrawal: Callable[[list[int]], bytes],
    ) -> None:
        self._context = context
        self._numbers = itertools.count(2)
        self._by_name: dict[str, Advertisement] = {}
        self._by_number: dict[int, Advertisement] = {}
        self._announcer = PacedAnnouncer(context, encode)
        self._encode_withdrawal = encode_withdrawal
        self._definitions = DefinitionRequests(context, status_id, self.update)
        self._settled: UpdateState | None = None
        """The state for which everything is advertised or requested; ``None`` before the first update."""

    def end(self) -> None:
        """The session is over."""
        self._announcer.end()

    def update(self) -> None:
        """Advertise what the client may use now, and withdraw the rest, first."""
        state = UpdateState.of(self._context.client)
        if self._settled is not None and state.equals(self._settled) and not self._definitions.outdated:
            return
        self._settled, self._definitions.outdated = state, False
        wanted = self._wanted()
        self._withdraw([each for each in self._by_name.values() if not self._is_current(each, wanted)])
        undefined = [
            types
            for name, types in wanted.items()
            if name not in self._by_name and not self._add(name, types)
        ]
        self._definitions.request(undefined)
        self._announcer.flush()

    def announce_again(self) -> None:
        """Announce everything once more, with equal entries: the client has forgotten the types."""
        for each in self._by_number.values():
            texts = self._texts(each.types, each.type, each.encoding)
            # The robot may have sent another definition since; apps take no other for the same number.
            if _hash(texts) == each.schema:
                self._announce(each, texts)
        self._announcer.flush_soon()

    def _is_current(self, advertised: Advertisement, wanted: Mapping[str, Sequence[str]]) -> bool:
        if advertised.type not in wanted.get(advertised.name, ()):
            return False
        if advertised.name in self.own_names or not self._context.client.robot.graph.known:
            return True
        return advertised.encoding == self._encoding_of(advertised.name) and self._is_same(advertised)

    def _is_same(self, advertised: Advertisement) -> bool:
        """Whether the definition is what was advertised; a robot that registers again may have another one."""
        types = self._context.client.robot.types
        if advertised.encoding == "json" or advertised.types is types:
            return True
        if not types.knows(advertised.type):
            self._definitions.request_again(advertised.type)
            return True
        advertised.types = types
        return advertised.schema == _hash(self._texts(types, advertised.type, advertised.encoding))

    def _add(self, name: str, types: Sequence[str]) -> bool:
        """Advertise a topic or service; returns false if the definition of its type is not known yet."""
        known, encoding = self._types_of(name), self._encoding_of(name)
        if encoding == "json":
            type_name = types[0]
        elif not (type_name := next((each for each in types if known.knows(each)), "")):
            return False
        texts = self._texts(known, type_name, encoding)
        advertised = Advertisement(self._number_of(name), name, type_name, encoding, _hash(texts), known)
        self._by_name[name] = self._by_number[advertised.number] = advertised
        self._announce(advertised, texts)
        return True

    def _announce(self, advertised: Advertisement, texts: list[str]) -> None:
        """Announce a topic or service with the next flush."""
        size = sum(map(len, texts))
        self._announcer.add(advertised.number, size, lambda: self._entry(advertised, *texts))

    def _texts(self, types: TypeRegistry, type_name: str, encoding: str) -> list[str]:
        if encoding == "json":
            return [OBJECT_SCHEMA for _ in self.parts]
        return [types.full_text(f"{type_name}{part}") for part in self.parts]

    def _withdraw(self, ended: list[Advertisement]) -> None:
        announced = []
        for each in ended:
            del self._by_name[each.name], self._by_number[each.number]
            if self._announcer.withdraw(each.number):
                announced.append(each.number)
            self._withdrawn(each)
        if announced:
            self._context.send(self._encode_withdrawal(announced))

    def _number_of(self, name: str) -> int:
        return next(self._numbers)

    def _encoding_of(self, name: str) -> str:
        return "cdr" if "cdr" in self._context.client.robot.encodings else "json"

    def _types_of(self, name: str) -> TypeRegistry:
        return self._context.client.robot.types

    @abstractmethod
    def _withdrawn(self, advertised: Advertisement) -> None:
        """A topic or service is no longer advertised."""

    @abstractmethod
    def _wanted(self) -> dict[str, list[str]]:
        """Types of each topic or service that the client may use."""

    @abstractmethod
    def _entry(self, advertised: Advertisement, *texts: str) -> dict[str, Any]:
        """The entry of a topic or service in an advertisement.

        :param texts: one definition for each of :attr:`parts`
        """


def _hash(texts: Sequence[str]) -> int:
    return hash("".join(texts))
