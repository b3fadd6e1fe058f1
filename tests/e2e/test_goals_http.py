"""Goals over HTTP, with a real relay, a real ROS 2 robot and httpx."""

from __future__ import annotations

import json
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx
import pytest

from relay_server.common.freshness_tokens import HEADER
from relay_server.http.idempotency import KEY_HEADER
from tests.robot_client.ros import Peer
from tests.worlds.processes import ros_environment
from tests.worlds.waiting import wait_for

ROBOT = "/api/v1/robots/rover"
COUNTS, ENDLESS, SPIN, REJECTS = "/http/counts", "/http/endless", "/http/spin", "/http/rejects"
ACTIONS = {COUNTS: "ok", ENDLESS: "forever", SPIN: "forever", REJECTS: "reject"}
FIVE = {"goal": {"order": 5}}
PATIENT = {**FIVE, "poll_timeout": 300}
"""A machine that runs tests may stand still for a while."""

COUNTED = {"sequence": [0, 1, 1, 2, 3]}


def client_of(world: Any, token: str) -> httpx.Client:
    """Requests to the relay with a token."""
    headers = {"Authorization": f"Bearer {token}"}
    base = f"http://127.0.0.1:{world.relay.http_port}{ROBOT}/"
    return httpx.Client(base_url=base, headers=headers, timeout=60)


@pytest.fixture(scope="module")
def peer(world: Any) -> Iterator[Peer]:
    """A node of the robot with actions that succeed, never end, and reject; one that never ends moves the
    robot.
    """
    peer = Peer(ros_environment(world.robot.domain))
    for name, kind in ACTIONS.items():
        peer.do("act", name, kind)
    with client_of(world, world.operator) as client:

        def known() -> bool:
            page = client.get("actions", params={"name": "/http/*"}).json()["actions"]
            return {each["name"] for each in page} == set(ACTIONS)

        wait_for("the relay knows the actions", known)
    yield peer
    peer.close()


@pytest.fixture
def operator(world: Any, peer: Peer) -> Iterator[httpx.Client]:
    """Requests of an operator."""
    with client_of(world, world.operator) as client:
        yield client


def give(client: httpx.Client, action: str = ENDLESS, **body: Any) -> str:
    """Sends a goal that runs; returns its status address."""
    answer = client.post(f"actions{action}", json={**PATIENT, **body})
    assert answer.status_code == 202, answer.text
    status = answer.json()
    assert answer.headers["location"] == f"{ROBOT}/goals/{status['id']}"
    assert (status["action"], status["state"]) == (action, "active")
    return f"goals/{status['id']}"


def begun(client: httpx.Client, address: str) -> Any:
    """Polls until the goal's feedback shows progress, or it has ended; returns its status."""

    def reported() -> Any:
        status = client.get(address).json()
        return status if status["feedback"] == COUNTED or status["ended"] else None

    return wait_for("the goal has begun", reported)


def ended(client: httpx.Client, address: str) -> Any:
    """Polls until a goal has ended; returns its status."""

    def over() -> Any:
        status = client.get(address).json()
        return status if status["ended"] else None

    return wait_for("the goal is over", over)


class Ends:
    """Goals that an action's node ends from now on."""

    def __init__(self, peer: Peer, action: str) -> None:
        self._peer = peer
        self._action = action
        self._before = len(peer.reported("ended", action))

    def cancelled(self) -> None:
        """Waits until it has ended a cancelled one."""
        self._peer.until(lambda: len(self._peer.reported("ended", self._action)) > self._before)
        assert self._peer.reported("ended", self._action)[-1]["canceled"] is True


def test_prefer_wait_answers_with_the_result(operator: httpx.Client) -> None:
    """As soon as it arrives; otherwise with the progress at the timeout."""
    done = operator.post(f"actions{COUNTS}", json=FIVE, headers={"Prefer": "wait=60"})
    assert (done.status_code, done.headers["preference-applied"]) == (200, "wait=60")
    status = done.json()
    assert (status["state"], status["result"], status["reason"]) == ("succeeded", COUNTED, None)
    assert status["type"] == "example_interfaces/action/Fibonacci"
    assert status["begun"] <= status["ended"]
    read = operator.get(f"goals/{status['id']}")
    assert (read.json(), read.headers["etag"]) == (status, done.headers["etag"])
    going = operator.post(f"actions{ENDLESS}", json=FIVE, headers={"Prefer": "respond-async, wait=0.2"})
    assert (going.status_code, going.headers["preference-applied"]) == (202, "wait=0.2")
    assert operator.delete(f"goals/{going.json()['id']}").status_code == 202


