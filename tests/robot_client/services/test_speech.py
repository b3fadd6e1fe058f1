"""Texts that are said one after the other."""

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
from switchboard_waiting import wait_for

from relay_protocol.errors import Refused, Unavailable
from robot_client.services import espeak, speech
from robot_client.services.health import Level
from robot_client.services.speech import LONGEST_TEXT, WAITING, Player, SpeechQueue, SpeechStatus, WavFile

FULL = Path("/dev/full")
"""Takes nothing: Linux says that the disk is full."""


def alone(code: str, *asked: object) -> str:
    """What code with a voice prints in a process of its own: the library bears only one, and others here use it too.

    :param asked: for the code, in ``asked``
    """
    before = "import json, sys\nfrom robot_client.services import espeak\nasked = json.loads(sys.argv[1])\n"
    words = [sys.executable, "-c", before + code, json.dumps(asked)]
    return subprocess.run(words, capture_output=True, text=True, timeout=60, check=True).stdout.strip()


class Heard(NamedTuple):
    """Of a sound: how long, and its largest sample."""

    seconds: float
    loudest: int


def spoken(*asked: tuple[str, float, bool]) -> list[Heard]:
    """What comes of texts, one after the other.

    :param asked: the text, the most seconds, and whether somebody has had enough at once
    """
    code = """
import array
voice = espeak.Espeak("en")
for text, longest, enough in asked:
    samples = array.array("h", voice.sound(text, longest, lambda: enough))
    print(json.dumps([len(samples) / voice.rate, max(map(abs, samples), default=0)]))
"""
    return [Heard(*json.loads(line)) for line in alone(code, *asked).splitlines()]


class Letters:
    """A voice that says a sample for each letter."""

    rate = 1000

    def sound(self, text: str, longest: float, stopped: Callable[[], bool]) -> bytes:
        if text == "broken":
            raise Unavailable("the voice is broken")
        if text == "odd":
            raise ValueError("what nobody foresaw")
        return text.encode()


class Ear:
    """Hears; each text until it is let go."""

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


def test_espeak_makes_sound_of_words() -> None:
    """It is not silent, a longer text takes longer, about in proportion, and the same text as long as before."""
    texts = ("one", "one two three four five six seven eight", "one")
    short, long, again = spoken(*((text, 60, False) for text in texts))
    assert short.loudest > 3000 and long.loudest > 3000
    assert 0.2 < short.seconds < 2
    assert 3 < long.seconds / short.seconds < 10
    assert again.seconds == pytest.approx(short.seconds, rel=0.02)  # the voice has some noise of its own


def test_a_sound_that_is_too_long_is_cut() -> None:
    """At the second that was given, and when somebody has had enough; the next is whole."""
    text = "word " * 100
    cut, ended, after = spoken((text, 1.5, False), (text, 60, True), ("one", 60, False))
    assert cut.seconds == pytest.approx(1.5)
    assert ended.seconds < 5
    assert after.seconds > 0.2


def test_odd_texts_are_said_or_passed_over() -> None:
    """Zeros, signs, other alphabets, markup: nothing of it is an instruction to the voice."""
    odd = ("a\0b", "<voice name='x'>hi</voice>", "[[h@'loU]]", "příliš žluťoučký", "🤖", "")
    *said, last = spoken(*((text, 60, False) for text in (*odd, "<break time='20s'/> hi")))
    assert len(said) == len(odd)
    assert last.seconds < 10


def test_data_with_a_long_path_are_found(tmp_path: Path) -> None:
    """The library itself has no room for it."""
    library, data = espeak.find()
    assert data is not None
    far = tmp_path / ("x" * 100) / ("y" * 100)
    far.mkdir(parents=True)
    (far / "data").symlink_to(data)
    code = "espeak.find = lambda: asked\nprint(len(espeak.Espeak('en').sound('hello', 10)))"
    assert int(alone(code, library, str(far / "data"))) > 5000


def test_an_unknown_voice_is_refused() -> None:
    """In words."""
    code = "try:\n espeak.Espeak('klingon-x')\nexcept espeak.Invalid as error:\n print(error)"
    assert alone(code) == "eSpeak NG has no voice 'klingon-x'"


