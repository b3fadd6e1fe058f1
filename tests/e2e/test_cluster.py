"""Two relays for one fleet, with PostgreSQL and NATS: clients at one relay, robots at the other."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from relay_protocol import PROTOCOL_VERSION, link
from relay_server.auth.account_limit import FAILURES_OF_ACCOUNT
from relay_server.cli.admin_socket_client import send_order
from relay_server.cli.app import os_user
from relay_server.cluster.forwarding import ANYTHING
from relay_server.icpi.messages import IcpiMessage, parse, write
from tests.worlds.chaos_proxy import ChaosProxy
from tests.worlds.nats_servers import NatsServer, nats_server
from tests.worlds.postgresql_server import postgresql_database
from tests.worlds.processes import running
from tests.worlds.relay_process import Relay
from tests.worlds.small_robot import CAMERA, End, SmallRobot
from tests.worlds.waiting import PATIENCE, wait_for

PICTURE = cv2.imencode(".jpg", np.zeros((24, 32, 3), np.uint8))[1].tobytes()
ROLE = "Rover-Says-Mode"
ROLE_DOCUMENT = """
@prefix fierro: <fierro:> .
@prefix switchboard: <switchboard:> .
fierro:Rover-Says-Mode a fierro:role ;
  fierro:subject fierro:Rover ; fierro:action fierro:Says ; fierro:directObject fierro:Mode .
fierro:Rover a fierro:subject .
fierro:Says a fierro:action ; fierro:function fierro:SAID .
fierro:SAID switchboard:resource "robots/rover/services/say#/message" .
fierro:Mode a fierro:directObject ; fierro:data fierro:MODE .
fierro:MODE switchboard:resource "robots/rover/topics/mode#/data" .
"""
BOTH_DOCUMENT = """
@prefix fierro: <fierro:> .
@prefix switchboard: <switchboard:> .
fierro:Both-Say-Words a fierro:role ;
  fierro:subject fierro:Both ; fierro:action fierro:Say ; fierro:directObject fierro:Words .
fierro:Both a fierro:subject .
fierro:Say a fierro:action ; fierro:process fierro:Rover, fierro:Pad .
fierro:Rover switchboard:resource "robots/rover/services/say" .
fierro:Pad switchboard:resource "robots/pad/services/say" .
fierro:Words a fierro:directObject .
"""
NAME, SECRET = "fleet.example.org", "0123456789abcdef" * 2


@pytest.fixture(scope="module")
def postgres() -> Iterator[str]:
    with postgresql_database() as url:
        yield url


class Fleet:
    """Two relays, a robot, and its user ann.

    :ivar link: from the second relay to the first
    :ivar token: of ann
    """

    def __init__(self, folder: Path, bus: NatsServer, database: str) -> None:
        self.bus = bus
        secret = folder / "secret"
        secret.write_text(SECRET + "\n")
        options = ["--cluster-bus", bus.url, "--cluster-secret", str(secret), "--name", NAME]
        self.link = ChaosProxy(0, host="127.0.0.2")
        proxied = ["--cluster-listen", f"127.0.0.1:{self.link.port}", "--cluster-host", "127.0.0.2"]
        self.relays = [
            Relay(folder / name, *options, *more, database=database)
            for name, more in (("one", proxied), ("two", []))
        ]
        self.first, self.second = self.relays
        self.robot = SmallRobot(self.first, "rover", {"/say": say, "/drive": say}, moving=("/drive",))
        self.robot.picture = PICTURE
        self.robot.modules = ["base"]
        self.token = self.first.user("ann")
        self.first.cli("right", "grant", "ann", "rover", "owner")

    def connect_at(self, relay: Relay, *others: Relay) -> None:
        """The robot connects to this relay, and the others know it."""
        self.robot.goes()
        self.robot.relay = relay
        self.robot.comes()
        for each in (relay, *others):
            wait_for("the relay knows it", lambda each=each: self.state(each) != "offline")

    def get(self, relay: Relay, path: str, **options: Any) -> httpx.Response:
        """GET of a path below the robot's resource."""
        return self.request("GET", relay, path, **options)

    def request(self, method: str, relay: Relay, path: str, **options: Any) -> httpx.Response:
        """A request below the robot's resource, by ann."""
        url = f"http://127.0.0.1:{relay.http_port}/api/v1/robots/rover{path}"
        headers = {"Authorization": f"Bearer {self.token}", **options.pop("headers", {})}
        return httpx.request(method, url, headers=headers, timeout=PATIENCE, **options)

    def alerts(self, relay: Relay, kind: str) -> list[dict[str, Any]]:
        """Alerts of a kind, as a relay lists them for ann."""
        url = f"http://127.0.0.1:{relay.http_port}/api/v1/alerts"
        headers = {"Authorization": f"Bearer {self.token}"}
        answer = httpx.get(url, headers=headers, timeout=PATIENCE).json()
        return [each for each in answer["alerts"] if each["kind"] == kind]

    def resume(self, relay: Relay) -> None:
        """Resumes the robot with a freshness token of its home."""
        refused = self.request("POST", relay, "/resume", json={})
        assert refused.status_code == 428
        token = {"switchboard-freshness": refused.headers["switchboard-freshness"]}
        resumed = self.request("POST", relay, "/resume", json={}, headers=token)
        assert resumed.status_code == 200, resumed.text

    def state(self, relay: Relay) -> str:
        """The robot's state in a relay's list."""
        return str(self.listed(relay)["state"])

    def listed(self, relay: Relay) -> dict[str, Any]:
        """The robot in a relay's list."""
        url = f"http://127.0.0.1:{relay.http_port}/api/v1/robots"
        headers = {"Authorization": f"Bearer {self.token}"}
        answer = httpx.get(url, headers=headers, timeout=PATIENCE).json()
        return dict(next(each for each in answer["robots"] if each["name"] == "rover"))


