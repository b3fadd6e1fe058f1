"""ICPI programs with a real relay: the examples, commands to Roles and programs, rights, and hostile
messages.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from relay_server.icpi.messages import IcpiMessage, parse, write
from tests.worlds.json_robots import JsonRobot
from tests.worlds.processes import Process, running
from tests.worlds.relay_process import Relay
from tests.worlds.waiting import PATIENCE, wait_for

EXAMPLES = Path("docs/examples")
NODE = [str(Path(__file__).parents[2] / "scripts" / "with-node.sh"), "node"]
ROLE = "Switch-Light-Lamp"
DOCUMENT = """
@prefix fierro: <fierro:> .
@prefix switchboard: <switchboard:> .
fierro:Switch-Light-Lamp a fierro:role ;
  fierro:subject fierro:Switch ; fierro:action fierro:Light ; fierro:directObject fierro:Lamp .
fierro:Switch fierro:data fierro:DEGREES .
fierro:DEGREES switchboard:resource "robots/pad/topics/temperature#/data" .
fierro:Light fierro:process fierro:Lighter ; fierro:function fierro:TOGGLE .
fierro:Lighter switchboard:resource "programs/lamp" .
fierro:TOGGLE switchboard:resource "programs/lamp/functions/toggle" .
fierro:Lamp fierro:data fierro:POWER .
fierro:POWER switchboard:resource "programs/lamp/ports/power" .
"""


class World:
    """A relay with a robot, ann's lamp program, and bob."""

    def __init__(self, relay: Relay) -> None:
        self.relay = relay
        self.robot = JsonRobot(relay, "pad")
        self.tokens = {each: relay.user(each) for each in ("ann", "bob")}
        relay.cli("right", "grant", "ann", "pad", "operator")
        self.url = f"ws://127.0.0.1:{relay.http_port}/icpi"
        self.ann = httpx.Client(
            base_url=f"http://127.0.0.1:{relay.http_port}/api/v1/roles/{ROLE}",
            headers={"Authorization": f"Bearer {self.tokens['ann']}"},
            timeout=60,
        )
        self.ann.put("", content=DOCUMENT, headers={"Content-Type": "text/turtle"}).raise_for_status()
        command = [sys.executable, str(EXAMPLES / "icpi_lamp.py"), self.url, "lamp"]
        self.lamp = Process(command, relay.folder, "lamp", self.environment("ann"))
        wait_for("the lamp is registered", lambda: "ok lamp" in self.lamp.said())

    def environment(self, user: str) -> dict[str, str]:
        """The environment of a user's program."""
        return {**os.environ, "SWITCHBOARD_TOKEN": self.tokens[user]}

    def connect(self, user: str) -> Program:
        """A program of a user."""
        headers = {"Authorization": f"Bearer {self.tokens[user]}"}
        return Program(connect(self.url, additional_headers=headers, open_timeout=PATIENCE))

    def stop(self) -> None:
        self.ann.close()
        self.lamp.stop()
        self.robot.stop()
        self.relay.stop()


class Program:
    """A program with messages of the test."""

    socket: ClientConnection

    def __init__(self, connecting: Any) -> None:
        self._connecting = connecting

    def __enter__(self) -> Program:
        self.socket = self._connecting.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    def send(self, dest: str, function: str, *args: str, **more: Any) -> None:
        """Sends a message."""
        more = {"id": "1", "acknowledge": True, **more}
        self.socket.send(write(IcpiMessage(dest, "test", function=function, args=args, **more)))

    def receive(self) -> IcpiMessage:
        """The next message."""
        return parse(str(self.socket.recv(PATIENCE)))

    def request(self, dest: str, function: str, *args: str, **more: Any) -> tuple[str, ...]:
        """Sends a request; returns the arguments of its reply."""
        self.send(dest, function, *args, **more)
        return self.receive().args


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    made = World(Relay(tmp_path_factory.mktemp("icpi")))
    with running(made):
        yield made


