"""``switchboard realm``, and names with realms in all other commands."""

from __future__ import annotations

import json
import shlex
import time
from collections.abc import Callable
from typing import Any

import pytest
from sqlalchemy.orm import Session

from relay_db import queries
from relay_db.engine import Database
from relay_protocol.errors import Invalid
from relay_server.cli.app import resolve_realm


@pytest.fixture
def labs(cli: Any) -> Any:
    """The default realm and lab1, each with a user ann in group crew, and a robot rover in group cleaners."""
    cli.ok("realm", "add", "lab1")
    for realm in ("", "@lab1"):
        cli.ok("user", "add", f"ann{realm}", "--no-password")
        cli.ok("group", "add", f"crew{realm}")
        cli.ok("group", "join", f"crew{realm}", f"ann{realm}")
        cli.ok("robot", "add", f"rover{realm}")
        cli.ok("robot", "group", "add", f"cleaners{realm}", f"rover{realm}")
    return cli


def write(cli: Any, what: Callable[[Session], object]) -> None:
    """Writes to the database as a relay does."""
    database = Database(f"sqlite:///{cli.data / 'switchboard.db'}")
    with database.begin() as s:
        what(s)
    database.close()


def targets(cli: Any, action: str) -> list[str]:
    """Targets of this action in the audit log."""
    return [each["target"] for each in cli.json("audit", "list") if each["action"] == action]


# --- realms -----------------------------------------------------------------------------------------------


def test_realms_are_listed_with_how_many_are_in_them(labs: Any) -> None:
    """The default realm is included."""
    labs.ok("user", "add", "bob@lab1", "--no-password")
    assert labs.json("realm", "list") == [
        {"realm": "default", "users": 1, "robots": 1, "events_days": None},
        {"realm": "lab1", "users": 2, "robots": 1, "events_days": None},
    ]
    assert labs.ok("realm", "list").splitlines()[-1].split()[:3] == ["lab1", "2", "1"]


def test_a_realm_has_a_time_of_its_own_for_events(labs: Any) -> None:
    """In days, until it is reset to the relay's; invalid values are refused."""
    assert labs.json("realm", "set", "LAB1", "--events-days", "7.5") == {"realm": "lab1", "events_days": 7.5}
    assert [each["events_days"] for each in labs.json("realm", "list")] == [None, 7.5]
    assert "for 7.5 days" in labs.ok("realm", "list")
    assert targets(labs, "realm.set") == ["lab1"]
    for days in ("0", "-1", "4000", "nan", "week"):
        assert "days" in labs.fails("realm", "set", "lab1", "--events-days", days)
    assert "no realm 'lab9'" in labs.fails("realm", "set", "lab9", "--events-days", "7")
    assert "as long as the relay's" in labs.ok("realm", "set", "lab1", "--events-days", "relay")
    assert [each["events_days"] for each in labs.json("realm", "list")] == [None, None]


def test_a_realm_is_added_once(cli: Any) -> None:
    assert cli.json("realm", "add", "Lab1") == {"realm": "lab1"}
    assert "there is a realm 'lab1' already" in cli.fails("realm", "add", "LAB1")
    assert "must not contain '@'" in cli.fails("realm", "add", "a@b")
    assert targets(cli, "realm.add") == ["lab1"]


def test_a_realm_with_users_or_robots_stays(labs: Any) -> None:
    said = labs.fails("realm", "remove", "lab1", "--yes")
    assert "users and groups and robots and groups of robots in the realm 'lab1'" in said
    labs.ok("user", "remove", "ann@lab1", "--yes")
    labs.ok("group", "remove", "crew@lab1", "--yes")
    labs.ok("robot", "group", "remove", "cleaners@lab1", "--yes")
    assert "there are robots in the realm 'lab1'" in labs.fails("realm", "remove", "lab1", "--yes")
    assert "cannot be removed" in labs.fails("realm", "remove", "default", "--yes")
    assert targets(labs, "realm.remove") == []


def test_a_realm_is_removed_after_asking(cli: Any) -> None:
    """The question lists what is removed with it."""
    cli.ok("realm", "add", "lab1")
    asked = cli("realm", "remove", "lab1", stdin="n\n")
    assert asked.exit_code == 1
    assert "Remove realm lab1 with its events and its directory?" in asked.stderr
    assert cli.json("realm", "remove", "LAB1", "--yes") == {"realm": "lab1", "removed": True}
    assert "there is no realm 'lab1'" in cli.fails("realm", "remove", "lab1", "--yes")
    assert targets(cli, "realm.remove") == ["lab1"]