def say(robot: SmallRobot, arguments: Any) -> dict[str, Any]:
    """Calls the service ``/say``."""
    return {"success": True, "message": "hello"}


@pytest.fixture(scope="module")
def fleet(postgres: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fleet]:
    folder = tmp_path_factory.mktemp("cluster")
    with nats_server(folder) as bus, ExitStack() as stack:
        fleet = Fleet(folder, bus, postgres)
        for relay in fleet.relays:
            stack.enter_context(running(relay))
        stack.callback(fleet.link.close)
        fleet.connect_at(fleet.first, fleet.second)
        yield fleet
        fleet.robot.goes()


def test_a_websocket_at_another_relay_reaches_the_robot(fleet: Fleet) -> None:
    """Calls, commands and samples, one client at each relay; both see the same control."""
    with (
        fleet.second.connect("rover", fleet.token) as client,
        fleet.first.connect("rover", fleet.token) as other,
    ):
        before = len(fleet.robot.calls)
        assert client.call("/say")["values"] == {"success": True, "message": "hello"}
        assert len(fleet.robot.calls) == before + 1
        client.send(op="publish", topic="/mode", type="std_msgs/msg/String", msg={"data": "ü" * 70_000})
        wait_for("it has come", lambda: {"data": "ü" * 70_000} in fleet.robot.heard)
        assert client.call("/drive")["result"]
        assert "controlled by ann" in other.call("/drive")["values"]
        client.send(op="subscribe", topic="/relay/status", id="s")
        client.until(op="publish", topic="/relay/status")


def test_a_client_that_logs_in_by_a_message_reaches_the_robot_with_its_messages(fleet: Fleet) -> None:
    """The client does not wait for an answer to ``auth``."""
    with connect(fleet.second.url("rover"), open_timeout=PATIENCE) as socket:
        socket.send(json.dumps({"op": "auth", "mac": fleet.token}))
        socket.send('{"op":"call_service","id":"1","service":"/say"}')
        while '"id":"1"' not in str(socket.recv(timeout=PATIENCE)):
            pass


def test_foxglove_at_another_relay_reaches_the_robot(fleet: Fleet) -> None:
    """Definitions, a message in binary and a call; a right that ends cuts it."""
    token = fleet.first.user("fox")
    fleet.first.cli("right", "grant", "fox", "rover", "operator")
    client = connect(
        fleet.second.url("rover"),
        subprotocols=["foxglove.sdk.v1"],
        additional_headers={"Authorization": f"Bearer {token}"},
        open_timeout=PATIENCE,
    )
    with client:

        def until(op: str) -> dict[str, Any]:
            while True:
                received = client.recv(timeout=PATIENCE)
                if isinstance(received, str) and (message := json.loads(received))["op"] == op:
                    return dict(message)

        assert until("serverInfo")["name"] == "rover"
        channel = {"id": 7, "topic": "/mode", "encoding": "json", "schemaName": "std_msgs/String"}
        client.send(json.dumps({"op": "advertise", "channels": [channel]}))
        client.send(struct.pack("<BI", 1, 7) + b'{"data":"by foxglove"}')
        wait_for("it has come", lambda: {"data": "by foxglove"} in fleet.robot.heard)
        fleet.first.cli("right", "revoke", "fox", "rover")
        with pytest.raises(ConnectionClosed):
            while True:
                client.recv(timeout=PATIENCE)


def test_alerts_go_with_their_robot_and_are_shown_at_each_relay(fleet: Fleet) -> None:
    """One alert of a stop stays one: shown and acknowledged at the other relay, and ended after the robot moved."""

    def shown(relay: Relay) -> list[dict[str, Any]]:
        url = f"http://127.0.0.1:{relay.http_port}/api/v1/robots/stream"
        headers = {"Authorization": f"Bearer {fleet.token}", "Accept": "text/event-stream"}
        with httpx.stream("GET", url, headers=headers, timeout=PATIENCE) as answer:
            lines = iter(answer.iter_lines())
            while next(lines) != "event: alerts":
                pass
            found = json.loads(next(lines).removeprefix("data:"))["alerts"]
        return [each for each in found if each["kind"] == "stop" and each["text"].endswith(": moving house")]

    assert fleet.request("POST", fleet.first, "/stop", json={"why": "moving house"}).status_code == 200
    (alert,) = wait_for("the second shows it", lambda: shown(fleet.second))
    assert alert["over"] is None
    url = f"http://127.0.0.1:{fleet.second.http_port}/api/v1/alerts/{alert['id']}/acknowledge"
    headers = {"Authorization": f"Bearer {fleet.token}"}
    assert httpx.post(url, headers=headers, timeout=PATIENCE).json()["acknowledged"]["by"] == "ann"
    wait_for("the first shows that", lambda: shown(fleet.first)[0]["acknowledged"])
    fleet.connect_at(fleet.second, fleet.first)
    assert [each["over"] for each in shown(fleet.second)] == [None]
    fleet.resume(fleet.first)
    for relay in fleet.relays:
        wait_for("it shows no stop", lambda relay=relay: fleet.listed(relay)["stopped"] is None)
        wait_for("it has ended", lambda relay=relay: shown(relay)[0]["over"] is not None)
    # Nothing of it was raised or ended by the other relay.
    for relay in fleet.relays:
        (ended,) = shown(relay)
        assert (ended["id"], ended["notification_count"]) == (alert["id"], 2)
    wait_for(
        "it is written",
        lambda: [each["id"] for each in fleet.alerts(fleet.first, "stop")][:1] == [alert["id"]],
    )
    fleet.connect_at(fleet.first, fleet.second)


