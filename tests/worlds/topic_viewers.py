"""Clients that subscribe to a topic of an online robot, and their messages."""

from __future__ import annotations

from typing import Any

from relay_protocol import link
from relay_server.channels.samples import Converter
from tests.worlds.relay import Person, World


def watching(world: World, *asks: dict[str, Any]) -> tuple[int, list[Person]]:
    """An online robot and one client for each subscription to /chatter, confirmed and typed; returns the
    robot's subscription number.
    """
    world.robot_comes()
    people = [world.person() for _ in asks] or [world.person()]
    world.robot_joins()
    for person, ask in zip(people, asks, strict=False):
        person.says("subscribe", **{"topic": "/chatter", **ask})
    number = world.link.all(link.Subscribe)[0].number
    world.subscribed(number)
    world.define()
    return number, people


def counting(world: World, number: int) -> list[str]:
    """The list that records every conversion of a topic's samples from now on."""
    converter = world.channel.subscriptions.by_number[number]._converter
    converted: list[str] = []

    def counted(language: str, body: bytes) -> bytes:
        converted.append(language)
        return Converter.convert(converter, language, body)

    converter.convert = counted  # type: ignore[method-assign]
    return converted


def heard(person: Person) -> list[str]:
    """Received texts."""
    return [message["msg"]["data"] for message in person.received("publish")]
