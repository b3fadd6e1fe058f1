"""The parts in C: the plain fan-out loop that is compared with, and clients that cost next to nothing."""

from __future__ import annotations

import os
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

from bench import BUILD, ROOT
from bench.child import Child
from bench.report import Unavailable

SOURCES = ROOT / "bench" / "native"


def program(name: str) -> Path:
    """A program of ``bench/native``, compiled when its source is newer.

    :raises Unavailable: there is no C compiler here
    """
    source, built = SOURCES / f"{name}.c", BUILD / name
    if built.exists() and built.stat().st_mtime > source.stat().st_mtime:
        return built
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        raise Unavailable("no C compiler (Debian: apt install gcc libc6-dev)")
    BUILD.mkdir(parents=True, exist_ok=True)
    fresh = built.with_suffix(f".{os.getpid()}")
    subprocess.run([compiler, "-O2", "-Wall", "-o", str(fresh), str(source), "-lm"], check=True)
    fresh.replace(built)
    return built


class Native(Child):
    """One of these programs, running. It ends with its standard input."""

    def __init__(self, name: str, *arguments: str) -> None:
        command = [str(program(name)), *arguments]
        super().__init__(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self.words = self.ready(AssertionError(f"{name} did not start; see above"))


class Receivers(Native):
    """Websocket clients, see ``bench/native/receivers.c``.

    :param folder: where the files with what they send are put
    :param head: the HTTP request that opens a websocket
    :param frames: what each sends then, masked frames
    :param rate: bytes a second each reads; 0 all, -1 none
    :param again: whether who is cut comes again
    :param every_ms: how often they look for what has come; 0: whoever sends wakes them
    """

    _serial = 0

    def __init__(
        self,
        folder: Path,
        port: int,
        count: int,
        head: bytes,
        frames: bytes = b"",
        *,
        rate: float = 0,
        again: bool = False,
        every_ms: int = 0,
    ) -> None:
        Receivers._serial += 1
        head_file, frames_file = (folder / f"{kind}-{Receivers._serial}" for kind in ("head", "frames"))
        head_file.write_bytes(head)
        frames_file.write_bytes(frames)
        numbers = (str(each) for each in (rate, int(again), every_ms))
        super().__init__("receivers", str(port), str(count), str(head_file), str(frames_file), *numbers)

    def report(self) -> dict[str, Any]:
        """What has come since the report before."""
        return self.ask()

    def until_each_has(self, count: float, seconds: float = 20.0) -> None:
        """Wait until every client has had so many messages since the report before.

        :raises AssertionError: somebody has not
        """
        least, end = 0, time.monotonic() + seconds
        while least < count:
            assert time.monotonic() < end, f"a client got {least} messages of {count:.0f}"
            time.sleep(0.05)  # they tell only what they are asked for
            least += self.report()["least"]