def test_lists_show_the_same_of_a_robot_at_each_relay(fleet: Fleet) -> None:
    """Also who uses it, and that it is stopped."""
    passing = {"rtt_ms", "last_seen"}

    def shown(relay: Relay) -> dict[str, Any]:
        return {name: value for name, value in fleet.listed(relay).items() if name not in passing}

    with fleet.second.connect("rover", fleet.token) as client:
        assert client.call("/relay/take_control")["values"]["success"]
        assert client.call("/relay/stop", {"why": "test"})["values"]["done"]
        here = shown(fleet.first)
        assert (here["state"], here["holder"], here["people"], here["platform"]) == (
            "in_use",
            "ann",
            1,
            "json",
        )
        assert here["stopped"]["confirmed"]
        wait_for("the second shows the same", lambda: shown(fleet.second) == here)
    fleet.resume(fleet.second)
    here = shown(fleet.first)
    assert (here["state"], here["people"], here["stopped"]) == ("online", 0, None)
    wait_for("the second shows the same", lambda: shown(fleet.second) == here)


@pytest.mark.parametrize(("revoking", "serving"), [(0, 1), (1, 0), (1, 1)])
def test_a_foxglove_url_revoked_at_one_relay_is_cut_at_another(
    fleet: Fleet, revoking: int, serving: int
) -> None:
    """The robot's home is the first, where the sessions are. Its token opens nothing at any relay afterwards."""
    made = fleet.request("POST", fleet.relays[revoking], "/foxglove-urls", json={"label": "screen"})
    assert made.status_code == 201, made.text
    token = made.json()["url"].partition("?")[2]

    def opened(relay: Relay) -> Any:
        url = f"{relay.url('rover')}?{token}"
        return connect(url, subprotocols=[Subprotocol("foxglove.sdk.v1")], open_timeout=PATIENCE)

    with opened(fleet.relays[serving]) as client:
        assert json.loads(client.recv(PATIENCE))["op"] == "serverInfo"
        answer = fleet.request("DELETE", fleet.relays[revoking], f"/foxglove-urls/{made.json()['id']}")
        assert answer.status_code == 204, answer.text
        with pytest.raises(ConnectionClosed, match="revoked"):
            while True:
                client.recv(PATIENCE)
    for relay in fleet.relays:
        with pytest.raises(InvalidStatus) as refused:
            opened(relay)
        assert refused.value.response.status_code == 401


def test_http_at_another_relay_reaches_the_robot(fleet: Fleet) -> None:
    here, there = (fleet.get(relay, "") for relay in fleet.relays)
    assert here.json()["name"] == there.json()["name"] == "rover"
    assert there.status_code == 200
    answer = fleet.request("POST", fleet.second, "/services/say", json={})
    assert answer.json() == {"values": {"success": True, "message": "hello"}}
    assert answer.headers.get_list("content-type") == ["application/json"]
    assert fleet.get(fleet.second, "/topics/nothing").status_code == 404
    services = fleet.get(fleet.second, "/services")
    assert services.status_code == 200
    unchanged = fleet.get(fleet.second, "/services", headers={"If-None-Match": services.headers["etag"]})
    assert (unchanged.status_code, unchanged.content) == (304, b"")
    stop = fleet.request("POST", fleet.second, "/stop", json={"why": "smoke"})
    assert stop.status_code == 200, stop.text
    wait_for("it is stopped", lambda: fleet.robot.stopped is not None)
    assert fleet.robot.stopped == {"by": "ann", "why": "smoke"}
    fleet.resume(fleet.second)


def test_cameras_at_another_relay_are_shown(fleet: Fleet) -> None:
    """The list, a single image and a stream, also with a ticket, as in the ``<img>`` of a page elsewhere."""
    url = f"http://127.0.0.1:{fleet.second.http_port}/robots/rover/video"
    headers = {"Authorization": f"Bearer {fleet.token}"}
    cameras = httpx.get(f"{url}/cameras", headers=headers, timeout=PATIENCE).json()["cameras"]
    assert [each["name"] for each in cameras] == [CAMERA]
    snapshot = httpx.get(f"{url}/snapshot?topic={CAMERA}", headers=headers, timeout=PATIENCE)
    assert (snapshot.status_code, snapshot.content) == (200, fleet.robot.picture)
    assert httpx.get(f"{url}/snapshot?topic=/nothing", headers=headers, timeout=PATIENCE).status_code == 404
    tickets = f"http://127.0.0.1:{fleet.second.http_port}/api/v1/tickets"
    ticket = httpx.post(tickets, headers=headers, json={"robot": "rover", "for": "video"}).json()["ticket"]
    shown = f"{url}/stream?topic={CAMERA}&ticket={ticket}"
    with httpx.stream("GET", shown, headers={"Sec-Fetch-Site": "cross-site"}, timeout=PATIENCE) as stream:
        assert stream.headers["content-type"].startswith("multipart/x-mixed-replace")
        assert stream.headers["cross-origin-resource-policy"] == "cross-origin"
        received = b""
        for part in stream.iter_raw():
            received += part
            if fleet.robot.picture in received:
                break
    assert httpx.get(f"{url}/cameras", timeout=PATIENCE).status_code == 401


