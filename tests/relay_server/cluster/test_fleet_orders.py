"""Fleet orders for robots whose home is another relay."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import msgspec
import pytest
from twisted.internet.defer import CancelledError, Deferred
from twisted.internet.task import Clock

from relay_db.queries import RobotRecord
from relay_protocol.errors import Unavailable
from relay_server.access import Principal
from relay_server.cluster.fleet_orders import ClusterOrders
from relay_server.cluster.forwarding import RelayAnswer
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
        self.lines = [START, RESULT, END]
        self.answer = (200, b"")
        self.answers: list[RelayAnswer] = []
        self.ending: Deferred[None] | None = None
        self.on_line: Callable[[bytes], None] = lambda line: None

    def elsewhere(self, robot_id: int) -> RelayInfo | None:
        """The home of odd robots."""
        return HOME if robot_id % 2 else None

    async def ask_lines(self, *arguments: Any) -> RelayAnswer:
        """Executes the order, as far as a test has said."""
        *asked, on_line, _ = arguments
        self.asked.append(tuple(asked))
        self.on_line = on_line
        for line in self.lines:
            on_line(line)
        if self.ending is not None:
            await self.ending
        return self.answers.pop(0) if self.answers else RelayAnswer(*self.answer, "")


def sending(
    fleet: Any, order: Order, *robots: RobotRecord, sent: int | None = None, now: int = 0
) -> list[Deferred[TaskOutcome | None]]:
    clock = Clock()
    orders = ClusterOrders(clock, fleet, fleet, lambda: now)
    found = [Deferred.fromCoroutine(orders.send(ANN, "192.0.2.1", order, each, sent)) for each in robots]
    clock.advance(0)
    return found


def sent(fleet: Any, order: Order, robot_id: int) -> TaskOutcome | None:
    (found,) = sending(fleet, order, RobotRecord(robot_id, "rover", "default", ""))
    result: Any = found.result
    return result  # type: ignore[no-any-return]


def test_an_order_goes_to_the_home_for_one_robot() -> None:
    """The user's rights apply. An order for a local robot is not forwarded."""
    fleet = Fleet()
    order = Order(["r*"], "call", service="/say", args=msgspec.Raw(b'{"x":1}'), timeout=3.0)
    assert sent(fleet, order, 2) is None
    assert sent(fleet, order, 1) == TaskOutcome(True, "yes", {"a": 1})
    ((path, body, relay, client, token),) = fleet.asked
    assert (path, relay, token) == ("/api/v1/fleet", HOME, "")
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
    again = msgspec.json.decode(body_of(order, ["a"]), type=Order)
    again.check()
    assert bytes(again.value) == bytes(order.value)
    assert (again.why, again.stop_id, again.subject) == (order.why, order.stop_id, order.subject)


def many(count: int) -> list[RobotRecord]:
    return [RobotRecord(2 * each + 1, f"r{each}", "default", "") for each in range(count)]


def test_robots_of_one_relay_are_sent_together_and_each_outcome_is_passed_on_when_it_comes() -> None:
    fleet = Fleet()
    fleet.lines, fleet.ending = [START], Deferred()
    found = sending(fleet, Order(["*"], "stop"), *many(3))
    (asked,) = fleet.asked
    assert json.loads(asked[1])["robots"] == ["r0", "r1", "r2"]
    fleet.on_line(RESULT.replace(b"rover", b"r1"))
    assert [each.called for each in found] == [False, True, False]
    # The stop of r0 is not waited for any longer, that of r2 is.
    found[0].addErrback(lambda failure: failure.trap(CancelledError) and None)
    found[0].cancel()
    assert not fleet.ending.called
    fleet.on_line(RESULT.replace(b"rover", b"r0"))
    fleet.on_line(RESULT.replace(b"rover", b"r2").replace(b"true", b"false"))
    fleet.ending.callback(None)
    outcomes: list[Any] = [each.result for each in found]
    assert outcomes == [None, TaskOutcome(True, "yes", {"a": 1}), TaskOutcome(False, "yes", {"a": 1})]


@pytest.mark.parametrize(
    ("sent", "sent_again"), [(3_000, [("t1", 4_000)]), (None, [])], ids=["of known age", "of unknown age"]
)
def test_a_home_that_needs_the_age_gets_it(sent: int | None, sent_again: list[tuple[str, int]]) -> None:
    """The order is at least as much older than the token as time has passed from when it was sent until now."""
    fleet = Fleet()
    fleet.lines, fleet.answer = [], (200, b"")
    fleet.answers = [RelayAnswer(428, b'{"detail":"prove that this is fresh"}', "t1")]
    (found,) = sending(fleet, Order(["*"], "resume"), *many(1), sent=sent, now=7_000)
    assert [(each[4], each[3].older_ns) for each in fleet.asked] == [("", 0), *sent_again]
    if sent is None:
        result: Any = found.result
        assert result == TaskOutcome(False, "prove that this is fresh")
    else:
        found.addErrback(lambda failure: None)


def test_a_thousand_robots_are_several_orders() -> None:
    fleet = Fleet()
    fleet.lines = [RESULT.replace(b"rover", f"r{each}".encode()) for each in range(1000)]
    found = sending(fleet, Order(["*"], "stop"), *many(1000))
    assert [len(json.loads(each[1])["robots"]) for each in fleet.asked] == [200] * 5
    assert all(each.called for each in found)


def test_an_order_that_all_have_cancelled_ends() -> None:
    fleet = Fleet()
    fleet.lines, fleet.ending = [], Deferred(lambda _: ended.append(True))
    ended: list[bool] = []
    found = sending(fleet, Order(["*"], "stop"), *many(2))
    for each in found:
        each.addErrback(lambda failure: failure.trap(CancelledError) and None)
        each.cancel()
    assert ended == [True]


def test_a_refusal_of_the_home_is_the_outcome() -> None:
    fleet = Fleet()
    fleet.lines, fleet.answer = [], (403, b'{"title":"Refused","detail":"no right"}')
    assert sent(fleet, Order(["*"], "stop"), 1) == TaskOutcome(False, "no right")


@pytest.mark.parametrize(
    ("line", "answer"), [(START, (200, b"")), (b"[]", (200, b"")), (b"", (502, b"<html>")), (END, (200, b""))]
)
def test_an_answer_without_a_result_is_an_error(line: bytes, answer: tuple[int, bytes]) -> None:
    fleet = Fleet()
    fleet.lines, fleet.answer = [line], answer
    (found,) = sending(fleet, Order(["*"], "stop"), *many(1))
    failures: list[Any] = []
    found.addErrback(failures.append)
    assert "gave no result" in str(failures[0].value)


def test_a_relay_that_can_not_be_reached_is_an_error_for_each_robot() -> None:
    fleet = Fleet()
    fleet.lines, fleet.ending = [], Deferred()
    found = sending(fleet, Order(["*"], "stop"), *many(2))
    failures: list[Any] = []
    for each in found:
        each.addErrback(failures.append)
    fleet.ending.errback(Unavailable("it is gone"))
    assert [str(each.value) for each in failures] == ["it is gone"] * 2
