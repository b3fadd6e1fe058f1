"""The voice program, with words and a websocket in memory."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from click.testing import CliRunner

from robot_client.apps.audio import Block
from robot_client.apps.command_words import CommandWord, WordCommands
from robot_client.apps.connection import RosbridgeConnection
from robot_client.apps.driver import PING_SECONDS, UNRESPONSIVE_SECONDS, MaximumSpeeds
from robot_client.apps.voice import (
    MAX_WORD_AGE,
    RELEASE_AFTER,
    RecognisedWord,
    RecognitionThread,
    VoiceControl,
    main,
)
from tests.worlds.memory_socket import Socket


class Said:
    """Words in memory."""

    def __init__(self) -> None:
        self.ended = False
        self.words: list[RecognisedWord] = []

    def take_words(self) -> Iterator[RecognisedWord]:
        while self.words:
            yield self.words.pop(0)


class Scene:
    """A running program."""

    def __init__(self, latch: bool = False) -> None:
        self.now = 100.0
        self.said = Said()
        self.reported: list[str] = []
        self.program = VoiceControl(
            self.said,
            WordCommands(1.5),
            "/cmd_vel",
            MaximumSpeeds(0.4, 1.0),
            latch,
            lambda state, _: self.reported.append(state),
            lambda: self.now,
        )
        self.goes_on = True
        self.connect()

    def connect(self) -> None:
        """Makes a new connection."""
        self.socket = Socket()
        self.socket.reached = True
        self.program.begin(RosbridgeConnection(self.socket))

    def step(self, *words: CommandWord, seconds: float = 0.06, age: float = 0.0) -> list[tuple[float, float]]:
        """One step with these words; returns the commands."""
        before = len(self.socket.driven())
        self.now += seconds
        self.said.words += [RecognisedWord(each, self.now - age) for each in words]
        self.goes_on = self.program.step()
        while self.socket.coming:
            self.goes_on = self.program.step()
        return self.socket.driven()[before:]

    def take(self) -> None:
        """Takes control."""
        self.socket.control(holder="me", you=True)
        self.step()


def test_a_word_takes_control_and_then_moves_the_robot() -> None:
    """For 1.5 s, then it stands."""
    scene = Scene()
    assert scene.step(CommandWord.AHEAD) == []
    assert len(scene.socket.asked("/relay/take_control")) == 1
    scene.socket.answer(service="/relay/take_control")
    assert scene.step() == [(pytest.approx(0.2), 0.0)]
    commands = [each for _ in range(40) for each in scene.step()]
    assert commands[-1] == (0.0, 0.0)
    assert {round(each[0], 6) for each in commands[:-1]} == {0.2}
    assert len(commands) == pytest.approx(25, abs=2)


def test_without_control_a_word_is_not_done_later() -> None:
    """Control may be refused, or granted when the word has expired."""
    scene = Scene()
    scene.step(CommandWord.AHEAD)
    scene.socket.answer(success=False, service="/relay/take_control")
    assert scene.step() == []
    assert "not done: no" in scene.reported[-1]
    scene.step(CommandWord.LEFT)
    scene.step(seconds=MAX_WORD_AGE + 0.1)
    scene.take()
    assert scene.step() == []


def test_stop_is_zero_at_once() -> None:
    """With control it does not latch: the next word moves the robot."""
    scene = Scene()
    scene.take()
    scene.step(CommandWord.AHEAD)
    assert scene.step(CommandWord.STOP, seconds=0.001) == [(0.0, 0.0)]
    assert scene.socket.asked("/relay/stop") == []
    assert scene.step() == []
    assert scene.step(CommandWord.BACK) == [(pytest.approx(-0.2), 0.0)]


def test_stop_without_control_is_the_relays_stop() -> None:
    """A zero would be refused then."""
    scene = Scene()
    scene.socket.control(holder="somebody")
    scene.step()
    scene.step(CommandWord.STOP)
    assert len(scene.socket.asked("/relay/stop")) == 1


def test_stop_during_suppression_is_the_relays_stop() -> None:
    """A zero would be refused then too."""
    scene = Scene()
    scene.socket.control(holder="me", you=True)
    scene.socket.coming[-1]["msg"]["suppressed"] = [{"resource": "/cmd_vel"}]
    scene.step()
    scene.step(CommandWord.STOP)
    assert len(scene.socket.asked("/relay/stop")) == 1


def test_stop_where_the_robot_is_late_is_the_relays_stop() -> None:
    """A zero could be lost on the late link; the relay's stop is not."""
    scene = Scene()
    scene.take()
    scene.socket.reached = False
    scene.step(seconds=PING_SECONDS)
    scene.step(seconds=UNRESPONSIVE_SECONDS + 0.1)
    scene.step(CommandWord.STOP)
    assert len(scene.socket.asked("/relay/stop")) == 1


