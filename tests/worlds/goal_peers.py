"""Robots and clients that send goals, and that execute them."""

from __future__ import annotations

from typing import Any

from relay_protocol import link
from tests.worlds.relay import FIBONACCI, Person, World

GOAL, RESULT, FEEDBACK = (f"{FIBONACCI}_{part}" for part in ("Goal", "Result", "Feedback"))


def with_action(world: World, encodings: tuple[str, ...] = ("cdr", "json")) -> Person:
    """A robot with an action that counts, and an operator that receives errors."""
    world.robot_comes(encodings=encodings)
    person = world.person()
    world.robot_joins()
    world.robot.graph.actions["/count"] = link.Service(types=[FIBONACCI], providers=["/counter"])
    person.says("set_level", level="error")
    if "cdr" in encodings:
        person.says("send_action_goal", action="/count", id="first", args={"order": 1})
        world.define()
        finish(world, sequence=[0])
        person.client.take()
    return person


def finish(world: World, status: int = 4, **result: Any) -> None:
    """The robot ends its goals."""
    for goal in world.link.take(link.SendActionGoal):
        body = world.cdr(RESULT, **result)
        world.channel.message(link.ActionResult(id=goal.id, status=status, result=True, cdr=body))


def send(person: Person, id: Any = "g", action: str = "/count", **more: Any) -> None:
    """The client sends a goal."""
    person.says("send_action_goal", action=action, id=id, **{"args": {"order": 3}, **more})


def offering(world: World, encodings: tuple[str, ...] = ("cdr", "json")) -> Person:
    """A client that offers ``/fib``."""
    person = with_action(world, encodings)
    person.says("advertise_action", action="fib", type="example_interfaces/Fibonacci")
    world.channel.message(link.AdvertisedAction(action="/fib", type=FIBONACCI))
    return person


def graph_sends(world: World, id: str = "1", **more: Any) -> None:
    """A node of the robot sends a goal."""
    fields = {"cdr": world.cdr(GOAL, order=3), "feedback": True} | more
    world.channel.message(link.SendActionGoal(id=id, action="/fib", type=FIBONACCI, **fields))


def results(world: World) -> list[link.ActionResult]:
    """Results that the robot received."""
    return world.link.take(link.ActionResult)
