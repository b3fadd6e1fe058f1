"""The greeting program, with a websocket and an event log in memory."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest
from click.testing import CliRunner

from robot_client.apps.connection import Lost, RosbridgeConnection
from robot_client.apps.event_client import EventLogUnavailable
from robot_client.apps.greeting import (
    BEGUN,
    CONFIRM_SECONDS,
    GREETED,
    LOST_SECONDS,
    PING_SECONDS,
    RECHECK_SECONDS,
    STRANGER,
    Greeting,
    GreetingConfig,
    main,
    person_names,
)
from tests.worlds.memory_socket import Socket

FACES = "/faces/seen"


class Remembered:
    """A relay's event log, shared by programs."""

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
            raise EventLogUnavailable("the relay does not answer")


class Scene:
    """A running program."""

    def __init__(self, memory: Remembered, config: GreetingConfig | None = None) -> None:
        self.memory = memory
        self.reported: list[str] = []
        self.program = Greeting(
            FACES, "/say", memory, config or GreetingConfig(), self.reported.append, lambda: self.memory.now
        )
        self.connect()

    def connect(self) -> None:
        """Makes a new connection."""
        self.socket = Socket()
        self.program.begin(RosbridgeConnection(self.socket))

    def see(self, *names: str | None, times: int = 2, seconds: float = 0.2) -> None:
        """Sends images with these persons."""
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


def test_arriving_person_is_greeted_once(memory: Remembered) -> None:
    """For any length of stay; each person by name."""
    scene = Scene(memory)
    scene.see("ann", times=100)
    scene.see("ann", "bob", times=3)
    assert memory.said == ["Hello, ann.", "Hello, bob."]
    assert kinds(memory) == [BEGUN, GREETED] * 2
    assert "greeted ann" in scene.reported


def test_a_person_is_greeted_again_after_a_minute(memory: Remembered) -> None:
    """Not before."""
    scene = Scene(memory)
    scene.see("ann")
    scene.see("ann", times=57, seconds=1.0)
    assert memory.said == ["Hello, ann."]
    scene.see("ann", times=5, seconds=1.0)
    assert memory.said == ["Hello, ann."] * 2


def test_single_wrong_frame_is_tolerated(memory: Remembered) -> None:
    """A single image causes no greeting, nor do two that are far apart."""
    scene = Scene(memory)
    scene.see("ann", times=1)
    scene.see("ann", times=1, seconds=CONFIRM_SECONDS + 0.1)
    assert memory.said == []


def test_a_restarted_program_greets_no_person_twice(memory: Remembered) -> None:
    """The relay has the event."""
    Scene(memory).see("ann")
    again = Scene(memory)
    again.see("ann")
    assert memory.said == ["Hello, ann."]
    assert again.reported[-1] == "ann was greeted already"


def test_of_two_that_ask_at_the_same_time_one_greets(memory: Remembered) -> None:
    """Both found no earlier greeting; the first event counts."""
    one, other = Scene(memory), Scene(memory)
    # While the first program has just read that there is no greeting, the second does all steps.
    memory.between = lambda: other.see("ann")
    one.see("ann")
    assert memory.said == ["Hello, ann."]
    assert kinds(memory) == [BEGUN, GREETED, BEGUN]
    assert one.reported[-1] == "ann is greeted by another program"


@pytest.mark.parametrize("fails_at", ["events", BEGUN, "publish", GREETED])
def test_a_relay_that_is_lost_in_the_middle_greets_at_most_once(memory: Remembered, fails_at: str) -> None:
    """A request without an answer may have been executed; the program continues."""
    scene = Scene(memory)
    memory.fails_at = fails_at
    scene.see("ann")
    assert scene.reported[-1] == "ann is not greeted: the relay does not answer"
    scene.see("ann", times=20, seconds=1.0)
    assert memory.said == ([] if fails_at == BEGUN else ["Hello, ann."])
    scene.see("ann", times=60, seconds=1.0)
    assert len(memory.said) == (1 if fails_at == BEGUN else 2)


def test_strangers_are_greeted_where_configured(memory: Remembered) -> None:
    """All of them as one person."""
    Scene(memory).see(None, None)
    assert memory.said == []
    Scene(memory, GreetingConfig(strangers="Good day.")).see(None, None)
    assert memory.said == ["Good day."]
    assert memory.written[0]["data"] == {"person": STRANGER}


def test_the_text_is_as_one_likes(memory: Remembered) -> None:
    """Braces in the text or in a name are literal."""
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
def test_unusable_image_shows_no_face(text: Any) -> None:
    """For any message on the topic."""
    assert person_names(text, True) == []


def test_the_relay_is_queried_about_a_person_periodically(memory: Remembered) -> None:
    """Not for each image."""
    scene = Scene(memory)
    scene.see("ann")
    memory.questions = 0
    scene.see("ann", times=round(5 * RECHECK_SECONDS / 0.1), seconds=0.1)
    assert 4 <= memory.questions <= 5


def test_a_line_on_which_nothing_comes_is_lost(memory: Remembered) -> None:
    """It is pinged before, and its loss is reported."""
    scene = Scene(memory)
    memory.now += PING_SECONDS
    scene.program.step()
    assert len(scene.socket.asked("/relay/ping")) == 1
    memory.now += LOST_SECONDS
    with pytest.raises(Lost):
        scene.program.step()
    scene.program.lost("gone", 0.5)
    assert scene.reported[-1] == "gone; again in 0.5 s"
    scene.connect()
    scene.see("ann")
    assert memory.said == ["Hello, ann."]


def test_refusal_of_the_relay_is_reported(memory: Remembered) -> None:
    """For example a topic without the right to subscribe."""
    scene = Scene(memory)
    scene.socket.coming.append({"op": "status", "level": "error", "msg": "you may not"})
    scene.program.step()
    assert scene.reported[-1] == "refused: you may not"


@pytest.mark.parametrize(
    ("arguments", "token", "words"),
    [
        (["ws://127.0.0.1:1/robots/r"], "", "SWITCHBOARD_TOKEN"),
        (["http://127.0.0.1:1/"], "t", "is not the address of a robot"),
        (["ws://127.0.0.1:1/robots/r", "--within", "0"], "t", "--within"),
    ],
)
def test_error_is_explained(arguments: list[str], token: str, words: str) -> None:
    """No token, no robot's address, invalid options."""
    done = CliRunner().invoke(main, arguments, env={"SWITCHBOARD_TOKEN": token})
    assert done.exit_code != 0
    assert words in done.output
