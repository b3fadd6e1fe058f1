"""The inputs of ``tests/e2e/test_hostile_input.py`` reach every way into the relay before login."""

from __future__ import annotations

from collections.abc import Iterator

import relay_server.relay  # noqa: F401  (with it all websockets are known)
from relay_server.http.openapi.http import operations
from relay_server.http.request_fields import LONGEST
from relay_server.http.site import ROUTED
from relay_server.ws.connection import ClientFactory
from tests.worlds.hostile_inputs import FIELDS, WEBSOCKETS, entries, handshakes, unproved


def _factories(base: type) -> Iterator[type]:
    yield base
    for each in base.__subclasses__():
        yield from _factories(each)


def test_every_websocket_has_hostile_inputs() -> None:
    """Give a new one its path in ``WEBSOCKETS``."""
    known = {
        each.__name__ for each in _factories(ClientFactory) if each.__module__.startswith("relay_server")
    }
    assert known == set(WEBSOCKETS)


def test_every_field_that_is_read_is_tried() -> None:
    """Give a new one its longest value in ``FIELDS``. Lengths and transfer encodings are tried as framing."""
    tried = {each.lower() for each in FIELDS}
    limited = {each.decode() for each in LONGEST} - {"content-length", "transfer-encoding"}
    described = {
        parameter.name.lower()
        for operation in operations()
        for parameter in operation.parameters
        if parameter.place == "header"
    }
    assert (limited | described) - tried == set()
    assert {name: FIELDS[name] for name in FIELDS if name.lower().encode() in LONGEST} == {
        name: LONGEST[name.lower().encode()] for name in FIELDS if name.lower().encode() in LONGEST
    }


def test_every_request_and_handshake_has_hostile_inputs() -> None:
    names = [each.name for each in unproved()]
    for entry in [*entries(), *handshakes()]:
        assert any(name.startswith(f"{entry}: ") for name in names), entry


def test_all_beginnings_of_paths_are_described() -> None:
    begins = {each.path.split(b"/")[1] for each in [*entries().values(), *handshakes().values()]}
    assert set(ROUTED) - begins == set()
