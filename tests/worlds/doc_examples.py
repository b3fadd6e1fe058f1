"""Shell lines and programs of the documents, and their results."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from tests.worlds.processes import mortal
from tests.worlds.waiting import PATIENCE, wait_for

# A block of a language, which may be part of a list and indented.
_BLOCK = r"^( *)```{}\b[^\n]*\n(.*?)^\1```$"
_CURL = re.compile(r"(^|[\s;|&(])curl\s")
_SETTING = re.compile(r"[A-Z]+=")
_REMARK = re.compile(r"\s+# .*\Z", re.DOTALL)
# Curl may print it in the same line as its progress.
_STATUS = re.compile(r"< HTTP/[0-9.]+ ([0-9]{3})")


class Example(NamedTuple):
    """A command or a program of a document.

    :param place: the document and the first line
    :param text: its literal text, over any number of lines
    """

    place: str
    text: str

    @property
    def asks(self) -> bool:
        """Whether it sends a request by curl."""
        return _CURL.search(self.text) is not None

    @property
    def sets(self) -> bool:
        """Whether it begins by setting a variable."""
        return _SETTING.match(self.text) is not None

    @property
    def command(self) -> str:
        """The command without its comment."""
        return _REMARK.sub("", self.text)


class Came(NamedTuple):
    """The result of an example.

    :param status: of HTTP; that of the last answer that curl got
    :param words: output of curl itself, or a program's error output
    """

    code: int
    status: int
    output: str
    words: str


def examples(path: Path) -> Iterator[Example]:
    """The commands in a document's shell blocks."""
    for line, text in _blocks(path, "sh"):
        # A backslash at its end joins a line with the next.
        for lines in re.findall(r"(?:.*\\\n)*.*\n", text):
            if lines.strip():
                yield Example(f"{path.name}:{line}", lines.rstrip("\n"))
            line += lines.count("\n")


def programs(path: Path) -> Iterator[Example]:
    """The programs in a document's Python blocks, one per block."""
    for line, text in _blocks(path, r"py\w*"):
        yield Example(f"{path.name}:{line}", text)


def _blocks(path: Path, language: str) -> Iterator[tuple[int, str]]:
    """Each block of a language, and its first line."""
    text = path.read_text()
    for block in re.finditer(_BLOCK.format(language), text, re.DOTALL | re.MULTILINE):
        yield text.count("\n", 0, block.start(2)) + 1, textwrap.dedent(block[2])


class Shell:
    """Runs examples in a folder, by bash and curl, or by Python.

    :param folder: for their files; has curl's settings, which report its results
    :param environment: variables
    :param places: replacements for placeholders in examples
    """

    def __init__(self, folder: Path, environment: Mapping[str, str], places: Mapping[str, str]) -> None:
        self.folder = folder
        (folder / ".curlrc").write_text("verbose\n")
        self.environment = {**environment, "CURL_HOME": str(folder)}
        self._places = dict(places)

    def set(self, settings: list[Example]) -> None:
        """Sets variables as examples do, for all that follow."""
        text = "\n".join(self._here(each.text, {}) for each in settings)
        script = f"set -euo pipefail -o allexport\n{text}\nenv -0"
        done = subprocess.run(
            ["bash", "-c", script],
            cwd=self.folder,
            env=self.environment,
            capture_output=True,
            text=True,
            timeout=PATIENCE,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        self.environment = dict(each.split("=", 1) for each in done.stdout.split("\0") if each)

    def run(
        self, example: Example, places: Mapping[str, str], over: Callable[[str], bool] | None = None
    ) -> Came:
        """Runs one.

        :param places: further ones, for this example
        :param over: decides by the output when to end an endless one, as Ctrl-C does
        """
        lines = [self._here(example.text, places)]
        if example.sets:
            lines.append(f'printf %s "${example.text.partition("=")[0]}"')
        command = ["bash", "-c", "set -euo pipefail\n" + "\n".join(lines)]
        return self._come(command, None if over is None else (example.place, over))

    def run_program(self, text: str, *arguments: str) -> Came:
        """Runs a program to its end, by this Python.

        :param arguments: its own
        """
        (self.folder / "example.py").write_text(self._here(text, {}))
        return self._come([sys.executable, "example.py", *arguments], None)

    def _come(self, command: list[str], over: tuple[str, Callable[[str], bool]] | None) -> Came:
        """Runs a command.

        :param over: for an endless one: its place, and a function that decides by the output when to end it
        """
        out, words = self.folder / "out", self.folder / "words"
        with out.open("wb") as printed, words.open("wb") as reported:
            running = subprocess.Popen(
                mortal(command),
                cwd=self.folder,
                env=self.environment,
                stdin=subprocess.DEVNULL,
                stdout=printed,
                stderr=reported,
                start_new_session=True,
            )
            try:
                if over is not None:
                    place, enough = over
                    wait_for(
                        f"{place} has come so far",
                        lambda: running.poll() is not None or enough(out.read_text(errors="replace")),
                    )
                    _signal(running.pid, signal.SIGINT)
                code = running.wait(PATIENCE)
            finally:
                _signal(running.pid, signal.SIGKILL)
                running.wait()
        said = words.read_text(errors="replace")
        found = _STATUS.findall(said)
        return Came(code, int(found[-1]) if found else 0, out.read_text(errors="replace"), said)

    def _here(self, text: str, places: Mapping[str, str]) -> str:
        for stands, there in {**self._places, **places}.items():
            text = text.replace(stands, there)
        return text


def _signal(group: int, number: signal.Signals) -> None:
    """Sends a signal to all processes of a group, if there are any."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(group, number)