def test_an_order_to_many_robots_reaches_those_of_other_relays(fleet: Fleet) -> None:
    """The robot's relay refuses an order that needs its age; a stop is sent to it, and confirmed by the robot."""
    url = f"http://127.0.0.1:{fleet.second.http_port}/api/v1/fleet"
    headers = {"Authorization": f"Bearer {fleet.token}"}
    results = []
    for order in ({"do": "call", "service": "/say"}, {"do": "call", "service": "/nothing"}):
        answer = httpx.post(url, headers=headers, json={"robots": ["rover"], **order}, timeout=PATIENCE)
        results += [
            json.loads(line) for line in answer.text.splitlines() if '"ok":' in line and "done" not in line
        ]
    assert [(each["robot"], each["ok"]) for each in results] == [("rover", True), ("rover", False)]
    assert results[0]["values"] == {"success": True, "message": "hello"}
    for way in ("http", "command line"):
        if way == "http":
            stop = {"robots": ["r*"], "do": "stop", "stop_id": "one press"}
            answer = httpx.post(url, headers=headers, json=stop, timeout=PATIENCE)
            (line,) = [each for each in answer.text.splitlines() if '"ok":' in each and "done" not in each]
            assert json.loads(line) | {"seconds": 0} == {
                "robot": "rover", "ok": True, "message": "", "values": None, "pending": False, "seconds": 0
            }  # fmt: skip
        else:
            fleet.second.run_cli("stop", "rover")
        if way == "http":
            assert fleet.robot.stopped is not None
        wait_for("it is stopped", lambda: fleet.robot.stopped is not None)
        fleet.resume(fleet.first)
        wait_for("it may move", lambda: fleet.robot.stopped is None)


def test_the_command_line_at_another_relay_reaches_modules(fleet: Fleet) -> None:
    """Its orders are carried out by the home at once, so that none is pending."""
    for action in ("stop", "start", "restart"):
        done = fleet.second.cli("module", action, "rover", "base")
        assert (done["action"], done["pending"]) == (action, False)
    assert fleet.robot.module_orders == [("base", "stop"), ("base", "start"), ("base", "restart")]
    listed = fleet.second.cli("module", "list", "rover")
    assert (listed["online"], listed["current"]) == (True, True)
    assert [(each["name"], each["pending"]) for each in listed["modules"]] == [("base", None)]
    assert "base is up" in fleet.second.run_cli("module", "log", "rover", "base").stdout
    assert [each["name"] for each in fleet.second.cli("top", "rover")["processes"]] == ["base"]
    refused = fleet.second.run_cli("module", "stop", "rover", "arm")
    assert (refused.returncode, "no module 'arm'; it has base" in refused.stderr) == (1, True)
    entries = fleet.first.cli("audit", "list")
    assert [each["actor"] for each in entries if each["action"] == "module.restart"] == [f"cli:{os_user()}"]


def test_the_command_line_at_another_relay_reaches_pipes(fleet: Fleet) -> None:
    """They run at the home, which is the one that knows their states."""
    added = fleet.second.cli(
        *("pipe", "add", "told", "rover:/say()", "rover:/mode", "--target-type", "std_msgs/msg/String"),
        *("--owner", "ann", "--field", "message=data", "--rate", "5"),
    )
    assert "another relay" not in added["why"]

    def listed() -> dict[str, Any]:
        return next(each for each in fleet.second.cli("pipe", "list")["pipes"] if each["name"] == "told")

    wait_for("replies are carried, by the list", lambda: listed()["messages"])
    assert fleet.second.cli("pipe", "show", "told")["state"] == "running"
    assert fleet.second.cli("pipe", "stop", "told")["state"] == "stopped"
    assert fleet.first.cli("pipe", "show", "told")["state"] == "stopped"
    assert "relay" not in fleet.second.cli("pipe", "start", "told")["why"]
    fleet.second.cli("pipe", "remove", "told", "--yes")
    assert fleet.first.cli("pipe", "list") == {"pipes": []}


