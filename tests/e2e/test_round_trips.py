"""A resource's body can be sent back byte by byte, in every format, with the same meaning."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from pyld import jsonld
from rdflib import XSD, Graph, Literal
from rdflib.compare import isomorphic

from relay_server.http.media_types import FORMS, JSON_LD, TURTLE
from tests.worlds.processes import Process, ros_environment, running
from tests.worlds.sync_client import Client
from tests.worlds.waiting import wait_for

ROBOT = "/api/v1/robots/rover"
MEDIA = [each.media for each in FORMS]
PEER = Path(__file__).parent / "clients" / "rosapi_peer.py"
NESTED = "switchboard_test_interfaces/msg/Nested"
SEQUENCES = "switchboard_test_interfaces/msg/Sequences"

TEXTS = ["naïve", "", "😀", '<&>"]]>', "a\nb\tc\r", "\x01\x7f"]
MESSAGES: dict[str, tuple[str, dict[str, Any]]] = {
    "nested": (
        NESTED,
        {
            "header": {"stamp": {"sec": 1_700_000_000, "nanosec": 123_456_789}, "frame_id": "map"},
            "primitives": {
                "flag": False,
                "single": 0.1,
                "precise": 0.1,
                "far": -(2**63),
                "vast": 2**64 - 1,
                "text": TEXTS[3],
                "wide": "ß",
                "brief": "12345678",
            },
            "sequences": [{"doubles": [0.1, None], "texts": TEXTS, "inners": [{"id": 1, "weight": 1e-300}]}],
            "times": [{"sec": -1, "nanosec": 5}, {"sec": 0, "nanosec": 0}],
            "patience": {"sec": -2, "nanosec": 999_999_999},
            "pose": {"covariance": [each / 7 for each in range(36)]},
        },
    ),
    "long": (
        SEQUENCES,
        {
            "raws": [each % 256 for each in range(300)],
            "singles": [each / 3 for each in range(150)],
            "doubles": [None, *(each / 3 for each in range(150))],
            "vasts": [2**64 - 1 - each for each in range(150)],
            "texts": TEXTS * 20,
        },
    ),
}
"""Messages of one of every kind of field, by what they are like; long arrays are written in another way."""

EMPTY: dict[str, dict[str, Any]] = {"nested": {"header": {"stamp": {"sec": 1}}}, "long": {}}
"""The least that can be said. A header without a time is given that of the moment, as in rosbridge."""


@pytest.fixture
def client(world: Any) -> Iterator[httpx.Client]:
    """Requests of an operator."""
    with world.over_http() as client:
        yield client


def get(client: httpx.Client, address: str, media: str) -> httpx.Response:
    """A resource in a format."""
    answer = client.get(
        address, headers={"Accept": media}, params={"wait": 0.5} if "topics" in address else {}
    )
    if answer.status_code == 200:
        assert answer.headers["content-type"].partition(";")[0] == media
    return answer


def value(client: httpx.Client, address: str) -> Any:
    """A resource's value, ``None`` while it has none."""
    return get(client, address, "application/json").json().get("value")


def send_back(client: httpx.Client, address: str, read: httpx.Response) -> None:
    """Sends the body that was read."""
    headers = {"Content-Type": read.headers["content-type"]}
    answer = client.put(address, content=read.content, headers=headers)
    assert answer.status_code == 204, answer.text


def said(speaker: Client, client: httpx.Client, topic: str, which: str) -> tuple[Any, Any]:
    """Publishes one of the messages on a topic as its last; returns the values of an empty message and of
    this one.
    """
    type_name, message = MESSAGES[which]
    speaker.send(op="advertise", topic=topic, type=type_name)

    def received() -> Any:
        speaker.send(op="publish", topic=topic, msg=EMPTY[which])
        return value(client, f"topics{topic}")

    # Repeated until DDS has matched all.
    empty = wait_for("something is heard", received)
    speaker.send(op="publish", topic=topic, msg=message)

    def changed() -> Any:
        found = value(client, f"topics{topic}")
        return None if found == empty else found

    return empty, wait_for("the message is heard", changed)


@pytest.mark.parametrize("media", MEDIA)
@pytest.mark.parametrize("which", MESSAGES)
def test_latched_sample_is_sent_again(world: Any, client: httpx.Client, which: str, media: str) -> None:
    """After another message; the state equals the one that was read."""
    # Its own topic: earlier messages must not count as new.
    topic = f"/round/trip_{which}_{MEDIA.index(media)}"
    address = f"topics{topic}"
    with world.relay.connect("rover", world.operator) as speaker:
        empty, state = said(speaker, client, topic, which)
        read = get(client, address, media)
        speaker.send(op="publish", topic=topic, msg=EMPTY[which])
        wait_for("something else is said", lambda: value(client, address) == empty)
        send_back(client, address, read)
        wait_for("it says the same", lambda: value(client, address) == state)
        assert get(client, address, media).headers["etag"] == read.headers["etag"]


