"""The commands by which docs/ start services and applications work as they stand, against a relay and a robot."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import NamedTuple

import pytest
from switchboard_examples import Example, examples
from switchboard_scene import ROOT, Scene, staged

from tests.robot_client.services.pictures_of_people import people

SHOWN = [each for name in ("apps", "services") for each in examples(ROOT / "docs" / f"{name}.md")]
STARTS = re.compile(r"switchboard-robot-service (?!--help)|robot_client\.apps\.")
PROGRAMS = [each for each in SHOWN if STARTS.search(each.command)]


class Begun(NamedTuple):
    """How one begins.

    :param says: what it prints
    :param lacks: what it says instead, and ends with 1, where a machine has not the device it takes
    """

    says: str
    lacks: str = "nothing"


EXPECTED = {
    r"apps\.joystick ": Begun("no gamepad"),
    r"apps\.voice ": Begun("listening", "a microphone takes"),
    r"apps\.runaway ": Begun("READY"),
    r"apps\.recharge ": Begun("looking for marker 7"),
    r"apps\.greeting ": Begun("looking for people"),
    r"robot-service speech$": Begun("READY", "no program that plays sound"),
    r"robot-service \w+": Begun("READY"),
}
"""By what stands in the command."""


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    """One for all, with what the documents take to be there."""
    with staged(tmp_path_factory.mktemp("programs"), camera=True) as made:
        people(made.folder / "people")
        (made.folder / "docs").symlink_to(ROOT / "docs")
        made.shell.environment.pop("SWITCHBOARD_TOKEN", None)
        yield made


def before(example: Example) -> list[Example]:
    """The lines of both documents that are typed once, before all others, and what the document has just above."""
    settings = [each for each in SHOWN if each.text.startswith("export ")]
    place = SHOWN.index(example) - 1
    above = SHOWN[place]
    return [*settings, above] if re.match(r"\S*switchboard --data .* right grant", above.text) else settings


@pytest.mark.parametrize("example", PROGRAMS, ids=lambda each: each.place)
def test_what_is_shown_begins_and_ends(scene: Scene, example: Example) -> None:
    """It says what it says of itself, and Ctrl-C ends it; what it lacks here is told in words."""
    begun = next(found for pattern, found in EXPECTED.items() if re.search(pattern, example.command))
    words = scene.folder / "words"
    text = "\n".join([*(each.command for each in before(example)), example.command])
    came = scene.shell.run(
        Example(example.place, text),
        {"ROS_DOMAIN_ID=…": f"ROS_DOMAIN_ID={scene.robot.domain}"},
        # What lacks something ends by itself.
        lambda printed: begun.says in printed + words.read_text(errors="replace"),
    )
    said = came.output + came.words
    assert (begun.says in said, came.code) == (True, 0) or (begun.lacks in said, came.code) == (True, 1), came
    assert "Traceback" not in said
