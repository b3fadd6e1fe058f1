"""Fleet orders for robots whose home is another relay."""

from __future__ import annotations

import json
from typing import Any

import msgspec
import pytest
from twisted.internet.defer import Deferred

from relay_db.queries import RobotRecord
from relay_protocol.errors import Unavailable
from relay_server.access import Principal
from relay_server.cluster.fleet_orders import ClusterOrders, outcome_of
from relay_server.cluster.relays import RelayInfo
from relay_server.fleet.order import Order, TaskOutcome, body_of

ANN = Principal(1, "ann", "default", False, 2, None)
HOME = RelayInfo("home", "10.0.0.2", 9092, "1.0", 0.0)
START = b'{"do":"call","robots":["rover"],"unmatched":[]}\n'
RESULT = b'{"robot":"rover","ok":true,"message":"yes","values":{"a":1},"pending":false,"seconds":0.1}\n'
END = b'{"done":true,"robots":1,"ok":1,"failed":0,"seconds":0.1}\n'


class Fleet:
    """Homes and a forwarder: robot 1 is at another relay."""

    def __init__(self) -> None:
        self.asked: list[tuple[Any, ...]] = []

    def elsewhere(self, robot_id: int) -> RelayInfo | None:
        """The home of robot 1."""
        return HOME if robot_id == 1 else None

    async def ask(self, *arguments: Any) -> tuple[int, bytes]:
        """Executes the order."""
        self.asked.append(arguments)
        return 200, START + RESULT + END


def sent(fleet: Any, order: Order, robot_id: int) -> TaskOutcome | None:
    robot = RobotRecord(robot_id, "rover", "default", "")
    result: Any = Deferred.fromCoroutine(
        ClusterOrders(fleet, fleet).send(ANN, "192.0.2.1", order, robot)
    ).result
    return result  # type: ignore[no-any-return]


def test_an_order_goes_to_the_home_for_one_robot() -> None:
    """The user's rights apply. An order for a local robot is not forwarded."""
    fleet = Fleet()
    order = Order(["r*"], "call", service="/say", args=msgspec.Raw(b'{"x":1}'), timeout=3.0)
    assert sent(fleet, order, 2) is None
    assert sent(fleet, order, 1) == TaskOutcome(True, "yes", {"a": 1})
    ((method, path, body, relay, client),) = fleet.asked
    assert (method, path, relay) == ("POST", "/api/v1/fleet", HOME)
    assert (client.name, client.address) == ("ann", "192.0.2.1")
    assert json.loads(body) == {
        "robots": ["rover"],
        "do": "call",
        "service": "/say",
        "args": {"x": 1},
        "timeout": 3.0,
        "why": "",
    }


@pytest.mark.parametrize(
    "order",
    [
        Order(["a"], "stop", reason=msgspec.Raw(b'"fire"'), request=msgspec.Raw(b'"7"')),
        Order(["a"], "resume"),
        Order(["a"], "publish", topic="/a", type="t", msg=msgspec.Raw(b'{"data":1}')),
        Order(["a"], "set", name="/n:p", value=msgspec.Raw(b"null")),
        Order(["a"], "module", module="base", action="restart"),
    ],
)
def test_the_home_reads_the_same_order(order: Order) -> None:
    again = msgspec.json.decode(body_of(order, "a"), type=Order)
    again.check()
    assert bytes(again.value) == bytes(order.value)
    assert (again.why, again.stop_id, again.subject) == (order.why, order.stop_id, order.subject)


def test_a_refusal_of_the_home_is_the_outcome() -> None:
    assert outcome_of(403, b'{"title":"Refused","detail":"no right"}', HOME) == TaskOutcome(False, "no right")


@pytest.mark.parametrize(("status", "answer"), [(200, START), (200, b""), (502, b"<html>"), (200, b"[]")])
def test_an_answer_without_a_result_is_an_error(status: int, answer: bytes) -> None:
    with pytest.raises(Unavailable, match="gave no result"):
        outcome_of(status, answer, HOME)