def test_without_the_library_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither the package nor the system has it."""
    monkeypatch.setitem(sys.modules, "espeakng_loader", None)
    monkeypatch.setattr("ctypes.util.find_library", lambda _: None)
    with pytest.raises(Unavailable, match="apt install libespeak-ng1"):
        espeak.find()


def test_texts_are_said_in_order_and_never_two_at_a_time() -> None:
    """Each begins when the last was heard, and all is told."""
    ear, told = Ear(), list[SpeechStatus]()
    speaker = SpeechQueue(Letters(), ear, told.append)
    for text in ("one", "two", "three"):
        speaker.say(text)
    for count in (1, 2, 3):
        wait_for("the next", lambda count=count: len(ear.heard) == count)
        ear.go.release()
    wait_for("the end", lambda: len(told) == 6)
    speaker.close()
    assert (ear.heard, ear.most, ear.closed) == (["one", "two", "three"], 1, True)
    assert told == [each for text in ear.heard for each in (SpeechStatus(True), SpeechStatus(False, text))]


def test_what_is_too_much_is_refused_in_words() -> None:
    """More texts than may wait, and texts that are too long; nothing at all is nothing."""
    ear = Ear()
    speaker = SpeechQueue(Letters(), ear, lambda _: None)
    speaker.say("first")
    wait_for("it speaks", lambda: ear.heard)
    for _ in range(WAITING):
        speaker.say("next")
    with pytest.raises(Refused, match="10 texts wait already"):
        speaker.say("one more")
    speaker.hush()
    with pytest.raises(Refused, match="too long"):
        speaker.say("x" * (LONGEST_TEXT + 1))
    speaker.say(" \n ")
    assert speaker.finding().values == {"waiting": "0", "refused": "2"}
    speaker.close()


def test_hush_silences_it_and_what_comes_after_is_said() -> None:
    """What was being said is not told as said."""
    ear, told = Ear(), list[SpeechStatus]()
    speaker = SpeechQueue(Letters(), ear, told.append)
    speaker.say("one")
    speaker.say("two")
    wait_for("it speaks", lambda: ear.heard)
    assert speaker.hush() == 2
    speaker.say("three")
    wait_for("the next", lambda: ear.heard == ["one", "three"])
    ear.go.release()
    wait_for("the end", lambda: SpeechStatus(False, "three") in told)
    speaker.close()
    assert SpeechStatus(False, "one") not in told and SpeechStatus(False, "two") not in told


def test_a_failure_is_an_error_until_something_is_said() -> None:
    """The next text is said all the same."""
    ear, told = Ear(), list[SpeechStatus]()
    speaker = SpeechQueue(Letters(), ear, told.append)
    speaker.say("broken")
    wait_for("the failure", lambda: speaker.finding().level is Level.ERROR)
    assert speaker.finding().message == "the voice is broken"
    ear.go.release()
    speaker.say("fine")
    wait_for("the end", lambda: SpeechStatus(False, "fine") in told)
    assert speaker.finding().level is Level.OK
    speaker.close()


def test_an_unforeseen_failure_is_logged_and_the_next_text_is_said(caplog: pytest.LogCaptureFixture) -> None:
    """It is an error in words, and the thread goes on: nothing is said for ever."""
    ear, told = Ear(), list[SpeechStatus]()
    speaker = SpeechQueue(Letters(), ear, told.append)
    speaker.say("odd")
    wait_for("the failure", lambda: speaker.finding().level is Level.ERROR)
    assert speaker.finding().message == "saying a text failed: ValueError: what nobody foresaw"
    assert "saying a text failed" in caplog.text and "Traceback" in caplog.text
    wait_for("its end is told", lambda: told == [SpeechStatus(True), SpeechStatus(False)])
    assert speaker.hush() == 0
    ear.go.release()
    speaker.say("fine")
    wait_for("the end", lambda: SpeechStatus(False, "fine") in told)
    assert speaker.finding() == (Level.OK, "silent", {"waiting": "0", "refused": "0"})
    speaker.close()


@pytest.mark.parametrize("deaf", [SpeechStatus(True), SpeechStatus(False, "one")])
def test_who_cannot_be_told_silences_nothing(deaf: SpeechStatus, caplog: pytest.LogCaptureFixture) -> None:
    """The text is said, the failure is an error in words, and the next text is said and told."""
    ear, told = Ear(), list[SpeechStatus]()

    def tell(what: SpeechStatus) -> None:
        told.append(what)
        if what == deaf and len(told) <= 2:
            raise RuntimeError("nobody listens")

    speaker = SpeechQueue(Letters(), ear, tell)
    speaker.say("one")
    ear.go.release()
    wait_for("the failure", lambda: speaker.finding().level is Level.ERROR)
    assert speaker.finding().message == "telling what is said failed: RuntimeError: nobody listens"
    assert "telling what is said failed" in caplog.text
    wait_for("the end", lambda: len(told) == 2)
    speaker.say("two")
    ear.go.release()
    wait_for("the next", lambda: told[2:] == [SpeechStatus(True), SpeechStatus(False, "two")])
    assert (ear.heard, speaker.finding().level) == (["one", "two"], Level.OK)
    speaker.close()


def test_a_full_disk_is_an_error_and_ends_no_speech(monkeypatch: pytest.MonkeyPatch) -> None:
    """What can't be written is told as not said, in words, each time."""
    full(monkeypatch)
    told: list[SpeechStatus] = []
    speaker = SpeechQueue(Letters(), player("pass"), told.append)
    for count in (1, 2):
        speaker.say("one")
        wait_for("its end", lambda count=count: told == [SpeechStatus(True), SpeechStatus(False)] * count)
        found = speaker.finding()
        assert (found.level, "No space left on device" in found.message) == (Level.ERROR, True)
        assert speaker.hush() == 0
    speaker.close()


