"""Two simulated robots on one relay: robot two has no scanner, uses robot one's, and avoids a wall."""

from __future__ import annotations

import contextlib
import json
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import Any

import pytest
from playwright.sync_api import Browser, expect

from tests.worlds.accessibility import violations
from tests.worlds.browser import checked_pages, open_session
from tests.worlds.chaos_proxy import ChaosProxy
from tests.worlds.client_threads import Driver
from tests.worlds.http_requests import ask
from tests.worlds.processes import Process, running
from tests.worlds.relay_process import Relay
from tests.worlds.robot_process import Robot
from tests.worlds.waiting import wait_for

AHEAD = 0.3
SCAN = "sensor_msgs/msg/LaserScan"
SCANS = 20


class TwoRobots:
    def __init__(self, folder: Path) -> None:
        self.relay = Relay(folder)
        self.ann = self.relay.user("ann")
        self.proxy = ChaosProxy(self.relay.robots_port)
        room = ("--world", "room", "--no-depth", "--no-battery")
        self.one = Robot(self.relay, "one", port=self.proxy.port, sim_options=room)
        self.two = Robot(self.relay, "two", sim_options=(*room, "--no-scan"))
        for robot in ("one", "two"):
            self.relay.cli("right", "grant", "ann", robot, "owner")

    def pipe(self, name: str) -> dict[str, Any]:
        return dict(ask(self.relay.http_port, "GET", f"/api/v1/pipes/{name}", token=self.ann).json)

    def add(self, name: str, topic: str) -> None:
        self.relay.cli("pipe", "add", name, "one:/scan", f"two:{topic}", "--owner", "ann")
        wait_for(f"{name} runs", lambda: self.pipe(name)["state"] == "running")

    def stop(self) -> None:
        self.two.stop()
        self.one.stop()
        self.proxy.close()
        self.relay.stop()


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TwoRobots]:
    made = TwoRobots(tmp_path_factory.mktemp("pipes"))
    with running(made):
        made.add("scan", "/scan")
        yield made


def age(message: dict[str, Any]) -> float:
    """Seconds since a message's stamp."""
    stamp = message["header"]["stamp"]
    return time.time() - stamp["sec"] - stamp["nanosec"] / 1e9