def test_a_robot_is_resumed_by_orders_of_another_relay(fleet: Fleet) -> None:
    """The home finds out how old the order can be."""
    refused = fleet.second.run_cli("resume", "rover")
    assert refused.returncode != 0
    assert "robot rover is connected to another relay" in refused.stderr
    assert "resume it by 'switchboard robot resume rover'" in refused.stderr
    (stopped,) = fleet.second.cli("robot", "stop", "rover")["results"]
    assert stopped["ok"], stopped
    wait_for("it is stopped", lambda: fleet.robot.stopped is not None)
    (resumed,) = fleet.second.cli("robot", "resume", "rover")["results"]
    assert resumed["ok"], resumed
    wait_for("it may move", lambda: fleet.robot.stopped is None)
    assert "online at another relay" in fleet.second.run_cli("status", "rover").stdout
    url = f"http://127.0.0.1:{fleet.second.http_port}/api/v1/fleet"
    headers = {"Authorization": f"Bearer {fleet.token}"}
    answer = httpx.post(url, json={"robots": ["*"], "do": "stop"}, headers=headers, timeout=PATIENCE)
    assert json.loads(answer.text.splitlines()[1])["ok"], answer.text
    body = {"robots": ["*"], "do": "resume"}
    answer = httpx.post(url, json=body, headers=headers, timeout=PATIENCE)
    assert answer.status_code == 428
    token = {"Switchboard-Freshness": answer.headers["Switchboard-Freshness"]}
    answer = httpx.post(url, json=body, headers={**headers, **token}, timeout=PATIENCE)
    assert json.loads(answer.text.splitlines()[1])["ok"], answer.text


def test_a_pipe_runs_at_the_home_of_its_robot(fleet: Fleet) -> None:
    """It is added, shown and removed at the other relay."""
    url = f"http://127.0.0.1:{fleet.second.http_port}/api/v1/pipes"
    headers = {"Authorization": f"Bearer {fleet.token}"}
    fields = [{"source": "message", "target": "data"}]
    source = {"robot": "rover", "service": "/say"}
    target = {"robot": "rover", "topic": "/mode", "type": "std_msgs/msg/String"}
    pipe = {"name": "said", "source": source, "target": target, "fields": fields, "rate": 5}
    added = httpx.post(url, headers=headers, json=pipe, timeout=PATIENCE)
    assert added.status_code == 201, added.text
    wait_for("the reply is carried", lambda: {"data": "hello"} in fleet.robot.heard)

    def messages() -> int:
        answer = httpx.get(url, headers=headers, timeout=PATIENCE).json()
        return int(answer["pipes"][0]["messages"])

    wait_for("the list shows it", messages)
    assert httpx.delete(f"{url}/said", headers=headers, timeout=PATIENCE).status_code in (200, 204)
    first = url.replace(str(fleet.second.http_port), str(fleet.first.http_port))
    assert httpx.get(first, headers=headers, timeout=PATIENCE).json() == {"pipes": []}


def test_elements_of_roles_at_another_relay_take_commands(fleet: Fleet) -> None:
    """Over HTTP, and by a program."""
    url = f"http://127.0.0.1:{fleet.second.http_port}/api/v1/roles/{ROLE}"
    headers = {"Authorization": f"Bearer {fleet.token}"}
    turtle = {**headers, "Content-Type": "text/turtle"}
    put = httpx.put(url, headers=turtle, content=ROLE_DOCUMENT, timeout=PATIENCE)
    assert put.status_code == 201, put.text
    said = httpx.post(f"{url}/elements/SAID/call", headers=headers, timeout=PATIENCE)
    assert said.json()["values"] == "hello", said.text
    value = {"value": "by role", "type": "std_msgs/msg/String"}
    done = httpx.put(f"{url}/elements/MODE", headers=headers, json=value, timeout=PATIENCE)
    assert done.status_code == 200, done.text
    wait_for("it has come", lambda: {"data": "by role"} in fleet.robot.heard)
    assert httpx.post(f"{url}/elements/MODE/call", headers=headers, timeout=PATIENCE).status_code == 409
    icpi = f"ws://127.0.0.1:{fleet.second.http_port}/icpi"
    with connect(icpi, additional_headers=headers, open_timeout=PATIENCE) as program:

        def request(function: str, *args: str) -> tuple[str, ...]:
            program.send(write(IcpiMessage(ROLE, "test", "1", True, function, args)))
            return parse(str(program.recv(PATIENCE))).args

        assert request("call", "SAID") == ("ok", '"hello"')
        result, reason = request("set", "NOTHING", "1")
        assert (result, "has no element NOTHING" in reason) == ("error", True)
        assert request("set", "MODE", '"by program"')[0] == "ok"
    wait_for("it has come", lambda: {"data": "by program"} in fleet.robot.heard)


def test_a_role_of_robots_at_two_relays_starts(fleet: Fleet) -> None:
    """Each part at the relay of its robot. A pipe between such robots waits, and says why."""
    pad = SmallRobot(fleet.second, "pad", {"/say": say})
    fleet.first.cli("right", "grant", "ann", "pad", "owner")
    pad.comes()
    url = f"http://127.0.0.1:{fleet.second.http_port}/api/v1"
    headers = {"Authorization": f"Bearer {fleet.token}"}
    with httpx.Client(base_url=url, headers=headers, timeout=PATIENCE) as ann:
        turtle = {"Content-Type": "text/turtle"}
        put = ann.put("/roles/Both-Say-Words", content=BOTH_DOCUMENT, headers=turtle)
        assert put.status_code == 201, put.text
        before = len(fleet.robot.calls)
        started = ann.post("/roles/Both-Say-Words/run/start").json()
        assert {each["resource"]: each["why"] for each in started["parts"]} == {
            "robots/pad/services/say": "",
            "robots/rover/services/say": "",
        }
        assert (len(pad.calls), len(fleet.robot.calls)) == (1, before + 1)
        ann.post("/roles/Both-Say-Words/run/stop").raise_for_status()
        source = {"robot": "rover", "service": "/say"}
        target = {"robot": "pad", "topic": "/mode", "type": "std_msgs/msg/String"}
        fields = [{"source": "message", "target": "data"}]
        pipe = {"name": "apart", "source": source, "target": target, "fields": fields, "rate": 5}
        ann.post("/pipes", json=pipe).raise_for_status()
        why = "waiting for robot rover, which is connected to another relay"
        wait_for("it says why", lambda: ann.get("/pipes/apart").json()["why"] == why)
        ann.delete("/pipes/apart").raise_for_status()
    pad.goes()