def test_a_program_in_javascript_commands_one_in_python(world: World) -> None:
    done = subprocess.run(
        [*NODE, str(EXAMPLES / "icpi_switch.mjs"), world.url, "switch", "lamp"],
        env=world.environment("ann"),
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=True,
    )
    lines = done.stdout.splitlines()
    assert lines[:2] == ["the lamp is on", "1 programs were notified"], done
    assert "has no function 'explode'; it has start, stop, toggle" in lines[2]
    wait_for("the lamp was notified", lambda: "switch says toggled ['lamp']" in world.lamp.said())


def test_a_program_is_a_platform_of_roles(world: World) -> None:
    def power() -> Any:
        return world.ann.get("/elements/POWER").json()["value"]

    assert world.ann.post("/elements/Lighter/stop").status_code == 200
    assert power() is False
    assert world.ann.put("/elements/POWER", json={"value": True}).status_code == 200
    assert power() is True
    called = world.ann.post("/elements/TOGGLE/call")
    assert (called.status_code, called.json()["values"], power()) == (200, False, False)
    started = world.ann.post("/run/start").json()
    assert ([each["element"] for each in started["parts"]], started["state"]) == (["Lighter"], "running")
    assert power() is True
    world.ann.post("/run/stop")
    assert power() is False


def test_pipes_carry_values_from_and_to_a_program(world: World) -> None:
    add, owner = ("pipe", "add"), ("--owner", "ann")
    world.relay.cli(*add, "beeps", "programs/lamp/ports/power", "pad:/beep()", *owner)
    with world.connect("ann") as program:
        assert program.request("relay", "register", "gauge", '["needle"]', "[]") == ("ok", "gauge")
        needle = "programs/gauge/ports/needle"
        world.relay.cli(*add, "warm", "pad:/temperature", needle, *owner, "--rate", "5")
        asked = program.receive()
        assert (asked.function, asked.args[0], 19 <= float(asked.args[1]) <= 21) == ("set", "needle", True)
        program.send("relay", "reply", "ok", "", id=asked.id)
    assert world.relay.cli("pipe", "show", "beeps")["source"]["port"] == "power"

    def lamp_beeps() -> bool:
        """Each call of the lamp is published again, when the pipe may not have run before."""
        world.ann.post("/elements/TOGGLE/call").raise_for_status()
        return bool(world.relay.cli("pipe", "show", "beeps")["messages"])

    wait_for("the robot beeps when the lamp is switched", lamp_beeps)
    wait_for("the needle waits", lambda: world.relay.cli("pipe", "show", "warm")["state"] == "waiting")
    for each in ("beeps", "warm"):
        world.relay.cli("pipe", "remove", each, "--yes")


def test_a_program_commands_elements_of_roles(world: World) -> None:
    with world.connect("ann") as program:
        result, value = program.request(ROLE, "get", "DEGREES")
        assert (result, 19 <= float(value) <= 21) == ("ok", True)
        assert program.request(ROLE, "set", "POWER", "true") == ("ok", "programs/lamp/ports/power")
        assert program.request(ROLE, "call", "TOGGLE") == ("ok", "false")
        # Without a reply; that of the next request comes first.
        program.send(ROLE, "get", "POWER", acknowledge=False, id="quiet")
        program.send(ROLE, "get", "POWER", id="high 7 ½")
        assert program.receive() == IcpiMessage("test", ROLE, "high 7 ½", False, "reply", ("ok", "false"))
        program.send(ROLE, "fly", acknowledge=False, id="")
        assert program.receive().args[0] == "error"
        assert program.request(ROLE, "fly")[0] == "error"
        assert "has no element NOTHING" in program.request(ROLE, "get", "NOTHING")[1]
        found = json.loads(program.request("relay", "programs")[1])
        assert found == [{"name": "lamp", "ports": ["power"], "functions": ["start", "stop", "toggle"]}]


