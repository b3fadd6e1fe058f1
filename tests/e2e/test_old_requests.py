"""No call and no goal from before a stall moves the robot after it, wherever it was delayed."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from tests.robot_client.ros import Peer
from tests.worlds.chaos_proxy import ChaosProxy
from tests.worlds.http_requests import Answer, ask
from tests.worlds.processes import ros_environment
from tests.worlds.relay_process import Relay
from tests.worlds.robot_process import Robot
from tests.worlds.sync_client import Client
from tests.worlds.waiting import wait_for

MOMENT = "switchboard-freshness"

STALL_SECONDS = 0.9
"""Longer than the deadline of commands, shorter than what a link is given up for."""


class ControlWorld:
    """A relay, a robot whose service ``/reset`` and action ``/counts`` move it, a driver; proxies between
    them.
    """

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
        """The driver, with control; both requests were done once, so that no further preparation is needed."""
        client = self.relay.connect_by(self.client_side.port, "rover", self._token)
        wait_for("he has control", lambda: client.call("/relay/take_control")["values"]["success"])
        wait_for("it is reset", lambda: call(client)["result"])
        wait_for("it has pursued a goal", lambda: pursue(client)["result"])
        return client

    def ask(self, method: str, path: str, body: Any = None, moment: str = "", port: int = 0) -> Answer:
        """A request of the owner.

        :param port: where to send it, such as a proxy
        """
        dated = {MOMENT: moment} if moment else {}
        port = port or self.relay.http_port
        return ask(port, method, f"/api/v1{path}", body, headers=dated, token=self.owner)

    def held_up(self, path: str, body: Any, moment: str) -> Future[Answer]:
        """A request of the owner that does not arrive before the network works again."""
        self.client_side.forward_up.clear()
        return self._threads.submit(self.ask, "POST", path, body, moment, self.client_side.port)

    def resets(self) -> int:
        """The number of resets, by the robot's own log."""
        return len(self.robot.events("reset"))

    def stop(self) -> None:
        self.robot_side.heal()
        self.client_side.heal()
        self._threads.shutdown()
        self.peer.close()
        self.robot.stop()
        self.relay.stop()
        self.robot_side.close()
        self.client_side.close()


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ControlWorld]:
    """One scene for all; each test leaves it intact."""
    made = ControlWorld(tmp_path_factory.mktemp("scene"))
    try:
        yield made
    finally:
        made.stop()


def send(client: Client) -> None:
    """Sends both requests."""
    client.send(op="call_service", id="call", service="/reset")
    client.send(op="send_action_goal", id="goal", action="/counts", args={"order": 3})


def ends(client: Client) -> list[dict[str, Any]]:
    """The results of both."""
    found: dict[str, dict[str, Any]] = {}
    while len(found) < 2:
        message = client.receive()
        if message["op"] in ("service_response", "action_result"):
            found[message["op"]] = message
    return [found["service_response"], found["action_result"]]


def call(client: Client) -> dict[str, Any]:
    """A call that moves the robot; returns its answer."""
    return client.call("/reset")


def pursue(client: Client) -> dict[str, Any]:
    """A goal that moves the robot; returns its end."""
    client.send(op="send_action_goal", id="first", action="/counts", args={"order": 3})
    return client.until(op="action_result", id="first")


def test_delayed_command_is_refused_by_the_robot(scene: ControlWorld) -> None:
    """The robot knows the maximum age and does nothing; later requests are executed."""
    with scene.connect() as client:
        before = scene.resets()
        scene.robot_side.forward_down.clear()
        send(client)
        time.sleep(STALL_SECONDS)
        scene.robot_side.heal()
        for end in ends(client):
            assert end["result"] is False
            assert "none older than 500 ms is obeyed" in end["values"]
        assert scene.resets() == before
        done = 0

        def both() -> bool:
            nonlocal done
            send(client)
            results = [end["result"] for end in ends(client)]
            done += results[0]
            return results == [True, True]

        wait_for("both are done that come in time", both)
        wait_for("it was reset as often as it was told", lambda: scene.resets() == before + done)


