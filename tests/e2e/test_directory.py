"""The service registry, with a real relay, a real ROS 2 robot, httpx and curl."""

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

from tests.robot_client.ros import Peer
from tests.worlds.processes import ros_environment, running
from tests.worlds.relay_process import Relay
from tests.worlds.robot_process import Robot
from tests.worlds.waiting import PATIENCE, wait_for

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
    """A new relay that the test may kill."""
    running = Relay(tmp_path)
    yield running
    running.stop()


def test_leases_outlast_a_relay_that_is_killed_and_end_at_their_time(relay: Relay) -> None:
    """An entry that is not renewed ends with an event; its program registers again."""
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
    """Follows the service registry in a thread until it has this many changes."""

    def __init__(self, client: httpx.Client, count: int) -> None:
        self.reported: list[tuple[str, str]] = []
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
                    self.reported.append((event, json.loads(line.removeprefix("data: "))["name"]))
                if len(self.reported) == self._count:
                    return

    def all(self) -> list[tuple[str, str]]:
        """All expected changes."""
        wait_for(f"{self._count} changes come", lambda: len(self.reported) == self._count)
        self._thread.join(PATIENCE)
        return self.reported


def test_follower_receives_additions_and_removals(relay: Relay) -> None:
    """Removed by its program, or by the administrator with the command line."""
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
    """Whether the service registry equals the list of resources."""
    listed = client.get(f"/api/v1/robots/rover/{kind}s", params={"limit": 1000}).json()[f"{kind}s"]
    entries = found(client, robot="rover", kind=kind)
    return [each["name"] for each in entries] == [each["name"] for each in listed]


def leads(client: httpx.Client, kind: str) -> int:
    """The number of entries of a kind that the registry links to; None if one has gone meanwhile."""
    entries = found(client, robot="rover", kind=kind)
    reported = [client.get(each["address"]).json().get("name") for each in entries]
    return len(reported) if reported == [each["name"] for each in entries] else 0


@pytest.fixture
def peer(world: Any) -> Iterator[Peer]:
    """A node of the robot with an action."""
    peer = Peer(ros_environment(world.robot.domain))
    peer.do("act", "/directory/counts", "ok")
    yield peer
    peer.close()


def test_the_service_registry_links_to_resources_of_robots(world: Any, peer: Peer) -> None:
    """For each user by their rights, as in the lists of resources."""
    for token in (world.operator, world.viewer):
        with client_of(world.relay, token) as client:
            # The graph and the cameras of a robot are discovered over time.
            wait_for("a camera is there", partial(found, client, robot="rover", kind="camera"))
            wait_for("odometry is there", partial(found, client, kind="topic", name="/odom"))
            for kind in ("topic", "service", "action", "camera", "node"):
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
    """Another robot, on which the first one's operator may call services."""
    robot = Robot(world.relay, "partner")
    with running(robot):
        world.relay.cli("right", "grant", "operator", "partner", "operator")
        yield robot
    # It would be visible in all later tests.
    world.relay.cli("robot", "remove", "partner", "--yes")


def test_a_program_at_one_robot_finds_and_calls_a_service_of_another(world: Any, partner: Robot) -> None:
    """By its entry only, while it is registered; a user without rights finds no entry."""
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
            """A robot's graph is discovered over time."""
            answer = rovers.post(service["address"], json={})
            return answer.json()["values"] if answer.status_code == 200 else None

        since = time.monotonic_ns()
        assert wait_for("the other robot does it", called)["success"] is True
        assert partner.events("reset", since) and not world.robot.events("reset", since)
        assert found(other, kind="service", name="start*") == []
        assert other.get(f"{DIRECTORY}/{service['id']}").status_code == 404
        assert other.post(service["address"], json={}).status_code == 404
        assert [each["id"] for each in found(rovers, kind="service", name="start*")] == [service["id"]]
        # Registered again, for a short time.
        assert own.post(DIRECTORY, json={**body, "ttl": 2}).headers["location"] == place
        wait_for("it is registered no more", lambda: found(rovers, kind="service", name="start*") == [])
        assert rovers.get(place).status_code == 404
        assert own.put(place).status_code == 404


def test_robots_name_cannot_be_registered_by_others(world: Any) -> None:
    """Viewers of the robot find its entries, and can neither remove them nor add others."""
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
