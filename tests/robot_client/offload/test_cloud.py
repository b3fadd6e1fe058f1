"""Replies of the relay as results and exceptions."""

from __future__ import annotations

import math
import os
import socket
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import pytest_twisted
from twisted.internet import reactor
from twisted.internet.task import deferLater
from twisted.internet.threads import deferToThread

from relay_protocol.errors import Invalid, SwitchboardError, Unavailable
from relay_protocol.function_link import FunctionReply
from relay_protocol.functions import CallFailed
from robot_client.offload import Device, DeviceState, function_link, offload
from robot_client.offload.cloud import Cloud, result_of
from robot_client.offload.deferred import DeferredCloud
from robot_client.offload.device import publish
from robot_client.offload.function_link import FunctionConnection, Overtaken
from tests.worlds.waiting import wait_for


@pytest.mark.parametrize(
    ("state", "code", "error"),
    [
        ("refused", "unavailable", Unavailable),
        ("refused", "too_many_jobs", CallFailed),
        ("failed", "lost", CallFailed),
    ],
)
def test_a_call_for_which_there_is_no_worker_is_unavailable(
    state: str, code: str, error: type[SwitchboardError]
) -> None:
    with pytest.raises(error, match="no worker"):
        result_of(FunctionReply(state=state, code=code, error="no worker"))


class Robot:
    """A node with a method that may run in the cloud."""

    def __init__(self) -> None:
        self.seen: list[int] = []

    @offload("double", when=lambda device: False)
    def doubled(self, number: int = 4) -> int:
        """Here."""
        self.seen.append(number)
        return 2 * number


class Calls(Cloud):
    """Records calls."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[tuple[str, dict[str, Any]]] = []

    def call(self, function: str, /, **arguments: Any) -> Any:
        for option in ("timeout", "newest", "version"):
            arguments.pop(option)
        self.calls.append((function, arguments))
        return 0


def test_a_method_may_be_offloaded() -> None:
    """Its object is not sent. Where it runs can be read from the class and from an object."""
    robot, client = Robot(), Calls()
    assert (robot.doubled(3), robot.seen) == (6, [3])
    Robot.doubled._cloud, Robot.doubled._when = client, lambda device: True
    assert (robot.doubled(5), robot.doubled(number=6)) == (0, 0)
    assert client.calls == [("double", {"number": 5}), ("double", {"number": 6})]
    assert robot.doubled.latest.where == Robot.doubled.latest.where == "cloud"
    assert robot.seen == [3]


@pytest.fixture
def slow(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Cloud, socket.socket]]:
    """A robot whose link takes a few bytes, and the other end."""
    ours, other = socket.socketpair()
    ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
    monkeypatch.setattr(function_link, "_dial", lambda enrolment: ours)
    monkeypatch.setattr(FunctionConnection, "_greet", lambda self: None)
    enrolment, identity = cast(Any, SimpleNamespace(address="relay")), cast(Any, None)
    connection = FunctionConnection(enrolment, identity)
    client = Cloud()
    monkeypatch.setattr(client, "_connect", lambda: connection)
    yield client, other
    connection.close("over")
    other.close()


def test_a_call_that_was_not_sent_in_time_has_not_run(slow: tuple[Cloud, socket.socket]) -> None:
    """It is withdrawn, so it is never sent, and the next one does not wait behind it."""
    client, _ = slow
    with pytest.raises(CallFailed, match="it may have run"):
        client.call("look", timeout=0.3, frame=bytes(1_000_000))
    for _ in range(3):
        with pytest.raises(Unavailable, match=r"could not be sent in 0\.1 s"):
            client.call("look", timeout=0.1, frame=bytes(1_000_000))
    assert client._connection is not None
    assert not client._connection._waiting
    for _ in range(60):
        client.submit("look", frame=bytes(1_000_000))
    with pytest.raises(Unavailable, match="bytes of calls wait for the slow link"):
        for _ in range(10):
            client.submit("look", frame=bytes(1_000_000))


def test_a_call_does_not_wait_longer_for_the_link_than_it_may(monkeypatch: pytest.MonkeyPatch) -> None:
    """The relay's name is looked up for ever. All callers wait for one attempt, each as long as it may."""
    client, looked_up, attempts = Cloud(), threading.Event(), list[str]()

    def connect() -> FunctionConnection:
        attempts.append("")
        assert looked_up.wait(60)
        raise Unavailable("there is no such relay")

    monkeypatch.setattr(client, "_connect", connect)
    with ThreadPoolExecutor(2) as pool:
        patient = pool.submit(client.call, "look", timeout=60)
        for _ in range(3):
            with pytest.raises(Unavailable, match=r"can't be reached in 0\.1 s"):
                client.call("look", timeout=0.1)
        looked_up.set()
        with pytest.raises(Unavailable, match="no such relay"):
            patient.result(60)
    assert len(attempts) == 1
    with pytest.raises(Unavailable, match="no such relay"):
        client.call("look", timeout=60)
    assert len(attempts) == 1


