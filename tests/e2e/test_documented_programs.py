"""Commands in docs/ that start services and applications run literally against a relay and a robot."""

from __future__ import annotations

import re
from collections.abc import Iterator
from importlib.metadata import metadata
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.worlds.doc_examples import Example, examples
from tests.worlds.doc_scene import ROOT, Scene, staged
from tests.worlds.face_images import people

DOCUMENTS = [ROOT / "docs/guides" / f"{name}.md" for name in ("apps", "services")]
SHOWN = [each for path in DOCUMENTS for each in examples(path)]
PROGRAM, TYPED, CURL, INSTALLS = KINDS = (
    r"(switchboard-robot-service|.*\bpython -m robot_client\.apps\.\w+)\s",
    r"export \w+=|\S*switchboard --data \S+ right grant ",
    r"curl ",
    r"pip install ",
)
"""What lines there are: programs, what is typed before one, what test_curl_examples.py runs, what brings programs."""


class Begun(NamedTuple):
    """How a program starts, by expressions.

    :param says: its output
    :param lacks: its output, with exit code 1, on a machine without the device it needs
    :param stays: whether it runs until it is ended
    """

    says: str
    lacks: str | None = None
    stays: bool = True


EXPECTED = {
    r"apps\.joystick ": Begun(r"no gamepad|\bbutton\b"),
    r"apps\.voice ": Begun("listening", "a microphone needs sounddevice|cannot use the microphone"),
    r"apps\.collision_avoidance ": Begun("READY"),
    r"apps\.recharge ": Begun("looking for marker 7"),
    r"apps\.greeting ": Begun("looking for people"),
    r"robot-service speech$": Begun("READY", "no program that plays sound is installed"),
    r"robot-service (?!speech$)\w+": Begun("READY"),
    r"robot-service --help$": Begun("Usage: ", stays=False),
}
"""By what stands in the command: each program is one of these, and each of these is shown."""


def lines(kind: str) -> list[Example]:
    """Lines of a kind."""
    return [each for each in SHOWN if re.match(kind, each.command, re.DOTALL)]


def expected(example: Example) -> list[str]:
    """The expectation for a program."""
    return [each for each in EXPECTED if re.search(each, example.command)]


def before(example: Example) -> list[Example]:
    """The lines that both documents have once before all others, and those just above the line."""
    above = SHOWN[SHOWN.index(example) - 1]
    return [each for each in lines(TYPED) if each.text.startswith("export ") or each == above]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    """One for all, with the preconditions of the documents."""
    with staged(tmp_path_factory.mktemp("programs"), camera=True) as made:
        people(made.folder / "people")
        (made.folder / "docs").symlink_to(ROOT / "docs")
        made.shell.environment.pop("SWITCHBOARD_TOKEN", None)
        yield made


def test_lines_are_run() -> None:
    """As exactly one kind, in any shell block; each expectation has a line."""
    fences = [re.findall(r"(?m)^ *(?:```|~~~)(.*)$", path.read_text()) for path in DOCUMENTS]
    assert {each for found in fences for each in found[::2]} == {"sh", "json"}
    found = {each.place: [kind for kind in KINDS if each in lines(kind)] for each in SHOWN}
    assert {place: len(kinds) for place, kinds in found.items()} == dict.fromkeys(found, 1)
    programs = lines(PROGRAM)
    assert {each.place: len(expected(each)) for each in programs} == {each.place: 1 for each in programs}
    assert set(EXPECTED) == {name for each in programs for name in expected(each)}
    typed = {line.place for each in programs for line in before(each)}
    assert typed == {each.place for each in lines(TYPED)}


@pytest.mark.parametrize("example", lines(PROGRAM), ids=lambda each: each.place)
def test_a_program_begins_and_ends(scene: Scene, example: Example) -> None:
    """It prints its start line, and Ctrl-C ends it with 0.

    The joystick waits for a gamepad if there is none, and prints so; without a microphone or a player voice
    and speech end with 1, and print the missing device. The receiver of gps is a recording, as in the
    document.
    """
    begun = EXPECTED[expected(example)[0]]
    words = scene.folder / "words"
    text = "\n".join(each.text for each in [*before(example), example])

    def enough(printed: str) -> bool:
        """A program without its device ends by itself."""
        return re.search(begun.says, printed + words.read_text(errors="replace")) is not None

    places = {"ROS_DOMAIN_ID=…": f"ROS_DOMAIN_ID={scene.robot.domain}"}
    came = scene.shell.run(Example(example.place, text), places, enough if begun.stays else None)
    said = came.output + came.words
    assert "Traceback" not in said
    if came.code == 1 and begun.lacks is not None:
        assert re.search(f"Error: .*({begun.lacks})", came.words), came
    else:
        assert (came.code, re.search(begun.says, said) is not None) == (0, True), came


@pytest.mark.parametrize(
    "page", [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))], ids=lambda page: page.stem
)
def test_installed_extras_exist(page: Path) -> None:
    """A page names only extras of our package."""
    named = {
        extra
        for asked in re.findall(r"robot-switchboard\[([\w,]+)\]", page.read_text())
        for extra in asked.split(",")
    }
    assert named <= set(metadata("robot-switchboard").get_all("Provides-Extra") or [])
