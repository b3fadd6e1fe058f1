"""Modules of a robot through all interfaces: HTTP, its streams, rosbridge, the command line; also while the
robot is offline.
"""

from __future__ import annotations

import http.client
import json
import os
import re
import signal
import threading
from collections.abc import Iterator
from contextlib import closing
from itertools import pairwise
from typing import Any

import pytest

from tests.worlds.http_requests import Answer, ask
from tests.worlds.module_settings import MODULES
from tests.worlds.relay_process import Relay
from tests.worlds.robot_process import Robot
from tests.worlds.terminal import Terminal
from tests.worlds.waiting import freeze, wait_for

HERE = "/api/v1/robots/rover"


class World:
    def __init__(self, relay: Relay) -> None:
        self.relay = relay
        self.owner = relay.user("owner")
        self.viewer = relay.user("viewer")
        self.robot = Robot(relay, "rover", settings=MODULES)
        relay.cli("right", "grant", "owner", "rover", "owner")
        relay.cli("right", "grant", "viewer", "rover", "viewer")

    def ask(self, method: str, path: str, token: str = "") -> Answer:
        return ask(self.relay.http_port, method, HERE + path, token=token or self.owner)

    def module(self, name: str) -> dict[str, Any]:
        found = self.ask("GET", f"/modules/{name}")
        assert found.status == 200, found.body
        return dict(found.json)

    def wait_state(self, name: str, state: str) -> dict[str, Any]:
        wait_for(f"{name} is {state}", lambda: self.module(name)["state"] == state)
        return self.module(name)


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    relay = Relay(tmp_path_factory.mktemp("modules"), "--requests-per-second", "0")
    made = World(relay)
    yield made
    made.robot.stop()
    relay.stop()


class Stream:
    """Server-sent events, read in a thread."""

    def __init__(self, world: World, path: str, token: str = "") -> None:
        self.events: list[tuple[str, Any]] = []
        self._connection = http.client.HTTPConnection("127.0.0.1", world.relay.http_port, timeout=60)
        headers = {"Authorization": f"Bearer {token or world.owner}", "Accept": "text/event-stream"}
        self._connection.request("GET", HERE + path, headers=headers)
        self.answer = self._connection.getresponse()
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self) -> None:
        kind = ""
        try:
            for line in self.answer:
                name, _, value = line.decode().rstrip("\n").partition(": ")
                if name == "event":
                    kind = value
                elif name == "data":
                    self.events.append((kind, json.loads(value)))
        except (OSError, ValueError, AttributeError):
            pass

    def close(self) -> None:
        sock = self._connection.sock or self.answer.fp.raw._sock  # type: ignore[union-attr]
        sock.shutdown(2)
        self._thread.join()
        self._connection.close()


def test_modules_are_listed_started_and_stopped(world: World) -> None:
    world.wait_state("base", "running")
    listed = world.ask("GET", "/modules").json
    assert (listed["robot"], listed["online"]) == ("rover", True)
    states = {each["name"]: (each["kind"], each["state"], each["wanted"]) for each in listed["modules"]}
    assert states == {"base": ("command", "running", True), "cleaning": ("command", "stopped", False)}
    with closing(Stream(world, "/modules")) as stream:
        ordered = world.ask("POST", "/modules/cleaning/start")
        assert (ordered.status, ordered.json) == (
            202,
            {"module": "cleaning", "action": "start", "pending": False, "why": ""},
        )
        pid = world.wait_state("cleaning", "running")["pid"]
        world.ask("POST", "/modules/cleaning/restart")
        wait_for("another process", lambda: world.module("cleaning")["pid"] not in (pid, None))
        world.wait_state("cleaning", "running")
        world.ask("POST", "/modules/cleaning/stop")
        world.wait_state("cleaning", "stopped")

        def seen() -> list[str]:
            lists = [value["modules"] for kind, value in stream.events if kind == "modules"]
            return [each["state"] for modules in lists for each in modules if each["name"] == "cleaning"]

        wait_for("the stream has shown it", lambda: seen()[-1:] == ["stopped"])
        assert "running" in seen()
    audit = [
        (each["actor"], each["action"], each["target"])
        for each in world.relay.cli("audit", "list")
        if each["action"].startswith("module.")
    ]
    assert sorted(audit) == [
        ("user:owner", f"module.{action}", "rover/cleaning") for action in ("restart", "start", "stop")
    ]
    found = ask(world.relay.http_port, "GET", "/api/v1/events?kind=module*&limit=100", token=world.owner).json
    kinds = {(each["kind"], each["data"]["module"], each["data"].get("state")) for each in found["events"]}
    assert ("module.ordered", "cleaning", None) in kinds
    assert ("module.changed", "cleaning", "running") in kinds


