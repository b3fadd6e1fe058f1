"""No call and no goal from before a stall moves the robot after it, wherever it was held up."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from switchboard_client import Client
from switchboard_http import Answer, ask
from switchboard_processes import ros_environment
from switchboard_proxy import ChaosProxy
from switchboard_relay import Relay
from switchboard_robot import Robot
from switchboard_waiting import wait_for

from tests.robot_client.ros import Peer

MOMENT = "switchboard-moment"

STALL_SECONDS = 0.9
"""Longer than the deadline of commands, shorter than what a link is given up for."""


class Place:
    """A relay, a robot whose service ``/reset`` and action ``/counts`` move it, a driver; proxies between them."""

    def __init__(self, folder: Path) -> None:
        self.relay = Relay(folder)
        self.robot_side = ChaosProxy(self.relay.robots_port)
        self.client_side = ChaosProxy(self.relay.http_port)
        moves = {"SERVICES": "/reset", "ACTIONS": "/counts"}
        environment = {f"SWITCHBOARD_ROBOT_SAFETY_MOTION_{kind}": names for kind, names in moves.items()}
        self.robot = Robot(self.relay, "rover", port=self.robot_side.port, daemon_env=environment)
        self.peer = Peer(ros_environment(self.robot.domain))
        self.peer.do("act", "/counts", "ok")
        self._token = self.relay.user("driver")
        self.owner = self.relay.user("owner")
        self.relay.cli("right", "grant", "driver", "rover", "operator")
        self.relay.cli("right", "grant", "owner", "rover", "owner")
        self._threads = ThreadPoolExecutor(1)

    def connect(self) -> Client:
        """The driver, who has control and has had both done, so that nothing is waited for any more."""
        client = self.relay.connect_by(self.client_side.port, "rover", self._token)
        wait_for("he has control", lambda: client.call("/relay/take_control")["values"]["success"])
        wait_for("it is reset", lambda: call(client)["result"])
        wait_for("it has pursued a goal", lambda: pursue(client)["result"])
        return client

    def ask(self, method: str, path: str, body: Any = None, moment: str = "", port: int = 0) -> Answer:
        """A request of the owner's.

        :param port: where it goes, for another way than the short one
        """
        dated = {MOMENT: moment} if moment else {}
        port = port or self.relay.http_port
        return ask(port, method, f"/api/v1{path}", body, headers=dated, token=self.owner)

    def held_up(self, path: str, body: Any, moment: str) -> Future[Answer]:
        """A request of the owner's that does not come through before the network is healed."""
        self.client_side.forward_up.clear()
        return self._threads.submit(self.ask, "POST", path, body, moment, self.client_side.port)

    def resets(self) -> int:
        """How often the robot was reset, by its own record."""
        return len(self.robot.events("reset"))

    def stop(self) -> None:
        """End everything."""
        self.robot_side.heal()
        self.client_side.heal()
        self._threads.shutdown()
        self.peer.close()
        self.robot.stop()
        self.relay.stop()
        self.robot_side.close()
        self.client_side.close()


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Place]:
    """One place for all; each test leaves it whole."""
    made = Place(tmp_path_factory.mktemp("place"))
    try:
        yield made
    finally:
        made.stop()


def send(client: Client) -> None:
    """Ask for both."""
    client.send(op="call_service", id="call", service="/reset")
    client.send(op="send_action_goal", id="goal", action="/counts", args={"order": 3})


def ends(client: Client) -> list[dict[str, Any]]:
    """What comes of both."""
    found: dict[str, dict[str, Any]] = {}
    while len(found) < 2:
        message = client.receive()
        if message["op"] in ("service_response", "action_result"):
            found[message["op"]] = message
    return [found["service_response"], found["action_result"]]


def call(client: Client) -> dict[str, Any]:
    """One call that moves the robot; its answer."""
    return client.call("/reset")


def pursue(client: Client) -> dict[str, Any]:
    """One goal that moves the robot; its end."""
    client.send(op="send_action_goal", id="first", action="/counts", args={"order": 3})
    return client.until(op="action_result", id="first")


