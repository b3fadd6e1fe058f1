"""Commands on elements of a Role, on real robots: by HTTP, rosbridge and the command line, by the user's rights."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

import httpx
import pytest
from websockets.sync.client import connect

from relay_server.icpi.messages import IcpiMessage, parse, write
from tests.worlds.json_robots import JsonRobot
from tests.worlds.processes import running
from tests.worlds.relay_process import Relay
from tests.worlds.waiting import PATIENCE, wait_for

ROLE = "Thermometer-Drive-Wheels"
DOCUMENT = """
@prefix fierro: <fierro:> .
@prefix switchboard: <switchboard:> .
fierro:Thermometer-Drive-Wheels a fierro:role ;
  fierro:subject fierro:Thermometer ; fierro:action fierro:Drive ; fierro:directObject fierro:Wheels .
fierro:Thermometer a fierro:subject ; fierro:data fierro:Readings .
fierro:Readings fierro:field fierro:DEGREES .
fierro:DEGREES switchboard:resource "robots/pad/topics/temperature#/data" ; fierro:mapping fierro:Port_1 .
fierro:Drive a fierro:action ; fierro:process fierro:Carrier ; fierro:function fierro:BEEP .
fierro:Carrier a fierro:process ; fierro:port fierro:Port_1 ; switchboard:resource "pipes/drive" .
fierro:BEEP switchboard:resource "robots/rover/services/beep" .
fierro:Wheels a fierro:directObject ; fierro:data fierro:SPEED, fierro:DRIVEN .
fierro:SPEED switchboard:resource "robots/rover/topics/cmd_vel#/linear/x" .
fierro:DRIVEN switchboard:resource "robots/rover/topics/cmd_vel/heard" .
"""
SET = ("role", "set", ROLE, "SPEED", "0.1")
PIPE = {
    "name": "drive",
    "source": {"robot": "pad", "topic": "/temperature"},
    "target": {"robot": "rover", "topic": "/cmd_vel"},
    "fields": [{"source": "data", "target": "linear.x", "scale": 0.01}],
    "start": False,
}


RUN = "Thermometer-Moves-Wheels"
RUN_DOCUMENT = """
@prefix fierro: <fierro:> .
@prefix switchboard: <switchboard:> .
fierro:Thermometer-Moves-Wheels a fierro:role ;
  fierro:subject fierro:Thermometer ; fierro:action fierro:Move ; fierro:directObject fierro:Wheels .
