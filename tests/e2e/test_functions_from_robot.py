"""A program on a robot calls functions over its own link, and works without the cloud if needed."""

from __future__ import annotations

import json
import shutil
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pytest_twisted
from twisted.internet.defer import CancelledError
from twisted.internet.threads import deferToThread

from relay_protocol.errors import Unavailable
from relay_protocol.functions import CallFailed, function
from robot_client.offload import Cloud, Device, DeviceState, decisions, offload
from robot_client.offload.decisions import Offloaded
from robot_client.offload.deferred import DeferredCloud
from robot_client.offload.device import publish
from robot_client.offload.function_link import Overtaken
from robot_client.services.faces import FaceFinder
from robot_client.services.placement import CameraImage, RunOptions, face_function, file_of, marker_function
from tests.robot_client.services.test_markers import LENS, SIZE, drawn
from tests.worlds import offload_functions
from tests.worlds.chaos_proxy import ChaosProxy
from tests.worlds.face_images import EILEEN, scene
from tests.worlds.file_daemon import PRESSURE, file_daemon
from tests.worlds.forked_programs import run_command
from tests.worlds.http_requests import ask
from tests.worlds.processes import BIN, ros_environment, running
from tests.worlds.relay_process import Relay
from tests.worlds.ros_domains import free_domain
from tests.worlds.waiting import wait_for


class RobotProgram:
    """A relay, and a program on rover that reaches it through a proxy, without a daemon."""

    def __init__(self, folder: Path) -> None:
        functions = folder / "functions"
        functions.mkdir()
        shutil.copy(offload_functions.__file__, functions)
        options = ("--offload-folder", str(functions), "--offload-processes", "2", "--offload-robots", "*")
        self.relay = Relay(folder, *options)
        self.proxy = ChaosProxy(self.relay.robots_port)
        self.state = folder / "state"
        code = self.relay.cli("robot", "add", "rover")["enrolment_code"]
        enroll = [str(BIN / "switchboard-robot"), "enroll", "--relay", f"127.0.0.1:{self.proxy.port}"]
        enroll += ["--robot", "rover", "--code", "-", "--state", str(self.state)]
        run_command(enroll, stdin=code).check_returncode()
        self.cloud = Cloud(self.state)
        self.device = Device(self.state)

    def publish(self, **critical: bool) -> None:
        publish(self.state, DeviceState(time.time(), critical))

    def stop(self) -> None:
        self.cloud.close()
        self.proxy.close()
        self.relay.stop()


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RobotProgram]:
    made = RobotProgram(tmp_path_factory.mktemp("robot"))
    with running(made):
        yield made


def test_a_call_returns_its_result_and_large_values(world: RobotProgram) -> None:
    assert world.cloud.call("add", a=1, b=2)["sum"] == 3
    cloud = np.arange(1_000_000, dtype=np.float32)
    assert np.array_equal(world.cloud.call("double", cloud=cloud), cloud * 2)


def test_calls_of_many_threads_get_their_own_results(world: RobotProgram) -> None:
    with ThreadPoolExecutor(8) as pool:
        sums = pool.map(lambda n: world.cloud.call("add", timeout=60, a=n)["sum"], range(40))
    assert list(sums) == [n + 1 for n in range(40)]


@pytest.mark.parametrize(
    ("name", "arguments", "code"),
    [
        ("loop_for_ever", {}, "timeout"),
        ("crash", {}, "crashed"),
        ("missing", {}, "not_found"),
        ("size_of", {"data": bytes(17_000_000)}, "too_large"),
    ],
)
def test_a_call_without_a_result_is_an_exception(
    world: RobotProgram, name: str, arguments: dict[str, object], code: str
) -> None:
    with pytest.raises(CallFailed) as failed:
        world.cloud.call(name, timeout=30, **arguments)
    assert failed.value.code == code


