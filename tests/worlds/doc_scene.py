"""The world of the documents' examples: a relay with the demo's robot-one and its user driver."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from tests.robot_client.ros import Peer
from tests.worlds.doc_examples import Shell, examples
from tests.worlds.http_requests import ask
from tests.worlds.processes import BIN, ros_environment, running
from tests.worlds.relay_process import Relay
from tests.worlds.robot_process import Robot
from tests.worlds.waiting import wait_for

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
GUIDES = [
    ROOT / f"docs/guides/{name}.md"
    for name in ("connect", "tokens", "cameras", "record", "service_registry", "http")
]
"""These and the README set variables that examples use."""
PAGES = sorted(path for path in (ROOT / "docs").rglob("*.md") if path.name != "tutorial.md")
"""The tutorial has a world of its own: tests/e2e/test_tutorial.py."""
DOCUMENTS = [README, *PAGES, *sorted((ROOT / "protocol" / "spec").glob("*.md"))]
"""Whose examples are run."""

ROBOT = "/api/v1/robots/robot-one"
DIRECTORY = "/api/v1/directory"


@dataclass
class Scene:
    """A relay, its robot, and the examples' folder, with the variables that README.md and guides set."""

    relay: Relay
    robot: Robot
    shell: Shell

    @property
    def folder(self) -> Path:
        """The folder in which examples run."""
        return self.shell.folder

    @property
    def token(self) -> str:
        """The driver's token, used by the examples."""
        return self.shell.environment["TOKEN"]

    def ask(self, method: str, path: str, body: Any = None) -> Any:
        """A request of the driver, by the examples' own token; returns the content."""
        answer = ask(self.relay.http_port, method, path, body, token=self.token)
        assert answer.status < 300, answer.body
        return answer.json if answer.body else None

    def wait_until_known(self, used: dict[str, set[str]]) -> None:
        """Waits until the relay knows the robot's names in examples.

        :param used: names by kind: ``topics``, ``services``, ``actions``, ``cameras``
        """
        for part, names in used.items():
            wait_for(f"the relay knows the robot's {part}", partial(self._knows, part, names))

    def _knows(self, part: str, names: set[str]) -> bool:
        return names <= {each["name"] for each in self.ask("GET", f"{ROBOT}/{part}?limit=1000")[part]}


@contextmanager
def staged(folder: Path, *options: str, camera: bool = False, settings: str = "") -> Iterator[Scene]:
    """A scene with an action beside those of the demo's robot.

    :param folder: for the output of all processes
    :param options: further ones of ``switchboard serve``
    :param camera: whether the robot has one
    :param settings: further ones of its daemon
    """
    with ExitStack() as stack:
        relay = Relay(folder, *options)
        stack.enter_context(running(relay))
        robot = Robot(relay, "robot-one", camera=camera, settings=settings)
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
        settings = (each for path in (README, *GUIDES) for each in examples(path))
        shell.set([each for each in settings if each.sets and not each.asks])
        yield Scene(relay, robot, shell)
