"""The control link's proof that it works both ways."""

from __future__ import annotations

import pytest

from relay_protocol import link
from robot_client.platforms.memory import TWIST, twist
from tests.robot_client.breaking import broken
from tests.robot_client.daemon_scene import DRIVER, Line, Scene


def pings(line: Line) -> list[int]:
    return [each["t"] for each in line.heard() if isinstance(each, dict) and each["op"] == "ping"]


def answer(scene: Scene, line: Line) -> None:
    for t in pings(line):
        line.say(link.Pong(t=t, at=scene.now()))


def test_link_is_proved_often_while_somebody_may_command() -> None:
    """Ten times a second from the moment a topic that moves the robot is advertised, until it no longer is."""
    scene = Scene(answers=False)
    control = scene.register()
    scene.run(4)
    assert len(pings(control)) <= 4
    line = scene.channel(control)
    line.say(link.Advertise(number=5, topic="/cmd_vel", type=TWIST))
    scene.run(4)
    assert len(pings(control)) >= 38
    line.say(link.Unadvertise(number=5))
    scene.run(4)
    assert len(pings(control)) <= 4


def test_answers_are_the_proof() -> None:
    """What counts is when the ping was sent; without a link there is none."""
    scene = Scene(answers=False)
    assert scene.connection.answered is None
    control = scene.register()
    (asked,) = pings(control)
    assert scene.connection.answered is None
    scene.run(0.3)
    control.say(link.Pong(t=asked, at=scene.now()))
    assert scene.connection.answered == asked
    control.lose()
    assert scene.connection.answered is None


def test_a_link_is_dialled_again_whatever_its_loss_breaks(monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot that never dialled again would have to be restarted by hand."""
    scene = Scene()
    control = scene.register()
    monkeypatch.setattr(scene.daemon, "on_unregistered", broken)
    control.lose()
    scene.run(1)
    assert len(scene.lines) == 2


def test_a_robot_whose_word_does_not_arrive_stops() -> None:
    """Though its driver's commands do: he sees nothing any more. When it is heard again it moves again."""
    scene = Scene(answers=False)
    control = scene.register()
    answer(scene, control)
    line = scene.driving(control)

    def drive(seconds: float, answers: bool) -> None:
        for _ in range(round(seconds * 10)):
            if answers:
                answer(scene, control)
            scene.command(line, twist(1.0))
            scene.run(0.1)

    drive(2, True)
    assert scene.platform.published[-1] == ("/cmd_vel", twist(1.0))
    drive(0.5, False)
    assert scene.platform.published[-1] == ("/cmd_vel", twist())
    drive(0.5, True)
    assert scene.platform.published[-1] == ("/cmd_vel", twist(1.0))
    assert scene.daemon.authority.holder == DRIVER
