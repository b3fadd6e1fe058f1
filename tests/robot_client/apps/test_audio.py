"""Sources of speech, and the time at which it was spoken."""

from __future__ import annotations

import builtins
import io
import wave
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import click
import pytest

from robot_client.apps import audio
from robot_client.apps.audio import BLOCK, MAX_BLOCKS, RATE, SIZE, TRAILING_SILENCE, AudioBuffer, BlockTimes


def written(path: Path, seconds: float, channels: int = 1, rate: int = RATE) -> Path:
    """Writes a WAV file."""
    with wave.open(str(path), "wb") as file:
        file.setnchannels(channels)
        file.setsampwidth(2)
        file.setframerate(rate)
        file.writeframes(b"\x01\x00" * int(seconds * rate * channels))
    return path


def test_a_file_is_as_long_as_it_was_spoken(tmp_path: Path) -> None:
    """With silence at the end, and a wait before each block."""
    waits: list[float] = []
    blocks = list(audio.from_file(written(tmp_path / "a.wav", 0.3), waits.append))
    assert len(blocks) == round((0.3 + TRAILING_SILENCE) / BLOCK)
    assert {len(each) for each in blocks} == {SIZE}
    assert sum(each == b"\x01\x00" * (SIZE // 2) for each in blocks) == 10
    assert len(waits) == len(blocks)
    assert max(waits) > BLOCK / 2


@pytest.mark.parametrize("form", [{"channels": 2}, {"rate": 44100}])
def test_a_file_of_another_form_is_refused_with_a_reason(tmp_path: Path, form: dict[str, int]) -> None:
    """The error has its format and the needed one."""
    with pytest.raises(click.ClickException, match="16000 Hz"):
        list(audio.from_file(written(tmp_path / "a.wav", 0.1, **form)))


class _Pipe(io.RawIOBase):
    """Returns at most 700 bytes at a time."""

    def __init__(self, data: bytes) -> None:
        self._data = data

    def read(self, size: int = -1) -> bytes:
        given, self._data = self._data[: min(size, 700)], self._data[min(size, 700) :]
        return given


def test_samples_from_a_stream_come_in_whole_blocks() -> None:
    """For any division of the stream; an incomplete block at the end is dropped."""
    data = bytes(range(256)) * (2 * SIZE // 256 + 1)
    blocks = list(audio.from_stream(_Pipe(data[: 2 * SIZE + 5])))
    assert blocks == [data[:SIZE], data[SIZE : 2 * SIZE]]


def test_without_sounddevice_a_microphone_is_refused_with_a_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    """The error says what to install, and which sources work without it."""
    real: Callable[..., Any] = builtins.__import__

    def without(name: str, *rest: Any) -> Any:
        if name == "sounddevice":
            raise ImportError("no such module")
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(click.ClickException, match=r"pip install sounddevice.*--wav"):
        audio.from_microphone(None)


def test_blocks_that_come_in_time_ended_when_they_came() -> None:
    """Except for jitter."""
    moments = BlockTimes()
    assert [moments.next_time(100.0 + n * BLOCK) for n in range(3)] == pytest.approx(
        [100.0 + n * BLOCK for n in range(3)]
    )


def test_blocks_that_were_held_up_ended_before_they_came() -> None:
    """A program that stalled for a second gets all blocks at once."""
    moments = BlockTimes()
    moments.next_time(100.0)
    late = [moments.next_time(101.0 + BLOCK) for _ in range(10)]
    assert late == pytest.approx([100.0 + (n + 1) * BLOCK for n in range(10)])


class _Clock:
    """Each reading takes as long as a block."""

    now = 5.0

    def __call__(self) -> float:
        self.now += BLOCK
        return self.now


def test_a_tape_keeps_the_newest() -> None:
    """A slow reader gets no old blocks."""
    tape = AudioBuffer(iter([bytes([n]) for n in range(MAX_BLOCKS + 10)]), _Clock())
    tape.start()
    tape.join()
    heard = list(tape)
    assert len(heard) == MAX_BLOCKS - 1  # and the end
    assert heard[-1].data == bytes([MAX_BLOCKS + 9])


def test_a_source_that_fails_ends_the_recording_with_the_reason() -> None:
    """Earlier blocks are still read."""

    def source() -> Any:
        yield b"a"
        raise OSError("unplugged")

    tape = AudioBuffer(source(), _Clock())
    tape.start()
    (block,) = tape
    assert block == (b"a", pytest.approx(5.0 + 2 * BLOCK))
    assert "unplugged" in tape.error


def test_sound_that_lay_ready_at_the_start_is_dropped() -> None:
    """A full pipe may have any age; a burst after the first wait was delayed, and is kept."""
    now = 5.0

    def source() -> Iterator[bytes]:
        nonlocal now
        for number in range(20):
            now += BLOCK if number in (10, 15) else 0.001
            yield bytes([number])

    tape = AudioBuffer(source(), lambda: now)
    tape.start()
    heard = list(tape)
    assert [each.data[0] for each in heard] == list(range(10, 20))
    assert heard[0].at == pytest.approx(5.0 + 10 * 0.001 + BLOCK)
