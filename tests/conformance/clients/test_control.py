"""Control of the robot, by any rosbridge client."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from conformance_suite import Hand, Server, case
from rosbridge_client import Client

CONTROL = "SPEC 1.7 Control"
TWIST = "geometry_msgs/msg/Twist"


@pytest.fixture
def pair(server: Server) -> Iterator[tuple[Client, Client]]:
    """Two clients that follow control; after each case the robot is free and not stopped."""
    with server.connect() as one, server.connect() as two:
        for each in (one, two):
            each.send("set_level", level="error")
            each.send("subscribe", topic="/relay/control")
            each.until("publish", topic="/relay/control")
        yield one, two
        one.values("/relay/resume")
        for each in (one, two):
            each.values("/relay/release_control")


def reported(client: Client, state: str) -> Any:
    """The next message on ``/relay/control`` with this state."""
    while True:
        message = client.until("publish", topic="/relay/control")["msg"]
        if message["state"] == state:
            return message


@case("call_service", f"{CONTROL}, /relay/take_control")
def test_control_take(pair: tuple[Client, Client]) -> None:
    """A free robot becomes the caller's; all followers receive the new controller."""
    one, two = pair
    assert one.values("/relay/take_control", {"why": "a case"})["success"] is True
    mine, other = reported(one, "held"), reported(two, "held")
    assert mine["holder"]["you"] is True
    assert mine["you"]["client"] == mine["holder"]["client"]
    assert other["holder"]["you"] is False
    assert other["you"]["client"] != other["holder"]["client"]
    assert one.values("/relay/release_control")["success"] is True
    assert reported(two, "free")["holder"] is None


@case("call_service", f"{CONTROL}, answers")
def test_control_answers(pair: tuple[Client, Client]) -> None:
    """Impossible requests are answered with success false and a reason."""
    one, _ = pair
    for service in ("release_control", "grant_control", "refuse_control"):
        answer = one.values(f"/relay/{service}")
        assert answer["success"] is False, service
        assert answer["message"]


@case("publish", f"{CONTROL}, the first command")
def test_control_first_command(pair: tuple[Client, Client], hand: Hand, topic: str) -> None:
    """The first command takes a free robot and is obeyed; another publisher gets the controller's name in an
    error.
    """
    one, two = pair
    hand.listen(topic, TWIST)
    one.send("advertise", topic=topic, type=TWIST)
    for _ in range(20):
        one.send("publish", topic=topic, msg={"linear": {"x": 0.1}})
    assert reported(one, "held")["holder"]["you"] is True
    reported(two, "held")


@case("call_service", f"{CONTROL}, /relay/stop")
def test_control_stop(pair: tuple[Client, Client]) -> None:
    """A stop is published with user and reason, until a resume."""
    one, two = pair
    answer = one.values("/relay/stop", {"why": "a case"})
    assert (answer["success"], answer["done"]) == (True, True)
    while not (stopped := two.until("publish", topic="/relay/control")["msg"]["stopped"]):
        pass
    assert stopped["why"] == "a case"
    assert stopped["by"]
    assert one.values("/relay/resume")["success"] is True
    while two.until("publish", topic="/relay/control")["msg"]["stopped"]:
        pass


@case("call_service", f"{CONTROL}, /relay/suppress, /relay/inhibit")
def test_control_times(client: Client) -> None:
    """Invalid durations are refused with a reason."""
    for service, ms in (("suppress", 20), ("suppress", 201), ("inhibit", -1), ("inhibit", 60_001)):
        answer = client.call(f"/relay/{service}", {"resource": "/conformance/cmd_vel", "ms": ms})
        assert answer["result"] is False, (service, ms)
        assert "ms" in answer["values"]


@case("call_service", f"{CONTROL}, /relay/inhibit")
def test_control_inhibit(client: Client) -> None:
    """An inhibited topic sends no samples, and continues when the inhibition ends."""
    client.send("subscribe", topic="/conformance/counter", type="std_msgs/msg/Int64")
    client.until("publish", topic="/conformance/counter")
    asked = {"resource": "/conformance/counter", "ms": 30_000}
    assert client.values("/relay/inhibit", asked)["success"] is True
    client.all_within("publish", 0.3, topic="/conformance/counter")
    client.none("publish", topic="/conformance/counter")
    assert client.values("/relay/inhibit", {**asked, "ms": 0})["success"] is True
    client.until("publish", topic="/conformance/counter")
