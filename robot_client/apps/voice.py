"""Moves a robot by words: ``python -m robot_client.apps.voice``.

*right*, *left*, *ahead*, *back*, *faster*, *slower*, *stop*, recognised on this computer. Each word moves the robot for
a moment; repeating it continues the motion. *stop* is zero velocity at once. If zero velocity would not be obeyed
(without control, while the topic is suppressed, or when the robot does not answer), it is the relay's stop, which lasts
until the robot is resumed.
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

from relay_protocol.clocks import now as seconds_since_boot
from relay_protocol.command_output import OutputCommand
from robot_client.apps import audio
from robot_client.apps.command_words import MOTION_WORDS, SECONDS, CommandWord, WordCommands
from robot_client.apps.connection import RosbridgeConnection, access_token, errors_as_click
from robot_client.apps.driver import ZERO_VELOCITY, Driver, MaximumSpeeds, StopRequest
from robot_client.apps.program import ExitSignal, StatusLine, driving, run_connected
from robot_client.apps.speech_recognition import Recognizer
from robot_client.command_line import Number

NAME = "voice"
POLL_SECONDS = 0.02
COMMAND_SECONDS = 0.05
"""Interval of commands, seconds."""

MAX_WORD_AGE = 1.0
"""Seconds after which a word is ignored. *stop* never expires."""

RELEASE_AFTER = 15.0
"""Seconds without a word after which control is released."""

MAX_WAITING_WORDS = 16
"""Most words that wait."""


class RecognisedWord(NamedTuple):
    """A recognised word.

    :ivar at: seconds, including suspends, when it ended
    """

    word: CommandWord
    at: float


class SpeechSource(Protocol):
    """Recognises words in sound."""

    def recognize(self, data: bytes) -> Iterable[tuple[CommandWord, float]]:
        """Add a block; yields words, and how many seconds before the block's end each ended."""


class RecognitionThread(Thread):
    """Recognises words in a thread of its own.

    :param blocks: of sound
    :ivar ended: whether the sound has ended
    """

    def __init__(self, blocks: Iterable[audio.Block], recognizer: SpeechSource) -> None:
        super().__init__(daemon=True)
        self.ended = False
        self._blocks = blocks
        self._recognizer = recognizer
        self._recognised: deque[RecognisedWord] = deque(maxlen=MAX_WAITING_WORDS)

    def run(self) -> None:
        """Process all blocks."""
        try:
            for block in self._blocks:
                for word, before in self._recognizer.recognize(block.data):
                    self._recognised.append(RecognisedWord(word, block.at - before))
        finally:
            self.ended = True

    def take_words(self) -> Iterator[RecognisedWord]:
        """Words recognised since the last call."""
        while self._recognised:
            yield self._recognised.popleft()


class Words(Protocol):
    """Source of words: :class:`RecognitionThread`."""

    ended: bool

    def take_words(self) -> Iterator[RecognisedWord]:
        """Words recognised since the last call."""