def test_a_link_that_is_closed_while_it_is_dialled_stays_closed(slow: tuple[Cloud, socket.socket]) -> None:
    client, _ = slow
    connect, go_on = client._connect, threading.Event()

    def later() -> FunctionConnection:
        assert go_on.wait(60)
        return connect()

    client._connect = later  # type: ignore[method-assign]
    with ThreadPoolExecutor(1) as pool:
        call = pool.submit(client.call, "look", timeout=60)
        wait_for("it is dialled", lambda: client._dialled is not None)
        client.close()
        go_on.set()
        with pytest.raises(Unavailable, match="the program has closed the link"):
            call.result(60)
    assert client._connection is None


def _is_sent_alone(client: Cloud) -> bool:
    connection = client._connection
    return connection is not None and bool(connection._replies) and not connection._waiting


def test_calls_of_two_cameras_do_not_replace_each_other(slow: tuple[Cloud, socket.socket]) -> None:
    client, _ = slow
    frame = bytes(1_000_000)
    with ThreadPoolExecutor(4) as pool:
        first = pool.submit(client.call, "look", timeout=60, newest="front", frame=frame)
        wait_for("the first is being sent", lambda: _is_sent_alone(client))
        front = pool.submit(client.call, "look", timeout=60, newest="front", frame=frame)
        wait_for("the second waits", lambda: client._connection and client._connection._waiting)
        rear = pool.submit(client.call, "look", timeout=60, newest="rear", frame=frame)
        wait_for("both wait", lambda: client._connection and len(client._connection._waiting) == 2)
        newer = pool.submit(client.call, "look", timeout=60, newest="front", frame=frame)
        with pytest.raises(Overtaken):
            front.result(60)
        client.close()
        for each in (first, rear, newer):
            with pytest.raises((CallFailed, Unavailable)):
                each.result(60)


@pytest.mark.parametrize("seconds", [0.0, -1.0, 86_401.0, math.nan])
def test_a_time_that_the_relay_would_refuse_is_refused_before(seconds: float) -> None:
    """The relay closes the link on an invalid request, and other calls of the program with it."""
    with pytest.raises(Invalid, match="must be more than 0 and at most 86400 s"):
        Cloud().call("look", timeout=seconds)
    with pytest.raises(Invalid, match="deadline"):
        Cloud().submit("look", deadline=seconds)
    with pytest.raises(Invalid, match="the key has 300 characters"):
        Cloud().submit("look", key="x" * 300)


def test_an_older_frame_stays_if_there_is_no_room_for_the_newer(slow: tuple[Cloud, socket.socket]) -> None:
    """Else neither would be sent, and the caller of the older would wait for nothing."""
    client, _ = slow
    with ThreadPoolExecutor(2) as pool:
        first = pool.submit(client.call, "look", timeout=60, newest=True, frame=bytes(1_000_000))
        wait_for("the first is being sent", lambda: _is_sent_alone(client))
        older = pool.submit(client.call, "look", timeout=60, newest=True, frame=bytes(1_000_000))
        wait_for("the second waits", lambda: client._connection and client._connection._waiting)
        with pytest.raises(Unavailable, match="bytes of calls wait"):
            for _ in range(70):
                client.submit("look", frame=bytes(1_000_000))
        with pytest.raises(Unavailable, match="bytes of calls wait"):
            client.call("look", timeout=60, newest=True, frame=bytes(2_000_000))
        assert client._connection is not None
        assert any(each.newest for each in client._connection._waiting)
        client.close()
        for each in (first, older):
            with pytest.raises((CallFailed, Unavailable)) as caught:
                each.result(60)
            assert not isinstance(caught.value, Overtaken)


def test_a_link_whose_thread_fails_is_closed(slow: tuple[Cloud, socket.socket]) -> None:
    """By any fault; calls fail at once, and the next one dials."""
    client, other = slow
    call = client.submit("look")
    connection = client._connection
    assert connection is not None
    connection._link = None  # type: ignore[assignment]
    other.send(b"x")
    with pytest.raises(SwitchboardError, match="lost"):
        call.id(60)
    assert not connection.open


def test_a_forked_program_has_a_link_of_its_own(slow: tuple[Cloud, socket.socket]) -> None:
    client, _ = slow
    client.submit("look")
    before = client._connection
    client._process += 1
    client._lock.acquire()
    client.submit("look")
    assert client._process == os.getpid()
    assert client._connection is not None
    assert before is not None


@pytest.mark.parametrize(("at", "critical"), [(900.0, True), (1100.0, True), (819.0, False), (1181.0, False)])
def test_a_state_counts_while_it_is_new(tmp_path: Path, at: float, critical: bool) -> None:
    """Also on a robot whose clock was set back."""
    publish(tmp_path, DeviceState(at, {"cpu": True}))
    assert Device(tmp_path, lambda: 1000.0).critical("cpu") is critical


@pytest_twisted.ensureDeferred
async def test_the_time_of_a_call_covers_the_wait_for_a_turn() -> None:
    workers, begun, goes = DeferredCloud(Cloud(), threads=1), threading.Event(), threading.Event()

    def busy() -> None:
        begun.set()
        goes.wait(60)

    first = workers.run(busy)
    await deferToThread(begun.wait, 60)
    second = workers.call("look", timeout=0.01)
    await deferLater(reactor, 0.05, lambda: None)
    goes.set()
    await first
    with pytest.raises(Unavailable, match=r"look was not begun in 0\.01 s"):
        await second
    await deferToThread(workers.close)
