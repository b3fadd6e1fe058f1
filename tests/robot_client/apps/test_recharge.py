"""The recharge program, with a websocket in memory."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest
from click.testing import CliRunner

from robot_client.apps.connection import RosbridgeConnection
from robot_client.apps.driver import PING_SECONDS, UNRESPONSIVE_SECONDS
from robot_client.apps.recharge import (
    BACK_OFF_SECONDS,
    BLOCKED_SECONDS,
    CHARGING,
    CONFIRM_SECONDS,
    MARKER_LOST_SECONDS,
    RETRY_SECONDS,
    SEARCH_ANGLE,
    SEEKING_TURN,
    SIGHTING_SECONDS,
    UNKNOWN,
    Approach,
    ChargeNeed,
    DockingTopics,
    Recharge,
    RechargePhase,
    main,
)
from tests.worlds.memory_socket import Socket

DRAINS = 2
ZERO_VELOCITY = (0.0, 0.0)


class Scene:
    """A running program with the robot's messages."""

    def __init__(self) -> None:
        self.now = 100.0
        self.reported: list[str] = []
        self.ahead: float | None = 3.0
        """What the scanner tells, in metres; nothing comes where it is none."""
        self.program = Recharge(
            DockingTopics("/battery_state", "/markers/seen", "/scan"),
            "/cmd_vel",
            7,
            ChargeNeed(0.2, 0.8),
            Approach(0.45, 0.3, 1.0),
            0.3,
            lambda state, _: self.reported.append(state),
            lambda: self.now,
        )
        self.connect()

    def connect(self) -> None:
        """Makes a new connection."""
        self.socket = Socket()
        self.socket.reached = True
        self.program.begin(RosbridgeConnection(self.socket))

    def hear(self, topic: str, **message: Any) -> None:
        """Delivers a message."""
        self.socket.coming.append({"op": "publish", "topic": topic, "msg": message})

    def battery(self, share: float, status: int = DRAINS) -> None:
        """The battery reports its charge."""
        self.hear("/battery_state", percentage=share, power_supply_status=status)

    def marker(self, distance: float, bearing: float, number: int = 7) -> None:
        """The service reports a marker in two images."""
        seen = {"id": number, "distance": distance, "bearing": bearing}
        for _ in range(2):
            self.hear("/markers/seen", data=json.dumps({"markers": [seen]}))

    def step(self, seconds: float = 0.06) -> list[tuple[float, float]]:
        """Lets time pass; returns the commands."""
        before = len(self.socket.driven())
        self.now += seconds
        if self.ahead is not None:
            self.hear("/scan", ranges=[self.ahead], angle_min=0.0, angle_increment=0.1)
        self.program.step()
        while self.socket.coming:
            self.program.step()
        return self.socket.driven()[before:]

    def asked(self, service: str) -> int:
        """The number of calls of a relay's service."""
        return len(self.socket.asked(f"/relay/{service}"))

    def take(self) -> None:
        """The battery is low, and control is granted."""
        self.battery(0.1)
        self.step()
        self.step()
        self.socket.answer(service="/relay/take_control")
        self.socket.control(holder="me", you=True)
        assert self.step() == [ZERO_VELOCITY]
        assert self.program.phase is RechargePhase.SEEKING
        while not self.step():
            """It lets go, as of what it may have been doing a moment ago."""

    def go(self, distance: float = 2.0, bearing: float = 0.0) -> None:
        """It has seen the marker, and drives there."""
        self.take()
        self.marker(distance, bearing)
        self.step()
        assert self.program.phase is RechargePhase.DRIVING


def test_full_battery_needs_no_action() -> None:
    """Nor before the first battery message, nor while charging."""
    scene = Scene()
    assert scene.step() == []
    scene.battery(0.5)
    scene.step()
    scene.battery(0.1, CHARGING)
    assert scene.step() == []
    assert scene.asked("take_control") == 0
    assert scene.reported[-1] == "charging"


def test_a_low_battery_brings_the_robot_to_its_charger() -> None:
    """It takes control, turns, drives there, stands, and releases control."""
    scene = Scene()
    scene.take()
    assert scene.step() == [(0.0, SEEKING_TURN)]
    scene.marker(2.0, 0.2)
    scene.step()
    assert scene.step() == [(0.3, pytest.approx(0.3))]
    scene.marker(0.44, 0.0)
    assert scene.step()[-1] == ZERO_VELOCITY
    assert scene.asked("release_control") == 1
    scene.socket.control()
    scene.battery(0.11, CHARGING)
    scene.step()
    assert scene.reported[-1] == "charging"
    scene.battery(0.8, CHARGING)
    scene.step()
    assert scene.program.phase is RechargePhase.WATCHING
    assert scene.asked("take_control") == 1


