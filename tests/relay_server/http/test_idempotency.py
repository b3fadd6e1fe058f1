"""Requests that are repeated with their idempotency key, on transports in memory."""

from __future__ import annotations

from pathlib import Path
from typing import TypedDict

import msgspec
import pytest

from relay_protocol.errors import Refused
from relay_server.http.endpoint import ApiRequest, Created, IdempotencyKey, endpoint
from relay_server.http.idempotency import Idempotency
from tests.worlds.http_client import Answer, World

HERE = "/api/v1/robots/rover/works"


class Order(msgspec.Struct):
    """Any."""

    text: str = ""


class Done(TypedDict):
    """How often something was done."""

    times: int


class Works:
    """Counts what is done."""

    def __init__(self, world: World) -> None:
        self.remembered = Idempotency(world.clock)
        self.done = 0
        self.withdrawn = False

    @endpoint(
        "POST",
        "/api/v1/robots/{robot}/works/{name}",
        tag="robots",
        summary="Do something",
        key=IdempotencyKey.REMEMBERED,
    )
    async def once(self, request: ApiRequest, robot: str, name: str, body: Order) -> Created[Done]:
        self.done += 1
        return Created({"times": self.done}, location=f"{HERE}/{name}/{self.done}")

    @once.replay
    async def may(self, request: ApiRequest, robot: str, name: str, body: Order) -> None:
        if self.withdrawn:
            raise Refused(f"no more of {name}")

    @endpoint(
        "PUT",
        "/api/v1/robots/{robot}/works/{name}",
        tag="robots",
        summary="Do something each time",
        key=IdempotencyKey.REFUSED,
    )
    async def each_time(self, request: ApiRequest, robot: str, name: str, body: Order) -> Done:
        self.done += 1
        return {"times": self.done}


@pytest.fixture
def world(tmp_path: Path) -> World:
    """A site."""
    return World(tmp_path)


@pytest.fixture
def works(world: World) -> Works:
    """Endpoints that count their calls."""
    made = Works(world)
    world.router.add(made)
    return made


def ask(world: World, key: str | None = "k", name: str = "a", method: str = "POST", text: str = "") -> Answer:
    """A request with a key."""
    headers = {} if key is None else {"Idempotency-Key": key}
    return world.ask(method, f"{HERE}/{name}", {"text": text}, Authorization="Bearer ann", **headers)


def test_a_repeated_request_is_carried_out_once(world: World, works: Works) -> None:
    """Without a key it is carried out each time."""
    first, again = ask(world), ask(world)
    assert [each.status for each in (first, again)] == [201, 201]
    assert first.json == again.json == {"times": 1}
    assert first.headers["location"] == again.headers["location"] == f"{HERE}/a/1"
    assert [ask(world, None).json["times"] for _ in "ab"] == [2, 3]
    assert ask(world, name="other").json == {"times": 4}


def test_a_key_with_another_body_is_refused(world: World, works: Works) -> None:
    ask(world, text="a")
    refused = ask(world, text="b")
    assert (refused.status, refused.json["code"], works.done) == (422, "key_reused", 1)


def test_an_invalid_key_is_refused(world: World, works: Works) -> None:
    """Nothing is carried out."""
    for key in ("k" * 256, "a b", "ü"):
        assert ask(world, key).status == 400
    assert works.done == 0


def test_a_stored_answer_needs_the_right(world: World, works: Works) -> None:
    """The right was revoked after the first request."""
    ask(world)
    works.withdrawn = True
    refused = ask(world)
    assert (refused.status, refused.json["detail"]) == (403, "no more of a")


def test_a_key_is_refused_by_endpoints_without_support(world: World, works: Works) -> None:
    """Its sender relies on it."""
    refused = ask(world, method="PUT")
    assert refused.status == 400 and "is not supported at this address" in refused.json["detail"]
    assert (works.done, ask(world, None, method="PUT").status) == (0, 200)
