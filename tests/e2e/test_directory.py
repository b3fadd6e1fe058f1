"""The directory, with a real relay, a real ROS 2 robot, httpx and curl."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import pytest
from switchboard_processes import ros_environment, running
from switchboard_relay import Relay
from switchboard_robot import Robot
from switchboard_waiting import PATIENCE, wait_for

from tests.robot_client.ros import Peer

DIRECTORY = "/api/v1/directory"
MAP = {"kind": "application", "name": "map", "address": "http://10.0.0.7:8000/"}


def client_of(relay: Relay, token: str) -> httpx.Client:
    """Requests to a relay with a token."""
    headers = {"Authorization": f"Bearer {token}"}
    return httpx.Client(base_url=f"http://127.0.0.1:{relay.http_port}", headers=headers, timeout=PATIENCE)


def found(client: httpx.Client, **query: str) -> list[dict[str, Any]]:
    """All entries that match, page by page."""
    entries: list[dict[str, Any]] = []
    after: dict[str, str] | None = {}
    while after is not None:
        answer = client.get(DIRECTORY, params={**query, **after, "limit": "50"})
        assert answer.status_code == 200, answer.text
        page = answer.json()
        entries += page["entries"]
        after = None if page["next"] is None else {"after": page["next"]}
    return entries


@pytest.fixture
def relay(tmp_path: Path) -> Iterator[Relay]:
    """A relay of its own, which may be killed."""
    running = Relay(tmp_path)
    yield running
    running.stop()


def test_leases_outlast_a_relay_that_is_killed_and_end_at_their_time(relay: Relay) -> None:
    """What is not renewed is gone, and that is remembered; its program registers anew."""
    with client_of(relay, relay.user("root", admin=True)) as client:
        long = client.post(DIRECTORY, json={**MAP, "ttl": 3600})
        assert long.status_code == 201
        short = client.post(DIRECTORY, json={**MAP, "name": "short", "ttl": 2})
        place = short.headers["location"]
        relay.kill()
        relay.start()
        kept = client.get(long.headers["location"])
        assert (kept.json(), kept.headers["etag"]) == (long.json(), long.headers["etag"])
        wait_for("its lease is over", lambda: client.get(place).status_code == 404)
        assert [each["name"] for each in found(client, kind="application")] == ["map"]
        assert client.put(place).status_code == 404

        def expired() -> Any:
            query = {"kind": "expired", "data.entry": short.json()["id"], "count": "true"}
            return client.get("/api/v1/events", params=query).json()["count"]

        wait_for("it is remembered", expired)
        assert expired() == 1
        assert client.post(DIRECTORY, json={**MAP, "name": "short"}).status_code == 201
        assert client.put(long.headers["location"]).json()["expires"] > long.json()["expires"]


class Reader:
    """Follows the directory in a thread until so many changes have come."""

    def __init__(self, client: httpx.Client, count: int) -> None:
        self.told: list[tuple[str, str]] = []
        self.open = threading.Event()
        self._client = client
        self._count = count
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        event = ""
        with self._client.stream("GET", DIRECTORY, headers={"Accept": "text/event-stream"}) as answer:
            for line in answer.iter_lines():
                self.open.set()
                if line.startswith("event: "):
                    event = line.removeprefix("event: ")
                if line.startswith("data: "):
                    self.told.append((event, json.loads(line.removeprefix("data: "))["name"]))
                if len(self.told) == self._count:
                    return

    def all(self) -> list[tuple[str, str]]:
        """All that were wanted."""
        wait_for(f"{self._count} changes come", lambda: len(self.told) == self._count)
        self._thread.join(PATIENCE)
        return self.told


def test_who_follows_hears_what_comes_and_goes(relay: Relay) -> None:
    """Whoever removes it: its program, or the administrator by the command line."""
    ann, bob = relay.user("ann"), relay.user("bob")
    with client_of(relay, ann) as client, client_of(relay, bob) as reading:
        reader = Reader(reading, 5)
        assert reader.open.wait(PATIENCE)
        one = client.post(DIRECTORY, json=MAP)
        two = client.post(DIRECTORY, json={**MAP, "name": "other"})
        tag = {"If-Match": two.headers["etag"]}
        changed = {**MAP, "name": "other", "description": "of upstairs"}
        assert client.put(two.headers["location"], json=changed, headers=tag).status_code == 200
        assert client.put(two.headers["location"], json=MAP, headers=tag).status_code == 412
        assert client.delete(one.headers["location"]).status_code == 204
        assert [each["description"] for each in relay.cli("directory")] == ["of upstairs"]
        relay.cli("directory", "remove", two.json()["id"], "--yes")
        assert reader.all() == [
            ("registered", "map"),
            ("registered", "other"),
            ("changed", "other"),
            ("removed", "map"),
            ("removed", "other"),
        ]
        assert client.get(two.headers["location"]).status_code == 404


def alike(client: httpx.Client, kind: str) -> bool:
    """Whether the directory has what the list of resources has."""
    listed = client.get(f"/api/v1/robots/rover/{kind}s", params={"limit": 1000}).json()[f"{kind}s"]
    entries = found(client, robot="rover", kind=kind)
    return [each["name"] for each in entries] == [each["name"] for each in listed]


def leads(client: httpx.Client, kind: str) -> int:
    """To how many of a kind the directory leads; none where one has gone meanwhile."""
    entries = found(client, robot="rover", kind=kind)
    told = [client.get(each["address"]).json().get("name") for each in entries]
    return len(told) if told == [each["name"] for each in entries] else 0


@pytest.fixture
def peer(world: Any) -> Iterator[Peer]:
    """A node of the robot with an action."""
    peer = Peer(ros_environment(world.robot.domain))
    peer.do("act", "/directory/counts", "ok")
    yield peer
    peer.close()


def test_what_robots_have_is_where_the_directory_says(world: Any, peer: Peer) -> None:
    """For each as far as he may see it, as in the lists of resources."""
    for token in (world.operator, world.viewer):
        with client_of(world.relay, token) as client:
            # A robot finds out about its graph and its cameras by and by.
            wait_for("a camera is there", partial(found, client, robot="rover", kind="camera"))
            wait_for("odometry is there", partial(found, client, kind="topic", name="/odom"))
            for kind in ("topic", "service", "action", "camera", "module"):
                wait_for(f"each {kind} is told alike", partial(alike, client, kind))
            wait_for("services are there", partial(leads, client, "service"))
            (odom,) = found(client, kind="topic", name="/odom")
            assert client.get(odom["address"]).json()["topic"] == "/odom"
            (robot,) = found(client, kind="robot", name="rover")
            assert client.get(robot["address"]).json()["name"] == "rover"
            wait_for("cameras are there", partial(leads, client, "camera"))
            one = client.get(f"{DIRECTORY}/{odom['id']}")
            assert one.json() == odom
    with client_of(world.relay, world.operator) as client:
        wait_for("the action is there", partial(leads, client, "action"))
        (reset,) = found(client, kind="service", name="/reset")
    with client_of(world.relay, world.stranger) as client:
        assert client.get(reset["address"]).status_code == 404
        assert [each for each in found(client) if each["robot"]] == []
        assert client.get(f"{DIRECTORY}/{odom['id']}").status_code == 404
        body = {"kind": "service", "name": "speech", "robot": "rover", "address": "http://a/"}
        assert client.post(DIRECTORY, json=body).status_code == 404


@pytest.fixture
def partner(world: Any) -> Iterator[Robot]:
    """Another robot, of which the operator of the first one may call services."""
    robot = Robot(world.relay, "partner")
    with running(robot):
        world.relay.cli("right", "grant", "operator", "partner", "operator")
        yield robot
    # Who sees it would see it in all tests that follow.
    world.relay.cli("robot", "remove", "partner", "--yes")


def test_a_program_at_one_robot_finds_and_calls_a_service_of_another(world: Any, partner: Robot) -> None:
    """By what the directory says of it alone, as long as it is registered; who has no right there finds nothing."""
    body = {"kind": "service", "name": "start-over", "robot": "partner", "ttl": 3600}
    body["address"] = "/api/v1/robots/partner/services/reset"
    with (
        client_of(world.relay, world.relay.user("partners-program")) as own,
        client_of(world.relay, world.operator) as rovers,
        client_of(world.relay, world.viewer) as other,
    ):
        world.relay.cli("right", "grant", "partners-program", "partner", "owner")
        place = own.post(DIRECTORY, json=body).raise_for_status().headers["location"]
        (service,) = found(rovers, kind="service", name="start*")
        assert (service["robot"], service["user"]) == ("partner", "partners-program")

        def called() -> Any:
            """The relay finds out by and by what a robot has."""
            answer = rovers.post(service["address"], json={})
            return answer.json()["values"] if answer.status_code == 200 else None

        since = time.monotonic_ns()
        assert wait_for("the other robot does it", called)["success"] is True
        assert partner.events("reset", since) and not world.robot.events("reset", since)
        assert found(other, kind="service", name="start*") == []
        assert other.get(f"{DIRECTORY}/{service['id']}").status_code == 404
        assert other.post(service["address"], json={}).status_code == 404
        assert [each["id"] for each in found(rovers, kind="service", name="start*")] == [service["id"]]
        # Registered once more, for moments.
        assert own.post(DIRECTORY, json={**body, "ttl": 2}).headers["location"] == place
        wait_for("it is registered no more", lambda: found(rovers, kind="service", name="start*") == [])
        assert rovers.get(place).status_code == 404
        assert own.put(place).status_code == 404


def test_nobody_registers_in_another_robots_name(world: Any) -> None:
    """What one does is found by who sees the robot, who neither takes it out nor adds to it."""
    body = {"kind": "service", "name": "speech", "robot": "rover", "ttl": 3600}
    body["address"] = "/api/v1/robots/rover/services/say"
    with client_of(world.relay, world.operator) as client:
        mine = client.post(DIRECTORY, json=body)
        assert mine.status_code == 201
    with client_of(world.relay, world.viewer) as other:
        (speech,) = found(other, kind="service", name="spee*")
        assert (speech["robot"], speech["address"], speech["user"]) == ("rover", body["address"], "operator")
        assert other.post(DIRECTORY, json={**body, "name": "mine"}).status_code == 403
        assert other.delete(mine.headers["location"]).status_code == 403
    with client_of(world.relay, world.operator) as client:
        assert client.delete(mine.headers["location"]).status_code == 204
