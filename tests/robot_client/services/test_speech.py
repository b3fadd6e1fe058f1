"""Speech, one text after the other."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import threading
import wave
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

from relay_protocol.errors import Refused, Unavailable
from robot_client.services import speech
from robot_client.services.health import Level
from robot_client.services.speech import LONGEST_TEXT, MAX_WAITING, Player, SpeechQueue, SpeechStatus, WavFile
from tests.worlds.waiting import wait_for

FULL = Path("/dev/full")
"""Takes nothing: Linux says that the disk is full."""


def alone(code: str, *asked: object) -> str:
    """Output of code with a voice in a process of its own, as the library is global. :param request: for the code,
    in ``asked``"""
    before = "import json, sys\nfrom robot_client.services import speech\nasked = json.loads(sys.argv[1])\n"
    words = [sys.executable, "-c", before + code, json.dumps(asked)]
    return subprocess.run(words, capture_output=True, text=True, timeout=60, check=True).stdout.strip()


class Measured(NamedTuple):
    """Length and largest sample of a sound."""

    seconds: float
    loudest: int


def spoken(*asked: tuple[str, float, bool]) -> list[Measured]:
    """The sounds of texts, one after the other. :param request: the text, the most seconds, and whether it is
    stopped at once"""
    code = """
import array
voice = speech.Espeak("en")
for text, longest, enough in asked:
    samples = array.array("h", voice.sound(text, longest, lambda: enough))
    print(json.dumps([len(samples) / voice.rate, max(map(abs, samples), default=0)]))