def test_robot_one_sends_its_scan_once_for_two_pipes_and_a_viewer(world: TwoRobots) -> None:
    world.add("again", "/again")
    with world.relay.connect("one", world.ann) as viewer, world.relay.connect("two", world.ann) as other:
        viewer.send(op="subscribe", topic="/scan", type=SCAN, compression="cbor-raw")
        message = viewer.connection.recv()
        before, carried = world.proxy.up, world.pipe("again")["messages"]
        for _ in range(SCANS):
            viewer.connection.recv()
        sent = world.proxy.up - before
        other.send(op="subscribe", topic="/again", type=SCAN)
        ages = [age(other.until(op="publish", topic="/again")["msg"]) for _ in range(SCANS // 2)]
    pipe = world.pipe("again")
    print(
        f"robot one sent {sent / SCANS:.0f} bytes for each scan of {len(message)}; from its stamp to a client of robot "
        f"two {median(ages) * 1000:.1f} ms, of which the pipe took {pipe['latency_ms']:.3f} ms"
    )
    assert pipe["encoded"] == pipe["messages"]
    assert sent < 2 * SCANS * len(message)
    assert world.pipe("again")["messages"] > carried
    world.relay.cli("pipe", "remove", "again", "--yes")


@contextlib.contextmanager
def avoiding(world: TwoRobots) -> Iterator[Process]:
    environment = {**os.environ, "SWITCHBOARD_TOKEN": world.ann}
    command = [sys.executable, "-u", "-m", "robot_client.apps.collision_avoidance", world.relay.url("two")]
    runaway = Process(command, world.two.folder, "runaway", environment)
    with running(runaway):
        runaway.wait_to_say("READY")
        yield runaway


def test_robot_two_turns_away_from_a_wall_that_robot_one_sees(world: TwoRobots) -> None:
    with (
        world.relay.connect("one", world.ann) as first,
        world.relay.connect("two", world.ann) as second,
        avoiding(world) as runaway,
    ):
        drivers = [Driver(each, AHEAD, 0.0) for each in (first, second)]
        for each in (first, second):
            assert each.call("/relay/take_control")["values"]["success"]
        with running(*drivers):
            for driver in drivers:
                driver.start()
            wait_for("robot two turns away", lambda: "turning away" in runaway.said(), 60)
    assert world.two.events("bump") == []


def test_pipes_by_rosbridge(world: TwoRobots) -> None:
    new = {
        "name": "speed",
        "source": {"robot": "one", "topic": "/odom"},
        "target": {"robot": "two", "topic": "/speed", "type": "std_msgs/msg/Float64"},
        "fields": [{"source": "twist.twist.linear.x", "target": "data", "scale": 3.6}],
    }
    with world.relay.connect("two", world.ann) as client:
        added = client.call("/relay/add_pipe", {"pipe": json.dumps(new)})["values"]
        assert (added["success"], added["state"]) == (True, "waiting"), added
        client.send(op="subscribe", topic="/speed", type="std_msgs/msg/Float64")
        assert isinstance(client.until(op="publish", topic="/speed")["msg"]["data"], float)
        found = {each["name"]: each["state"] for each in client.call("/relay/pipes")["values"]["pipes"]}
        assert found == {"scan": "running", "speed": "running"}
        assert client.call("/relay/stop_pipe", {"pipe": "speed"})["values"]["state"] == "stopped"
        assert client.call("/relay/start_pipe", {"pipe": "speed"})["values"]["success"]
        assert client.call("/relay/remove_pipe", {"pipe": "speed"})["values"]["success"]
        assert not client.call("/relay/stop_pipe", {"pipe": "speed"})["result"]


def test_a_service_is_called_and_its_reply_is_carried(world: TwoRobots) -> None:
    more = "--owner", "ann", "--target-type", "std_msgs/msg/Bool", "--field", "success=data"
    world.relay.cli("pipe", "add", "done", "two:/reset()", "one:/done", *more)
    world.relay.cli("pipe", "add", "reset", "one:/odom", "two:/reset()", "--owner", "ann", "--rate", "5")
    with world.relay.connect("one", world.ann) as client:
        client.send(op="subscribe", topic="/done", type="std_msgs/msg/Bool")
        assert client.until(op="publish", topic="/done")["msg"]["data"] is True
    for each in ("reset", "done"):
        assert world.relay.cli("pipe", "show", each)["state"] == "running"
        world.relay.cli("pipe", "remove", each, "--yes")
    assert world.two.events("reset") != []


def test_pipes_in_the_portal(world: TwoRobots, browser: Browser) -> None:
    with checked_pages(browser, f"http://127.0.0.1:{world.relay.http_port}", 60) as new_page:
        page = new_page(1280, 900)
        open_session(page, "ann", "correct horse")
        page.goto("/pipes")
        fields = {"name": "moved", "source-topic": "/odom", "target-topic": "/moved"}
        for name, value in fields.items():
            page.get_by_test_id(f"pipe-{name}").fill(value)
        page.get_by_test_id("pipe-add").click()
        expect(page.get_by_test_id("pipe-wrong")).to_have_text("Choose both robots.")
        page.get_by_test_id("pipe-source").select_option("one")
        page.get_by_test_id("pipe-target").select_option("two")
        page.get_by_test_id("pipe-add").click()
        pipe = page.locator('[data-testid="pipe"][data-name="moved"]')
        state = pipe.get_by_test_id("pipe-state")
        expect(state).to_have_text("running", timeout=60_000)
        for width in (1280, 390):
            page.set_viewport_size({"width": width, "height": 900})
            assert violations(page) == []
            assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        pipe.get_by_test_id("pipe-stop").click()
        expect(state).to_have_text("stopped", timeout=60_000)
        pipe.get_by_test_id("pipe-start").click()
        expect(state).to_have_text("running", timeout=60_000)
        pipe.get_by_test_id("pipe-stop").click()
        pipe.get_by_test_id("pipe-remove").click()
        expect(pipe).to_have_count(0, timeout=60_000)


def test_it_goes_on_when_robot_one_is_back(world: TwoRobots) -> None:
    world.one.daemon.kill()
    wait_for("the pipe waits", lambda: world.pipe("scan")["state"] == "waiting")
    world.one.start_daemon()
    wait_for("the pipe runs", lambda: world.pipe("scan")["state"] == "running")
    carried = world.pipe("scan")["messages"]
    wait_for("scans come", lambda: world.pipe("scan")["messages"] > carried)