def test_programs_belong_to_their_user(world: World) -> None:
    with world.connect("bob") as program:
        assert program.request("lamp", "toggle")[0] == "error"
        assert program.request(ROLE, "get", "POWER")[0] == "error"
        assert program.request("relay", "programs") == ("ok", "[]")
        assert program.request("", "hello", broadcast=True) == ("ok", "0")
        assert program.request("relay", "register", "lamp", "[]", "[]") == ("ok", "lamp")
    with pytest.raises(InvalidStatus, match="401"):
        connect(world.url, additional_headers={"Authorization": "Bearer wrong"}, open_timeout=PATIENCE)
    with world.connect("ann") as program:
        assert "is connected already" in program.request("relay", "register", "lamp", "[]", "[]")[1]


def test_a_program_that_leaves_does_not_let_others_wait(world: World) -> None:
    with world.connect("ann") as caller:
        with world.connect("ann") as callee:
            assert callee.request("relay", "register", "silent", "[]", '["work"]')[0] == "ok"
            caller.send("silent", "work")
            assert callee.receive().function == "work"
        assert caller.receive().args == ("error", "program silent has disconnected")


def test_a_part_that_did_not_stop_is_stopped_by_a_second_stop(world: World) -> None:
    role = "Hand-Turn-Valve"
    text = f"""
        @prefix fierro: <fierro:> .
        @prefix switchboard: <switchboard:> .
        fierro:{role} a fierro:role ;
          fierro:subject fierro:Hand ; fierro:action fierro:Turn ; fierro:directObject fierro:Valve .
        fierro:Turn fierro:process fierro:Turner .
        fierro:Turner switchboard:resource "programs/valve" .
    """
    address = f"../{role}"
    put = world.ann.put(address, content=text, headers={"Content-Type": "text/turtle"})
    assert put.status_code == 201, put.text
    with world.connect("ann") as caller, world.connect("ann") as valve:
        assert valve.request("relay", "register", "valve", "[]", '["start", "stop"]')[0] == "ok"

        def order(function: str, *answer: str) -> tuple[str, ...]:
            caller.send(role, function)
            asked = valve.receive()
            assert asked.function == function
            valve.send("relay", "reply", *answer, id=asked.id)
            return caller.receive().args

        assert order("start", "ok", "") == ("ok", "running")
        assert order("stop", "error", "it is stuck") == ("ok", "ended")
        state = world.ann.get(f"{address}/run").json()
        assert (state["why"], state["parts"][0]["why"]) == (
            "some parts could not be stopped; stop the Role again",
            "valve: it is stuck",
        )
        assert world.ann.delete(address).json()["code"] == "started"
        assert order("stop", "ok", "") == ("ok", "stopped")
    assert world.ann.get(f"{address}/run").json()["state"] == "stopped"


def test_hostile_messages_are_refused_and_disturb_no_other_client(world: World) -> None:
    with world.connect("ann") as program:
        program.socket.send("no message")
        refused = program.receive()
        assert (refused.function, refused.args[0]) == ("reply", "error")
        assert "a message has 13" in refused.args[1]
        assert "no list of names" in program.request("relay", "register", "x", "{}")[1]
        assert "is no name" in program.request("relay", "register", "relay")[1]
        for _ in range(60):
            program.socket.send("flood")
        with pytest.raises(ConnectionClosed) as closed:
            while True:
                program.receive()
        assert closed.value.rcvd is not None
        assert (closed.value.rcvd.code, "50 errors" in closed.value.rcvd.reason) == (4429, True)
    with world.connect("ann") as program:
        program.socket.send("x" * 100_000)
        with pytest.raises(ConnectionClosed) as closed:
            program.receive()
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 1009
    with world.connect("ann") as program:
        program.socket.send("lamp!sn!!id!!ak!1!fx!get!ar!(0)power!br!0")
        assert program.receive().args[0] == "ok"