"""
    return [Measured(*json.loads(line)) for line in alone(code, *asked).splitlines()]


class Letters:
    """A voice with one sample for each letter."""

    rate = 1000

    def sound(self, text: str, longest: float, stopped: Callable[[], bool]) -> bytes:
        if text == "broken":
            raise Unavailable("the voice is broken")
        if text == "odd":
            raise ValueError("what nobody foresaw")
        return text.encode()


class RecordingOutput:
    """Records sounds; each ends when a test lets it."""

    def __init__(self) -> None:
        self.heard: list[str] = []
        self.now = 0
        self.most = 0
        self.closed = False
        self.go = threading.Semaphore(0)

    def play(self, sound: bytes, rate: int, stopped: threading.Event) -> None:
        self.now += 1
        self.most = max(self.most, self.now)
        self.heard.append(sound.decode())
        while not stopped.is_set() and not self.go.acquire(timeout=0.01):
            pass
        self.now -= 1

    def close(self) -> None:
        self.closed = True


def test_espeak_makes_sound() -> None:
    """Not silent, and about proportional to the text."""
    texts = ("one", "one two three four five six seven eight", "one")
    short, long, again = spoken(*((text, 60, False) for text in texts))
    assert short.loudest > 3000 and long.loudest > 3000
    assert 0.2 < short.seconds < 2
    assert 3 < long.seconds / short.seconds < 10
    assert again.seconds == pytest.approx(short.seconds, rel=0.02)  # the voice has some noise of its own


def test_too_long_sound_is_cut() -> None:
    text = "word " * 100
    cut, ended, after = spoken((text, 1.5, False), (text, 60, True), ("one", 60, False))
    assert cut.seconds == pytest.approx(1.5)
    assert ended.seconds < 5
    assert after.seconds > 0.2


def test_unusual_texts_are_no_instructions() -> None:
    odd = ("a\0b", "<voice name='x'>hi</voice>", "[[h@'loU]]", "příliš žluťoučký", "🤖", "")
    *said, last = spoken(*((text, 60, False) for text in (*odd, "<break time='20s'/> hi")))
    assert len(said) == len(odd)
    assert last.seconds < 10


def test_data_with_a_long_path_are_found(tmp_path: Path) -> None:
    library, data = speech.find()
    assert data is not None
    far = tmp_path / ("x" * 100) / ("y" * 100)
    far.mkdir(parents=True)
    (far / "data").symlink_to(data)
    code = "speech.find = lambda: asked\nprint(len(speech.Espeak('en').sound('hello', 10)))"
    assert int(alone(code, library, str(far / "data"))) > 5000


def test_an_unknown_voice_is_refused() -> None:
    code = "try:\n speech.Espeak('klingon-x')\nexcept speech.Invalid as error:\n print(error)"
    assert alone(code) == "eSpeak NG has no voice 'klingon-x'"


def test_missing_library_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "espeakng_loader", None)
    monkeypatch.setattr("ctypes.util.find_library", lambda _: None)
    with pytest.raises(Unavailable, match="apt install libespeak-ng1"):
        speech.find()


def test_texts_are_spoken_in_order() -> None:
    """One at a time."""
    ear, reported = RecordingOutput(), list[SpeechStatus]()
    speaker = SpeechQueue(Letters(), ear, reported.append)
    for text in ("one", "two", "three"):
        speaker.add(text)
    for count in (1, 2, 3):
        wait_for("the next", lambda count=count: len(ear.heard) == count)
        ear.go.release()
    wait_for("the end", lambda: len(reported) == 6)
    speaker.close()
    assert (ear.heard, ear.most, ear.closed) == (["one", "two", "three"], 1, True)
    assert reported == [
        each for text in ear.heard for each in (SpeechStatus(True), SpeechStatus(False, text))
    ]


def test_too_many_and_too_long_texts_are_refused() -> None:
    ear = RecordingOutput()
    speaker = SpeechQueue(Letters(), ear, lambda _: None)
    speaker.add("first")
    wait_for("it speaks", lambda: ear.heard)
    for _ in range(MAX_WAITING):
        speaker.add("next")
    with pytest.raises(Refused, match="10 texts are waiting"):
        speaker.add("one more")
    speaker.cancel()
    with pytest.raises(Refused, match="too long"):
        speaker.add("x" * (LONGEST_TEXT + 1))
    speaker.add(" \n ")
    assert speaker.finding().values == {"waiting": "0", "refused": "2"}
    speaker.close()


def test_cancel_stops_speech_and_later_texts_are_spoken() -> None:
    ear, reported = RecordingOutput(), list[SpeechStatus]()
    speaker = SpeechQueue(Letters(), ear, reported.append)
    speaker.add("one")
    speaker.add("two")
    wait_for("it speaks", lambda: ear.heard)
    assert speaker.cancel() == 2
    speaker.add("three")
    wait_for("the next", lambda: ear.heard == ["one", "three"])
    ear.go.release()
    wait_for("the end", lambda: SpeechStatus(False, "three") in reported)
    speaker.close()
    assert SpeechStatus(False, "one") not in reported and SpeechStatus(False, "two") not in reported


def test_failure_is_reported_until_a_text_is_spoken() -> None:
    ear, reported = RecordingOutput(), list[SpeechStatus]()
    speaker = SpeechQueue(Letters(), ear, reported.append)
    speaker.add("broken")
    wait_for("the failure", lambda: speaker.finding().level is Level.ERROR)
    assert speaker.finding().message == "the voice is broken"
    ear.go.release()
    speaker.add("fine")
    wait_for("the end", lambda: SpeechStatus(False, "fine") in reported)
    assert speaker.finding().level is Level.OK
    speaker.close()


def test_unexpected_error_is_logged_and_the_next_text_is_spoken(caplog: pytest.LogCaptureFixture) -> None:
    ear, reported = RecordingOutput(), list[SpeechStatus]()
    speaker = SpeechQueue(Letters(), ear, reported.append)
    speaker.add("odd")
    wait_for("the failure", lambda: speaker.finding().level is Level.ERROR)
    assert speaker.finding().message == "speaking a text failed: ValueError: what nobody foresaw"
    assert "speaking a text failed" in caplog.text and "Traceback" in caplog.text
    wait_for("its end is told", lambda: reported == [SpeechStatus(True), SpeechStatus(False)])
    assert speaker.cancel() == 0
    ear.go.release()
    speaker.add("fine")
    wait_for("the end", lambda: SpeechStatus(False, "fine") in reported)
    assert speaker.finding() == (Level.OK, "silent", {"waiting": "0", "refused": "0"})
    speaker.close()


@pytest.mark.parametrize("deaf", [SpeechStatus(True), SpeechStatus(False, "one")])
def test_failure_to_report_does_not_stop_the_speech(
    deaf: SpeechStatus, caplog: pytest.LogCaptureFixture
) -> None:
    ear, reported = RecordingOutput(), list[SpeechStatus]()

    def tell(what: SpeechStatus) -> None:
        reported.append(what)
        if what == deaf and len(reported) <= 2:
            raise RuntimeError("nobody listens")

    speaker = SpeechQueue(Letters(), ear, tell)
    speaker.add("one")
    ear.go.release()
    wait_for("the failure", lambda: speaker.finding().level is Level.ERROR)
    assert speaker.finding().message == "reporting speech failed: RuntimeError: nobody listens"
    assert "reporting speech failed" in caplog.text
    wait_for("the end", lambda: len(reported) == 2)
    speaker.add("two")
    ear.go.release()
    wait_for("the next", lambda: reported[2:] == [SpeechStatus(True), SpeechStatus(False, "two")])
    assert (ear.heard, speaker.finding().level) == (["one", "two"], Level.OK)
    speaker.close()


def test_full_disk_is_reported_and_does_not_stop_the_speech(monkeypatch: pytest.MonkeyPatch) -> None:
    full(monkeypatch)
    reported: list[SpeechStatus] = []
    speaker = SpeechQueue(Letters(), player("pass"), reported.append)
    for count in (1, 2):
        speaker.add("one")
        wait_for("its end", lambda count=count: reported == [SpeechStatus(True), SpeechStatus(False)] * count)
        found = speaker.finding()
        assert (found.level, "No space left on device" in found.message) == (Level.ERROR, True)
        assert speaker.cancel() == 0
    speaker.close()


def test_wav_file_is_valid_at_any_time(tmp_path: Path) -> None:
    path = tmp_path / "said.wav"
    file = WavFile(path, 1000)
    for count in (1, 2):
        file.play(b"\1\0" * 500, 1000, threading.Event())
        with wave.open(str(path)) as read:
            assert (read.getnframes(), read.getframerate(), read.getnchannels()) == (500 * count, 1000, 1)
    file.close()
    with wave.open(str(path)) as read:
        assert read.readframes(1000) == b"\1\0" * 1000


def test_unwritable_file_is_reported(tmp_path: Path) -> None:
    with pytest.raises(Unavailable, match="No such file"):
        WavFile(tmp_path / "no" / "said.wav", 1000)


def player(code: str) -> Player:
    return Player([sys.executable, "-S", "-c", code])


def test_player_gets_a_wav_file(tmp_path: Path) -> None:
    copy = tmp_path / "copy.wav"
    code = f"import shutil, sys; shutil.copy(sys.argv[-1], {str(copy)!r})"
    player(code).play(b"\1\0" * 500, 1000, threading.Event())
    with wave.open(str(copy)) as read:
        assert read.readframes(1000) == b"\1\0" * 500


def test_failing_player_is_reported_with_its_last_line() -> None:
    with pytest.raises(Unavailable, match="could not play it: no device"):
        player("import sys; sys.exit('no device')").play(b"\0\0", 1000, threading.Event())
    with pytest.raises(Unavailable, match="No such file"):
        Player(["/nowhere/play"]).play(b"\0\0", 1000, threading.Event())


def full(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave no room for temporary files."""
    monkeypatch.setattr(tempfile, "NamedTemporaryFile", lambda **_: FULL.open("w+b"))


def test_sound_that_can_not_be_written_for_the_player_is_reported(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with monkeypatch.context() as patched:
        patched.setattr(tempfile, "tempdir", str(tmp_path / "gone"))
        with pytest.raises(Unavailable, match="can't be written to be played: No such file"):
            player("pass").play(b"\0\0", 1000, threading.Event())
    full(monkeypatch)
    for samples in (1, 1_000_000):
        with pytest.raises(Unavailable, match="can't be written to be played: No space left"):
            player("pass").play(b"\0\0" * samples, 1000, threading.Event())


def test_player_is_killed_on_cancel() -> None:
    stopped = threading.Event()
    playing = player("import time; time.sleep(600)")
    thread = threading.Thread(target=playing.play, args=(b"\0\0" * 1_000_000, 1000, stopped))
    thread.start()
    stopped.set()
    thread.join(60)
    assert not thread.is_alive()


def test_missing_player_is_reported() -> None:
    assert speech.player(lambda name: "/usr/bin/aplay" if name == "aplay" else None)._command == [
        "aplay",
        "-q",
    ]
    with pytest.raises(Unavailable, match="--out writes a WAV file instead"):
        speech.player(lambda _: None)