fierro:Thermometer fierro:data fierro:HEAT .
fierro:HEAT switchboard:resource "robots/pad/topics/temperature#/data" ; fierro:mapping fierro:SPEED .
fierro:Move fierro:process fierro:Driver, fierro:Horn .
fierro:Driver switchboard:resource "robots/rover/modules/driver" .
fierro:Horn switchboard:resource "robots/rover/services/beep" .
fierro:Wheels fierro:data fierro:SPEED .
fierro:SPEED switchboard:resource "robots/rover/topics/cmd_vel#/linear/x" .
"""


class World:
    """A relay with two robots; ann drives both, bob sees both, cid has no right, root administers."""

    def __init__(self, relay: Relay) -> None:
        self.relay = relay
        self.robots = [JsonRobot(relay, name) for name in ("pad", "rover")]
        self.tokens = {each: relay.user(each, admin=each == "root") for each in ("root", "ann", "bob", "cid")}
        for robot in ("pad", "rover"):
            relay.cli("right", "grant", "ann", robot, "operator")
            relay.cli("right", "grant", "bob", robot, "viewer")
        base = f"http://127.0.0.1:{relay.http_port}/api/v1"
        self.clients = {
            each: httpx.Client(base_url=base, headers={"Authorization": f"Bearer {token}"}, timeout=60)
            for each, token in self.tokens.items()
        }
        for name, text in ((ROLE, DOCUMENT), (RUN, RUN_DOCUMENT)):
            headers = {"Content-Type": "text/turtle"}
            put = self.clients["ann"].put(f"/roles/{name}", content=text, headers=headers)
            assert put.status_code == 201, put.text

    def ask(self, user: str, method: str, element: str, **more: Any) -> httpx.Response:
        """A request for an element."""
        return self.clients[user].request(method, f"/roles/{ROLE}/elements/{element}", **more)

    def fresh(self) -> dict[str, str]:
        """A freshness token."""
        answer = self.ask("ann", "GET", "DRIVEN")
        return {"Switchboard-Freshness": answer.headers["Switchboard-Freshness"]}

    def stop(self) -> None:
        for client in self.clients.values():
            client.close()
        for robot in self.robots:
            robot.stop()
        self.relay.stop()


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    made = World(Relay(tmp_path_factory.mktemp("commands")))
    with running(made):
        yield made


def test_elements_are_listed(world: World) -> None:
    answer = world.clients["bob"].get(f"/roles/{ROLE}/elements")
    found = {each["name"]: each for each in answer.json()["elements"]}
    assert found["DEGREES"] == {
        "name": "DEGREES",
        "types": ["field"],
        "resources": ["robots/pad/topics/temperature#/data"],
        "mappings": ["Port_1"],
    }
    assert (found["Carrier"]["types"], ROLE in found) == (["process"], False)
    assert world.clients["cid"].get(f"/roles/{ROLE}/elements").status_code == 404


def test_get_by_own_and_by_mapped_resource(world: World) -> None:
    own = world.ask("ann", "GET", "DEGREES")
    assert own.status_code == 200, own.text
    assert 19 <= own.json()["value"] <= 21
    mapped = world.ask("bob", "GET", "fierro:Port_1").json()
    assert (mapped["resource"], 19 <= mapped["value"] <= 21) == ("robots/pad/topics/temperature#/data", True)
    assert world.ask("cid", "GET", "DEGREES").status_code == 404
    assert world.ask("ann", "GET", "NOTHING").status_code == 404


def test_set_moves_the_robot_by_the_rules_of_a_client(world: World) -> None:
    def speed() -> float:
        value = world.ask("ann", "GET", "DRIVEN").json().get("value") or {}
        return float(value.get("linear", {}).get("x", 0.0))

    assert world.ask("ann", "PUT", "SPEED", json={"value": 0.25}).status_code == 428
    viewer = world.ask("bob", "PUT", "SPEED", json={"value": 0.25}, headers=world.fresh())
    assert viewer.status_code == 403, viewer.text

    # Until the robots have channels, a command may arrive too late.
    def moves() -> bool:
        answer = world.ask("ann", "PUT", "SPEED", json={"value": 0.25}, headers=world.fresh())
        assert answer.status_code in (200, 409, 412), answer.text
        return speed() == 0.25

    wait_for("the robot moves", moves)
    world.clients["ann"].post("/robots/rover/services/relay/release_control")

    def audited() -> list[str]:
        return [
            each["target"] for each in world.relay.cli("audit", "list") if each["action"] == "element.set"
        ]

    wait_for("it is in the audit log", lambda: f"{ROLE}/SPEED@default" in audited())


def test_a_number_that_is_not_finite_moves_no_robot_by_icpi(world: World) -> None:
    """A program sets an element of a Role."""
    with connect(
        f"ws://127.0.0.1:{world.relay.http_port}/icpi",
        additional_headers={"Authorization": f"Bearer {world.tokens['ann']}"},
        open_timeout=PATIENCE,
    ) as program:

        def refusal() -> str:
            program.send(write(IcpiMessage(ROLE, "test", "1", True, "set", ("SPEED", "NaN"))))
            result, words = parse(str(program.recv(PATIENCE))).args
            assert result == "error"
            # Until a ping proves how old its messages are; commands are limited for each user.
            return "" if "too long ago" in words or "too often" in words else words

        assert "must be finite" in wait_for("a command by ICPI is judged", refusal)
    assert world.ask("ann", "GET", "DRIVEN").json()["value"]["linear"]["x"] == 0


@pytest.mark.parametrize("number", ["NaN", "-Infinity", "1e999", "null"])
def test_a_number_that_is_not_finite_moves_no_robot_by_any_entry(world: World, number: str) -> None:
    """HTTP, which Things use too, the fleet, elements by HTTP and rosbridge, and a published message."""
    topic, twist = "/robots/rover/topics/cmd_vel", f'{{"linear":{{"x":{number}}}}}'
    requests = (
        ("PUT", topic, f'{{"value":{twist}}}'),
        ("POST", topic, f'{{"value":{twist}}}'),
        ("PUT", f"/roles/{ROLE}/elements/SPEED", f'{{"value":{number}}}'),
        ("POST", "/fleet", f'{{"robots":["rover"],"do":"publish","topic":"/cmd_vel","msg":{twist}}}'),
    )
    errors = {}
    for method, path, body in requests:
        headers = {"Content-Type": "application/json", **world.fresh()}
        answer = world.clients["ann"].request(method, path, content=body, headers=headers)
        assert not answer.is_success or '"ok":false' in answer.text, answer.text
        errors[method, path] = answer.text
    with world.relay.connect("rover", world.tokens["ann"]) as client:
        client.send(op="set_level", level="warning")
        assert client.call("/relay/take_control")["result"]
        level = "warning"
        # Until the robot has the publisher, a command may become too old.
        while level == "warning":
            client.connection.send(f'{{"op":"publish","id":"p","topic":"/cmd_vel","msg":{twist}}}')
            status = client.until(op="status", id="p")
            level, errors["rosbridge", "publish"] = status["level"], status["msg"]
        assert client.call("/relay/release_control")["result"]
        element = {"role": ROLE, "element": "SPEED", "value": number}
        given = client.call("/relay/set_element", element)
        assert not given["result"] or not given["values"]["success"]
        errors["rosbridge", "set"] = str(given["values"])
    unclear = {
        each: text for each, text in errors.items() if not re.search(r"finite|range|NaN|null|JSON", text)
    }
    assert not unclear
    assert world.ask("ann", "GET", "DRIVEN").json()["value"]["linear"]["x"] == 0


def test_a_pipe_whose_product_is_infinite_moves_no_robot(world: World) -> None:
    """Its table of fields multiplies a temperature by more than a double can hold."""
    fields = [{"source": "data", "target": "linear.x", "scale": 1e308}]
    pipe = {**PIPE, "name": "hot", "fields": fields, "start": True}
    world.clients["ann"].post("/pipes", json=pipe).raise_for_status()

    def problem() -> str:
        return str(world.clients["ann"].get("/pipes/hot").json()["why"])

    wait_for("its drops say why", lambda: re.search("finite|range", problem()))
    assert world.ask("ann", "GET", "DRIVEN").json()["value"]["linear"]["x"] == 0
    world.clients["ann"].delete("/pipes/hot").raise_for_status()
    world.clients["ann"].post("/robots/rover/services/relay/release_control")


def test_call_start_and_stop(world: World) -> None:
    called = world.ask("ann", "POST", "BEEP/call", json={})
    assert called.status_code == 200, called.text
    assert called.json()["values"]["success"] is True
    refused = world.ask("ann", "POST", "DEGREES/call")
    assert (refused.status_code, "takes no 'call'" in refused.json()["detail"]) == (409, True)
    assert world.ask("ann", "POST", "Carrier/fly").status_code == 404
    assert world.ask("ann", "POST", "Carrier/start").status_code == 404
    world.clients["ann"].post("/pipes", json=PIPE).raise_for_status()
    started = world.ask("ann", "POST", "Carrier/start").json()
    assert (started["resource"], started["state"] in ("waiting", "running")) == ("pipes/drive", True)
    wait_for(
        "the pipe runs", lambda: world.ask("ann", "GET", "Carrier").json()["value"]["state"] == "running"
    )
    assert world.ask("bob", "POST", "Carrier/stop").status_code == 404
    assert world.ask("ann", "POST", "Carrier/stop").json()["state"] == "stopped"
    assert world.ask("ann", "POST", "BEEP/start").json()["state"] == "on"
    assert "can only be started" in world.ask("ann", "POST", "BEEP/stop").json()["detail"]


def test_by_rosbridge(world: World) -> None:
    element = {"role": ROLE, "element": "DEGREES"}
    with world.relay.connect("rover", world.tokens["ann"]) as client:
        got = client.call("/relay/get_element", element)["values"]
        assert (got["success"], 19 <= json.loads(got["value"]) <= 21) == (True, True)
        called = client.call("/relay/call_element", {"role": ROLE, "element": "BEEP"})["values"]
        assert json.loads(called["values"])["success"] is True
        assert not client.call("/relay/set_element", {**element, "value": "no JSON"})["result"]
        assert (
            client.call("/relay/start_element", {"role": ROLE, "element": "BEEP"})["values"]["state"] == "on"
        )
        assert not client.call("/relay/stop_element", {"role": ROLE, "element": "BEEP"})["result"]


def test_by_the_command_line(world: World) -> None:
    cli = world.relay.cli
    assert 19 <= cli("role", "get", ROLE, "DEGREES", "--user", "bob")["value"] <= 21
    assert cli("role", "call", ROLE, "BEEP", "--user", "ann")["values"]["success"] is True
    said: list[str] = []

    def is_set() -> bool:
        done = world.relay.run_cli(*SET, "--user", "ann")
        said.append(str(done.stderr))
        return done.returncode == 0

    try:
        wait_for("the robot is free", is_set)
    except AssertionError as error:
        raise AssertionError(f"{error}: {said[-1]}") from None
    denied = world.relay.run_cli(*SET, "--user", "bob")
    assert (denied.returncode != 0, "publish" in denied.stderr) == (True, True), denied.stderr
    unseen = world.relay.run_cli("role", "get", ROLE, "DEGREES", "--user", "cid")
    assert "no such Role" in unseen.stderr


def run(world: World, user: str, order: str = "") -> dict[str, Any]:
    """Starts or stops the Role that moves the robot; returns its state."""
    method, path = ("POST", f"/run/{order}") if order else ("GET", "/run")
    answer = world.clients[user].request(method, f"/roles/{RUN}{path}")
    assert answer.status_code == 200, answer.text
    return dict(answer.json())


def parts(world: World, user: str = "ann") -> dict[str, str]:
    """States of the parts of that Role."""
    return {each["element"]: each["state"] for each in run(world, user)["parts"]}


def mapped_pipes(world: World) -> list[str]:
    """Names of pipes made for mappings."""
    pipes = world.clients["root"].get("/pipes").json()["pipes"]
    return [each["name"] for each in pipes if each["name"].startswith("role-")]


UP = {"Driver": "failed", "Horn": "on", "HEAT → SPEED": "running"}


def comes_up(world: World) -> None:
    """Starts it and waits until all is up. The robot has no controller first: commands to elements have
    acquired control.
    """

    def up() -> bool:
        if parts(world).get("HEAT → SPEED") in ("refused", "failed"):
            assert world.clients["ann"].delete("/robots/rover/control").is_success
            run(world, "ann", "start")
        return parts(world) == UP

    try:
        wait_for("its parts are up", up)
    except AssertionError as error:
        raise AssertionError(run(world, "ann")) from error


def test_a_role_starts_what_it_can_and_its_state_is_live(world: World) -> None:
    assert run(world, "bob")["state"] == "stopped"
    with world.clients["bob"].stream(
        "GET", f"/roles/{RUN}/run", headers={"Accept": "text/event-stream"}
    ) as live:
        states = (json.loads(each[6:])["state"] for each in live.iter_lines() if each.startswith("data: "))
        assert next(states) == "stopped"
        started = run(world, "ann", "start")
        assert [each["element"] for each in started["parts"]] == ["Driver", "Horn", "HEAT → SPEED"]
        assert started["parts"][0]["why"] != ""
        assert "partial" in states
    comes_up(world)
    wait_for("the robot moves", lambda: world.ask("ann", "GET", "DRIVEN").json()["value"]["linear"]["x"] > 15)
    assert parts(world, "bob") == {}
    taken = world.clients["root"].post(f"/roles/{RUN}/run/start")
    assert (taken.status_code, taken.json()["code"]) == (409, "started_by_another")
    assert world.clients["bob"].post(f"/roles/{RUN}/run/stop").status_code == 403
    assert world.clients["ann"].delete(f"/roles/{RUN}").status_code == 409


def test_a_second_start_leaves_what_runs(world: World) -> None:
    def carried() -> int:
        (pipe,) = [
            each for each in world.clients["ann"].get("/pipes").json()["pipes"] if each["name"][:5] == "role-"
        ]
        return int(pipe["messages"])

    before = wait_for("it has carried messages", lambda: carried() if carried() > 5 else 0)
    assert parts(world) == UP
    run(world, "ann", "start")
    assert carried() >= before
    assert parts(world) == UP


def test_it_outlives_the_relay(world: World) -> None:
    world.relay.stop()
    world.relay.start()
    for robot in ("pad", "rover"):
        wait_for(f"{robot} is back", lambda name=robot: world.relay.state_of(name) != "offline")
    # A pipe that moves a robot waits for a user to start it again.
    wait_for("it is partial", lambda: parts(world) == {**UP, "HEAT → SPEED": "refused"})
    comes_up(world)


def test_it_stops_in_the_reverse_order_and_by_rosbridge(world: World) -> None:
    assert run(world, "root", "stop")["state"] == "stopped"
    assert mapped_pipes(world) == []
    with world.relay.connect("rover", world.tokens["ann"]) as client:
        started = client.call("/relay/start_role", {"role": RUN})["values"]
        assert (started["success"], "Driver: " in started["message"]) == (False, True)
        assert client.call("/relay/stop_role", {"role": RUN})["values"]["state"] == "stopped"
    kinds = [each["kind"] for each in world.clients["ann"].get("/events").json()["events"]]
    assert {"role.started", "role.stopped"} <= set(kinds)


def test_it_ends_with_a_right_of_its_user(world: World) -> None:
    cli = world.relay.cli
    assert cli("role", "start", RUN, "--user", "ann")["by"] == "ann"
    cli("right", "revoke", "ann", "pad")
    wait_for("it has ended", lambda: cli("role", "state", RUN, "--user", "ann")["state"] == "ended")
    assert "revoked" in cli("role", "state", RUN, "--user", "ann")["why"]
    assert mapped_pipes(world) == []
    cli("right", "grant", "ann", "pad", "operator")
    cli("role", "stop", RUN, "--user", "ann")
    assert [each["action"] for each in cli("audit", "list")].count("role.end") == 1


def test_what_a_replaced_role_has_no_more_is_stopped(world: World) -> None:
    ann, headers = world.clients["ann"], {"Content-Type": "text/turtle", "If-Match": "*"}
    assert [each["element"] for each in run(world, "ann", "start")["parts"]] == list(UP)
    assert len(mapped_pipes(world)) == 1
    less = RUN_DOCUMENT.replace(" ; fierro:mapping fierro:SPEED", "")
    ann.put(f"/roles/{RUN}", content=less, headers=headers).raise_for_status()
    assert [each["element"] for each in run(world, "ann", "start")["parts"]] == ["Driver", "Horn"]
    assert mapped_pipes(world) == []
    assert "SPEED" not in parts(world)
    lacking = less.replace("fierro:subject fierro:Thermometer ;", "")
    notes = ann.put(f"/roles/{RUN}", content=lacking, headers=headers).raise_for_status().json()["notes"]
    refused = ann.post(f"/roles/{RUN}/run/start")
    assert (refused.status_code, notes[0] in refused.json()["detail"]) == (400, True), refused.text
    assert run(world, "ann", "stop")["state"] == "stopped"


OTHER = "Thermometer-Reports-Heat"
OTHER_DOCUMENT = """
@prefix fierro: <fierro:> .
fierro:Thermometer-Reports-Heat a fierro:role ;
  fierro:subject fierro:Probe ; fierro:action fierro:Report ; fierro:directObject fierro:Heat .