def test_guesses_at_a_password_count_at_all_relays_together(fleet: Fleet) -> None:
    """A network that the user has logged in from at one relay is not held up at the other."""
    fleet.first.user("gus", "correct horse")

    def log_in(relay: Relay, password: str, source: str) -> int:
        url = f"http://127.0.0.1:{relay.http_port}/api/v1/session"
        body = {"user": "gus", "password": password}
        with httpx.Client(transport=httpx.HTTPTransport(local_address=source), timeout=PATIENCE) as client:
            return client.post(url, json=body).status_code

    assert log_in(fleet.first, "correct horse", "127.0.0.100") == 200
    for number in range(FAILURES_OF_ACCOUNT):
        assert log_in(fleet.relays[number % 2], "wrong", f"127.0.0.{101 + number}") == 401
    assert [log_in(each, "correct horse", "127.0.0.99") for each in fleet.relays] == [429, 429]
    assert log_in(fleet.second, "correct horse", "127.0.0.100") == 200


def test_without_rights_another_relay_admits_no_client(fleet: Fleet) -> None:
    stranger = fleet.second.user("stranger")
    with pytest.raises(InvalidStatus) as caught:
        fleet.second.connect("rover", stranger)
    assert caught.value.response.status_code == 403
    url = f"http://127.0.0.1:{fleet.second.http_port}/api/v1/robots/rover"
    assert httpx.get(url, headers={"Authorization": f"Bearer {stranger}"}).status_code == 404


@pytest.mark.parametrize("bus", [True, False])
def test_a_right_that_ends_at_one_relay_ends_the_websocket_at_the_other(fleet: Fleet, bus: bool) -> None:
    """Without the bus, the other relay finds the change in the database."""
    token = fleet.first.user(f"bob{bus}".lower())
    fleet.first.cli("right", "grant", f"bob{bus}", "rover", "viewer")
    with fleet.second.connect("rover", token) as client:
        client.call("/rosapi/topics")
        if not bus:
            fleet.bus.kill()
        fleet.first.cli("right", "revoke", f"bob{bus}", "rover")
        with pytest.raises(ConnectionClosed) as closed:
            while True:
                client.receive()
    assert closed.value.rcvd is None or closed.value.rcvd.code == 4403
    if not bus:
        fleet.bus.start()
        for relay in fleet.relays:
            wait_for("the bus is back", lambda relay=relay: relay.cli("cluster", "status")["bus"])


def test_each_relay_shows_all_relays(fleet: Fleet) -> None:
    """By the command line, over HTTP and in the metrics, for administrators."""
    state = fleet.second.cli("cluster", "status")
    assert state["bus"]
    own = {each["address"]: (each["own"], each["state"]) for each in state["relays"]}
    assert sorted(own.values()) == [(False, "ready"), (True, "ready")]
    home = next(each for each in state["relays"] if not each["own"])
    assert (home["homes"], home["load"]["robots"]) == (1, 1)
    root = {"Authorization": f"Bearer {fleet.second.user('root', admin=True)}"}
    url = f"http://127.0.0.1:{fleet.second.http_port}"
    answer = httpx.get(f"{url}/api/v1/cluster", headers=root, timeout=PATIENCE).json()
    assert [each["address"] for each in answer["relays"]] == [each["address"] for each in state["relays"]]
    assert "switchboard_cluster_relays 2.0" in httpx.get(f"{url}/metrics", headers=root).text
    ann = {"Authorization": f"Bearer {fleet.token}"}
    assert httpx.get(f"{url}/api/v1/cluster", headers=ann).status_code == 403


def test_the_port_for_relays_serves_only_relays(fleet: Fleet) -> None:
    assert "the bus is connected" in fleet.second.log
    port = int(fleet.second.log.rpartition("other relays connect at 127.0.0.1:")[2].split()[0])
    # Other relays ask this whether it still answers anything.
    alive = httpx.get(f"http://127.0.0.1:{port}{ANYTHING}", headers={"Switchboard-Cluster": SECRET})
    assert alive.status_code < 500, alive.text
    for headers in (
        {},
        {"Switchboard-Cluster": "x" * 32},
        {"Switchboard-Cluster": SECRET, "Switchboard-Client": "bm8="},
    ):
        answer = httpx.get(f"http://127.0.0.1:{port}/api/v1/robots", headers=headers)
        assert answer.status_code == 403, answer.text
    for relay in fleet.relays:
        # The header of another relay has no effect at the port for clients.
        url = f"http://127.0.0.1:{relay.http_port}/api/v1/robots"
        answer = httpx.get(url, headers={"Switchboard-Cluster": SECRET, "Switchboard-Client": "bm8="})
        assert answer.status_code == 401


