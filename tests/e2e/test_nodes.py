"""The nodes of a robot's graph as resources, with a real relay, a real ROS 2 robot and httpx."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
from rdflib import RDF, RDFS, SSN, Graph, URIRef

from relay_server.http.media_types import FORMS
from tests.worlds.processes import Process, ros_environment, running
from tests.worlds.waiting import wait_for

ROBOT = "/api/v1/robots/rover"
TALKING = Path(__file__).parent / "clients" / "talking.py"
TOPIC = "/nodes/said"
NODE = "/talks_string"


@contextmanager
def asking(world: Any, token: str) -> Iterator[httpx.Client]:
    """Requests to the relay with a token."""
    with httpx.Client(
        base_url=f"http://127.0.0.1:{world.relay.http_port}{ROBOT}",
        headers={"Authorization": f"Bearer {token}"},
        timeout=30,
    ) as client:
        yield client


@pytest.fixture
def viewer(world: Any) -> Iterator[httpx.Client]:
    """Requests of a viewer."""
    with asking(world, world.viewer) as client:
        yield client


def reported(client: httpx.Client) -> dict[str, dict[str, list[str]]]:
    """All nodes over HTTP, in the form of rosapi."""
    page = client.get("nodes", params={"limit": 1000}).raise_for_status().json()
    assert page["next"] == "" and page["online"]
    return {
        each["name"]: {
            "publishing": each["publishes"],
            "subscribing": each["subscribes"],
            "services": each["services"],
        }
        for each in page["nodes"]
    }


def listed_by_rosapi(world: Any, token: str) -> dict[str, dict[str, list[str]]]:
    """All nodes in rosapi."""
    with world.relay.connect("rover", token) as client:
        nodes = client.call("/rosapi/nodes")["values"]["nodes"]
        return {node: client.call("/rosapi/node_details", {"node": node})["values"] for node in nodes}


def test_a_node_comes_and_goes(world: Any, viewer: httpx.Client, tmp_path: Path) -> None:
    """With its topic; its entity tag is valid until it has gone."""
    address = f"nodes{NODE}"

    def no_publisher() -> bool:
        return bool(viewer.get("nodes", params={"name": "/talks_*"}).json()["nodes"] == [])

    # Other tests have nodes of these names.
    wait_for("earlier ones are gone", no_publisher)
    assert viewer.get(address).status_code == 404
    command = [sys.executable, str(TALKING), TOPIC, "std_msgs/msg/String", "reliable"]
    talking = Process(command, tmp_path, "talking", ros_environment(world.robot.domain))

    def one() -> Any:
        answer = viewer.get(address)
        return answer.json() if answer.status_code == 200 else {"publishes": []}

    def known() -> bool:
        answer = viewer.get(address)
        again = viewer.get(address, headers={"If-None-Match": answer.headers["etag"]})
        return again.status_code == 304 and not again.content

    with running(talking):
        talking.wait_to_say("READY")
        wait_for("it is there, and publishes", lambda: TOPIC in one()["publishes"])
        assert one()["name"] == NODE and TOPIC not in one()["subscribes"]
        (listed,) = viewer.get("nodes", params={"name": "/talks_*"}).json()["nodes"]
        assert listed["name"] == NODE and TOPIC in listed["publishes"]
        wait_for("nothing more of it is new", known)
        tag = viewer.get(address).headers["etag"]
    wait_for("it is gone", lambda: viewer.get(address, headers={"If-None-Match": tag}).status_code == 404)
    assert no_publisher()


def test_http_shows_what_rosapi_shows(world: Any) -> None:
    """For an operator, a viewer, and a user with one topic; without rights there is nothing."""
    narrow = world.relay.cli("token", "create", "operator", "--scope", "subscribe:/odom")["token"]
    for token in (world.operator, world.viewer, narrow):
        with asking(world, token) as client:
            wait_for(
                "they report the same", lambda c=client, t=token: reported(c) == listed_by_rosapi(world, t)
            )
    with asking(world, world.operator) as client:
        sim = reported(client)["/switchboard_sim"]
        assert "/cmd_vel" in sim["subscribing"] and {"/odom", "/scan"} <= set(sim["publishing"])
        assert sim["services"]
    with asking(world, narrow) as client:
        seen = reported(client)
        assert seen["/switchboard_sim"] == {"publishing": ["/odom"], "subscribing": [], "services": []}
        used = {name for each in seen.values() for part in each.values() for name in part}
        assert {name for name in used if not name.startswith(("/relay/", "/rosapi/"))} == {"/odom"}
    with asking(world, world.stranger) as client:
        assert [client.get(each).status_code for each in ("nodes", "nodes/switchboard_sim")] == [404, 404]


@pytest.mark.parametrize("media", [each.media for each in FORMS if each.mark])
def test_nodes_link_to_their_topics(viewer: httpx.Client, media: str) -> None:
    """The page links to each node, and each node to its resources; all terms have definitions at their
    addresses.
    """
    root = f"http://127.0.0.1:{viewer.base_url.port}"

    def graph_of(address: str) -> Graph:
        answer = viewer.get(address, headers={"Accept": media}).raise_for_status()
        assert answer.headers["content-type"] == f"{media}; charset=utf-8"
        return Graph().parse(data=answer.content, format=media, publicID=str(answer.url))

    sim, own = URIRef(f"{root}{ROBOT}/nodes/switchboard_sim"), f"{root}/api/v1/vocabulary/switchboard#"
    page = graph_of("nodes?name=/switchboard_*")
    assert sim in set(page.objects(URIRef(f"{root}{ROBOT}/nodes"), RDFS.member))
    alone = graph_of(str(sim))
    assert set(alone.objects(sim, RDF.type)) == {URIRef(f"{own}Node"), SSN.System}
    topic = URIRef(f"{root}{ROBOT}/topics/odom")
    for graph in (page, alone):
        assert (sim, URIRef(f"{own}publishes"), topic) in graph
    assert viewer.get(str(topic)).status_code == 200
    words = graph_of(own.removesuffix("#"))
    for word in ("Node", "publishes", "subscribes", "services"):
        assert words.value(URIRef(f"{own}{word}"), RDFS.comment) is not None