@pytest.mark.parametrize(
    ("method", "path"),
    [
        ("GET", "/modules/base"),
        ("POST", "/modules/base/stop"),
        ("GET", "/modules/base/log"),
        ("GET", "/processes"),
    ],
)
def test_modules_need_the_right_to_manage(world: World, method: str, path: str) -> None:
    refused = world.ask(method, path, world.viewer)
    assert (refused.status, refused.json["code"]) == (403, "refused")
    assert "manage" in refused.json["detail"]
    assert world.ask("GET", "/modules", world.viewer).json["modules"] == []


@pytest.mark.parametrize(
    ("method", "path", "status"),
    [
        ("POST", "/modules/kitchen/start", 404),
        ("GET", "/modules/kitchen/log", 404),
        ("POST", "/modules/base/explode", 400),
        ("GET", "/processes?every=0.5", 400),
        ("GET", "/modules/base/log?limit=0", 400),
        ("GET", "/modules/base/log?level=loud", 400),
        ("GET", "/modules/base/log?before=9&after=9", 400),
        ("GET", "/modules/base/log?before=9&wait=1", 400),
    ],
)
def test_wrong_requests_are_explained(world: World, method: str, path: str, status: int) -> None:
    answer = world.ask(method, path)
    assert answer.status == status
    assert answer.json["detail"]
    if "kitchen" in path:
        assert "it has base, cleaning" in answer.json["detail"]


def test_a_log_is_read_and_followed(world: World) -> None:
    world.ask("POST", "/modules/cleaning/start")
    world.wait_state("cleaning", "running")

    def swept() -> list[dict[str, Any]]:
        lines = [line for _, page in stream.events for line in page["lines"]]
        first = max(
            (at for at, line in enumerate(lines) if line["text"].endswith("swept 0")), default=len(lines)
        )
        return lines[first:]

    with closing(Stream(world, "/modules/cleaning/log?limit=50")) as stream:
        wait_for("lines", lambda: len(swept()) >= 5)
    assert all((each["level"], each["stream"]) == ("warn", "out") for each in swept())
    numbers = [int(each["text"].rpartition(" ")[2]) for each in swept()]
    assert numbers == list(range(len(numbers)))
    page = world.ask("GET", "/modules/cleaning/log?limit=1").json
    following = world.ask("GET", f"/modules/cleaning/log?limit=1&after={page['next']}&wait=30").json
    first, second = (int(each["lines"][0]["text"].rpartition(" ")[2]) for each in (page, following))
    assert second == first + 1
    world.ask("POST", "/modules/cleaning/stop")
    world.wait_state("cleaning", "stopped")