class VoiceControl:
    """Drives a robot by words.

    :param words: source of words
    :param orders: their meaning
    :param topic: of the commands
    :param wanted: maximum speeds; the robot's own limits apply too
    :param latch: whether *stop* is always the relay's stop
    :param report: takes the state, and details that change all the time
    :param clock: seconds, including suspends
    """

    def __init__(
        self,
        words: Words,
        orders: WordCommands,
        topic: str,
        wanted: MaximumSpeeds,
        latch: bool,
        report: Callable[[str, str], None],
        clock: Callable[[], float] = seconds_since_boot,
    ) -> None:
        self._words = words
        self._orders = orders
        self._topic = topic
        self._wanted = wanted
        self._latch = latch
        self._report = report
        self._clock = clock
        self._driver: Driver
        self._stop_request = StopRequest()
        self._shown_stop_text = ""
        self._waiting_word: RecognisedWord | None = None
        """The word that waits for control."""
        self._sent = -math.inf
        self._last_word_at = -math.inf
        self._moving = False

    def begin(self, connection: RosbridgeConnection) -> None:
        """A connection was made. Earlier words are ignored, except *stop*."""
        self._cancel_words()
        self._last_word_at = self._clock()
        if CommandWord.STOP in {recognised.word for recognised in self._words.take_words()}:
            self._stop_request.request()
        self._driver = Driver(connection, self._topic, NAME, self._clock, self._stop_request)
        self._report("listening", "")
        self._shown_stop_text = ""
        if self._stop_request.pending:
            self._show_stop()

    def step(self) -> bool:
        """Take what comes within a moment, and do what was said."""
        ended = self._words.ended  # the last words are taken below
        self._driver.poll(POLL_SECONDS)
        now = self._clock()
        for recognised in self._words.take_words():
            self._do(recognised, now)
        if self._waiting_word is not None:
            self._wait(self._waiting_word, now)
        self._move(now)
        if self._stop_request.text != self._shown_stop_text:
            self._show_stop()
        if self._driver.in_control and not self._moving and now - self._last_word_at > RELEASE_AFTER:
            self._driver.release_control()
            self._report("no words for a while: control released", "")
        return not ended or self._moving or self._waiting_word is not None or self._stop_request.pending

    def leave(self) -> None:
        """Stop the robot and release control."""
        self._cancel_words()
        self._driver.release_control()

    def lost(self, why: str, seconds: float) -> None:
        """Report it. The robot stops by itself."""
        self._cancel_words()
        self._report(f"{why}; again in {seconds:.1f} s", "")

    def _cancel_words(self) -> None:
        self._orders.cancel()
        self._waiting_word = None
        self._moving = False

    def _do(self, recognised: RecognisedWord, now: float) -> None:
        word, driver = recognised.word, self._driver
        self._last_word_at = now
        if word is CommandWord.STOP:
            self._stop()
        elif now - recognised.at > MAX_WORD_AGE:
            self._report(f"{word.value}: too late, ignored", "")
        elif word not in MOTION_WORDS:
            self._orders.handle(word, now)
            self._report(word.value, "")
        elif driver.in_control:
            self._begin(word, now)
        else:
            self._waiting_word = recognised
            driver.request_control()

    def _stop(self) -> None:
        driver = self._driver
        self._cancel_words()
        if self._latch or not driver.in_control or driver.suppressed or driver.unresponsive:
            driver.stop()
        else:
            # Also without a motion of this program: an earlier driver may have left the robot moving.
            driver.drive(ZERO_VELOCITY)
            self._report("stop", "")

    def _show_stop(self) -> None:
        self._shown_stop_text = self._stop_request.text
        self._report(self._shown_stop_text, "")

    def _wait(self, recognised: RecognisedWord, now: float) -> None:
        driver = self._driver
        stale = now - recognised.at > MAX_WORD_AGE
        if driver.in_control and not stale:
            self._waiting_word = None
            self._begin(recognised.word, now)
        elif driver.refusal or stale:
            self._waiting_word = None
            why = (
                driver.refusal or driver.blocked_by or ("no control" if not driver.in_control else "too late")
            )
            self._report(f"{recognised.word.value}: not done: {why}", "")

    def _begin(self, word: CommandWord, now: float) -> None:
        why = self._driver.blocked_by or ("the robot does not answer" if self._driver.unresponsive else "")
        if why:
            self._report(f"{word.value}: not done: {why}", "")
        else:
            self._orders.handle(word, now)
            self._sent = -math.inf
            self._report(word.value, "")

    def _move(self, now: float) -> None:
        driver = self._driver
        if driver.blocked_by or driver.unresponsive or not driver.in_control:
            self._orders.cancel()
        command = self._orders.command(self._wanted.within(driver.limits), now)
        if command is None:
            if self._moving:
                driver.halt()
                self._report("stands", "")
        elif now - self._sent >= COMMAND_SECONDS:
            self._sent = now
            driver.drive(command)
        self._moving = command is not None


@click.command(cls=OutputCommand, context_settings={"help_option_names": ["-h", "--help"]})
@driving
@click.option(
    "--wav",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Use a WAV file: 16000 Hz, 16 bits, one channel.",
)
@click.option("--pcm", is_flag=True, help="Use the standard input: raw samples of the same format.")
@click.option("--microphone", metavar="NAME", help="Number or part of the name of the microphone.")
@click.option("--latch", is_flag=True, help="'stop' always stops the robot until it is resumed.")
@click.option(
    "--seconds",
    type=Number(0.3, 5.0),
    default=SECONDS,
    show_default=True,
    help="Duration of a word's motion.",
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

    The default source is the microphone; words are recognised on this computer. Each word moves the robot for a moment.
    'stop' is zero velocity at once; without control it stops the robot until it is resumed.

    The access token is read from SWITCHBOARD_TOKEN. SIGINT and SIGTERM end the program.

    \b
    Examples:
      ROBOT=ws://127.0.0.1:9090/robots/robot-one
      python -m robot_client.apps.voice $ROBOT
      python -m robot_client.apps.voice $ROBOT --wav orders.wav
      arecord -q -t raw -f S16_LE -r 16000 -c 1 | python -m robot_client.apps.voice $ROBOT --pcm
    """
    if (wav is not None) + pcm + (microphone is not None) > 1:
        raise click.UsageError("use only one of --wav, --pcm and --microphone")
    access_token()
    sound = audio.AudioBuffer(_source(wav, pcm, microphone))
    recognition = RecognitionThread(sound, Recognizer())
    exit_signal = ExitSignal()
    status = StatusLine(sys.stdout, time.monotonic)
    program = VoiceControl(
        recognition, WordCommands(seconds), topic, MaximumSpeeds(speed, turn), latch, status.show
    )
    sound.start()
    recognition.start()
    with errors_as_click():
        run_connected(url, program, exit_signal)
    status.finish(sound.error or "ended")


def _source(wav: Path | None, pcm: bool, microphone: str | None) -> Iterator[bytes]:
    if wav is not None:
        return audio.from_file(wav)
    if pcm:
        return audio.from_stream(FileIO(0, closefd=False))
    return audio.from_microphone(microphone)


if __name__ == "__main__":
    main()
