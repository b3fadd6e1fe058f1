"""``switchboard user``, ``switchboard group`` and ``switchboard right``."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import click

from relay_db import queries
from relay_db.names import normal_name
from relay_protocol.errors import Invalid
from relay_protocol.realms import full_name, split_name
from relay_protocol.rights import Level
from relay_server.auth import passwords
from relay_server.cli.app import (
    App,
    LocalChange,
    examples,
    existing_realm,
    get_robot,
    get_user,
    json_option,
    list_in_realm,
    new_name,
    pass_app,
    realm_option,
    user_id,
    yes_option,
)
from relay_server.cli.output import print_list, print_result, remove_named
from relay_server.realms.changes import GROUP_MARK, Holder, holder_text

stdin_option: Callable[[Any], Any] = click.option(
    "--password-stdin", is_flag=True, help="Read the password from the first line of stdin."
)


@click.group()
def user() -> None:
    """Add, list, change and remove users."""


@user.command(
    epilog=examples(
        "switchboard user add ann",
        "switchboard user add ops --admin --password-stdin < password.txt",
        "switchboard user add fleet-report --no-password",
        "switchboard user add toad@lab1",
    )
)
@click.argument("name")
@click.option("--admin", is_flag=True, help="An administrator: owner of every robot of the realm.")
@stdin_option
@click.option("--no-password", is_flag=True, help="No password: the user can log in only with access tokens.")
@json_option
@pass_app
def add(app: App, name: str, admin: bool, password_stdin: bool, no_password: bool, as_json: bool) -> None:
    """Add the user NAME, or NAME@REALM. Asks for a password unless an option says otherwise."""
    if password_stdin and no_password:
        raise click.UsageError("--password-stdin and --no-password exclude each other.")
    bare = normal_name(split_name(name)[0], "name of a user")
    with app.reading() as session:
        # Checked before anyone types a password twice.
        _, realm = new_name(session, name)
        if queries.find_user(session, bare, realm) is not None:
            raise Invalid(f"the user '{full_name(bare, realm)}' exists already")
    hashed = None if no_password else new_password_hash(password_stdin)
    with app.change() as change:
        added = change.add_user(bare, realm, hashed, admin=admin)
    print_result(as_json, _json(added), f"Added {'administrator' if admin else 'user'} {added.full}.")


@user.command("list", epilog=examples("switchboard user list", "switchboard user list --realm lab1 --json"))
@realm_option
@json_option
@pass_app
def list_(app: App, realm: str | None, as_json: bool) -> None:
    """List all users, or those of one realm."""
    with app.reading() as session:
        users = list_in_realm(session, queries.list_users, realm)
    cells = ((each.full, _role(each), _password(each)) for each in users)
    print_list(as_json, map(_json, users), ("user", "role", "password"), cells)


@user.command(epilog=examples("switchboard user passwd ann", "switchboard user passwd ann --password-stdin"))
@click.argument("name")
@stdin_option
@json_option
@pass_app
def passwd(app: App, name: str, password_stdin: bool, as_json: bool) -> None:
    """Set the password of user NAME. Their browser sessions end, their access tokens stay valid."""
    with app.reading() as session:
        found = get_user(session, name)
        if found.home is not None:
            raise Invalid(f"the password of {found.full} is that of {found.home}; change it there")
    hashed = new_password_hash(password_stdin)
    with app.change() as change:
        found = change.set_password(change.user(name), hashed)
    print_result(as_json, _json(found), f"Changed the password of {found.full}.")


@user.command(
    epilog=examples("switchboard user join toad@lab1 lab2", "switchboard user remove toad@lab2 --yes")
)
@click.argument("name")
@click.argument("realm")
@json_option
@pass_app
def join(app: App, name: str, realm: str, as_json: bool) -> None:
    """Give user NAME an account in REALM too, with the same name and password.

    The new account has no rights until some are granted. To undo this, remove the account NAME@REALM.
    """
    with app.change() as change:
        added = change.add_guest(change.user(name), existing_realm(change.session, realm))
    print_result(
        as_json,
        _json(added),
        f"{added.home} now has an account in the realm {split_name(added.full)[1]} too: {added.full}.",
    )


@user.command(epilog=examples("switchboard user disable ann"))
@click.argument("name")
@json_option
@pass_app
def disable(app: App, name: str, as_json: bool) -> None:
    """Lock user NAME out at once. Rights and tokens are kept."""
    _set_disabled(app, name, True, as_json)


@user.command(epilog=examples("switchboard user enable ann"))
@click.argument("name")
@json_option
@pass_app
def enable(app: App, name: str, as_json: bool) -> None:
    """Unlock a disabled user NAME."""
    _set_disabled(app, name, False, as_json)


@user.command(epilog=examples("switchboard user remove ann", "switchboard user remove ann --yes"))
@click.argument("name")
@yes_option
@json_option
@pass_app
def remove(app: App, name: str, yes: bool, as_json: bool) -> None:
    """Remove user NAME with its rights and tokens."""
    remove_named(app, "user", name, yes, as_json)


def _set_disabled(app: App, name: str, disabled: bool, as_json: bool) -> None:
    with app.change() as change:
        found = change.set_disabled(change.user(name), disabled)
    sentence = f"{'Disabled' if disabled else 'Enabled'} user {found.full}."
    print_result(as_json, _json(found), sentence)


def _json(record: queries.UserRecord) -> dict[str, Any]:
    return {
        "user": record.full,
        "admin": record.admin,
        "disabled": record.disabled,
        "password": record.password_hash is not None,
        "guest_of": record.home,
    }


def _password(record: queries.UserRecord) -> str:
    if record.home is not None:
        return f"that of {record.home}"
    return "yes" if record.password_hash else "no"


def _role(record: queries.UserRecord) -> str:
    role = "admin" if record.admin else "user"
    return f"{role}, disabled" if record.disabled else role


def new_password_hash(from_stdin: bool) -> str:
    """Read a new password and return its hash.

    :raises Invalid: it breaks the rules, or stdin is empty
    """
    return passwords.hash_password(_read_stdin() if from_stdin else _prompt_password())


def _read_stdin() -> str:
    line = sys.stdin.buffer.readline(passwords.MAX_BYTES + 3)
    try:
        text = line.decode()
    except UnicodeDecodeError:
        raise Invalid("the password on stdin is not UTF-8") from None
    text = text.removesuffix("\n").removesuffix("\r")
    if not text:
        raise Invalid("no password came on stdin; pipe one line into the command")
    return text


def _prompt_password() -> str:
    text: str = click.prompt("Password", hide_input=True, confirmation_prompt=True, err=True)
    return text


# --- groups -----------------------------------------------------------------------------------------------


@click.group()
def group() -> None:
    """Put users into groups that share rights."""


@group.command("add", epilog=examples("switchboard group add lab", "switchboard group add lab@lab1"))
@click.argument("name")
@json_option
@pass_app
def add_group(app: App, name: str, as_json: bool) -> None:
    """Add the group NAME, or NAME@REALM."""
    with app.change() as change:
        added = change.add_group(*new_name(change.session, name))
    print_result(as_json, _group_json(added), f"Added group {added.full}.")


@group.command("list", epilog=examples("switchboard group list", "switchboard group list --realm lab1"))
@realm_option
@json_option
@pass_app
def list_groups(app: App, realm: str | None, as_json: bool) -> None:
    """List all groups and their members, or those of one realm."""
    with app.reading() as session:
        groups = list_in_realm(session, queries.list_groups, realm)
    cells = ((each.full, ", ".join(_members(each))) for each in groups)
    print_list(as_json, map(_group_json, groups), ("group", "members"), cells)


@group.command("remove", epilog=examples("switchboard group remove lab --yes"))
@click.argument("name")
@yes_option
@json_option
@pass_app
def remove_group(app: App, name: str, yes: bool, as_json: bool) -> None:
    """Remove group NAME and its rights. Its members stay users."""
    remove_named(app, "group", name, yes, as_json)


@group.command("join", epilog=examples("switchboard group join lab ann"))
@click.argument("group_name", metavar="GROUP")
@click.argument("user_name", metavar="USER")
@json_option
@pass_app
def join_group(app: App, group_name: str, user_name: str, as_json: bool) -> None:
    """Put USER into GROUP."""
    with app.change() as change:
        found, member = change.group(group_name), change.user(user_name)
        change.join(found, member)
        found = change.group(group_name)
    print_result(as_json, _group_json(found), f"{member.full} is in group {found.full}.")


@group.command("leave", epilog=examples("switchboard group leave lab ann"))
@click.argument("group_name", metavar="GROUP")
@click.argument("user_name", metavar="USER")
@json_option
@pass_app
def leave_group(app: App, group_name: str, user_name: str, as_json: bool) -> None:
    """Take USER out of GROUP."""
    with app.change() as change:
        found, member = change.group(group_name), change.user(user_name)
        if not change.leave(found, member):
            raise Invalid(f"{member.full} is not in group {found.full}")
        found = change.group(group_name)
    print_result(as_json, _group_json(found), f"{member.full} is no longer in group {found.full}.")


def _group_json(record: queries.GroupRecord) -> dict[str, Any]:
    return {"group": record.full, "members": _members(record)}


def _members(record: queries.GroupRecord) -> list[str]:
    return [full_name(each, record.realm) for each in record.members]


@click.group()
def right() -> None:
    """Grant, list and revoke rights on robots."""


@right.command(
    epilog=examples(
        "switchboard right grant ann rover operator",
        "switchboard right grant @lab rover viewer --allow call:/reset",
        "switchboard right grant bob rover operator --deny 'publish:/arm/*'",
        "switchboard right grant @crew@lab2 mobile@lab2 operator",
    )
)
@click.argument("holder", metavar="USER|@GROUP")
@click.argument("robot")
@click.argument("level", type=click.Choice([str(each) for each in Level]))
@click.option("--allow", metavar="PATTERN", multiple=True, help="Also allow operation:resource. Repeatable.")
@click.option(
    "--deny",
    metavar="PATTERN",
    multiple=True,
    help="Deny operation:resource. Repeatable; wins over everything else.",
)
@json_option
@pass_app
def grant(
    app: App,
    holder: str,
    robot: str,
    level: str,
    allow: tuple[str, ...],
    deny: tuple[str, ...],
    as_json: bool,
) -> None:
    """Grant USER or GROUP a right on ROBOT. It replaces the right they have there.

    They must belong to a realm of the robot. A viewer may subscribe, an operator may also publish and call,
    an owner may do everything. Patterns are operation:resource, with the operations subscribe, view, record,
    publish, call, provide, manage or *, and wildcards in the resource.
    """
    with app.change() as change:
        found, whose = change.robot(robot), _holder(change, holder)
        change.grant(found, whose, level, allow, deny)
    text = holder_text(whose)
    result = {"holder": text, "robot": found.full, "level": level, "allow": list(allow), "deny": list(deny)}
    print_result(as_json, result, f"{text} is {level} on {found.full}.")


@right.command(epilog=examples("switchboard right revoke ann rover"))
@click.argument("holder", metavar="USER|@GROUP")
@click.argument("robot")
@json_option
@pass_app
def revoke(app: App, holder: str, robot: str, as_json: bool) -> None:
    """Revoke the right of USER or GROUP on ROBOT. Connections that need it are cut at once."""
    with app.change() as change:
        found, whose = change.robot(robot), _holder(change, holder)
        text = holder_text(whose)
        if not change.revoke(found, whose):
            raise Invalid(f"{text} has no right of its own on {found.full}")
    answer = {"holder": text, "robot": found.full, "revoked": True}
    print_result(as_json, answer, f"{text} no longer has a right of its own on {found.full}.")


@right.command("list", epilog=examples("switchboard right list", "switchboard right list --user ann --json"))
@click.option("--robot", metavar="NAME", help="Only rights on this robot.")
@click.option("--user", metavar="NAME", help="Only rights of this user, including those of their groups.")
@json_option
@pass_app
def list_rights(app: App, robot: str | None, user: str | None, as_json: bool) -> None:
    """List rights as they were granted. Administrators own every robot without an entry."""
    with app.reading() as session:
        rights = queries.list_rights(
            session,
            robot_id=None if robot is None else get_robot(session, robot).id,
            user_id=user_id(session, user),
        )
        realms = {each.id: each.realm for each in queries.list_robots(session)}
    full = [_full(each, realms[each.robot_id]) for each in rights]
    cells = (
        (_text(each), each.robot, str(each.level), " ".join(each.allow), " ".join(each.deny)) for each in full
    )
    print_list(as_json, map(_right_json, full), ("holder", "robot", "level", "allow", "deny"), cells)


def _holder(change: LocalChange, text: str) -> Holder:
    if text.startswith(GROUP_MARK):
        return change.group(text.removeprefix(GROUP_MARK))
    return change.user(text)


def _full(record: queries.RightRecord, robots_realm: str) -> queries.RightRecord:
    """The record with names that are unique in the whole relay."""
    return record._replace(
        robot=full_name(record.robot, robots_realm),
        user=record.user and full_name(record.user, record.realm),
        group=record.group and full_name(record.group, record.realm),
    )


def _text(record: queries.RightRecord) -> str:
    return f"{GROUP_MARK}{record.group}" if record.user is None else record.user


def _right_json(record: queries.RightRecord) -> dict[str, Any]:
    return {
        "holder": _text(record),
        "robot": record.robot,
        "level": str(record.level),
        "allow": list(record.allow),
        "deny": list(record.deny),
    }
