"""Audit entries of commands on elements of Roles."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import pytest
from twisted.internet.defer import Deferred

from relay_protocol.errors import NotFound
from relay_protocol.nonfinite import NotFinite
from relay_server.access import Principal
from relay_server.audit_log import AuditLogEntry
from relay_server.cluster.element_commands import NoElementForwarding
from relay_server.http.router import decode_body
from relay_server.roles.bindings import binding_of
from relay_server.roles.commands import RoleCommands, RoleUser
from relay_server.roles.elements_http import RoleElementEndpoints
from relay_server.roles.schemas import NewElementValue

ANN = RoleUser(Principal(1, "ann", "lab", False, 1, None), "192.0.2.9")


class Scene:
    """An element that is bound to a resource; ann has a right on robot rover.

    :param resource: its address
    """

    def __init__(self, resource: str) -> None:
        self.entries: list[AuditLogEntry] = []
        self._binding = binding_of(resource)
        part = cast(Any, self)
        self.commands = RoleCommands(
            part,
            part,
            part,
            part,
            part,
            part,
            part,
            SimpleNamespace(append=self.entries.append),
            lambda: 5.0,
            forwarding=NoElementForwarding(),
        )  # type: ignore[arg-type]

    def count_change(self, principal: Principal) -> None:
        """Counts nothing."""

    async def bindings(self, principal: Principal, role: str, element: str) -> Any:
        return SimpleNamespace(own=[self._binding], mapped=[])

    async def set_param(self, *arguments: Any) -> None:
        """Sets nothing."""

    @asynccontextmanager
    async def admitted(self, principal: Principal, robot: str, address: str) -> AsyncIterator[Any]:
        if robot != "rover":
            raise NotFound("there is no such robot")
        yield SimpleNamespace(robot=SimpleNamespace(robot_id=7))


@pytest.mark.parametrize(
    ("resource", "robots"), [("robots/rover/params/base:speed", (7,)), ("robots/gone/params/base:speed", ())]
)
def test_an_entry_names_the_robot_that_it_is_about(resource: str, robots: tuple[int, ...]) -> None:
    """So its operators have an alert when the entry is lost."""
    scene = Scene(resource)
    done = Deferred.fromCoroutine(scene.commands.set(ANN, "Role", "SPEED", NewElementValue(1)))
    failures: list[Any] = []
    done.addErrback(failures.append)
    assert failures == []
    (entry,) = scene.entries
    assert (entry.action, entry.target, entry.robots) == ("element.set", "Role/SPEED@lab", robots)


@pytest.mark.parametrize(
    ("endpoint", "body"),
    [(RoleElementEndpoints.set, b'{"value":NaN}'), (RoleElementEndpoints.order, b'{"args":{"x":NaN}}')],
)
def test_values_and_arguments_may_be_nan(endpoint: Any, body: bytes) -> None:
    """It is marked for the encoders of messages. Elsewhere it is refused in words."""
    numbers = endpoint.options.numbers
    decoded = decode_body("application/json", body, endpoint.decoder, numbers)
    assert b'"\\u0000NaN"' in msgspec.json.encode(decoded)
    with pytest.raises(NotFinite, match="accepted only as numbers in messages"):
        decode_body("application/json", b'{"timeout":NaN,"type":NaN}', endpoint.decoder, numbers)
