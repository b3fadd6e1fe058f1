"""Control is granted to a source, and ends."""

from __future__ import annotations

import pytest

from relay_protocol import frames, link
from robot_client.platforms.base import CANCELED, GoalOutcome
from tests.worlds.memory_platform import TWIST, twist
from tests.worlds.robot_commands import (
    GO,
    NAVIGATE,
    OTHER,
    ZERO,
    ActionsWorld,
    messages_of,
    order,
)
from tests.worlds.robot_daemon import DRIVER, RelayEnd, Scene
from tests.worlds.robot_failures import broken


def test_commands_before_a_grant_are_refused_and_counted(scene: Scene, control: RelayEnd) -> None:
    line = scene.channel(control)
    line.send(link.Advertise(number=5, topic="/cmd_vel", type=TWIST))
    scene.command(line, GO)
    assert scene.platform.published == []
    assert scene.daemon._health().refused_commands == 1


def test_invalid_commands_and_goals_are_counted_in_the_health(scene: Scene, control: RelayEnd) -> None:
    line = scene.driving(control)
    line.send(link.Advertise(number=6, topic="/goal_pose", type="geometry_msgs/msg/PoseStamped"))
    control.received()
    for number in (5, 6):
        line.protocol.dataReceived(frames.encode_command(number, scene.now(), DRIVER, twist(float("nan"))))
    scene.daemon._report_health()
    (health,) = messages_of(control, "health")
    assert health["invalid_commands"] == 2
    assert health.get("refused_commands", 0) == 0


def test_change_of_control_stops_the_robot_before_it_is_answered(scene: Scene, control: RelayEnd) -> None:
    """Zero is published, goals that move the robot are cancelled, and the former holder is refused."""
    scene.platform.actions = {NAVIGATE, "/dock_is_free"}
    line = scene.driving(control)
    for id, action in (("g", NAVIGATE), ("h", "/dock_is_free")):
        line.send(link.SendActionGoal(id=id, action=action, type="a/action/B", source=DRIVER, cdr=""))
    control.received()
    control.send(link.ControlGrant(id=9, holder=OTHER, user="ben"))
    assert scene.platform.published[-1] == ("/cmd_vel", ZERO)
    assert [goal.cancelled for goal in scene.platform.goals] == [True, False]
    assert messages_of(control, "order_result") == []
    scene.platform.goals[0].result.callback(GoalOutcome(CANCELED, None))
    assert messages_of(control, "order_result") == [{"op": "order_result", "id": 9}]
    scene.command(line, twist(0.7))
    assert ("/cmd_vel", twist(0.7)) not in scene.platform.published
    scene.command(line, twist(0.3), OTHER)
    assert scene.platform.published[-1] == ("/cmd_vel", twist(0.3))


def test_change_of_control_waits_a_second_for_goals(scene: Scene, control: RelayEnd) -> None:
    """Also where the goal's channel is closed; a new grant to the holder does not wait."""
    scene.platform.actions = {NAVIGATE}
    line = scene.driving(control)
    line.send(link.SendActionGoal(id="g", action=NAVIGATE, type="a/action/B", source=DRIVER, cdr=""))
    assert order(control, link.ControlGrant(id=8, holder=DRIVER, user="ann", level="owner"))["id"] == 8
    for id in (9, 10):
        control.send(link.ControlGrant(id=id, holder=id))
        scene.clock.advance(0.999)
        assert messages_of(control, "order_result") == []
        scene.clock.advance(0.001)
        assert messages_of(control, "order_result") == [{"op": "order_result", "id": id}]
    control.send(link.ControlGrant(id=11))
    line.lose()
    assert messages_of(control, "order_result") == []
    scene.platform.goals[0].result.callback(GoalOutcome(CANCELED, None))
    assert messages_of(control, "order_result") == [{"op": "order_result", "id": 11}]


def orphan_alerts(line: RelayEnd) -> dict[str, bool]:
    """Alerts about goals that outlast control: text, and whether it is over."""
    return {
        each["about"]: each.get("over", False)
        for each in messages_of(line, "alert")
        if each["kind"] == "control"
    }


