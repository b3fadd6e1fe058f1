"""Several users share a robot: one moves it, all may stop it, and no failure reverts a stop."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from relay_server.cli.admin_socket_client import ask_status
from tests.worlds.driving import LATE_MS
from tests.worlds.http_requests import Answer, ask
from tests.worlds.machine_pauses import Pulse
from tests.worlds.relay_process import Relay
from tests.worlds.robot_process import Robot
from tests.worlds.sync_client import Client
from tests.worlds.waiting import wait_for

CLIENTS = Path(__file__).parent / "clients"
LET_GO_SECONDS = 0.8
"""Silence of half a second is letting go, and as long as pings leave in doubt when somebody spoke."""
PAUSE = 0.3
"""Who has said nothing for so many seconds, as far as he knows, may have let go as far as the robot knows."""
LEVELS = {"olga": "owner", "ann": "operator", "bob": "operator", "vic": "viewer"}

MOMENT = "switchboard-freshness"


class ControlWorld:
    """A relay with a robot and four users."""

    def __init__(self, folder: Path) -> None:
        self.relay = Relay(folder, "--heartbeat", "0.5")
        self.robot = Robot(self.relay, "rover")
        self.pause = 0.0
        """The longest that somebody who drives has said nothing, seconds; on a slow machine he lets go by it."""
        self.tokens = {name: self.relay.user(name) for name in LEVELS}
        for name, level in LEVELS.items():
            self.relay.cli("right", "grant", name, "rover", level)

    def connect(self, name: str) -> Client:
        """A user's connection that receives errors."""
        client = self.relay.connect("rover", self.tokens[name])
        client.send(op="set_level", level="error")
        return client

    def http(self, method: str, part: str, name: str, body: Any = None) -> Answer:
        """A request below the robot's address."""
        path, token = f"/api/v1/robots/rover/{part}", self.tokens[name]
        dated = {} if part != "resume" else {MOMENT: self.http("GET", "control", name).headers[MOMENT]}
        return ask(self.relay.http_port, method, path, body, headers=dated, token=token)

    def control(self, name: str = "olga") -> dict[str, Any]:
        """The robot's control."""
        return dict(self.http("GET", "control", name).json)

    def moves(self) -> None:
        """Waits until the robot moves, by its own log."""
        wait_for("the robot moves", self.robot.moving)

    def stands(self) -> None:
        """Waits until it stands."""
        wait_for("the robot stands", lambda: not self.robot.moving())

    @contextmanager
    def driving(self, name: str, v: float = 0.2) -> Iterator[Client]:
        """A user drives at 20 Hz after a pause, without reading; see :attr:`pause`."""
        time.sleep(LET_GO_SECONDS)  # a pause this long counts as a release
        with self.connect(name) as client:
            client.send(op="set_level", level="none")
            end = threading.Event()

            def drive() -> None:
                before = time.monotonic()
                while not end.wait(0.05):
                    client.drive(v)
                    self.pause = max(self.pause, time.monotonic() - before)
                    before = time.monotonic()

            thread = threading.Thread(target=drive)
            thread.start()
            try:
                yield client
            finally:
                end.set()
                thread.join(10)

    def stop(self) -> None:
        self.robot.stop()
        self.relay.stop()


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ControlWorld]:
    """One for all: each test leaves the robot without a controller and not stopped."""
    scene = ControlWorld(tmp_path_factory.mktemp("control"))
    try:
        yield scene
    finally:
        scene.stop()


