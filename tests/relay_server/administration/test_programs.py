"""Programs of users and groups of robots, as administrators see to them in their own realm, on a real database."""

from __future__ import annotations

import pytest
import pytest_twisted

from relay_db import queries
from relay_db.queries import QuotaExceeded
from relay_protocol.errors import Invalid, NotFound, Refused
from relay_server.auth import passwords
from relay_server.realms import limits, robots, users
from relay_server.resources.page import PageQuery
from tests.relay_server.administration.office import ALL, HERE, Office


@pytest_twisted.ensureDeferred
async def test_a_program_is_added_listed_and_revoked(office: Office) -> None:
    """Its secret is told once, proves it, and is kept nowhere; each change is on record as by the command line."""
    made = await office.do(users.add_program, "Toad", "nightly report", "viewer@mobile")
    key, secret = made["key"], made.pop("secret")
    told = {"key": key, "label": "nightly report", "created": 1000.0, "scope": "viewer@mobile"}
    assert made == told
    assert await office.see(users.programs, "toad", ALL) == {"programs": [told], "next": ""}
    assert (await office.see(users.about))["programs"] == 1
    with office.store.database.reading() as s:
        kept = queries.find_program(s, key)
    assert kept is not None and kept.verifier == passwords.verifier(key, secret)
    await office.do(users.revoke_program, key)
    assert office.taken_up == 2
    assert await office.see(users.programs, "toad", ALL) == {"programs": [], "next": ""}
    data = {"id": kept.id, "key": key, "scope": "viewer@mobile", "label": "nightly report"}
    assert office.record() == [
        ("user:root@lab1", HERE, "program.add", "toad@lab1", data),
        ("user:root@lab1", HERE, "program.revoke", str(kept.id), {"user": "toad@lab1"}),
    ]
    assert secret not in str(office.record())


@pytest_twisted.ensureDeferred
async def test_programs_are_listed_by_pages(office: Office) -> None:
    """In the order of their keys."""
    keys = sorted([(await office.do(users.add_program, "toad", "", None))["key"] for _ in range(3)])
    first = await office.see(users.programs, "toad", PageQuery(limit=2))
    assert ([each["key"] for each in first["programs"]], first["next"]) == (keys[:2], keys[1])
    rest = await office.see(users.programs, "toad", PageQuery(after=keys[1]))
    assert ([each["key"] for each in rest["programs"]], rest["next"]) == (keys[2:], "")


@pytest_twisted.ensureDeferred
async def test_a_program_of_another_realm_is_none(office: Office) -> None:
    """Its key is that of nobody, and it stays; that of a disabled user of the own realm is found."""
    other = (await office.do(users.add_program, "toad", "", None, who="root@lab2"))["key"]
    own = (await office.do(users.add_program, "toad", "", None))["key"]
    for key in (other, own[:-1], "swp_%", "\0", ""):
        with pytest.raises(NotFound, match="nobody in your realm has such a program"):
            await office.do(users.revoke_program, key)
    await office.do(users.change_user, "toad", None, True, None)
    await office.do(users.revoke_program, own)
    assert len((await office.see(users.programs, "toad", ALL, who="root@lab2"))["programs"]) == 1


