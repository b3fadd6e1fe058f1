"""Clients that violate all rules with seeded random messages: each gets an error or is cut, and no other
client is affected.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import typing
from collections.abc import Iterator
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from relay_protocol import rosbridge
from tests.worlds.bystanders import Watcher, undisturbed
from tests.worlds.waiting import PATIENCE

OPS = {each.__struct_config__.tag: each.__struct_fields__ for each in typing.get_args(rosbridge.ClientOp)}
NAMES = (
    "/odom",
    "scan",
    "/cmd_vel",
    "/reset",
    "/rosapi/topics",
    "/relay/status",
    "/nowhere",
    "",
    "/",
    "//",
    "1x",
    "~",
)
TYPES = (
    "std_msgs/msg/String",
    "nav_msgs/Odometry",
    "std_srvs/srv/Trigger",
    "example_interfaces/action/Fibonacci",
    "?",
    "a/b/c/d",
)
ODD = (
    None, True, False, 0, -1, 1, 7, 2**31, -(2**63), 2**64, 1e308, 0.5, "", "x", "\x00", "é" * 300, "none", "cbor",
    "png", "cbor-raw", [], {}, [[]], {"a": {"b": {}}}, [1, "2", None], {"data": "x"}, {"depth": -5},
    {"reliability": "maybe"}, {"order": 3}, {"linear": {"x": "fast"}},
)  # fmt: skip
"""Values that are right for some field, and wrong for most."""
MESSAGES = 4000
TELL = '{"op":"set_level","level":"error"}'


@pytest.fixture(autouse=True)
def others_unaffected(world: Any, watchers: list[Watcher]) -> Iterator[None]:
    """Bystanders, process, log and robot are unaffected."""
    daemon = len(world.robot.daemon.log.read_text())
    with undisturbed(world.relay, watchers):
        yield
    assert world.robot.daemon.popen.poll() is None
    assert "Traceback" not in world.robot.daemon.log.read_text()[daemon:]


def value_for(field: str, chance: random.Random) -> Any:
    """A value that often has the field's type."""
    if chance.random() < 0.25:
        return chance.choice(ODD)
    if field in ("topic", "service", "action"):
        return chance.choice(NAMES)
    if field in ("type", "action_type"):
        return chance.choice(TYPES)
    if field == "id":
        return chance.choice(("a", "b", 3, None))
    return chance.choice(ODD)


def message(chance: random.Random) -> str | bytes:
    """A message: an op with some of its fields, or sometimes less."""
    op = chance.choice(list(OPS))
    fields = {field: value_for(field, chance) for field in OPS[op] if chance.random() < 0.8}
    text = json.dumps({"op": op, **fields})
    kind = chance.random()
    if kind < 0.05:
        return text[: chance.randrange(len(text))]
    if kind < 0.08:
        return text.replace('"', chance.choice(("'", "", '""')))
    if kind < 0.1:
        return chance.choice(
            ("null", "[]", "3", '"op"', "{}", '{"op":null}', '{"op":["publish"]}', "\ufeff{}")
        )
    return text


def connected(world: Any, token: str) -> ClientConnection:
    """A hostile client's connection."""
    return connect(
        world.relay.url("rover"),
        additional_headers={"Authorization": f"Bearer {token}"},
        max_size=None,
        compression=None,
        open_timeout=PATIENCE,
    )


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_random_operations_are_refused_or_disconnected(world: Any, seed: int) -> None:
    """Each refusal has a reason; a cut client gets a code and a reason, reconnects and continues."""
    chance = random.Random(seed)
    left = MESSAGES
    reported: list[str] = []
    while left:
        with connected(world, world.operator) as client:
            try:
                client.send(TELL)
                while left:
                    left -= 1
                    if left % 100 == 0:
                        client.send(TELL)  # one of the messages may have turned statuses off
                    client.send(message(chance))
                    errors(client, 0, reported)
                errors(client, 1, reported)
            except ConnectionClosed as cut:
                assert cut.rcvd is not None
                assert cut.rcvd.reason
                with contextlib.suppress(ConnectionClosed):
                    errors(client, 1, reported)
    assert len(reported) > MESSAGES / 20


def errors(client: ClientConnection, seconds: float, reported: list[str]) -> None:
    """Collects errors until none arrives for a while."""
    with contextlib.suppress(TimeoutError):
        while True:
            heard = client.recv(timeout=seconds)
            if isinstance(heard, str) and '"level":"error"' in heard:
                reported.append(heard)


def test_random_bytes_after_the_handshake_are_cut(world: Any) -> None:
    """Frames with reserved bits, without masks, with wrong lengths, half of them unfinished."""
    chance = random.Random(4)
    for _ in range(40):
        with contextlib.suppress(ConnectionClosed, OSError), connected(world, world.viewer) as client:
            client.socket.sendall(chance.randbytes(chance.randrange(1, 4000)))
            if chance.random() < 0.5:
                client.socket.close()


def test_a_flood_of_all_operations_disturbs_no_other_client(world: Any) -> None:
    """Ten clients of one user, each at full speed, without reading answers."""
    chance = random.Random(5)
    texts = [message(chance) for _ in range(200)]
    with contextlib.ExitStack() as stack:
        clients = [stack.enter_context(connected(world, world.operator)) for _ in range(10)]
        for _ in range(10):
            for client in clients:
                with contextlib.suppress(ConnectionClosed):
                    for text in texts:
                        client.send(text)
        for client in clients:
            client.socket.close()


def test_an_unfinished_message_delays_no_other_client(world: Any) -> None:
    """An endless frame, a fragmented message without its last part, fragments without the others."""
    mask = os.urandom(4)
    with contextlib.ExitStack() as stack:
        first, second, third, another = (
            stack.enter_context(connected(world, world.viewer)) for _ in range(4)
        )
        first.socket.sendall(b"\x81\xff" + (500_000).to_bytes(8, "big") + mask + bytes(1000))
        second.socket.sendall(b"\x01\x85" + mask + bytes(5))
        third.send('{"op":"fragment","id":"f","num":0,"total":2,"data":"{"}')
        another.send('{"op":"call_service","service":"/rosapi/get_time","id":"now"}')
        assert json.loads(another.recv(timeout=PATIENCE))["id"] == "now"
        for client in (first, second):
            client.socket.close()
