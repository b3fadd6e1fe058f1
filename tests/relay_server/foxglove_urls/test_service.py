"""Foxglove URLs: their rights, their management, and their end."""

from __future__ import annotations

from typing import Any
from urllib.parse import parse_qs, urlsplit

import pytest
import pytest_twisted

from relay_db import queries
from relay_protocol.errors import NotFound, Refused, SwitchboardError
from relay_protocol.rights import Operation
from relay_server.access import BadCredentials, Principal
from relay_server.common import close_codes
from relay_server.foxglove_urls import service as module
from relay_server.foxglove_urls.schemas import MadeFoxgloveUrl, NewFoxgloveUrl
from relay_server.foxglove_urls.service import FoxgloveUrlService
from tests.worlds.session_manager import HERE, SessionsWorld

BASE = "https://relay.example.org"
ENDED = "this Foxglove URL was revoked or has expired, or its user was disabled"


class Scene:
    """Ann, the operator of rover, and her URLs."""

    def __init__(self, front: SessionsWorld) -> None:
        self.front = front
        self.service = FoxgloveUrlService(
            front.world.clock,
            front.access,
            front.store,
            front.access.refresh,
            front.service.tokens_of,
            front.wall,
        )

    async def made(self, principal: Principal, **settings: Any) -> MadeFoxgloveUrl:
        new = NewFoxgloveUrl(**settings)
        return await self.service.add(principal, HERE, "rover", new, BASE)

    async def by(self, made: MadeFoxgloveUrl) -> Principal:
        """The principal of a URL."""
        (token,) = parse_qs(urlsplit(made.url).query)["token"]
        return await self.front.logins.url_token(token, HERE)


@pytest_twisted.ensureDeferred
async def test_a_url_gives_a_viewers_rights_on_one_robot(front: SessionsWorld) -> None:
    scene = Scene(front)
    ann, _ = await front.logged_in()
    other = await front.store.write(queries.add_robot, "other")
    await front.store.write(queries.grant_right, other.id, "operator", user_id=front.ann.id)
    made = await scene.made(ann, label="office screen")
    assert made.url.startswith("wss://relay.example.org/robots/rover?token=swb_")
    assert "ds.url=wss%3A%2F%2Frelay.example.org%2Frobots%2Frover%3Ftoken%3Dswb_" in made.foxglove
    assert made.lichtblick.startswith("lichtblick://open?ds=foxglove-websocket&ds.url=wss%3A")
    principal = await scene.by(made)
    admission = await front.service.admit(principal, "rover", HERE)
    decisions = {
        operation: admission.permit.decide(operation, "/x").allowed
        for operation in (Operation.SUBSCRIBE, Operation.PUBLISH, Operation.CALL, Operation.CONTROL)
    }
    assert decisions == {
        Operation.SUBSCRIBE: True,
        Operation.PUBLISH: False,
        Operation.CALL: False,
        Operation.CONTROL: False,
    }
    with pytest.raises(NotFound):
        await front.service.admit(principal, "other", HERE)
    assert [record.name for record, _ in await front.access.robots(principal)] == ["rover"]


@pytest_twisted.ensureDeferred
async def test_a_url_never_allows_more_than_its_user_may_at_that_moment(front: SessionsWorld) -> None:
    scene = Scene(front)
    ann, _ = await front.logged_in()
    principal = await scene.by(await scene.made(ann, level="operator"))
    admission = await front.service.admit(principal, "rover", HERE)
    assert admission.permit.decide(Operation.PUBLISH, "/x").allowed
    await front.store.write(queries.grant_right, front.rover.id, "viewer", user_id=front.ann.id)
    await front.access.refresh()
    assert not admission.permit.decide(Operation.PUBLISH, "/x").allowed
    with pytest.raises(Refused, match="needs that level"):
        await scene.made(ann, level="operator")


@pytest_twisted.ensureDeferred
@pytest.mark.parametrize(
    ("level", "allow", "levels"),
    [
        ("viewer", (), ["viewer"]),
        ("viewer", ("publish:/cmd_vel",), ["viewer", "operator"]),
        ("viewer", ("view:/front", "call:/reset"), ["viewer", "operator"]),
        ("viewer", ("*:/arm/*",), ["viewer", "operator"]),
        ("viewer", ("view:/front", "subscribe:/scan", "record:/scan"), ["viewer"]),
        ("operator", (), ["viewer", "operator"]),
        ("owner", (), ["viewer", "operator"]),
    ],
)
async def test_the_levels_that_a_url_may_have_come_with_the_list(
    front: SessionsWorld, level: str, allow: tuple[str, ...], levels: list[str]
) -> None:
    """A viewer with a pattern that allows more needs an operator's URL to use it."""
    scene = Scene(front)
    ann, _ = await front.logged_in()
    await front.store.write(
        queries.grant_right, front.rover.id, level, user_id=front.ann.id, allow=list(allow)
    )
    await front.access.refresh()
    assert (await scene.service.urls(ann, "rover")).levels == levels
    for each in levels:
        assert (await scene.made(ann, level=each)).level == each
    if "operator" not in levels:
        with pytest.raises(Refused, match="needs that level"):
            await scene.made(ann, level="operator")


