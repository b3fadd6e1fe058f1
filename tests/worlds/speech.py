"""Speech made by eSpeak NG, and a microphone that plays it in real time."""

from __future__ import annotations

import ctypes
import functools
import os
import tempfile
import threading
import time
from pathlib import Path

import espeakng_loader
import numpy as np
import numpy.typing as npt

RATE = 16000
BLOCK = 480
"""Samples that are said at a time: 30 ms."""

Samples = npt.NDArray[np.int16]

_RETRIEVAL = 1
_RATE, _PITCH = 1, 3
_UTF8 = 1
_LONGEST_PATH = 140
"""The library has 160 bytes for its path, and ends the process where that is too little."""

_CALLBACK = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.POINTER(ctypes.c_short), ctypes.c_int, ctypes.c_void_p)


class _Synthesis:
    """The library, of which a process has one."""

    def __init__(self) -> None:
        data = str(espeakng_loader.get_data_path())
        if len(data) > _LONGEST_PATH:
            short = Path(tempfile.mkdtemp(prefix="speech-")) / "espeak-ng-data"
            short.symlink_to(data)
            data = str(short)
        self._library = ctypes.CDLL(str(espeakng_loader.get_library_path()))
        self._parts: list[Samples] = []
        self._callback = _CALLBACK(self._take)  # stored: the library has only its address
        self.rate = self._library.espeak_Initialize(_RETRIEVAL, 0, data.encode(), 0)
        assert self.rate > 0, "eSpeak NG does not start"
        self._library.espeak_SetSynthCallback(self._callback)

    def _take(self, samples: ctypes._Pointer[ctypes.c_short], count: int, _: int) -> int:
        if samples and count:
            self._parts.append(np.ctypeslib.as_array(samples, shape=(count,)).astype(np.int16))
        return 0

    def say(self, text: str, voice: str, words_per_minute: int, pitch: int) -> Samples:
        """Synthesises a text."""
        library = self._library
        assert library.espeak_SetVoiceByName(voice.encode()) == 0, f"eSpeak NG has no voice {voice}"
        library.espeak_SetParameter(_RATE, words_per_minute, 0)
        library.espeak_SetParameter(_PITCH, pitch, 0)
        self._parts.clear()
        spoken = text.encode() + b"\0"
        library.espeak_Synth(spoken, ctypes.c_size_t(len(spoken)), 0, 0, 0, _UTF8, None, None)
        library.espeak_Synchronize()
        return np.concatenate(self._parts)


@functools.cache
def _synthesis() -> _Synthesis:
    return _Synthesis()


@functools.cache
def speech(text: str, voice: str = "en-us", words_per_minute: int = 150, pitch: int = 50) -> Samples:
    """A spoken text, 16000 samples per second, without silence before and after.

    :param voice: of eSpeak NG, such as ``en-us+f3``
    :param pitch: 0 to 99
    """
    made = _synthesis()
    said = made.say(text, voice, words_per_minute, pitch)
    moments = np.arange(0, len(said) / made.rate, 1 / RATE)
    samples = np.interp(moments, np.arange(len(said)) / made.rate, said)
    loud = np.flatnonzero(np.abs(samples) > np.abs(samples).max() / 50)
    return samples[loud[0] : loud[-1] + 1].astype(np.int16)


def silence(seconds: float, seed: int = 1) -> Samples:
    """A microphone's signal without speech: a little noise."""
    return np.random.default_rng(seed).normal(0, 12, int(seconds * RATE)).astype(np.int16)


def spaced(*parts: Samples, gap: float = 0.7) -> Samples:
    """One after the other, with silence before, between and after."""
    quiet = silence(gap)
    return np.concatenate([quiet, *(each for part in parts for each in (part, quiet))])


class SimulatedMicrophone(threading.Thread):
    """Plays requested sounds, and silence before and after, in real time.

    :param out: a file descriptor for raw samples
    """

    def __init__(self, out: int) -> None:
        super().__init__(daemon=True)
        self._out = out
        self._lock = threading.Lock()
        self._coming = np.zeros(0, np.int16)
        self._said = threading.Event()
        self._end = threading.Event()
        self.ended_at = 0
        """Monotonic nanoseconds when the last word had been said whole."""

    def run(self) -> None:
        """Plays until it is stopped or the reader has gone."""
        due = time.monotonic()
        quiet = silence(BLOCK / RATE)
        while not self._end.is_set():
            due += BLOCK / RATE
            self._end.wait(max(0.0, due - time.monotonic()))
            with self._lock:
                now, self._coming = self._coming[:BLOCK], self._coming[BLOCK:]
            block = quiet.copy()
            block[: len(now)] += now
            try:
                os.write(self._out, block.tobytes())
            except BrokenPipeError:
                break
            if len(now) and not len(self._coming):
                self.ended_at = time.monotonic_ns() - int(1e9 * (BLOCK - len(now)) / RATE)
                self._said.set()
        os.close(self._out)

    def say(self, samples: Samples) -> int:
        """Plays a sound; returns the monotonic nanoseconds of its end."""
        self._said.clear()
        with self._lock:
            self._coming = samples
        assert self._said.wait(60)
        return self.ended_at

    def stop(self) -> None:
        self._end.set()
        self.join(10)
