"""Requests about modules to a robot on a link in memory, and measurements shared by several clients."""

from __future__ import annotations

import os
from typing import Any

import msgspec
import pytest
from twisted.internet.defer import Deferred
from twisted.python.failure import Failure

from relay_protocol import link
from relay_protocol.errors import Unavailable
from relay_server.modules import robot_modules as module
from relay_server.modules.cpu_shares import CpuShares
from relay_server.modules.robot_modules import NotOrdered, RobotModules
from relay_server.modules.schemas import LogQuery
from robot_client.modules import process_table
from robot_client.modules.process_table import ProcessTable
from robot_client.modules.processes import ProcessStat
from tests.worlds.relay import World

BASE = link.ModuleInfo(name="base", kind="command", state="running")


@pytest.fixture
def modules(world: World) -> RobotModules:
    world.robot_comes(["json"])
    found = world.modules.of(world.robot)
    found.message_received(link.Modules(modules=[BASE]))
    return found


def outcome(answer: Deferred[Any]) -> list[Any]:
    found: list[Any] = []
    answer.addBoth(lambda value: found.append(value.value if isinstance(value, Failure) else value))
    return found


def asked(world: World, kind: type[Any]) -> list[Any]:
    return [each for each in world.control.said if isinstance(each, kind)]


def answer(world: World, modules: RobotModules, at: float = 0.0) -> None:
    """Answers the latest measurement."""
    modules.message_received(link.Processes(request=asked(world, link.MeasureProcesses)[-1].request, at=at))


def test_an_order_ends_with_the_robots_answer(world: World, modules: RobotModules) -> None:
    accepted, refused = outcome(modules.order("base", "stop")), outcome(modules.order("base", "start"))
    first, second = asked(world, link.OrderModule)
    assert (first.module, first.action, second.action) == ("base", "stop", "start")
    modules.message_received(link.ModuleOrdered(request=second.request, error="it is locked"))
    modules.message_received(link.ModuleOrdered(request=first.request))
    assert accepted == [link.ModuleOrdered(request=first.request)]
    assert isinstance(refused[0], NotOrdered)
    assert "it is locked" in str(refused[0])
    # A repeated answer, or one without a request, has no effect.
    modules.message_received(link.ModuleOrdered(request=first.request))


def test_changes_are_events_and_a_crash_has_its_reason(world: World) -> None:
    events: list[dict[str, Any]] = []
    world.bus.subscribe(lambda event: events.append(event.data))
    world.robot_comes(["json"])
    robot = world.modules.of(world.robot)
    for state, last_exit in [
        ("running", ""),
        ("backing_off", "exit code 3"),
        ("starting", "exit code 3"),
        ("running", "exit code 3"),
        ("failed", "exit code 4"),
    ]:
        changed = msgspec.structs.replace(BASE, state=state, last_exit=last_exit)
        robot.message_received(link.Modules(modules=[changed]))
    assert [(each["state"], each["why"]) for each in events if "state" in each] == [
        ("backing_off", "exit code 3"),
        ("running", ""),
        ("failed", "exit code 4"),
    ]


def test_an_answer_that_does_not_come_is_not_waited_for(world: World, modules: RobotModules) -> None:
    found = outcome(modules.read_log("base", LogQuery(wait=20.0)))
    world.clock.advance(20.0 + module.ANSWER_SECONDS - 0.1)
    assert found == []
    world.clock.advance(0.2)
    assert isinstance(found[0], Unavailable)


def test_requests_end_with_the_link(world: World, modules: RobotModules) -> None:
    found = outcome(modules.order("base", "stop"))
    world.robot_goes()
    assert "lost its connection" in str(found[0])
    assert modules.modules == (BASE,)
    assert "is offline" in str(outcome(modules.order("base", "stop"))[0])


def test_a_robot_that_reports_no_modules_is_not_asked(world: World) -> None:
    world.robot_comes(["json"])
    modules = world.modules.of(world.robot)
    assert "has reported no modules" in str(outcome(modules.measure())[0])
    assert asked(world, link.MeasureProcesses) == []


def test_requests_to_one_robot_are_bounded(world: World, modules: RobotModules) -> None:
    for _ in range(module.MAX_PENDING):
        outcome(modules.measure())
    assert "requests to answer already" in str(outcome(modules.measure())[0])


def test_watches_share_measurements_at_the_shortest_interval(world: World, modules: RobotModules) -> None:
    fast: list[float] = []
    slow: list[float] = []
    end_fast = modules.watch(0.5, lambda found: fast.append(found.at))
    end_slow = modules.watch(2.0, lambda found: slow.append(found.at))
    for number in range(9):
        world.clock.advance(0)
        answer(world, modules, float(number))
        world.clock.advance(0.5)
    assert fast == [float(number) for number in range(9)]
    assert slow == [0.0, 4.0, 8.0]
    end_fast()
    end_slow()
    world.clock.advance(0)
    answer(world, modules)
    before = len(asked(world, link.MeasureProcesses))
    world.clock.advance(60)
    assert len(asked(world, link.MeasureProcesses)) == before


