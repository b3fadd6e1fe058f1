"""The joystick program, with a pad and a websocket in memory."""

from __future__ import annotations

from typing import Any

import pytest
from click.testing import CliRunner
from switchboard_socket import Socket

from robot_client.apps.connection import RosbridgeConnection
from robot_client.apps.deadman import Curve, Deadman, GamepadState
from robot_client.apps.driver import LATE, MaximumSpeeds
from robot_client.apps.joystick import Joystick, main

LOOSE = GamepadState(0.0, 0.0, False)
CENTRED = GamepadState(0.0, 0.0, True)
AHEAD = GamepadState(1.0, 0.0, True)


class Pad:
    """A pad in memory."""

    name = "pad"

    def __init__(self) -> None:
        self.now: GamepadState | None = LOOSE

    def look(self) -> GamepadState | None:
        return self.now


class Scene:
    """The program at work."""

    def __init__(self) -> None:
        self.now = 100.0
        self.pad = Pad()
        self.told: list[str] = []
        self.program = Joystick(
            self.pad, Deadman(Curve()), "/cmd_vel", MaximumSpeeds(0.4, 1.0), self._tell, lambda: self.now
        )
        self.connect()

    def _tell(self, state: str, details: str) -> None:
        if not self.told or self.told[-1] != state:
            self.told.append(state)

    def connect(self) -> None:
        """A new line."""
        self.socket = Socket()
        self.socket.reached = True
        self.program.begin(RosbridgeConnection(self.socket))

    def look(self, *looks: GamepadState | None, seconds: float = 0.06) -> list[tuple[float, float]]:
        """One look after the other; what was said to the robot then."""
        before = len(self.socket.driven())
        for look in looks:
            self.pad.now = look
            self.now += seconds
            self.program.step()
        return self.socket.driven()[before:]

    def take(self) -> None:
        """Have control, by the button."""
        self.look(LOOSE, CENTRED)
        self.socket.answer(service="/relay/take_control")
        self.look(CENTRED, LOOSE)

    def drive(self) -> None:
        """Drive ahead."""
        self.take()
        assert self.look(CENTRED, AHEAD, AHEAD)[-1] == (pytest.approx(0.4), 0.0)


def test_the_button_takes_control_first_and_drives_when_it_is_pressed_again() -> None:
    """Nothing moves by the press that took it."""
    scene = Scene()
    scene.look(LOOSE, CENTRED)
    assert len(scene.socket.asked("/relay/take_control")) == 1
    scene.socket.answer(service="/relay/take_control")
    assert scene.look(CENTRED, AHEAD, AHEAD) == []
    assert scene.look(LOOSE, CENTRED, AHEAD)[-1] == (pytest.approx(0.4), 0.0)
    assert len(scene.socket.asked("/relay/take_control")) == 1


@pytest.mark.parametrize(
    "last", [LOOSE, GamepadState(1.0, 0.0, False), CENTRED, None], ids=["all", "button", "stick", "unplugged"]
)
def test_every_way_of_letting_go_is_zero_at_once(last: GamepadState | None) -> None:
    """Without waiting for the time of the next command."""
    scene = Scene()
    scene.drive()
    assert scene.look(last, seconds=0.001) == [(0.0, 0.0)]


def test_who_holds_on_with_a_centred_stick_stands() -> None:
    """And drives on by the stick alone."""
    scene = Scene()
    scene.drive()
    assert set(scene.look(CENTRED, CENTRED, CENTRED)) == {(0.0, 0.0)}
    assert scene.look(AHEAD) == [(pytest.approx(0.4), 0.0)]


def test_the_end_is_zero_and_gives_control_back() -> None:
    """In this order."""
    scene = Scene()
    scene.drive()
    scene.program.leave()
    zero, release = scene.socket.sent[-2:]
    assert zero["msg"]["linear"]["x"] == 0.0
    assert release["service"] == "/relay/release_control"


def test_after_a_lost_connection_nothing_is_sent_until_the_stick_was_let_go() -> None:
    """By the new one control is taken anew as well."""
    scene = Scene()
    scene.drive()
    scene.program.lost("gone", 0.5)
    scene.connect()
    scene.socket.control(holder="me", you=True)
    assert scene.look(AHEAD, AHEAD, CENTRED, AHEAD, GamepadState(1.0, 0.0, False), AHEAD) == []
    assert scene.look(LOOSE, CENTRED, AHEAD)[-1] == (pytest.approx(0.4), 0.0)
    assert any("gone" in each for each in scene.told)


