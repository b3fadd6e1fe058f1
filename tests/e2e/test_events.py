"""The event log, with a real relay, a real ROS 2 robot and httpx."""

from __future__ import annotations

import csv
import io
import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.robot_client.ros import Peer
from tests.worlds.machine_pauses import Pulse
from tests.worlds.processes import ros_environment
from tests.worlds.relay_process import Relay
from tests.worlds.waiting import wait_for

EVENTS = "/api/v1/events"


def client_of(relay: Relay, token: str) -> httpx.Client:
    """Requests to a relay with a token."""
    headers = {"Authorization": f"Bearer {token}"}
    return httpx.Client(base_url=f"http://127.0.0.1:{relay.http_port}", headers=headers, timeout=60)


@pytest.fixture
def operator(world: Any) -> Iterator[httpx.Client]:
    """Requests of an operator."""
    with client_of(world.relay, world.operator) as client:
        yield client


@pytest.fixture
def stranger(world: Any) -> Iterator[httpx.Client]:
    """Requests of a user without a right on the robot."""
    with client_of(world.relay, world.stranger) as client:
        yield client


def asked(client: httpx.Client, **query: Any) -> list[dict[str, Any]]:
    """Events, newest first."""
    answer = client.get(EVENTS, params=query)
    assert answer.status_code == 200, answer.text
    found: list[dict[str, Any]] = answer.json()["events"]
    return found


class Stream:
    """A stream, read in a thread until it has this many events."""

    def __init__(
        self, client: httpx.Client, query: dict[str, str], count: int, last: int | None = None
    ) -> None:
        self.events: list[dict[str, Any]] = []
        self.ids: list[int] = []
        self.open = threading.Event()
        self._client = client
        self._query = query
        self._count = count
        self._last = {} if last is None else {"Last-Event-ID": str(last)}
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        headers = {"Accept": "text/event-stream", **self._last}
        with self._client.stream("GET", EVENTS, params=self._query, headers=headers) as answer:
            for line in answer.iter_lines():
                self.open.set()
                if line.startswith("id: "):
                    self.ids.append(int(line.removeprefix("id: ")))
                if line.startswith("data: "):
                    self.events.append(json.loads(line.removeprefix("data: ")))
                if len(self.events) == self._count:
                    return

    def reported(self) -> list[int]:
        """The numbers of all expected events."""
        wait_for(f"{self._count} events come", lambda: len(self.events) == self._count)
        self._thread.join(60)
        numbers = [each["id"] for each in self.events]
        assert [each for each in self.ids if each in numbers] == numbers
        return numbers


def test_actions_of_clients_leave_events(world: Any, operator: httpx.Client) -> None:
    """Connecting, taking control, first motion, calls and disconnecting; each user with a right on the robot
    reads them.
    """
    world.left_alone()
    with world.operating() as client, Pulse() as pulse:

        def moves() -> bool:
            client.drive(0.2)
            return bool(world.robot.moving())

        assert client.call("/relay/take_control", {"why": "a look around"})["values"]["success"]
        wait_for("it moves", moves)
        for _ in range(5):
            client.drive(0.2)
        client.call("/relay/release_control")
        held_up = pulse.held_up()
        client.call("/nobody/offers/this")
    kinds = ["client.joined", "control.taken", "motion.begun", "control.released", "call.begun", "call.ended"]

    def all_there() -> Any:
        found = {each["kind"] for each in asked(operator, robot="rover", user="operator", last=60)}
        return found >= {*kinds, "client.left"}

    wait_for("they are written", all_there)
    taken = asked(operator, kind="control.taken", robot="rover", last=60)[0]
    assert (taken["source"], taken["user"]) == ("relay:rover", "operator")
    assert taken["data"]["why"] == "a look around" and "address" not in taken["data"]
    begun = asked(operator, kind="motion.begun", **{"data.topic": "/cmd_vel"})
    times = sum(each["at"] >= taken["at"] for each in begun)
    # A delay of half a second counts as a release, so driving begins again.
    assert times == 1 or (times and held_up > 0.3)
    with client_of(world.relay, world.stranger) as stranger:
        assert asked(stranger, source="relay*") == []
        assert stranger.get(EVENTS, params={"robot": "rover", "count": "true"}).json() == {
            "count": 0,
            "next": None,
        }


