"""Fleet orders over HTTP and on the command line, with a real relay."""

from __future__ import annotations

import http.client
import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from tests.worlds.http_requests import Answer, ask
from tests.worlds.processes import Process, ros_environment
from tests.worlds.relay_process import Relay
from tests.worlds.small_robot import SmallRobot
from tests.worlds.sync_client import Client
from tests.worlds.waiting import PATIENCE, wait_for

CLEANERS = ("cleaner-1", "cleaner-2", "cleaner-3")

MOMENT = "switchboard-freshness"


def starts(robot: SmallRobot, args: Any) -> dict[str, Any]:
    """A service that succeeds."""
    return {"success": True, "message": f"{robot.name} cleans"}


def fails(robot: SmallRobot, args: Any) -> dict[str, Any]:
    """A service that reports failure, except on the first cleaner."""
    return {"success": robot.name == "cleaner-1", "message": "the brush is stuck"}


def never(robot: SmallRobot, args: Any) -> None:
    """A service that does not answer."""


SERVICES = {"/start": starts, "/brush": fails, "/dock": starts, "/think": never}


LISTENER = """
import rclpy
from std_msgs.msg import String
rclpy.init()
node = rclpy.create_node("listener")
node.create_subscription(String, "/mode", lambda message: print("HEARD", message.data, flush=True), 10)
print("READY", flush=True)
rclpy.spin(node)
"""


@dataclass
class Fleet:
    """A relay with robots, one of them offline, and users with rights on some."""

    relay: Relay
    robots: dict[str, SmallRobot]
    ann: str
    """Operates the cleaners."""
    bob: str
    """Owns all, as an administrator."""

    def orders(self, token: str, **order: Any) -> list[dict[str, Any]]:
        """The lines of an answer, repeated until the order is not too old, which a slow machine may cause."""

        def given() -> Answer | None:
            moment = ask(self.relay.http_port, "GET", "/api/v1/fleet/groups", token=token).headers[MOMENT]
            dated = {MOMENT: moment}
            answer = ask(self.relay.http_port, "POST", "/api/v1/fleet", order, headers=dated, token=token)
            return None if answer.status == 412 else answer

        answer = wait_for("the order comes in time", given)
        assert (answer.status, answer.headers["Content-Type"]) == (200, "application/x-ndjson"), answer.body
        return [json.loads(line) for line in answer.body.splitlines()]

    def begun(self, token: str, **order: Any) -> http.client.HTTPResponse:
        """The answer of an order that runs until the answer is closed."""
        connection = http.client.HTTPConnection("127.0.0.1", self.relay.http_port, timeout=PATIENCE)
        # It uses a connection of its own, which ends with the answer.
        headers = {
            "Authorization": f"Bearer {token}",
            "Content-Type": "application/json",
            "Connection": "close",
        }
        connection.request("POST", "/api/v1/fleet", json.dumps(order), headers)
        return connection.getresponse()

    def connections(self, robot: str) -> list[Any]:
        """Connections to a robot, as its owner sees them."""
        path = f"/api/v1/robots/{robot}/people"
        people = ask(self.relay.http_port, "GET", path, token=self.bob).json["people"]
        return [connection for person in people for connection in person["connections"]]

    def results(self, token: str, **order: Any) -> dict[str, dict[str, Any]]:
        """Results of an order by robot."""
        head, *results, end = self.orders(token, **order)
        assert end["done"]
        assert end["robots"] == len(head["robots"]) == len(results) == end["ok"] + end["failed"]
        return {each["robot"]: each for each in results}


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fleet]:
    """Three cleaners and another robot; the third cleaner is offline."""
    relay = Relay(tmp_path_factory.mktemp("fleet"))
    robots: dict[str, SmallRobot] = {}
    try:
        for name in (*CLEANERS, "other"):
            robots[name] = SmallRobot(relay, name, SERVICES, moving=("/dock",))
            if name != "cleaner-3":
                robots[name].comes()
        ann, bob = relay.user("ann"), relay.user("bob", admin=True)
        for name in CLEANERS:
            relay.cli("right", "grant", "ann", name, "operator", "--deny", "call:/think/*")
        relay.cli("robot", "group", "add", "upstairs", "cleaner-2", "other")
        yield Fleet(relay, robots, ann, bob)
    finally:
        for each in robots.values():
            each.goes()
        relay.stop()