def test_goal_that_outlasts_control_raises_an_alert_and_is_cancelled_again(
    acting: ActionsWorld,
) -> None:
    """Its action may refuse; goals of the next holder continue."""
    acting.scene.platform.actions = {NAVIGATE}
    line = acting.scene.driving(acting.control)
    line.send(link.SendActionGoal(id="g", action=NAVIGATE, type="a/action/B", source=DRIVER, cdr=""))
    (former,) = acting.scene.platform.goals
    acting.control.received()
    acting.control.send(link.ControlGrant(id=9, holder=OTHER))
    acting.pass_seconds(1)
    received = [each for each in acting.control.received() if isinstance(each, dict)]
    (alert,) = [each for each in received if each["op"] == "alert"]
    assert (alert["level"], NAVIGATE in alert["text"]) == ("error", True)
    assert [each["id"] for each in received if each["op"] == "order_result"] == [9]
    line.send(link.SendActionGoal(id="n", action=NAVIGATE, type="a/action/B", source=OTHER, cdr=""))
    for _ in range(5):
        acting.answer()  # no error, and nothing that is being cancelled
        acting.pass_seconds(1, line)
    assert 5 <= len(acting.asked) <= 6
    assert set(acting.asked) == {b"\0\1\0\0" + former.id + bytes(8)}
    assert orphan_alerts(acting.control) == {}
    former.result.callback(GoalOutcome(CANCELED, None))
    acting.pass_seconds(3, line)
    assert orphan_alerts(acting.control) == {"goals": True}
    assert len(acting.asked) <= 6
    assert not acting.scene.platform.goals[1].cancelled


def test_goal_that_outlasts_the_control_link_raises_an_alert_afterwards(acting: ActionsWorld) -> None:
    acting.scene.platform.actions = {NAVIGATE}
    line = acting.scene.driving(acting.control)
    line.send(link.SendActionGoal(id="g", action=NAVIGATE, type="a/action/B", source=DRIVER, cdr=""))
    acting.control.lose()
    acting.scene.run(3)
    control = acting.scene.register()
    assert orphan_alerts(control) == {"goals": False}


def test_goal_of_the_holder_raises_no_alert(acting: ActionsWorld) -> None:
    """Also one that the holder has cancelled."""
    acting.scene.platform.actions = {NAVIGATE}
    line = acting.scene.driving(acting.control)
    line.send(link.SendActionGoal(id="g", action=NAVIGATE, type="a/action/B", source=DRIVER, cdr=""))
    line.send(link.CancelActionGoal(id="g"))
    acting.pass_seconds(10, line)
    assert (acting.asked, orphan_alerts(acting.control)) == ([], {})


def test_grant_to_the_holder_stops_nothing(scene: Scene, control: RelayEnd) -> None:
    scene.driving(control)
    assert order(control, link.ControlGrant(id=9, holder=DRIVER, user="ann", level="owner"))["id"] == 9
    assert scene.platform.published == [("/cmd_vel", GO)]
    assert scene.daemon.authority.level == "owner"


def test_control_is_not_granted_if_the_robot_can_not_be_stopped(
    scene: Scene, control: RelayEnd, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The answer gives the reason, and no source has control."""
    scene.driving(control)
    monkeypatch.setattr(scene.platform.publishers[0], "publish", broken)
    done = order(control, link.ControlGrant(id=9, holder=OTHER))
    assert done["ok"] is False
    assert "/cmd_vel" in done["reason"]
    assert scene.daemon.authority.holder == 0


def test_control_ends_with_the_link(scene: Scene, control: RelayEnd) -> None:
    scene.driving(control)
    control.lose()
    scene.run(1)
    (state,) = messages_of(scene.register(), "motion_state")
    assert "holder" not in state


def test_modules_are_notified_of_a_stop_and_a_resume_also_by_the_next_daemon(
    scene: Scene, control: RelayEnd
) -> None:
    assert scene.modules.is_robot_stopped is False
    order(control, link.Stop(id=1, by="eve"))
    assert scene.modules.is_robot_stopped is True
    assert Scene(scene.stop_store).modules.is_robot_stopped is True
    scene.run(5)
    order(control, link.Resume(id=2, by="eve"))
    assert scene.modules.is_robot_stopped is False
