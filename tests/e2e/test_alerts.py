"""Alerts of real robots reach real receivers: once, in time, signed, and only who may know."""

from __future__ import annotations

import http.client
import json
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from switchboard_fake_robot import FakeRobot
from switchboard_hook import Delivery, Hook, MailServer
from switchboard_http import ask
from switchboard_processes import Process, ros_environment, running
from switchboard_proxy import ChaosProxy
from switchboard_relay import Relay
from switchboard_robot import Robot
from switchboard_threads import Driver
from switchboard_waiting import wait_for

from relay_protocol import identity, link
from relay_server.alerts.flow import REGULAR_SECONDS
from relay_server.alerts.hub import AGAIN_SECONDS

WITHIN = 8.0
"""An alert has arrived so many seconds after a robot's plug was pulled: promised are 5, of a computer that is not full
of tests. What waits for a rule's pause takes a minute.
"""


@dataclass
class House:
    """A relay that may send to this machine, with a robot of the tests' own and people."""

    relay: Relay
    hook: Hook
    admin: str
    viewer: str
    keys: dict[str, bytes]

    def ask(self, method: str, path: str, body: Any = None, *, token: str = "") -> Any:
        """One request about alerts; the answer must be a good one."""
        answer = ask(self.relay.http_port, method, f"/api/v1/alerts{path}", body, token=token or self.admin)
        assert answer.status < 300, answer.body
        return answer.json if answer.body else None

    def alerts(self, token: str = "", query: str = "?open=true") -> list[dict[str, Any]]:
        """What somebody sees."""
        return list(self.ask("GET", query, token=token)["alerts"])

    def modules(self, robot: str) -> list[dict[str, Any]]:
        """What lasts of a robot's modules."""
        return [each for each in self.alerts(query=f"?robot={robot}&open=true") if each["kind"] == "module"]

    def rule(self, **fields: Any) -> dict[str, Any]:
        """A webhook of the administrator's."""
        return dict(
            self.ask("POST", "/rules", {"channel": "webhook", "url": self.hook.url, "group_s": 5, **fields})
        )

    def robot(self, name: str) -> FakeRobot:
        """A robot that says what the test wants, registered."""
        if name not in self.keys:
            self.keys[name] = identity.generate_key()
            code = self.relay.cli("robot", "add", name)["enrolment_code"]
            with FakeRobot(self.relay.robots_port) as robot:
                assert robot.enroll(name, code, self.keys[name])["op"] == "enrolled"
            self.relay.cli("right", "grant", "viewer", name, "viewer")
        robot = FakeRobot(self.relay.robots_port)
        assert robot.register(name, self.keys[name])["op"] == "welcome"
        return robot