def test_a_file_has_all_that_was_said_at_any_time(tmp_path: Path) -> None:
    """Also before it is closed it can be played."""
    path = tmp_path / "said.wav"
    file = WavFile(path, 1000)
    for count in (1, 2):
        file.play(b"\1\0" * 500, 1000, threading.Event())
        with wave.open(str(path)) as read:
            assert (read.getnframes(), read.getframerate(), read.getnchannels()) == (500 * count, 1000, 1)
    file.close()
    with wave.open(str(path)) as read:
        assert read.readframes(1000) == b"\1\0" * 1000


def test_a_file_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    """In words."""
    with pytest.raises(Unavailable, match="No such file"):
        WavFile(tmp_path / "no" / "said.wav", 1000)


def player(code: str) -> Player:
    return Player([sys.executable, "-S", "-c", code])


def test_a_player_gets_a_whole_wav_file(tmp_path: Path) -> None:
    """Its path comes last, and it may take its time."""
    copy = tmp_path / "copy.wav"
    code = f"import shutil, sys; shutil.copy(sys.argv[-1], {str(copy)!r})"
    player(code).play(b"\1\0" * 500, 1000, threading.Event())
    with wave.open(str(copy)) as read:
        assert read.readframes(1000) == b"\1\0" * 500


def test_a_player_that_fails_is_told_in_its_own_words() -> None:
    """The last line it said; and one that isn't there."""
    with pytest.raises(Unavailable, match="could not play it: no device"):
        player("import sys; sys.exit('no device')").play(b"\0\0", 1000, threading.Event())
    with pytest.raises(Unavailable, match="No such file"):
        Player(["/nowhere/play"]).play(b"\0\0", 1000, threading.Event())


def full(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let there be no room for files that are made for a while."""
    monkeypatch.setattr(tempfile, "NamedTemporaryFile", lambda **_: FULL.open("w+b"))


def test_a_sound_that_cannot_be_written_for_the_player_is_told(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Where there is no folder for it, and no room, be it a short sound or a long one."""
    with monkeypatch.context() as patched:
        patched.setattr(tempfile, "tempdir", str(tmp_path / "gone"))
        with pytest.raises(Unavailable, match="can't be written to be played: No such file"):
            player("pass").play(b"\0\0", 1000, threading.Event())
    full(monkeypatch)
    for samples in (1, 1_000_000):
        with pytest.raises(Unavailable, match="can't be written to be played: No space left"):
            player("pass").play(b"\0\0" * samples, 1000, threading.Event())


def test_a_player_is_ended_when_it_is_to_be_silent() -> None:
    """At once, however long the sound."""
    stopped = threading.Event()
    playing = player("import time; time.sleep(600)")
    thread = threading.Thread(target=playing.play, args=(b"\0\0" * 1_000_000, 1000, stopped))
    thread.start()
    stopped.set()
    thread.join(60)
    assert not thread.is_alive()


def test_without_a_player_it_says_what_there_could_be() -> None:
    """And the first that is installed is taken."""
    assert speech.player(lambda name: "/usr/bin/aplay" if name == "aplay" else None)._command == [
        "aplay",
        "-q",
    ]
    with pytest.raises(Unavailable, match="--out writes a WAV file instead"):
        speech.player(lambda _: None)