def test_a_log_is_read_backwards_and_by_level(world: World) -> None:
    """By HTTP, rosbridge and the command line."""
    world.ask("POST", "/modules/cleaning/start")
    world.wait_state("cleaning", "running")
    read = "/modules/cleaning/log?level=warn&limit=2"

    def earlier_lines() -> bool:
        return bool(world.ask("GET", read).json["previous"])

    wait_for("some lines", earlier_lines)
    world.ask("POST", "/modules/cleaning/stop")
    world.wait_state("cleaning", "stopped")
    newest = world.ask("GET", read).json
    earlier = world.ask("GET", f"{read}&before={newest['previous']}").json
    lines = [*earlier["lines"], *newest["lines"]]
    # Python writes a traceback when it is stopped.
    assert earlier["lines"]
    assert {each["level"] for each in lines} <= {"warn", "error"}
    assert lines == world.ask("GET", "/modules/cleaning/log?level=warn&limit=4").json["lines"]
    assert world.ask("GET", "/modules/cleaning/log?level=fatal").json["lines"] == []
    with closing(world.relay.connect("rover", world.owner)) as client:
        asked = {"module": "cleaning", "level": "warn", "limit": 2, "before": newest["previous"]}
        assert client.call("/relay/module_log", asked)["values"] == earlier
        refused = client.call("/relay/module_log", {"module": "cleaning", "level": "loud"})
        assert (refused["result"], "loud" in str(refused["values"])) == (False, True)
    shown = ("module", "log", "rover", "cleaning", "--level", "warn", "--lines", "2")
    first = world.relay.run_cli(*shown)
    assert first.stderr.strip() == f"earlier lines: --before {newest['previous']}"
    second = world.relay.run_cli(*shown, "--before", first.stderr.split()[-1], "--json")
    assert [json.loads(each) for each in second.stdout.splitlines()] == earlier["lines"]


def test_processes_are_measured_while_they_are_viewed(world: World) -> None:
    world.wait_state("base", "running")
    once = world.ask("GET", "/processes").json
    parts = {each["part"] for each in once["processes"]}
    assert {"daemon", "guard", "base"} <= parts
    with closing(Stream(world, "/processes?every=0.1")) as stream:
        wait_for("measurements", lambda: len(stream.events) >= 5)
    rows = {each["part"]: each for each in stream.events[-1][1]["processes"]}
    daemon = rows["daemon"]
    assert daemon["pid"] == world.robot.daemon.popen.pid
    assert daemon["cpu"] is not None
    assert daemon["memory"] > 10_000_000
    assert daemon["threads"] > 1
    assert daemon["voluntary"] > 0


def test_each_client_gets_the_shares_of_its_own_interval(world: World) -> None:
    world.wait_state("base", "running")
    slow, fast = Stream(world, "/processes?every=1"), Stream(world, "/processes?every=0.1")
    with closing(slow), closing(fast):
        wait_for("measurements", lambda: len(slow.events) >= 3 and len(fast.events) >= 3)
    for stream in (slow, fast):
        lists = [{each["pid"]: each for each in value["processes"]} for _, value in stream.events]
        assert all(each["cpu"] is None for each in lists[0].values())
        for before, now in pairwise(lists):
            for pid in before.keys() & now.keys():
                busy, seconds = (now[pid][each] - before[pid][each] for each in ("busy", "read_at"))
                assert now[pid]["cpu"] == round(100 * busy / seconds, 1)


def test_rosbridge_clients_have_the_same(world: World) -> None:
    world.wait_state("base", "running")
    with closing(world.relay.connect("rover", world.owner)) as client:
        client.send(op="subscribe", topic="/relay/modules")
        listed = client.until(op="publish", topic="/relay/modules")["msg"]
        assert [each["name"] for each in listed["modules"]] == ["base", "cleaning"]
        assert (listed["online"], listed["modules"][0]["pending"]["action"]) == (True, "")
        done = client.call("/relay/start_module", {"module": "cleaning"})
        assert done["values"]["success"], done
        world.wait_state("cleaning", "running")
        log = client.call("/relay/module_log", {"module": "base"})["values"]
        assert "base is up" in [each["text"] for each in log["lines"]]
        client.send(op="subscribe", topic="/relay/processes")
        rows: list[Any] = []
        while not rows:
            rows = client.until(op="publish", topic="/relay/processes")["msg"]["processes"]
        assert {"daemon", "base"} <= {each["part"] for each in rows}
        pid = world.module("cleaning")["pid"]
        again = client.call("/relay/restart_module", {"module": "cleaning"})
        assert (again["result"], again["values"]["success"]) == (True, True), again
        wait_for("another process", lambda: world.module("cleaning")["pid"] not in (pid, None))
        world.wait_state("cleaning", "running")
        assert client.call("/relay/stop_module", {"module": "cleaning"})["values"]["success"]
    with closing(world.relay.connect("rover", world.viewer)) as client:
        for action in ("start", "stop", "restart"):
            refused = client.call(f"/relay/{action}_module", {"module": "cleaning"})
            assert refused["result"] is False
            assert "manage" in str(refused["values"])
        client.send(op="subscribe", topic="/relay/processes")
        assert "manage" in client.until(op="publish", topic="/relay/processes")["msg"]["error"]
    world.wait_state("cleaning", "stopped")