def test_each_watch_gets_the_share_of_a_cpu_over_its_own_interval(
    world: World, modules: RobotModules, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a process that is busy in the first of each five seconds, as ``/proc`` shows it: 20 % of a CPU."""
    began = world.clock.seconds()

    def stat(pid: int) -> ProcessStat:
        cycles, rest = divmod(world.clock.seconds() - began, 5.0)
        ticks = round((cycles + min(rest, 1.0)) * os.sysconf("SC_CLK_TCK"))
        return ProcessStat("base", "S", 1, pid, ticks, nice=0, threads=1, started=100, pages=10, cpu_number=0)

    monkeypatch.setattr(process_table, "read_stat", stat)
    monkeypatch.setattr(process_table, "read_file", lambda pid, name: b"")
    monkeypatch.setattr(process_table, "children_by_parent", lambda zombies: {})
    table = ProcessTable(wall=lambda: 1e9 + world.clock.seconds(), uptime=world.clock.seconds)
    fast, slow = list[float | None](), list[float | None]()
    modules.watch(0.1, lambda found: fast.append(found.processes[0].cpu))
    modules.watch(5.0, lambda found: slow.append(found.processes[0].cpu))
    for _ in range(101):
        world.clock.advance(0)
        request = asked(world, link.MeasureProcesses)[-1].request
        modules.message_received(
            link.Processes(request=request, at=0.0, processes=table.measure({7: "base"})[0])
        )
        world.clock.advance(0.1)
    assert slow == [None, pytest.approx(20.0, abs=0.5), pytest.approx(20.0, abs=0.5)]
    cycle = [100.0] * 10 + [0.0] * 40
    assert fast[0] is None
    assert fast[1:] == [pytest.approx(each, abs=0.5) for each in cycle * 2]


@pytest.mark.parametrize(
    ("change", "cpu"),
    [
        ({"busy": 3.5, "read_at": 12.0}, 25.0),
        ({"busy": 3.5, "read_at": 10.0}, None),  # no time between them
        ({"busy": 3.5, "read_at": 2.0}, None),  # the machine was started again
        ({"busy": 2.0, "read_at": 12.0}, None),  # another process
        ({"busy": 3.5, "read_at": 12.0, "created": 2e9}, None),  # another process with this id
        ({"busy": 3.5, "read_at": 12.0, "pid": 8}, None),
    ],
)
def test_the_share_of_a_cpu_is_that_of_one_process(change: dict[str, Any], cpu: float | None) -> None:
    row = link.ProcessInfo(
        pid=7, parent=1, name="a", part="base", state="running", busy=3.0, read_at=10.0, created=1e9
    )
    shares = CpuShares()
    shares.measured(link.Processes(request=1, at=0.0, processes=[row]))
    changed = msgspec.structs.replace(row, **change)
    (found,) = shares.measured(link.Processes(request=2, at=0.0, processes=[changed])).processes
    assert found.cpu == cpu


def test_a_measurement_is_asked_for_only_when_the_one_before_has_come(
    world: World, modules: RobotModules
) -> None:
    modules.watch(0.1, lambda found: None)
    world.clock.advance(3.0)
    assert len(asked(world, link.MeasureProcesses)) == 1
    answer(world, modules)
    world.clock.advance(0.1)
    assert len(asked(world, link.MeasureProcesses)) == 2


def test_a_watch_goes_on_when_the_robot_is_back(world: World, modules: RobotModules) -> None:
    found: list[float] = []
    modules.watch(1.0, lambda each: found.append(each.at))
    world.clock.advance(0)
    world.robot_goes()
    world.clock.advance(10)
    world.robot_comes(["json"])
    modules.message_received(link.Modules(modules=[BASE]))
    world.clock.advance(1)
    answer(world, modules, 7.0)
    assert found == [7.0]


def test_the_latest_measurement_is_kept_up_to_date_while_it_is_asked_for(
    world: World, modules: RobotModules
) -> None:
    assert modules.latest_processes().at == 0.0
    for number in range(1, 5):
        world.clock.advance(0)
        answer(world, modules, float(number))
        world.clock.advance(1.0)
        assert modules.latest_processes().at == float(number)
    answer(world, modules)
    world.clock.advance(module.KEEP_WATCHING_SECONDS + 1)
    answer(world, modules)
    before = len(asked(world, link.MeasureProcesses))
    world.clock.advance(60)
    assert len(asked(world, link.MeasureProcesses)) == before
