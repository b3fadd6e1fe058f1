"""The rosbridge services about functions: malformed arguments, and tokens with limits."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from twisted.internet.defer import CancelledError, Deferred

from relay_protocol.errors import Invalid, Refused
from relay_server.relay_node.functions import FunctionRosServices
from tests.worlds.function_service import FunctionWorld, result


def ask(world: FunctionWorld, principal: Any, name: str, **args: Any) -> Any:
    client: Any = SimpleNamespace(permit=SimpleNamespace(principal=principal), robot=world.rights.robot)
    handler = FunctionRosServices(world.service).handlers()[name]
    return result(Deferred.fromCoroutine(handler(client, args)))


@pytest.mark.parametrize(
    "arguments", ['{"a":123456789012345678901234567890}', "[" * 5000 + "]" * 5000, "{", '{"a":1,"a":2}']
)
def test_arguments_that_can_not_be_read_are_invalid(tmp_path: Path, arguments: str) -> None:
    world = FunctionWorld(tmp_path)
    with pytest.raises(Invalid, match="can't be read"):
        ask(world, world.ann, "/relay/call_function", function="move", arguments=arguments)


def test_a_token_for_one_robot_does_not_reach_a_job_without_a_robot(tmp_path: Path) -> None:
    world = FunctionWorld(tmp_path)
    owner, _ = result(Deferred.fromCoroutine(world.service.user(world.ann, "move")))
    job = result(Deferred.fromCoroutine(world.service.submit(owner, "move", b"\x80", keep=True)))
    limited = dataclasses.replace(world.ann, robot_id=world.robot_id)
    with pytest.raises(Refused, match="token"):
        ask(world, limited, "/relay/function_job", job=job.id, cancel=True)
    assert ask(world, world.ann, "/relay/function_job", job=job.id)["state"] == "running"
    begun = ask(world, limited, "/relay/call_function", function="move", timeout=0)
    assert ask(world, limited, "/relay/function_job", job=begun["job"])["state"] == "running"


def test_a_call_whose_client_leaves_is_cancelled(tmp_path: Path) -> None:
    world = FunctionWorld(tmp_path)
    client: Any = SimpleNamespace(permit=SimpleNamespace(principal=world.ann), robot=world.rights.robot)
    call = FunctionRosServices(world.service).handlers()["/relay/call_function"]
    waiting = Deferred.fromCoroutine(call(client, {"function": "move", "timeout": 30}))
    (run,) = world.engine.runs
    waiting.addErrback(lambda failure: failure.trap(CancelledError))
    waiting.cancel()
    assert run.outcome.called
    assert world.service.engine.free(None)  # type: ignore[arg-type]