def test_what_was_held_up_on_its_way_to_the_robot_is_refused_there(place: Place) -> None:
    """It arrives, the robot says how old it may be, and does nothing; what is asked for then is done."""
    with place.connect() as client:
        before = place.resets()
        place.robot_side.forward_down.clear()
        send(client)
        time.sleep(STALL_SECONDS)
        place.robot_side.heal()
        for end in ends(client):
            assert end["result"] is False
            assert "none older than 500 ms is obeyed" in end["values"]
        assert place.resets() == before
        done = 0

        def both() -> bool:
            nonlocal done
            send(client)
            results = [end["result"] for end in ends(client)]
            done += results[0]
            return results == [True, True]

        wait_for("both are done that come in time", both)
        wait_for("it was reset as often as it was told", lambda: place.resets() == before + done)


def test_what_a_client_asks_for_that_answers_no_ping_is_refused_by_the_relay(place: Place) -> None:
    """Its words come through, but when they were said nobody knows; after the stall all is well."""
    with place.connect() as client:
        before = place.resets()
        place.client_side.forward_down.clear()
        time.sleep(STALL_SECONDS)
        send(client)
        time.sleep(0.2)  # they reach the relay while no ping reaches the client
        place.client_side.heal()
        for end in ends(client):
            assert end["result"] is False
            assert "ms old, by the last ping answered" in end["values"]
        assert place.resets() == before
        wait_for("its pongs come again", lambda: call(client)["result"])
        wait_for("it was reset once", lambda: place.resets() == before + 1)


def test_an_order_to_many_that_was_held_up_moves_no_robot(place: Place) -> None:
    """It is as old as the moment it gives back; without one it is none. What is given then is done."""
    order = {"robots": ["rover"], "do": "call", "service": "/reset"}
    before = place.resets()
    assert place.ask("POST", "/fleet", order).status == 428
    held_up = place.held_up("/fleet", order, place.ask("GET", "/fleet/groups").headers[MOMENT])
    time.sleep(STALL_SECONDS)
    place.client_side.heal()
    refused = held_up.result(60)
    assert (refused.status, refused.json["code"]) == (412, "too_old")
    assert place.resets() == before

    def given() -> bool:
        answer = place.ask("POST", "/fleet", order, place.ask("GET", "/fleet/groups").headers[MOMENT])
        return answer.status == 200 and json.loads(answer.body.splitlines()[1])["ok"]

    wait_for("it is given in time", given)
    assert place.resets() == before + 1


@pytest.mark.parametrize("way", ["/robots/rover/resume", "/fleet", "/robots/rover/services/relay/resume"])
def test_a_resume_that_was_held_up_does_not_lift_a_newer_stop(place: Place, way: str) -> None:
    """Somebody has pressed STOP meanwhile: the robot stays stopped until somebody who has seen that resumes it."""
    body = {"robots": ["rover"], "do": "resume"} if way == "/fleet" else {}
    assert place.ask("POST", way, body).status == 428
    moment = place.ask("POST", "/robots/rover/stop", {"why": "smoke"}).headers[MOMENT]
    held_up = place.held_up(way, body, moment)
    assert place.ask("POST", "/robots/rover/stop", {"why": "a child"}).status == 200
    place.client_side.heal()
    assert "after you asked for this" in held_up.result(60).body.decode()
    told = place.ask("GET", "/robots/rover/control")
    assert told.json["stopped"]
    # The connection that is kept for who calls services has pings of its own.
    wait_for("it is resumed", lambda: place.ask("POST", way, body, told.headers[MOMENT]).status == 200)
    assert place.ask("GET", "/robots/rover/control").json["stopped"] is None


def test_a_resume_by_websocket_that_was_held_up_does_not_lift_a_newer_stop(place: Place) -> None:
    """By the pings that came back before it."""
    with place.relay.connect_by(place.client_side.port, "rover", place.owner) as client:
        assert place.ask("POST", "/robots/rover/stop", {"why": "smoke"}).status == 200
        place.client_side.forward_up.clear()
        client.send(op="call_service", id="old", service="/relay/resume")
        assert place.ask("POST", "/robots/rover/stop", {"why": "a child"}).status == 200
        place.client_side.heal()
        refused = client.until(op="service_response", id="old")
        assert refused["result"] is False
        assert "after you asked for this" in refused["values"]
        assert place.ask("GET", "/robots/rover/control").json["stopped"]
        wait_for("she resumes it", lambda: client.call("/relay/resume")["result"])
    assert place.ask("GET", "/robots/rover/control").json["stopped"] is None
