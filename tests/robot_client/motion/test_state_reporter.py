"""The state of motion that the robot reports."""

from __future__ import annotations

import pytest

from relay_protocol import link
from robot_client.motion.state_reporter import REPORT_EVERY
from robot_client.platforms.base import CANCELED, GoalOutcome
from tests.worlds.robot_commands import (
    GO,
    NAVIGATE,
    ZERO,
    messages_of,
    order,
    stop,
)
from tests.worlds.robot_daemon import DRIVER, RelayEnd, Scene
from tests.worlds.robot_failures import broken


def test_motion_state_has_holder_movement_suppression_and_stop(scene: Scene, control: RelayEnd) -> None:
    scene.driving(control)
    scene.clock.advance(REPORT_EVERY)
    control.received()
    control.send(link.Suppress(id=4, resource="/cmd_vel", sources=[DRIVER, 3], ms=200, by="walls"))
    scene.clock.advance(REPORT_EVERY)
    state = messages_of(control, "motion_state")[-1]
    assert (state["holder"], state["moving"]) == (DRIVER, True)
    assert state["suppressed"] == [
        {"resource": "/cmd_vel", "sources": [3, DRIVER], "by": "walls", "ms": state["suppressed"][0]["ms"]}
    ]
    assert 0 < state["suppressed"][0]["ms"] <= 200
    control.send(stop())
    scene.clock.advance(REPORT_EVERY)
    state = messages_of(control, "motion_state")[-1]
    assert "moving" not in state
    assert state["stopped"]["by"] == "eve"


def test_robot_counts_as_moving_while_a_motion_goal_is_active(scene: Scene, control: RelayEnd) -> None:
    """Also after its client lost control."""
    scene.platform.actions = {NAVIGATE, "/count"}
    line = scene.driving(control)
    scene.command(line, ZERO)
    for id, action in (("g", NAVIGATE), ("h", "/count")):
        line.send(link.SendActionGoal(id=id, action=action, type="a/action/B", source=DRIVER, cdr=""))
    scene.clock.advance(REPORT_EVERY)
    assert messages_of(control, "motion_state")[-1]["moving"] is True
    control.send(link.ControlGrant(id=9))
    scene.run(1)
    assert messages_of(control, "motion_state")[-1]["moving"] is True
    scene.platform.goals[0].result.callback(GoalOutcome(CANCELED, None))
    scene.clock.advance(REPORT_EVERY)
    assert "moving" not in messages_of(control, "motion_state")[-1]


def test_state_is_reported_at_most_20_times_a_second_and_the_last_always(
    scene: Scene, control: RelayEnd
) -> None:
    line = scene.driving(control)
    scene.run(1)
    control.received()
    for _ in range(200):
        scene.clock.advance(0.005)
        scene.command(line, GO)
        scene.command(line, ZERO)
    scene.command(line, GO)
    scene.clock.advance(REPORT_EVERY)
    state = messages_of(control, "motion_state")
    assert 0 < len(state) <= 22
    assert state[-1]["moving"] is True


def test_state_is_reported_again_when_the_link_is_back(scene: Scene, control: RelayEnd) -> None:
    scene.driving(control)
    control.lose()
    scene.run(1)
    control = scene.register()
    assert len(messages_of(control, "motion_state")) == 1


def test_unexpected_error_of_a_command_is_answered(
    scene: Scene, control: RelayEnd, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The link stays, and details stay in the log."""
    monkeypatch.setattr(scene.platform, "full_name", broken)
    done = order(control, link.Inhibit(id=4, resource="/chat", ms=100))
    assert done["ok"] is False
    assert "secret" not in done["reason"]