def test_a_service_is_called_on_all_that_match(fleet: Fleet) -> None:
    """With a result for each; an offline robot fails with a reason, and others receive no call."""
    results = fleet.results(fleet.ann, robots=["cleaner-*"], do="call", service="/start")
    assert set(results) == set(CLEANERS)
    for name in CLEANERS[:2]:
        assert results[name]["ok"]
        assert results[name]["values"] == {"success": True, "message": f"{name} cleans"}
        assert fleet.robots[name].calls[-1][0] == "/start"
    assert not results["cleaner-3"]["ok"]
    assert "offline" in results["cleaner-3"]["message"]
    assert not fleet.robots["other"].calls


def test_a_reported_failure_of_a_service_is_a_failure(fleet: Fleet) -> None:
    """The reason is the robot's."""
    results = fleet.results(fleet.ann, robots=["cleaner-1", "cleaner-2"], do="call", service="/brush")
    assert (results["cleaner-1"]["ok"], results["cleaner-2"]["ok"]) == (True, False)
    assert results["cleaner-2"]["message"] == "the brush is stuck"


def test_only_robots_with_a_right_are_meant(fleet: Fleet) -> None:
    """In a group too; an empty selection gives the same error whether the robots exist or not."""
    lines = fleet.orders(fleet.ann, robots=["*", "other", "nowhere"], do="call", service="/start")
    assert lines[0] == {"do": "call", "robots": list(CLEANERS), "unmatched": ["other", "nowhere"]}
    assert fleet.orders(fleet.ann, robots=["group:upstairs"], do="call", service="/start")[0]["robots"] == [
        "cleaner-2"
    ]
    for robots in (["other"], ["nowhere"], ["group:nowhere"]):
        order = {"robots": robots, "do": "stop"}
        answer = ask(fleet.relay.http_port, "POST", "/api/v1/fleet", order, token=fleet.ann)
        assert (answer.status, answer.json["detail"]) == (
            404,
            "the order matches no robot that you have a right on",
        )

    def groups(token: str) -> Any:
        return ask(fleet.relay.http_port, "GET", "/api/v1/fleet/groups", token=token).json["groups"]

    assert groups(fleet.ann) == [{"name": "upstairs", "robots": ["cleaner-2"]}]
    assert groups(fleet.bob) == [{"name": "upstairs", "robots": ["cleaner-2", "other"]}]


def test_robots_check_rights_as_for_any_connection(fleet: Fleet) -> None:
    """A denied right, a missing service, and a missing answer are failures."""
    relay = fleet.relay
    relay.cli("right", "grant", "ann", "cleaner-2", "operator", "--deny", "call:/start")
    try:
        results = fleet.results(fleet.ann, robots=["cleaner-[12]"], do="call", service="/start")
        assert (results["cleaner-1"]["ok"], results["cleaner-2"]["ok"]) == (True, False)
        assert "denied to you" in results["cleaner-2"]["message"]
    finally:
        relay.cli("right", "grant", "ann", "cleaner-2", "operator")
    results = fleet.results(fleet.ann, robots=["cleaner-1"], do="call", service="/nothing")
    assert not results["cleaner-1"]["ok"]
    results = fleet.results(fleet.ann, robots=["cleaner-1"], do="call", service="/think", timeout=0.5)
    assert "within 0.5 s" in results["cleaner-1"]["message"]
    assert 0.5 <= results["cleaner-1"]["seconds"] < 5


def test_moving_request_holds_control_while_it_lasts(fleet: Fleet) -> None:
    """If another user has control, the order fails with the name; otherwise control is released afterwards."""
    one, two = fleet.robots["cleaner-1"], fleet.robots["cleaner-2"]
    with fleet.relay.connect("cleaner-2", fleet.bob) as bob:
        assert bob.call("/relay/take_control")["values"]["success"]
        results = fleet.results(fleet.ann, robots=["cleaner-[12]"], do="call", service="/dock")
        while "send it again" in results["cleaner-1"]["message"]:  # too old, on a busy machine
            results = fleet.results(fleet.ann, robots=["cleaner-[12]"], do="call", service="/dock")
        assert results["cleaner-1"]["ok"], results["cleaner-1"]
        assert "bob" in results["cleaner-2"]["message"]
        assert bob.call("/relay/refuse_control")["values"]["message"] == "there is no request for control"
    service, source = one.calls[-1]
    assert (service, source != 0) == ("/dock", True)
    wait_for("control is released", lambda: one.holders[-2:] == [source, 0])
    assert ("/dock", 0) not in two.calls
    assert all(called != "/dock" for called, _ in two.calls)


