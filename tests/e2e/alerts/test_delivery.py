"""Alerts of real robots reach real receivers: once, signed, and only with the right."""

from __future__ import annotations

import http.client
import json
import time
from contextlib import closing
from typing import Any

import pytest

from relay_protocol import link
from relay_server.alerts.monitors import REGULAR_SECONDS
from tests.worlds.alert_relay import AlertWorld
from tests.worlds.chaos_proxy import ChaosProxy
from tests.worlds.client_threads import Driver
from tests.worlds.http_requests import ask
from tests.worlds.processes import running
from tests.worlds.robot_process import Robot
from tests.worlds.waiting import wait_for
from tests.worlds.webhook_server import Delivery, MailServer


@pytest.mark.parametrize("how", ["killed daemon", "swallowing link"])
def test_a_robot_whose_plug_is_pulled_is_one_alert(world: AlertWorld, how: str) -> None:
    """The rule sends at once, while a client drives and views the robot; other traffic does not delay it."""
    rule = world.ask("POST", "/rules", {"channel": "webhook", "url": world.webhook_receiver.url})
    proxy = ChaosProxy(world.relay.robots_port)
    robot = Robot(world.relay, f"pulled-{how[:6]}", port=proxy.port)
    with closing(proxy), running(robot), world.relay.connect(robot.name, world.admin) as client:
        client.send(op="subscribe", topic="/scan", type="sensor_msgs/msg/LaserScan")
        client.send(op="subscribe", topic="/odom", type="nav_msgs/msg/Odometry")
        driver = Driver(client)
        with running(driver):
            driver.start()
            wait_for("it moves", robot.moving)
            regular = time.monotonic() + REGULAR_SECONDS + 2
            wait_for("its topics are expected to go on", lambda: time.monotonic() > regular)
            world.webhook_receiver.got.clear()
            if how == "killed daemon":
                robot.daemon.kill()
            else:
                proxy.black_hole()
            delivery = wait_for("the webhook receives it", lambda: offline(world, robot.name))
            assert delivery.signed_with(rule["secret"])
            time.sleep(3)  # shows that it is not sent twice
        words = [
            each for delivery in list(world.webhook_receiver.got) for each in reported(delivery, robot.name)
        ]
        assert words.count("offline begun") == 1
        assert set(words) <= {"offline begun", "control begun"}
        proxy.heal()


def reported(delivery: Delivery, robot: str) -> list[str]:
    """Alerts about a robot in a message."""
    alerts = delivery.json["alerts"]
    return [f"{each['kind']} {each['event']}" for each in alerts if each["robot"] == robot]


def offline(world: AlertWorld, robot: str) -> Delivery | None:
    """The message that reports a robot offline."""
    return next(
        (each for each in world.webhook_receiver.got if "offline begun" in reported(each, robot)), None
    )


def test_a_robot_that_is_back_ends_the_alert_once(world: AlertWorld) -> None:
    """A real daemon is killed and started again; clients with the right see both."""
    world.rule(kinds=["offline"], robots="rover")
    robot = Robot(world.relay, "rover")
    with running(robot):
        world.relay.cli("right", "grant", "viewer", "rover", "viewer")
        before = time.time()
        robot.daemon.kill()
        delivery = only_delivery(world)
        assert before - 1 <= int(delivery.headers["switchboard-timestamp"]) <= time.time()
        (alert,) = delivery.json["alerts"]
        assert (alert["robot"], alert["kind"], alert["event"]) == ("rover", "offline", "begun")
        seen = world.alerts(world.viewer, "?robot=rover&open=true")
        assert [each["id"] for each in seen if each["kind"] == "offline"] == [alert["id"]]
        robot.start_daemon()
        wait_for("it is told that the robot is back", lambda: len(world.webhook_receiver.got) > 1)
        assert world.webhook_receiver.reported == ["offline begun", "offline over"]
        seen = world.alerts(world.viewer, "?robot=rover&open=true")
        assert [each for each in seen if each["kind"] == "offline"] == []


def test_a_silent_robot_is_an_alert(world: AlertWorld) -> None:
    """Its connection stays, as with a cut cable, but three heartbeats are missing."""
    world.rule(kinds=["offline"], robots="mute")
    with world.robot("mute") as robot:
        robot.send(link.Health())
        only_delivery(world)
    assert world.webhook_receiver.reported == ["offline begun"]


