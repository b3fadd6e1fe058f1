"""Recognises command words in sound, by PocketSphinx and its English model, on this computer.

Speech between two silences is recognised as a command word or as one of many other words, which absorb everything else:
a command word must match better than all of them. Speech that is too short, too long or without a voice is noise.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Any

import click

from robot_client.apps.audio import BLOCK, RATE
from robot_client.apps.command_words import CommandWord

BEFORE = 8
"""Blocks of silence before speech that are kept, because words begin softly."""

BEGINS = 2
"""Successive blocks of speech at which speech begins."""

ENDS = 6
"""Successive blocks of silence at which speech ends. Fewer would cut words at plosives."""

SHORTEST, LONGEST = 6, 60
"""Length of a word in blocks, without silence."""

FAINTEST = 60.0
"""Least RMS amplitude of speech."""

LOUDER = 3.0
"""Least ratio of the amplitudes of speech and background."""

MOMENTS = 70
"""Blocks whose quietest is the background."""

VOICED = 3
"""Least number of voiced blocks in a word."""

PERIODIC = 0.6
"""Least autocorrelation at the pitch of a voice."""

PITCH = (80, 400)
"""Pitch of voices, Hz."""

FAVOUR = {CommandWord.STOP: 10_000}
"""Weight of a word against each other word. A false stop does less harm than a missed one."""

USUAL_FAVOUR = 10

OTHERS = """
a about again all and any are ask at away battery be because bed big bird black book both box boy bread buy by
call can car cat child city clear cold come cup day do door down draw each east eat eight end every eye face fall far
farm feel few fine fire fish five floor flower foot for four friend from full get girl give go great green hand happy
hard has he head hear heart hello help her here high him his home hope house how hundred i if in is it job just keep
kind know large late law lay learn less life light line little long look lower made make man many master may me men
milk more morning mother must name near need never new night nine no north not nothing now of off oh old on one open
or our out over own pack page park part people play please point power read real red road robot room said same say
school see seven she shop short sit six sky sleep small snow so some song step sun table take talk tell ten thank the
then they thing think this three time to today too town train tree try turn two under until up very wait walk want was
water way we week well west what when where which white who why will wind window with wood word world year yellow yes
you young
""".split()  # noqa: SIM905 -- to be read


WORDS = {word.value: word for word in CommandWord}


class LoudnessDetector:
    """Detects blocks that are louder than the background.

    After a clap, the speech detector alone takes quiet blocks for speech for seconds.
    """

    def __init__(self) -> None:
        self._last: deque[float] = deque(maxlen=MOMENTS)

    def is_loud(self, data: bytes) -> bool:
        """Whether a block is loud."""
        loudness = _loudness(data)
        self._last.append(loudness)
        return loudness >= FAINTEST and loudness >= LOUDER * min(self._last)


class SpeechSegmenter:
    """Cuts speech out of a sequence of blocks.

    :param is_speech: whether a block is speech
    """

    def __init__(self, is_speech: Any) -> None:
        self._is_speech = is_speech
        self._blocks: deque[bytes] = deque(maxlen=BEFORE + BEGINS)
        self._segment: list[bytes] = []
        self._run = 0
        self._in_speech = False

    def add(self, data: bytes) -> list[bytes] | None:
        """Add a block; returns the speech that ends with it, as blocks."""
        is_speech = bool(self._is_speech(data))
        if not self._in_speech:
            self._blocks.append(data)
            self._run = self._run + 1 if is_speech else 0
            if self._run >= BEGINS:
                self._in_speech, self._run, self._segment = True, 0, list(self._blocks)
            return None
        if (
            len(self._segment) <= BEFORE + LONGEST + ENDS
        ):  # of a speech nothing more is needed than its length
            self._segment.append(data)
        self._run = 0 if is_speech else self._run + 1
        if self._run < ENDS:
            return None
        self._in_speech, self._run = False, 0
        self._blocks.clear()
        self._blocks.extend(self._segment[-ENDS:])
        return self._segment


class Recognizer:
    """Recognises one word in each piece of speech.

    :raises click.ClickException: PocketSphinx is not installed
    """

    def __init__(self) -> None:
        try:
            from pocketsphinx import Decoder, Vad
        except ImportError as error:
            raise click.ClickException(
                f"voice control needs pocketsphinx: pip install '.[apps]' ({error})"
            ) from None
        self._decoder: Any = Decoder(lm=None, samprate=RATE, lw=1.0, loglevel="FATAL")
        known = [f"/{FAVOUR.get(word, USUAL_FAVOUR)}/ {word.value}" for word in CommandWord] + [
            f"/1/ {word}" for word in OTHERS
        ]
        self._decoder.add_jsgf_string(
            "words", f"#JSGF V1.0; grammar words; public <word> = {' | '.join(known)};"
        )
        self._decoder.activate_search("words")
        self._vad: Any = Vad(Vad.MEDIUM_STRICT, RATE, BLOCK)
        self._loudness = LoudnessDetector()
        self._segmenter = SpeechSegmenter(self._is_speech)

    def recognize(self, data: bytes) -> Iterator[tuple[CommandWord, float]]:
        """Add a block; yields recognised words, and how many seconds before the block's end each ended."""
        segment = self._segmenter.add(data)
        if segment is None or not may_be_word(segment):
            return
        decoder = self._decoder
        known = decoder.get_cmn(False)
        decoder.start_utt()
        decoder.process_raw(b"".join(segment))
        decoder.end_utt()
        found = decoder.hyp()
        if found is not None and found.hypstr in WORDS:
            yield WORDS[found.hypstr], ENDS * BLOCK
        else:
            # Other sound must not adapt the model to voice and room.
            decoder.set_cmn(known)

    def _is_speech(self, data: bytes) -> bool:
        loud = self._loudness.is_loud(data)
        return bool(self._vad.is_speech(data)) and loud


def _loudness(data: bytes) -> float:
    import numpy as np

    return float(np.sqrt(np.square(np.frombuffer(data, "<i2").astype(np.float64)).mean()))


def may_be_word(segment: list[bytes]) -> bool:
    """Whether speech has the length of a word and enough voice."""
    length = len(segment) - BEFORE - ENDS
    return SHORTEST <= length <= LONGEST and sum(map(has_voice, segment)) >= VOICED


def has_voice(data: bytes) -> bool:
    """Whether a block is periodic at the pitch of a voice, unlike noise."""
    import numpy as np

    samples = np.frombuffer(data, "<i2").astype(np.float64)
    samples -= samples.mean()
    spectrum = np.fft.rfft(samples, 2 * len(samples))
    again = np.fft.irfft(spectrum * spectrum.conj())[: len(samples)]
    if again[0] <= 0:
        return False
    # With a lag fewer samples overlap: normalise by their number.
    shares = again / again[0] * len(samples) / np.arange(len(samples), 0, -1)
    first, last = RATE // PITCH[1], RATE // PITCH[0]
    return bool(shares[first : last + 1].max() >= PERIODIC)
