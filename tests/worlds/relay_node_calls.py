"""Calls of the relay's own services, and answers of a robot that speaks JSON."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import msgspec

from relay_protocol import link
from tests.worlds.relay import Person, World

OWN_SERVICES = 57
"""How many services the relay has itself."""


def ask(person: Person, service: str, args: Any = None) -> Any:
    """The answer's values, or its text if the call failed."""
    person.says("call_service", service=service, **({} if args is None else {"args": args}))
    (reply,) = person.received("service_response")
    return reply["values"]


def begin(person: Person, service: str, args: Any = None) -> Callable[[], Any]:
    """Calls a service; returns a function that gives the answer's values once they are there."""
    person.says("call_service", service=service, **({} if args is None else {"args": args}))

    def answer() -> Any:
        (reply,) = person.received("service_response")
        assert reply["result"], reply["values"]
        return reply["values"]

    return answer


def asked(world: World) -> list[tuple[str, Any]]:
    """Services that the robot was asked to call, with the arguments."""
    return [
        (each.service, json.loads(bytes(each.args or b"null"))) for each in world.link.all(link.CallService)
    ]


def answers(world: World, service: str, values: Any) -> Any:
    """A JSON robot answers the oldest call of a service; returns the request."""
    call = next(each for each in world.link.all(link.CallService) if each.service == service)
    world.link.said.remove(call)
    world.channel.message(link.ServiceResponse(id=call.id, result=True, values=_raw(values)))
    return json.loads(bytes(call.args or b"null"))


def fails(world: World, service: str, reason: str) -> None:
    """A robot reports that a call failed."""
    call = next(each for each in world.link.all(link.CallService) if each.service == service)
    world.link.said.remove(call)
    world.channel.message(link.ServiceResponse(id=call.id, result=False, reason=reason))


def _raw(values: Any) -> msgspec.Raw:
    return msgspec.Raw(json.dumps(values).encode())


def parameter_services(node: str) -> dict[str, link.Service | None]:
    """The parameter services of a node in a graph."""
    return {
        f"{node}/{service}": link.Service(types=[f"rcl_interfaces/srv/{kind}"], providers=[node])
        for service, kind in (
            ("get_parameters", "GetParameters"),
            ("set_parameters", "SetParameters"),
            ("list_parameters", "ListParameters"),
        )
    }