def only_delivery(world: AlertWorld) -> Delivery:
    """The only message received."""
    wait_for("the webhook receives it", lambda: world.webhook_receiver.got)
    (delivery,) = world.webhook_receiver.got
    return delivery


def test_a_driver_without_network_loses_control(world: AlertWorld) -> None:
    """The alert comes at the driver's timeout, though the robot has stood for seconds then."""
    world.rule(kinds=["control"], robots="adrift")
    proxy = ChaosProxy(world.relay.http_port)
    robot = Robot(world.relay, "adrift")
    with closing(proxy), running(robot), world.relay.connect_by(proxy.port, "adrift", world.admin) as client:
        driver = Driver(client)
        with running(driver):
            driver.start()
            wait_for("it moves", robot.moving)
            proxy.black_hole()
            wait_for("it stands", lambda: not robot.moving())
            stood = robot.events("standstill")[-1]["t"] / 1e9
            wait_for("it is told", lambda: world.webhook_receiver.reported == ["control begun"])
            assert world.webhook_receiver.got[0].at > stood
        proxy.heal()


def test_alerts_of_a_battery_and_a_module_are_sent_and_acknowledged(world: AlertWorld) -> None:
    """A robot reports its charge and a failed module; operators acknowledge, viewers see it."""
    world.rule(robots="mule", kinds=["battery", "module"])
    both = {"battery begun", "module begun"}
    with world.robot("mule") as robot:

        def says(charge: float) -> bool:
            robot.send(link.Health(battery=charge))
            return True

        robot.send(link.Alert(level="error", text="the arm is gone", kind="module", about="arm"))
        wait_for(
            "both are told", lambda: says(0.15) and len(both & set(world.webhook_receiver.reported)) == 2
        )
        seen = {each["kind"]: each for each in world.alerts(world.viewer, "?robot=mule&open=true")}
        assert (seen["battery"]["level"], seen["module"]["about"]) == ("warning", "arm")
        assert not seen["battery"]["may_acknowledge"]
        path = f"/api/v1/alerts/{seen['battery']['id']}/acknowledge"
        assert ask(world.relay.http_port, "POST", path, token=world.viewer).status == 403
        taken = ask(world.relay.http_port, "POST", path, token=world.admin).json
        assert taken["acknowledged"]["by"] == "boss"
        seen = {each["kind"]: each for each in world.alerts(world.viewer, "?robot=mule&open=true")}
        assert seen["battery"]["acknowledged"]["by"] == "boss"
        robot.send(link.Alert(level="info", text="there it is", kind="module", about="arm", over=True))
        wait_for(
            "nothing lasts",
            lambda: says(0.9) and world.alerts(world.viewer, "?robot=mule&open=true") == [],
        )
    stranger = world.relay.user("stranger")
    assert world.alerts(stranger, "") == []
    assert ask(world.relay.http_port, "POST", path, token=stranger).status == 404


def test_an_alert_of_a_stop_names_user_and_reason(world: AlertWorld) -> None:
    """The message reaches users without an open page."""
    world.rule(robots="digger", kinds=["stop"])
    with world.robot("digger") as robot:
        answer = ask(
            world.relay.http_port, "POST", "/api/v1/robots/digger/stop", {"why": "smoke"}, token=world.viewer
        )
        assert answer.status in (200, 202), answer.body
        wait_for("it is told", lambda: world.webhook_receiver.reported == ["stop begun"])
        (alert,) = world.webhook_receiver.got[0].json["alerts"]
        assert "viewer" in alert["text"]
        assert "smoke" in alert["text"]
        robot.send(link.MotionState())


