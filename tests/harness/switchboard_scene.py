"""What the documents' examples meet: a relay with the demo's robot-one and its user driver."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from switchboard_examples import Shell, examples
from switchboard_http import ask
from switchboard_processes import BIN, ros_environment, running
from switchboard_relay import Relay
from switchboard_robot import Robot
from switchboard_waiting import wait_for

from tests.robot_client.ros import Peer

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
GUIDE = ROOT / "docs" / "http.md"
DOCUMENTS = [README, *sorted((ROOT / "docs").glob("*.md")), ROOT / "protocol" / "SPEC.md"]
"""Whose examples are run."""

ROBOT = "/api/v1/robots/robot-one"
DIRECTORY = "/api/v1/directory"


@dataclass
class Scene:
    """A relay, its robot, and where examples run, with the variables that README.md and docs/http.md set."""

    relay: Relay
    robot: Robot
    shell: Shell

    @property
    def folder(self) -> Path:
        """Where examples run."""
        return self.shell.folder

    @property
    def token(self) -> str:
        """The driver's, the examples' own."""
        return self.shell.environment["TOKEN"]

    def ask(self, method: str, path: str, body: Any = None) -> Any:
        """A request of the driver's, by the examples' own token; what it gave."""
        answer = ask(self.relay.http_port, method, path, body, token=self.token)
        assert answer.status < 300, answer.body
        return answer.json if answer.body else None

    def wait_until_known(self, used: dict[str, set[str]]) -> None:
        """Wait until the relay knows what examples use of the robot.

        :param used: names by what they are: ``topics``, ``services``, ``actions``, ``cameras``
        """
        for part, names in used.items():
            wait_for(f"the relay knows the robot's {part}", partial(self._knows, part, names))

    def _knows(self, part: str, names: set[str]) -> bool:
        return names <= {each["name"] for each in self.ask("GET", f"{ROBOT}/{part}?limit=1000")[part]}


@contextmanager
def staged(folder: Path, *options: str, camera: bool = False) -> Iterator[Scene]:
    """A scene, with an action beside what the demo's robot has.

    :param folder: where all of its processes leave what they do
    :param options: further ones of ``switchboard serve``
    :param camera: whether the robot has one
    """
    with ExitStack() as stack:
        relay = Relay(folder, *options)
        stack.enter_context(running(relay))
        robot = Robot(relay, "robot-one", camera=camera)
        stack.enter_context(running(robot))
        relay.user("driver")
        relay.cli("right", "grant", "driver", "robot-one", "operator")
        peer = Peer(ros_environment(robot.domain))
        stack.callback(peer.close)
        peer.do("act", "/fibonacci", "ok")
        place = folder / "shell"
        place.mkdir()
        # The documents' own names, in the folder of the checkout.
        (place / ".venv").symlink_to(BIN.parent)
        (place / "demo-data").symlink_to(relay.data)
        shell = Shell(place, os.environ, {"127.0.0.1:9090": f"127.0.0.1:{relay.http_port}"})
        settings = (each for path in (README, GUIDE) for each in examples(path))
        shell.set([each for each in settings if each.sets and not each.asks])
        yield Scene(relay, robot, shell)