@pytest.fixture(scope="module")
def house(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    """One relay for all."""
    hook = Hook()
    relay = Relay(
        tmp_path_factory.mktemp("alerts"),
        "--webhook-networks",
        "127.0.0.0/8",
        "--apprise-schemes",
        "mailto",
    )
    with running(hook, relay):
        yield House(relay, hook, relay.user("boss", admin=True), relay.user("viewer"), {})


@pytest.fixture(autouse=True)
def clean(house: House) -> Iterator[None]:
    """No rules and nothing heard before; no robot's words after."""
    house.hook.got.clear()
    house.hook.status = 204
    yield
    for rule in house.ask("GET", "/rules")["rules"]:
        house.ask("DELETE", f"/rules/{rule['id']}")
    assert "Traceback" not in house.relay.log


@pytest.mark.parametrize("how", ["killed daemon", "swallowing link"])
def test_a_robot_whose_plug_is_pulled_is_told_once_within_seconds(house: House, how: str) -> None:
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
            pulled = time.monotonic()
            if how == "killed daemon":
                robot.daemon.kill()
            else:
                proxy.black_hole()
            delivery = wait_for("the webhook hears of it", lambda: offline(house, robot.name), 30)
            print(f"\n{how} to webhook: {delivery.at - pulled:.2f} s")
            assert delivery.at - pulled < WITHIN
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
        pulled = time.monotonic()
        robot.daemon.kill()
        delivery = told_in_time(house, pulled, "killed daemon")
        assert abs(int(delivery.headers["switchboard-timestamp"]) - time.time()) < 60
        (alert,) = delivery.json["alerts"]
        assert (alert["robot"], alert["kind"], alert["event"]) == ("rover", "offline", "begun")
        seen = house.alerts(house.viewer, "?robot=rover&open=true")
        assert [each["id"] for each in seen if each["kind"] == "offline"] == [alert["id"]]
        robot.start_daemon()
        wait_for("it is told that the robot is back", lambda: len(house.hook.got) > 1, 30)
        assert house.hook.told == ["offline begun", "offline over"]
        seen = house.alerts(house.viewer, "?robot=rover&open=true")
        assert [each for each in seen if each["kind"] == "offline"] == []


def test_a_robot_that_says_nothing_more_is_told_within_seconds(house: House) -> None:
    """Its link is there, as with a cable that was cut, but for three heartbeats nothing comes."""
    house.rule(kinds=["offline"], robots="mute")
    with house.robot("mute") as robot:
        robot.send(link.Health())
        told_in_time(house, time.monotonic(), "link that says nothing")
    assert house.hook.told == ["offline begun"]


def told_in_time(house: House, since: float, what: str) -> Delivery:
    """The one message that has come."""
    wait_for("the webhook hears of it", lambda: house.hook.got, 15)
    (delivery,) = house.hook.got
    took = delivery.at - since
    print(f"\n{what} to webhook: {took:.2f} s")
    assert took < WITHIN
    return delivery


def test_a_battery_and_a_module_are_told_and_acknowledged(house: House) -> None:
    """A robot tells of its charge and of a part; operators acknowledge, viewers see it."""
    house.rule(robots="mule", kinds=["battery", "module"])
    both = {"battery begun", "module begun"}
    with house.robot("mule") as robot:

        def says(charge: float) -> bool:
            robot.send(link.Health(battery=charge))
            return True

        robot.send(link.Alert(level="error", text="the arm is gone", kind="module", about="arm"))
        wait_for("both are told", lambda: says(0.15) and len(both & set(house.hook.told)) == 2, 10)
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
            10,
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
        wait_for("it is told", lambda: house.hook.told == ["stop begun"], 10)
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
        wait_for("it is tried", lambda: house.hook.got, 10)
        robot.send(link.Alert(level="error", text="two", kind="module", about="two"))
        house.hook.status = 204
        wait_for("both have arrived", lambda: len(house.hook.got) >= 3, 20)
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
            (mail,) = wait_for("the mail is there", lambda: server.mails, 20)
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


def test_alerts_outlive_the_relay(house: House, tmp_path: Path) -> None:
    """After kill -9 what lasted lasts, with who looks after it; nothing is told again."""
    house.rule(robots="tough", kinds=["module"])
    with house.robot("tough") as robot:
        robot.send(link.Alert(level="error", text="gone", kind="module", about="arm"))
        wait_for("it is told", lambda: house.hook.told == ["module begun"], 10)
        (alert,) = house.alerts(query="?robot=tough&open=true")
        house.ask("POST", f"/{alert['id']}/acknowledge")
    house.relay.kill()
    house.relay.start()
    (after,) = house.alerts(query="?robot=tough&open=true")
    assert (after["id"], after["count"], after["acknowledged"]["by"]) == (alert["id"], 1, "boss")
    with house.robot("tough") as robot:
        robot.send(link.Alert(level="info", text="back", kind="module", about="arm", over=True))
        wait_for("its end is told", lambda: "module over" in house.hook.told, 10)
    assert house.hook.told == ["module begun", "module over"]


def test_what_is_well_again_by_the_time_relay_and_robot_begin_anew_is_over(house: House) -> None:
    """The robot tells again what lasts; that is no news, and the rest is told to be over."""
    house.rule(robots="anew", kinds=["module"])
    with house.robot("anew") as robot:
        for about in ("arm", "leg"):
            robot.send(link.Alert(level="error", text="gone", kind="module", about=about))
        wait_for("both are seen", lambda: len(house.modules("anew")) == 2, 10)
    wait_for("both are told", lambda: len(house.hook.told) == 2, 20)
    house.relay.kill()
    house.relay.start()
    with house.robot("anew") as robot:
        robot.send(link.Alert(level="error", text="gone", kind="module", about="leg"))
        robot.send(link.AlertsTold())
        wait_for("one is over", lambda: len(house.modules("anew")) == 1, 10)
    (alert,) = house.modules("anew")
    assert (alert["about"], alert["count"]) == ("leg", 2)
    wait_for("its end is told", lambda: house.hook.told[-1] == "module over", 20)
    alerts = [each for delivery in house.hook.got for each in delivery.json["alerts"]]
    told = sorted(f"{each['about']} {each['event']}" for each in alerts)
    assert told == ["arm begun", "arm over", "leg begun"]


FAULT = """
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
rclpy.init()
node = rclpy.create_node("fault")
publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
fault = DiagnosticStatus(level=DiagnosticStatus.ERROR, name="arm", message="the motor is hot")
node.create_timer(1.0, lambda: publisher.publish(DiagnosticArray(status=[fault])))
print("READY", flush=True)
rclpy.spin(node)
"""


def test_a_daemon_that_begins_anew_while_a_part_is_in_error_tells_nothing_twice(house: House) -> None:
    """The part goes on saying so once a second, the new daemon hears it; nobody is told that it was over."""
    house.rule(kinds=["diagnostics"], robots="sick")
    robot = Robot(house.relay, "sick")
    fault = Process([sys.executable, "-c", FAULT], robot.folder, "fault", ros_environment(robot.domain))

    def arm() -> dict[str, Any]:
        seen = house.alerts(query="?robot=sick&open=true")
        return next((each for each in seen if each["about"] == "arm"), {})

    with running(robot, fault):
        fault.wait_to_say("READY")
        wait_for("it is told", lambda: house.hook.told == ["diagnostics begun"], 30)
        before = arm()["count"]
        robot.daemon.kill()
        robot.start_daemon()
        wait_for("the new daemon tells it, too", lambda: arm().get("count") == before + 1, 30)
        # Until the relay has ended all that a daemon which began anew did not tell.
        time.sleep(AGAIN_SECONDS + 2)
        assert arm()["news"] == 1
    assert house.hook.told == ["diagnostics begun"]


def test_a_running_relay_takes_up_what_is_changed_at_the_command_line(house: House) -> None:
    """A rule tells from then on and, once removed, nothing any more; who looks after an alert stays so."""

    def tells(about: str) -> None:
        with house.robot("cli") as robot:
            robot.send(link.Alert(level="error", text="gone", kind="module", about=about))
            wait_for("it is seen", lambda: about in {each["about"] for each in house.modules("cli")}, 10)

    tells("one")
    (alert,) = house.modules("cli")
    house.relay.cli("alerts", "ack", alert["id"])
    wait_for("it is known", lambda: house.modules("cli")[0]["acknowledged"] is not None, 10)
    address = ("--webhook", house.hook.url, "--kind", "module", "--group", "5")
    rule = house.relay.cli("alerts", "rules", "add", "boss", *address)
    tells("two")
    wait_for("it is told", lambda: house.hook.told == ["module begun"], 10)
    house.relay.cli("alerts", "rules", "remove", str(rule["id"]), "--yes")
    witness = house.rule(kinds=["module"])
    tells("three")
    wait_for("the other rule tells it", lambda: len(house.hook.got) == 2, 10)
    assert [each.json["rule"] for each in house.hook.got] == [rule["id"], witness["id"]]
    with house.robot("cli") as robot:
        robot.send(link.Alert(level="error", text="again", kind="module", about="one"))
        again = wait_for(
            "it is told again", lambda: [each for each in house.modules("cli") if each["text"] == "again"], 10
        )
    assert again[0]["acknowledged"]["by"].startswith("cli:")
