"""Alerts of real robots reach real receivers: once, signed, and only who may know."""

from __future__ import annotations

import http.client
import json
import time
from contextlib import closing
from typing import Any

import pytest
from switchboard_hook import Delivery, MailServer
from switchboard_http import ask
from switchboard_processes import running
from switchboard_proxy import ChaosProxy
from switchboard_robot import Robot
from switchboard_threads import Driver
from switchboard_waiting import wait_for

from relay_protocol import link
from relay_server.alerts.monitors import REGULAR_SECONDS
from tests.e2e.alerts.house import House


@pytest.mark.parametrize("how", ["killed daemon", "swallowing link"])
def test_a_robot_whose_plug_is_pulled_is_told_once(house: House, how: str) -> None:
    """By a rule as it comes, while somebody drives the robot and watches it: other news does not hold it up."""
    rule = house.ask("POST", "/rules", {"channel": "webhook", "url": house.hook.url})
    proxy = ChaosProxy(house.relay.robots_port)
    robot = Robot(house.relay, f"pulled-{how[:6]}", port=proxy.port)
    with closing(proxy), running(robot), house.relay.connect(robot.name, house.admin) as client:
        client.send(op="subscribe", topic="/scan", type="sensor_msgs/msg/LaserScan")
        client.send(op="subscribe", topic="/odom", type="nav_msgs/msg/Odometry")
        driver = Driver(client)
        with running(driver):
            driver.start()
            wait_for("it moves", robot.moving)
            regular = time.monotonic() + REGULAR_SECONDS + 2
            wait_for("its topics are expected to go on", lambda: time.monotonic() > regular)
            house.hook.got.clear()
            if how == "killed daemon":
                robot.daemon.kill()
            else:
                proxy.black_hole()
            delivery = wait_for("the webhook hears of it", lambda: offline(house, robot.name))
            assert delivery.signed_with(rule["secret"])
            time.sleep(3)  # to see that it does not come twice
        words = [each for delivery in list(house.hook.got) for each in told(delivery, robot.name)]
        assert words.count("offline begun") == 1
        assert set(words) <= {"offline begun", "control begun"}
        proxy.heal()


def told(delivery: Delivery, robot: str) -> list[str]:
    """What a message tells of a robot."""
    alerts = delivery.json["alerts"]
    return [f"{each['kind']} {each['event']}" for each in alerts if each["robot"] == robot]


def offline(house: House, robot: str) -> Delivery | None:
    """The message that told that a robot is offline."""
    return next((each for each in house.hook.got if "offline begun" in told(each, robot)), None)


def test_a_robot_that_is_back_is_told_once(house: House) -> None:
    """A real daemon is killed, which is seen by who may, and begins anew."""
    house.rule(kinds=["offline"], robots="rover")
    robot = Robot(house.relay, "rover")
    with running(robot):
        house.relay.cli("right", "grant", "viewer", "rover", "viewer")
        robot.daemon.kill()
        delivery = only_delivery(house)
        assert abs(int(delivery.headers["switchboard-timestamp"]) - time.time()) < 60
        (alert,) = delivery.json["alerts"]
        assert (alert["robot"], alert["kind"], alert["event"]) == ("rover", "offline", "begun")
        seen = house.alerts(house.viewer, "?robot=rover&open=true")
        assert [each["id"] for each in seen if each["kind"] == "offline"] == [alert["id"]]
        robot.start_daemon()
        wait_for("it is told that the robot is back", lambda: len(house.hook.got) > 1)
        assert house.hook.told == ["offline begun", "offline over"]
        seen = house.alerts(house.viewer, "?robot=rover&open=true")
        assert [each for each in seen if each["kind"] == "offline"] == []


def test_a_robot_that_says_nothing_more_is_told(house: House) -> None:
    """Its link is there, as with a cable that was cut, but for three heartbeats nothing comes."""
    house.rule(kinds=["offline"], robots="mute")
    with house.robot("mute") as robot:
        robot.send(link.Health())
        only_delivery(house)
    assert house.hook.told == ["offline begun"]