def test_a_receiver_that_was_away_gets_its_message_later_and_once(world: AlertWorld) -> None:
    """All tries of a message have the same id; alerts from meanwhile follow in the next message."""
    world.rule(robots="late", kinds=["module"])
    world.webhook_receiver.status = 503
    with world.robot("late") as robot:
        robot.send(link.Alert(level="error", text="one", kind="module", about="one"))
        wait_for("it is tried", lambda: world.webhook_receiver.got)
        robot.send(link.Alert(level="error", text="two", kind="module", about="two"))
        world.webhook_receiver.status = 204
        wait_for("both have arrived", lambda: len(world.webhook_receiver.got) >= 3)
    first, again, other = world.webhook_receiver.got[:3]
    assert first.headers["switchboard-delivery"] == again.headers["switchboard-delivery"]
    assert first.json["alerts"][0]["about"] == again.json["alerts"][0]["about"] == "one"
    assert other.json["alerts"][0]["about"] == "two"
    assert other.headers["switchboard-delivery"] != first.headers["switchboard-delivery"]


def test_alerts_arrive_by_e_mail(world: AlertWorld) -> None:
    """Through apprise to a mail server on this machine; another service is refused."""
    server = MailServer()
    with running(server):
        url = f"mailto://relay.example?smtp=127.0.0.1&port={server.port}&from=relay@x.example&to=ann@x.example&mode=insecure"
        refused = ask(
            world.relay.http_port,
            "POST",
            "/api/v1/alerts/rules",
            {"channel": "apprise", "url": "json://127.0.0.1/x"},
            token=world.admin,
        )
        assert (refused.status, "mailto" in refused.json["detail"]) == (400, True)
        rule = world.ask(
            "POST", "/rules", {"channel": "apprise", "url": url, "kinds": ["module"], "robots": "poster"}
        )
        assert rule["url"] == "mailto://…"
        with world.robot("poster") as robot:
            robot.send(link.Alert(level="error", text="the arm is gone", kind="module", about="arm"))
            (mail,) = wait_for("the mail is there", lambda: server.mails)
        assert "Subject: poster: error: module arm" in mail
        assert "the arm is gone" in mail


def test_a_page_receives_alerts_at_once(world: AlertWorld) -> None:
    """As events of its live updates, with their content."""
    connection = http.client.HTTPConnection("127.0.0.1", world.relay.http_port, timeout=20)
    with world.robot("page") as robot:
        connection.request(
            "GET", "/api/v1/robots/stream", headers={"Authorization": f"Bearer {world.viewer}"}
        )
        stream = connection.getresponse()
        robot.send(link.Alert(level="error", text="look", kind="module", about="arm"))
        alert: dict[str, Any] = {}
        while alert.get("robot") != "page":
            if stream.readline().strip() == b"event: alerts":
                alerts = json.loads(stream.readline().removeprefix(b"data: "))["alerts"]
                alert = next((each for each in alerts if each["robot"] == "page"), {})
        assert (alert["notify"], alert["notification_count"], alert["may_acknowledge"]) == (True, 1, False)
    connection.close()


def test_a_running_relay_takes_up_what_is_changed_at_the_command_line(world: AlertWorld) -> None:
    """A new rule sends, a removed one does not; an acknowledgement is kept."""

    def tells(about: str) -> None:
        with world.robot("cli") as robot:
            robot.send(link.Alert(level="error", text="gone", kind="module", about=about))
            wait_for("it is seen", lambda: about in {each["about"] for each in world.modules("cli")})

    tells("one")
    (alert,) = world.modules("cli")
    world.relay.cli("alerts", "ack", alert["id"])
    wait_for("it is known", lambda: world.modules("cli")[0]["acknowledged"] is not None)
    address = ("--webhook", world.webhook_receiver.url, "--kind", "module", "--group", "5")
    rule = world.relay.cli("alerts", "rules", "add", "boss", *address)
    tells("two")
    wait_for("it is told", lambda: world.webhook_receiver.reported == ["module begun"])
    world.relay.cli("alerts", "rules", "remove", str(rule["id"]), "--yes")
    witness = world.rule(kinds=["module"])
    tells("three")
    wait_for("the other rule notifies", lambda: len(world.webhook_receiver.got) == 2)
    assert [each.json["rule"] for each in world.webhook_receiver.got] == [rule["id"], witness["id"]]
    with world.robot("cli") as robot:
        robot.send(link.Alert(level="error", text="again", kind="module", about="one"))
        again = wait_for(
            "it is told again", lambda: [each for each in world.modules("cli") if each["text"] == "again"]
        )
    assert again[0]["acknowledged"]["by"].startswith("cli:")
