"""The commands and the program of docs/tutorial.md run literally, in their order."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.worlds.doc_examples import examples, programs
from tests.worlds.empty_database import write_empty_database
from tests.worlds.terminals import Terminals
from tests.worlds.waiting import wait_for

TUTORIAL = Path(__file__).parents[2] / "docs/tutorial.md"
STAYS = r"switchboard serve |switchboard-sim$|switchboard-robot run "
"""Programs that run until they are ended."""
NOT_RUN = r"make web$|export PATH=|pip install "
"""Set-up, which the tests have."""
STATUS = "switchboard --data relay-data status"


@pytest.fixture
def terminals(tmp_path: Path) -> Iterator[Terminals]:
    """Terminals in an empty folder, but for an empty database, which takes seconds to make."""
    write_empty_database(tmp_path / "relay-data/switchboard.db")
    with ExitStack() as stack:
        yield Terminals(tmp_path, stack, {"127.0.0.1:9090": "127.0.0.1:0", "127.0.0.1:9091": "127.0.0.1:0"})


def test_tutorial_ends_with_a_driven_and_stopped_robot(tmp_path: Path, terminals: Terminals) -> None:
    (program,) = programs(TUTORIAL)
    printed: list[str] = []
    code = ""
    for command in (each.command for each in examples(TUTORIAL) if not re.match(NOT_RUN, each.command)):
        if re.match(STAYS, command):
            process = terminals.start(command)
            if " serve " in command:
                ports = re.findall(r"=(\d+)", process.wait_to_say("READY"))
                terminals.places = dict(
                    zip(terminals.places, (f"127.0.0.1:{each}" for each in ports), strict=True)
                )
            continue
        if "drive.py" in command:
            (tmp_path / "drive.py").write_text(terminals.here(program.text))
            wait_for("the robot's wheels are known", lambda: "online" in terminals.run(STATUS))
        printed.append(terminals.run(command, code))
        if found := re.search(r"Enrolment code: (\S+)", printed[-1]):
            code = found[1]
    (driven,) = re.findall(r"driven: (\S+) m", "".join(printed))
    assert float(driven) >= 0.3