def test_a_goal_is_read_again_only_when_it_is_another(operator: httpx.Client) -> None:
    """A client with the present status waits for a change; an ended goal does not change."""
    address = give(operator)
    begun(operator, address)
    # Its feedback repeats the same value.
    known = {"If-None-Match": operator.get(address).headers["etag"]}
    assert operator.get(address, params={"wait": 0.3}, headers=known).status_code == 304
    assert operator.delete(address).json()["state"] == "cancelling"
    further = operator.get(address, params={"wait": 60}, headers=known)
    assert further.status_code == 200 and further.headers["etag"] != known["If-None-Match"]
    status = ended(operator, address)
    assert (status["state"], status["reason"]) == ("canceled", "its owner cancelled it")
    last = {"If-None-Match": operator.get(address).headers["etag"]}
    assert operator.get(address, params={"wait": 60}, headers=last).status_code == 304
    assert operator.delete(address).status_code == 204


def test_a_goal_is_followed_to_its_end(operator: httpx.Client) -> None:
    """As server-sent events: feedback, then the result."""
    address = give(operator)
    reported: list[tuple[str, Any]] = []
    name = ""
    with operator.stream("GET", address, headers={"Accept": "text/event-stream"}) as answer:
        assert answer.headers["content-type"] == "text/event-stream"
        for line in answer.iter_lines():
            field, _, value = line.partition(": ")
            if field == "event":
                name = value
            if field == "data":
                reported.append((name, json.loads(value)))
                if len(reported) == 1:
                    operator.delete(address)
    assert {each for each, _ in reported[:-1]} == {"feedback"}
    assert reported[0][1]["sequence"][:3] == [0, 1, 1]
    name, status = reported[-1]
    assert (name, status["state"], f"goals/{status['id']}") == ("ended", "canceled", address)


def test_a_goal_of_a_gone_client_is_cancelled_on_the_robot(operator: httpx.Client, peer: Peer) -> None:
    """When it was not polled for some time; a waiting request counts as polling."""
    ends = Ends(peer, ENDLESS)
    wish = {**FIVE, "poll_timeout": 0.5}
    given = operator.post(f"actions{ENDLESS}", json=wish, headers={"Prefer": "wait=1.5"})
    assert (given.status_code, given.json()["state"]) == (202, "active")
    ends.cancelled()
    status = ended(operator, f"goals/{given.json()['id']}")
    assert (status["state"], status["reason"]) == ("canceled", "its status was not requested for 0.5 s")


def test_ended_follower_is_removed(operator: httpx.Client, peer: Peer) -> None:
    """A closed connection does not count as polling."""
    ends = Ends(peer, ENDLESS)
    address = give(operator, poll_timeout=1)
    with operator.stream("GET", address, headers={"Accept": "text/event-stream"}) as answer:
        assert next(each for each in answer.iter_lines() if each.startswith("data: "))
    ends.cancelled()


def spins(client: httpx.Client) -> str:
    """Makes the robot spin as soon as it is ready; returns the goal's status address."""
    moment = client.get("topics").headers[HEADER]

    def spinning() -> str:
        nonlocal moment
        answer = client.post(f"actions{SPIN}", json=PATIENT, headers={HEADER: moment})
        moment = answer.headers[HEADER]
        assert answer.status_code in (202, 409, 412), answer.text
        if answer.status_code != 202:
            return ""
        address = f"goals/{answer.json()['id']}"
        return address if begun(client, address)["state"] == "active" else ""

    return str(wait_for("it spins", spinning))


def test_loss_of_control_ends_a_goal_with_a_reason(operator: httpx.Client, peer: Peer) -> None:
    """A goal that moves the robot needs a freshness token and takes control; without control the node cancels
    it.
    """
    needed = operator.post(f"actions{SPIN}", json=FIVE)
    assert (needed.status_code, needed.json()["code"]) == (428, "freshness_required")
    ends = Ends(peer, SPIN)
    address = spins(operator)
    assert operator.get("control").json()["holder"]["user"] == "operator"
    assert operator.post("control/release").status_code == 200
    ends.cancelled()
    status = ended(operator, address)
    assert (status["state"], status["reason"]) == (
        "canceled",
        "control of robot rover was lost or released",
    )


