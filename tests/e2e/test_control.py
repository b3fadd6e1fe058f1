"""Several people share a robot: one moves it, everybody may stop it, and no failure takes a stop back."""

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
from switchboard_client import Client
from switchboard_drive import LATE_MS
from switchboard_http import Answer, ask
from switchboard_pulse import Pulse
from switchboard_relay import Relay
from switchboard_robot import Robot
from switchboard_waiting import wait_for

CLIENTS = Path(__file__).parent / "clients"
LET_GO_SECONDS = 0.8
"""Silence of half a second is letting go, and as long as pings leave in doubt when somebody spoke."""
PAUSE = 0.3
"""Who has said nothing for so many seconds, as far as he knows, may have let go as far as the robot knows."""
LEVELS = {"olga": "owner", "ann": "operator", "bob": "operator", "vic": "viewer"}

MOMENT = "switchboard-moment"


class Place:
    """A relay with a robot and four people."""

    def __init__(self, folder: Path) -> None:
        self.relay = Relay(folder, "--heartbeat", "0.5")
        self.robot = Robot(self.relay, "rover")
        self.pause = 0.0
        """The longest that somebody who drives has said nothing, seconds; on a slow machine he lets go by it."""
        self.tokens = {name: self.relay.user(name) for name in LEVELS}
        for name, level in LEVELS.items():
            self.relay.cli("right", "grant", name, "rover", level)

    def connect(self, name: str) -> Client:
        """A connection of one of them, who hears of errors."""
        client = self.relay.connect("rover", self.tokens[name])
        client.send(op="set_level", level="error")
        return client

    def http(self, method: str, part: str, name: str, body: Any = None) -> Answer:
        """A request below the robot's address."""
        path, token = f"/api/v1/robots/rover/{part}", self.tokens[name]
        dated = {} if part != "resume" else {MOMENT: self.http("GET", "control", name).headers[MOMENT]}
        return ask(self.relay.http_port, method, path, body, headers=dated, token=token)

    def control(self, name: str = "olga") -> dict[str, Any]:
        """Who moves the robot."""
        return dict(self.http("GET", "control", name).json)

    def moves(self) -> None:
        """Wait until the robot moves, by its own record."""
        wait_for("the robot moves", self.robot.moving)

    def stands(self) -> None:
        """Wait until it stands."""
        wait_for("the robot stands", lambda: not self.robot.moving())

    @contextmanager
    def driving(self, name: str, v: float = 0.2) -> Iterator[Client]:
        """Somebody who has let go drives, at 20 Hz, and hears nothing meanwhile; see :attr:`pause`."""
        time.sleep(LET_GO_SECONDS)  # so long he must say nothing
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
        """End everything."""
        self.robot.stop()
        self.relay.stop()


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Place]:
    """One for all: each test leaves the robot free, and not stopped."""
    place = Place(tmp_path_factory.mktemp("control"))
    try:
        yield place
    finally:
        place.stop()