def test_viewing_recording_and_publishing_leave_events(operator: httpx.Client) -> None:
    """Viewing a camera, recording (once for two requests with one key), and the first message to a topic."""
    own = "/api/v1/robots/rover"
    begun = time.time() - 1

    def latest(kind: str) -> dict[str, Any] | None:
        return next(iter(asked(operator, kind=kind, robot="rover", since=begun)), None)

    camera = wait_for("a camera is known", lambda: operator.get(f"{own}/cameras").json()["cameras"])[0][
        "name"
    ]
    with operator.stream("GET", "/robots/rover/video/stream", params={"topic": camera}) as answer:
        next(answer.iter_bytes())
    wait_for("he has left", lambda: latest("video.left"))
    joined = latest("video.joined")
    assert joined is not None and (joined["user"], joined["data"]) == ("operator", {"camera": camera})
    key = {"Idempotency-Key": f'"{begun}"'}
    twice = [operator.post(f"{own}/recordings", json={"topics": ["/odom"]}, headers=key) for _ in "ab"]
    assert [each.status_code for each in twice] == [201, 201]
    assert twice[0].json()["id"] == twice[1].json()["id"]
    operator.post(f"{own}/recordings/{twice[0].json()['id']}/stop").raise_for_status()
    wait_for("it has ended", lambda: latest("recording.ended"))
    ended = latest("recording.ended")
    assert ended is not None
    assert ended["data"] == {"recording": twice[0].json()["id"], "state": "complete"}
    said = {"type": "std_msgs/msg/String", "value": {"data": "x"}}
    for _ in range(3):
        operator.post(f"{own}/topics/events/said", json=said).raise_for_status()
    wait_for("that is told", lambda: latest("publication.begun"))
    query = {"kind": "publication.begun", "data.topic": "/events/said", "since": begun}
    assert len(asked(operator, **query)) == 1


def test_nodes_that_come_and_go_and_their_parameters_leave_events(world: Any, operator: httpx.Client) -> None:
    """Each node is reported once; the name of a parameter is shown only with the right to read it."""
    (online, *_) = asked(operator, kind="robot.online", robot="rover")
    # The nodes of a new robot are discovered one by one, without events.
    wait_for("it has settled", lambda: time.time() - online["at"] > 11)
    begun, param = time.time() - 1, "/robot/peer:loose"

    def reported(kind: str) -> list[dict[str, Any]]:
        return asked(operator, kind=kind, robot="rover", since=begun, **{"data.node": "/robot/peer"})

    def is_set() -> bool:
        return operator.put(f"/api/v1/robots/rover/params{param}", json={"value": "there"}).status_code == 204

    peer = Peer(ros_environment(world.robot.domain))
    try:
        peer.do("declare", "loose", "here")
        wait_for("its parameter is set", is_set)
        wait_for("it is told to be there", lambda: reported("node.up"))
        assert reported("node.down") == []
    finally:
        peer.close()
    wait_for("it is told to be gone", lambda: reported("node.down"))
    assert len(reported("node.up")) == 1
    asking = {"kind": "param.set", "robot": "rover", "since": begun}
    # A request without a timely answer was sent again.
    was_set = asked(operator, **asking)
    assert was_set[0]["data"] == {"param": param, "deleted": False}
    with client_of(world.relay, world.viewer) as viewer:
        assert [each["data"] for each in asked(viewer, **asking)] == [{"deleted": False}] * len(was_set)
        assert asked(viewer, **asking, **{"data.param": param}) == []


def test_repeated_events_with_their_key_are_written_once(operator: httpx.Client) -> None:
    """The answer is the same as before; endpoints without support for keys refuse them."""
    event, key = {"kind": "once", "source": "again"}, {"Idempotency-Key": '"a first"'}
    reported = [operator.post(EVENTS, json=event, headers=key) for _ in range(3)]
    assert {(each.status_code, each.text) for each in reported} == {(201, reported[0].text)}
    assert [each["id"] for each in asked(operator, source="again")] == [reported[0].json()["id"]]
    changed = operator.post(EVENTS, json={**event, "data": {"n": 1}}, headers=key)
    assert (changed.status_code, changed.json()["code"]) == (422, "key_reused")
    for path, body in (
        ("tickets", {"robot": "rover"}),
        ("directory", {"kind": "service", "name": "keyed", "address": "http://a/"}),
        ("alerts/rules", {"channel": "portal"}),
        ("fleet", {"do": "call", "robots": ["rover"], "service": "/nobody"}),
    ):
        refused = operator.post(f"/api/v1/{path}", json=body, headers=key)
        assert (
            refused.status_code == 400 and "is not supported at this address" in refused.json()["detail"]
        ), path


def test_events_show_who_was_greeted_in_the_last_minute(
    operator: httpx.Client, stranger: httpx.Client
) -> None:
    """A program queries events of another one, so that no user is greeted twice."""
    query = {"kind": "greeted", "data.person": "ann", "last": 60, "count": "true"}
    assert stranger.get(EVENTS, params=query).json() == {"count": 0, "next": None}
    event = {"source": "greeting", "kind": "greeted", "data": {"person": "ann", "sure": 0.9}}
    answer = operator.post(EVENTS, json=event)
    assert answer.status_code == 201
    assert {name: answer.json()[name] for name in ("source", "kind", "robot", "user", "data")} == {
        **event,
        "robot": None,
        "user": "operator",
    }
    assert stranger.get(EVENTS, params=query).json() == {"count": 1, "next": None}
    assert stranger.get(EVENTS, params={**query, "data.person": "bob"}).json() == {"count": 0, "next": None}


