"""One text after the other, spoken. The voice and where it goes to are handed in."""

from __future__ import annotations

import logging
import shutil
import subprocess
import tempfile
import threading
import wave
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, Protocol, TypeVar

from relay_protocol.errors import Refused, SwitchboardError, Unavailable
from robot_client.services.health import Level, ServiceFinding

LONGEST_TEXT = 1000
"""Characters of one text."""
LONGEST_SOUND = 120.0
"""Seconds of one text."""
WAITING = 10
"""Texts that may wait."""

PLAYERS = ("pw-play", "paplay", "aplay")
"""Programs that play a WAV file: of PipeWire, PulseAudio, ALSA."""

_log = logging.getLogger(__name__)
_Given = TypeVar("_Given")


class SpeechSynthesizer(Protocol):
    """Makes sound of words; :class:`~robot_client.services.espeak.Espeak` is one."""

    @property
    def rate(self) -> int:
        """Samples per second."""

    def sound(self, text: str, longest: float, stopped: Callable[[], bool]) -> bytes:
        """Signed 16 bit samples of one channel.

        :raises SwitchboardError: it can't
        """


class Output(Protocol):
    """Where sound goes to."""

    def play(self, sound: bytes, rate: int, stopped: threading.Event) -> None:
        """Return when it has been heard, or ``stopped`` is set.

        :raises Unavailable: it can't be played
        """

    def close(self) -> None:
        """There is no more."""


class WavFile:
    """Everything in one file, one after the other; it can be played at any time.

    :param path: written anew
    :param rate: samples per second
    :raises Unavailable: it can't be written
    """

    def __init__(self, path: Path, rate: int) -> None:
        try:
            # The file itself is unbuffered, so that what was said is in it.
            self._file = path.open("wb", buffering=0)
        except OSError as error:
            raise Unavailable(f"{path}: {error.strerror}") from None
        self._wave = wave.open(self._file, "wb")  # noqa: SIM115  # closed by close
        _describe(self._wave, rate)
        self._wave.writeframes(b"")

    def play(self, sound: bytes, rate: int, stopped: threading.Event) -> None:
        """See :class:`Output`."""
        try:
            self._wave.writeframes(sound)
        except OSError as error:
            raise Unavailable(f"the sound can't be written: {error.strerror}") from None

    def close(self) -> None:
        """See :class:`Output`."""
        self._wave.close()
        self._file.close()


class Player:
    """A program that plays WAV files on this machine's sound device.

    :param command: the program, with its arguments; the file's path comes last
    """

    def __init__(self, command: list[str]) -> None:
        self._command = command

    def play(self, sound: bytes, rate: int, stopped: threading.Event) -> None:
        """See :class:`Output`."""
        try:
            with tempfile.NamedTemporaryFile(prefix="speech-", suffix=".wav") as file:
                with wave.open(file, "wb") as written:
                    _describe(written, rate)
                    written.writeframes(sound)
                file.flush()
                self._run([*self._command, file.name], len(sound) / 2 / rate, stopped)
        except OSError as error:
            raise Unavailable(f"the sound can't be written to be played: {error.strerror or error}") from None

    def _run(self, command: list[str], seconds: float, stopped: threading.Event) -> None:
        name = command[0]
        try:
            process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
            )
        except OSError as error:
            raise Unavailable(f"{name}: {error.strerror}") from None
        # A device that takes nothing would be waited for for ever.
        waited, most = 0.0, 2 * seconds + 10
        while True:
            try:
                _, said = process.communicate(timeout=0.1)
                break
            except subprocess.TimeoutExpired:
                waited += 0.1
                if stopped.is_set() or waited > most:
                    process.kill()
        if process.returncode and not stopped.is_set():
            words = said.decode(errors="replace").strip().splitlines()
            why = words[-1][:200] if words else f"it ended with {process.returncode}"
            raise Unavailable(f"{name} could not play it: {why}")

    def close(self) -> None:
        """Nothing is left to do."""


def _describe(file: wave.Wave_write, rate: int) -> None:
    file.setnchannels(1)
    file.setsampwidth(2)
    file.setframerate(rate)