# --- names ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "arguments",
    [
        ("user", "add", "eve@lab9", "--no-password"),
        ("group", "add", "crew@lab9"),
        ("robot", "add", "rover@lab9"),
        ("robot", "group", "add", "cleaners@lab9"),
        ("user", "list", "--realm", "lab9"),
        ("group", "list", "--realm", "lab9"),
        ("robot", "list", "--realm", "lab9"),
        ("robot", "group", "list", "--realm", "lab9"),
        ("events", "--realm", "lab9"),
        ("directory", "--realm", "lab9"),
        ("directory", "remove", "a1", "--realm", "lab9", "--yes"),
        ("realm", "remove", "lab9", "--yes"),
    ],
    ids=" ".join,
)
def test_a_realm_that_is_not_there_is_named(cli: Any, arguments: tuple[str, ...]) -> None:
    """The error names the commands that list and add realms."""
    said = cli.fails(*arguments)
    assert "there is no realm 'lab9'; see 'switchboard realm list'" in said
    assert "'switchboard realm add'" in said
    assert cli.json("audit", "list") == []


def test_lists_show_full_names_the_default_realm_first(labs: Any) -> None:
    """Or those of one realm, in any case of its name."""
    labs.ok("user", "add", "zoe", "--no-password")
    assert [each["user"] for each in labs.json("user", "list")] == ["ann", "zoe", "ann@lab1"]
    assert [each["user"] for each in labs.json("user", "list", "--realm", "LAB1")] == ["ann@lab1"]
    assert labs.json("group", "list") == [
        {"group": "crew", "members": ["ann"]},
        {"group": "crew@lab1", "members": ["ann@lab1"]},
    ]
    assert [each["robot"] for each in labs.json("robot", "list")] == ["rover", "rover@lab1"]
    assert [each["robot"] for each in labs.json("robot", "list", "--realm", "default")] == ["rover"]
    assert labs.json("robot", "group", "list", "--realm", "lab1") == [
        {"group": "cleaners@lab1", "robots": ["rover@lab1"]}
    ]
    for command in (("user",), ("group",), ("robot",), ("robot", "group")):
        assert "@lab1" in labs.ok(*command, "list").splitlines()[-1]


def test_a_name_with_a_realm_means_that_user_only(labs: Any) -> None:
    assert labs.json("user", "disable", "ann@lab1")["user"] == "ann@lab1"
    labs.user("bob@lab1")
    labs.ok("user", "passwd", "bob@lab1", "--password-stdin", stdin="battery staple\n")
    assert labs.json("group", "leave", "crew@lab1", "ann@lab1") == {"group": "crew@lab1", "members": []}
    assert labs.json("user", "remove", "ann@lab1", "--yes") == {"user": "ann@lab1", "removed": True}
    assert labs.json("group", "remove", "crew@lab1", "--yes")["group"] == "crew@lab1"
    assert labs.json("robot", "remove", "rover@lab1", "--yes")["robot"] == "rover@lab1"
    assert [(each["user"], each["disabled"]) for each in labs.json("user", "list", "--realm", "default")] == [
        ("ann", False)
    ]
    assert [each["members"] for each in labs.json("group", "list")] == [["ann"]]
    assert [each["robot"] for each in labs.json("robot", "list")] == ["rover"]
    for action, target in (
        ("user.disable", "ann@lab1"),
        ("user.password", "bob@lab1"),
        ("group.leave", "crew@lab1"),
        ("user.remove", "ann@lab1"),
        ("group.remove", "crew@lab1"),
        ("robot.remove", "rover@lab1"),
    ):
        assert targets(labs, action) == [target]


def test_the_default_realm_may_be_named(labs: Any) -> None:
    assert labs.json("user", "disable", "ann@default")["user"] == "ann"
    assert "the user 'ann' exists already" in labs.fails("user", "add", "Ann@default")
    assert "the user 'ann@lab1' exists already" in labs.fails("user", "add", "ann@LAB1")


