"""The commands by which docs/ start services and applications work as they stand, against a relay and a robot."""

from __future__ import annotations

import re
from collections.abc import Iterator
from importlib.metadata import metadata
from typing import NamedTuple

import pytest
from switchboard_examples import Example, examples
from switchboard_scene import ROOT, Scene, staged

from tests.robot_client.services.pictures_of_people import people

DOCUMENTS = [ROOT / "docs" / f"{name}.md" for name in ("apps", "services")]
SHOWN = [each for path in DOCUMENTS for each in examples(path)]
PROGRAM, TYPED, CURL, INSTALLS = KINDS = (
    r"(switchboard-robot-service|.*\bpython -m robot_client\.apps\.\w+)\s",
    r"export \w+=|\S*switchboard --data \S+ right grant ",
    r"curl ",
    r"pip install ",
)
"""What lines there are: programs, what is typed before one, what test_curl_examples.py runs, what brings programs."""


class Begun(NamedTuple):
    """How one begins, by expressions.

    :param says: what it says
    :param lacks: what it says instead, and ends with 1, where a machine has not the device it takes
    :param stays: whether it goes on until it is ended
    """

    says: str
    lacks: str | None = None
    stays: bool = True


EXPECTED = {
    r"apps\.joystick ": Begun(r"no gamepad|\bbutton\b"),
    r"apps\.voice ": Begun("listening", "a microphone takes sounddevice: pip|the microphone can't be used"),
    r"apps\.collision_avoidance ": Begun("READY"),
    r"apps\.recharge ": Begun("looking for marker 7"),
    r"apps\.greeting ": Begun("looking for people"),
    r"robot-service speech$": Begun("READY", "no program that plays sound is installed"),
    r"robot-service (?!speech$)\w+": Begun("READY"),
    r"robot-service --help$": Begun("Usage: ", stays=False),
}
"""By what stands in the command: each program is one of these, and each of these is shown."""


def lines(kind: str) -> list[Example]:
    """Those of a kind."""
    return [each for each in SHOWN if re.match(kind, each.command, re.DOTALL)]


def expected(example: Example) -> list[str]:
    """Which of them a program is."""
    return [each for each in EXPECTED if re.search(each, example.command)]


def before(example: Example) -> list[Example]:
    """The lines of both documents that are typed once, before all others, and what the document has just above."""
    above = SHOWN[SHOWN.index(example) - 1]
    return [each for each in lines(TYPED) if each.text.startswith("export ") or each == above]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    """One for all, with what the documents take to be there."""
    with staged(tmp_path_factory.mktemp("programs"), camera=True) as made:
        people(made.folder / "people")
        (made.folder / "docs").symlink_to(ROOT / "docs")
        made.shell.environment.pop("SWITCHBOARD_TOKEN", None)
        yield made


def test_each_line_is_run() -> None:
    """As just one thing, in whatever block of shell it stands; and nothing is expected of lines that are not there."""
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
    """It says what it says of itself, and Ctrl-C ends it with 0.

    The joystick waits for a gamepad where there is none, and says so; without a microphone or a player of sound voice
    and speech end with 1, and say what is missing. The receiver of gps is a recording, as the document has it.
    """
    begun = EXPECTED[expected(example)[0]]
    words = scene.folder / "words"
    text = "\n".join(each.text for each in [*before(example), example])

    def enough(printed: str) -> bool:
        """What lacks something ends by itself."""
        return re.search(begun.says, printed + words.read_text(errors="replace")) is not None

    places = {"ROS_DOMAIN_ID=…": f"ROS_DOMAIN_ID={scene.robot.domain}"}
    came = scene.shell.run(Example(example.place, text), places, enough if begun.stays else None)
    said = came.output + came.words
    assert "Traceback" not in said
    if came.code == 1 and begun.lacks is not None:
        assert re.search(f"Error: .*({begun.lacks})", came.words), came
    else:
        assert (came.code, re.search(begun.says, said) is not None) == (0, True), came


@pytest.mark.parametrize("example", lines(INSTALLS), ids=lambda each: each.place)
def test_what_is_to_be_installed_is_there_to_be_installed(example: Example) -> None:
    """The extras are those of our package."""
    (asked,) = re.findall(r"'\.\[([\w,]+)\]'", example.command)
    assert set(asked.split(",")) <= set(metadata("robot-switchboard").get_all("Provides-Extra") or [])
