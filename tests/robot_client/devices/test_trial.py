"""Classes of modules, run on the command line."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.worlds.waiting import PATIENCE

CLASS = """
from robot_client.devices import Module

class Gripper(Module):
    def __init__(self, width):
        self.width = width

    def handle(self, command):
        if command > self.width:
            raise ValueError(f"it opens {self.width} mm at most")
        self.feedback({"width": command, "stopped": self.stopped})

    def stop(self):
        print("stopped")
"""


def trial(folder: Path, *arguments: str) -> subprocess.Popen[str]:
    (folder / "gripper.py").write_text(CLASS)
    command = [sys.executable, "-m", "robot_client.devices.trial", *arguments]
    pipe = subprocess.PIPE
    environment = {"PYTHONPATH": ":".join(filter(None, [*sys.path, str(folder)]))}
    return subprocess.Popen(
        command, cwd=folder, env=environment, stdin=pipe, stdout=pipe, stderr=pipe, text=True
    )


def test_commands_of_a_pipe_are_answered_before_it_ends(tmp_path: Path) -> None:
    with trial(tmp_path, "gripper:Gripper", json.dumps({"width": 80})) as made:
        out, err = made.communicate("50\n\nwide\n90\n", timeout=PATIENCE)
    assert made.returncode == 0, err
    assert out.count("not JSON") == 1
    assert "answer: done" in out
    assert "answer: it opens 80 mm at most" in out


def test_settings_that_are_not_json_are_refused_in_words(tmp_path: Path) -> None:
    with trial(tmp_path, "gripper:Gripper", "{port: 1}") as made:
        _, err = made.communicate(timeout=PATIENCE)
    assert (made.returncode, err.startswith("the settings are not JSON: ")) == (1, True)


@pytest.mark.parametrize("by_signal", [False, True])
def test_a_class_takes_commands_until_the_input_ends_or_a_signal(tmp_path: Path, by_signal: bool) -> None:
    with trial(tmp_path, "gripper:Gripper", json.dumps({"width": 80})) as made:
        assert made.stdin is not None
        assert made.stdout is not None
        assert made.stdout.readline() + made.stdout.readline() == "\nREADY\n"
        made.stdin.write("wide\n")
        made.stdin.flush()
        assert "not JSON" in made.stdout.readline()
        made.stdin.write("50\n90\n")
        made.stdin.flush()
        assert {made.stdout.readline().strip() for _ in range(3)} == {
            'feedback: {"width": 50, "stopped": false}',
            "answer: done",
            "answer: it opens 80 mm at most",
        }
        if by_signal:
            (child,) = Path(f"/proc/{made.pid}/task/{made.pid}/children").read_text().split()
            subprocess.run(["kill", "-INT", child, str(made.pid)], check=True)
        else:
            made.stdin.close()
        assert made.stdout.read() == "stopped\n"
        assert made.wait(PATIENCE) == 0


def test_a_wrong_class_is_named(tmp_path: Path) -> None:
    with trial(tmp_path, "gripper:Missing") as made:
        assert made.wait(PATIENCE) == 1
        assert made.stderr is not None
        assert "gripper has no class 'Missing'" in made.stderr.read()
