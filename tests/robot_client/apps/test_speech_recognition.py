"""Speech recognition of words and of other sounds: made by eSpeak NG, processed faster than real time."""

from __future__ import annotations

import numpy as np
import pytest

from robot_client.apps.audio import BLOCK, SIZE
from robot_client.apps.command_words import CommandWord
from robot_client.apps.speech_recognition import (
    BEFORE,
    BEGINS,
    ENDS,
    LONGEST,
    SHORTEST,
    Recognizer,
    SpeechSegmenter,
    has_voice,
    may_be_word,
)
from tests.worlds.speech import RATE, Samples, spaced, speech


def blocks(samples: Samples) -> list[bytes]:
    """Blocks of a sound."""
    data = samples.tobytes()
    return [data[at : at + SIZE] for at in range(0, len(data) - SIZE + 1, SIZE)]


@pytest.fixture(scope="module")
def recognizer() -> Recognizer:
    """Its model takes half a second to load."""
    return Recognizer()


def heard(recognizer: Recognizer, samples: Samples) -> list[tuple[CommandWord, float]]:
    """The words, and the second at which each ended."""
    return [
        (word, (number + 1) * BLOCK - before)
        for number, data in enumerate(blocks(samples))
        for word, before in recognizer.recognize(data)
    ]


def test_all_words_are_recognised_with_their_end_times(recognizer: Recognizer) -> None:
    """One after the other, to 1/7 s."""
    parts = [speech(word.value) for word in CommandWord]
    found = heard(recognizer, spaced(*parts))
    assert [word for word, _ in found] == list(CommandWord)
    ends = np.cumsum([0.7 + len(part) / RATE for part in parts])
    assert [at for _, at in found] == pytest.approx(ends, abs=0.15)


@pytest.mark.parametrize("word", [CommandWord.STOP, CommandWord.AHEAD])
def test_a_word_is_recognised_softly_and_loudly(recognizer: Recognizer, word: CommandWord) -> None:
    """Over a factor of three."""
    samples = speech(word.value).astype(float)
    for gain in (0.3, 1.0):
        assert [each for each, _ in heard(recognizer, spaced((samples * gain).astype(np.int16)))] == [word]


def test_other_words_and_sentences_are_not_taken_for_those(recognizer: Recognizer) -> None:
    """Neither those in its vocabulary of others nor unknown ones."""
    said = [
        "hello",
        "window",
        "purple elephant",
        "monkey",
        "what time is it tomorrow",
        "seventeen",
        "good morning",
    ]
    assert heard(recognizer, spaced(*map(speech, said))) == []


def noises() -> list[Samples]:
    """Hiss, claps, a hum and a whistle."""
    random = np.random.default_rng(7)
    moments = np.arange(RATE) / RATE
    hiss = random.normal(0, 3000, RATE)
    claps = random.normal(0, 9000, RATE) * np.exp(-(moments % 0.4) * 40)
    hum = 6000 * np.sin(2 * np.pi * 110 * moments)
    whistle = 6000 * np.sin(2 * np.pi * (700 + 300 * moments) * moments)
    return [each.clip(-32000, 32000).astype(np.int16) for each in (hiss, claps, hum, whistle)]


def test_noise_is_no_word(recognizer: Recognizer) -> None:
    """For any kind and length."""
    assert heard(recognizer, spaced(*noises())) == []
    assert heard(recognizer, np.concatenate(noises() * 2)) == []


def test_a_word_is_recognised_in_noise(recognizer: Recognizer) -> None:
    """Preceding hiss and claps do not disturb it."""
    found = heard(recognizer, spaced(*noises()[:2], speech("stop"), gap=1.0))
    assert [word for word, _ in found] == [CommandWord.STOP]


def test_silence_has_no_voice_and_speech_has() -> None:
    """Hiss of any volume has none."""
    assert not has_voice(bytes(SIZE))
    assert not any(map(has_voice, blocks(noises()[0])))
    assert sum(map(has_voice, blocks(speech("ahead")))) > 5


def test_speech_is_cut_out_with_some_silence_around() -> None:
    """Shorter pauses within it are kept."""
    cutter = SpeechSegmenter(lambda data: data == b"!")
    plan = "." * 20 + "!" * 5 + "." * (ENDS - 1) + "!" * 5 + "." * 20
    cuts = [cut for each in plan if (cut := cutter.add(each.encode()))]
    (cut,) = cuts
    spoken = b"".join(cut).decode()
    assert spoken == "." * BEFORE + "!" * 5 + "." * (ENDS - 1) + "!" * 5 + "." * ENDS


def test_a_single_block_is_no_speech() -> None:
    """Several in a row are needed."""
    cutter = SpeechSegmenter(lambda data: data == b"!")
    plan = ("." * 5 + "!" * (BEGINS - 1)) * 5 + "." * 20
    assert [cutter.add(each.encode()) for each in plan] == [None] * len(plan)


def test_endless_speech_is_stored_up_to_a_limit() -> None:
    """It is too long for a word."""
    cutter = SpeechSegmenter(lambda data: data == b"!")
    cuts = [cut for each in "!" * 5000 + "." * ENDS if (cut := cutter.add(each.encode()))]
    assert len(cuts[0]) < BEFORE + LONGEST + ENDS + BEGINS
    assert not may_be_word(cuts[0])


def test_too_short_or_long_sound_is_no_word() -> None:
    """Even with a voice."""
    voice = next(each for each in blocks(speech("ahead")) if has_voice(each))
    around = BEFORE + ENDS
    assert may_be_word([voice] * (around + SHORTEST))
    assert not may_be_word([voice] * (around + SHORTEST - 1))
    assert may_be_word([voice] * (around + LONGEST))
    assert not may_be_word([voice] * (around + LONGEST + 1))
