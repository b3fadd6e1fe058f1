"""What lasts goes on when the relay or a robot's daemon begins anew, and is not told again."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest
from switchboard_diagnostics import reporting
from switchboard_drive import LET_GO_SECONDS
from switchboard_processes import Process, ros_environment, running
from switchboard_robot import Robot
from switchboard_threads import Driver
from switchboard_waiting import wait_for

from relay_protocol import link
from relay_server.alerts.alerts import AGAIN_SECONDS
from tests.e2e.alerts.house import House


def test_alerts_outlive_the_relay(house: House) -> None:
    """After kill -9 what lasted lasts, with who looks after it; nothing is told again."""
    house.rule(robots="tough", kinds=["module"])
    with house.robot("tough") as robot:
        robot.send(link.Alert(level="error", text="gone", kind="module", about="arm"))
        wait_for("it is told", lambda: house.hook.told == ["module begun"])
        (alert,) = house.alerts(query="?robot=tough&open=true")
        house.ask("POST", f"/{alert['id']}/acknowledge")
    house.relay.kill()
    house.relay.start()
    (after,) = house.alerts(query="?robot=tough&open=true")
    assert (after["id"], after["count"], after["acknowledged"]["by"]) == (alert["id"], 1, "boss")
    with house.robot("tough") as robot:
        robot.send(link.Alert(level="info", text="back", kind="module", about="arm", over=True))
        wait_for("its end is told", lambda: "module over" in house.hook.told)
    assert house.hook.told == ["module begun", "module over"]


def test_what_is_well_again_by_the_time_relay_and_robot_begin_anew_is_over(house: House) -> None:
    """The robot tells again what lasts; that is no news, and the rest is told to be over."""
    house.rule(robots="anew", kinds=["module"])
    with house.robot("anew") as robot:
        for about in ("arm", "leg"):
            robot.send(link.Alert(level="error", text="gone", kind="module", about=about))
        wait_for("both are seen", lambda: len(house.modules("anew")) == 2)
    wait_for("both are told", lambda: len(house.hook.told) == 2)
    house.relay.kill()
    house.relay.start()
    with house.robot("anew") as robot:
        robot.send(link.Alert(level="error", text="gone", kind="module", about="leg"))
        robot.send(link.AlertsTold())
        wait_for("one is over", lambda: len(house.modules("anew")) == 1)
    (alert,) = house.modules("anew")
    assert (alert["about"], alert["count"]) == ("leg", 2)
    wait_for("its end is told", lambda: house.hook.told[-1] == "module over")
    alerts = [each for delivery in house.hook.got for each in delivery.json["alerts"]]
    told = sorted(f"{each['about']} {each['event']}" for each in alerts)
    assert told == ["arm begun", "arm over", "leg begun"]


@pytest.mark.parametrize("how", ["killed", "stopped"])
def test_control_that_was_lost_with_the_relay_is_told_by_the_next(house: House, how: str) -> None:
    """A killed one knew nothing of it, but the robot says so; the other could tell nobody. The next driver ends it."""
    name = f"driven-{how}"
    house.rule(robots=name, kinds=["control"])
    robot = Robot(house.relay, name)
    with running(robot):
        drive(house, robot, house.relay.kill if how == "killed" else house.relay.stop)
        house.relay.start()
        wait_for("it is told", lambda: house.hook.told == ["control begun"])
        (alert,) = [
            each for each in house.alerts(query=f"?robot={name}&open=true") if each["kind"] == "control"
        ]
        assert (alert["level"], alert["text"].partition(" while ")[0]) == ("error", "boss lost control")
        drive(house, robot, lambda: None, pause=LET_GO_SECONDS)
        wait_for("its end is told", lambda: house.hook.told == ["control begun", "control over"])


def drive(house: House, robot: Robot, then: Callable[[], object], *, pause: float = 0.0) -> None:
    """Somebody drives the robot until something happens.

    :param pause: of so many seconds after the first command, by which he lets go
    """
    with house.relay.connect(robot.name, house.admin) as client:
        driver = Driver(client)
        driver.begin_with_a_pause(pause)
        with running(driver):
            driver.start()
            wait_for("it moves", robot.moving)
            then()


def test_a_daemon_that_begins_anew_while_a_part_is_in_error_tells_nothing_twice(house: House) -> None:
    """The part goes on saying so once a second, the new daemon hears it; nobody is told that it was over."""
    house.rule(kinds=["diagnostics"], robots="sick")
    robot = Robot(house.relay, "sick")
    fault = Process(
        reporting("arm", "ERROR", "the motor is hot", 1.0),
        robot.folder,
        "fault",
        ros_environment(robot.domain),
    )

    def arm() -> dict[str, Any]:
        seen = house.alerts(query="?robot=sick&open=true")
        return next((each for each in seen if each["about"] == "arm"), {})

    with running(robot, fault):
        fault.wait_to_say("READY")
        wait_for("it is told", lambda: house.hook.told == ["diagnostics begun"])
        before = arm()["count"]
        robot.daemon.kill()
        robot.start_daemon()
        wait_for("the new daemon tells it, too", lambda: arm().get("count", 0) > before)
        time.sleep(AGAIN_SECONDS + 2)  # by then the relay has ended all that the new daemon did not tell
        assert arm()["news"] == 1
    assert house.hook.told == ["diagnostics begun"]
