"""Graphs that do not fit into one frame."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from relay_protocol import jsontext, limits, link
from relay_server.robots.graph import GraphMirror
from robot_client.graph_chunks import parts

NAMES = st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=30)
ENDS = st.lists(NAMES, max_size=3)
TOPICS = st.none() | st.builds(link.Topic, types=ENDS, publishers=ENDS, subscribers=ENDS)
SERVICES = st.none() | st.builds(link.Service, types=ENDS, providers=ENDS)
GRAPHS = st.builds(
    link.Graph,
    full=st.booleans(),
    topics=st.dictionaries(NAMES, TOPICS, max_size=6),
    services=st.dictionaries(NAMES, SERVICES, max_size=6),
    actions=st.dictionaries(NAMES, SERVICES, max_size=6),
    nodes=st.dictionaries(NAMES, st.none() | st.just({}), max_size=6),
)


def seen(*messages: link.Graph) -> list[Any]:
    """What the relay's mirror shows after these messages."""
    mirror = GraphMirror()
    mirror.apply(link.Graph(topics={"/former": link.Topic(types=[])}))
    for message in messages:
        mirror.apply(message)
    return [mirror.topics, mirror.services, mirror.actions, mirror.nodes]


@given(GRAPHS)
def test_the_parts_are_the_whole_and_each_fits(graph: link.Graph) -> None:
    """Whoever applies them in turn sees what one message would have shown."""
    pieces = list(parts(graph, 2000))
    assert seen(*pieces) == seen(graph)
    assert all(len(link.frame(each)) - 4 <= 2000 for each in pieces)
    assert [each.full for each in pieces] == [graph.full] + [False] * (len(pieces) - 1)


def test_a_graph_that_fits_is_one_message() -> None:
    """Also one of nothing."""
    assert list(parts(link.Graph(full=True))) == [link.Graph(full=True)]
    graph = link.Graph(full=True, topics={"/a": link.Topic(types=["x"], publishers=["/n"])}, nodes={"/n": {}})
    assert list(parts(graph)) == [graph]


def test_a_large_graph_is_taken_by_the_relay() -> None:
    """Three thousand topics with long names and many ends go over in frames of at most 1 MiB."""
    ends = [f"/{'n' * 60}{number}" for number in range(20)]
    topics = {
        f"/{'t' * 60}{number}": link.Topic(types=["a/msg/B"], publishers=ends) for number in range(3000)
    }
    pieces = list(parts(link.Graph(full=True, topics=dict(topics))))
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
def test_what_the_contract_does_not_take_is_left_out(entry: dict[str, Any]) -> None:
    """A strange node on the robot's network does not cost the robot its link."""
    for piece in parts(link.Graph(full=True, **entry)):
        body = jsontext.encode(piece)
        assert len(body) < limits.CONTROL_FRAME
        assert jsontext.decode(link.robot_control_decoder, body) == piece
