"""Calls of the relay's own services, and answers of a robot that speaks JSON."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import msgspec

from relay_protocol import link
from tests.relay_server.memory import Person, World

OWN_SERVICES = 38
"""How many services the relay has itself."""


def ask(person: Person, service: str, args: Any = None) -> Any:
    """The answer's values, or its words when the call failed."""
    person.says("call_service", service=service, **({} if args is None else {"args": args}))
    (reply,) = person.hears("service_response")
    return reply["values"]


def begin(person: Person, service: str, args: Any = None) -> Callable[[], Any]:
    """Call; what gives the answer's values once they are there."""
    person.says("call_service", service=service, **({} if args is None else {"args": args}))

    def answer() -> Any:
        (reply,) = person.hears("service_response")
        assert reply["result"], reply["values"]
        return reply["values"]

    return answer


def asked(world: World) -> list[tuple[str, Any]]:
    """Services the robot was asked to call, with the arguments."""
    return [
        (each.service, json.loads(bytes(each.args or b"null"))) for each in world.link.all(link.CallService)
    ]


def answers(world: World, service: str, values: Any) -> Any:
    """A robot of JSON answers the oldest call of a service; what it was asked."""
    call = next(each for each in world.link.all(link.CallService) if each.service == service)
    world.link.said.remove(call)
    world.channel.message(link.ServiceResponse(id=call.id, result=True, values=_raw(values)))
    return json.loads(bytes(call.args or b"null"))


def fails(world: World, service: str, reason: str) -> None:
    """A robot can't make a call."""
    call = next(each for each in world.link.all(link.CallService) if each.service == service)
    world.link.said.remove(call)
    world.channel.message(link.ServiceResponse(id=call.id, result=False, reason=reason))


def _raw(values: Any) -> msgspec.Raw:
    return msgspec.Raw(json.dumps(values).encode())
