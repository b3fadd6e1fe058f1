"""The greeting program, with a websocket and a memory in memory."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest
from click.testing import CliRunner
from switchboard_socket import Socket

from robot_client.apps.connection import Lost, RosbridgeConnection
from robot_client.apps.event_client import Unanswered
from robot_client.apps.greeting import (
    BEAT,
    BEGUN,
    CHECK,
    GREETED,
    SILENT,
    STRANGER,
    SURE,
    Greeting,
    GreetingConfig,
    main,
    persons,
)

FACES = "/faces/seen"


class Remembered:
    """A relay's memory, which programs share."""

    def __init__(self) -> None:
        self.now = 1000.0
        self.written: list[dict[str, Any]] = []
        self.said: list[str] = []
        self.questions = 0
        self.fails_at = ""
        """What is not answered, though it is done."""
        self.between: Callable[[], None] = lambda: None
        """What happens once, after the next question about what was before."""

    def events(self, kind: str, last: float, **data: str) -> list[dict[str, Any]]:
        found = [
            each
            for each in self.written
            if each["kind"].startswith(kind.rstrip("*"))
            and each["at"] > self.now - last
            and each["data"] == data
        ]
        self.questions += 1
        self._answered("events")
        between, self.between = self.between, lambda: None
        between()
        return found[::-1]

    def write(self, kind: str, **data: str) -> int:
        self.written.append({"id": len(self.written) + 1, "kind": kind, "at": self.now, "data": data})
        self._answered(kind)
        return len(self.written)

    def publish(self, topic: str, message: dict[str, Any], kind: str) -> None:
        assert (topic, kind) == ("/say", "std_msgs/msg/String")
        self.said.append(message["data"])
        self._answered("publish")

    def _answered(self, what: str) -> None:
        if what == self.fails_at:
            self.fails_at = ""
            raise Unanswered("the relay does not answer")


class Scene:
    """A program at work."""

    def __init__(self, memory: Remembered, manners: GreetingConfig | None = None) -> None:
        self.memory = memory
        self.told: list[str] = []
        self.program = Greeting(
            FACES, "/say", memory, manners or GreetingConfig(), self.told.append, lambda: self.memory.now
        )
        self.connect()

    def connect(self) -> None:
        """A new line."""
        self.socket = Socket()
        self.program.begin(RosbridgeConnection(self.socket))

    def see(self, *names: str | None, times: int = 2, seconds: float = 0.2) -> None:
        """Pictures with these people in them."""
        text = json.dumps({"faces": [{"name": name} for name in names]})
        for _ in range(times):
            self.memory.now += seconds
            self.socket.coming.append({"op": "publish", "topic": FACES, "msg": {"data": text}})
            self.program.step()


@pytest.fixture
def memory() -> Remembered:
    return Remembered()


def kinds(memory: Remembered) -> list[str]:
    return [each["kind"] for each in memory.written]


def test_who_comes_is_greeted_once(memory: Remembered) -> None:
    """However long he stays; each person by his name."""
    scene = Scene(memory)
    scene.see("ann", times=100)
    scene.see("ann", "bob", times=3)
    assert memory.said == ["Hello, ann.", "Hello, bob."]
    assert kinds(memory) == [BEGUN, GREETED] * 2
    assert "greeted ann" in scene.told


def test_after_a_minute_he_is_greeted_again(memory: Remembered) -> None:
    """Not before."""
    scene = Scene(memory)
    scene.see("ann")
    scene.see("ann", times=57, seconds=1.0)
    assert memory.said == ["Hello, ann."]
    scene.see("ann", times=5, seconds=1.0)
    assert memory.said == ["Hello, ann."] * 2


def test_one_picture_may_be_wrong(memory: Remembered) -> None:
    """Nobody is greeted by one alone, nor by two that are far apart."""
    scene = Scene(memory)
    scene.see("ann", times=1)
    scene.see("ann", times=1, seconds=SURE + 0.1)
    assert memory.said == []


def test_a_program_that_is_started_anew_greets_nobody_twice(memory: Remembered) -> None:
    """The relay remembers."""
    Scene(memory).see("ann")
    again = Scene(memory)
    again.see("ann")
    assert memory.said == ["Hello, ann."]
    assert again.told[-1] == "ann was greeted already"


