"""Changes between two views of a graph."""

from __future__ import annotations

import itertools

from hypothesis import given
from hypothesis import strategies as st

from relay_protocol import link
from robot_client.platforms.base import GraphView, full_graph, graph_changes

names = st.sampled_from(["/a", "/b", "/c", "/d"])
topics = st.dictionaries(
    names, st.builds(link.Topic, types=st.just(["x"]), publishers=st.lists(names, max_size=2)), max_size=4
)
services = st.dictionaries(names, st.builds(link.Service, types=st.sampled_from([["s"], ["t"]])), max_size=4)
views = st.builds(
    GraphView, topics=topics, services=services, actions=services, nodes=st.frozensets(names, max_size=4)
)


def apply(state: dict[str, dict[str, object]], graph: link.Graph) -> dict[str, dict[str, object]]:
    for part in ("topics", "services", "actions", "nodes"):
        if graph.full:
            state[part] = {}
        for name, entry in getattr(graph, part).items():
            if entry is None:
                del state[part][name]
            else:
                state[part][name] = entry
    return state


@given(st.lists(views, min_size=1, max_size=6))
def test_changes_rebuild_the_last_view(history: list[GraphView]) -> None:
    mirror = apply({}, full_graph(history[0]))
    for old, new in itertools.pairwise(history):
        changes = graph_changes(old, new)
        if changes is not None:
            apply(mirror, changes)
    assert mirror == apply({}, full_graph(history[-1]))


@given(views)
def test_equal_views_have_no_changes(view: GraphView) -> None:
    assert graph_changes(view, view) is None