def test_the_command_line_has_the_same(world: World) -> None:
    world.wait_state("base", "running")
    listed = world.relay.cli("module", "list", "rover")
    assert [each["name"] for each in listed["modules"]] == ["base", "cleaning"]
    shown = world.relay.run_cli("module", "list", "rover")
    assert "running" in shown.stdout
    assert world.relay.cli("module", "start", "rover", "cleaning")["pending"] is False
    world.wait_state("cleaning", "running")
    assert "base is up" in world.relay.run_cli("module", "log", "rover", "base").stdout
    rows = world.relay.cli("top", "rover", "--every", "0.1")["processes"]
    assert {"daemon", "guard", "base", "cleaning"} <= {each["part"] for each in rows}
    assert all(each["cpu"] is not None for each in rows if each["part"] == "daemon")
    table = world.relay.run_cli("top", "rover", "--every", "0.1", "--sort", "part").stdout
    assert table.split()[:4] == ["PID", "part", "name", "state"]
    pid = world.module("cleaning")["pid"]
    again = world.relay.run_cli("module", "restart", "rover", "cleaning")
    assert again.stdout == "Robot rover has accepted: restart cleaning.\n", again
    wait_for("another process", lambda: world.module("cleaning")["pid"] not in (pid, None))
    world.wait_state("cleaning", "running")
    assert world.relay.run_cli("module", "stop", "rover", "cleaning").stdout.startswith(
        "Robot rover has accepted"
    )
    world.wait_state("cleaning", "stopped")
    wrong = world.relay.run_cli("module", "start", "rover", "kitchen")
    assert (wrong.returncode, "it has base, cleaning" in wrong.stderr) == (1, True)
    missing = world.relay.run_cli("module", "list", "nobody")
    assert (missing.returncode, "there is no robot 'nobody'" in missing.stderr) == (1, True)


def test_a_log_is_followed_on_the_command_line_until_ctrl_c(world: World) -> None:
    world.ask("POST", "/modules/cleaning/start")
    world.wait_state("cleaning", "running")
    data = ("--data", str(world.relay.data))
    with Terminal(*data, "module", "log", "rover", "cleaning", "--lines", "1", "-f") as terminal:

        def swept() -> list[int]:
            found = re.findall(r" out +warn +\S+ \S+ \S+ swept (\d+)\r\n", terminal.shown())
            return [int(each) for each in found]

        wait_for("lines that follow", lambda: len(swept()) >= 5)
        # The first may have been there before, of an earlier run.
        numbers = swept()[1:]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        assert terminal.process.poll() is None
        terminal.type("\x03")
        assert terminal.process.wait(60) == 0
        assert terminal.settings() == terminal.settings_before
        assert not {"Traceback", "Aborted"} & set(re.findall(r"\w+", terminal.shown()))
    world.ask("POST", "/modules/cleaning/stop")
    world.wait_state("cleaning", "stopped")