def test_stop_in_control_is_zero_also_where_no_word_moved_the_robot() -> None:
    """An earlier driver may have left it moving."""
    scene = Scene()
    scene.take()
    assert scene.step(CommandWord.STOP) == [(0.0, 0.0)]


def test_a_stop_is_reported_as_requested_and_then_as_answered() -> None:
    """Sending it does not count as done."""
    scene = Scene()
    scene.step(CommandWord.STOP)
    assert scene.reported[-1] == "stop requested, not confirmed yet"
    scene.socket.answer(service="/relay/stop")
    scene.socket.coming[-1]["values"]["done"] = False
    scene.step()
    assert "as soon as it is online" in scene.reported[-1]


def test_an_unanswered_stop_is_sent_again_by_the_next_connection() -> None:
    """The program does not end before, even if no more speech follows."""
    scene = Scene()
    scene.said.ended = True
    scene.step(CommandWord.STOP)
    assert scene.goes_on
    scene.program.lost("gone", 0.1)
    scene.connect()
    assert scene.socket.sent[0]["service"] == "/relay/stop"
    assert scene.reported[-1] == "stop requested, not confirmed yet"
    scene.socket.answer(service="/relay/stop")
    scene.step()
    assert not scene.goes_on


def test_a_stop_spoken_without_a_connection_is_sent_by_the_next() -> None:
    """No other word is kept."""
    scene = Scene()
    scene.program.lost("gone", 0.1)
    scene.said.words += [
        RecognisedWord(CommandWord.STOP, scene.now),
        RecognisedWord(CommandWord.LEFT, scene.now),
    ]
    scene.connect()
    assert scene.socket.sent[0]["service"] == "/relay/stop"
    assert scene.said.words == []


def test_a_word_that_waited_while_the_program_stood_still_moves_nothing() -> None:
    """Even if control was granted meanwhile."""
    scene = Scene()
    scene.step(CommandWord.AHEAD)
    scene.socket.answer(service="/relay/take_control")
    assert scene.step(seconds=MAX_WORD_AGE + 0.5) == []
    assert "ahead: not done: too late" in scene.reported


def test_stop_is_always_the_relays_stop_where_configured() -> None:
    """After the zero."""
    scene = Scene(latch=True)
    scene.take()
    scene.step(CommandWord.AHEAD)
    scene.step(CommandWord.STOP)
    zero, stop = scene.socket.sent[-2:]
    assert zero["msg"]["linear"]["x"] == 0.0
    assert stop["service"] == "/relay/stop"


def test_a_word_that_comes_too_late_moves_nothing() -> None:
    """*stop* counts at any age."""
    scene = Scene()
    scene.take()
    assert scene.step(CommandWord.AHEAD, age=MAX_WORD_AGE + 0.1) == []
    assert "too late" in scene.reported[-1]
    scene.step(CommandWord.AHEAD)
    assert scene.step(CommandWord.STOP, age=10.0) == [(0.0, 0.0)]


def test_speech_without_a_connection_does_not_count() -> None:
    """Nor do earlier words continue."""
    scene = Scene()
    scene.take()
    scene.step(CommandWord.AHEAD)
    scene.program.lost("gone", 0.1)
    scene.said.words.append(RecognisedWord(CommandWord.LEFT, scene.now))
    scene.connect()
    scene.take()
    assert scene.step() == []


