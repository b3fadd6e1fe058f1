"""A daemon with only modules, as a process: states as lines on stdout, orders as lines on stdin.

Run as ``python -m tests.worlds.module_daemon FOLDER SETTINGS`` (JSON).
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

import msgspec
from twisted.internet import reactor as default_reactor
from twisted.internet.defer import Deferred, succeed
from twisted.internet.stdio import StandardIO
from twisted.protocols.basic import LineReceiver

from relay_protocol import link
from robot_client.modules.settings import ModuleSettings, check_modules
from robot_client.modules.supervisor import ModuleSupervisor, SupervisedModule
from robot_client.platforms.base import GraphView

reactor: Any = default_reactor


class Orders(LineReceiver):
    """Reads ``{"do": "start", "name": "base"}`` or ``{"do": "say why"}``; the end of stdin shuts the daemon down."""

    delimiter = b"\n"

    def __init__(self, supervisor: ModuleSupervisor) -> None:
        self._supervisor = supervisor

    def lineReceived(self, line: bytes) -> None:
        order = json.loads(line)
        if order["do"] == "resume the robot":
            self._supervisor.robot_stopped(False)
            return
        if order["do"] == "say why":
            runners = {each.name: each.runner_pid for each in self._supervisor}
            say({"why": {each.name: each.why for each in self._supervisor}, "runners": runners})
            return
        getattr(self._supervisor[order["name"]], order["do"])()

    def connectionLost(self, reason: Any = None) -> None:
        self._supervisor.stop().addBoth(lambda _: reactor.stop())


class FolderGraph:
    """A graph with the topic /scan, the service /map and the lifecycle node /arm.

    For files of these names in a folder the topic has publishers, the service has servers, the node is active. Each
    line of a file is the id of a publisher or server; an empty file has one line.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def graph(self) -> GraphView:
        return GraphView(services={"/arm/get_state": link.Service(types=["lifecycle_msgs/srv/GetState"])})

    def endpoints(self, name: str, kind: str) -> frozenset[bytes]:
        path = self._folder / name.removeprefix("/")
        return frozenset(path.read_bytes().split(b"\n")) if path.exists() else frozenset()

    def call(
        self, service: str, type: str, request: bytes, timeout: float, check: Any = None
    ) -> Deferred[bytes]:
        inactive, active = b"\0\1\0\0\2", b"\0\1\0\0\3"
        return succeed(active if (self._folder / "arm").exists() else inactive)


def say(what: dict[str, Any]) -> None:
    sys.stderr.write(json.dumps(what) + "\n")
    sys.stderr.flush()


def main() -> None:
    folder = Path(sys.argv[1])
    settings = msgspec.json.decode(sys.argv[2], type=list[ModuleSettings])
    check_modules(settings)

    def alert(level: str, text: str, kind: str = "", about: str = "", over: bool = False) -> None:
        say({"alert": text, "about": about, "over": over})

    supervisor = ModuleSupervisor(
        settings,
        folder,
        reactor=reactor,
        environment=os.environ,
        graph=FolderGraph(folder),
        alert=alert,
        boot=os.environ["BOOT"],
    )

    def changed(module: SupervisedModule) -> None:
        say({"name": module.name, "state": module.state.value, "pid": module.pid, "exit": module.last_exit})

    supervisor.on_change(changed)
    supervisor.start()
    StandardIO(Orders(supervisor))
    reactor.run()


if __name__ == "__main__":
    main()
