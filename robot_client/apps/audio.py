"""Sources of speech: a file, the standard input or a microphone, as blocks of one format with their times."""

from __future__ import annotations

import threading
import time
import wave
from collections import deque
from collections.abc import Callable, Iterator
from io import RawIOBase
from pathlib import Path
from typing import Any, NamedTuple

import click

from relay_protocol.clocks import now as seconds_since_boot

RATE = 16000
"""Samples per second: one channel, 16 bits, little endian."""

BLOCK = 0.03
"""Duration of a block, seconds."""

FRESH_SECONDS = BLOCK / 2
"""Least time to read a block that was not buffered already, seconds."""

SIZE = int(RATE * BLOCK) * 2
"""Size of a block, bytes."""

TRAILING_SILENCE = 0.6
"""Silence appended to a file, so that its last word is recognised as ended, seconds."""

MAX_BLOCKS = 50
"""Most buffered blocks; the oldest are dropped."""

DELAY_BLOCKS = 1000
"""Blocks over which the least delay is taken: half a minute."""


class Block(NamedTuple):
    """A block of sound.

    :ivar data: :data:`SIZE` bytes
    :ivar at: seconds, including suspends, end of the block
    """

    data: bytes
    at: float


def from_file(path: Path, sleep: Callable[[float], None] = time.sleep) -> Iterator[bytes]:
    """Read a WAV file in real time.

    :raises click.ClickException: not a WAV file, or another format
    """
    try:
        with wave.open(str(path), "rb") as file:
            form = (file.getnchannels(), file.getsampwidth(), file.getframerate())
            data = file.readframes(file.getnframes())
    except (OSError, EOFError, wave.Error) as error:
        raise click.ClickException(f"cannot read {path} as WAV: {error}") from None
    if form != (1, 2, RATE):
        actual = f"{form[0]} channels, {form[1] * 8} bits, {form[2]} Hz"
        raise click.ClickException(f"{path} has {actual}; it must have 1 channel, 16 bits, {RATE} Hz")
    return _paced(data + bytes(int(TRAILING_SILENCE * RATE) * 2), sleep)


def _paced(data: bytes, sleep: Callable[[float], None]) -> Iterator[bytes]:
    began = time.monotonic()
    for number in range(len(data) // SIZE):
        sleep(max(0.0, began + (number + 1) * BLOCK - time.monotonic()))
        yield data[number * SIZE : (number + 1) * SIZE]


def from_stream(stream: RawIOBase) -> Iterator[bytes]:
    """Read raw samples at the pace of the stream.

    :param stream: unbuffered, because a buffer's lock held by a waiting thread would block the exit
    """
    data = b""
    while more := stream.read(SIZE - len(data)):
        data += more
        if len(data) == SIZE:
            yield data
            data = b""


def from_microphone(device: str | None) -> Iterator[bytes]:
    """Read a microphone.

    :param device: number or part of the name; ``None`` for the default
    :raises click.ClickException: no microphone, or no ``sounddevice``
    """
    try:
        import sounddevice
    except (ImportError, OSError) as error:
        words = "a microphone needs sounddevice (pip install sounddevice) and the library PortAudio"
        raise click.ClickException(f"{words} ({error}); without it: --wav FILE, or --pcm") from None
    chosen = int(device) if device is not None and device.isdigit() else device
    try:
        stream = sounddevice.RawInputStream(
            samplerate=RATE, channels=1, dtype="int16", blocksize=SIZE // 2, device=chosen
        )
        stream.start()
    except (sounddevice.PortAudioError, ValueError) as error:
        raise click.ClickException(f"cannot use the microphone: {error}") from None
    return _recorded(stream)


def _recorded(stream: Any) -> Iterator[bytes]:
    while True:
        data, _ = stream.read(SIZE // 2)
        yield bytes(data)


class BlockTimes:
    """Computes when blocks ended, although they may arrive late and in bursts.

    The block with the least delay counts as undelayed; the others are late by the difference.
    """

    def __init__(self) -> None:
        self._number = 0
        self._delays: deque[float] = deque(maxlen=DELAY_BLOCKS)

    def next_time(self, now: float) -> float:
        """End of the next block, which arrived now; seconds, including suspends."""
        self._number += 1
        self._delays.append(now - self._number * BLOCK)
        return self._number * BLOCK + min(self._delays)


class AudioBuffer(threading.Thread):
    """Reads blocks from a source, and keeps the newest.

    The time of data buffered before the start, as in a full pipe, is unknown. It is dropped, up to the first block that
    had to be waited for.

    :param source: yields blocks in real time
    :param clock: seconds, including suspends
    :ivar error: why the source failed; empty at a normal end
    """

    def __init__(self, source: Iterator[bytes], clock: Callable[[], float] = seconds_since_boot) -> None:
        super().__init__(daemon=True)
        self.error = ""
        self._source = source
        self._clock = clock
        self._times = BlockTimes()
        self._blocks: deque[Block | None] = deque(maxlen=MAX_BLOCKS)
        self._more = threading.Condition()

    def run(self) -> None:
        """Read until the source ends."""
        try:
            for data, now in self._fresh():
                self._add(Block(data, self._times.next_time(now)))
        except Exception as error:
            self.error = f"the sound source failed: {error}"
        self._add(None)

    def _fresh(self) -> Iterator[tuple[bytes, float]]:
        fresh, asked = False, self._clock()
        for data in self._source:
            now = self._clock()
            fresh = fresh or now - asked >= FRESH_SECONDS
            if fresh:
                yield data, now
            asked = self._clock()

    def _add(self, block: Block | None) -> None:
        with self._more:
            self._blocks.append(block)
            self._more.notify()

    def __iter__(self) -> Iterator[Block]:
        """Yields blocks until the source ends."""
        while True:
            with self._more:
                self._more.wait_for(lambda: self._blocks)
                block = self._blocks.popleft()
            if block is None:
                return
            yield block
