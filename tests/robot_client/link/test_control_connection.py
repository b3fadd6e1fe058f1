"""The control connection: proof that its link works in both directions, and reconnecting."""

from __future__ import annotations

import pytest

from relay_protocol import link
from relay_protocol.errors import Invalid
from robot_client.link.addresses import RelayAddresses
from tests.worlds.memory_platform import TWIST, twist
from tests.worlds.robot_daemon import DRIVER, RelayEnd, Scene
from tests.worlds.robot_failures import broken


def pings(line: RelayEnd) -> list[int]:
    return [each["t"] for each in line.received() if isinstance(each, dict) and each["op"] == "ping"]


def answer(scene: Scene, line: RelayEnd) -> None:
    for t in pings(line):
        line.send(link.Pong(t=t, at=scene.now()))


def test_link_is_pinged_often_while_a_motion_topic_is_advertised() -> None:
    scene = Scene(answers=False)
    control = scene.register()
    scene.run(4)
    assert len(pings(control)) <= 4
    line = scene.channel(control)
    line.send(link.Advertise(number=5, topic="/cmd_vel", type=TWIST))
    scene.run(4)
    assert len(pings(control)) >= 38
    line.send(link.Unadvertise(number=5))
    scene.run(4)
    assert len(pings(control)) <= 4


def test_answered_pings_are_the_proof() -> None:
    """By the time they were sent."""
    scene = Scene(answers=False)
    assert scene.connection.answered is None
    control = scene.register()
    (asked,) = pings(control)
    assert scene.connection.answered is None
    scene.run(0.3)
    control.send(link.Pong(t=asked, at=scene.now()))
    assert scene.connection.answered == asked
    control.lose()
    assert scene.connection.answered is None


def test_link_is_dialled_again_after_an_unexpected_error(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene()
    control = scene.register()
    monkeypatch.setattr(scene.daemon, "on_link_lost", broken)
    control.lose()
    scene.run(1)
    assert len(scene.lines) == 2


def test_robot_stops_on_a_one_way_link() -> None:
    """Its client may receive nothing."""
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


def test_the_next_relay_is_dialled_after_each_failure() -> None:
    """The first one follows the last."""
    scene = Scene(addresses="one:1, two:2")
    dialled = [scene.addresses.current]
    for _ in range(2):
        scene.register().lose()
        scene.run(1)
        dialled.append(scene.addresses.current)
    assert dialled == ["one:1", "two:2", "one:1"]


@pytest.mark.parametrize("text", ["", " , ", "one:1,two:x", "one:1,two:0"])
def test_addresses_of_relays_must_all_be_addresses(text: str) -> None:
    with pytest.raises(Invalid):
        RelayAddresses(text)
