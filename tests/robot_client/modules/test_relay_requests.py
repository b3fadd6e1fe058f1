"""The relay's requests about modules, answered by a supervisor without processes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from twisted.internet.defer import Deferred, maybeDeferred
from twisted.internet.task import Clock

from relay_protocol import link
from robot_client.modules import relay_requests as module
from robot_client.modules.log_ring import LogRing, ModuleLogLine
from robot_client.modules.relay_requests import ModuleRequests
from robot_client.modules.settings import ModuleSettings
from robot_client.modules.supervisor import ModuleSupervisor
from robot_client.platforms.base import GraphView


class Scene:
    def __init__(self, folder: Path, in_thread: Callable[..., Deferred[Any]] = maybeDeferred) -> None:
        self.clock = Clock()
        self.sent: list[Any] = []
        self.folder = folder
        settings = ModuleSettings(name="base", command=["/no/such/program"], autostart=False, restart="never")
        self.supervisor = ModuleSupervisor(
            [settings],
            folder,
            reactor=self.clock,
            environment={},
            graph=GraphView,
            alert=lambda *args, **more: None,
            boot="",
            wall=lambda: 1000.0,
        )
        self.requests = ModuleRequests(
            self.supervisor,
            folder,
            send=self.sent.append,
            clock=self.clock,
            in_thread=in_thread,
            other_roots=dict,
            wall=lambda: 1000.0,
        )
        (folder / "base").mkdir()

    def write(self, *texts: str, level: str = "info") -> None:
        ring = LogRing(self.folder / "base" / "log", 100_000)
        for text in texts:
            ring.write(ModuleLogLine(1.0, "out", level, text))
        ring.close()


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return Scene(tmp_path)


def texts(answer: link.ModuleLog) -> list[str]:
    return [each.text for each in answer.lines]


def test_all_modules_are_reported_after_the_registration(scene: Scene) -> None:
    scene.requests.registered()
    (report,) = scene.sent
    assert report == link.Modules(
        modules=[link.ModuleInfo(name="base", kind="command", state="stopped", since=1000.0)]
    )


def test_changes_that_follow_each_other_are_reported_together(scene: Scene) -> None:
    scene.supervisor.changed(scene.supervisor["base"])
    scene.supervisor.changed(scene.supervisor["base"])
    assert scene.sent == []
    scene.clock.advance(module.REPORT_SECONDS)
    assert [type(each) for each in scene.sent] == [link.Modules]


def test_an_order_to_an_unknown_module_is_answered_with_those_known(scene: Scene) -> None:
    assert scene.requests.handle(link.OrderModule(request=7, module="kitchen", action="start"))
    assert scene.sent == [
        link.ModuleOrdered(request=7, error="the robot has no module 'kitchen'; it has base")
    ]


def test_other_messages_are_left_to_others(scene: Scene) -> None:
    assert not scene.requests.handle(link.Ping(t=1))


def test_a_log_is_read_from_an_offset_on(scene: Scene) -> None:
    scene.write("one", "two", "three")
    scene.requests.handle(link.ReadModuleLog(request=1, module="base", most=2))
    newest = scene.sent.pop()
    assert texts(newest) == ["two", "three"]
    scene.write("four")
    scene.requests.handle(link.ReadModuleLog(request=2, module="base", after=newest.next))
    following = scene.sent.pop()
    assert (following.request, texts(following), following.missed) == (2, ["four"], False)


def test_a_log_is_read_backwards(scene: Scene) -> None:
    scene.write("one", "two", "three", "four", "five")
    scene.requests.handle(link.ReadModuleLog(request=1, module="base", most=2))
    pages = [scene.sent.pop()]
    while pages[-1].previous:
        before = pages[-1].previous
        scene.requests.handle(link.ReadModuleLog(request=2, module="base", before=before, most=2, wait_s=9))
        pages.append(scene.sent.pop())
    assert [texts(each) for each in pages] == [["four", "five"], ["two", "three"], ["one"]]
    scene.requests.handle(link.ReadModuleLog(request=3, module="base", before=1, after=1))
    assert "does not go with" in scene.sent.pop().error


def test_a_request_waits_for_a_line_of_its_level(scene: Scene) -> None:
    scene.write("one", "two")
    scene.write("hot", level="warn")
    scene.requests.handle(link.ReadModuleLog(request=1, module="base", level="warn"))
    newest = scene.sent.pop()
    assert texts(newest) == ["hot"]
    wait = link.ReadModuleLog(request=2, module="base", after=newest.next, level="warn", wait_s=10)
    scene.requests.handle(wait)
    scene.write("three")
    scene.clock.advance(module.LOG_POLL_SECONDS)
    assert scene.sent == []
    scene.write("broken", level="error")
    scene.clock.advance(module.LOG_POLL_SECONDS)
    assert texts(scene.sent.pop()) == ["broken"]


def test_a_request_waits_for_a_line(scene: Scene) -> None:
    scene.write("one")
    scene.requests.handle(link.ReadModuleLog(request=1, module="base"))
    end = scene.sent.pop().next
    scene.requests.handle(link.ReadModuleLog(request=2, module="base", after=end, wait_s=10))
    scene.clock.advance(5)
    assert scene.sent == []
    scene.write("two")
    scene.clock.advance(module.LOG_POLL_SECONDS)
    assert texts(scene.sent.pop()) == ["two"]


def test_a_request_without_a_line_is_answered_when_its_time_is_over(scene: Scene) -> None:
    scene.requests.handle(link.ReadModuleLog(request=1, module="base", after=0, wait_s=1))
    scene.clock.pump([module.LOG_POLL_SECONDS] * 5)
    assert texts(scene.sent.pop()) == []


def test_requests_that_wait_are_bounded(scene: Scene) -> None:
    for number in range(module.LOG_READERS + 1):
        scene.requests.handle(link.ReadModuleLog(request=number, module="base", after=0, wait_s=30))
    (refused,) = scene.sent
    assert "the most this robot takes" in refused.error
    scene.clock.pump([module.LOG_POLL_SECONDS] * 130)
    scene.sent.clear()
    scene.requests.handle(link.ReadModuleLog(request=99, module="base"))
    assert scene.sent[0].error == ""


def test_measurement_answers_all_waiting_requests(tmp_path: Path) -> None:
    running: list[tuple[Deferred[Any], Any]] = []

    def in_thread(work: Any, *args: Any) -> Deferred[Any]:
        running.append((Deferred(), lambda: work(*args)))
        return running[-1][0]

    scene = Scene(tmp_path, in_thread)
    for number in (1, 2):
        scene.requests.handle(link.MeasureProcesses(request=number))
    assert len(running) == 1
    done, work = running[0]
    done.callback(work())
    assert [(each.request, each.processes) for each in scene.sent] == [(1, []), (2, [])]
    scene.requests.handle(link.MeasureProcesses(request=3))
    running[1][0].errback(OSError("no /proc"))
    assert scene.sent[-1].error == "no /proc"