@pytest.mark.parametrize(("end", "code"), [("q", 0), ("\x03", 0), (signal.SIGTERM, 143)])
def test_top_refreshes_its_terminal_and_restores_it(world: World, end: str | int, code: int) -> None:
    world.wait_state("cleaning", "stopped")
    with Terminal("--data", str(world.relay.data), "top", "rover", "--every", "0.1") as terminal:
        wait_for("the processes", lambda: "daemon" in terminal.shown())
        assert "cleaning" not in terminal.shown()
        world.ask("POST", "/modules/cleaning/start")
        wait_for("a new process", lambda: "cleaning" in terminal.shown())
        wait_for("shares of a CPU", lambda: re.search(r"rover: \d+ processes, [\d.]+ % of", terminal.shown()))
        terminal.type("x")  # means nothing, and is not shown
        drawn = terminal.shown().count("rover:")
        wait_for("further turns", lambda: terminal.shown().count("rover:") > drawn + 2)
        assert terminal.settings() != terminal.settings_before
        if isinstance(end, str):
            terminal.type(end)
        else:
            terminal.process.send_signal(end)
        assert terminal.process.wait(60) == code
        shown = terminal.shown()
        # The cursor, and the screen as it was before.
        assert "\x1b[?1049l" in shown[shown.rindex("rover:") :]
        assert shown.rindex("\x1b[?25h") > shown.rindex("\x1b[?25l")
        assert terminal.settings() == terminal.settings_before
        assert not {"Traceback", "Aborted"} & set(re.findall(r"\w+", shown))
    world.ask("POST", "/modules/cleaning/stop")
    world.wait_state("cleaning", "stopped")


def test_order_reaches_many_robots(world: World) -> None:
    world.relay.cli("robot", "add", "rover-away")
    world.relay.cli("right", "grant", "owner", "rover-away", "owner")
    done = world.relay.run_cli("module", "start", "rover*", "cleaning", "--json")
    results = {each["robot"]: each for each in json.loads(done.stdout)["results"]}
    assert (results["rover"]["ok"], results["rover"]["pending"]) == (True, False)
    assert (results["rover-away"]["ok"], results["rover-away"]["pending"]) == (True, True)
    world.wait_state("cleaning", "running")
    body = {"robots": ["rover"], "do": "module", "module": "cleaning", "action": "stop"}
    lines = ask(world.relay.http_port, "POST", "/api/v1/fleet", body, token=world.owner).body.splitlines()
    assert json.loads(lines[1])["ok"], lines
    world.wait_state("cleaning", "stopped")
    refused = ask(world.relay.http_port, "POST", "/api/v1/fleet", body, token=world.viewer).body.splitlines()
    assert "manage" in json.loads(refused[1])["message"]
    del body["action"]
    assert ask(world.relay.http_port, "POST", "/api/v1/fleet", body, token=world.owner).status == 400


def test_an_order_that_the_robot_does_not_answer_is_pending(world: World) -> None:
    world.wait_state("cleaning", "stopped")
    pid = world.robot.daemon.popen.pid
    freeze(pid)
    try:
        ordered = world.ask("POST", "/modules/cleaning/start")
        assert (ordered.status, ordered.json["pending"]) == (202, True)
        assert world.module("cleaning")["pending"]["action"] == "start"
    finally:
        os.kill(pid, signal.SIGCONT)
    world.wait_state("cleaning", "running")
    # An order that the robot executes replaces the pending one.
    wait_for("it takes orders", lambda: world.ask("POST", "/modules/cleaning/stop").json["pending"] is False)
    world.wait_state("cleaning", "stopped")
    assert world.module("cleaning")["pending"] is None