def player(which: Callable[[str], str | None] = shutil.which) -> Player:
    """The first of :data:`PLAYERS` that is installed.

    :raises Unavailable: none is
    """
    for name in PLAYERS:
        if which(name):
            return Player([name, "-q"] if name == "aplay" else [name])
    raise Unavailable(
        f"no program that plays sound is installed ({', '.join(PLAYERS)}; Debian, Ubuntu: apt install alsa-utils); "
        "--out writes a WAV file instead"
    )


class SpeechStatus(NamedTuple):
    """What becomes of a text.

    :ivar speaking: whether anything is being said now
    :ivar said: the text that has been said to its end
    """

    speaking: bool
    said: str | None = None


class SpeechQueue:
    """Says texts in their order, in a thread of its own; never two at a time.

    Whatever fails is told by :meth:`finding`, and what was not foreseen is logged with its traceback; the next text
    is said all the same.

    :param tell: called in that thread
    """

    def __init__(
        self, voice: SpeechSynthesizer, output: Output, tell: Callable[[SpeechStatus], None]
    ) -> None:
        self._voice = voice
        self._output = output
        self._tell = tell
        self._texts: deque[str] = deque()
        self._changed = threading.Condition()
        """Of all that follows."""
        self._hush = threading.Event()
        self._ending = False
        self._speaking = False
        self._trouble = ""
        self._refused = 0
        self._thread = threading.Thread(target=self._run, name="speech", daemon=True)
        self._thread.start()

    def say(self, text: str) -> None:
        """Say it when it is its turn.

        :raises Refused: it is too long, or too many wait
        """
        words = " ".join(text.split())
        with self._changed:
            if len(words) > LONGEST_TEXT:
                self._refused += 1
                raise Refused(f"a text of {len(words)} characters is too long; {LONGEST_TEXT} are the most")
            if len(self._texts) >= WAITING:
                self._refused += 1
                raise Refused(f"{WAITING} texts wait already; this one is not said")
            if words:
                self._texts.append(words)
                self._changed.notify()

    def hush(self) -> int:
        """Be silent at once, and forget what waits.

        :returns: how many texts are not said, or not to their end
        """
        with self._changed:
            forgotten = len(self._texts) + self._speaking
            self._texts.clear()
            self._hush.set()
        return forgotten

    def finding(self) -> ServiceFinding:
        """How it is."""
        with self._changed:
            values = {"waiting": str(len(self._texts)), "refused": str(self._refused)}
            if self._trouble:
                return ServiceFinding(Level.ERROR, self._trouble, values)
            return ServiceFinding(Level.OK, "speaking" if self._speaking else "silent", values)

    def close(self) -> None:
        """Be silent for good."""
        self.hush()
        with self._changed:
            self._ending = True
            self._changed.notify()
        self._thread.join(5.0)
        self._output.close()

    def _run(self) -> None:
        while (text := self._next()) is not None:
            untold = self._told(SpeechStatus(speaking=True))
            trouble = "the text was not said to its end"
            try:
                trouble = _tried("saying a text", self._say, text)
            finally:
                with self._changed:
                    self._speaking = False
                    self._trouble = trouble or untold
                    said = not trouble and not self._hush.is_set()
            untold = self._told(SpeechStatus(speaking=False, said=text if said else None))
            if untold:
                with self._changed:
                    self._trouble = self._trouble or untold

    def _next(self) -> str | None:
        with self._changed:
            while not self._texts:
                if self._ending:
                    return None
                self._changed.wait()
            self._hush.clear()
            self._speaking = True
            return self._texts.popleft()

    def _told(self, told: SpeechStatus) -> str:
        """:returns: why it could not be told"""
        return _tried("telling what is said", self._tell, told)

    def _say(self, text: str) -> None:
        sound = self._voice.sound(text, LONGEST_SOUND, self._hush.is_set)
        if not self._hush.is_set():
            self._output.play(sound, self._voice.rate, self._hush)


def _tried(what: str, action: Callable[[_Given], None], given: _Given) -> str:
    """:returns: why it could not be done; empty when it was"""
    try:
        action(given)
    except SwitchboardError as error:
        return str(error)
    except Exception as error:  # of a voice, an output or a listener: none of them may end the thread
        _log.exception("%s failed", what)
        return f"{what} failed: {type(error).__name__}: {error}"
    return ""
