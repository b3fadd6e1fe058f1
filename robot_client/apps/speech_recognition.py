"""Finds the words a robot obeys in sound, by PocketSphinx and the English model it comes with, on this computer.

What is spoken is cut out between two silences, and recognised as one of the words or as one of many others that are
there to be taken for what is neither: a word has to be nearer than all of them. What is too short or too long to be a
word, or has no voice in it, is noise.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Any

import click

from robot_client.apps.audio import BLOCK, RATE
from robot_client.apps.command_words import CommandWord

BEFORE = 8
"""Blocks of silence before speech that belong to it: recognition needs some, and words begin softly."""

BEGINS = 2
"""Blocks of speech in a row by which it begins."""

ENDS = 6
"""Blocks of silence in a row by which it has ended. Less would cut words at their closed consonants."""

SHORTEST, LONGEST = 6, 60
"""Blocks that a word has, without the silence around it."""

FAINTEST = 60.0
"""The least of a sample, on average, that is speech."""

LOUDER = 3.0
"""Times as loud as the quietest of the last moments speech is at least."""

MOMENTS = 70
"""Blocks of which the quietest tells how loud it is where nobody speaks."""

VOICED = 3
"""Blocks with a voice in them that a word has at least."""

PERIODIC = 0.6
"""Of a block's energy, what has to come again at the pitch of a voice for it to be one."""

PITCH = (80, 400)
"""Hertz of voices."""

FAVOUR = {CommandWord.STOP: 10_000}
"""How much likelier a word is than each of the others. A stop nobody said does less harm than one not heard."""

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


class Loudness:
    """Tells what is louder than silence.

    A detector of speech that has heard a clap takes what is quiet after it for speech, for seconds.
    """

    def __init__(self) -> None:
        self._last: deque[float] = deque(maxlen=MOMENTS)

    def is_loud(self, data: bytes) -> bool:
        """Whether a block is."""
        loudness = _loudness(data)
        self._last.append(loudness)
        return loudness >= FAINTEST and loudness >= LOUDER * min(self._last)


class Cutter:
    """Cuts what is spoken out of sound: block after block.

    :param speaks: whether somebody speaks in a block
    """

    def __init__(self, speaks: Any) -> None:
        self._speaks = speaks
        self._blocks: deque[bytes] = deque(maxlen=BEFORE + BEGINS)
        self._spoken: list[bytes] = []
        self._run = 0
        self._in_speech = False

    def take(self, data: bytes) -> list[bytes] | None:
        """What was spoken, as blocks, when it has ended with this one."""
        speaks = bool(self._speaks(data))
        if not self._in_speech:
            self._blocks.append(data)
            self._run = self._run + 1 if speaks else 0
            if self._run >= BEGINS:
                self._in_speech, self._run, self._spoken = True, 0, list(self._blocks)
            return None
        if len(self._spoken) <= BEFORE + LONGEST + ENDS:  # of a speech nothing more is needed than its length
            self._spoken.append(data)
        self._run = 0 if speaks else self._run + 1
        if self._run < ENDS:
            return None
        self._in_speech, self._run = False, 0
        self._blocks.clear()
        self._blocks.extend(self._spoken[-ENDS:])
        return self._spoken


class Recognizer:
    """Finds words, one for each time somebody speaks.

    :raises click.ClickException: there is no PocketSphinx
    """

    def __init__(self) -> None:
        try:
            from pocketsphinx import Decoder, Vad
        except ImportError as error:
            raise click.ClickException(f"words take pocketsphinx: pip install '.[apps]' ({error})") from None
        self._decoder: Any = Decoder(lm=None, samprate=RATE, lw=1.0, loglevel="FATAL")
        known = [f"/{FAVOUR.get(word, USUAL_FAVOUR)}/ {word.value}" for word in CommandWord] + [
            f"/1/ {word}" for word in OTHERS
        ]
        self._decoder.add_jsgf_string(
            "words", f"#JSGF V1.0; grammar words; public <word> = {' | '.join(known)};"
        )
        self._decoder.activate_search("words")
        self._vad: Any = Vad(Vad.MEDIUM_STRICT, RATE, BLOCK)
        self._loudness = Loudness()
        self._cutter = Cutter(self._speaks)

    def hear(self, data: bytes) -> Iterator[tuple[CommandWord, float]]:
        """Words found with one block more, and how many seconds before its end each ended."""
        spoken = self._cutter.take(data)
        if spoken is None or not may_be_word(spoken):
            return
        decoder = self._decoder
        known = decoder.get_cmn(False)
        decoder.start_utt()
        decoder.process_raw(b"".join(spoken))
        decoder.end_utt()
        found = decoder.hyp()
        if found is not None and found.hypstr in WORDS:
            yield WORDS[found.hypstr], ENDS * BLOCK
        else:
            # Of what is no word nothing is learnt about the voice and the room.
            decoder.set_cmn(known)

    def _speaks(self, data: bytes) -> bool:
        loud = self._loudness.is_loud(data)
        return bool(self._vad.is_speech(data)) and loud


def _loudness(data: bytes) -> float:
    import numpy as np

    return float(np.sqrt(np.square(np.frombuffer(data, "<i2").astype(np.float64)).mean()))


def may_be_word(spoken: list[bytes]) -> bool:
    """Whether it is as long as words are, and has a voice in it."""
    length = len(spoken) - BEFORE - ENDS
    return SHORTEST <= length <= LONGEST and sum(map(has_voice, spoken)) >= VOICED


def has_voice(data: bytes) -> bool:
    """Whether a block comes again and again at the pitch of a voice, as no noise does."""
    import numpy as np

    samples = np.frombuffer(data, "<i2").astype(np.float64)
    samples -= samples.mean()
    spectrum = np.fft.rfft(samples, 2 * len(samples))
    again = np.fft.irfft(spectrum * spectrum.conj())[: len(samples)]
    if again[0] <= 0:
        return False
    # Of what is later by a lag there is less: that much it could be at most.
    shares = again / again[0] * len(samples) / np.arange(len(samples), 0, -1)
    first, last = RATE // PITCH[1], RATE // PITCH[0]
    return bool(shares[first : last + 1].max() >= PERIODIC)