def test_recharging_waits_while_the_robot_is_driven() -> None:
    """It reports this without requesting control. It starts some seconds after the driver has released."""
    scene = Scene()
    scene.socket.control(holder="ann")
    scene.battery(0.1)
    for _ in range(20):
        scene.step(1.0)
    assert scene.reported[-1] == "battery low, waiting: ann has control"
    assert scene.asked("take_control") == 0
    scene.socket.control()
    scene.step()
    scene.step(BACK_OFF_SECONDS - 1.0)
    assert scene.asked("take_control") == 0
    scene.step(1.5)
    assert scene.asked("take_control") == 1


def test_simultaneous_take_has_one_winner() -> None:
    """The resulting request is withdrawn."""
    scene = Scene()
    scene.battery(0.1)
    scene.step()
    scene.step()
    scene.socket.answer(success=False, service="/relay/take_control")
    scene.step()
    assert scene.asked("release_control") == 1
    assert scene.reported[-1] == "battery low, waiting: no"
    scene.step(BACK_OFF_SECONDS - 1.0)
    assert scene.asked("take_control") == 1


@pytest.mark.parametrize("who", ["asks", "takes", "stops", "loses"])
def test_other_control_requests_come_first(who: str) -> None:
    """If another user requests control, has taken it, or has stopped the robot, it stands and releases
    control.
    """
    scene = Scene()
    scene.go()
    if who == "asks":
        scene.socket.control(holder="me", you=True)
        scene.socket.coming[-1]["msg"]["request"] = {"user": "ann", "you": False}
    elif who == "stops":
        scene.socket.control(holder="me", you=True, stopped="ann")
    else:
        scene.socket.control(holder="ann" if who == "takes" else "")
    driven = scene.step()
    assert scene.program.phase is RechargePhase.WAITING
    assert "control released: " in " ".join(scene.reported)
    if who in ("asks", "stops"):
        assert driven[-1] == ZERO_VELOCITY
        assert scene.asked("release_control") == 1
        assert "ann" in scene.reported[-1]
    scene.marker(2.0, 0.0)
    assert scene.step(BACK_OFF_SECONDS - 1.0) == []


@pytest.mark.parametrize("what", ["scan", "answer"])
def test_it_does_not_drive_blind(what: str) -> None:
    """Without a scan, or without an answer of the robot, it stands and releases control."""
    scene = Scene()
    scene.go()
    if what == "scan":
        scene.ahead = None
    else:
        scene.socket.reached = False
        scene.step(PING_SECONDS)
    driven = []
    for _ in range(round((UNRESPONSIVE_SECONDS + 0.2) / 0.1)):
        scene.marker(2.0, 0.0)
        driven += scene.step(0.1)
    assert driven[-1] == ZERO_VELOCITY
    assert scene.asked("release_control") >= 1
    assert ("/scan" if what == "scan" else "does not answer") in scene.reported[-1]


def test_it_stands_before_an_obstacle() -> None:
    """It goes on when the obstacle is gone, and releases control after a while."""
    scene = Scene()
    scene.go()
    scene.ahead = 0.2
    scene.marker(2.0, 0.0)
    assert scene.step()[-1] == ZERO_VELOCITY
    assert scene.reported[-1] == "stopped: obstacle ahead"
    scene.ahead = 3.0
    scene.marker(2.0, 0.0)
    assert scene.step()[-1] == (0.3, 0.0)
    scene.ahead = 0.2
    for _ in range(math.ceil(BLOCKED_SECONDS / 0.2) + 2):
        scene.marker(2.0, 0.0)
        scene.step(0.2)
    assert scene.asked("release_control") == 1
    assert scene.reported[-1] == "battery low, waiting: an obstacle is ahead"


def test_a_marker_that_is_lost_is_looked_for_where_it_was() -> None:
    """First it stands, since the marker may reappear."""
    scene = Scene()
    scene.go(bearing=-0.3)
    scene.step(SIGHTING_SECONDS + 0.1)
    assert scene.socket.driven()[-1] == ZERO_VELOCITY
    scene.step(MARKER_LOST_SECONDS)
    assert scene.program.phase is RechargePhase.SEEKING
    assert scene.step() == [(0.0, -SEEKING_TURN)]
    assert "marker 7 is lost: looking for it" in scene.reported


def test_a_marker_in_one_image_does_not_count() -> None:
    """A single image may contain a false marker; it stands for a moment, and searches on."""
    scene = Scene()
    scene.take()
    for _ in range(5):
        scene.marker(1.0, 0.5)
        scene.socket.coming.pop()
        assert scene.step()[-1] == ZERO_VELOCITY
        for _ in range(6):
            scene.step(CONFIRM_SECONDS / 4)
    assert scene.program.phase is RechargePhase.SEEKING
    assert all(speed == 0.0 for speed, _ in scene.socket.driven())


