"""Open alerts continue after a restart of the relay or a daemon, and are not sent twice."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest

from relay_protocol import link
from relay_server.alerts.hub import REPORT_AGAIN_SECONDS
from tests.worlds.alert_relay import AlertWorld
from tests.worlds.client_threads import Driver
from tests.worlds.diagnostics_node import reporting
from tests.worlds.driving import LET_GO_SECONDS
from tests.worlds.processes import Process, ros_environment, running
from tests.worlds.robot_process import Robot
from tests.worlds.waiting import wait_for


def test_alerts_outlive_the_relay(world: AlertWorld) -> None:
    """After kill -9 open alerts are open, with their acknowledgements, and are not sent again."""
    world.rule(robots="tough", kinds=["module"])
    with world.robot("tough") as robot:
        robot.send(link.Alert(level="error", text="gone", kind="module", about="arm"))
        wait_for("it is told", lambda: world.webhook_receiver.reported == ["module begun"])
        (alert,) = world.alerts(query="?robot=tough&open=true")
        world.ask("POST", f"/{alert['id']}/acknowledge")
    world.relay.kill()
    world.relay.start()
    (after,) = world.alerts(query="?robot=tough&open=true")
    assert (after["id"], after["count"], after["acknowledged"]["by"]) == (alert["id"], 1, "boss")
    with world.robot("tough") as robot:
        robot.send(link.Alert(level="info", text="back", kind="module", about="arm", over=True))
        wait_for("its end is told", lambda: "module over" in world.webhook_receiver.reported)
    assert world.webhook_receiver.reported == ["module begun", "module over"]


def test_alert_ends_when_relay_and_robot_restart_healthy(world: AlertWorld) -> None:
    """The robot's repeated report is not sent again; other alerts end with a message."""
    world.rule(robots="restarted", kinds=["module"])
    with world.robot("restarted") as robot:
        for about in ("arm", "leg"):
            robot.send(link.Alert(level="error", text="gone", kind="module", about=about))
        wait_for("both are seen", lambda: len(world.modules("restarted")) == 2)
    wait_for("both are told", lambda: len(world.webhook_receiver.reported) == 2)
    world.relay.kill()
    world.relay.start()
    with world.robot("restarted") as robot:
        robot.send(link.Alert(level="error", text="gone", kind="module", about="leg"))
        robot.send(link.ActiveAlertsSent())
        wait_for("one is over", lambda: len(world.modules("restarted")) == 1)
    (alert,) = world.modules("restarted")
    assert (alert["about"], alert["count"]) == ("leg", 2)
    wait_for("its end is told", lambda: world.webhook_receiver.reported[-1] == "module over")
    alerts = [each for delivery in world.webhook_receiver.got for each in delivery.json["alerts"]]
    reported = sorted(f"{each['about']} {each['event']}" for each in alerts)
    assert reported == ["arm begun", "arm over", "leg begun"]


@pytest.mark.parametrize("how", ["killed", "stopped"])
def test_control_lost_with_the_relay_is_reported_by_the_next_one(world: AlertWorld, how: str) -> None:
    """The robot reports it to the relay after a kill; after a shutdown the relay itself stores it. The next
    driver ends the alert.
    """
    name = f"driven-{how}"
    world.rule(robots=name, kinds=["control"])
    robot = Robot(world.relay, name)
    with running(robot):
        drive(world, robot, world.relay.kill if how == "killed" else world.relay.stop)
        world.relay.start()
        wait_for("it is told", lambda: world.webhook_receiver.reported == ["control begun"])
        (alert,) = [
            each for each in world.alerts(query=f"?robot={name}&open=true") if each["kind"] == "control"
        ]
        assert (alert["level"], alert["text"].partition(" while ")[0]) == ("error", "boss lost control")
        drive(world, robot, lambda: None, pause=LET_GO_SECONDS)
        wait_for(
            "its end is told", lambda: world.webhook_receiver.reported == ["control begun", "control over"]
        )


def drive(world: AlertWorld, robot: Robot, then: Callable[[], object], *, pause: float = 0.0) -> None:
    """A client drives the robot until an event.

    :param pause: seconds without commands after the first one, which release the controls
    """
    with world.relay.connect(robot.name, world.admin) as client:
        driver = Driver(client)
        driver.begin_with_a_pause(pause)
        with running(driver):
            driver.start()
            wait_for("it moves", robot.moving)
            then()


def test_a_daemon_that_restarts_during_an_error_reports_nothing_twice(world: AlertWorld) -> None:
    """The module repeats its report each second to the new daemon; no end is sent."""
    world.rule(kinds=["diagnostics"], robots="sick")
    robot = Robot(world.relay, "sick")
    fault = Process(
        reporting("arm", "ERROR", "the motor is hot", 1.0),
        robot.folder,
        "fault",
        ros_environment(robot.domain),
    )

    def arm() -> dict[str, Any]:
        seen = world.alerts(query="?robot=sick&open=true")
        return next((each for each in seen if each["about"] == "arm"), {})

    with running(robot, fault):
        fault.wait_to_say("READY")
        wait_for("it is told", lambda: world.webhook_receiver.reported == ["diagnostics begun"])
        before = arm()["count"]
        robot.daemon.kill()
        robot.start_daemon()
        wait_for("the new daemon tells it, too", lambda: arm().get("count", 0) > before)
        time.sleep(
            REPORT_AGAIN_SECONDS + 2
        )  # by then the relay has ended all alerts that the new daemon did not report
        assert arm()["notification_count"] == 1
    assert world.webhook_receiver.reported == ["diagnostics begun"]
