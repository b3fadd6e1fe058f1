"""Two administrators at the same time: unseen changes are not overwritten."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import pytest_twisted

from relay_protocol import jsontext
from relay_protocol.errors import NotFound
from relay_server.common.etags import PreconditionFailed, tag_of
from relay_server.realms import robots, users
from relay_server.realms.realm_change import NO_PRECONDITION, Precondition
from tests.worlds.realm_admin import RealmAdminWorld

CHANGES: list[
    tuple[Callable[..., Any], tuple[Any, ...], Callable[..., Any], tuple[str, ...], tuple[Any, ...]]
] = [
    (users.change_user, ("toad", None, True, None), users.user, ("toad",), ("toad", None, None, True)),
    (robots.change_robot, ("mobile", "mine"), robots.robot, ("mobile",), ("mobile", "theirs")),
    (
        robots.grant,
        ("mobile", "toad", "owner", [], []),
        robots.right,
        ("mobile", "toad"),
        ("mobile", "toad", "viewer", [], ["call:/x"]),
    ),
]
"""What one does, what he looks at before, and what another does meanwhile."""


def tag(reported: Any) -> str:
    """Its entity tag."""
    return tag_of(jsontext.encode(reported))


@pytest.mark.parametrize(("work", "mine", "look", "where", "theirs"), CHANGES, ids=lambda each: None)
@pytest_twisted.ensureDeferred
async def test_concurrent_change_is_not_overwritten(
    world: RealmAdminWorld, work: Any, mine: Any, look: Any, where: Any, theirs: Any
) -> None:
    """Until it is read again; a request without a precondition changes it anyway."""
    await world.do(robots.grant, "mobile", "toad", "viewer", [], [])
    seen = Precondition(match=tag(await world.see(look, *where)))
    await world.do(work, *theirs, who="boss@lab1")
    before = await world.see(look, *where)
    noted = len(world.record())
    with pytest.raises(PreconditionFailed):
        await world.do(work, *mine, seen)
    assert await world.see(look, *where) == before and len(world.record()) == noted
    await world.do(work, *mine, Precondition(match=tag(before)))
    assert await world.see(look, *where) != before
    await world.do(work, *theirs, NO_PRECONDITION)
    await world.do(work, *mine, Precondition(match="*"))


@pytest_twisted.ensureDeferred
async def test_a_right_is_given_only_where_there_is_none_or_where_there_is_one(
    world: RealmAdminWorld,
) -> None:
    """``If-None-Match`` creates only a new right; ``If-Match`` replaces only an existing one."""
    given = ("mobile", "@crew", "viewer", [], [])
    for match in ("*", '"of one that was there"'):
        with pytest.raises(PreconditionFailed, match="no longer exists"):
            await world.do(robots.grant, *given, Precondition(match=match))
    with pytest.raises(NotFound, match="no such right"):
        await world.see(robots.right, "mobile", "@crew")
    reported, fresh = await world.do(robots.grant, *given, Precondition(none="*"))
    assert fresh and await world.see(robots.right, "mobile", "@Crew") == reported
    for none in ("*", tag(reported), f"W/{tag(reported)}"):
        with pytest.raises(PreconditionFailed, match="it exists by now"):
            await world.do(robots.grant, *given, Precondition(none=none))
    await world.do(robots.grant, *given, Precondition(none='"another"'))


@pytest_twisted.ensureDeferred
async def test_a_right_of_another_realm_is_not_found(world: RealmAdminWorld) -> None:
    """The answer is that for an unknown right."""
    await world.do(robots.grant, "mobile", "toad", "viewer", [], [], who="root@lab2")
    with pytest.raises(NotFound, match="no such right"):
        await world.see(robots.right, "mobile", "toad")
    for where in (("arm", "toad"), ("mobile", "luigi"), ("mobile", "@band")):
        with pytest.raises(NotFound, match="in your realm"):
            await world.see(robots.right, *where)