def test_an_order_to_a_robot_that_is_away_is_pending(world: World) -> None:
    world.wait_state("cleaning", "stopped")
    world.robot.daemon.kill()
    wait_for("it is offline", lambda: not world.ask("GET", "/modules").json["online"])
    assert world.ask("POST", "/modules/cleaning/restart").status == 503
    ordered = world.ask("POST", "/modules/cleaning/start")
    assert (ordered.status, ordered.json["pending"]) == (202, True)
    waiting = world.module("cleaning")
    assert (waiting["pending"]["action"], waiting["pending"]["by"]) == ("start", "owner")
    with closing(world.relay.connect("rover", world.owner)) as client:
        client.send(op="subscribe", topic="/relay/modules")

        def shown() -> tuple[bool, str]:
            listed = client.until(op="publish", topic="/relay/modules")["msg"]
            return listed["online"], listed["modules"][1]["pending"]["action"]

        wait_for("the topic has the pending order", lambda: shown() == (False, "start"))
    # Orders and the last known states survive the relay.
    known = world.ask("GET", "/modules").json
    world.relay.kill()
    world.relay.start()
    listed = world.ask("GET", "/modules").json
    assert listed == known
    assert (listed["online"], listed["current"]) == (False, False)
    assert [each["name"] for each in listed["modules"]] == ["base", "cleaning"]
    cleaning = world.module("cleaning")
    assert (cleaning["state"], cleaning["pending"]["action"]) == ("stopped", "start")
    assert "rover is offline; last reported" in world.relay.run_cli("module", "list", "rover").stdout
    assert "its last report has no module" in world.ask("POST", "/modules/kitchen/start").json["detail"]
    with closing(world.relay.connect("rover", world.owner)) as client:
        client.send(op="subscribe", topic="/relay/modules")
        topic = client.until(op="publish", topic="/relay/modules")["msg"]
    assert (topic["current"], topic["reported_at"]) == (False, known["reported_at"])
    assert [each["name"] for each in topic["modules"]] == ["base", "cleaning"]
    world.robot.start_daemon()
    world.robot.wait_online()
    assert world.wait_state("cleaning", "running")["wanted"]
    wait_for("nothing is pending any more", lambda: world.module("cleaning")["pending"] is None)


def test_a_pending_order_needs_the_right_when_it_is_carried_out(world: World) -> None:
    """The user gave the order and lost the right before the robot returned."""
    world.wait_state("cleaning", "running")
    former = world.relay.user("former")
    world.relay.cli("right", "grant", "former", "rover", "owner")
    world.robot.daemon.kill()
    wait_for("it is offline", lambda: not world.ask("GET", "/modules").json["online"])
    assert world.ask("POST", "/modules/cleaning/stop", former).json["pending"]
    world.relay.cli("right", "grant", "former", "rover", "viewer")
    world.robot.start_daemon()
    world.robot.wait_online()
    wait_for("the order is dropped", lambda: world.module("cleaning")["pending"] is None)
    assert world.wait_state("cleaning", "running")["wanted"]
    path = "/api/v1/events?kind=module.ordered&limit=5"

    def errors() -> str:
        found = ask(world.relay.http_port, "GET", path, token=world.owner).json["events"]
        return str([each["data"].get("error") for each in found])

    wait_for("an event says why", lambda: "manage" in errors())
    hidden = ask(world.relay.http_port, "GET", path, token=world.viewer).json["events"]
    assert all(not {"module", "error"} & each["data"].keys() for each in hidden)


def test_modules_of_a_robot_that_was_never_there_are_not_known(world: World) -> None:
    """An order to it may name any module."""
    world.relay.cli("robot", "add", "newcomer")
    world.relay.cli("right", "grant", "owner", "newcomer", "owner")
    here = "/api/v1/robots/newcomer/modules"
    port, token = world.relay.http_port, world.owner
    listed = ask(port, "GET", here, token=token).json
    assert (listed["current"], listed["reported_at"], listed["modules"]) == (False, None, [])
    assert "never reported its modules" in ask(port, "GET", f"{here}/base", token=token).json["detail"]
    assert "it is not known" in world.relay.run_cli("module", "list", "newcomer").stdout
    assert ask(port, "POST", f"{here}/base/start", token=token).json["pending"]
    assert ask(port, "GET", f"{here}/base", token=token).json["state"] == "unknown"


def test_a_stream_ends_with_the_right(world: World) -> None:
    world.wait_state("base", "running")
    leaving = world.relay.user("leaving")
    world.relay.cli("right", "grant", "leaving", "rover", "owner")
    with closing(Stream(world, "/processes?every=0.1", leaving)) as stream:
        wait_for("measurements", lambda: len(stream.events) >= 2)
        world.relay.cli("right", "grant", "leaving", "rover", "viewer")
        wait_for("it ends", lambda: stream.events[-1][0] == "ended")
        assert "manage" in stream.events[-1][1]
