"""Moves a robot by words: ``python -m robot_client.apps.voice``.

*right*, *left*, *ahead*, *back*, *faster*, *slower*, *stop*, recognised on this computer. Each moves the robot for a
moment only, then it stands; said again it goes on. *stop* is zero at once; where a zero would not be obeyed (without
control, while somebody suppresses the topic, or where the robot is late) it is the relay's stop, which lasts until
somebody resumes the robot. What is none of these words moves nothing.
"""

from __future__ import annotations

import math
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from io import FileIO
from pathlib import Path
from threading import Thread
from typing import NamedTuple, Protocol

import click

from robot_client.apps import audio
from robot_client.apps.clock import now as since_start
from robot_client.apps.command_words import MOVES, SECONDS, CommandWord, WordCommands
from robot_client.apps.connection import RosbridgeConnection, in_words, token
from robot_client.apps.driver import STILL, Driver, MaximumSpeeds, StopNotice
from robot_client.apps.options import driving
from robot_client.apps.reconnect import Ending, run_connected
from robot_client.apps.speech_recognition import Recognizer
from robot_client.apps.status_line import StatusLine
from robot_client.numbers import Number

NAME = "voice"
LOOK = 0.02
EVERY = 0.05
"""Seconds from one command to the next."""

STALE = 1.0
"""Seconds after which a word counts no more: held up on its way, or without control. *stop* is never too old."""

KEEP = 15.0
"""Seconds without a word after which control is given back."""

WAITING = 16
"""Words that wait to be done, at most."""


class RecognisedWord(NamedTuple):
    """A word.

    :ivar at: seconds, suspends included, when it ended
    """

    word: CommandWord
    at: float


class SpeechSource(Protocol):
    """Finds words in sound."""

    def hear(self, data: bytes) -> Iterable[tuple[CommandWord, float]]:
        """Words found with one block more, and how many seconds before its end each ended."""


class RecognitionThread(Thread):
    """Hears, in a thread of its own.

    :param blocks: of sound
    :ivar ended: whether there is nothing more to hear
    """

    def __init__(self, blocks: Iterable[audio.Block], ear: SpeechSource) -> None:
        super().__init__(daemon=True)
        self.ended = False
        self._blocks = blocks
        self._ear = ear
        self._heard: deque[RecognisedWord] = deque(maxlen=WAITING)

    def run(self) -> None:
        """Hear all there is."""
        try:
            for block in self._blocks:
                for word, before in self._ear.hear(block.data):
                    self._heard.append(RecognisedWord(word, block.at - before))
        finally:
            self.ended = True

    def heard(self) -> Iterator[RecognisedWord]:
        """The words since this was asked last."""
        while self._heard:
            yield self._heard.popleft()


class Words(Protocol):
    """Where words come from: :class:`RecognitionThread`."""

    ended: bool

    def heard(self) -> Iterator[RecognisedWord]:
        """The words since this was asked last."""


