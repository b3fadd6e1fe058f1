"""Large and malformed values of functions over HTTP, on transports in memory."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import pytest

from relay_server.offload.http import FunctionEndpoints
from relay_server.offload.runner import Outcome
from tests.worlds.function_service import FunctionWorld
from tests.worlds.http_client import Answer, World

MSGPACK = "application/msgpack"


class Site:
    """A relay's HTTP site with functions."""

    def __init__(self, folder: Path) -> None:
        self.functions = FunctionWorld(folder)
        self.world = World(folder)
        self.world.service.tokens["ann"] = self.functions.ann
        self.world.router.add(FunctionEndpoints(self.functions.service))

    def call(self, raw: bytes, **headers: str) -> Answer:
        return self.world.ask(
            "POST", "/api/v1/functions/move", raw=raw, Authorization="Bearer ann", Prefer="wait=0", **headers
        )


@pytest.fixture
def site(tmp_path: Path) -> Site:
    return Site(tmp_path)


def test_a_large_body_with_too_many_values_is_refused_before_it_is_decoded(site: Site) -> None:
    answer = site.call(b'{"arguments":{"a":[' + b"[]," * 60_000 + b"[]]}}")
    assert (answer.status, answer.json["code"]) == (400, "too_costly")


def test_a_large_body_of_a_sender_without_the_right_is_not_decoded(site: Site) -> None:
    site.functions.rights.allowed = False
    answer = site.call(b"[" * 100_000)
    assert answer.status == 403


def test_a_result_of_too_many_values_is_refused_as_json(site: Site) -> None:
    answer = site.call(b'{"arguments":{}}')
    job = answer.json["id"]
    value = msgspec.msgpack.encode([[]] * 300_000)
    site.functions.engine.runs[0].outcome.callback(Outcome(value=value))
    path = f"/api/v1/jobs/{job}/result"
    refused = site.world.ask("GET", path, Authorization="Bearer ann")
    assert (refused.status, refused.json["code"]) == (400, "too_costly")
    assert "application/msgpack" in refused.json["detail"]
    packed = site.world.ask("GET", path, Authorization="Bearer ann", Accept=MSGPACK)
    assert packed.status == 200


@pytest.mark.parametrize(
    ("kind", "body"),
    [
        ("application/json", b'{"arguments":{"a":123456789012345678901234567890}}'),
        ("application/json", b'{"arguments":{"a":' + b"[" * 900 + b"]" * 900 + b"}}"),
        (MSGPACK, b"\x81\xa2\xff\xfe\x01"),
        (MSGPACK, b"\x91" * 100_000),
        (MSGPACK, b"\x81\xa9arguments" + b"\x91" * 100_000),
    ],
)
def test_a_malformed_call_is_an_error_of_the_client(site: Site, kind: str, body: bytes) -> None:
    answer: Any = site.call(body, Content_Type=kind)
    assert (answer.status, answer.json["code"]) == (400, "malformed")
