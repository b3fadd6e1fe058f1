"""People who watch a topic of a robot at work, and what they hear."""

from __future__ import annotations

from typing import Any

from relay_protocol import link
from relay_server.channels.samples import Converter
from tests.relay_server.memory import Person, World


def watching(world: World, *asks: dict[str, Any]) -> tuple[int, list[Person]]:
    """A robot at work and one person for each ask of /chatter, confirmed and typed; the uplink's number."""
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
    """The list that every conversion of a topic's sample is written to from now on."""
    converter = world.channel.subscriptions._numbers[number]._converter
    converted: list[str] = []

    def counted(language: str, body: bytes) -> bytes:
        converted.append(language)
        return Converter.convert(converter, language, body)

    converter.convert = counted  # type: ignore[method-assign]
    return converted


def heard(person: Person) -> list[str]:
    """The words that came."""
    return [message["msg"]["data"] for message in person.hears("publish")]
