"""A Foxglove client on a real connection to a relay."""

from __future__ import annotations

import itertools
import json
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from tests.worlds.waiting import PATIENCE


class FoxgloveConnection:
    """A connection with its advertised channels."""

    def __init__(self, connection: ClientConnection) -> None:
        self.connection = connection
        self.channels: dict[str, int] = {}
        self.services: dict[str, dict[str, Any]] = {}
        self.changes: list[tuple[str, Any]] = []
        """Of parameters that are followed."""
        self._ids = itertools.count(1)

    def send(self, op: str, **fields: Any) -> None:
        """Send a JSON message."""
        self.connection.send(json.dumps({"op": op, **fields}))

    def receive(self) -> dict[str, Any] | bytes:
        """The next message."""
        data = self.connection.recv(PATIENCE)
        if isinstance(data, bytes):
            return data
        message: dict[str, Any] = json.loads(data)
        if message["op"] == "advertise":
            self.channels |= {each["topic"]: each["id"] for each in message["channels"]}
        elif message["op"] == "advertiseServices":
            self.services |= {each["name"]: each for each in message["services"]}
        elif message["op"] == "parameterValues" and "id" not in message:
            self.changes += [(each["name"], each["value"]) for each in message["parameters"]]
        return message

    def until(self, fits: Callable[[Any], Any], what: str = "a message that fits") -> Any:
        """The next message that fits; others may come for as long as one is waited for."""
        late = time.monotonic() + PATIENCE
        while not fits(message := self.receive()):
            assert time.monotonic() < late, f"not within {PATIENCE:g} s: {what}"
        return message

    def next(self, op: str, fits: Callable[[dict[str, Any]], Any] = lambda message: True) -> dict[str, Any]:
        """The next JSON message of one op that fits."""
        found: dict[str, Any] = self.until(
            lambda each: isinstance(each, dict) and each["op"] == op and fits(each), f"{op} that fits"
        )
        return found

    def fetch(self, uri: str) -> bytes | str:
        """The bytes of an asset, or the reason why it is refused."""
        number = next(self._ids)
        self.send("fetchAsset", uri=uri, requestId=number)
        head = struct.pack("<BI", 4, number)
        answer: bytes = self.until(lambda each: isinstance(each, bytes) and each.startswith(head), uri)
        status, length = struct.unpack_from("<BI", answer, 5)
        return answer[10 : 10 + length].decode() if status else answer[10:]

    def channel(self, topic: str) -> int:
        """A topic's channel number, as soon as it is advertised."""
        while topic not in self.channels:
            self.receive()
        return self.channels[topic]

    def subscribe(self, topic: str) -> int:
        """Subscribes; returns the subscription's number."""
        id = next(self._ids)
        self.send("subscribe", subscriptions=[{"id": id, "channelId": self.channel(topic)}])
        return id

    def sample(self, subscription: int) -> bytes:
        """The next message of a subscription, without its header."""
        head = struct.pack("<BI", 1, subscription)
        found: bytes = self.until(lambda each: isinstance(each, bytes) and each.startswith(head))
        return found[13:]

    def parameters(self, *names: str) -> dict[str, Any]:
        """Values of parameters, all if none is named."""
        id = f"request {next(self._ids)}"
        self.send("getParameters", parameterNames=list(names), id=id)
        return self.values(id)

    def set(self, *entries: dict[str, Any]) -> dict[str, Any]:
        """Set parameters; their values afterwards."""
        id = f"request {next(self._ids)}"
        self.send("setParameters", parameters=list(entries), id=id)
        return self.values(id)

    def values(self, id: str) -> dict[str, Any]:
        """The values of the answer with this id."""
        answer = self.until(
            lambda each: (
                not isinstance(each, bytes) and each["op"] == "parameterValues" and each.get("id") == id
            )
        )
        return {each["name"]: each["value"] for each in answer["parameters"]}


@contextmanager
def opened(url: str, token: str) -> Iterator[FoxgloveConnection]:
    """A connection with an access token."""
    with connect(
        url,
        additional_headers={"Authorization": f"Bearer {token}"},
        subprotocols=[Subprotocol("foxglove.sdk.v1")],
        open_timeout=PATIENCE,
        max_size=None,
        max_queue=None,
    ) as connection:
        yield FoxgloveConnection(connection)
