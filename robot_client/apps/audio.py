"""Where speech comes from: a file, the standard input, a microphone; as blocks of one form, each with its moment."""

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

from robot_client.apps.clock import now as since_start

RATE = 16000
"""Samples per second: one channel, 16 bits, little endian."""

BLOCK = 0.03
"""Seconds of a block."""

WAITED = BLOCK / 2
"""Seconds that reading a block takes at least where it was not there already."""

SIZE = int(RATE * BLOCK) * 2
"""Bytes of a block."""

AFTER = 0.6
"""Seconds of silence behind a file, in which its last word is found to have ended."""

KEPT = 50
"""Blocks that wait at most; of what waits longer the oldest are dropped."""

MEMORY = 1000
"""Blocks of which the one that was on its way shortest tells how late the others are: half a minute."""


class Block(NamedTuple):
    """Sound.

    :ivar data: :data:`SIZE` bytes
    :ivar at: seconds, suspends included, when it ended
    """

    data: bytes
    at: float


def from_file(path: Path, sleep: Callable[[float], None] = time.sleep) -> Iterator[bytes]:
    """A WAV file, as fast as it was spoken.

    :raises click.ClickException: it is none, or has another form
    """
    try:
        with wave.open(str(path), "rb") as file:
            form = (file.getnchannels(), file.getsampwidth(), file.getframerate())
            data = file.readframes(file.getnframes())
    except (OSError, EOFError, wave.Error) as error:
        raise click.ClickException(f"{path} can't be read as WAV: {error}") from None
    if form != (1, 2, RATE):
        told = f"{form[0]} channels, {form[1] * 8} bits, {form[2]} Hz"
        raise click.ClickException(f"{path} has {told}; what is needed is 1 channel, 16 bits, {RATE} Hz")
    return _paced(data + bytes(int(AFTER * RATE) * 2), sleep)


def _paced(data: bytes, sleep: Callable[[float], None]) -> Iterator[bytes]:
    began = time.monotonic()
    for number in range(len(data) // SIZE):
        sleep(max(0.0, began + (number + 1) * BLOCK - time.monotonic()))
        yield data[number * SIZE : (number + 1) * SIZE]


def from_stream(stream: RawIOBase) -> Iterator[bytes]:
    """Raw samples, as they come; whoever writes them gives the pace.

    :param stream: without a buffer, whose lock a thread that waits for more would take into the end of the program
    """
    data = b""
    while more := stream.read(SIZE - len(data)):
        data += more
        if len(data) == SIZE:
            yield data
            data = b""


def from_microphone(device: str | None) -> Iterator[bytes]:
    """What a microphone hears.

    :param device: its number or a part of its name; the usual one where none is said
    :raises click.ClickException: there is none, or no ``sounddevice``
    """
    try:
        import sounddevice
    except (ImportError, OSError) as error:
        words = "a microphone takes sounddevice: pip install sounddevice, and the library PortAudio"
        raise click.ClickException(f"{words} ({error}); without it: --wav FILE, or --pcm") from None
    chosen = int(device) if device is not None and device.isdigit() else device
    try:
        stream = sounddevice.RawInputStream(
            samplerate=RATE, channels=1, dtype="int16", blocksize=SIZE // 2, device=chosen
        )
        stream.start()
    except (sounddevice.PortAudioError, ValueError) as error:
        raise click.ClickException(f"the microphone can't be used: {error}") from None
    return _recorded(stream)


def _recorded(stream: Any) -> Iterator[bytes]:
    while True:
        data, _ = stream.read(SIZE // 2)
        yield bytes(data)


class BlockTimes:
    """When blocks ended, though they may come late and several at once.

    The block that was on its way shortest is taken to have come at once: by as much more are the others late.
    """

    def __init__(self) -> None:
        self._number = 0
        self._delays: deque[float] = deque(maxlen=MEMORY)

    def of_next(self, now: float) -> float:
        """When the next block ended, that has come now; seconds, suspends included."""
        self._number += 1
        self._delays.append(now - self._number * BLOCK)
        return self._number * BLOCK + min(self._delays)


class AudioBuffer(threading.Thread):
    """Takes blocks from a source as they come, and keeps the newest.

    What lies ready at the start, as in a full pipe, is of nobody knows when: it is dropped, to the first block that had
    to be waited for.

    :param source: blocks, when they come
    :param clock: seconds, suspends included
    :ivar broken: why the source ended, in words, where it did not just end
    """

    def __init__(self, source: Iterator[bytes], clock: Callable[[], float] = since_start) -> None:
        super().__init__(daemon=True)
        self.broken = ""
        self._source = source
        self._clock = clock
        self._moments = BlockTimes()
        self._blocks: deque[Block | None] = deque(maxlen=KEPT)
        self._more = threading.Condition()

    def run(self) -> None:
        """Take them all."""
        try:
            for data, now in self._fresh():
                self._add(Block(data, self._moments.of_next(now)))
        except Exception as error:
            self.broken = f"no more sound: {error}"
        self._add(None)

    def _fresh(self) -> Iterator[tuple[bytes, float]]:
        fresh, asked = False, self._clock()
        for data in self._source:
            now = self._clock()
            fresh = fresh or now - asked >= WAITED
            if fresh:
                yield data, now
            asked = self._clock()

    def _add(self, block: Block | None) -> None:
        with self._more:
            self._blocks.append(block)
            self._more.notify()

    def __iter__(self) -> Iterator[Block]:
        """The blocks, until the source has ended."""
        while True:
            with self._more:
                self._more.wait_for(lambda: self._blocks)
                block = self._blocks.popleft()
            if block is None:
                return
            yield block
