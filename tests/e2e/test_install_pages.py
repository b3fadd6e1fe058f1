"""The commands of docs/operate/install.md, tls.md, backup.md and upgrade.md run literally, in their order.

Not those that change the machine. The name in the documents is that in the certificate; there is no such host.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.worlds.doc_examples import examples
from tests.worlds.empty_database import write_empty_database
from tests.worlds.processes import Process
from tests.worlds.terminals import Terminals
from tests.worlds.waiting import wait_for

PAGES = Path(__file__).parents[2] / "docs/operate"
STAYS = r"switchboard serve |switchboard-robot run "
"""Programs that run until they are ended."""
NOT_RUN = (
    r"python3 -m venv|export PATH=|pip install |source |pg_dump|systemctl|useradd|install -|chown|runuser|echo |"
    r"(cp|mv) .*(/etc|/var)/"
)
"""What installs packages and changes the machine."""
NAME = "robots.example.org"


class Reader:
    """Follows the documents.

    :ivar relay: the last relay that was started
    """

    def __init__(self, terminals: Terminals) -> None:
        self.terminals = terminals
        self.relay: Process | None = None
        self._code = ""

    def follow(self, page: str, only: str = "") -> None:
        """Run the commands of a page.

        :param only: those that begin with it
        """
        for each in examples(PAGES / f"{page}.md"):
            if re.match(only, each.command) and not re.match(NOT_RUN, each.command):
                self._follow(each.command)

    def _follow(self, command: str) -> None:
        if not re.match(STAYS, command):
            typed = self._code if "enroll" in command else "correct horse\n" * 2
            printed = self.terminals.run(command, typed)
            if found := re.search(r"Enrolment code: (\S+)", printed):
                self._code = found[1]
            return
        if " serve " in command and self.relay is not None:
            assert self.relay.stop() == 0
        process = self.terminals.start(command)
        if " serve " in command:
            self.relay = process
            http, robots = re.findall(r"=(\d+)", process.wait_to_say("READY"))
            self.terminals.places |= {
                "0.0.0.0:9090": f"127.0.0.1:{http}",
                "0.0.0.0:9091": f"127.0.0.1:{robots}",
                f"{NAME}:9091": f"127.0.0.1:{robots} --server-name {NAME}",
            }

    def wait_online(self, data: str) -> None:
        """The robot of the documents is online at the relay with this data folder."""
        command = f"switchboard --data {data} status"
        wait_for("the robot is online", lambda: "online" in self.terminals.run(command))


@pytest.fixture
def reader(tmp_path: Path) -> Iterator[Reader]:
    """A reader in an empty folder, but for an empty database, which takes seconds to make."""
    write_empty_database(tmp_path / "relay-data/switchboard.db")
    with ExitStack() as stack:
        yield Reader(
            Terminals(tmp_path, stack, {"0.0.0.0:9090": "127.0.0.1:0", "0.0.0.0:9091": "127.0.0.1:0"})
        )


def test_robot_is_online_by_tls_and_again_at_a_restored_relay(reader: Reader) -> None:
    reader.follow("tls", only="openssl ")
    reader.follow("install")
    reader.wait_online("relay-data")
    reader.follow("backup")
    reader.wait_online("restored-data")
    reader.follow("upgrade")
