"""The nodes of ``ros2 launch``, as its output reports them."""

from __future__ import annotations

import re

NODES = 100
"""Most nodes that are followed; those of a launch file beyond it are not."""

_STARTED = re.compile(r"(?:\x1b\[[\d;]*m)?\[INFO\] \[([^\]]{1,200})\]: process started with pid \[(\d+)\]")
_DIED = re.compile(
    r"(?:\x1b\[[\d;]*m)?\[ERROR\] \[([^\]]{1,200})\]: process has died \[pid (\d+), exit code (-?\d+)"
)
_FINISHED = re.compile(r"(?:\x1b\[[\d;]*m)?\[INFO\] \[([^\]]{1,200})\]: process has finished cleanly")

_NOT_LAUNCHED = re.compile(
    r"(?:\x1b\[[\d;]*m)?(?:"
    r"\[ERROR\] \[launch\]: Caught exception in launch \(see debug for traceback\): (?P<exception>.+?)"
    r"|(?P<error>(?:Package '[^']*' not found|file '[^']*' was |malformed launch argument ).*?)"
    r")(?:\x1b\[0m)?\Z"
)

ERROR_CHARACTERS = 300
"""Most of an error of ``ros2 launch`` that is shown; one of a missing package lists all folders."""


def launch_error(line: str) -> str:
    """What ``ros2 launch`` says in this line of its output when it can't carry out a launch file; empty for others."""
    found = _NOT_LAUNCHED.match(line)
    return (found["exception"] or found["error"])[:ERROR_CHARACTERS] if found else ""


class LaunchedNodes:
    """Nodes of one launch file.

    :ivar running: process ids by name
    :ivar dead: exit codes by name, of nodes that have died and were not started again
    """

    def __init__(self) -> None:
        self.running: dict[str, int] = {}
        self.dead: dict[str, int] = {}

    def received(self, line: str) -> bool:
        """Take in a line of the output.

        :returns: whether :attr:`dead` has changed
        """
        if found := _STARTED.match(line):
            if len(self.running) < NODES:
                self.running[found[1]] = int(found[2])
            return self.dead.pop(found[1], None) is not None
        if found := _DIED.match(line):
            self.running.pop(found[1], None)
            if len(self.dead) < NODES:
                self.dead[found[1]] = int(found[3])
            return True
        if found := _FINISHED.match(line):
            self.running.pop(found[1], None)
        return False
