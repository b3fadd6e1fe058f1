"""Commands on elements of Roles for robots at another relay."""

from __future__ import annotations

from typing import Any

import pytest
from twisted.internet.defer import Deferred

from relay_protocol.errors import NotFound, Refused, SwitchboardError, Unavailable
from relay_server.access import Principal
from relay_server.cluster.element_commands import ClusterElements, element_path
from relay_server.cluster.relays import RelayInfo

HOME = RelayInfo("home", "10.0.0.2", 9092, "1.0", 0.0)
ANN = Principal(1, "ann", "default", False, 7, None)


class Cluster:
    """Homes, access and a forwarder: rover is at another relay, pad is here, and no right on any other robot."""

    def __init__(self, status: int, body: bytes) -> None:
        self.answer = status, body
        self.asked: list[tuple[Any, ...]] = []
        self.released: list[str] = []

    def elsewhere(self, robot_id: int) -> RelayInfo | None:
        return HOME if robot_id == 1 else None

    async def permit_by_name(self, principal: Principal, robot: str) -> Any:
        numbers = {"rover": 1, "pad": 2}
        return (type("Record", (), {"id": numbers[robot]}), robot) if robot in numbers else None

    def release(self, permit: str) -> None:
        self.released.append(permit)

    async def ask(self, *arguments: Any) -> tuple[int, bytes]:
        self.asked.append(arguments)
        return self.answer


def sent(cluster: Any, robot: str) -> Any:
    path = element_path("Say It", "fierro:a/b", "call")
    elements = ClusterElements(cluster, cluster, cluster)
    done: list[Any] = []
    sending = elements.send(ANN, "192.0.2.1", robot, "POST", path, b"{}")
    Deferred.fromCoroutine(sending).addBoth(done.append)
    return done[0]


def test_a_command_goes_to_the_home_of_its_robot() -> None:
    """With the user's rights; permits are released."""
    cluster = Cluster(200, b'{"value":1}')
    assert sent(cluster, "rover") == b'{"value":1}'
    assert sent(cluster, "pad") is None
    assert sent(cluster, "nobodys") is None
    ((method, path, body, relay, client),) = cluster.asked
    assert (method, path, body, relay) == (
        "POST",
        "/api/v1/roles/Say%20It/elements/fierro%3Aa%2Fb/call",
        b"{}",
        HOME,
    )
    assert (client.name, client.address) == ("ann", "192.0.2.1")
    assert cluster.released == ["rover", "pad"]


@pytest.mark.parametrize(
    ("status", "body", "kind", "reason"),
    [
        (404, b'{"detail":"no such element"}', NotFound, "no such element"),
        (403, b'{"detail":"no right"}', Refused, "no right"),
        (428, b'{"detail":"send a freshness token"}', Unavailable, "send a freshness token"),
        (502, b"<html>", Unavailable, "the relay that the robot is connected to answered 502"),
    ],
)
def test_a_refusal_of_the_home_is_an_error(
    status: int, body: bytes, kind: type[SwitchboardError], reason: str
) -> None:
    failure = sent(Cluster(status, body), "rover")
    assert failure.check(kind)
    assert str(failure.value) == reason