@pytest.fixture(scope="module")
def arm(world: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A node with parameters of all types; returns the prefix of their addresses."""
    command = [sys.executable, str(PEER)]
    folder, environment = tmp_path_factory.mktemp("peer"), ros_environment(world.robot.domain)
    peer = Process(command, folder, "peer", environment)
    with running(peer):
        peer.wait_to_say("READY")
        yield "params/lab/arm:"


@pytest.mark.parametrize("media", MEDIA)
def test_read_parameter_can_be_written_back(client: httpx.Client, arm: str, media: str) -> None:
    """After other values: a string, a number, and arrays."""
    others = {"title": "neu", "speed": 2.5, "flags": [False], "counts": [], "speeds": [7.0], "titles": ["x"]}
    for name, other in others.items():
        address = f"{arm}{name}"
        wait_for("its node is known", lambda at=address: get(client, at, media).status_code == 200)
        read, before = get(client, address, media), value(client, address)
        assert before != other
        assert client.put(address, json={"value": other}).status_code == 204
        assert value(client, address) == other
        send_back(client, address, read)
        assert value(client, address) == before


def test_body_about_another_resource_is_refused(client: httpx.Client, arm: str) -> None:
    """With a reason, in every format."""
    wait_for("its node is known", lambda: value(client, f"{arm}speed") is not None)
    for media in MEDIA:
        for there, elsewhere in (
            (f"{arm}speed", f"{arm}loose"),
            ("topics/relay/control", "topics/round/elsewhere"),
        ):
            read = get(client, there, media)
            headers = {"Content-Type": read.headers["content-type"]}
            answer = client.put(elsewhere, content=read.content, headers=headers)
            assert answer.status_code == 400, (media, elsewhere, answer.text)
            assert (
                "of this address" in answer.json()["detail"] or "resource itself" in answer.json()["detail"]
            )


# --- JSON-LD by another processor ---------------------------------------------------------------------------


def plain(graph: Graph) -> Graph:
    """The same graph with one notation per value: a string's datatype may be left out (RDF 1.1 Concepts
    section 3.3), and PyLD writes doubles with 16 digits.
    """
    made = Graph()
    for subject, predicate, value in graph:
        if isinstance(value, Literal) and value.datatype == XSD.string:
            value = Literal(str(value))
        elif isinstance(value, Literal) and value.datatype == XSD.double:
            value = Literal(f"{float(value):.15e}", datatype=XSD.double)
        made.add((subject, predicate, value))
    return made


def see_same(client: httpx.Client, address: str) -> Graph:
    """Checks that PyLD reads a resource in JSON-LD as rdflib reads it in Turtle; returns the graph."""
    turtle, linked = get(client, address, TURTLE.media), get(client, address, JSON_LD.media)
    assert (turtle.status_code, linked.status_code) == (200, 200), turtle.text
    here = f"http://127.0.0.1:{client.base_url.port}/"

    def load(url: str, options: Any) -> dict[str, Any]:
        assert url.startswith(here), f"{url} is of another host"
        found = client.get(url, headers={"Accept": JSON_LD.media})
        found.raise_for_status()
        return {
            "contentType": JSON_LD.media,
            "contextUrl": None,
            "documentUrl": url,
            "document": found.json(),
        }

    options = {"documentLoader": load, "base": str(linked.url), "format": "application/n-quads"}
    assert jsonld.expand(linked.json(), options), "it is about something"
    quads = jsonld.to_rdf(linked.json(), options)
    expected = plain(Graph().parse(data=turtle.content, format="turtle", publicID=str(turtle.url)))
    assert isomorphic(plain(Graph().parse(data=quads, format="nt")), expected), address
    return expected


@pytest.mark.parametrize("which", MESSAGES)
def test_another_processor_reads_the_same_of_a_state(world: Any, client: httpx.Client, which: str) -> None:
    """With the context in the answer; no other host is contacted."""
    topic = f"/round/linked_{which}"
    with world.relay.connect("rover", world.operator) as speaker:
        said(speaker, client, topic, which)
        assert len(see_same(client, f"topics{topic}")) > 20


@pytest.mark.parametrize(
    "address",
    [
        "params/lab/arm:titles",
        "services?name=/lab/*",
        "cameras",
        "nodes/lab/arm",
        "/api/v1/vocabulary/switchboard",
        "/api/v1/vocabulary/fields",
        "/api/v1/vocabulary/nav_msgs/Odometry",
    ],
)
def test_another_processor_reads_the_same_of_all_else(client: httpx.Client, arm: str, address: str) -> None:
    """Parameters, collections, their members, and the vocabulary."""
    if address.startswith("/"):
        # The robot sends it with its first message.
        assert (
            client.get("topics/odom", params={"wait": 60}, headers={"Accept": TURTLE.media}).status_code
            == 200
        )
        address = f"http://127.0.0.1:{client.base_url.port}{address}"
    wait_for("its node is known", lambda: get(client, "nodes/lab/arm", "application/json").status_code == 200)
    wait_for("it is there", lambda: get(client, address, TURTLE.media).status_code == 200)
    assert len(see_same(client, address)) > 2
