"""Topics that do not exist yet, and publishers that return with changes, in a real graph."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.worlds.processes import Process, ros_environment
from tests.worlds.sync_client import Client
from tests.worlds.waiting import wait_for

TALKING = Path(__file__).parent / "clients" / "talking.py"
STRING, BOOL = "std_msgs/msg/String", "std_msgs/msg/Bool"
HEADED = "switchboard_test_interfaces/msg/Headed"

Talking = Callable[..., AbstractContextManager[None]]


@pytest.fixture
def talking(world: Any, tmp_path: Path) -> Talking:
    """Starts a publishing node in the robot's graph."""
    numbers = itertools.count()

    @contextmanager
    def start(topic: str, type_name: str, qos: str = "reliable") -> Iterator[None]:
        command = [sys.executable, str(TALKING), topic, type_name, qos]
        name = f"talks{next(numbers)}"
        node = Process(command, tmp_path, name, ros_environment(world.robot.domain))
        try:
            node.wait_to_say("READY")
            yield
        finally:
            node.stop()

    return start


@pytest.fixture
def clients(world: Any) -> Iterator[list[Client]]:
    """Three viewers that receive errors."""
    found = [world.relay.connect("rover", world.viewer) for _ in range(3)]
    try:
        for client in found:
            client.send(op="set_level", level="error")
        yield found
    finally:
        for client in found:
            client.close()


def known(client: Client, topic: str, type_name: str) -> None:
    """Waits until the relay knows a topic."""

    def has_it() -> bool:
        return bool(client.call("/rosapi/topic_type", {"topic": topic})["values"] == {"type": type_name})

    wait_for(f"{topic} is known", has_it)


def test_early_subscriber_with_the_right_type(talking: Talking, clients: list[Client]) -> None:
    """The first client's wrong guess blocks no other client, and causes an error for the first."""
    wrong, right, again = clients
    wrong.send(op="subscribe", topic="/to_come", type=BOOL)
    right.send(op="subscribe", topic="/to_come", type=STRING)
    right.call("/rosapi/topics")
    with talking("/to_come", STRING):
        assert right.until(op="publish", topic="/to_come")["msg"] == {"data": ""}
        words = wrong.until(op="status")["msg"]
        assert (
            words
            == f"subscribe /to_come: it has the type {STRING}, not {BOOL}; subscribe with {STRING} to get it"
        )
        again.send(op="subscribe", topic="/to_come", type=BOOL)
        assert again.until(op="status")["msg"] == f"topic /to_come has the type {STRING}, not {BOOL}"
        wrong.send(op="subscribe", topic="/to_come", type=STRING)
        assert wrong.until(op="publish", topic="/to_come")["msg"] == {"data": ""}


def test_publishers_that_come_back_with_another_type(talking: Talking, clients: list[Client]) -> None:
    """Clients without a type get the new messages on the same subscription."""
    careless, exact, _ = clients
    with talking("/changing", STRING):
        known(careless, "/changing", STRING)
        exact.send(op="subscribe", topic="/changing", type=STRING)
        exact.until(op="publish", topic="/changing")
        careless.send(op="subscribe", topic="/changing")
        assert careless.until(op="publish", topic="/changing")["msg"] == {"data": ""}
    with talking("/changing", BOOL):
        assert careless.until(op="publish", topic="/changing", msg={"data": False})
        assert "it has the type std_msgs/msg/Bool" in exact.until(op="status")["msg"]


def test_publishers_that_come_back_with_another_qos(talking: Talking, clients: list[Client]) -> None:
    """A topic that is latched now is latched for late subscribers too."""
    first, second, _ = clients
    with talking("/settling", STRING):
        known(first, "/settling", STRING)
        first.send(op="subscribe", topic="/settling")
        first.until(op="publish", topic="/settling")
    with talking("/settling", STRING, "latched"):
        first.until(op="publish", topic="/settling")
        second.send(op="subscribe", topic="/settling", type=STRING)
        second.until(op="publish", topic="/settling")


def test_a_package_with_a_header_of_its_own(talking: Talking, clients: list[Client]) -> None:
    """A name without a package means the message of the same package, as in rosidl."""
    client = clients[0]
    with talking("/headed", HEADED):
        client.send(op="subscribe", topic="/headed", type=HEADED)
        message = client.until(op="publish", topic="/headed")["msg"]
        assert message["header"] == {"number": 0, "note": ""}
        assert message["stamped"]["frame_id"] == ""
        details = client.call("/rosapi/message_details", {"type": HEADED})["values"]["typedefs"]
        assert details[0]["fieldtypes"] == [
            "switchboard_test_interfaces/Header", "switchboard_test_interfaces/Header", "std_msgs/Header"
        ]  # fmt: skip