def test_requests_of_a_client_that_answers_no_ping_are_refused(scene: ControlWorld) -> None:
    """Its messages arrive, but their age is unknown; after the stall requests are executed again."""
    with scene.connect() as client:
        before = scene.resets()
        scene.client_side.forward_down.clear()
        time.sleep(STALL_SECONDS)
        send(client)
        time.sleep(0.2)  # they reach the relay while no ping reaches the client
        scene.client_side.heal()
        for end in ends(client):
            assert end["result"] is False
            assert "ms old, by the last ping answered" in end["values"]
        assert scene.resets() == before
        wait_for("its pongs come again", lambda: call(client)["result"])
        wait_for("it was reset once", lambda: scene.resets() == before + 1)


def test_an_order_to_many_that_was_held_up_moves_no_robot(scene: ControlWorld) -> None:
    """It is as old as its freshness token; without one it is refused. Later orders are executed."""
    order = {"robots": ["rover"], "do": "call", "service": "/reset"}
    before = scene.resets()
    assert scene.ask("POST", "/fleet", order).status == 428
    held_up = scene.held_up("/fleet", order, scene.ask("GET", "/fleet/groups").headers[MOMENT])
    time.sleep(STALL_SECONDS)
    scene.client_side.heal()
    refused = held_up.result(60)
    assert (refused.status, refused.json["code"]) == (412, "too_old")
    assert scene.resets() == before

    def given() -> bool:
        answer = scene.ask("POST", "/fleet", order, scene.ask("GET", "/fleet/groups").headers[MOMENT])
        return answer.status == 200 and json.loads(answer.body.splitlines()[1])["ok"]

    wait_for("it is given in time", given)
    assert scene.resets() == before + 1


@pytest.mark.parametrize("way", ["/robots/rover/resume", "/fleet", "/robots/rover/services/relay/resume"])
def test_a_resume_that_was_held_up_does_not_lift_a_newer_stop(scene: ControlWorld, way: str) -> None:
    """STOP was pressed meanwhile: the robot stays stopped until a user who has seen that resumes it."""
    body = {"robots": ["rover"], "do": "resume"} if way == "/fleet" else {}
    assert scene.ask("POST", way, body).status == 428
    moment = scene.ask("POST", "/robots/rover/stop", {"why": "smoke"}).headers[MOMENT]
    held_up = scene.held_up(way, body, moment)
    assert scene.ask("POST", "/robots/rover/stop", {"why": "a child"}).status == 200
    scene.client_side.heal()
    assert "after you sent this" in held_up.result(60).body.decode()
    reported = scene.ask("GET", "/robots/rover/control")
    assert reported.json["stopped"]
    # The pooled connection for service calls has its own pings.
    wait_for("it is resumed", lambda: scene.ask("POST", way, body, reported.headers[MOMENT]).status == 200)
    assert scene.ask("GET", "/robots/rover/control").json["stopped"] is None


def test_a_resume_by_websocket_that_was_held_up_does_not_lift_a_newer_stop(scene: ControlWorld) -> None:
    """By the pings that were answered before it."""
    with scene.relay.connect_by(scene.client_side.port, "rover", scene.owner) as client:
        assert scene.ask("POST", "/robots/rover/stop", {"why": "smoke"}).status == 200
        scene.client_side.forward_up.clear()
        client.send(op="call_service", id="old", service="/relay/resume")
        assert scene.ask("POST", "/robots/rover/stop", {"why": "a child"}).status == 200
        scene.client_side.heal()
        refused = client.until(op="service_response", id="old")
        assert refused["result"] is False
        assert "after you sent this" in refused["values"]
        assert scene.ask("GET", "/robots/rover/control").json["stopped"]
        wait_for("she resumes it", lambda: client.call("/relay/resume")["result"])
    assert scene.ask("GET", "/robots/rover/control").json["stopped"] is None
