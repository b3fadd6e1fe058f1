"""A graph in messages that fit into frames of the control link (SPEC section 2.4)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from relay_protocol import jsontext, limits, link

_HEAD = 200
"""Room for the frame's kind, ``op``, ``full`` and the names of the maps."""


def parts(graph: link.Graph, limit: int = limits.CONTROL_FRAME) -> Iterator[link.Graph]:
    """The same graph, or difference, as one message or several: the first as it was, then differences.

    Names longer than ROS has are left out, ends beyond what the contract takes too.

    :param limit: most bytes of a frame
    """
    maps: dict[str, dict[str, Any]] = {}
    room, full = limit - _HEAD, graph.full
    for kind, name, entry in _entries(graph):
        size = len(jsontext.encode(name)) + len(jsontext.encode(entry)) + 2
        if size > limit - _HEAD:
            continue
        if size > room:
            yield link.Graph(full=full, **maps)
            maps, room, full = {}, limit - _HEAD, False
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
            types=_few(entry.types), publishers=_few(entry.publishers), subscribers=_few(entry.subscribers)
        )
    if isinstance(entry, link.Service):
        return link.Service(types=_few(entry.types), providers=_few(entry.providers))
    return entry


def _few(names: Iterable[str]) -> list[str]:
    return [name for name in names if len(name) <= limits.NAME][: limits.GRAPH_ENDS]
