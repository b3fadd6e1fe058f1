"""The joystick program, with a gamepad and a websocket in memory."""

from __future__ import annotations

from typing import Any

import pytest
from click.testing import CliRunner

from robot_client.apps.connection import RosbridgeConnection
from robot_client.apps.driver import UNRESPONSIVE_SECONDS, MaximumSpeeds
from robot_client.apps.joystick import Deadman, GamepadState, Joystick, StickCurve, main
from tests.worlds.memory_socket import Socket

LOOSE = GamepadState(0.0, 0.0, False)
CENTRED = GamepadState(0.0, 0.0, True)
AHEAD = GamepadState(1.0, 0.0, True)


class Pad:
    """A gamepad in memory."""

    problem = ""

    def __init__(self) -> None:
        self.now: GamepadState | None = LOOSE

    def read(self) -> GamepadState | None:
        return self.now


class Scene:
    """A running program."""

    def __init__(self) -> None:
        self.now = 100.0
        self.pad = Pad()
        self.reported: list[str] = []
        self.program = Joystick(
            self.pad, Deadman(StickCurve()), "/cmd_vel", MaximumSpeeds(0.4, 1.0), self._tell, lambda: self.now
        )
        self.connect()

    def _tell(self, state: str, details: str) -> None:
        if not self.reported or self.reported[-1] != state:
            self.reported.append(state)

    def connect(self) -> None:
        """Makes a new connection."""
        self.socket = Socket()
        self.socket.reached = True
        self.program.begin(RosbridgeConnection(self.socket))

    def look(self, *looks: GamepadState | None, seconds: float = 0.06) -> list[tuple[float, float]]:
        """Polls repeatedly; returns the commands."""
        before = len(self.socket.driven())
        for look in looks:
            self.pad.now = look
            self.now += seconds
            self.program.step()
        return self.socket.driven()[before:]

    def take(self) -> None:
        """Takes control with the button."""
        self.look(LOOSE, CENTRED)
        self.socket.answer(service="/relay/take_control")
        self.look(CENTRED, LOOSE)

    def drive(self) -> None:
        """Drives ahead."""
        self.take()
        assert self.look(CENTRED, AHEAD, AHEAD)[-1] == (pytest.approx(0.4), 0.0)


def test_the_button_takes_control_first_and_drives_when_it_is_pressed_again() -> None:
    """The press that takes control moves nothing."""
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
def test_every_release_sends_zero_at_once(last: GamepadState | None) -> None:
    """Before the next command is due."""
    scene = Scene()
    scene.drive()
    assert scene.look(last, seconds=0.001) == [(0.0, 0.0)]


def test_centred_stick_keeps_the_robot_still() -> None:
    """The stick alone continues the drive."""
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


def test_after_a_lost_connection_nothing_is_sent_until_the_stick_was_released() -> None:
    """The new connection also takes control again."""
    scene = Scene()
    scene.drive()
    scene.program.lost("gone", 0.5)
    scene.connect()
    scene.socket.control(holder="me", you=True)
    assert scene.look(AHEAD, AHEAD, CENTRED, AHEAD, GamepadState(1.0, 0.0, False), AHEAD) == []
    assert scene.look(LOOSE, CENTRED, AHEAD)[-1] == (pytest.approx(0.4), 0.0)
    assert any("gone" in each for each in scene.reported)


def test_a_link_that_is_late_ends_driving() -> None:
    """When it has recovered, held controls move nothing."""
    scene = Scene()
    scene.drive()
    scene.socket.reached = False
    commands = scene.look(*[AHEAD] * round((UNRESPONSIVE_SECONDS + 0.5) / 0.06))
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


def test_an_unanswered_stop_is_sent_again_by_the_next_connection() -> None:
    """Its result is shown."""
    scene = Scene()
    scene.look(GamepadState(0.0, 0.0, False, stop=True), LOOSE)
    assert "stop requested, not confirmed yet" in scene.reported[-1]
    scene.program.lost("gone", 0.5)
    scene.connect()
    assert scene.socket.sent[0]["service"] == "/relay/stop"
    scene.socket.answer(result=False, service="/relay/stop")
    scene.look(*[LOOSE] * 3)
    assert "stop refused: you may not" in scene.reported[-1]


def test_the_stop_button_pressed_without_a_connection_stops_by_the_next() -> None:
    """While it is held."""
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
    """Even if the other controls are held."""
    scene = Scene()
    scene.drive()
    assert scene.look(AHEAD._replace(stop=True)) == [(0.0, 0.0)]
    assert scene.look(AHEAD, AHEAD) == []


def test_a_stopped_robot_is_not_driven_on_after_its_resume() -> None:
    """The stick has to be released first."""
    scene = Scene()
    scene.drive()
    scene.socket.control(holder="me", you=True, stopped="somebody")
    assert scene.look(AHEAD, AHEAD)[-1] == (0.0, 0.0)
    scene.socket.control(holder="me", you=True)
    assert scene.look(AHEAD, AHEAD) == []


def test_the_back_button_gives_control_back() -> None:
    """After a zero."""
    scene = Scene()
    scene.drive()
    assert scene.look(AHEAD._replace(back=True)) == [(0.0, 0.0)]
    assert scene.socket.sent[-1]["service"] == "/relay/release_control"


def test_the_robots_limits_are_the_ends_of_the_stick() -> None:
    """Half of the stick's range is half of the limit; nothing is cut off."""
    scene = Scene()
    scene.take()
    scene.socket.control(holder="me", you=True, limits={"operator": {"linear": 0.2, "angular": 0.5}})
    scene.socket.status("operator")
    scene.look(CENTRED, CENTRED)
    assert scene.look(AHEAD) == [(pytest.approx(0.2), 0.0)]
    assert scene.look(GamepadState(0.0, 1.0, True)) == [(0.0, pytest.approx(0.5))]
    half = StickCurve().apply(GamepadState(0.5, 0.0, True)).ahead
    assert scene.look(GamepadState(0.5, 0.0, True)) == [(pytest.approx(0.2 * half), 0.0)]


def test_its_states_are_explained() -> None:
    """From the first to the last."""
    scene = Scene()
    scene.drive()
    scene.look(LOOSE, None)
    assert scene.reported == [
        "press the button to take control",
        "release stick and button",
        "you have control: release stick and button",
        "hold the button to drive",
        "driving",
        "hold the button to drive",
        "no gamepad",
    ]


@pytest.mark.parametrize(
    ("arguments", "token", "words"),
    [
        (["ws://127.0.0.1:1/robots/r"], "", "SWITCHBOARD_TOKEN"),
        (["http://127.0.0.1:1/robots/r"], "t", "not the address of a robot"),
        (["ws://127.0.0.1:1/robots/r", "--speed", "-1"], "t", "--speed"),
    ],
)
def test_error_is_explained(arguments: list[str], token: str, words: str) -> None:
    """No token, no address, an invalid speed."""
    done: Any = CliRunner().invoke(main, arguments, env={"SWITCHBOARD_TOKEN": token})
    assert done.exit_code != 0
    assert words in done.output