def test_handover_between_two_roslibpy_users(scene: ControlWorld) -> None:
    """The first drives without asking for control; the second requests it, gets it, and only the second moves
    the robot.
    """
    program = [sys.executable, str(CLIENTS / "handing_over_with_roslibpy.py")]
    done = subprocess.run(
        [*program, scene.relay.url("rover"), scene.tokens["ann"], scene.tokens["bob"]],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    seen = json.loads(done.stdout)
    assert all(seen[what] for what in ("free", "held", "requested", "handed over"))
    assert seen["asked"] == {"success": False, "message": "ann has control and was asked for it"}
    assert (seen["granted"]["success"], seen["released"]["success"]) == (True, True)
    after = wait_for(
        "the second moves it",
        lambda: [each["v"] for each in scene.robot.events("command", seen["since"]) if each["v"]],
    )
    assert all(v < 0 for v in after), "the first moved it after he had handed it over"

    def first_actions() -> list[str]:
        actions = [entry["action"] for entry in scene.relay.cli("audit", "list")]
        return [action for action in actions if action.startswith("control.")][:5]

    wait_for("all is in the audit log", lambda: len(first_actions()) == 5)
    assert first_actions() == [
        "control.taken",
        "control.requested",
        "control.granted",
        "control.taken",
        "control.released",
    ]


def test_taking_control_again_without_a_release_moves_nothing(scene: ControlWorld) -> None:
    """An owner takes control from a driver who goes on commanding, and takes it back: the robot stands until
    the driver pauses.
    """
    with scene.driving("ann") as ann:

        def holds_on() -> bool:
            scene.moves()
            scene.pause = 0.0
            assert scene.http("POST", "control/release", "olga", {"why": "a rest"}).status == 200
            scene.stands()
            time.sleep(LET_GO_SECONDS)  # the robot receives none of these commands, so for it this is a pause
            assert ann.call("/relay/take_control")["values"]["success"]
            assert scene.control("ann")["holder"]["user"] == "ann"
            time.sleep(0.3)  # shows absence: the commands go on without effect
            moved = scene.robot.moving()
            if moved and scene.pause >= PAUSE:
                return False
            assert not moved
            return True

        wait_for("he says nothing for no moment", holds_on)
        ann.drive(0.0)
        scene.moves()
    scene.stands()


def test_a_viewer_stops_the_driver_and_may_not_resume(scene: ControlWorld) -> None:
    """The robot stands at once and stays stopped; the controller resumes it, and moves it after a pause."""
    with scene.driving("ann") as ann, scene.connect("vic") as vic, Pulse() as pulse:
        scene.moves()
        since = time.monotonic_ns()
        assert vic.call("/relay/stop", {"why": "somebody is in the way"})["values"]["success"]
        scene.stands()
        took_ms = (scene.robot.events("standstill", since)[0]["t"] - since) / 1e6
        assert took_ms < LATE_MS + 1000 * pulse.held_up()
        refused = vic.call("/relay/resume")
        assert refused["result"] is False
        assert "only the holder of control" in refused["values"]
        assert scene.http("POST", "resume", "bob").status == 403
        stopped = scene.control("vic")["stopped"]
        assert (stopped["by"], stopped["why"], stopped["confirmed"]) == (
            "vic",
            "somebody is in the way",
            True,
        )
        assert scene.control("ann")["holder"]["user"] == "ann"
        wait_for(
            "she may say so after the stop",
            lambda: ann.call("/relay/resume", {"why": "he is gone"})["result"],
        )
        assert scene.control("ann")["stopped"] is None
        assert vic.call("/relay/ping", {"robot": True})["result"]
        time.sleep(0.3)  # shows absence: the commands go on without effect
        assert not scene.robot.moving()
    with scene.driving("ann"):
        scene.moves()
    scene.stands()


def test_a_stop_survives_the_relay_and_the_daemon(scene: ControlWorld) -> None:
    """kill -9 of both: the robot comes back stopped, and an owner resumes it."""
    with scene.driving("ann"):
        scene.moves()
        assert scene.http("POST", "stop", "vic", {"why": "smoke"}).status == 200
    scene.stands()
    scene.relay.kill()
    scene.robot.daemon.kill()
    scene.relay.start()
    scene.robot.start_daemon()
    scene.robot.wait_online()
    wait_for("it reports that it is stopped", lambda: scene.control()["stopped"])
    assert scene.control()["stopped"]["why"] == "smoke"
    since = time.monotonic_ns()
    with scene.driving("ann"):
        wait_for("he has control", lambda: scene.control()["holder"])
        time.sleep(0.5)  # shows absence: the commands go on without effect
    assert not [each for each in scene.robot.events("command", since) if each["v"]]
    assert scene.http("POST", "resume", "olga", {"why": "it was toast"}).json == {"stopped": None}
    with scene.driving("ann"):
        scene.moves()
    scene.stands()


def test_a_robot_that_is_away_is_stopped_when_it_comes_back(scene: ControlWorld) -> None:
    """By the command line, even without a running relay; the stop comes before any command."""
    scene.robot.daemon.stop()
    wait_for("the robot is offline", lambda: scene.relay.state_of("rover") == "offline")
    (answer,) = scene.relay.cli("stop", "rover", "--why", "maintenance")["robots"]
    assert (answer["robot"], answer["done"], answer["stopped"]["why"]) == ("rover", False, "maintenance")
    wait_for("it is pending", lambda: scene.control()["stopped"])
    assert scene.control()["stopped"]["confirmed"] is False
    assert scene.http("POST", "stop", "vic").status == 202
    # A resume does not end a stop that its relay does not know of yet.
    wait_for("the relay knows it", lambda: "'vic'" in str(ask_status(scene.relay.data)["robots"]))
    scene.relay.cli("resume", "rover")
    wait_for("it is withdrawn", lambda: scene.control()["stopped"] is None)
    scene.relay.stop()
    assert scene.relay.cli("stop", "--all") == {"robots": [{"robot": "rover", "done": False}]}
    scene.relay.start()
    wait_for("it is pending", lambda: scene.control()["stopped"])
    assert scene.control()["stopped"]["confirmed"] is False
    scene.robot.start_daemon()
    scene.robot.wait_online()
    wait_for("it has confirmed it", lambda: scene.control()["stopped"]["confirmed"])
    shown = ask(scene.relay.http_port, "GET", "/api/v1/robots", token=scene.tokens["vic"]).json["robots"][0]
    assert shown["stopped"]["confirmed"] is True
    assert "may move again" in scene.relay.run_cli("resume", "rover").stdout
    wait_for("it is resumed", lambda: scene.control()["stopped"] is None)


def test_a_right_that_is_revoked_ends_control(scene: ControlWorld) -> None:
    """The robot stands, and another user takes control."""
    with scene.driving("bob"):
        scene.moves()
        scene.relay.cli("right", "grant", "bob", "rover", "viewer")
        scene.stands()
        with scene.driving("ann"):
            scene.moves()
            assert scene.control()["holder"]["user"] == "ann"
    scene.relay.cli("right", "grant", "bob", "rover", "operator")
    scene.stands()


def test_an_owner_suppresses_the_driver(scene: ControlWorld) -> None:
    """While it is renewed only the owner moves the robot; after that the driver does, following a pause."""
    with scene.driving("ann", 0.2), scene.connect("olga") as olga:
        scene.moves()

        def suppressed() -> bool:
            since = 0
            for renewal in range(24):
                if renewal == 4:
                    since = time.monotonic_ns()
                order = {"resource": "/cmd_vel", "ms": 200}
                olga.send(op="call_service", service="/relay/suppress", args=order)
                olga.drive(-0.1)
                time.sleep(0.05)  # the driver's rate
            commands = [each["v"] for each in scene.robot.events("command", since)]
            # Suppression ends after 200 ms: a pause of this process or of the relay lets the driver's
            # commands through.
            return min(commands) < 0 and max(commands) <= 0

        wait_for("a second passes without a command of the driver", suppressed)
        assert scene.control()["holder"]["user"] == "ann"
    scene.stands()


def test_an_inhibited_topic_sends_nothing(scene: ControlWorld) -> None:
    """For all clients during the given time; it needs the right."""
    with scene.connect("vic") as vic:
        vic.send(op="subscribe", topic="/odom", type="nav_msgs/msg/Odometry")
        vic.until(op="publish", topic="/odom")
        assert scene.http("POST", "inhibit", "ann", {"resource": "/odom"}).status == 403
        begun = time.monotonic()
        assert scene.http("POST", "inhibit", "olga", {"resource": "/odom", "ms": 1500}).status == 200
        assert vic.call("/relay/ping", {"robot": True})["result"]
        vic.until(op="publish", topic="/odom")
        assert time.monotonic() - begun > 1.4
        assert [each["resource"] for each in scene.control("vic")["inhibited"]] == []
