"""Speed limits by level, and ramps."""

from __future__ import annotations

from relay_protocol import link
from robot_client.config import LimitSettings, RobotSettings, SafetySettings, SpeedSettings
from tests.worlds.memory_platform import TWIST, twist
from tests.worlds.robot_commands import (
    GO,
    JOY,
    OTHER,
    ZERO,
    messages_of,
    order,
    stop,
)
from tests.worlds.robot_daemon import DRIVER, Scene


def test_limits_are_reported_and_applied() -> None:
    """The stricter of robot and level; limited commands are counted."""
    scene = Scene(
        settings=RobotSettings(limits=LimitSettings(linear=0.8, operator=SpeedSettings(linear=0.5)))
    )
    control = scene.register()
    (state,) = messages_of(control, "motion_state")
    assert state["limits"] == {"operator": {"linear": 0.5}, "owner": {"linear": 0.8}}
    line = scene.channel(control)
    line.send(link.Advertise(number=5, topic="/cmd_vel", type=TWIST))
    for level in ("operator", "owner"):
        order(control, link.ControlGrant(id=9, holder=DRIVER, user="ann", level=level))
        scene.command(line, GO)
    assert scene.platform.published == [("/cmd_vel", twist(0.5)), ("/cmd_vel", twist(0.8))]
    assert scene.daemon._health().limited_commands == 2


def test_refused_types_raise_one_alert_until_control_changes() -> None:
    """If no level may command a topic, advertising it is refused."""
    scene = Scene(settings=RobotSettings(limits=LimitSettings(operator=SpeedSettings(linear=0.5))))
    control = scene.register()
    line = scene.channel(control)
    line.send(link.Advertise(number=5, topic="/joy", type=JOY))
    control.send(link.ControlGrant(id=8, holder=DRIVER, user="ann", level="operator"))
    control.received()
    for _ in range(3):
        scene.command(line, GO)
    (alert,) = messages_of(control, "alert")
    assert (alert["kind"], alert["about"], alert.get("over", False)) == ("control", "limits", False)
    assert (
        "commands on /joy (sensor_msgs/msg/Joy) are refused: the speed of the level 'operator'"
        in alert["text"]
    )
    assert scene.platform.published == []
    assert scene.daemon._health().refused_commands == 3
    control.send(link.ControlGrant(id=9, holder=DRIVER, user="ann", level="owner"))
    assert [each["over"] for each in messages_of(control, "alert")] == [True]
    scene.command(line, GO)
    assert scene.platform.published == [("/joy", GO)]
    closed = Scene(settings=RobotSettings(limits=LimitSettings(linear=0.5)))
    line = closed.channel(closed.register())
    line.send(link.Advertise(number=5, topic="/joy", type=JOY))
    (failed,) = messages_of(line, "failed")
    assert "how fast sensor_msgs/msg/Joy on /joy moves the robot can't be read" in failed["reason"]
    assert closed.platform.publishers == []


def test_change_of_control_waits_for_the_ramp() -> None:
    """A stop does not."""
    scene = Scene(settings=RobotSettings(safety=SafetySettings(ramp_ms=200)))
    control = scene.register()
    line = scene.driving(control)
    control.received()
    control.send(link.ControlGrant(id=9, holder=OTHER, user="ben"))
    assert messages_of(control, "order_result") == []
    scene.run(0.3)
    assert ("/cmd_vel", ZERO) in scene.platform.published
    assert messages_of(control, "order_result") == [{"op": "order_result", "id": 9}]
    scene.command(line, GO, OTHER)
    control.send(link.ControlGrant(id=10))
    assert messages_of(control, "order_result") == []
    control.send(stop(11))
    assert scene.platform.published[-1] == ("/cmd_vel", ZERO)
    assert [each["id"] for each in messages_of(control, "order_result")] == [10, 11]