@pytest_twisted.ensureDeferred
async def test_a_revoked_url_cuts_what_is_open_with_its_reason(front: SessionsWorld) -> None:
    scene = Scene(front)
    ann, _ = await front.logged_in()
    made, kept = await scene.made(ann), await scene.made(ann)
    _, cut = await front.opens(await scene.by(made))
    _, stays = await front.opens(await scene.by(kept))
    listed = (await scene.service.urls(ann, "rover")).urls
    assert [(each.id, each.connections) for each in listed] == [(made.id, 1), (kept.id, 1)]
    await scene.service.revoke(ann, HERE, "rover", made.id)
    assert cut.closed == (close_codes.UNAUTHENTICATED, ENDED)
    assert stays.closed is None
    assert [each.id for each in (await scene.service.urls(ann, "rover")).urls] == [kept.id]
    with pytest.raises(BadCredentials):
        await scene.by(made)
    with pytest.raises(NotFound):
        await scene.service.revoke(ann, HERE, "rover", made.id)


@pytest_twisted.ensureDeferred
async def test_a_url_that_expires_while_connected_is_closed_with_the_reason(front: SessionsWorld) -> None:
    scene = Scene(front)
    ann, _ = await front.logged_in()
    made, kept = await scene.made(ann, expires_in=60.0), await scene.made(ann)
    front.world.clock.advance(59.5)
    _, cut = await front.opens(await scene.by(made))
    _, stays = await front.opens(await scene.by(kept))
    front.world.clock.advance(0.4)
    front.access.expire()
    assert cut.closed is None
    front.world.clock.advance(0.1)
    front.access.expire()
    assert cut.closed == (close_codes.UNAUTHENTICATED, ENDED)
    assert stays.closed is None
    with pytest.raises(BadCredentials):
        await scene.by(made)


@pytest_twisted.ensureDeferred
async def test_making_and_revoking_are_in_the_audit_log_without_the_token(front: SessionsWorld) -> None:
    scene = Scene(front)
    ann, _ = await front.logged_in()
    made = await scene.made(ann, label="screen", expires_in=3600.0)
    await scene.service.revoke(ann, HERE, "rover", made.id)
    audit = await front.store.read(queries.list_audit)
    entries = [each for each in reversed(audit) if each.action.startswith("foxglove")]
    assert [(each.actor, each.action, each.target, each.origin) for each in entries] == [
        ("user:ann", "foxglove_url.create", "rover", HERE),
        ("user:ann", "foxglove_url.revoke", "rover", HERE),
    ]
    assert (entries[0].data["level"], entries[0].data["ttl_s"], entries[0].data["label"]) == (
        "viewer",
        3600.0,
        "screen",
    )
    token = made.url.partition("token=")[2]
    assert token not in str(entries)


@pytest_twisted.ensureDeferred
async def test_a_url_ends_with_its_robot(front: SessionsWorld) -> None:
    scene = Scene(front)
    ann, _ = await front.logged_in()
    made = await scene.made(ann)
    await front.store.write(queries.remove_robot, front.rover.id)
    with pytest.raises(BadCredentials):
        await scene.by(made)


@pytest_twisted.ensureDeferred
async def test_urls_are_made_by_full_tokens_for_known_robots_and_not_without_end(
    front: SessionsWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = Scene(front)
    ann, _ = await front.logged_in()
    narrow = await front.by_token(front.ann, "operator@rover")
    with pytest.raises(Refused, match="without a scope"):
        await scene.made(narrow)
    for robot in ("hidden", "nothing"):
        with pytest.raises(NotFound):
            await scene.service.add(ann, HERE, robot, NewFoxgloveUrl(), BASE)
    monkeypatch.setattr(module, "MOST", 2)
    await scene.made(ann)
    await scene.made(ann)
    with pytest.raises(SwitchboardError, match="the most that one user may have"):
        await scene.made(ann)


@pytest_twisted.ensureDeferred
async def test_a_token_of_a_url_is_no_access_token(front: SessionsWorld) -> None:
    """Neither before nor after its use in a URL."""
    scene = Scene(front)
    ann, _ = await front.logged_in()
    made = await scene.made(ann, level="operator")
    await scene.by(made)
    with pytest.raises(BadCredentials):
        await front.logins.token(made.url.partition("token=")[2])
