"""Makes a robot greet persons, each only once in a while: ``python -m robot_client.apps.greeting``.

The robot's service ``faces`` recognises persons, its service ``speech`` speaks. The relay's event log says whether a
person was greeted recently, also when this program is restarted or runs twice. Before it speaks, the program logs that
it is about to, and checks that no other program did so earlier. Without an answer of the relay, it greets no person.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import click

from relay_protocol.clocks import now as seconds_since_boot
from relay_protocol.command_output import OutputCommand
from robot_client.apps.connection import LivenessMonitor, RosbridgeConnection, access_token, errors_as_click
from robot_client.apps.event_client import EventClient, EventLogUnavailable
from robot_client.apps.program import ExitSignal, StatusLine, run_connected
from robot_client.command_line import Number

POLL_SECONDS = 0.25
BEGUN, GREETED = "greeting.begun", "greeted"
"""Kinds of the events it logs: before and after it speaks. Their data has the person."""
ANY_GREETING = "greet*"

CONFIRM_SECONDS = 2.0
"""Seconds within which a person must be seen in two images, because one may be wrong."""
RECHECK_SECONDS = 2.0
"""Interval of queries about one person."""
LONGEST_NAME = 64
MAX_FACES = 50
"""Most persons of one image."""
MAX_PERSONS = 1000
"""Most persons remembered."""
STRANGER = "a stranger"
"""Name of an unrecognised person in events."""

PING_SECONDS = 5.0
"""Interval of pings to the relay."""
LOST_SECONDS = 15.0
"""Time without a message after which the connection counts as lost."""


class GreetingConfig(NamedTuple):
    """Settings.

    :ivar within: least time between two greetings of a person, seconds
    :ivar text: greeting; ``{name}`` is replaced by the name
    :ivar strangers: greeting of unrecognised persons; empty for none
    """

    within: float = 60.0
    text: str = "Hello, {name}."
    strangers: str = ""

    def words(self, person: str) -> str:
        """The greeting of a person."""
        return self.strangers if person == STRANGER else self.text.replace("{name}", person)


class EventStore(Protocol):
    """Event log and speech: :class:`~robot_client.apps.event_client.EventClient`."""

    def events(self, kind: str, last: float, **data: str) -> list[dict[str, Any]]:
        """Events of the last ``last`` seconds."""

    def write(self, kind: str, **data: str) -> int:
        """Log an event, and return its number."""

    def publish(self, topic: str, message: dict[str, Any], kind: str) -> None:
        """Publish a message on the robot."""


def person_names(text: Any, strangers: bool) -> list[str]:
    """Names of the persons in a message of the service ``faces``.

    :param text: ``data`` of ``faces/seen``; invalid data gives no persons
    :param strangers: include unrecognised persons, all as one
    """
    found: dict[str, None] = {}
    try:
        for each in json.loads(text)["faces"][:MAX_FACES]:
            name = each["name"]
            if isinstance(name, str) and 0 < len(name) <= LONGEST_NAME and name.isprintable():
                found[name] = None
            elif name is None and strangers:
                found[STRANGER] = None
    except (ValueError, TypeError, KeyError):
        pass
    return list(found)


class SightingFilter:
    """Decides which sightings of persons to act on."""

    def __init__(self) -> None:
        self._seen: dict[str, float] = {}
        self._next: dict[str, float] = {}

    def due(self, person: str, now: float) -> bool:
        """Whether to query now if this person, who is seen, was greeted."""
        before = self._seen.get(person, -math.inf)
        self._seen[person] = now
        if now - before > CONFIRM_SECONDS or now < self._next.get(person, -math.inf):
            return False
        self._next[person] = now + RECHECK_SECONDS
        if len(self._seen) > MAX_PERSONS:
            self._seen = {name: at for name, at in self._seen.items() if now - at <= CONFIRM_SECONDS}
            self._next = {name: at for name, at in self._next.items() if at > now}
        return True


class Greeting:
    """Makes the robot greet the persons it sees.

    :param faces: topic of the service ``faces``
    :param say: topic of the service ``speech``
    :param report: takes a short text about every change
    :param clock: seconds, including suspends
    """

    def __init__(
        self,
        faces: str,
        say: str,
        events: EventStore,
        config: GreetingConfig,
        report: Callable[[str], None],
        clock: Callable[[], float] = seconds_since_boot,
    ) -> None:
        self._faces = faces
        self._say = say
        self._events = events
        self._config = config
        self._report = report
        self._clock = clock
        self._sightings = SightingFilter()
        self._liveness: LivenessMonitor

    def begin(self, connection: RosbridgeConnection) -> None:
        """A connection was made."""
        self._liveness = LivenessMonitor(connection, self._clock, PING_SECONDS, LOST_SECONDS)
        connection.send(op="set_level", level="error")
        connection.send(op="subscribe", topic=self._faces, type="std_msgs/msg/String", queue_length=1)
        self._report("looking for people")

    def step(self) -> bool:
        """Receive one message, and act on it.

        :raises Lost: nothing has come for long
        :raises Refused: the relay refuses, and a retry does not help
        """
        message = self._liveness.receive(POLL_SECONDS)
        if message is not None:
            self._take(message)
        return True

    def leave(self) -> None:
        """Nothing to release."""

    def lost(self, why: str, seconds: float) -> None:
        """Report it."""
        self._report(f"{why}; again in {seconds:.1f} s")

    def _take(self, message: dict[str, Any]) -> None:
        if message["op"] == "status":
            self._report(f"refused: {message['msg']}")
        elif message["op"] == "publish" and message["topic"] == self._faces:
            for person in person_names(message["msg"].get("data"), bool(self._config.strangers)):
                if self._sightings.due(person, self._clock()):
                    try:
                        self._report(self._greet(person))
                    except EventLogUnavailable as error:
                        self._report(f"{person} is not greeted: {error}")

    def _greet(self, person: str) -> str:
        """Greet a person unless that was done, and return the result for display."""
        events, within = self._events, self._config.within
        if events.events(ANY_GREETING, within, person=person):
            return f"{person} was greeted already"
        own = events.write(BEGUN, person=person)
        # Two programs may do this at the same time; the lower event number wins.
        if any(int(each["id"]) < own for each in events.events(ANY_GREETING, within, person=person)):
            return f"{person} is greeted by another program"
        events.publish(self._say, {"data": self._config.words(person)}, "std_msgs/msg/String")
        events.write(GREETED, person=person)
        return f"greeted {person}"


@click.command(cls=OutputCommand, context_settings={"help_option_names": ["-h", "--help"]})
@click.argument("url")
@click.option(
    "--faces", default="/faces/seen", show_default=True, metavar="TOPIC", help="Topic of the service 'faces'."
)
@click.option(
    "--say", default="/say", show_default=True, metavar="TOPIC", help="Topic of the service 'speech'."
)
@click.option(
    "--within",
    type=Number(1, 86400),
    default=GreetingConfig().within,
    show_default=True,
    metavar="S",
    help="Least time between two greetings of a person.",
)
@click.option(
    "--text",
    default=GreetingConfig().text,
    show_default=True,
    help="Greeting; {name} is replaced by the name.",
)
@click.option(
    "--strangers", default="", metavar="TEXT", help="Greeting of unrecognised persons. Default: none."
)
def main(url: str, faces: str, say: str, within: float, text: str, strangers: str) -> None:
    """Make the robot at URL (ws://relay/robots/NAME) greet the persons it recognises.

    The robot must run the services 'faces' and 'speech'. The access token is read from SWITCHBOARD_TOKEN. SIGINT and
    SIGTERM end the program.

    \b
    Examples:
      ROBOT=ws://127.0.0.1:9090/robots/robot-one
      python -m robot_client.apps.greeting $ROBOT
      python -m robot_client.apps.greeting $ROBOT --within 3600 --text 'Good morning, {name}.' --strangers Hello.
    """
    access_token()
    exit_signal = ExitSignal()
    status = StatusLine(sys.stdout, time.monotonic)
    with errors_as_click():
        program = Greeting(faces, say, EventClient(url), GreetingConfig(within, text, strangers), status.show)
        run_connected(url, program, exit_signal)
    status.finish("ended")


if __name__ == "__main__":
    main()
