"""Nodes of a launch file, by its output."""

from __future__ import annotations

import pytest

from robot_client.modules.launched_nodes import NODES, LaunchedNodes, launch_error

STARTED = "[INFO] [a-1]: process started with pid [7]"
DIED = "[ERROR] [a-1]: process has died [pid 7, exit code -9, cmd '/opt/a --x']."
FINISHED = "[INFO] [a-1]: process has finished cleanly [pid 7]"


@pytest.mark.parametrize(
    ("lines", "running", "dead"),
    [
        ([STARTED], {"a-1": 7}, {}),
        ([STARTED, FINISHED], {}, {}),
        ([STARTED, DIED], {}, {"a-1": -9}),
        ([f"\x1b[31m{DIED}\x1b[0m"], {}, {"a-1": -9}),
        ([STARTED, DIED, STARTED], {"a-1": 7}, {}),
        (["[a-1] " + DIED, "[a-1] " + STARTED, "process has died"], {}, {}),
    ],
    ids=["started", "finished", "died", "in colour", "respawned", "text of a node"],
)
def test_nodes_follow_the_output(lines: list[str], running: dict[str, int], dead: dict[str, int]) -> None:
    nodes = LaunchedNodes()
    for line in lines:
        before = dict(nodes.dead)
        assert nodes.received(line) is (before != nodes.dead)
    assert (nodes.running, nodes.dead) == (running, dead)


def test_nodes_are_bounded() -> None:
    nodes = LaunchedNodes()
    for number in range(2 * NODES):
        nodes.received(STARTED.replace("a-1", f"a-{number}"))
        nodes.received(DIED.replace("a-1", f"b-{number}"))
    assert (len(nodes.running), len(nodes.dead)) == (NODES, NODES)


@pytest.mark.parametrize(
    ("line", "error"),
    [
        (
            "Package 'lidar' not found: \"package 'lidar' not found\"",
            "Package 'lidar' not found: \"package 'lidar' not found\"",
        ),
        (
            "file 'a.py' was not found in the share directory of package 'lidar' which is at '/opt'",
            "file 'a.py' was not found in the share directory of package 'lidar' which is at '/opt'",
        ),
        ("malformed launch argument 'a', expected format", "malformed launch argument 'a', expected format"),
        (
            "\x1b[31m[ERROR] [launch]: Caught exception in launch (see debug for traceback): no executable\x1b[0m",
            "no executable",
        ),
        ("[a-1] Package 'lidar' not found", ""),
        ("[INFO] [launch]: Default logging verbosity is set to INFO", ""),
    ],
)
def test_error_of_ros2_launch_is_found(line: str, error: str) -> None:
    assert launch_error(line) == error
