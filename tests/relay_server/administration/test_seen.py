"""Two administrators at once: what one has not seen he does not overwrite."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import pytest_twisted

from relay_protocol import jsontext
from relay_protocol.errors import NotFound
from relay_server.realms import robots, users
from relay_server.realms.realm_change import ANYTHING, Precondition
from relay_server.resources.etags import PreconditionFailed, tag_of
from tests.relay_server.administration.office import Office

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


def tag(told: Any) -> str:
    """Its entity tag."""
    return tag_of(jsontext.encode(told))


@pytest.mark.parametrize(("work", "mine", "look", "where", "theirs"), CHANGES, ids=lambda each: None)
@pytest_twisted.ensureDeferred
async def test_what_another_changed_meanwhile_is_not_overwritten(
    office: Office, work: Any, mine: Any, look: Any, where: Any, theirs: Any
) -> None:
    """Until it was read again; who says nothing of what he has seen changes it all the same."""
    await office.do(robots.grant, "mobile", "toad", "viewer", [], [])
    seen = Precondition(match=tag(await office.see(look, *where)))
    await office.do(work, *theirs, who="boss@lab1")
    before = await office.see(look, *where)
    noted = len(office.record())
    with pytest.raises(PreconditionFailed):
        await office.do(work, *mine, seen)
    assert await office.see(look, *where) == before and len(office.record()) == noted
    await office.do(work, *mine, Precondition(match=tag(before)))
    assert await office.see(look, *where) != before
    await office.do(work, *theirs, ANYTHING)
    await office.do(work, *mine, Precondition(match="*"))


@pytest_twisted.ensureDeferred
async def test_a_right_is_given_only_where_there_is_none_or_where_there_is_one(office: Office) -> None:
    """Whoever has seen none takes the place of none; whoever has seen one gives none anew."""
    given = ("mobile", "@crew", "viewer", [], [])
    for match in ("*", '"of one that was there"'):
        with pytest.raises(PreconditionFailed, match="none of it any more"):
            await office.do(robots.grant, *given, Precondition(match=match))
    with pytest.raises(NotFound, match="no such right"):
        await office.see(robots.right, "mobile", "@crew")
    told, fresh = await office.do(robots.grant, *given, Precondition(none="*"))
    assert fresh and await office.see(robots.right, "mobile", "@Crew") == told
    for none in ("*", tag(told), f"W/{tag(told)}"):
        with pytest.raises(PreconditionFailed, match="there is one by now"):
            await office.do(robots.grant, *given, Precondition(none=none))
    await office.do(robots.grant, *given, Precondition(none='"another"'))


@pytest_twisted.ensureDeferred
async def test_a_right_of_another_realm_is_none(office: Office) -> None:
    """It is answered as one that nobody has."""
    await office.do(robots.grant, "mobile", "toad", "viewer", [], [], who="root@lab2")
    with pytest.raises(NotFound, match="no such right"):
        await office.see(robots.right, "mobile", "toad")
    for where in (("arm", "toad"), ("mobile", "luigi"), ("mobile", "@band")):
        with pytest.raises(NotFound, match="in your realm"):
            await office.see(robots.right, *where)