class VoiceControl:
    """Does what words say.

    :param words: where they come from
    :param orders: what they mean
    :param topic: of the commands
    :param wanted: the fastest, within what the robot allows
    :param latch: whether *stop* is the relay's stop always
    :param tell: takes the state in a few words, and what changes all the time
    :param clock: seconds, suspends included
    """

    def __init__(
        self,
        words: Words,
        orders: WordCommands,
        topic: str,
        wanted: MaximumSpeeds,
        latch: bool,
        tell: Callable[[str, str], None],
        clock: Callable[[], float] = since_start,
    ) -> None:
        self._words = words
        self._orders = orders
        self._topic = topic
        self._wanted = wanted
        self._latch = latch
        self._tell = tell
        self._clock = clock
        self._driver: Driver
        self._asked = StopNotice()
        self._told_of_stop = ""
        self._waits: RecognisedWord | None = None
        """The word that waits for control."""
        self._sent = -math.inf
        self._spoken = -math.inf
        self._moves = False

    def begin(self, line: RosbridgeConnection) -> None:
        """There is a line. What was said before does not count by it; but *stop* does."""
        self._forget()
        self._spoken = self._clock()
        if CommandWord.STOP in {heard.word for heard in self._words.heard()}:
            self._asked.ask()
        self._driver = Driver(line, self._topic, NAME, self._clock, self._asked)
        self._tell("listening", "")
        self._told_of_stop = ""
        if self._asked.asked:
            self._tell_of_stop()

    def step(self) -> bool:
        """Take what comes within a moment, and do what was said."""
        ended = self._words.ended  # what was said last is heard below
        self._driver.hear(LOOK)
        now = self._clock()
        for heard in self._words.heard():
            self._do(heard, now)
        if self._waits is not None:
            self._wait(self._waits, now)
        self._move(now)
        if self._asked.words != self._told_of_stop:
            self._tell_of_stop()
        if self._driver.in_control and not self._moves and now - self._spoken > KEEP:
            self._driver.give_back()
            self._tell("nothing was said for long: control given back", "")
        return not ended or self._moves or self._waits is not None or self._asked.asked

    def leave(self) -> None:
        """Stand still, and let others drive."""
        self._forget()
        self._driver.give_back()

    def lost(self, why: str, seconds: float) -> None:
        """Say so; the robot stands by itself."""
        self._forget()
        self._tell(f"{why}; again in {seconds:.1f} s", "")

    def _forget(self) -> None:
        self._orders.still()
        self._waits = None
        self._moves = False

    def _do(self, heard: RecognisedWord, now: float) -> None:
        word, driver = heard.word, self._driver
        self._spoken = now
        if word is CommandWord.STOP:
            self._stop()
        elif now - heard.at > STALE:
            self._tell(f"{word.value}: heard too late, not done", "")
        elif word not in MOVES:
            self._orders.say(word, now)
            self._tell(word.value, "")
        elif driver.in_control:
            self._begin(word, now)
        else:
            self._waits = heard
            driver.take()

    def _stop(self) -> None:
        driver = self._driver
        self._forget()
        if self._latch or not driver.in_control or driver.suppressed or driver.late:
            driver.stop()
        else:
            # Also where nothing was said that moves: whoever drove before may have left the robot moving.
            driver.drive(STILL)
            self._tell("stop", "")

    def _tell_of_stop(self) -> None:
        self._told_of_stop = self._asked.words
        self._tell(self._told_of_stop, "")

    def _wait(self, heard: RecognisedWord, now: float) -> None:
        driver = self._driver
        stale = now - heard.at > STALE
        if driver.in_control and not stale:
            self._waits = None
            self._begin(heard.word, now)
        elif driver.said or stale:
            self._waits = None
            why = (
                driver.said
                or driver.obstacle
                or ("no control" if not driver.in_control else "heard too late")
            )
            self._tell(f"{heard.word.value}: not done: {why}", "")

    def _begin(self, word: CommandWord, now: float) -> None:
        why = self._driver.obstacle or ("the robot does not answer" if self._driver.late else "")
        if why:
            self._tell(f"{word.value}: not done: {why}", "")
        else:
            self._orders.say(word, now)
            self._sent = -math.inf
            self._tell(word.value, "")

    def _move(self, now: float) -> None:
        driver = self._driver
        if driver.obstacle or driver.late or not driver.in_control:
            self._orders.still()
        command = self._orders.command(self._wanted.within(driver.limits), now)
        if command is None:
            if self._moves:
                driver.still()
                self._tell("stands", "")
        elif now - self._sent >= EVERY:
            self._sent = now
            driver.drive(command)
        self._moves = command is not None


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@driving
@click.option(
    "--wav",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Hear a file: 16000 Hz, 16 bits, one channel.",
)
@click.option("--pcm", is_flag=True, help="Hear the standard input: raw samples of the same form.")
@click.option("--microphone", metavar="NAME", help="Which microphone, by its number or a part of its name.")
@click.option("--latch", is_flag=True, help="Have 'stop' stop the robot until somebody resumes it, always.")
@click.option(
    "--seconds",
    type=Number(0.3, 5.0),
    default=SECONDS,
    show_default=True,
    help="How long a word acts.",
)
def main(
    url: str,
    topic: str,
    speed: float,
    turn: float,
    wav: Path | None,
    pcm: bool,
    microphone: str | None,
    latch: bool,
    seconds: float,
) -> None:
    """Move the robot at URL (ws://relay/robots/NAME) by words: right, left, ahead, back, faster, slower, stop.

    They are heard by the microphone, if nothing else is said, and recognised on this computer. Each acts for a
    moment, then the robot stands. 'stop' is zero at once; without control it stops the robot until it is resumed.

    The token comes from the variable SWITCHBOARD_TOKEN. SIGINT and SIGTERM end it.

    \b
    Examples:
      ROBOT=ws://127.0.0.1:9090/robots/robot-one
      python -m robot_client.apps.voice $ROBOT
      python -m robot_client.apps.voice $ROBOT --wav orders.wav
      arecord -q -t raw -f S16_LE -r 16000 -c 1 | python -m robot_client.apps.voice $ROBOT --pcm
    """
    if (wav is not None) + pcm + (microphone is not None) > 1:
        raise click.UsageError("one of --wav, --pcm and --microphone is enough")
    token()
    tape = audio.AudioBuffer(_source(wav, pcm, microphone))
    listening = RecognitionThread(tape, Recognizer())
    ending = Ending()
    status = StatusLine(sys.stdout, time.monotonic)
    program = VoiceControl(
        listening, WordCommands(seconds), topic, MaximumSpeeds(speed, turn), latch, status.tell
    )
    tape.start()
    listening.start()
    with in_words():
        run_connected(url, program, ending)
    status.end(tape.broken or "ended")


def _source(wav: Path | None, pcm: bool, microphone: str | None) -> Iterator[bytes]:
    if wav is not None:
        return audio.from_file(wav)
    if pcm:
        return audio.from_stream(FileIO(0, closefd=False))
    return audio.from_microphone(microphone)


if __name__ == "__main__":
    main()