def test_of_two_that_ask_at_the_same_time_one_greets(memory: Remembered) -> None:
    """Both heard that nobody has; who wrote first greets."""
    one, other = Scene(memory), Scene(memory)
    # While the one has just been told that nobody has greeted her, the other does all of it.
    memory.between = lambda: other.see("ann")
    one.see("ann")
    assert memory.said == ["Hello, ann."]
    assert kinds(memory) == [BEGUN, GREETED, BEGUN]
    assert one.told[-1] == "ann is greeted by another program"


@pytest.mark.parametrize("fails_at", ["events", BEGUN, "publish", GREETED])
def test_a_relay_that_is_lost_in_the_middle_greets_at_most_once(memory: Remembered, fails_at: str) -> None:
    """What was not answered may have been done; the program goes on."""
    scene = Scene(memory)
    memory.fails_at = fails_at
    scene.see("ann")
    assert scene.told[-1] == "ann is not greeted: the relay does not answer"
    scene.see("ann", times=20, seconds=1.0)
    assert memory.said == ([] if fails_at == BEGUN else ["Hello, ann."])
    scene.see("ann", times=60, seconds=1.0)
    assert len(memory.said) == (1 if fails_at == BEGUN else 2)


def test_strangers_are_greeted_where_that_is_wanted(memory: Remembered) -> None:
    """All of them as one person."""
    Scene(memory).see(None, None)
    assert memory.said == []
    Scene(memory, GreetingConfig(strangers="Good day.")).see(None, None)
    assert memory.said == ["Good day."]
    assert memory.written[0]["data"] == {"person": STRANGER}


def test_the_text_is_as_one_likes(memory: Remembered) -> None:
    """Braces in it or in a name are letters."""
    Scene(memory, GreetingConfig(text="{hi} {name}!")).see("{0}")
    assert memory.said == ["{hi} {0}!"]


@pytest.mark.parametrize(
    "text",
    [
        None,
        3,
        "no json",
        "[]",
        '{"faces": {}}',
        '{"faces": [3]}',
        '{"faces": [{}]}',
        '{"faces": [{"name": 3}, {"name": ""}, {"name": "a\\nb"}]}',
        json.dumps({"faces": [{"name": "x" * 65}]}),
    ],
)
def test_what_makes_no_sense_is_nobody(text: Any) -> None:
    """Whatever comes on the topic."""
    assert persons(text, True) == []


def test_the_relay_is_asked_about_somebody_now_and_then(memory: Remembered) -> None:
    """Not with each picture."""
    scene = Scene(memory)
    scene.see("ann")
    memory.questions = 0
    scene.see("ann", times=round(5 * CHECK / 0.1), seconds=0.1)
    assert 4 <= memory.questions <= 5


def test_a_line_on_which_nothing_comes_is_lost(memory: Remembered) -> None:
    """It is asked before, and said when it is."""
    scene = Scene(memory)
    memory.now += BEAT
    scene.program.step()
    assert len(scene.socket.asked("/relay/ping")) == 1
    memory.now += SILENT
    with pytest.raises(Lost):
        scene.program.step()
    scene.program.lost("gone", 0.5)
    assert scene.told[-1] == "gone; again in 0.5 s"
    scene.connect()
    scene.see("ann")
    assert memory.said == ["Hello, ann."]


def test_what_the_relay_refuses_is_told(memory: Remembered) -> None:
    """As a topic that may not be heard."""
    scene = Scene(memory)
    scene.socket.coming.append({"op": "status", "level": "error", "msg": "you may not"})
    scene.program.step()
    assert scene.told[-1] == "refused: you may not"


@pytest.mark.parametrize(
    ("arguments", "token", "words"),
    [
        (["ws://127.0.0.1:1/robots/r"], "", "SWITCHBOARD_TOKEN"),
        (["http://127.0.0.1:1/"], "t", "is no address of a robot"),
        (["ws://127.0.0.1:1/robots/r", "--within", "0"], "t", "--within"),
    ],
)
def test_what_is_wrong_is_said_in_words(arguments: list[str], token: str, words: str) -> None:
    """No token, no robot's address, options that make no sense."""
    done = CliRunner().invoke(main, arguments, env={"SWITCHBOARD_TOKEN": token})
    assert done.exit_code != 0
    assert words in done.output