def test_a_link_that_is_late_ends_driving() -> None:
    """When it is back, who held on moves nothing."""
    scene = Scene()
    scene.drive()
    scene.socket.reached = False
    commands = scene.look(*[AHEAD] * round((LATE + 0.5) / 0.06))
    assert commands[-1] == (0.0, 0.0)
    assert commands.count((0.0, 0.0)) == 1
    scene.socket.answer(service="/relay/ping")
    assert scene.look(AHEAD, AHEAD) == []


def test_the_stop_button_stops_the_robot_without_control() -> None:
    """Once for each press."""
    scene = Scene()
    pressed = GamepadState(0.0, 0.0, False, stop=True)
    scene.look(pressed, pressed, LOOSE, pressed)
    assert len(scene.socket.asked("/relay/stop")) == 2


def test_a_stop_that_was_not_answered_is_said_again_by_the_next_connection() -> None:
    """What became of it is told."""
    scene = Scene()
    scene.look(GamepadState(0.0, 0.0, False, stop=True), LOOSE)
    assert "stop asked for, not answered yet" in scene.told[-1]
    scene.program.lost("gone", 0.5)
    scene.connect()
    assert scene.socket.sent[0]["service"] == "/relay/stop"
    scene.socket.answer(result=False, service="/relay/stop")
    scene.look(*[LOOSE] * 3)
    assert "stop refused: you may not" in scene.told[-1]


def test_the_stop_button_pressed_without_a_connection_stops_by_the_next() -> None:
    """As long as it is held."""
    scene = Scene()
    pressed = GamepadState(0.0, 0.0, False, stop=True)
    scene.look(pressed)
    scene.socket.answer(service="/relay/stop")
    scene.look(pressed, pressed)
    scene.program.lost("gone", 0.5)
    scene.connect()
    scene.look(pressed)
    assert len(scene.socket.asked("/relay/stop")) == 1


def test_the_stop_button_in_driving_is_zero_and_ends_it() -> None:
    """Though the rest is held on."""
    scene = Scene()
    scene.drive()
    assert scene.look(AHEAD._replace(stop=True)) == [(0.0, 0.0)]
    assert scene.look(AHEAD, AHEAD) == []


def test_a_robot_that_somebody_stopped_is_not_driven_on_after_its_resume() -> None:
    """Until the stick was let go."""
    scene = Scene()
    scene.drive()
    scene.socket.control(holder="me", you=True, stopped="somebody")
    assert scene.look(AHEAD, AHEAD)[-1] == (0.0, 0.0)
    scene.socket.control(holder="me", you=True)
    assert scene.look(AHEAD, AHEAD) == []


def test_the_back_button_gives_control_back() -> None:
    """With a zero before."""
    scene = Scene()
    scene.drive()
    assert scene.look(AHEAD._replace(back=True)) == [(0.0, 0.0)]
    assert scene.socket.sent[-1]["service"] == "/relay/release_control"


def test_the_robots_limits_are_the_ends_of_the_stick() -> None:
    """Half of the stick's way is half of what is allowed, not half of what is cut off."""
    scene = Scene()
    scene.take()
    scene.socket.control(holder="me", you=True, limits={"operator": {"linear": 0.2, "angular": 0.5}})
    scene.socket.status("operator")
    scene.look(CENTRED, CENTRED)
    assert scene.look(AHEAD) == [(pytest.approx(0.2), 0.0)]
    assert scene.look(GamepadState(0.0, 1.0, True)) == [(0.0, pytest.approx(0.5))]
    half = Curve().bend(GamepadState(0.5, 0.0, True)).ahead
    assert scene.look(GamepadState(0.5, 0.0, True)) == [(pytest.approx(0.2 * half), 0.0)]


def test_its_states_are_told_in_words() -> None:
    """From the first to the last."""
    scene = Scene()
    scene.drive()
    scene.look(LOOSE, None)
    assert scene.told == [
        "press the button to take control",
        "let go of stick and button",
        "you have control: let go of stick and button",
        "hold the button to drive",
        "driving",
        "hold the button to drive",
        "no gamepad",
    ]


@pytest.mark.parametrize(
    ("arguments", "token", "words"),
    [
        (["ws://127.0.0.1:1/robots/r"], "", "SWITCHBOARD_TOKEN"),
        (["http://127.0.0.1:1/robots/r"], "t", "no address of a robot"),
        (["ws://127.0.0.1:1/robots/r", "--speed", "-1"], "t", "--speed"),
    ],
)
def test_what_is_wrong_is_said_in_words(arguments: list[str], token: str, words: str) -> None:
    """No token, no address, a speed that makes no sense."""
    done: Any = CliRunner().invoke(main, arguments, env={"SWITCHBOARD_TOKEN": token})
    assert done.exit_code != 0
    assert words in done.output
