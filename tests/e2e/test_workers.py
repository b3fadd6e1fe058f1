"""``switchboard serve --workers 2`` with PostgreSQL and NATS: two relay processes behind one address."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx
import psutil
import pytest

from relay_server.cli.admin_socket_client import ask_status, send_order
from relay_server.cluster.workers import data_of
from tests.worlds.nats_servers import nats_server
from tests.worlds.postgresql_server import postgresql_database
from tests.worlds.relay_process import Relay
from tests.worlds.small_robot import SmallRobot
from tests.worlds.waiting import PATIENCE, wait_for

COUNT = 2


def say(robot: SmallRobot, arguments: Any) -> dict[str, Any]:
    """Calls the service ``/say``."""
    return {"success": True, "message": robot.name}


class Workers(Relay):
    """A relay of two workers."""

    def state_of(self, robot: str) -> str:
        """The state of a robot by the worker that it is connected to; ``offline`` if it is connected to none."""
        for worker in range(1, COUNT + 1):
            for each in ask_status(data_of(worker, self.data))["robots"]:
                if each["name"] == robot and each["state"] != "offline":
                    return str(each["state"])
        return "offline"

    def load(self, worker: int) -> dict[str, Any]:
        """The figures of a worker, by itself."""
        state = send_order(data_of(worker, self.data), "cluster", {})
        return dict(next(each["load"] for each in state["relays"] if each["own"]))


class Scene:
    """A relay of two workers, a robot at each of them, and their owner ann.

    :ivar robots: by the number of their worker
    :ivar token: of ann
    """

    def __init__(self, folder: Path, bus: str, database: str, stack: ExitStack) -> None:
        self.relay = Workers(folder, "--workers", str(COUNT), "--cluster-bus", bus, database=database)
        stack.callback(self.relay.stop)
        self.token = self.relay.user("ann")
        self.robots: dict[int, SmallRobot] = {}
        # The kernel chooses the worker by the address of the robot.
        for number in range(1, 50):
            robot = SmallRobot(self.relay, f"r{number}", {"/say": say}, source=f"127.0.0.{number}")
            self.relay.cli("right", "grant", "ann", robot.name, "owner")
            before = self.counts()
            robot.comes()
            stack.callback(robot.goes)
            home = 1 + next(
                n for n, (old, new) in enumerate(zip(before, self.counts(), strict=True)) if new > old
            )
            if self.robots.setdefault(home, robot) is not robot:
                robot.goes()
                wait_for("it is gone", lambda before=before: self.counts() == before)
            if len(self.robots) == COUNT:
                break
        wait_for("both workers know both robots", self.settled)

    def counts(self) -> list[int]:
        """Connected robots of each worker."""
        return [self.relay.load(worker)["robots"] for worker in range(1, COUNT + 1)]

    def settled(self) -> bool:
        """Whether both workers know the home of each robot, and reach its service."""
        for worker in range(1, COUNT + 1):
            state = send_order(data_of(worker, self.relay.data), "cluster", {})
            if [each["homes"] for each in state["relays"] if each["state"] == "ready"] != [1] * COUNT:
                return False
        for robot in self.robots.values():
            with self.relay.connect(robot.name, self.token) as client:
                if not client.call("/say")["result"]:
                    return False
        return True

    def calls(self, robot: SmallRobot) -> None:
        """Calls the robot's service over a websocket, which any worker may serve."""
        with self.relay.connect(robot.name, self.token) as client:
            assert client.call("/say")["values"] == {"success": True, "message": robot.name}


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    folder = tmp_path_factory.mktemp("workers")
    with ExitStack() as stack:
        bus = stack.enter_context(nats_server(folder))
        database = stack.enter_context(postgresql_database())
        yield Scene(folder, bus.url, database, stack)


def test_clients_reach_the_robots_of_all_workers(scene: Scene) -> None:
    """Over websockets and HTTP, several times, as any worker may accept the connection."""
    for robot in scene.robots.values():
        for _ in range(4):
            scene.calls(robot)
            url = f"http://127.0.0.1:{scene.relay.http_port}/api/v1/robots/{robot.name}/services/say"
            headers = {"Authorization": f"Bearer {scene.token}"}
            answer = httpx.post(url, headers=headers, json={}, timeout=PATIENCE)
            assert answer.json()["values"]["message"] == robot.name
    state = scene.relay.cli("cluster", "status")
    assert [each["state"] for each in state["relays"]] == ["ready"] * COUNT
    assert [each["load"]["robots"] for each in state["relays"]] == [1] * COUNT


def test_a_stop_from_the_command_line_reaches_the_robot_of_another_worker(scene: Scene) -> None:
    robot = scene.robots[2]
    scene.relay.run_cli("stop", robot.name)
    wait_for("it is stopped", lambda: robot.stopped is not None)


def test_workers_are_not_drained_to_each_other(scene: Scene) -> None:
    """Their robots could not connect to another one."""
    done = scene.relay.run_cli("drain")
    assert done.returncode != 0
    assert "no other relay" in done.stderr


def test_a_worker_that_dies_is_started_again(scene: Scene) -> None:
    """Its robot connects to it again; that of the other worker stays connected."""
    assert scene.relay.process is not None
    supervisor = psutil.Process(scene.relay.process.popen.pid)
    died, other = scene.robots[2], scene.robots[1]
    links = list(other._links)
    sockets = {
        each.pid: each
        for each in supervisor.children()
        if any(str(data_of(2, scene.relay.data)) in str(file.laddr) for file in each.net_connections("unix"))
    }
    (worker,) = sockets.values()
    worker.send_signal(signal.SIGKILL)
    wait_for("it is gone", lambda: not worker.is_running())
    died.goes()
    died.comes()
    wait_for("both workers know its home", scene.settled)
    for robot in (died, other):
        scene.calls(robot)
    assert other._links[: len(links)] == links
    assert len(supervisor.children()) == COUNT
    assert "worker 2 has ended" in scene.relay.log
    assert "worker 2: " in scene.relay.log


def test_all_workers_end_with_the_relay(scene: Scene) -> None:
    assert scene.relay.process is not None
    workers = psutil.Process(scene.relay.process.popen.pid).children()
    assert scene.relay.process.stop() == 0
    assert not any(each.is_running() for each in workers)