def test_a_robot_that_moves_is_reached_at_its_new_home(fleet: Fleet) -> None:
    """Its connection to another relay ends the websockets that were forwarded to the relay before."""
    fleet.connect_at(fleet.second, fleet.first)
    for relay in fleet.relays:
        with relay.connect("rover", fleet.token) as client:
            assert client.call("/say")["result"], relay
    fleet.connect_at(fleet.first, fleet.second)
    with fleet.second.connect("rover", fleet.token) as client:
        assert client.call("/say")["result"]


def test_two_daemons_with_one_key_at_two_relays_are_an_alert(fleet: Fleet) -> None:
    """The older link still answers; owners are notified of both addresses. Each relay lists the alert."""
    with End(fleet.second.robots_port, "127.0.0.3") as copy:
        assert copy.register("rover", fleet.robot._key)["op"] == "welcome"
        for relay in fleet.relays:
            (alert,) = wait_for("the owner is notified", lambda relay=relay: fleet.alerts(relay, "key"))
            assert "127.0.0.1, 127.0.0.3" in alert["text"]
    fleet.connect_at(fleet.first, fleet.second)


def test_recordings_and_files_are_found_at_the_relay_that_has_them(fleet: Fleet) -> None:
    """A client at any relay lists, downloads and deletes what the robot's former home has stored."""
    begun = fleet.request("POST", fleet.second, "/recordings", json={"cameras": [CAMERA]})
    assert begun.status_code == 201, begun.text
    path = f"/recordings/{begun.json()['id']}"
    wait_for("a frame is recorded", lambda: fleet.get(fleet.second, path).json()["messages"] > 0)
    fleet.request("POST", fleet.second, f"{path}/stop")
    wait_for("it is complete", lambda: fleet.get(fleet.second, path).json()["state"] == "complete")
    large = bytes(4 << 20)
    assert fleet.request("PUT", fleet.second, "/files/bags/large", content=large).status_code == 201
    fleet.connect_at(fleet.second, fleet.first)
    for relay in fleet.relays:
        listed = fleet.get(relay, "/recordings?limit=1").json()
        assert ([each["id"] for each in listed["recordings"]], listed["next"]) == ([begun.json()["id"]], None)
        assert fleet.get(relay, f"{path}/file").content.startswith(b"\x89MCAP")
        assert [each["name"] for each in fleet.get(relay, "/files").json()["files"]] == ["bags/large"]
        assert fleet.get(relay, "/files/bags/large").content == large
        assert fleet.get(relay, "/recordings/nothing").status_code == 404
        assert fleet.get(relay, "/files/nothing").status_code == 404
    contents = fleet.first.data / "files"
    assert [each.stat().st_size for each in contents.rglob("*") if each.is_file()] == [len(large)]
    for each in (path, "/files/bags/large"):
        assert fleet.request("DELETE", fleet.second, each).status_code in (200, 204)
    wait_for("the contents are deleted", lambda: not any(each.is_file() for each in contents.rglob("*")))
    assert fleet.get(fleet.first, "/recordings").json()["recordings"] == []
    fleet.connect_at(fleet.first, fleet.second)


def test_a_home_that_stands_still_lets_no_request_wait(fleet: Fleet) -> None:
    """The request would have ten minutes. The websocket ends when the robot is at another relay."""
    fleet.connect_at(fleet.first, fleet.second)
    with fleet.second.connect("rover", fleet.token) as client:
        assert client.call("/say")["result"]
        fleet.first.freeze()
        try:
            fleet.connect_at(fleet.second)
            with pytest.raises(ConnectionClosed) as closed:
                while True:
                    client.receive()
            assert closed.value.rcvd is not None
            assert (closed.value.rcvd.code, "connected to another relay" in closed.value.rcvd.reason) == (
                4503,
                True,
            )
        finally:
            fleet.first.thaw()
    fleet.connect_at(fleet.first, fleet.second)
    fleet.first.freeze()
    try:
        answer = fleet.get(fleet.second, "/params")
        assert (answer.status_code, "relay" in answer.json()["detail"]) == (503, True), answer.text
    finally:
        fleet.first.thaw()


def test_a_stop_that_waits_for_its_robot_ends_at_each_relay(fleet: Fleet) -> None:
    """By a resume at one of them, or when the robot has confirmed it to one of them."""
    fleet.robot.goes()
    for relay in fleet.relays:
        wait_for("the robot is away", lambda relay=relay: fleet.state(relay) == "offline")
    for at, ends in enumerate((lambda: fleet.first.cli("resume", "rover"), fleet.robot.comes)):
        assert fleet.request("POST", fleet.relays[at], "/stop", json={"why": "away"}).status_code == 202
        for relay in fleet.relays:
            wait_for("it shows the stop", lambda relay=relay: fleet.listed(relay)["stopped"])
        ends()
        for relay in fleet.relays:
            wait_for(
                "it shows the stop as pending no longer",
                lambda relay=relay: (fleet.listed(relay)["stopped"] or {"confirmed": True})["confirmed"],
            )
    fleet.resume(fleet.second)
    for relay in fleet.relays:
        wait_for("it shows no stop", lambda relay=relay: fleet.listed(relay)["stopped"] is None)