@pytest_twisted.ensureDeferred
async def test_a_program_on_the_reactor_waits_by_deferreds(world: RobotProgram) -> None:
    workers = DeferredCloud(world.cloud)
    calls = [workers.call("add", a=number, b=1, timeout=60) for number in range(20)]
    assert [(await each)["sum"] for each in calls] == list(range(1, 21))
    handle = await workers.submit("add", a=2, b=2)
    assert (await workers.result(handle, 60))["sum"] == 4

    @offload("add", client=world.cloud, state=world.device, version=1)
    def add(a: float, b: float = 1.0) -> float:
        return a + b

    assert await workers.run(add, 4) == 5
    with pytest.raises(CallFailed):
        await workers.call("no_such_function", timeout=60)
    lost = workers.call("add", a=1, b=1, timeout=60)
    lost.cancel()
    with pytest.raises(CancelledError):
        await lost
    await deferToThread(workers.close)


def test_a_submitted_job_outlasts_the_link(world: RobotProgram, tmp_path: Path) -> None:
    go_on = tmp_path / "go on"
    handle = world.cloud.submit("report", steps=4, go_on=str(go_on))
    wait_for("it runs", lambda: handle.status().text == "half")
    world.cloud.close()
    go_on.touch()
    again = Cloud(world.state)
    assert again.handle(handle.id()).result(timeout=60) == 4
    again.close()


def test_a_function_runs_where_the_device_wants_it(world: RobotProgram) -> None:
    here = []

    @offload("add", client=world.cloud, state=world.device, version=1)
    def add(a: float, b: float = 1.0) -> float:
        here.append(a)
        return a + b

    world.publish(cpu=False)
    assert (add(1), here) == (2, [1])
    world.publish(cpu=True)
    assert (add(2), here) == (3, [1])
    world.publish(cpu=True, signal=True)
    assert (add(3), here) == (4, [1, 3])
    add.where = "cloud"
    assert (add(4), here) == (5, [1, 3])
    assert [(each.where, each.why) for each in decisions()[-4:]] == [
        ("here", "nothing is critical"),
        ("cloud", "cpu critical"),
        ("here", "the signal is too weak"),
        ("cloud", "forced"),
    ]


def test_what_the_daemon_measures_sends_a_function_to_a_worker(world: RobotProgram, tmp_path: Path) -> None:
    """From memory that is critical to the worker's result, and to the relay's view of the device."""
    here = []

    @offload("add", client=world.cloud, state=world.device, version=1)
    def add(a: float, b: float = 1.0) -> float:
        here.append(a)
        return a + b

    settings = tmp_path / "robot.toml"
    settings.write_text("[safety]\nguard = false\n")
    world.publish(memory=False)
    with running(file_daemon(world.state, settings, tmp_path, **PRESSURE)):
        wait_for("memory is critical", lambda: world.device.critical("memory"))
        assert (add(6), here) == (7, [])
        decision = decisions()[-1]
        assert (decision.where, decision.why) == ("cloud", "memory critical")
        admin = world.relay.user("root", admin=True)

        def shown() -> Any:
            answer = ask(world.relay.http_port, "GET", "/api/v1/robots/rover/device", token=admin)
            return answer.status == 200 and answer.json["critical"]

        wait_for("the relay knows", lambda: (shown() or {}).get("memory"))


def test_a_ros_node_that_is_a_module_calls_functions(world: RobotProgram, tmp_path: Path) -> None:
    """In its callbacks; it knows the robot's key from the daemon."""
    found, settings = tmp_path / "sum", tmp_path / "robot.toml"
    command = [sys.executable, "-m", "tests.worlds.adding_node", str(found)]
    settings.write_text(
        f'[safety]\nguard = false\n\n[[module]]\nname = "adding"\ncommand = {json.dumps(command)}\n'
    )
    with running(file_daemon(world.state, settings, tmp_path, **ros_environment(free_domain()))):
        wait_for("a sum comes", found.exists)
    assert found.read_text() == "42.0 cloud 2.0"