@pytest_twisted.ensureDeferred
async def test_programs_that_can_not_be(office: Office, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of somebody shut out, for what is no scope, too many of the realm and of one user: nothing is on record."""
    for scope in ("", "fly", "viewer  owner"):
        with pytest.raises(Invalid):
            await office.do(users.add_program, "toad", "", scope)
    with pytest.raises(Invalid, match="label of a program"):
        await office.do(users.add_program, "toad", "two\nlines", None)
    with office.store.database.begin() as s:
        toad = queries.find_user(s, "toad", "lab1")
        assert toad is not None
        queries.set_disabled(s, toad.id, True)
    with pytest.raises(Invalid, match="disabled; enable it first"):
        await office.do(users.add_program, "toad", "", None)
    monkeypatch.setattr(users, "PROGRAMS_OF_ONE", 0)
    with pytest.raises(QuotaExceeded, match="a user has 0 programs"):
        await office.do(users.add_program, "boss", "", None)
    monkeypatch.setitem(limits.MOST, "programs", 0)
    with pytest.raises(QuotaExceeded, match="a realm has 0 programs"):
        await office.do(users.add_program, "boss", "", None)
    assert office.record() == []


@pytest_twisted.ensureDeferred
async def test_nobody_makes_a_program_that_acts_as_a_guest(office: Office) -> None:
    """By it he would get tokens of the realm that the guest comes from, and be him there."""
    with office.store.database.begin() as s:
        boss = queries.find_user(s, "boss", "lab1")
        assert boss is not None
        queries.add_guest(s, boss.id, "lab2")
    with pytest.raises(Refused, match="a matter of his own realm"):
        await office.do(users.add_program, "boss", "", None, who="root@lab2")
    assert await office.see(users.programs, "boss", ALL, who="root@lab2") == {"programs": [], "next": ""}
    assert office.record() == []


@pytest_twisted.ensureDeferred
async def test_a_group_of_robots_from_its_beginning_to_its_end(office: Office) -> None:
    """With the names on record that the command line has; a robot that is in it already is not put in again."""
    await office.do(robots.add_robot, "arm", "")
    assert await office.do(robots.add_group, "Upstairs") == {"group": "upstairs", "robots": []}
    for robot in ("mobile", "arm", "arm"):
        await office.do(robots.join, "upstairs", robot)
    assert await office.see(robots.group, "UPSTAIRS") == {"group": "upstairs", "robots": ["arm", "mobile"]}
    assert await office.see(robots.groups, ALL) == {
        "robot_groups": [
            {"group": "cleaners", "robots": []},
            {"group": "upstairs", "robots": ["arm", "mobile"]},
        ],
        "next": "",
    }
    first = await office.see(robots.groups, PageQuery(limit=1))
    assert ([each["group"] for each in first["robot_groups"]], first["next"]) == (["cleaners"], "cleaners")
    await office.do(robots.leave, "upstairs", "arm")
    with pytest.raises(NotFound, match="not in this group"):
        await office.do(robots.leave, "upstairs", "arm")
    await office.do(robots.remove_group, "upstairs")
    assert [each["group"] for each in (await office.see(robots.groups, ALL))["robot_groups"]] == ["cleaners"]
    assert [each[2:] for each in office.record()[1:]] == [
        ("robot.group.add", "upstairs@lab1", {"robots": []}),
        ("robot.group.add", "upstairs@lab1", {"robots": ["mobile@lab1"]}),
        ("robot.group.add", "upstairs@lab1", {"robots": ["arm@lab1"]}),
        ("robot.group.remove", "upstairs@lab1", {"robots": ["arm@lab1"]}),
        ("robot.group.remove", "upstairs@lab1", {"robots": []}),
    ]


@pytest_twisted.ensureDeferred
async def test_groups_have_not_too_many_robots(office: Office, monkeypatch: pytest.MonkeyPatch) -> None:
    """All groups of the realm together; what is in one already takes no room."""
    monkeypatch.setitem(limits.MOST, "robot_memberships", 1)
    await office.do(robots.add_robot, "arm", "")
    for _ in range(2):
        await office.do(robots.join, "cleaners", "mobile")
    await office.do(robots.join, "cleaners", "mobile", who="root@lab2")
    with pytest.raises(QuotaExceeded, match="1 robot memberships at most"):
        await office.do(robots.join, "cleaners", "arm")


@pytest_twisted.ensureDeferred
async def test_a_robot_is_described_anew(office: Office) -> None:
    """In one line; what it is called already is not on record."""
    for description in ("on the bench", "on the bench", None):
        told = await office.do(robots.change_robot, "mobile", description)
        assert told == {"robot": "mobile", "description": "on the bench", "keys": 0, "guest": False}
    with pytest.raises(Invalid, match="description of a robot"):
        await office.do(robots.change_robot, "mobile", "two\nlines")
    assert await office.see(robots.robot, "mobile") == told
    assert (await office.see(robots.robot, "mobile", who="root@lab2"))["description"] == ""
    data = {"description": "on the bench"}
    assert [each[2:] for each in office.record()] == [("robot.describe", "mobile@lab1", data)]


@pytest_twisted.ensureDeferred
async def test_a_shared_robot_is_its_own_realms(office: Office) -> None:
    """Where it is shared it is given rights on and put into groups; it is neither removed nor enrolled from there."""
    await office.do(robots.add_robot, "arm", "")
    with office.store.database.begin() as s:
        arm = queries.find_robot(s, "arm", "lab1")
        assert arm is not None
        queries.share_robot(s, arm.id, "lab2")
    for work, args in (
        (robots.change_robot, ("arm", "mine")),
        (robots.new_code, ("arm",)),
        (robots.revoke_key, ("arm", "0" * 16)),
        (robots.remove_robot, ("arm", 0)),
    ):
        with pytest.raises(Refused, match="a matter of its own realm"):
            await office.do(work, *args, who="root@lab2")
    await office.do(robots.grant, "arm", "toad", "viewer", [], [], who="root@lab2")
    await office.do(robots.join, "cleaners", "arm", who="root@lab2")
    assert (await office.see(robots.group, "cleaners", who="root@lab2"))["robots"] == ["arm"]
    assert (await office.see(robots.group, "cleaners"))["robots"] == []
    with pytest.raises(Refused, match="a matter of its own realm"):
        await office.see(robots.keys, "arm", PageQuery(), who="root@lab2")


@pytest_twisted.ensureDeferred
async def test_who_shuts_out_a_guest_has_shut_him_out(office: Office) -> None:
    """Also while the guest's own realm has done so for a time; nor is his password anybody's but there."""
    with office.store.database.begin() as s:
        queries.add_user(s, "peach", "hash", realm="lab1")
        peach = queries.find_user(s, "peach", "lab1")
        assert peach is not None
        guest = queries.add_guest(s, peach.id, "lab2")
        queries.set_disabled(s, peach.id, True)
    change = users.change_user
    told = await office.do(change, "peach", None, True, None, who="root@lab2")
    assert (told["disabled"], told["guest"]) == (True, True)
    with office.store.database.begin() as s:
        queries.set_disabled(s, peach.id, False)
        assert not queries.user_is_live(s, guest.id)
    with pytest.raises(Refused, match="an account elsewhere"):
        await office.do(change, "peach", "hash", None, None, who="root@lab2")


@pytest_twisted.ensureDeferred
async def test_how_long_events_are_kept_is_said_for_ones_own_realm(office: Office) -> None:
    """On record as by the command line; by a token for all, and for no longer than may be."""
    assert (await office.do(users.keep_events, 7.0))["events_days"] == 7.0
    assert (await office.see(users.about, who="root@lab2"))["events_days"] is None
    assert (await office.do(users.keep_events, None))["events_days"] is None
    assert office.record() == [
        ("user:root@lab1", HERE, "realm.set", "lab1", {"events_days": days}) for days in (7.0, None)
    ]
    for days in (0.0, 1e6):
        with pytest.raises(Invalid, match="more than 0 days"):
            await office.do(users.keep_events, days)
    office.people["narrow"] = office.by_token("root", "lab1", "admin")
    with pytest.raises(Refused):
        await office.do(users.keep_events, 7.0, who="narrow")