def services(foxglove: Any) -> list[dict[str, Any]]:
    """The services that a Foxglove client gets first."""
    while True:
        message = foxglove.recv(PATIENCE)
        if isinstance(message, str) and json.loads(message)["op"] == "advertiseServices":
            return list(json.loads(message)["services"])


def stops_and_resumes(fleet: Fleet) -> None:
    """The robot stops, and the first relay resumes it."""
    wait_for("the robot has stopped", lambda: fleet.robot.stopped is not None)
    fleet.resume(fleet.first)
    wait_for("the robot has resumed", lambda: fleet.robot.stopped is None)


def test_a_silent_network_between_relays_lets_no_stop_wait(fleet: Fleet) -> None:
    """The stop passes by the database, however it was sent, and the client learns that its robot can't be reached."""
    address = f"ws://127.0.0.1:{fleet.second.http_port}/robots/rover"
    headers, protocols = {"Authorization": f"Bearer {fleet.token}"}, [Subprotocol("foxglove.websocket.v1")]
    with (
        fleet.second.connect("rover", fleet.token) as client,
        connect(address, additional_headers=headers, subprotocols=protocols) as foxglove,
    ):
        assert client.call("/say")["result"]
        stop = next(each for each in services(foxglove) if each["name"] == "/relay/stop")
        fleet.link.black_hole()
        try:
            assert fleet.request("POST", fleet.second, "/stop", json={"reason": "test"}).status_code == 202
            stops_and_resumes(fleet)
            answer = client.call("/relay/stop", {"why": "test", "stop_id": "one"})
            assert (answer["result"], answer["values"]) == (
                True,
                {
                    "success": True,
                    "message": "robot rover will be stopped as soon as it can be reached",
                    "done": False,
                    "stopped": {**answer["values"]["stopped"], "why": "test", "confirmed": False},
                },
            )
            stops_and_resumes(fleet)
            foxglove.send(struct.pack("<BIII", 2, stop["id"], 5, 4) + b"json" + b'{"why":"test"}')
            assert json.loads(foxglove.recv(PATIENCE)) == {
                "op": "serviceCallFailure",
                "serviceId": stop["id"],
                "callId": 5,
                "message": "robot rover will be stopped as soon as it can be reached",
            }
            wait_for("the robot has stopped", lambda: fleet.robot.stopped is not None)
            assert fleet.get(fleet.first, "").json()["stopped"]
            with pytest.raises(ConnectionClosed) as closed:
                while True:
                    client.receive()
            assert closed.value.rcvd is not None
            assert (closed.value.rcvd.code, closed.value.rcvd.reason) == (
                4503,
                "the connection to the robot's relay is lost; connect again",
            )
            with pytest.raises(InvalidStatus, match="503"):
                fleet.second.connect("rover", fleet.token)
        finally:
            fleet.link.heal()
    fleet.resume(fleet.second)
    with fleet.second.connect("rover", fleet.token) as client:
        assert client.call("/say")["result"]


def test_death_of_the_home_relay_is_explained(fleet: Fleet) -> None:
    with fleet.second.connect("rover", fleet.token) as client:
        assert client.call("/say")["result"]
        fleet.first.kill()
        with pytest.raises(ConnectionClosed) as closed:
            while True:
                client.receive()
        assert closed.value.rcvd is not None
        assert (closed.value.rcvd.code, closed.value.rcvd.reason) == (
            4503,
            "the connection to the robot's relay is lost; connect again",
        )
    fleet.connect_at(fleet.second)
    with fleet.second.connect("rover", fleet.token) as client:
        assert client.call("/say")["result"]
    fleet.first.start()
    wait_for("the first knows it", lambda: fleet.state(fleet.first) != "offline")
    with fleet.first.connect("rover", fleet.token) as client:
        assert client.call("/say")["result"]


def test_a_drained_relay_gives_its_robots_and_clients_to_the_others(fleet: Fleet) -> None:
    """It takes no robots afterwards, and still forwards. It can be stopped then without a wait."""
    fleet.connect_at(fleet.second, fleet.first)
    with fleet.second.connect("rover", fleet.token) as client:
        client.call("/say")
        assert not send_order(fleet.second.data, "drain", {})["done"]
        wait_for("the robot was asked", lambda: fleet.state(fleet.second) == "offline")
        fleet.connect_at(fleet.first, fleet.second)
        with pytest.raises(ConnectionClosed) as closed:
            while True:
                client.receive()
    assert closed.value.rcvd is not None
    assert "connect again" in closed.value.rcvd.reason
    assert fleet.second.cli("drain") == {"robots": 0, "done": True}
    ready = [httpx.get(f"http://127.0.0.1:{each.http_port}/readyz").status_code for each in fleet.relays]
    assert ready == [200, 503]
    # Its robots would have nowhere to go.
    refused = fleet.first.run_cli("drain")
    assert (refused.returncode, "no other relay" in refused.stdout + refused.stderr) == (3, True)
    with End(fleet.second.robots_port) as robot:
        robot.send(link.Hello(version=PROTOCOL_VERSION, robot="rover", key="", encodings=["json"]))
        assert robot.until("refused")["retry_after"] == 1.0
    with fleet.second.connect("rover", fleet.token) as client:
        assert client.call("/say")["result"]
    assert fleet.second.stop() == 0
    fleet.second.start()