def test_two_roslibpy_users_hand_a_robot_over(place: Place) -> None:
    """The first drives without a word about control; the second asks, gets it, and only he moves the robot."""
    program = [sys.executable, str(CLIENTS / "handing_over_with_roslibpy.py")]
    done = subprocess.run(
        [*program, place.relay.url("rover"), place.tokens["ann"], place.tokens["bob"]],
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
    after = [each["v"] for each in place.robot.events("command", seen["since"]) if each["v"]]
    assert after
    assert all(v < 0 for v in after), "the first moved it after he had handed it over"
    actions = [entry["action"] for entry in place.relay.cli("audit", "list")]
    in_order = [action for action in actions if action.startswith("control.")]
    assert in_order[:5] == [
        "control.taken",
        "control.requested",
        "control.granted",
        "control.taken",
        "control.released",
    ]


def test_who_never_let_go_moves_nothing_by_taking_control_again(place: Place) -> None:
    """An owner takes control from who drives; he holds on, takes it back, and the robot stands until he lets go."""
    with place.driving("ann") as ann:

        def holds_on() -> bool:
            place.moves()
            place.pause = 0.0
            assert place.http("POST", "control/release", "olga", {"why": "a rest"}).status == 200
            place.stands()
            time.sleep(LET_GO_SECONDS)  # to the robot, which hears nothing of him, that is silence
            assert ann.call("/relay/take_control")["values"]["success"]
            assert place.control("ann")["holder"]["user"] == "ann"
            time.sleep(0.3)  # he still holds the stick: nothing may come of it
            moved = place.robot.moving()
            if moved and place.pause >= PAUSE:
                return False
            assert not moved
            return True

        wait_for("he says nothing for no moment", holds_on)
        ann.drive(0.0)
        place.moves()
    place.stands()


def test_a_viewer_stops_who_drives_and_may_not_resume(place: Place) -> None:
    """The robot stands at once and stays so; who holds control lets it move again, once he has let go."""
    with place.driving("ann") as ann, place.connect("vic") as vic, Pulse() as pulse:
        place.moves()
        since = time.monotonic_ns()
        assert vic.call("/relay/stop", {"why": "somebody is in the way"})["values"]["success"]
        place.stands()
        took_ms = (place.robot.events("standstill", since)[0]["t"] - since) / 1e6
        assert took_ms < LATE_MS + 1000 * pulse.lost()
        refused = vic.call("/relay/resume")
        assert refused["result"] is False
        assert "only who has control" in refused["values"]
        assert place.http("POST", "resume", "bob").status == 403
        stopped = place.control("vic")["stopped"]
        assert (stopped["by"], stopped["why"], stopped["told"]) == ("vic", "somebody is in the way", True)
        assert place.control("ann")["holder"]["user"] == "ann"
        wait_for(
            "she may say so after the stop",
            lambda: ann.call("/relay/resume", {"why": "he is gone"})["result"],
        )
        assert place.control("ann")["stopped"] is None
        assert vic.call("/relay/ping", {"robot": True})["result"]
        time.sleep(0.3)  # he still holds the stick: nothing may come of it
        assert not place.robot.moving()
    with place.driving("ann"):
        place.moves()
    place.stands()


def test_a_stop_survives_the_relay_and_the_daemon(place: Place) -> None:
    """kill -9 of both: the robot comes back stopped, and an owner resumes it."""
    with place.driving("ann"):
        place.moves()
        assert place.http("POST", "stop", "vic", {"why": "smoke"}).status == 200
    place.stands()
    place.relay.kill()
    place.robot.daemon.kill()
    place.relay.start()
    place.robot.start_daemon()
    place.robot.wait_online()
    wait_for("it tells that it is stopped", lambda: place.control()["stopped"])
    assert place.control()["stopped"]["why"] == "smoke"
    since = time.monotonic_ns()
    with place.driving("ann"):
        wait_for("he has control", lambda: place.control()["holder"])
        time.sleep(0.5)  # he drives on: nothing may come of it
    assert not [each for each in place.robot.events("command", since) if each["v"]]
    assert place.http("POST", "resume", "olga", {"why": "it was toast"}).json == {"stopped": None}
    with place.driving("ann"):
        place.moves()
    place.stands()


def test_a_robot_that_is_away_is_stopped_when_it_comes_back(place: Place) -> None:
    """By the command line, also when no relay runs; before anybody can drive it."""
    place.robot.daemon.stop()
    wait_for("the robot is offline", lambda: place.relay.state_of("rover") == "offline")
    assert place.relay.cli("stop", "rover", "--why", "maintenance") == {
        "robots": [{"robot": "rover", "done": False}]
    }
    assert place.control()["stopped"]["told"] is False
    assert place.http("POST", "stop", "vic").status == 202
    place.relay.cli("resume", "rover")
    assert place.control()["stopped"] is None
    place.relay.stop()
    assert place.relay.cli("stop", "--all") == {"robots": [{"robot": "rover", "done": False}]}
    place.relay.start()
    assert place.control()["stopped"]["told"] is False
    place.robot.start_daemon()
    place.robot.wait_online()
    wait_for("it has confirmed it", lambda: place.control()["stopped"]["told"])
    shown = ask(place.relay.http_port, "GET", "/api/v1/robots", token=place.tokens["vic"]).json["robots"][0]
    assert shown["stopped"]["told"] is True
    assert "may move again" in place.relay.run_cli("resume", "rover").stdout
    assert place.control()["stopped"] is None


def test_a_right_that_is_revoked_ends_control(place: Place) -> None:
    """The robot stands, and somebody else takes it."""
    with place.driving("bob"):
        place.moves()
        place.relay.cli("right", "grant", "bob", "rover", "viewer")
        place.stands()
        with place.driving("ann"):
            place.moves()
            assert place.control()["holder"]["user"] == "ann"
    place.relay.cli("right", "grant", "bob", "rover", "operator")
    place.stands()


def test_an_owner_suppresses_who_drives(place: Place) -> None:
    """For as long as it is renewed only he moves the robot; then it is the driver's again, once he has let go."""
    with place.driving("ann", 0.2), place.connect("olga") as olga:
        place.moves()

        def suppressed() -> bool:
            since = 0
            with Pulse() as pulse:
                for renewal in range(20):
                    if renewal == 4:
                        since = time.monotonic_ns()
                    order = {"resource": "/cmd_vel", "ms": 200}
                    olga.send(op="call_service", service="/relay/suppress", args=order)
                    olga.drive(-0.1)
                    time.sleep(0.05)  # the pace of a driver
                commands = [each["v"] for each in place.robot.events("command", since)]
                if pulse.lost():
                    return False
            assert min(commands) < 0
            assert max(commands) <= 0, "the driver's commands came through"
            return True

        wait_for("it is renewed without a pause", suppressed)
        assert place.control()["holder"]["user"] == "ann"
    place.stands()


def test_an_inhibited_topic_says_nothing(place: Place) -> None:
    """To anybody, for so long; it takes the right to."""
    with place.connect("vic") as vic:
        vic.send(op="subscribe", topic="/odom", type="nav_msgs/msg/Odometry")
        vic.until(op="publish", topic="/odom")
        assert place.http("POST", "inhibit", "ann", {"resource": "/odom"}).status == 403
        begun = time.monotonic()
        assert place.http("POST", "inhibit", "olga", {"resource": "/odom", "ms": 1500}).status == 200
        assert vic.call("/relay/ping", {"robot": True})["result"]
        vic.until(op="publish", topic="/odom")
        assert time.monotonic() - begun > 1.4
        assert [each["resource"] for each in place.control("vic")["inhibited"]] == []