@pytest.mark.parametrize("who", ["stopped", "taken"])
def test_a_robot_that_is_stopped_or_controlled_by_another_is_released(who: str) -> None:
    """Earlier words are not executed later."""
    scene = Scene()
    scene.take()
    scene.step(CommandWord.AHEAD)
    if who == "stopped":
        scene.socket.control(holder="me", you=True, stopped="somebody")
    else:
        scene.socket.control(holder="somebody")
    scene.step()
    scene.socket.control(holder="me", you=True)
    assert scene.step() == []


def test_a_word_to_a_stopped_robot_is_answered_so() -> None:
    """It moves nothing."""
    scene = Scene()
    scene.socket.control(holder="me", you=True, stopped="somebody")
    scene.step()
    assert scene.step(CommandWord.AHEAD) == []
    assert "stopped by somebody" in scene.reported[-1]


def test_a_late_link_releases_control() -> None:
    """The robot stands, and a word gets the reason."""
    scene = Scene()
    scene.take()
    scene.step(CommandWord.AHEAD)
    scene.socket.reached = False
    scene.step(seconds=PING_SECONDS)
    assert scene.step(seconds=UNRESPONSIVE_SECONDS + 0.1) == [(0.0, 0.0)]
    assert scene.step(CommandWord.AHEAD) == []
    assert "does not answer" in scene.reported[-1]


def test_control_is_released_after_silence() -> None:
    """So that others can drive."""
    scene = Scene()
    scene.take()
    scene.step(CommandWord.AHEAD)
    for _ in range(round(RELEASE_AFTER / 0.5)):
        assert scene.socket.asked("/relay/release_control") == []
        scene.step(seconds=0.5)
    scene.step(seconds=0.5)
    assert len(scene.socket.asked("/relay/release_control")) == 1


def test_it_ends_after_the_last_word_was_executed() -> None:
    """The last word is completed."""
    scene = Scene()
    scene.take()
    scene.said.ended = True
    scene.step(CommandWord.AHEAD)
    assert scene.goes_on
    steps = 0
    while scene.goes_on:
        scene.step()
        steps += 1
    assert steps == pytest.approx(25, abs=2)
    assert scene.socket.driven()[-1] == (0.0, 0.0)


def test_the_end_is_zero_and_gives_control_back() -> None:
    """In this order."""
    scene = Scene()
    scene.take()
    scene.step(CommandWord.AHEAD)
    scene.program.leave()
    zero, release = scene.socket.sent[-2:]
    assert zero["msg"]["linear"]["x"] == 0.0
    assert release["service"] == "/relay/release_control"


class _Ear:
    def recognize(self, data: bytes) -> list[tuple[CommandWord, float]]:
        return [(CommandWord.LEFT, 0.25)] if data == b"left" else []


def test_a_word_is_as_old_as_its_end() -> None:
    """By the time of the block in which it was recognised."""
    listening = RecognitionThread([Block(b"", 9.0), Block(b"left", 10.0)], _Ear())
    listening.start()
    listening.join()
    assert list(listening.take_words()) == [RecognisedWord(CommandWord.LEFT, 9.75)]
    assert listening.ended


@pytest.mark.parametrize(
    ("arguments", "token", "words"),
    [
        ([], "", "SWITCHBOARD_TOKEN"),
        (["--wav", "/dev/null"], "t", "cannot read"),
        (["--wav", "/dev/null", "--pcm"], "t", "one of"),
        (["--seconds", "60"], "t", "--seconds"),
    ],
)
def test_error_is_explained(arguments: list[str], token: str, words: str) -> None:
    """No token, no sound, two sources, a word with too long an effect."""
    done = CliRunner().invoke(
        main, ["ws://127.0.0.1:1/robots/r", *arguments], env={"SWITCHBOARD_TOKEN": token}
    )
    assert done.exit_code != 0
    assert words in done.output