fierro:Probe fierro:data fierro:HEAT . fierro:HEAT fierro:mapping fierro:TURN .
"""
"""Its mapping joins an element of the Role that moves the robot with one of a third Role."""
TURN = "Wheels-Turn-Rover"
TURN_DOCUMENT = """
@prefix fierro: <fierro:> .
@prefix switchboard: <switchboard:> .
fierro:Wheels-Turn-Rover a fierro:role ;
  fierro:subject fierro:Wheels ; fierro:action fierro:Turn ; fierro:directObject fierro:Rover .
fierro:Turn fierro:process fierro:Beeper . fierro:Beeper switchboard:resource "robots/rover/services/beep" .
fierro:Rover fierro:data fierro:TURN .
fierro:TURN switchboard:resource "robots/pad/topics/cmd_vel#/angular/z" .
"""


def test_a_pipe_between_roles_runs_while_all_of_them_are_started(world: World) -> None:
    ann = world.clients["ann"]
    turtle = {"Content-Type": "text/turtle"}
    for name, text in ((OTHER, OTHER_DOCUMENT), (TURN, TURN_DOCUMENT)):
        ann.put(f"/roles/{name}", content=text, headers=turtle).raise_for_status()
    whole = ann.put(f"/roles/{RUN}", content=RUN_DOCUMENT, headers={**turtle, "If-Match": "*"})
    whole.raise_for_status()

    def order(role: str, what: str) -> None:
        ann.post(f"/roles/{role}/run/{what}").raise_for_status()

    def part() -> dict[str, str]:
        (found,) = ann.get(f"/roles/{OTHER}/run").json()["parts"]
        return dict(found)

    order(OTHER, "start")
    assert part()["why"] == f"waiting for {RUN} and {TURN} to be started"
    order(RUN, "start")
    assert (part()["state"], len(mapped_pipes(world))) == ("waiting", 1)
    order(TURN, "start")
    assert part()["element"] == "HEAT → TURN"
    wait_for("the pipe runs", lambda: part()["state"] == "running")
    order(RUN, "stop")
    assert (part()["state"], mapped_pipes(world)) == ("waiting", [])
    for role in (OTHER, TURN):
        order(role, "stop")


def test_a_role_may_name_robots_with_their_realm(world: World) -> None:
    """Its user's account in that realm is who has the right; here it is the user itself."""
    ann, name = world.clients["ann"], "Thermometer-Full-Names"
    text = TURN_DOCUMENT.replace(TURN, name).replace(
        'fierro:Turn fierro:process fierro:Beeper . fierro:Beeper switchboard:resource "robots/rover/services/beep" .',
        "fierro:Turn fierro:port fierro:HEAT . fierro:HEAT fierro:mapping fierro:TURN ; "
        'switchboard:resource "robots/pad%40default/topics/temperature#/data" .',
    )
    ann.put(f"/roles/{name}", content=text, headers={"Content-Type": "text/turtle"}).raise_for_status()
    started = ann.post(f"/roles/{name}/run/start").raise_for_status().json()
    assert ([each["element"] for each in started["parts"]], started["why"]) == (["HEAT → TURN"], "")
    wait_for("the pipe runs", lambda: ann.get(f"/roles/{name}/run").json()["state"] == "running")
    assert ann.post(f"/roles/{name}/run/stop").json()["state"] == "stopped"
