"""The recharge program, with a websocket in memory."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest
from click.testing import CliRunner
from switchboard_socket import Socket

from robot_client.apps.connection import RosbridgeConnection
from robot_client.apps.docking import CHARGING, UNKNOWN, Approach, DockingTopics, Need
from robot_client.apps.driver import BEAT, LATE
from robot_client.apps.recharge import (
    AGAIN,
    CALM,
    FRESH,
    GLIMPSE,
    LOST,
    PATIENCE,
    ROUND,
    SEEKING_TURN,
    Recharge,
    RechargePhase,
    main,
)

DRAINS = 2
STILL = (0.0, 0.0)


class Scene:
    """The program at work, and the robot it hears of."""

    def __init__(self) -> None:
        self.now = 100.0
        self.told: list[str] = []
        self.ahead: float | None = 3.0
        """What the scanner tells, in metres; nothing comes where it is none."""
        self.program = Recharge(
            DockingTopics("/battery_state", "/markers/seen", "/scan"),
            "/cmd_vel",
            7,
            Need(0.2, 0.8),
            Approach(0.45, 0.3, 1.0),
            0.3,
            lambda state, _: self.told.append(state),
            lambda: self.now,
        )
        self.connect()

    def connect(self) -> None:
        """A new line."""
        self.socket = Socket()
        self.socket.reached = True
        self.program.begin(RosbridgeConnection(self.socket))

    def hear(self, topic: str, **message: Any) -> None:
        """Something comes."""
        self.socket.coming.append({"op": "publish", "topic": topic, "msg": message})

    def battery(self, share: float, status: int = DRAINS) -> None:
        """The battery tells its charge."""
        self.hear("/battery_state", percentage=share, power_supply_status=status)

    def marker(self, distance: float, bearing: float, number: int = 7) -> None:
        """The service sees a marker, in two pictures."""
        seen = {"id": number, "distance": distance, "bearing": bearing}
        for _ in range(2):
            self.hear("/markers/seen", data=json.dumps({"markers": [seen]}))

    def step(self, seconds: float = 0.06) -> list[tuple[float, float]]:
        """Some time passes; what was said to the robot meanwhile."""
        before = len(self.socket.driven())
        self.now += seconds
        if self.ahead is not None:
            self.hear("/scan", ranges=[self.ahead], angle_min=0.0, angle_increment=0.1)
        self.program.step()
        while self.socket.coming:
            self.program.step()
        return self.socket.driven()[before:]

    def asked(self, service: str) -> int:
        """How often a service of the relay was asked."""
        return len(self.socket.asked(f"/relay/{service}"))

    def take(self) -> None:
        """The battery is low, and control is given."""
        self.battery(0.1)
        self.step()
        self.step()
        self.socket.answer(service="/relay/take_control")
        self.socket.control(holder="me", you=True)
        assert self.step() == [STILL]
        assert self.program.phase is RechargePhase.SEEKING
        while not self.step():
            """It lets go, as of what it may have been doing a moment ago."""

    def go(self, distance: float = 2.0, bearing: float = 0.0) -> None:
        """It has seen the marker, and drives there."""
        self.take()
        self.marker(distance, bearing)
        self.step()
        assert self.program.phase is RechargePhase.GOING


def test_nothing_is_done_while_the_battery_is_not_low() -> None:
    """Nor before anything is known of it, nor while it charges."""
    scene = Scene()
    assert scene.step() == []
    scene.battery(0.5)
    scene.step()
    scene.battery(0.1, CHARGING)
    assert scene.step() == []
    assert scene.asked("take_control") == 0
    assert scene.told[-1] == "charging"


def test_a_low_battery_brings_the_robot_to_its_charger() -> None:
    """Control, a turn, the way there, a standstill, and control is given back."""
    scene = Scene()
    scene.take()
    assert scene.step() == [(0.0, SEEKING_TURN)]
    scene.marker(2.0, 0.2)
    scene.step()
    assert scene.step() == [(0.3, pytest.approx(0.3))]
    scene.marker(0.44, 0.0)
    assert scene.step()[-1] == STILL
    assert scene.asked("release_control") == 1
    scene.socket.control()
    scene.battery(0.11, CHARGING)
    scene.step()
    assert scene.told[-1] == "charging"
    scene.battery(0.8, CHARGING)
    scene.step()
    assert scene.program.phase is RechargePhase.WATCHING
    assert scene.asked("take_control") == 1


def test_a_robot_that_somebody_drives_is_waited_for() -> None:
    """And said so; nothing is asked of him. Some seconds after he has let go of it is its turn."""
    scene = Scene()
    scene.socket.control(holder="ann")
    scene.battery(0.1)
    for _ in range(20):
        scene.step(1.0)
    assert scene.told[-1] == "the battery is low, and it waits: ann has control"
    assert scene.asked("take_control") == 0
    scene.socket.control()
    scene.step()
    scene.step(CALM - 1.0)
    assert scene.asked("take_control") == 0
    scene.step(1.5)
    assert scene.asked("take_control") == 1


def test_who_took_it_in_the_same_moment_has_it() -> None:
    """The request that came of it is taken back."""
    scene = Scene()
    scene.battery(0.1)
    scene.step()
    scene.step()
    scene.socket.answer(success=False, service="/relay/take_control")
    scene.step()
    assert scene.asked("release_control") == 1
    assert scene.told[-1] == "the battery is low, and it waits: no"
    scene.step(CALM - 1.0)
    assert scene.asked("take_control") == 1


@pytest.mark.parametrize("who", ["asks", "takes", "stops", "loses"])
def test_somebody_else_comes_first(who: str) -> None:
    """Whoever asks for control, has taken it, or has stopped the robot: it stands, and control is given back."""
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
    assert "control given back: " in " ".join(scene.told)
    if who in ("asks", "stops"):
        assert driven[-1] == STILL
        assert scene.asked("release_control") == 1
        assert "ann" in scene.told[-1]
    scene.marker(2.0, 0.0)
    assert scene.step(CALM - 1.0) == []


@pytest.mark.parametrize("what", ["scan", "answer"])
def test_it_does_not_drive_blind(what: str) -> None:
    """Without a scan, or without an answer of the robot, it stands and gives control back."""
    scene = Scene()
    scene.go()
    if what == "scan":
        scene.ahead = None
    else:
        scene.socket.reached = False
        scene.step(BEAT)
    driven = []
    for _ in range(round((LATE + 0.2) / 0.1)):
        scene.marker(2.0, 0.0)
        driven += scene.step(0.1)
    assert driven[-1] == STILL
    assert scene.asked("release_control") >= 1
    assert ("/scan" if what == "scan" else "does not answer") in scene.told[-1]


def test_it_stands_before_what_is_in_the_way() -> None:
    """And goes on when it has gone; after a while control is given back."""
    scene = Scene()
    scene.go()
    scene.ahead = 0.2
    scene.marker(2.0, 0.0)
    assert scene.step()[-1] == STILL
    assert scene.told[-1] == "something is in the way: it stands"
    scene.ahead = 3.0
    scene.marker(2.0, 0.0)
    assert scene.step()[-1] == (0.3, 0.0)
    scene.ahead = 0.2
    for _ in range(math.ceil(PATIENCE / 0.2) + 2):
        scene.marker(2.0, 0.0)
        scene.step(0.2)
    assert scene.asked("release_control") == 1
    assert scene.told[-1] == "the battery is low, and it waits: something is in the way"


def test_a_marker_that_is_lost_is_looked_for_where_it_was() -> None:
    """First it stands, since it may come back."""
    scene = Scene()
    scene.go(bearing=-0.3)
    scene.step(FRESH + 0.1)
    assert scene.socket.driven()[-1] == STILL
    scene.step(LOST)
    assert scene.program.phase is RechargePhase.SEEKING
    assert scene.step() == [(0.0, -SEEKING_TURN)]
    assert "marker 7 is lost: looking for it" in scene.told


def test_a_glimpse_of_a_marker_is_none() -> None:
    """In one picture anything may look like it; it stands for a moment, and goes on looking."""
    scene = Scene()
    scene.take()
    for _ in range(5):
        scene.marker(1.0, 0.5)
        scene.socket.coming.pop()
        assert scene.step()[-1] == STILL
        for _ in range(6):
            scene.step(GLIMPSE / 4)
    assert scene.program.phase is RechargePhase.SEEKING
    assert all(speed == 0.0 for speed, _ in scene.socket.driven())


def test_a_marker_that_is_nowhere_is_given_up_for_a_while() -> None:
    """After a whole turn; another marker is none."""
    scene = Scene()
    scene.take()
    for _ in range(math.ceil(ROUND / SEEKING_TURN / 0.2) + 2):
        scene.marker(1.0, 0.0, number=3)
        scene.step(0.2)
    assert scene.socket.driven()[-1] == STILL
    assert scene.asked("release_control") == 1
    scene.socket.control()
    scene.step()
    assert scene.told[-1] == "the battery is low, and it waits: marker 7 is nowhere around"
    scene.step(AGAIN - 3.0)
    assert scene.asked("take_control") == 1
    scene.step(3.0)
    assert scene.asked("take_control") == 2


def test_without_the_right_to_control_it_says_so() -> None:
    """And asks for nothing."""
    scene = Scene()
    scene.socket.control()
    scene.socket.coming[-1]["msg"]["you"]["may_control"] = False
    scene.battery(0.1)
    scene.step()
    scene.step()
    assert scene.told[-1] == "the battery is low, and it waits: you may not control this robot"
    assert scene.asked("take_control") == 0


def test_what_the_relay_refuses_is_told() -> None:
    """As a topic that may not be heard."""
    scene = Scene()
    scene.socket.coming.append({"op": "status", "level": "error", "msg": "you may not hear /battery_state"})
    scene.step()
    assert scene.told[-1] == "refused: you may not hear /battery_state"


def test_a_command_that_is_refused_has_it_let_go_and_go_on() -> None:
    """As one that came late: zero, silence, and then it drives again."""
    scene = Scene()
    scene.go()
    scene.step()
    scene.socket.coming.append({"op": "status", "level": "error", "msg": "too old"})
    assert scene.step() == [STILL]
    assert "refused: too old" in scene.told
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
    assert scene.socket.driven()[-1] == STILL
    assert scene.socket.sent[-1]["service"] == "/relay/release_control"


def test_a_new_connection_begins_anew() -> None:
    """What was seen before moves nothing."""
    scene = Scene()
    scene.go()
    scene.program.lost("gone", 0.5)
    assert scene.told[-1] == "gone; again in 0.5 s"
    scene.connect()
    assert scene.step() == []
    scene.take()
    assert scene.step() == [(0.0, SEEKING_TURN)]


def test_a_battery_that_charges_on_the_way_ends_it() -> None:
    """Somebody plugged it in."""
    scene = Scene()
    scene.go()
    scene.battery(0.1, CHARGING)
    assert scene.step()[-1] == STILL
    assert scene.asked("release_control") == 1
    scene.step()
    assert scene.told[-1] == "charging"


@pytest.mark.parametrize(("status", "again"), [(DRAINS, True), (UNKNOWN, False)])
def test_a_charger_that_does_not_charge_is_driven_to_again(status: int, again: bool) -> None:
    """After a while, where the battery tells that it does not charge."""
    scene = Scene()
    scene.go()
    scene.marker(0.4, 0.0)
    scene.battery(0.1, status)
    scene.step()
    scene.socket.control()
    scene.step()
    assert scene.told[-1].startswith("stands at marker 7")
    scene.step(AGAIN + 1.0)
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
def test_what_is_wrong_is_said_in_words(arguments: list[str], token: str, words: str) -> None:
    """No token, and options that make no sense."""
    done = CliRunner().invoke(
        main, ["ws://127.0.0.1:1/robots/r", *arguments], env={"SWITCHBOARD_TOKEN": token}
    )
    assert done.exit_code != 0
    assert words in done.output
