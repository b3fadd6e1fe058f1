"""The voice program, with words and a websocket in memory."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from click.testing import CliRunner
from switchboard_socket import Socket

from robot_client.apps.audio import Block
from robot_client.apps.command_words import CommandWord, WordCommands
from robot_client.apps.connection import RosbridgeConnection
from robot_client.apps.driver import BEAT, LATE, MaximumSpeeds
from robot_client.apps.voice import KEEP, STALE, RecognisedWord, RecognitionThread, VoiceControl, main


class Said:
    """Words in memory."""

    def __init__(self) -> None:
        self.ended = False
        self.words: list[RecognisedWord] = []

    def heard(self) -> Iterator[RecognisedWord]:
        while self.words:
            yield self.words.pop(0)


class Scene:
    """The program at work."""

    def __init__(self, latch: bool = False) -> None:
        self.now = 100.0
        self.said = Said()
        self.told: list[str] = []
        self.program = VoiceControl(
            self.said,
            WordCommands(1.5),
            "/cmd_vel",
            MaximumSpeeds(0.4, 1.0),
            latch,
            lambda state, _: self.told.append(state),
            lambda: self.now,
        )
        self.goes_on = True
        self.connect()

    def connect(self) -> None:
        """A new line."""
        self.socket = Socket()
        self.socket.reached = True
        self.program.begin(RosbridgeConnection(self.socket))

    def step(self, *words: CommandWord, seconds: float = 0.06, age: float = 0.0) -> list[tuple[float, float]]:
        """One step in which these were said; what was said to the robot then."""
        before = len(self.socket.driven())
        self.now += seconds
        self.said.words += [RecognisedWord(each, self.now - age) for each in words]
        self.goes_on = self.program.step()
        while self.socket.coming:
            self.goes_on = self.program.step()
        return self.socket.driven()[before:]

    def take(self) -> None:
        """Have control."""
        self.socket.control(holder="me", you=True)
        self.step()


def test_a_word_takes_control_and_then_moves_the_robot() -> None:
    """For a second and a half, then it stands."""
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
    """Refused, or given when the word is long over."""
    scene = Scene()
    scene.step(CommandWord.AHEAD)
    scene.socket.answer(success=False, service="/relay/take_control")
    assert scene.step() == []
    assert "not done: no" in scene.told[-1]
    scene.step(CommandWord.LEFT)
    scene.step(seconds=STALE + 0.1)
    scene.take()
    assert scene.step() == []


def test_stop_is_zero_at_once() -> None:
    """In control it does not latch: the next word moves the robot."""
    scene = Scene()
    scene.take()
    scene.step(CommandWord.AHEAD)
    assert scene.step(CommandWord.STOP, seconds=0.001) == [(0.0, 0.0)]
    assert scene.socket.asked("/relay/stop") == []
    assert scene.step() == []
    assert scene.step(CommandWord.BACK) == [(pytest.approx(-0.2), 0.0)]


def test_stop_without_control_is_the_relays_stop() -> None:
    """A zero would not be obeyed there."""
    scene = Scene()
    scene.socket.control(holder="somebody")
    scene.step()
    scene.step(CommandWord.STOP)
    assert len(scene.socket.asked("/relay/stop")) == 1


def test_stop_while_somebody_suppresses_the_topic_is_the_relays_stop() -> None:
    """A zero would not be obeyed there either."""
    scene = Scene()
    scene.socket.control(holder="me", you=True)
    scene.socket.coming[-1]["msg"]["suppressed"] = [{"resource": "/cmd_vel"}]
    scene.step()
    scene.step(CommandWord.STOP)
    assert len(scene.socket.asked("/relay/stop")) == 1


def test_stop_where_the_robot_is_late_is_the_relays_stop() -> None:
    """A zero could be lost on the way; that stop is not."""
    scene = Scene()
    scene.take()
    scene.socket.reached = False
    scene.step(seconds=BEAT)
    scene.step(seconds=LATE + 0.1)
    scene.step(CommandWord.STOP)
    assert len(scene.socket.asked("/relay/stop")) == 1


def test_stop_in_control_is_zero_also_where_no_word_moved_the_robot() -> None:
    """Whoever drove before may have left it moving."""
    scene = Scene()
    scene.take()
    assert scene.step(CommandWord.STOP) == [(0.0, 0.0)]


def test_a_stop_is_told_as_asked_for_and_then_as_answered() -> None:
    """It is not done because it was said."""
    scene = Scene()
    scene.step(CommandWord.STOP)
    assert scene.told[-1] == "stop asked for, not answered yet"
    scene.socket.answer(service="/relay/stop")
    scene.socket.coming[-1]["values"]["done"] = False
    scene.step()
    assert "as soon as it is back" in scene.told[-1]


def test_a_stop_that_was_not_answered_is_said_again_by_the_next_connection() -> None:
    """The program does not end before, though nothing more is to be heard."""
    scene = Scene()
    scene.said.ended = True
    scene.step(CommandWord.STOP)
    assert scene.goes_on
    scene.program.lost("gone", 0.1)
    scene.connect()
    assert scene.socket.sent[0]["service"] == "/relay/stop"
    assert scene.told[-1] == "stop asked for, not answered yet"
    scene.socket.answer(service="/relay/stop")
    scene.step()
    assert not scene.goes_on


def test_a_stop_that_is_said_without_a_connection_is_done_by_the_next() -> None:
    """Of all words it alone."""
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
    """Though control was given meanwhile."""
    scene = Scene()
    scene.step(CommandWord.AHEAD)
    scene.socket.answer(service="/relay/take_control")
    assert scene.step(seconds=STALE + 0.5) == []
    assert "ahead: not done: heard too late" in scene.told


def test_stop_is_the_relays_stop_always_where_that_is_wanted() -> None:
    """After the zero."""
    scene = Scene(latch=True)
    scene.take()
    scene.step(CommandWord.AHEAD)
    scene.step(CommandWord.STOP)
    zero, stop = scene.socket.sent[-2:]
    assert zero["msg"]["linear"]["x"] == 0.0
    assert stop["service"] == "/relay/stop"


def test_a_word_that_comes_too_late_moves_nothing() -> None:
    """But *stop* counts however late it comes."""
    scene = Scene()
    scene.take()
    assert scene.step(CommandWord.AHEAD, age=STALE + 0.1) == []
    assert "too late" in scene.told[-1]
    scene.step(CommandWord.AHEAD)
    assert scene.step(CommandWord.STOP, age=10.0) == [(0.0, 0.0)]


def test_what_was_said_without_a_connection_does_not_count() -> None:
    """Nor does what was under way before."""
    scene = Scene()
    scene.take()
    scene.step(CommandWord.AHEAD)
    scene.program.lost("gone", 0.1)
    scene.said.words.append(RecognisedWord(CommandWord.LEFT, scene.now))
    scene.connect()
    scene.take()
    assert scene.step() == []


@pytest.mark.parametrize("who", ["stopped", "taken"])
def test_a_robot_that_is_stopped_or_anothers_is_let_go_of(who: str) -> None:
    """What was under way is not done later."""
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


def test_a_word_to_a_robot_that_is_stopped_is_told_so() -> None:
    """And moves nothing."""
    scene = Scene()
    scene.socket.control(holder="me", you=True, stopped="somebody")
    scene.step()
    assert scene.step(CommandWord.AHEAD) == []
    assert "stopped by somebody" in scene.told[-1]


def test_a_link_that_is_late_lets_go() -> None:
    """The robot stands, and a word is told why."""
    scene = Scene()
    scene.take()
    scene.step(CommandWord.AHEAD)
    scene.socket.reached = False
    scene.step(seconds=BEAT)
    assert scene.step(seconds=LATE + 0.1) == [(0.0, 0.0)]
    assert scene.step(CommandWord.AHEAD) == []
    assert "does not answer" in scene.told[-1]


def test_control_is_given_back_when_nothing_is_said() -> None:
    """So that others can drive."""
    scene = Scene()
    scene.take()
    scene.step(CommandWord.AHEAD)
    for _ in range(round(KEEP / 0.5)):
        assert scene.socket.asked("/relay/release_control") == []
        scene.step(seconds=0.5)
    scene.step(seconds=0.5)
    assert len(scene.socket.asked("/relay/release_control")) == 1


def test_it_ends_when_all_was_said_and_done() -> None:
    """Not in the middle of the last word."""
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
    def hear(self, data: bytes) -> list[tuple[CommandWord, float]]:
        return [(CommandWord.LEFT, 0.25)] if data == b"left" else []


def test_a_word_is_as_old_as_its_end() -> None:
    """By the moment of the block it was found in."""
    listening = RecognitionThread([Block(b"", 9.0), Block(b"left", 10.0)], _Ear())
    listening.start()
    listening.join()
    assert list(listening.heard()) == [RecognisedWord(CommandWord.LEFT, 9.75)]
    assert listening.ended


@pytest.mark.parametrize(
    ("arguments", "token", "words"),
    [
        ([], "", "SWITCHBOARD_TOKEN"),
        (["--wav", "/dev/null"], "t", "can't be read as WAV"),
        (["--wav", "/dev/null", "--pcm"], "t", "one of"),
        (["--seconds", "60"], "t", "--seconds"),
    ],
)
def test_what_is_wrong_is_said_in_words(arguments: list[str], token: str, words: str) -> None:
    """No token, no sound, two sources, a word that would act for too long."""
    done = CliRunner().invoke(
        main, ["ws://127.0.0.1:1/robots/r", *arguments], env={"SWITCHBOARD_TOKEN": token}
    )
    assert done.exit_code != 0
    assert words in done.output
