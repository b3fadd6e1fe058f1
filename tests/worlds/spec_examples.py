"""The examples of the specification: fenced blocks whose first line says what they are.

``json robot_control`` is a list of messages of one end of one link, ``text exchange`` is played by
:class:`Exchange`; the other words are those of ``tests/protocol/test_spec_examples.py``.
"""

from __future__ import annotations

import base64
import io
import itertools
import json
import re
from collections.abc import Iterator
from typing import Any, NamedTuple

from PIL import Image

from relay_protocol import jsontext, link
from relay_protocol.rights import Level
from relay_server.channels import encodings
from tests.worlds.relay import FIBONACCI, GRAPH, MemoryLink, Person, World
from tests.worlds.specification import CHAPTERS

_BLOCK = re.compile(r"^```(\w*) ?([^\n]*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
_SECONDS_BETWEEN = 0.1
"""Seconds that pass before each message of an exchange."""


class Block(NamedTuple):
    """One example.

    :param chapter: its number
    :param language: of the fence
    :param kind: the words after the language
    """

    chapter: str
    language: str
    kind: str
    text: str


BLOCKS = [Block(chapter, *found) for chapter, text in CHAPTERS.items() for found in _BLOCK.findall(text)]


def blocks(kind: str) -> list[Block]:
    """All examples of one kind."""
    return [each for each in BLOCKS if each.kind == kind]


def values(text: str) -> list[Any]:
    """The JSON values of a text, one after another."""
    found, decoder = [], json.JSONDecoder()
    while text := text.lstrip():
        value, end = decoder.raw_decode(text)
        found.append(value)
        text = text[end:]
    return found


def compact(value: Any) -> str:
    """JSON as the ends of a link write it."""
    return json.dumps(value, ensure_ascii=False, separators=(",", ":"))


def lines(text: str) -> Iterator[tuple[str, str]]:
    """Each step of an exchange: the party with the direction, and the message. Indented lines continue a message."""
    for line in re.sub(r"\n +", "", text).splitlines():
        party, _, said = line.partition(" ")
        yield party, said.strip()


def png_text(data: str) -> str:
    """The text in the pixels of a PNG in base64."""
    return Image.open(io.BytesIO(base64.b64decode(data))).tobytes().decode().rstrip("\n")


class Exchange:
    """Plays an exchange of clients, relay and robot in memory, and checks each message of the relay.

    A line begins with a party, and ``>`` for a message to the relay or ``<`` for one from it. The robot's definitions
    are sent unasked where the exchange does not show them.
    """

    def __init__(self) -> None:
        # Other tests in this process have made fragments too.
        encodings._numbers = itertools.count(1)
        self.world = World()
        self.world.robot_comes()
        self.world.robot.graph.actions.update(
            {"/fibonacci": link.Service(types=[FIBONACCI], providers=["/counter"])}
        )
        self.people: dict[str, Person] = {"client": self.world.person(Level.OWNER)}
        self.robot: MemoryLink = self.world.robot_joins()
        self.people["client"].client.take()

    def play(self, text: str) -> None:
        """Every line in turn; at the end nothing is left that was not shown."""
        for party, said in lines(text):
            self.world.wait(_SECONDS_BETWEEN, *self.people.values())
            name, direction = party[:-1], party[-1]
            assert direction in "<>", party
            if name == "robot":
                self.robot_says(said) if direction == ">" else self.robot_receives(said)
            elif direction == ">":
                self.person(name).rosbridge.message(said.encode())
            else:
                self.client_receives(self.person(name), said)
        self.define(unless="get_type")
        assert [msg for person in self.people.values() for msg in person.client.sent] == []
        assert self.robot.said == []
        assert self.robot.samples == []

    def person(self, name: str) -> Person:
        """A client by its name in the exchange; a new one is an owner like the first."""
        if name not in self.people:
            self.people[name] = self.world.person(Level.OWNER, user=8, name="bob")
        return self.people[name]

    def define(self, unless: str) -> None:
        """The robot answers requests for definitions that the exchange does not show."""
        if unless != "get_type":
            self.world.define()

    def robot_says(self, said: str) -> None:
        """A message, or a sample."""
        if said.startswith("sample "):
            _, number, body = said.split()
            self.world.channel.sample(int(number), bytes.fromhex(body), 1_700_000_000_000_000_007)
        else:
            self.world.channel.message(jsontext.decode(link.robot_channel_decoder, said.encode()))

    def robot_receives(self, said: str) -> None:
        """The next message or sample to the robot."""
        if said.startswith(("sample ", "command ")):
            self.define(unless="")
            kind, number, body = said.split()
            commands = [(each[0], each[3]) for each in self.robot.commands]
            got, _, received = self.robot.samples.pop(0)
            assert (got, received.hex()) == (int(number), body)
            assert ((got, received) in commands) is (kind == "command")
            return
        self.define(unless=json.loads(said)["op"])
        assert self.robot.said, f"the robot did not receive {said}"
        assert jsontext.encode(self.robot.said.pop(0)).decode() == said

    def client_receives(self, person: Person, said: str) -> None:
        """The next message to a client: JSON or, for CBOR, its bytes."""
        self.define(unless="")
        assert person.client.sent, f"the client did not receive {said}"
        received = person.client.sent.pop(0)
        if said.startswith("binary "):
            assert received.hex() == said.split()[1]
        elif said.startswith('{"op":"png"'):
            shown, got = json.loads(said), json.loads(received)
            assert got.keys() == shown.keys()
            assert png_text(got["data"]) == png_text(shown["data"])
        else:
            assert compact(json.loads(received)) == said, f"the client received {received!r}"


__all__ = ["BLOCKS", "GRAPH", "Block", "Exchange", "blocks", "compact", "lines", "values"]