def test_a_stop_is_stored_for_robots_that_are_offline(fleet: Fleet) -> None:
    """Online robots stop at once; resuming needs control or ownership."""
    results = fleet.results(fleet.ann, robots=["cleaner-*"], do="stop", why="wet floor")
    assert all(each["ok"] for each in results.values()), results
    assert [results[name]["pending"] for name in CLEANERS] == [False, False, True]
    one, three = fleet.robots["cleaner-1"], fleet.robots["cleaner-3"]
    assert one.stopped == {"by": "ann", "why": "wet floor"}
    assert fleet.robots["other"].stopped is None
    three.comes()
    try:
        wait_for("it is stopped as it comes", lambda: three.stopped == {"by": "ann", "why": "wet floor"})
        results = fleet.results(fleet.ann, robots=["cleaner-*"], do="resume")
        assert not any(each["ok"] for each in results.values())
        results = fleet.results(fleet.bob, robots=["cleaner-*"], do="resume")
        assert all(each["ok"] for each in results.values()), results
        assert one.stopped is None
        assert three.stopped is None
    finally:
        three.goes()
        wait_for("it is offline again", lambda: fleet.relay.state_of("cleaner-3") == "offline")


def test_a_stop_by_websocket_and_by_http_is_one(fleet: Fleet) -> None:
    """A page sends it by both, as its requests may wait for a connection."""
    one = fleet.robots["cleaner-1"]
    order = {"robots": ["cleaner-*"], "do": "stop", "why": "a press", "stop_id": "press-1"}
    url = f"ws://127.0.0.1:{fleet.relay.http_port}/api/v1/robots/stream"
    with Client(connect(url, additional_headers={"Authorization": f"Bearer {fleet.ann}"})) as page:
        page.send(**order)
        lines = [page.until(event="order")["data"] for _ in range(5)]
        assert lines[0]["robots"] == list(CLEANERS)
        assert {each["robot"] for each in lines[1:4]} == set(CLEANERS)
        assert (lines[4]["done"], lines[4]["ok"]) == (True, 3)
        assert one.stopped == {"by": "ann", "why": "a press"}
        results = fleet.results(fleet.ann, **order)
        assert all(each["ok"] for each in results.values())
        page.send(robots=["no-such"], do="stop")
        with pytest.raises(ConnectionClosed) as closed:
            page.until(event="order")
        assert closed.value.rcvd is not None
        assert (closed.value.rcvd.code, closed.value.rcvd.reason) == (
            4404,
            "the order matches no robot that you have a right on",
        )
    with Client(connect(url, additional_headers={"Authorization": f"Bearer {fleet.ann}"})) as page:
        page.send(robots=["*"], do="call", service="/start")
        with pytest.raises(ConnectionClosed) as closed:
            page.until(event="order")
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 4400
    audited = fleet.relay.cli("audit", "list", "--limit", "1000")
    reasons = [each["data"]["why"] for each in audited if each["action"] == "fleet.stop"]
    assert reasons.count("a press") == 1
    fleet.results(fleet.bob, robots=["cleaner-*"], do="resume")
    assert one.stopped is None


def test_a_message_is_published_once(fleet: Fleet) -> None:
    """To each online robot."""
    results = fleet.results(fleet.bob, robots=["*"], do="publish", topic="/mode", msg={"data": "dock"})
    assert {name: each["ok"] for name, each in results.items()} == {
        "cleaner-1": True,
        "cleaner-2": True,
        "cleaner-3": False,
        "other": True,
    }
    for name in ("cleaner-1", "cleaner-2", "other"):
        wait_for(f"{name} has heard it", lambda robot=fleet.robots[name]: robot.heard == [{"data": "dock"}])