def only_delivery(house: House) -> Delivery:
    """The one message that has come."""
    wait_for("the webhook hears of it", lambda: house.hook.got)
    (delivery,) = house.hook.got
    return delivery


def test_a_driver_whom_the_network_swallows_has_lost_control(house: House) -> None:
    """It is told once he is given up, though the robot has stood for seconds then."""
    house.rule(kinds=["control"], robots="adrift")
    proxy = ChaosProxy(house.relay.http_port)
    robot = Robot(house.relay, "adrift")
    with closing(proxy), running(robot), house.relay.connect_by(proxy.port, "adrift", house.admin) as client:
        driver = Driver(client)
        with running(driver):
            driver.start()
            wait_for("it moves", robot.moving)
            proxy.black_hole()
            wait_for("it stands", lambda: not robot.moving())
            stood = robot.events("standstill")[-1]["t"] / 1e9
            wait_for("it is told", lambda: house.hook.told == ["control begun"])
            assert house.hook.got[0].at > stood
        proxy.heal()


def test_a_battery_and_a_module_are_told_and_acknowledged(house: House) -> None:
    """A robot tells of its charge and of a part; operators acknowledge, viewers see it."""
    house.rule(robots="mule", kinds=["battery", "module"])
    both = {"battery begun", "module begun"}
    with house.robot("mule") as robot:

        def says(charge: float) -> bool:
            robot.send(link.Health(battery=charge))
            return True

        robot.send(link.Alert(level="error", text="the arm is gone", kind="module", about="arm"))
        wait_for("both are told", lambda: says(0.15) and len(both & set(house.hook.told)) == 2)
        seen = {each["kind"]: each for each in house.alerts(house.viewer, "?robot=mule&open=true")}
        assert (seen["battery"]["level"], seen["module"]["about"]) == ("warning", "arm")
        assert not seen["battery"]["may_acknowledge"]
        path = f"/api/v1/alerts/{seen['battery']['id']}/acknowledge"
        assert ask(house.relay.http_port, "POST", path, token=house.viewer).status == 403
        taken = ask(house.relay.http_port, "POST", path, token=house.admin).json
        assert taken["acknowledged"]["by"] == "boss"
        seen = {each["kind"]: each for each in house.alerts(house.viewer, "?robot=mule&open=true")}
        assert seen["battery"]["acknowledged"]["by"] == "boss"
        robot.send(link.Alert(level="info", text="there it is", kind="module", about="arm", over=True))
        wait_for(
            "nothing lasts",
            lambda: says(0.9) and house.alerts(house.viewer, "?robot=mule&open=true") == [],
        )
    stranger = house.relay.user("stranger")
    assert house.alerts(stranger, "") == []
    assert ask(house.relay.http_port, "POST", path, token=stranger).status == 404


def test_a_stop_is_told_with_who_and_why(house: House) -> None:
    """Whoever looks at nothing hears of it."""
    house.rule(robots="digger", kinds=["stop"])
    with house.robot("digger") as robot:
        answer = ask(
            house.relay.http_port, "POST", "/api/v1/robots/digger/stop", {"why": "smoke"}, token=house.viewer
        )
        assert answer.status in (200, 202), answer.body
        wait_for("it is told", lambda: house.hook.told == ["stop begun"])
        (alert,) = house.hook.got[0].json["alerts"]
        assert "viewer" in alert["text"]
        assert "smoke" in alert["text"]
        robot.send(link.Safety())


def test_a_receiver_that_was_away_gets_its_message_later_and_once(house: House) -> None:
    """Tries of one message have one name; what came meanwhile is told after it."""
    house.rule(robots="late", kinds=["module"])
    house.hook.status = 503
    with house.robot("late") as robot:
        robot.send(link.Alert(level="error", text="one", kind="module", about="one"))
        wait_for("it is tried", lambda: house.hook.got)
        robot.send(link.Alert(level="error", text="two", kind="module", about="two"))
        house.hook.status = 204
        wait_for("both have arrived", lambda: len(house.hook.got) >= 3)
    first, again, other = house.hook.got[:3]
    assert first.headers["switchboard-delivery"] == again.headers["switchboard-delivery"]
    assert first.json["alerts"][0]["about"] == again.json["alerts"][0]["about"] == "one"
    assert other.json["alerts"][0]["about"] == "two"
    assert other.headers["switchboard-delivery"] != first.headers["switchboard-delivery"]


