"""A name server that hangs delays only requests for its own names."""

from __future__ import annotations

import socket
import threading
from collections.abc import AsyncIterator
from typing import Any

import pytest
import pytest_twisted
from twisted.internet.defer import Deferred

from relay_server.alerts import egress as module
from relay_server.alerts.egress import LOOKUPS, NOT_PERMITTED, THREADS, NameResolver, unreachable
from relay_server.alerts.schemas import Undelivered
from tests.worlds.alert_receivers import REACTOR
from tests.worlds.robot_links import until

EVE, ANN = 1, 2


class Scene:
    """A resolver whose names below ``slow.test`` hang until the test releases them."""

    def __init__(self) -> None:
        self.names = NameResolver(REACTOR)
        self.go = threading.Event()
        self.asked: list[str] = []

    def system(self, host: str, port: int, **_: Any) -> list[Any]:
        """The system's answer for a name. Called in a thread."""
        self.asked.append(host)
        if host.endswith(".slow.test"):
            self.go.wait()
            raise OSError("no such name")
        return [(0, 0, 0, "", ("192.0.2.7", port))]

    def asks(self, host: str, user: int) -> Deferred[list[str]]:
        """A message waits for the address of a name."""
        return Deferred.fromCoroutine(self.names.addresses(host, 80, user))


@pytest_twisted.async_yield_fixture
async def scene(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Scene]:
    """No name was requested yet; requests time out soon."""
    made = Scene()
    monkeypatch.setattr(socket, "getaddrinfo", made.system)
    monkeypatch.setattr(module, "LOOKUP_SECONDS", 0.2)
    made.names.start()
    yield made
    made.go.set()
    made.names.stop()


async def gives_up(asking: Deferred[list[str]]) -> str:
    """The error of a name without an answer."""
    with pytest.raises(Undelivered) as error:
        await asking
    return str(error.value)


@pytest_twisted.ensureDeferred
async def test_slow_lookups_of_one_user_do_not_delay_others(scene: Scene) -> None:
    for _ in range(3):
        for asking in [scene.asks(f"{number}.slow.test", EVE) for number in range(THREADS)]:
            await gives_up(asking)
    assert len(scene.asked) == LOOKUPS < THREADS
    assert await scene.asks("plain.test", ANN) == ["192.0.2.7"]
    await gives_up(scene.asks("plain.test", EVE))
    assert scene.asked.count("plain.test") == 1
    scene.go.set()
    await until(lambda: not scene.names._slots)
    assert await scene.asks("plain.test", EVE) == ["192.0.2.7"]


@pytest_twisted.ensureDeferred
async def test_waiting_lookups_are_done_in_turn(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "LOOKUP_SECONDS", 60.0)
    slow = [scene.asks(f"{number}.slow.test", ANN) for number in range(LOOKUPS)]
    asking = scene.asks("plain.test", ANN)
    scene.go.set()
    assert await asking == ["192.0.2.7"]
    for each in slow:
        await gives_up(each)
    assert scene.names._slots == {}


@pytest.mark.parametrize(
    ("host", "address"),
    [("192.0.2.1", "192.0.2.1"), ("2001:DB8::0:1", "2001:db8::1"), ("::ffff:127.0.0.1", "::ffff:127.0.0.1")],
)
@pytest_twisted.ensureDeferred
async def test_an_address_needs_no_lookup(scene: Scene, host: str, address: str) -> None:
    for asking in [scene.asks(f"{number}.slow.test", ANN) for number in range(LOOKUPS)]:
        await gives_up(asking)
    (found,) = await scene.asks(host, ANN)
    assert (found.replace("7f00:1", "127.0.0.1"), host in scene.asked) == (address, False)


@pytest_twisted.ensureDeferred
async def test_errors_do_not_show_whether_a_name_is_known(scene: Scene) -> None:
    unknown = await gives_up(scene.asks("x.slow.test", ANN))
    internal = unreachable("x.slow.test", NOT_PERMITTED)
    assert (unknown, internal.again) == (str(internal), True)
    plain = unreachable("10.0.0.7", NOT_PERMITTED)
    assert (str(plain).startswith(f"10.0.0.7: {NOT_PERMITTED}"), plain.again) == (True, False)