def test_ending_the_request_ends_the_order(fleet: Fleet) -> None:
    """The relay's connections for it are closed, and it is audited."""
    relay = fleet.relay
    order = {"robots": ["cleaner-1", "other"], "do": "call", "service": "/think", "timeout": 60}
    answer = fleet.begun(fleet.bob, **order)
    assert json.loads(answer.readline())["robots"] == ["cleaner-1", "other"]
    wait_for("somebody is there for it", lambda: len(fleet.connections("other")) == 1)
    answer.close()
    wait_for("nobody is there any more", lambda: fleet.connections("other") == [])
    (entry,) = wait_for(
        "it is in the audit log",
        lambda: [each for each in relay.cli("audit", "list") if each["target"] == "cleaner-1, other"],
    )
    assert (entry["actor"], entry["action"]) == ("user:bob", "fleet.call")
    assert (entry["data"]["robots"], entry["data"]["what"]) == (2, "/think")


def test_a_user_has_four_orders_at_a_time(fleet: Fleet) -> None:
    """The fifth is refused with a reason; another user's is not."""
    relay = fleet.relay
    slow = {"robots": ["other"], "do": "call", "service": "/think", "timeout": 60}
    quick = {"robots": ["other"], "do": "call", "service": "/start"}
    orders = [fleet.begun(fleet.bob, **slow) for _ in range(4)]
    wait_for("four are under way", lambda: len(fleet.connections("other")) == 4)
    refused = ask(relay.http_port, "POST", "/api/v1/fleet", quick, token=fleet.bob)
    assert (refused.status, "you have 4 orders in progress" in refused.json["detail"]) == (503, True)
    assert fleet.results(fleet.ann, robots=["cleaner-1"], do="call", service="/start")["cleaner-1"]["ok"]
    for each in orders:
        each.close()
    wait_for("none is under way", lambda: fleet.connections("other") == [])
    assert fleet.results(fleet.bob, **quick)["other"]["ok"]


def test_the_command_line_orders_as_the_administrator(fleet: Fleet) -> None:
    """With a table, an exit code, and an audit entry."""
    relay = fleet.relay
    done = relay.run_cli("robot", "call", "cleaner-*", "/start")
    assert done.returncode == 1
    assert "Done on 2 of 3." in done.stdout
    assert "cleaner-1 cleans" in done.stdout
    assert "robot cleaner-3 is offline" in done.stdout
    reported = relay.cli("robot", "call", "group:upstairs,cleaner-1", "/dock")
    assert [each["robot"] for each in sorted(reported["results"], key=lambda each: str(each["robot"]))] == [
        "cleaner-1",
        "cleaner-2",
        "other",
    ]
    assert all(each["ok"] for each in reported["results"]), reported
    assert relay.run_cli("robot", "call", "nowhere", "/start").returncode == 1

    def audited() -> set[tuple[str, str]]:
        entries = relay.cli("audit", "list")
        return {(each["action"], each["target"]) for each in entries if each["actor"] == "admin (local)"}

    orders = {("fleet.call", "cleaner-*"), ("fleet.call", "group:upstairs, cleaner-1")}
    wait_for("both are in the audit log", lambda: audited() == orders)


def test_robots_of_ros_take_parameters_and_messages(world: Any, tmp_path: Path) -> None:
    """A parameter is set, an invalid one refused, and one message reaches a subscribing node."""
    relay, robot = world.relay, world.robot
    done = relay.run_cli("robot", "set", "rov*", "/switchboard_sim:max_speed", "0.4")
    assert (done.returncode, "Done on 1 of 1." in done.stdout) == (0, True), done.stdout
    done = relay.run_cli("robot", "set", "rov*", "/switchboard_sim:max_speed", "70")
    assert done.returncode == 1
    assert "FAILED" in done.stdout
    listener = Process([sys.executable, "-c", LISTENER], tmp_path, "listener", ros_environment(robot.domain))
    try:
        listener.wait_to_say("READY")
        with relay.connect("rover", world.viewer) as client:

            def seen() -> bool:
                topics: list[str] = client.call("/rosapi/topics")["values"]["topics"]
                return "/mode" in topics

            wait_for("the robot knows who subscribes", seen)
        order = {"robots": ["rover"], "do": "publish", "topic": "/mode", "msg": {"data": "dock"}}
        answer = ask(relay.http_port, "POST", "/api/v1/fleet", order, token=world.operator)
        result = json.loads(answer.body.splitlines()[1])
        assert result["ok"], result
        assert listener.wait_to_say("HEARD") == "HEARD dock"
        assert listener.said().count("HEARD") == 1
    finally:
        listener.stop()
        relay.run_cli("robot", "set", "rover", "/switchboard_sim:max_speed", "0.5").check_returncode()
