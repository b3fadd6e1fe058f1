"""Splits a graph into messages that fit into frames of the control link (SPEC 2.4)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from relay_protocol import jsontext, limits, link

_OVERHEAD = 200
"""Bytes for the frame's kind, ``op``, ``full`` and the names of the maps."""


def graph_chunks(graph: link.Graph, limit: int = limits.CONTROL_FRAME) -> Iterator[link.Graph]:
    """A graph, full or changes, as one or several messages; those after the first are changes.

    Names that are longer than the protocol allows, and excess endpoints of a topic or service, are left out.

    :param limit: most bytes of a frame
    """
    maps: dict[str, dict[str, Any]] = {}
    room, full = limit - _OVERHEAD, graph.full
    for kind, name, entry in _entries(graph):
        size = len(jsontext.encode(name)) + len(jsontext.encode(entry)) + 2
        if size > limit - _OVERHEAD:
            continue
        if size > room:
            yield link.Graph(full=full, **maps)
            maps, room, full = {}, limit - _OVERHEAD, False
        maps.setdefault(kind, {})[name] = entry
        room -= size
    yield link.Graph(full=full, **maps)


def _entries(graph: link.Graph) -> Iterator[tuple[str, str, Any]]:
    for kind in ("topics", "services", "actions", "nodes"):
        for name, entry in getattr(graph, kind).items():
            if len(name) <= limits.NAME:
                yield kind, name, _bounded(entry)


def _bounded(entry: Any) -> Any:
    if isinstance(entry, link.Topic):
        return link.Topic(
            types=_limited(entry.types),
            publishers=_limited(entry.publishers),
            subscribers=_limited(entry.subscribers),
        )
    if isinstance(entry, link.Service):
        return link.Service(types=_limited(entry.types), providers=_limited(entry.providers))
    return entry


def _limited(names: Iterable[str]) -> list[str]:
    return [name for name in names if len(name) <= limits.NAME][: limits.GRAPH_NODES]
