"""Graphs that do not fit into one frame."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from relay_protocol import jsontext, limits, link
from relay_server.robots.registry import GraphMirror
from robot_client.graph_chunks import graph_chunks

MAX_NAMES = st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=30)
ENDS = st.lists(MAX_NAMES, max_size=3)
TOPICS = st.none() | st.builds(link.Topic, types=ENDS, publishers=ENDS, subscribers=ENDS)
SERVICES = st.none() | st.builds(link.Service, types=ENDS, providers=ENDS)
GRAPHS = st.builds(
    link.Graph,
    full=st.booleans(),
    topics=st.dictionaries(MAX_NAMES, TOPICS, max_size=6),
    services=st.dictionaries(MAX_NAMES, SERVICES, max_size=6),
    actions=st.dictionaries(MAX_NAMES, SERVICES, max_size=6),
    nodes=st.dictionaries(MAX_NAMES, st.none() | st.just({}), max_size=6),
)


def seen(*messages: link.Graph) -> list[Any]:
    """The relay's mirror after these messages."""
    mirror = GraphMirror()
    mirror.apply(link.Graph(topics={"/former": link.Topic(types=[])}))
    for message in messages:
        mirror.apply(message)
    return [mirror.topics, mirror.services, mirror.actions, mirror.nodes]


@given(GRAPHS)
def test_chunks_rebuild_the_graph_and_fit(graph: link.Graph) -> None:
    pieces = list(graph_chunks(graph, 2000))
    assert seen(*pieces) == seen(graph)
    assert all(len(link.frame(each)) - 4 <= 2000 for each in pieces)
    assert [each.full for each in pieces] == [graph.full] + [False] * (len(pieces) - 1)


def test_a_graph_that_fits_is_one_message() -> None:
    """An empty one too."""
    assert list(graph_chunks(link.Graph(full=True))) == [link.Graph(full=True)]
    graph = link.Graph(full=True, topics={"/a": link.Topic(types=["x"], publishers=["/n"])}, nodes={"/n": {}})
    assert list(graph_chunks(graph)) == [graph]


def test_relay_accepts_a_large_graph() -> None:
    ends = [f"/{'n' * 60}{number}" for number in range(20)]
    topics = {
        f"/{'t' * 60}{number}": link.Topic(types=["a/msg/B"], publishers=ends) for number in range(3000)
    }
    pieces = list(graph_chunks(link.Graph(full=True, topics=dict(topics))))
    assert len(pieces) > 3
    for piece in pieces:
        body = jsontext.encode(piece)
        assert len(body) < limits.CONTROL_FRAME
        assert jsontext.decode(link.robot_control_decoder, body) == piece


@pytest.mark.parametrize(
    "entry",
    [
        {
            "topics": {
                "/a": link.Topic(types=["x"] * 5000, publishers=["/n"] * 5000, subscribers=["/n"] * 5000)
            }
        },
        {"topics": {"/a": link.Topic(types=["x" * 300, "y"], publishers=["/" * 300])}},
        {"topics": {"/a": link.Topic(types=["ü" * 255] * 5000, publishers=["ü" * 255] * 5000)}},
        {"services": {"/" * 300: link.Service(types=["x"])}},
        {"services": {"/a": link.Service(types=["x"], providers=["/n"] * 5000)}},
        {"nodes": {"/" * 300: {}}},
    ],
    ids=["many", "long", "large", "long name", "providers", "node"],
)
def test_too_long_names_and_excess_endpoints_are_left_out(entry: dict[str, Any]) -> None:
    for piece in graph_chunks(link.Graph(full=True, **entry)):
        body = jsontext.encode(piece)
        assert len(body) < limits.CONTROL_FRAME
        assert jsontext.decode(link.robot_control_decoder, body) == piece
