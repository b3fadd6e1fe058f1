"""Without a right there is no channel; a viewer only reads; a revoked right ends open connections."""

from __future__ import annotations

from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus

from tests.worlds.waiting import wait_for


def refusal(world: Any, robot: str, token: str) -> InvalidStatus:
    with pytest.raises(InvalidStatus) as caught:
        world.relay.connect(robot, token)
    return caught.value


def test_a_user_without_a_right_gets_no_channel(world: Any) -> None:
    """A user without a right on the robot is refused in the handshake."""
    assert refusal(world, "rover", world.stranger).response.status_code == 403


def test_a_robot_that_does_not_exist_answers_like_one_without_rights(world: Any) -> None:
    """The answer does not disclose which robots exist."""
    missing = refusal(world, "no-such-robot", world.stranger).response
    foreign = refusal(world, "rover", world.stranger).response
    assert (missing.status_code, missing.reason_phrase) == (foreign.status_code, foreign.reason_phrase)


def test_a_wrong_token_is_refused(world: Any) -> None:
    """An unknown access token is refused."""
    assert refusal(world, "rover", "swb_wrong").response.status_code == 401


def test_a_viewer_sees_samples(world: Any) -> None:
    with world.relay.connect("rover", world.viewer) as client:
        client.send(op="subscribe", topic="/odom", type="nav_msgs/msg/Odometry")
        assert client.until(op="publish", topic="/odom")["msg"]["header"]["frame_id"] == "odom"


def test_a_viewers_command_is_refused_with_the_reason_and_never_reaches_the_robot(world: Any) -> None:
    """The publish gets a status with a reason, and the robot receives nothing."""
    since = world.left_alone()
    with world.relay.connect("rover", world.viewer) as client:
        client.send(op="set_level", level="error")
        client.drive(0.3)
        status = client.until(op="status")
        assert status["level"] == "error"
        assert "needs the level operator" in status["msg"]
        # Earlier messages to the robot have arrived by the time of this answer.
        assert client.call("/relay/ping", {"robot": True})["result"]
    assert world.robot.events("command", since) == []


def test_a_viewers_call_is_refused_with_the_reason(world: Any) -> None:
    """It is answered with result false and a reason."""
    with world.relay.connect("rover", world.viewer) as client:
        answer = client.call("/reset")
    assert answer["result"] is False
    assert "needs the level operator" in answer["values"]


def test_forbidden_services_are_absent_from_rosapi(world: Any) -> None:
    """rosapi lists only services that the caller may use."""
    with world.relay.connect("rover", world.viewer) as client:
        services = client.call("/rosapi/services")["values"]["services"]
        assert all(name.startswith(("/rosapi/", "/relay/")) for name in services)
    with world.relay.connect("rover", world.operator) as client:
        assert "/reset" in client.call("/rosapi/services")["values"]["services"]


def test_a_revoked_right_cuts_the_open_channel(world: Any) -> None:
    """The command line revokes it; the open websocket ends with the reason in its close frame."""
    token = world.relay.user("leaver")
    world.relay.cli("right", "grant", "leaver", "rover", "operator")
    with world.relay.connect("rover", token) as client:
        assert client.call("/relay/ping")["result"]
        world.relay.cli("right", "revoke", "leaver", "rover")
        with pytest.raises(ConnectionClosed) as closed:
            while True:
                client.receive()
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 4403
        assert "revoked" in closed.value.rcvd.reason


def test_a_lowered_right_ends_what_it_no_longer_covers(world: Any) -> None:
    """An operator demoted to viewer keeps the channel, and cannot drive any more."""
    token = world.relay.user("demoted")
    world.relay.cli("right", "grant", "demoted", "rover", "operator")
    with world.relay.connect("rover", token) as client:
        client.send(op="set_level", level="error")
        client.send(op="advertise", topic="/cmd_vel", type="geometry_msgs/msg/Twist")
        assert client.call("/reset")["result"]
        world.relay.cli("right", "grant", "demoted", "rover", "viewer")

        def refused() -> bool:
            return client.call("/reset")["result"] is False

        wait_for("the call is refused", refused)
        since = world.left_alone()
        client.drive(0.3)
        assert client.call("/relay/ping", {"robot": True})["result"]
    assert world.robot.events("command", since) == []


def test_a_revoked_token_ends_what_was_opened_with_it(world: Any) -> None:
    """The token authenticates the whole connection, not only its start."""
    token = world.relay.user("tokenless")
    world.relay.cli("right", "grant", "tokenless", "rover", "viewer")
    with world.relay.connect("rover", token) as client:
        assert client.call("/relay/ping")["result"]
        tokens = world.relay.cli("token", "list", "--user", "tokenless")
        world.relay.cli("token", "revoke", str(tokens[0]["id"]))
        with pytest.raises(ConnectionClosed) as closed:
            while True:
                client.receive()
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 4401


def test_patterns_narrow_and_widen_a_level(world: Any) -> None:
    """A viewer with one allowed service may call it; one with a denied topic does not see it."""
    token = world.relay.user("patterned")
    world.relay.cli(
        "right",
        "grant",
        "patterned",
        "rover",
        "viewer",
        "--allow",
        "call:/reset",
        "--deny",
        "subscribe:/scan",
    )
    with world.relay.connect("rover", token) as client:
        client.send(op="set_level", level="error")
        assert client.call("/reset")["result"]
        client.send(op="subscribe", topic="/scan", type="sensor_msgs/msg/LaserScan", id="s")
        assert "denied" in client.until(op="status", id="s")["msg"]