def test_names_of_two_realms_cannot_be_combined(labs: Any) -> None:
    for arguments in (
        ("right", "grant", "ann@lab1", "rover", "viewer"),
        ("right", "grant", "@crew", "rover@lab1", "viewer"),
        ("group", "join", "crew", "ann@lab1"),
        ("robot", "group", "add", "cleaners@lab1", "rover"),
    ):
        said = labs.fails(*arguments)
        assert "belong to different realms" in said or "not belong to the realm of the" in said
    assert "there is no robot 'mule@lab1'" in labs.fails("right", "grant", "ann", "mule@lab1", "viewer")


def test_rights_are_printed_with_full_names(labs: Any) -> None:
    granted = labs.json("right", "grant", "@crew@lab1", "rover@lab1", "viewer")
    assert (granted["holder"], granted["robot"]) == ("@crew@lab1", "rover@lab1")
    labs.ok("right", "grant", "ann@lab1", "rover@lab1", "owner")
    labs.ok("right", "grant", "ann", "rover", "owner")
    reported = [(each["holder"], each["robot"]) for each in labs.json("right", "list")]
    assert sorted(reported) == [("@crew@lab1", "rover@lab1"), ("ann", "rover"), ("ann@lab1", "rover@lab1")]
    assert len(labs.json("right", "list", "--user", "ann@lab1")) == 2
    assert len(labs.json("right", "list", "--robot", "rover")) == 1
    assert labs.json("right", "revoke", "@crew@lab1", "rover@lab1")["holder"] == "@crew@lab1"
    assert targets(labs, "right.revoke") == ["@crew@lab1 on rover@lab1"]


def test_tokens_and_oauth_clients_are_printed_with_full_names(labs: Any) -> None:
    for name in ("ann", "ann@lab1"):
        assert labs.json("token", "create", name)["user"] == name
        assert labs.json("oauth-client", "add", name)["user"] == name
    for what in ("token", "oauth-client"):
        assert [each["user"] for each in labs.json(what, "list")] == ["ann", "ann@lab1"]
        assert [each["user"] for each in labs.json(what, "list", "--user", "ann@lab1")] == ["ann@lab1"]
        assert "ann@lab1" in labs.ok(what, "list")
    assert targets(labs, "token.create") == targets(labs, "oauth_client.add") == ["ann", "ann@lab1"]


def test_a_robot_of_a_realm_enrols_by_its_full_name(labs: Any) -> None:
    """The printed command contains it."""
    for said in (labs.ok("robot", "code", "rover@lab1"), labs.ok("robot", "add", "mule@lab1")):
        command = shlex.split(said.splitlines()[-1])
        assert command[command.index("--robot") + 1] in ("rover@lab1", "mule@lab1")
    assert labs.json("robot", "keys", "rover@lab1") == []
    assert targets(labs, "robot.code") == ["rover@lab1"]


def test_alerts_are_printed_with_full_names(labs: Any) -> None:
    write(
        labs,
        lambda s: queries.save_alerts(
            s,
            [
                queries.AlertRecord(
                    f"a{number}",
                    number,
                    "rover",
                    "default",
                    "offline",
                    "",
                    "error",
                    "gone",
                    10.0,
                    10.0,
                    1,
                    1,
                    *[None] * 3,
                )
                for number in (1, 2)
            ],
        ),
    )
    assert [each["robot"] for each in labs.json("alerts", "list")] == ["rover", "rover@lab1"]
    assert [each["id"] for each in labs.json("alerts", "list", "--robot", "rover@lab1")] == ["a2"]
    assert "offline of rover@lab1" in labs.ok("alerts", "ack", "a2")
    assert targets(labs, "alert.acknowledge") == ["offline of rover@lab1"]
    assert labs.json("alerts", "rules", "add", "ann@lab1", "--portal")["user"] == "ann@lab1"
    labs.ok("alerts", "rules", "add", "ann", "--portal")
    assert [each["user"] for each in labs.json("alerts", "rules", "list")] == ["ann@lab1", "ann"]
    assert len(labs.json("alerts", "rules", "list", "--user", "ann@lab1")) == 1


# --- one realm at a time ----------------------------------------------------------------------------------


