"""Speech: a queue of texts, eSpeak NG to convert them to sound, and outputs of the sound.

Source: eSpeak NG, src/include/espeak-ng/speak_lib.h.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import logging
import shutil
import subprocess
import tempfile
import threading
import wave
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar

from relay_protocol.errors import Invalid, Refused, SwitchboardError, Unavailable
from robot_client.services.health import Level, ServiceFinding

_SYNCHRONOUS = 2
"""The callback is called within ``espeak_Synth``."""
_DONT_EXIT = 0x8000
"""Without it the library ends the process when its data is missing."""
_UTF8 = 1
_END_PAUSE = 0x1000
_RATE, _VOLUME = 1, 2
_CONTINUE, _STOP = 0, 1
"""Return values of the callback."""

_LONGEST_PATH = 140
"""The library has 160 bytes for paths of its data, including file names."""

_Callback = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.POINTER(ctypes.c_short), ctypes.c_int, ctypes.c_void_p)

MISSING = (
    "eSpeak NG is not installed: install 'robot-switchboard[services]', or the system package "
    "(Debian, Ubuntu: apt install libespeak-ng1)"
)


def find() -> tuple[str, str | None]:
    """Paths of the library and its data; ``None`` for the default data path.

    :raises Unavailable: not installed
    """
    try:
        import espeakng_loader
    except ImportError:
        pass
    else:
        return str(espeakng_loader.get_library_path()), str(espeakng_loader.get_data_path())
    system = ctypes.util.find_library("espeak-ng")
    if system is None:
        raise Unavailable(MISSING)
    return system, None


class Espeak:
    """One voice. The library is global, so create only one, and use it in one thread at a time.

    :param voice: its name or a language: ``en``, ``en-us``, ``de``, ``cs`` …
    :param words_per_minute: 80 to 450
    :param volume: 0 to 200; 100 is the default
    :raises Unavailable: the library is missing, or does not start
    :raises Invalid: unknown voice
    :ivar rate: samples per second of the sound
    """

    def __init__(self, voice: str = "en", words_per_minute: int = 160, volume: int = 100) -> None:
        file, data = find()
        try:
            self._library: Any = ctypes.CDLL(file)
        except OSError as error:
            raise Unavailable(f"eSpeak NG can't be loaded: {error}") from None
        self._library.espeak_Synth.argtypes = [
            ctypes.c_char_p,
            ctypes.c_size_t,
            ctypes.c_uint,
            ctypes.c_int,
            ctypes.c_uint,
            ctypes.c_uint,
            ctypes.c_void_p,
            ctypes.c_void_p,
        ]
        self._short: tempfile.TemporaryDirectory[str] | None = None
        if data and len(data.encode()) > _LONGEST_PATH:
            self._short = tempfile.TemporaryDirectory(prefix="speech-")
            link = Path(self._short.name, "espeak-ng-data")
            link.symlink_to(data)
            data = str(link)
        path = data.encode() if data else None
        self.rate: int = self._library.espeak_Initialize(_SYNCHRONOUS, 0, path, _DONT_EXIT)
        if self.rate <= 0:
            raise Unavailable(
                f"eSpeak NG does not start; is its data installed? ({Path(data or '/usr/share')})"
            )
        # Referenced, because the library keeps calling it.
        self._callback = _Callback(self._take)
        self._library.espeak_SetSynthCallback(self._callback)
        if not voice or self._library.espeak_SetVoiceByName(voice.encode()) != 0:
            raise Invalid(f"eSpeak NG has no voice '{voice}'")
        self._library.espeak_SetParameter(_RATE, words_per_minute, 0)
        self._library.espeak_SetParameter(_VOLUME, volume, 0)
        self._parts: list[bytes] = []
        self._left = 0
        self._stopped: Callable[[], bool] = lambda: False

    def sound(self, text: str, longest: float, stopped: Callable[[], bool] = lambda: False) -> bytes:
        """Convert a text to sound: signed 16 bit samples of one channel, in this machine's byte order.

        :param longest: longest sound, seconds
        :param stopped: polled; true ends it
        :raises Unavailable: the library fails
        """
        encoded = text.replace("\0", " ").encode() + b"\0"
        self._parts, self._left, self._stopped = [], round(longest * self.rate), stopped
        failed = self._library.espeak_Synth(encoded, len(encoded), 0, 1, 0, _UTF8 | _END_PAUSE, None, None)
        parts, self._parts = self._parts, []
        if failed:
            raise Unavailable(f"eSpeak NG failed (error {failed})")
        return b"".join(parts)

    def _take(self, samples: Any, count: int, _: Any) -> int:
        if samples and count > 0:
            count = min(count, self._left)
            self._left -= count
            self._parts.append(ctypes.string_at(samples, count * ctypes.sizeof(ctypes.c_short)))
        return _STOP if self._left <= 0 or self._stopped() else _CONTINUE


LONGEST_TEXT = 1000
"""Longest text, characters."""
LONGEST_SOUND = 120.0
"""Longest sound of a text, seconds."""
MAX_WAITING = 10
"""Most waiting texts."""

PLAYERS = ("pw-play", "paplay", "aplay")
"""Programs that play a WAV file: of PipeWire, PulseAudio, ALSA."""

_log = logging.getLogger(__name__)
_Argument = TypeVar("_Argument")


class SpeechSynthesizer(Protocol):
    """Converts text to sound; :class:`~robot_client.services.speech.Espeak`."""

    @property
    def rate(self) -> int:
        """Samples per second."""

    def sound(self, text: str, longest: float, stopped: Callable[[], bool]) -> bytes:
        """Signed 16 bit samples of one channel.

        :raises SwitchboardError: it fails
        """


class Output(Protocol):
    """An output of sound."""

    def play(self, sound: bytes, rate: int, stopped: threading.Event) -> None:
        """Play, and return at the end or when ``stopped`` is set.

        :raises Unavailable: it fails
        """

    def close(self) -> None:
        """Close the output."""


class WavFile:
    """Appends all sound to one file, which is valid at any time.

    :param path: overwritten
    :param rate: samples per second
    :raises Unavailable: it can't be written
    """

    def __init__(self, path: Path, rate: int) -> None:
        try:
            # Unbuffered, so that the file is complete.
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
    """Plays sound by a program of this machine.

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
        # A blocked sound device would block the player for ever.
        waited, most = 0.0, 2 * seconds + 10
        while True:
            try:
                _, errors = process.communicate(timeout=0.1)
                break
            except subprocess.TimeoutExpired:
                waited += 0.1
                if stopped.is_set() or waited > most:
                    process.kill()
        if process.returncode and not stopped.is_set():
            lines = errors.decode(errors="replace").strip().splitlines()
            why = lines[-1][:200] if lines else f"it ended with {process.returncode}"
            raise Unavailable(f"{name} could not play it: {why}")

    def close(self) -> None:
        """See :class:`Output`."""


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
    """Progress of the speech.

    :ivar speaking: whether a text is being spoken
    :ivar completed: the text that was spoken completely
    """

    speaking: bool
    completed: str | None = None