def test_a_revoked_right_ends_a_goal_with_a_reason(world: Any, peer: Peer) -> None:
    """Its client gets the end, without feedback."""
    token = world.relay.user("goal-giver")
    world.relay.cli("right", "grant", "goal-giver", "rover", "operator")
    ends = Ends(peer, ENDLESS)
    with client_of(world, token) as giver:
        address = give(giver)
        begun(giver, address)
        world.relay.cli("right", "grant", "goal-giver", "rover", "viewer")
        ends.cancelled()
        status = ended(giver, address)
        assert (status["state"], status["feedback"]) == ("canceled", None)
        assert "call on /http/endless" in status["reason"]


def test_a_goal_belongs_to_its_owner_only(world: Any, operator: httpx.Client) -> None:
    """Other users and tokens with other scopes can neither read, find nor cancel it."""
    address = give(operator)
    made = world.relay.cli("token", "create", "operator", "--ttl", "1h", "--scope", "operator@rover")
    with client_of(world, world.viewer) as viewer, client_of(world, made["token"]) as narrower:
        for other in (viewer, narrower):
            assert other.get("goals").json() == {"goals": [], "next": ""}
            answers = other.get(address), other.delete(address), other.get("goals/made-up")
            assert [each.status_code for each in answers] == [404] * 3
            assert len({each.json()["detail"] for each in answers}) == 1
    mine = operator.get("goals", params={"name": ENDLESS, "limit": 1000}).json()["goals"]
    (found,) = [each for each in mine if f"goals/{each['id']}" == address]
    assert (found["action"], found["state"], "result" in found) == (ENDLESS, "active", False)
    assert operator.delete(address).status_code == 202


def test_repeated_request_with_its_key_is_done_once(world: Any, operator: httpx.Client, peer: Peer) -> None:
    """A goal, a call and a message, also concurrently; with another body the key is refused."""
    began = len(peer.reported("began", COUNTS))
    key = {KEY_HEADER: '"the first"', "Prefer": "wait=60"}
    with ThreadPoolExecutor(2) as at_once:
        sent = [at_once.submit(operator.post, f"actions{COUNTS}", json=FIVE, headers=key) for _ in "ab"]
        answers = [each.result() for each in sent]
    answers.append(operator.post(f"actions{COUNTS}", json=FIVE, headers=key))
    assert [each.status_code for each in answers] == [200] * 3
    assert len({each.headers["location"] for each in answers}) == 1
    assert all(each.json() == answers[0].json() for each in answers)
    assert len(peer.reported("began", COUNTS)) == began + 1
    other = operator.post(f"actions{COUNTS}", json={"goal": {"order": 6}}, headers=key)
    assert (other.status_code, other.json()["code"]) == (422, "key_reused")
    long = operator.post(f"actions{COUNTS}", json=FIVE, headers={KEY_HEADER: "k" * 256})
    assert long.status_code == 400
    first, again = (operator.post("services/reset", json={}, headers=key) for _ in "ab")
    assert first.status_code == 200 and first.content == again.content
    topic = {"topic": "/http/said", "type": "std_msgs/msg/String"}
    with world.relay.connect("rover", world.operator) as client:
        client.send(op="subscribe", **topic)
        for text, name in (("once", "a"), ("once", "a"), ("then", "b")):
            said = {"value": {"data": text}, "type": topic["type"]}
            answer = operator.post("topics/http/said", json=said, headers={KEY_HEADER: name})
            assert answer.status_code == 204, answer.text
        heard = [client.until(op="publish", topic=topic["topic"])["msg"]["data"] for _ in "ab"]
    assert heard == ["once", "then"]


def test_failed_goals_are_reported(world: Any, operator: httpx.Client) -> None:
    """Rejected, unknown, invalid and denied ones."""
    rejected = operator.post(f"actions{REJECTS}", json=FIVE, headers={"Prefer": "wait=60"})
    assert (rejected.status_code, rejected.json()["state"]) == (200, "refused")
    assert "reject" in rejected.json()["reason"]
    wrong = operator.post(f"actions{COUNTS}", json={"goal": {"order": "five"}})
    assert wrong.status_code == 409 and "order" in wrong.json()["detail"]
    assert operator.post("actions/nowhere", json=FIVE).status_code == 404
    for body in (
        {"poll_timeout": 0},
        {"poll_timeout": 3601},
        {"poll_timeout": "long"},
        {"order": 5},
        {"type": "a b"},
    ):
        assert operator.post(f"actions{COUNTS}", json={**FIVE, **body}).status_code == 400, body
    with client_of(world, world.viewer) as viewer:
        assert viewer.post(f"actions{COUNTS}", json=FIVE).status_code == 403