def test_events_are_those_of_one_realm(labs: Any) -> None:
    write(
        labs,
        lambda s: queries.store_events(
            s,
            [
                queries.NewStoredEvent("default", 10.0, "relay:rover", "here", 1, "ann", "{}"),
                queries.NewStoredEvent("lab1", 20.0, "relay:rover", "there", 2, "ann", "{}"),
                queries.NewStoredEvent("lab1", 30.0, "relay:rover", "local", 2, "admin (local)", "{}"),
            ],
        ),
    )
    assert [each["kind"] for each in labs.json("events")] == ["here"]
    reported = labs.json("events", "--realm", "LAB1")
    assert [(each["kind"], each["robot"], each["user"]) for each in reported] == [
        ("there", "rover@lab1", "ann@lab1"),
        ("local", "rover@lab1", "admin (local)"),
    ]
    assert labs.json("events", "--robot", "rover@lab1") == reported
    assert labs.json("events", "--robot", "ro*", "--realm", "lab1") == reported
    assert [each["kind"] for each in labs.json("events", "--user", "ann@lab1")] == ["there"]
    assert "one realm at a time" in labs.fails("events", "--robot", "rover@lab1", "--user", "ann")
    assert "give its realm by --realm" in labs.fails("events", "--robot", "ro*@lab1")


def test_the_directory_is_that_of_one_realm(labs: Any) -> None:

    def enter(s: Session) -> None:
        for realm, name, id in (("default", "ann", "a1"), ("lab1", "ann", "a2")):
            ann, rover = queries.find_user(s, name, realm), queries.find_robot(s, "rover", realm)
            assert ann is not None and rover is not None
            new = queries.NewEntry(
                realm, "service", "speech", "http://a/", "x", rover.id, ann.id, "{}", 3600.0
            )
            queries.register_entry(s, new, id, time.time(), of_user=9, of_realm=9)

    write(labs, enter)
    assert [each["id"] for each in labs.json("directory")] == ["a1"]
    (reported,) = labs.json("directory", "--realm", "lab1")
    assert (reported["id"], reported["robot"], reported["user"]) == ("a2", "rover@lab1", "ann@lab1")
    for arguments in (("--robot", "rover@lab1"), ("--robot", "rover", "--realm", "lab1")):
        assert [each["id"] for each in labs.json("directory", *arguments)] == ["a2"]
    assert "there is no robot 'mule@lab1'" in labs.fails("directory", "--robot", "mule@lab1")
    assert "rover@lab1" in labs.ok("directory", "--realm", "lab1")
    assert "there is no entry 'a2'" in labs.fails("directory", "remove", "a2", "--yes")
    asked = labs("directory", "remove", "a2", "--realm", "lab1", stdin="n\n")
    assert "of ann@lab1 from" in asked.stderr
    labs.ok("directory", "remove", "a2", "--realm", "lab1", "--yes")
    assert labs.json("directory", "--realm", "lab1") == []


@pytest.mark.parametrize(
    ("asked", "realm", "meant"),
    [
        (["rover", "cleaner-*", "group:crew"], None, ("default", ["rover", "cleaner-*", "group:crew"])),
        (["rover", "cleaner-*", "group:crew"], "Lab2", ("lab2", ["rover", "cleaner-*", "group:crew"])),
        (["mobile@lab2", "arm@LAB2"], None, ("lab2", ["mobile", "arm"])),
        (["rover", "mule@default"], None, ("default", ["rover", "mule"])),
        (["rover", "mobile@lab2"], "lab2", ("lab2", ["rover", "mobile"])),
        ([], None, ("default", [])),
        ([], "lab2", ("lab2", [])),
    ],
)
def test_all_names_of_a_request_belong_to_one_realm(
    asked: list[str], realm: str | None, meant: tuple[str, list[str]]
) -> None:
    assert resolve_realm(asked, realm) == meant


@pytest.mark.parametrize(
    ("asked", "realm", "words"),
    [
        (["rover", "mobile@lab2"], None, "the realms 'default' and 'lab2'"),
        (["arm@lab1", "mobile@lab2"], None, "the realms 'lab1' and 'lab2'"),
        (["mobile@lab2"], "lab1", "the realms 'lab1' and 'lab2'"),
        (["mobile@lab2", "cleaner-*"], None, "the realms 'default' and 'lab2'"),
        (["cleaner-*@lab2"], None, "write 'cleaner-*' and give its realm by --realm"),
        (["group:crew@lab2"], "lab2", "write 'group:crew' and give its realm by --realm"),
        (["mobile@"], None, "the name of a realm must have"),
        (["mobile@a@b"], None, "the name of a realm must not contain '@'"),
        (["mobile"], "lab 2", "the name of a realm must be printable, without spaces"),
    ],
)
def test_names_of_several_realms_are_refused(asked: list[str], realm: str | None, words: str) -> None:
    """The error says what to write instead."""
    with pytest.raises(Invalid, match=words.replace("*", r"\*")):
        resolve_realm(asked, realm)