class SpeechQueue:
    """Speaks one text after the other, in a thread of its own.

    Failures are reported by :meth:`finding`, unexpected ones are logged with a traceback; the next text is spoken.

    :param report: called in that thread
    """

    def __init__(
        self, voice: SpeechSynthesizer, output: Output, report: Callable[[SpeechStatus], None]
    ) -> None:
        self._voice = voice
        self._output = output
        self._report = report
        self._texts: deque[str] = deque()
        self._changed = threading.Condition()
        """Guards the attributes below."""
        self._cancelled = threading.Event()
        self._ending = False
        self._speaking = False
        self._problem = ""
        self._refused = 0
        self._thread = threading.Thread(target=self._run, name="speech", daemon=True)
        self._thread.start()

    def add(self, text: str) -> None:
        """Queue a text.

        :raises Refused: it is too long, or too many are waiting
        """
        words = " ".join(text.split())
        with self._changed:
            if len(words) > LONGEST_TEXT:
                self._refused += 1
                raise Refused(
                    f"a text of {len(words)} characters is too long; at most {LONGEST_TEXT} are spoken"
                )
            if len(self._texts) >= MAX_WAITING:
                self._refused += 1
                raise Refused(f"{MAX_WAITING} texts are waiting; this one is dropped")
            if words:
                self._texts.append(words)
                self._changed.notify()

    def cancel(self) -> int:
        """Stop speaking, and drop the waiting texts.

        :returns: number of texts that were not spoken completely
        """
        with self._changed:
            cancelled = len(self._texts) + self._speaking
            self._texts.clear()
            self._cancelled.set()
        return cancelled

    def finding(self) -> ServiceFinding:
        """State of the speech."""
        with self._changed:
            values = {"waiting": str(len(self._texts)), "refused": str(self._refused)}
            if self._problem:
                return ServiceFinding(Level.ERROR, self._problem, values)
            return ServiceFinding(Level.OK, "speaking" if self._speaking else "silent", values)

    def close(self) -> None:
        """Stop speaking, and end the thread."""
        self.cancel()
        with self._changed:
            self._ending = True
            self._changed.notify()
        self._thread.join(5.0)
        self._output.close()

    def _run(self) -> None:
        while (text := self._next()) is not None:
            report_failure = self._report_status(SpeechStatus(speaking=True))
            problem = "the text was not spoken completely"
            try:
                problem = _failure_of("speaking a text", self._speak, text)
            finally:
                with self._changed:
                    self._speaking = False
                    self._problem = problem or report_failure
                    completed = not problem and not self._cancelled.is_set()
            status = SpeechStatus(speaking=False, completed=text if completed else None)
            report_failure = self._report_status(status)
            if report_failure:
                with self._changed:
                    self._problem = self._problem or report_failure

    def _next(self) -> str | None:
        with self._changed:
            while not self._texts:
                if self._ending:
                    return None
                self._changed.wait()
            self._cancelled.clear()
            self._speaking = True
            return self._texts.popleft()

    def _report_status(self, status: SpeechStatus) -> str:
        """:returns: why it failed; empty when it worked"""
        return _failure_of("reporting speech", self._report, status)

    def _speak(self, text: str) -> None:
        sound = self._voice.sound(text, LONGEST_SOUND, self._cancelled.is_set)
        if not self._cancelled.is_set():
            self._output.play(sound, self._voice.rate, self._cancelled)


def _failure_of(what: str, action: Callable[[_Argument], None], argument: _Argument) -> str:
    """Run an action.

    :param what: its name, for the log
    :returns: why it failed; empty when it worked
    """
    try:
        action(argument)
    except SwitchboardError as error:
        return str(error)
    except Exception as error:  # no voice, output or callback may end the thread
        _log.exception("%s failed", what)
        return f"{what} failed: {type(error).__name__}: {error}"
    return ""