def test_a_marker_that_is_nowhere_is_given_up_for_a_while() -> None:
    """After a full turn; other markers do not count."""
    scene = Scene()
    scene.take()
    for _ in range(math.ceil(SEARCH_ANGLE / SEEKING_TURN / 0.2) + 2):
        scene.marker(1.0, 0.0, number=3)
        scene.step(0.2)
    assert scene.socket.driven()[-1] == ZERO_VELOCITY
    assert scene.asked("release_control") == 1
    scene.socket.control()
    scene.step()
    assert scene.reported[-1] == "battery low, waiting: marker 7 was not found"
    scene.step(RETRY_SECONDS - 3.0)
    assert scene.asked("take_control") == 1
    scene.step(3.0)
    assert scene.asked("take_control") == 2


def test_without_the_right_to_control_it_reports_so() -> None:
    """It makes no request."""
    scene = Scene()
    scene.socket.control()
    scene.socket.coming[-1]["msg"]["you"]["may_control"] = False
    scene.battery(0.1)
    scene.step()
    scene.step()
    assert scene.reported[-1] == "battery low, waiting: you may not control this robot"
    assert scene.asked("take_control") == 0


def test_refusal_of_the_relay_is_reported() -> None:
    """For example a topic without the right to subscribe."""
    scene = Scene()
    scene.socket.coming.append({"op": "status", "level": "error", "msg": "you may not hear /battery_state"})
    scene.step()
    assert scene.reported[-1] == "refused: you may not hear /battery_state"


def test_after_a_refused_command_it_releases_control_and_goes_on() -> None:
    """For example after a late one: zero, a pause, and then it drives again."""
    scene = Scene()
    scene.go()
    scene.step()
    scene.socket.coming.append({"op": "status", "level": "error", "msg": "too old"})
    assert scene.step() == [ZERO_VELOCITY]
    assert "refused: too old" in scene.reported
    silent = 0.0
    while not (driven := scene.step()):
        silent += 0.06
        scene.marker(2.0, 0.0)
    assert 0.5 < silent < 1.5
    assert driven[-1] == (0.3, 0.0)


def test_leaving_is_zero_and_gives_control_back() -> None:
    """In this order."""
    scene = Scene()
    scene.go()
    scene.program.leave()
    assert scene.socket.driven()[-1] == ZERO_VELOCITY
    assert scene.socket.sent[-1]["service"] == "/relay/release_control"


def test_a_new_connection_starts_from_nothing() -> None:
    """Earlier messages move nothing."""
    scene = Scene()
    scene.go()
    scene.program.lost("gone", 0.5)
    assert scene.reported[-1] == "gone; again in 0.5 s"
    scene.connect()
    assert scene.step() == []
    scene.take()
    assert scene.step() == [(0.0, SEEKING_TURN)]


def test_a_battery_that_charges_meanwhile_ends_it() -> None:
    """The robot was plugged in."""
    scene = Scene()
    scene.go()
    scene.battery(0.1, CHARGING)
    assert scene.step()[-1] == ZERO_VELOCITY
    assert scene.asked("release_control") == 1
    scene.step()
    assert scene.reported[-1] == "charging"


@pytest.mark.parametrize(("status", "again"), [(DRAINS, True), (UNKNOWN, False)])
def test_a_charger_that_does_not_charge_is_driven_to_again(status: int, again: bool) -> None:
    """After a while, if the battery reports that it is not charging."""
    scene = Scene()
    scene.go()
    scene.marker(0.4, 0.0)
    scene.battery(0.1, status)
    scene.step()
    scene.socket.control()
    scene.step()
    assert scene.reported[-1].startswith("stands at marker 7")
    scene.step(RETRY_SECONDS + 1.0)
    scene.step()
    scene.step()
    assert scene.asked("take_control") == (2 if again else 1)


@pytest.mark.parametrize(
    ("arguments", "token", "words"),
    [
        ([], "", "SWITCHBOARD_TOKEN"),
        (["--low", "50", "--enough", "40"], "t", "--enough (40) must be more than --low (50)"),
        (["--clear", "0.5"], "t", "--clear (0.5) must be less than --distance (0.45)"),
        (["--marker", "-1"], "t", "--marker"),
    ],
)
def test_error_is_explained(arguments: list[str], token: str, words: str) -> None:
    """No token and invalid options."""
    done = CliRunner().invoke(
        main, ["ws://127.0.0.1:1/robots/r", *arguments], env={"SWITCHBOARD_TOKEN": token}
    )
    assert done.exit_code != 0
    assert words in done.output