@pytest.mark.parametrize(
    ("body", "status"),
    [
        ({"kind": "x", "source": "relay"}, 403),
        ({"kind": "x", "robot": "nowhere"}, 404),
        ({"kind": ""}, 400),
        ({"kind": "x", "data": 3}, 400),
        ({"kind": "x", "id": 3}, 400),
        ([], 400),
        ([{"kind": "x"}] * 101, 400),
        ("x", 400),
    ],
)
def test_unstorable_event_is_refused_with_a_reason(operator: httpx.Client, body: Any, status: int) -> None:
    """As problem details."""
    answer = operator.post(EVENTS, json=body)
    assert (answer.status_code, answer.headers["content-type"]) == (status, "application/problem+json")
    assert answer.json()["detail"]


def test_returning_follower_gets_missed_changes(operator: httpx.Client, stranger: httpx.Client) -> None:
    """A stream begins with new events, or after the event named by its reader."""
    operator.post(EVENTS, json={"kind": "step", "source": "resume"})
    stream = Stream(stranger, {"source": "resume"}, 2)
    assert stream.open.wait(60)
    numbers = [
        operator.post(EVENTS, json={"kind": "step", "source": "resume"}).json()["id"] for _ in range(2)
    ]
    assert stream.reported() == numbers
    missed = operator.post(
        EVENTS, json=[{"kind": "step", "source": "resume", "data": {"n": n}} for n in range(3)]
    )
    again = Stream(stranger, {"source": "resume"}, 4, last=numbers[0])
    assert again.reported() == [numbers[1], *(each["id"] for each in missed.json()["events"])]


def test_all_that_match_are_exported(operator: httpx.Client) -> None:
    """As lines of JSON and as a table without formulas, in any number of pages."""
    for part in range(12):
        several = [{"kind": "=1+1", "source": "export", "data": {"n": part * 100 + n}} for n in range(100)]
        assert operator.post(EVENTS, json=several).status_code == 201
    query = {"source": "export"}
    lines = operator.get(EVENTS, params=query, headers={"Accept": "application/jsonl"})
    assert lines.headers["content-type"] == "application/jsonl"
    reported = [json.loads(line) for line in lines.text.splitlines()]
    assert [each["data"]["n"] for each in reported] == list(range(1199, -1, -1))
    table = operator.get(EVENTS, params=query, headers={"Accept": "text/csv"})
    rows = list(csv.DictReader(io.StringIO(table.text, newline="")))
    assert [json.loads(row["data"])["n"] for row in rows] == list(range(1199, -1, -1))
    assert {row["kind"] for row in rows} == {"'=1+1"}
    pages, after = [], {}
    while after is not None:
        page = operator.get(EVENTS, params={**query, "limit": 500, **after}).json()
        pages.append(len(page["events"]))
        after = {"after": page["next"]} if page["next"] else None
    assert pages == [500, 500, 200]


def test_acknowledged_change_survives_kill_9(tmp_path: Path) -> None:
    """During many writes: numbers continue, refused events stay refused, and a source keeps within its quota."""
    relay = Relay(tmp_path, "--events-per-source", "500")
    try:
        token = relay.user("ann")
        kept: list[int] = []
        broken = threading.Event()

        def write(source: str) -> None:
            with client_of(relay, token) as client:
                try:
                    for n in range(10_000):
                        answer = client.post(
                            EVENTS, json=[{"kind": "k", "source": source, "data": {"n": n}}] * 10
                        )
                        kept.extend(each["id"] for each in answer.json()["events"])
                except httpx.HTTPError:
                    broken.set()

        writers = [threading.Thread(target=write, args=(f"s{each}",), daemon=True) for each in range(4)]
        for each in writers:
            each.start()
        wait_for("some are kept", lambda: len(kept) > 300)
        relay.kill()
        for each in writers:
            each.join(60)
        assert broken.is_set()
        relay.start()
        with client_of(relay, token) as client:
            lines = client.get(
                EVENTS, params={"source": "s*"}, headers={"Accept": "application/x-ndjson"}
            ).text
            found = {json.loads(line)["id"] for line in lines.splitlines()}
            assert set(kept) <= found
            fresh = client.post(EVENTS, json={"kind": "k"}).json()
            assert fresh["id"] > max(found)
            for _ in range(8):
                client.post(EVENTS, json=[{"kind": "k", "source": "full"}] * 100)
            query = {"source": "full", "count": "true"}
            wait_for("its share is kept to", lambda: client.get(EVENTS, params=query).json()["count"] == 500)
    finally:
        relay.stop()
