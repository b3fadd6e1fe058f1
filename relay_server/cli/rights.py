"""``switchboard right``."""

from __future__ import annotations

from typing import Any

import click

from relay_db import queries
from relay_protocol.errors import Invalid
from relay_protocol.realms import full_name
from relay_protocol.rights import Level
from relay_server.cli.app import App, LocalChange, examples, json_option, pass_app, robot_of, user_of
from relay_server.cli.output import show, tell
from relay_server.realms.changes import GROUP_MARK, Holder, holder_text


@click.group()
def right() -> None:
    """Say who may do what on which robot."""


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
@click.option("--allow", metavar="PATTERN", multiple=True, help="Allow more: operation:resource. Repeatable.")
@click.option("--deny", metavar="PATTERN", multiple=True, help="Deny in spite of the rest. Repeatable.")
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
    """Give USER or GROUP a right on ROBOT, which is of their realm too; it replaces the one they have there.

    A viewer may subscribe, an operator also publish and call, an owner do everything. Patterns are
    operation:resource with subscribe, view, record, publish, call, provide, manage or *, and wildcards in the
    resource.
    """
    with app.change() as change:
        found, whose = change.robot(robot), _holder(change, holder)
        change.grant(found, whose, level, allow, deny)
    text = holder_text(whose)
    told = {"holder": text, "robot": found.full, "level": level, "allow": list(allow), "deny": list(deny)}
    tell(as_json, told, f"{text} is {level} on {found.full}.")


@right.command(epilog=examples("switchboard right revoke ann rover"))
@click.argument("holder", metavar="USER|@GROUP")
@click.argument("robot")
@json_option
@pass_app
def revoke(app: App, holder: str, robot: str, as_json: bool) -> None:
    """Take the right of USER or GROUP on ROBOT away; what is open is cut at once."""
    with app.change() as change:
        found, whose = change.robot(robot), _holder(change, holder)
        text = holder_text(whose)
        if not change.revoke(found, whose):
            raise Invalid(f"{text} has no right of its own on {found.full}")
    answer = {"holder": text, "robot": found.full, "revoked": True}
    tell(as_json, answer, f"{text} has no right of its own on {found.full} any more.")


@right.command("list", epilog=examples("switchboard right list", "switchboard right list --user ann --json"))
@click.option("--robot", metavar="NAME", help="Only rights on this robot.")
@click.option("--user", metavar="NAME", help="Only rights of this user, also through groups.")
@json_option
@pass_app
def list_(app: App, robot: str | None, user: str | None, as_json: bool) -> None:
    """List rights as they were given. Administrators are owners everywhere without one."""
    with app.reading() as session:
        rights = queries.list_rights(
            session,
            robot_id=None if robot is None else robot_of(session, robot).id,
            user_id=None if user is None else user_of(session, user).id,
        )
        realms = {each.id: each.realm for each in queries.list_robots(session)}
    full = [_full(each, realms[each.robot_id]) for each in rights]
    cells = (
        (_text(each), each.robot, str(each.level), " ".join(each.allow), " ".join(each.deny)) for each in full
    )
    show(as_json, map(_json, full), ("holder", "robot", "level", "allow", "deny"), cells)


def _holder(change: LocalChange, text: str) -> Holder:
    if text.startswith(GROUP_MARK):
        return change.group(text.removeprefix(GROUP_MARK))
    return change.user(text)


def _full(record: queries.RightRecord, robots_realm: str) -> queries.RightRecord:
    """With names for the whole relay."""
    return record._replace(
        robot=full_name(record.robot, robots_realm),
        user=record.user and full_name(record.user, record.realm),
        group=record.group and full_name(record.group, record.realm),
    )


def _text(record: queries.RightRecord) -> str:
    return f"{GROUP_MARK}{record.group}" if record.user is None else record.user


def _json(record: queries.RightRecord) -> dict[str, Any]:
    return {
        "holder": _text(record),
        "robot": record.robot,
        "level": str(record.level),
        "allow": list(record.allow),
        "deny": list(record.deny),
    }