def test_without_the_relay_a_function_runs_here(world: RobotProgram, tmp_path: Path) -> None:
    world.publish(cpu=True)

    @offload("crash", client=world.cloud, state=world.device)
    def crash(began: str = "") -> str:
        return "here"

    with pytest.raises(CallFailed):
        crash(str(tmp_path / "began"))
    assert (tmp_path / "began").read_bytes() == b"x"

    @offload("crash", client=world.cloud, state=world.device)
    @function(name="crash", repeatable=True)
    def crash_or_here(began: str = "") -> str:
        return "here"

    assert crash_or_here() == "here"
    world.cloud.close()
    elsewhere = Cloud(world.state.parent / "nowhere")
    unreached = offload("add", client=elsewhere, state=world.device)(lambda a: a + 1)
    assert unreached(1) == 2
    with pytest.raises(Unavailable):
        elsewhere.call("add", a=1)


@pytest.mark.parametrize("service", ["markers", "faces"])
def test_a_service_searches_on_a_worker_and_here_once_the_link_is_cut(
    world: RobotProgram, service: str
) -> None:
    run = RunOptions("auto", world.cloud, world.device)
    find: Offloaded[..., list[Any]]
    if service == "markers":
        find, picture = marker_function("4X4_50", SIZE, run), CameraImage(drawn(7, (0.2, 0.1, 1.5), 0.4))
        arguments: tuple[Any, ...] = (picture, LENS)
    else:
        find, picture = face_function(FaceFinder(), run), CameraImage(scene(EILEEN, 0.8, (50, 20)))
        arguments = (picture,)
    world.publish(cpu=False)
    here = find(*arguments)
    assert len(here) == 1
    world.publish(cpu=True)

    def ran_away() -> bool:
        found = find(*arguments)
        assert found == here
        return find.ran_away

    # The first call may take longer than a service waits, while the worker imports OpenCV.
    world.cloud.call(f"detect_{service}", timeout=60, image=file_of(picture))
    wait_for("it runs on a worker", ran_away)
    world.proxy.black_hole()
    assert not ran_away()
    world.proxy.heal()
    world.cloud.close()


@pytest.mark.parametrize("broken", ["link", "relay"])
def test_a_call_whose_link_or_relay_is_lost_is_an_error_at_once(
    world: RobotProgram, tmp_path: Path, broken: str
) -> None:
    with ThreadPoolExecutor(1) as pool:
        call = pool.submit(
            world.cloud.call, "sleep", timeout=60, duration=30.0, began=str(tmp_path / "began")
        )
        wait_for("it runs", (tmp_path / "began").exists)
        if broken == "link":
            world.proxy.reset()
        else:
            world.relay.kill()
        with pytest.raises(CallFailed) as failed:
            call.result(30)
    assert failed.value.code == "lost"
    if broken == "relay":
        with pytest.raises(Unavailable):
            world.cloud.call("add", a=1)
        world.relay.start()

    def answered() -> bool:
        try:
            return bool(world.cloud.call("add", timeout=30, a=1)["sum"] == 2)
        except Unavailable:
            return False

    wait_for("it is reached again", answered)
    assert (tmp_path / "began").read_bytes() == b"x"


def test_a_newer_frame_takes_the_place_of_one_that_waits(world: RobotProgram, tmp_path: Path) -> None:
    go_on = tmp_path / "go on"
    world.cloud.call("add", a=1)
    connection = world.cloud._connection
    assert connection is not None

    def call(steps: int) -> int:
        return int(world.cloud.call("report", timeout=60, newest=True, steps=steps, go_on=str(go_on)))

    with ThreadPoolExecutor(3) as pool:
        first = pool.submit(call, 1)
        wait_for("the first is sent", lambda: any(each.sent for each in connection._replies.values()))
        second = pool.submit(call, 2)
        wait_for("the second waits", lambda: connection._waiting)
        third = pool.submit(call, 3)
        with pytest.raises(Overtaken):
            second.result(60)
        go_on.touch()
        assert (first.result(60), third.result(60)) == (1, 3)
