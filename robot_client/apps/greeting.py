"""Has a robot greet who comes, and nobody twice: ``python -m robot_client.apps.greeting``.

The robot's service ``faces`` says whom it sees, its service ``speech`` says the words. Whether somebody was greeted of
late the relay's memory knows: "was this person greeted in the last minute?" So nobody is greeted twice when this
program is started anew, or runs twice. Who greets writes down first that he is about to, then looks whether somebody
else did so before him, and only then speaks. Where the memory does not answer nobody is greeted.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import click

from robot_client.apps.clock import now as since_start
from robot_client.apps.connection import LivenessCheck, RosbridgeConnection, in_words, token
from robot_client.apps.event_client import EventClient, Unanswered
from robot_client.apps.reconnect import Ending, run_connected
from robot_client.apps.status_line import StatusLine
from robot_client.numbers import Number

LOOK = 0.25
BEGUN, GREETED = "greeting.begun", "greeted"
"""Kinds of the events it writes: before it speaks, and after. The person is in their data."""
EITHER = "greet*"

SURE = 2.0
"""Seconds within which somebody must be seen in two pictures: one may be wrong."""
CHECK = 2.0
"""Seconds from one question about a person to the next."""
LONGEST_NAME = 64
MOST = 50
"""Persons of one picture that count."""
KEPT = 1000
"""Persons that are known at a time."""
STRANGER = "a stranger"
"""Who is not recognised, by the events."""

BEAT = 5.0
"""Seconds from one question to the relay to the next."""
SILENT = 15.0
"""Seconds without a word of the relay after which there is no connection."""


class GreetingConfig(NamedTuple):
    """How it greets.

    :ivar within: seconds within which nobody is greeted twice
    :ivar text: what is said; ``{name}`` is the person's
    :ivar strangers: what is said to who is not recognised; empty: nothing
    """

    within: float = 60.0
    text: str = "Hello, {name}."
    strangers: str = ""

    def words(self, person: str) -> str:
        """What is said to somebody."""
        return self.strangers if person == STRANGER else self.text.replace("{name}", person)


class Events(Protocol):
    """What remembers, and speaks: :class:`~robot_client.apps.event_client.EventClient`."""

    def events(self, kind: str, last: float, **data: str) -> list[dict[str, Any]]:
        """Events of the last so many seconds."""

    def write(self, kind: str, **data: str) -> int:
        """Keep an event; its number."""

    def publish(self, topic: str, message: dict[str, Any], kind: str) -> None:
        """Have the robot publish a message."""


def persons(text: Any, strangers: bool) -> list[str]:
    """Whom the service ``faces`` sees.

    :param text: ``data`` of ``faces/seen``; what makes no sense is nobody
    :param strangers: whether who is not recognised counts, all as one
    """
    found: dict[str, None] = {}
    try:
        for each in json.loads(text)["faces"][:MOST]:
            name = each["name"]
            if isinstance(name, str) and 0 < len(name) <= LONGEST_NAME and name.isprintable():
                found[name] = None
            elif name is None and strangers:
                found[STRANGER] = None
    except (ValueError, TypeError, KeyError):
        pass
    return list(found)


class Attention:
    """Who was seen often enough to be somebody, and is to be asked about."""

    def __init__(self) -> None:
        self._seen: dict[str, float] = {}
        self._next: dict[str, float] = {}

    def due(self, person: str, now: float) -> bool:
        """Somebody is seen: whether it is to be asked now if he was greeted."""
        before = self._seen.get(person, -math.inf)
        self._seen[person] = now
        if now - before > SURE or now < self._next.get(person, -math.inf):
            return False
        self._next[person] = now + CHECK
        if len(self._seen) > KEPT:
            self._seen = {name: at for name, at in self._seen.items() if now - at <= SURE}
            self._next = {name: at for name, at in self._next.items() if at > now}
        return True


class Greeting:
    """Hears whom the robot sees, asks, has it speak.

    :param faces: topic of the service ``faces``
    :param say: topic of the service ``speech``
    :param tell: takes what happens, in a few words
    :param clock: seconds, suspends included
    """

    def __init__(
        self,
        faces: str,
        say: str,
        memory: Events,
        manners: GreetingConfig,
        tell: Callable[[str], None],
        clock: Callable[[], float] = since_start,
    ) -> None:
        self._faces = faces
        self._say = say
        self._memory = memory
        self._manners = manners
        self._tell = tell
        self._clock = clock
        self._attention = Attention()
        self._pulse: LivenessCheck

    def begin(self, line: RosbridgeConnection) -> None:
        """There is a line."""
        self._pulse = LivenessCheck(line, self._clock, BEAT, SILENT)
        line.say(op="set_level", level="error")
        line.say(op="subscribe", topic=self._faces, type="std_msgs/msg/String", queue_length=1)
        self._tell("looking for people")

    def step(self) -> bool:
        """Take what comes within a moment, and act on it.

        :raises Lost: nothing has come for long
        :raises Refused: the relay says no, and will until a person has done something
        """
        message = self._pulse.hear(LOOK)
        if message is not None:
            self._take(message)
        return True

    def leave(self) -> None:
        """Nothing is held."""

    def lost(self, why: str, seconds: float) -> None:
        """Say so."""
        self._tell(f"{why}; again in {seconds:.1f} s")

    def _take(self, message: dict[str, Any]) -> None:
        if message["op"] == "status":
            self._tell(f"refused: {message['msg']}")
        elif message["op"] == "publish" and message["topic"] == self._faces:
            for person in persons(message["msg"].get("data"), bool(self._manners.strangers)):
                if self._attention.due(person, self._clock()):
                    try:
                        self._tell(self._greet(person))
                    except Unanswered as error:
                        self._tell(f"{person} is not greeted: {error}")

    def _greet(self, person: str) -> str:
        """What became of it."""
        memory, within = self._memory, self._manners.within
        if memory.events(EITHER, within, person=person):
            return f"{person} was greeted already"
        own = memory.write(BEGUN, person=person)
        # Two may have asked at the same time; their numbers say who came first.
        if any(int(each["id"]) < own for each in memory.events(EITHER, within, person=person)):
            return f"{person} is greeted by another program"
        memory.publish(self._say, {"data": self._manners.words(person)}, "std_msgs/msg/String")
        memory.write(GREETED, person=person)
        return f"greeted {person}"


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.argument("url")
@click.option(
    "--faces", default="/faces/seen", show_default=True, metavar="TOPIC", help="Of the service 'faces'."
)
@click.option("--say", default="/say", show_default=True, metavar="TOPIC", help="Of the service 'speech'.")
@click.option(
    "--within",
    type=Number(1, 86400),
    default=GreetingConfig().within,
    show_default=True,
    metavar="S",
    help="Nobody is greeted twice within.",
)
@click.option(
    "--text", default=GreetingConfig().text, show_default=True, help="What is said; {name} is the person's."
)
@click.option(
    "--strangers", default="", metavar="TEXT", help="What is said to who is not recognised. Default: nothing."
)
def main(url: str, faces: str, say: str, within: float, text: str, strangers: str) -> None:
    """Have the robot at URL (ws://relay/robots/NAME) greet whom it recognises, and nobody twice.

    It takes the robot's services 'faces' and 'speech'. SIGINT and SIGTERM end it. The token comes from the variable
    SWITCHBOARD_TOKEN.

    \b
    Examples:
      ROBOT=ws://127.0.0.1:9090/robots/robot-one
      python -m robot_client.apps.greeting $ROBOT
      python -m robot_client.apps.greeting $ROBOT --within 3600 --text 'Good morning, {name}.' --strangers Hello.
    """
    token()
    ending = Ending()
    status = StatusLine(sys.stdout, time.monotonic)
    with in_words():
        program = Greeting(faces, say, EventClient(url), GreetingConfig(within, text, strangers), status.tell)
        run_connected(url, program, ending)
    status.end("ended")


if __name__ == "__main__":
    main()
