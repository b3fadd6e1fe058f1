"""A name server that hangs holds up nobody but who asked it."""

from __future__ import annotations

import socket
import threading
from collections.abc import AsyncIterator
from typing import Any

import pytest
import pytest_twisted
from twisted.internet.defer import Deferred

from relay_server.alerts import egress as module
from relay_server.alerts.egress import LOOKUPS, SPECIAL_NAMES, THREADS, NameResolver, unreachable
from relay_server.alerts.message import Undelivered
from tests.relay_server.alerts.receiver import REACTOR
from tests.relay_server.edges.robot_ends import until

EVE, ANN = 1, 2


class Scene:
    """Names, of which those below ``slow.test`` hang until the test lets them go."""

    def __init__(self) -> None:
        self.names = NameResolver(REACTOR)
        self.go = threading.Event()
        self.asked: list[str] = []

    def system(self, host: str, port: int, **_: Any) -> list[Any]:
        """What the system says of a name. In a thread."""
        self.asked.append(host)
        if host.endswith(".slow.test"):
            self.go.wait()
            raise OSError("no such name")
        return [(0, 0, 0, "", ("192.0.2.7", port))]

    def asks(self, host: str, user: int) -> Deferred[list[str]]:
        """Somebody's message waits for a name."""
        return Deferred.fromCoroutine(self.names.addresses(host, 80, user))


@pytest_twisted.async_yield_fixture
async def scene(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Scene]:
    """Nothing was asked yet; who asks gives up soon."""
    made = Scene()
    monkeypatch.setattr(socket, "getaddrinfo", made.system)
    monkeypatch.setattr(module, "SECONDS", 0.2)
    made.names.start()
    yield made
    made.go.set()
    made.names.stop()


async def gives_up(asking: Deferred[list[str]]) -> str:
    """Why there is no answer."""
    with pytest.raises(Undelivered) as error:
        await asking
    return str(error.value)


@pytest_twisted.ensureDeferred
async def test_one_users_slow_names_are_in_nobody_elses_way(scene: Scene) -> None:
    """However often he asks: given up or not, what hangs keeps his place, and he has fewer than there are threads."""
    for _ in range(3):
        for asking in [scene.asks(f"{number}.slow.test", EVE) for number in range(THREADS)]:
            await gives_up(asking)
    assert len(scene.asked) == LOOKUPS < THREADS
    assert await scene.asks("plain.test", ANN) == ["192.0.2.7"]
    await gives_up(scene.asks("plain.test", EVE))
    assert scene.asked.count("plain.test") == 1
    scene.go.set()
    await until(lambda: not scene.names._places)
    assert await scene.asks("plain.test", EVE) == ["192.0.2.7"]


@pytest_twisted.ensureDeferred
async def test_who_waits_has_his_turn(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """As soon as one of his own is done."""
    monkeypatch.setattr(module, "SECONDS", 60.0)
    slow = [scene.asks(f"{number}.slow.test", ANN) for number in range(LOOKUPS)]
    asking = scene.asks("plain.test", ANN)
    scene.go.set()
    assert await asking == ["192.0.2.7"]
    for each in slow:
        await gives_up(each)
    assert scene.names._places == {}


@pytest.mark.parametrize(
    ("host", "address"),
    [("192.0.2.1", "192.0.2.1"), ("2001:DB8::0:1", "2001:db8::1"), ("::ffff:127.0.0.1", "::ffff:127.0.0.1")],
)
@pytest_twisted.ensureDeferred
async def test_of_an_address_nobody_is_asked(scene: Scene, host: str, address: str) -> None:
    """Also while all that may be asked is."""
    for asking in [scene.asks(f"{number}.slow.test", ANN) for number in range(LOOKUPS)]:
        await gives_up(asking)
    (found,) = await scene.asks(host, ANN)
    assert (found.replace("7f00:1", "127.0.0.1"), host in scene.asked) == (address, False)


@pytest_twisted.ensureDeferred
async def test_people_do_not_hear_whether_a_name_is_known(scene: Scene) -> None:
    """Of the relay's own networks; an address they know as well as we."""
    unknown = await gives_up(scene.asks("x.slow.test", ANN))
    internal = unreachable("x.slow.test", SPECIAL_NAMES)
    assert (unknown, internal.again) == (str(internal), True)
    plain = unreachable("10.0.0.7", SPECIAL_NAMES)
    assert (str(plain).startswith(f"10.0.0.7: {SPECIAL_NAMES}"), plain.again) == (True, False)