def test_alerts_arrive_by_e_mail(house: House) -> None:
    """Through apprise, at a mail server on this machine; another service is refused."""
    server = MailServer()
    with running(server):
        url = f"mailto://relay.example?smtp=127.0.0.1&port={server.port}&from=relay@x.example&to=ann@x.example&mode=insecure"
        refused = ask(
            house.relay.http_port,
            "POST",
            "/api/v1/alerts/rules",
            {"channel": "apprise", "url": "json://127.0.0.1/x"},
            token=house.admin,
        )
        assert (refused.status, "mailto" in refused.json["detail"]) == (400, True)
        rule = house.ask(
            "POST", "/rules", {"channel": "apprise", "url": url, "kinds": ["module"], "robots": "poster"}
        )
        assert rule["url"] == "mailto://…"
        with house.robot("poster") as robot:
            robot.send(link.Alert(level="error", text="the arm is gone", kind="module", about="arm"))
            (mail,) = wait_for("the mail is there", lambda: server.mails)
        assert "Subject: poster: error: module arm" in mail
        assert "the arm is gone" in mail


def test_a_page_hears_of_alerts_at_once(house: House) -> None:
    """In the events it follows anyway, with what it is to show."""
    connection = http.client.HTTPConnection("127.0.0.1", house.relay.http_port, timeout=20)
    with house.robot("page") as robot:
        connection.request(
            "GET", "/api/v1/robots/stream", headers={"Authorization": f"Bearer {house.viewer}"}
        )
        stream = connection.getresponse()
        robot.send(link.Alert(level="error", text="look", kind="module", about="arm"))
        alert: dict[str, Any] = {}
        while alert.get("robot") != "page":
            if stream.readline().strip() == b"event: alerts":
                alerts = json.loads(stream.readline().removeprefix(b"data: "))["alerts"]
                alert = next((each for each in alerts if each["robot"] == "page"), {})
        assert (alert["notify"], alert["news"], alert["may_acknowledge"]) == (True, 1, False)
    connection.close()


def test_a_running_relay_takes_up_what_is_changed_at_the_command_line(house: House) -> None:
    """A rule tells from then on and, once removed, nothing any more; who looks after an alert stays so."""

    def tells(about: str) -> None:
        with house.robot("cli") as robot:
            robot.send(link.Alert(level="error", text="gone", kind="module", about=about))
            wait_for("it is seen", lambda: about in {each["about"] for each in house.modules("cli")})

    tells("one")
    (alert,) = house.modules("cli")
    house.relay.cli("alerts", "ack", alert["id"])
    wait_for("it is known", lambda: house.modules("cli")[0]["acknowledged"] is not None)
    address = ("--webhook", house.hook.url, "--kind", "module", "--group", "5")
    rule = house.relay.cli("alerts", "rules", "add", "boss", *address)
    tells("two")
    wait_for("it is told", lambda: house.hook.told == ["module begun"])
    house.relay.cli("alerts", "rules", "remove", str(rule["id"]), "--yes")
    witness = house.rule(kinds=["module"])
    tells("three")
    wait_for("the other rule tells it", lambda: len(house.hook.got) == 2)
    assert [each.json["rule"] for each in house.hook.got] == [rule["id"], witness["id"]]
    with house.robot("cli") as robot:
        robot.send(link.Alert(level="error", text="again", kind="module", about="one"))
        again = wait_for(
            "it is told again", lambda: [each for each in house.modules("cli") if each["text"] == "again"]
        )
    assert again[0]["acknowledged"]["by"].startswith("cli:")