@pytest.mark.parametrize(
    "arguments",
    [
        ("call", "mobile@lab2", "/start"),
        ("publish", "mobile", "/mode", "{}", "--realm", "lab2"),
        ("set", "mobile@lab2", "/a:speed", "1"),
        ("stop", "mobile@lab2"),
        ("resume", "mobile", "--realm", "lab2"),
    ],
)
def test_an_order_to_many_goes_to_one_realm(live: Any, relay: Any, arguments: tuple[str, ...]) -> None:
    """The relay gets names within the realm; the output has full names."""
    result = {"robot": "mobile", "ok": True, "message": "", "values": None, "seconds": 0.25}
    head = {"do": arguments[0], "robots": ["mobile"], "unmatched": ["arm"]}
    relay.lines = 200, b"\n".join(json.dumps(each).encode() for each in (head, result))
    said = live("robot", *arguments).stdout
    assert said.splitlines()[2].split()[0] == "mobile@lab2"
    assert "'arm' matches no robot of the realm 'lab2'." in said
    assert relay.asked == ["POST /fleet?realm=lab2"]
    assert [each["robots"] for each in relay.ordered] == [["mobile"]]
    assert json.loads(live("robot", *arguments, "--json").stdout)["results"][0]["robot"] == "mobile@lab2"


def test_an_order_without_a_match_names_the_realm(live: Any, relay: Any) -> None:
    """Names of two realms never reach the relay."""
    assert "one realm at a time" in live.fails("robot", "stop", "rover,mobile@lab2")
    assert relay.asked == []
    relay.lines = 404, b'{"detail": "the order means no robot"}'
    said = live.fails("robot", "call", "*", "/start", "--realm", "lab9")
    assert "the order means no robot in the realm 'lab9'; see 'switchboard realm list'" in said


# --- stop, resume, status ---------------------------------------------------------------------------------


def test_a_robot_of_a_realm_is_stopped_without_a_relay(labs: Any) -> None:
    """The order is stored for it, not for a robot of the same name. Resuming removes it."""
    assert labs.json("stop", "rover@lab1") == {"robots": [{"robot": "rover@lab1", "done": False}]}
    assert "no stop of this robot is waiting" in labs.fails("resume", "rover", code=3)
    assert labs.ok("resume", "rover@lab1") == "Robot rover@lab1 may move again.\n"
    assert targets(labs, "robot.stopped") == targets(labs, "robot.resumed") == ["rover@lab1"]
    assert [each["robot"] for each in labs.json("stop", "--all")["robots"]] == ["rover", "rover@lab1"]


def test_a_stop_of_all_is_stored_for_robots_the_relay_missed(live: Any, relay: Any) -> None:
    live.ok("realm", "add", "lab1")
    live.ok("robot", "add", "rover")
    live.ok("robot", "add", "rover@lab1")
    relay.motion = (200, b'{"robots": [{"robot": "rover@lab1", "done": true}], "missed": "no answer"}')
    reported = json.loads(live("stop", "--all", "--json").stdout)["robots"]
    assert reported == [{"robot": "rover@lab1", "done": True}, {"robot": "rover", "done": False}]


def test_the_relay_gets_the_full_name_of_a_robot(live: Any, relay: Any) -> None:
    """Any spelling of the realm works: a stop must not fail for an upper-case letter."""
    relay.motion = (200, b'{"robots": [{"robot": "rover@lab1", "done": true}]}')
    for written in ("rover@LAB1", "rover@lab1"):
        assert live.ok("stop", written) == "Robot rover@lab1 is stopped.\n"
        assert live.ok("resume", written) == "Robot rover@lab1 may move again.\n"
    live.ok("stop", "rover@default")
    assert [each["robot"] for each in relay.ordered] == [*["rover@lab1"] * 4, "rover"]


def test_status_of_a_robot_goes_by_its_full_name(live: Any, relay: Any) -> None:
    robots = [{"name": "rover"}, {"name": "rover@lab1"}]
    relay.answer = (200, json.dumps({"relay": "here", "robots": robots}).encode())
    for asked, name in (("rover@lab1", "rover@lab1"), ("rover", "rover"), ("rover@default", "rover")):
        assert live.json("status", asked)["robots"] == [{"name": name}]
    assert "does not know a robot 'rover@lab2'" in live.fails("status", "rover@lab2")
