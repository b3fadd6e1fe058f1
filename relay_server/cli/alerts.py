"""``switchboard alerts``."""

from __future__ import annotations

import secrets
import sys
import time
from typing import Any

import click
import msgspec

from relay_db import queries
from relay_db.names import normalise
from relay_protocol.errors import Invalid, NotFound
from relay_protocol.realms import full_name, parted
from relay_server.alerts import rules as wording
from relay_server.alerts import types as kinds
from relay_server.alerts.message import view
from relay_server.alerts.service import keep
from relay_server.alerts.webhook import parse
from relay_server.cli.app import (
    App,
    examples,
    json_option,
    os_user,
    pass_app,
    robot_of,
    sure,
    user_of,
    yes_option,
)
from relay_server.cli.output import moment, show, tell


@click.group()
def alerts() -> None:
    """Show what people should know of robots, and say who is told how."""


@alerts.command(
    "list",
    epilog=examples("switchboard alerts list --open", "switchboard alerts list --robot rover --json"),
)
@click.option("--robot", metavar="NAME", help="Only of this robot.")
@click.option("--open", "lasting", is_flag=True, help="Only those that last.")
@click.option("--limit", default=100, show_default=True, type=click.IntRange(1, 10_000), help="How many.")
@json_option
@pass_app
def list_(app: App, robot: str | None, lasting: bool, limit: int, as_json: bool) -> None:
    """List alerts, the latest first. Those of the last half second may be missing."""
    with app.reading() as session:
        wanted = None if robot is None else [robot_of(session, robot).id]
        kept = queries.list_alerts(session, wanted, open=True if lasting else None, limit=limit)
    found = [_named(each) for each in kept]
    cells = (
        (each.id, each.robot, each.level, _what(each), _state(each), moment(each.last), each.text)
        for each in found
    )
    show(as_json, map(view, found), ("id", "robot", "level", "kind", "state", "last", "text"), cells)


@alerts.command(epilog=examples("switchboard alerts ack 3f6c0a5d9b1e2c47"))
@click.argument("alert", metavar="ID")
@json_option
@pass_app
def ack(app: App, alert: str, as_json: bool) -> None:
    """Say that somebody looks after the alert ID."""
    with app.change() as change:
        now = time.time()
        found = _named(queries.acknowledge_alert(change.session, alert, f"cli:{os_user()}", now))
        if found.ack_at == now:
            change.audit("alert.acknowledge", f"{found.kind} of {found.robot}", id=found.id)
    tell(as_json, view(found), f"{found.ack_by} looks after {found.kind} of {found.robot}.")


@alerts.group()
def rules() -> None:
    """Say which alerts a user is told of, and how."""


@rules.command("list", epilog=examples("switchboard alerts rules list --user ann"))
@click.option("--user", metavar="NAME", help="Only rules of this user.")
@json_option
@pass_app
def rules_list(app: App, user: str | None, as_json: bool) -> None:
    """List rules, without addresses and secrets."""
    with app.reading() as session:
        kept = queries.list_alert_rules(session, None if user is None else user_of(session, user).id)
    found = [_with_realm(each) for each in kept]
    cells = (
        (
            str(each.id),
            each.user,
            each.robots,
            " ".join(each.kinds) or "all",
            each.level,
            each.channel,
            wording.shown_url(each) or "–",
            _hours(each.quiet),
        )
        for each in found
    )
    columns = ("id", "user", "robots", "kinds", "level", "channel", "to", "quiet")
    show(as_json, map(_json, found), columns, cells)


@rules.command(
    "add",
    epilog=examples(
        "switchboard alerts rules add ann --webhook https://hooks.example.org/robots --level error",
        "switchboard alerts rules add ann --portal --robots 'cleaner-*' --quiet 22:00-07:00@Europe/Rome",
        "switchboard alerts rules add ann --apprise < mail-url.txt",
    ),
)
@click.argument("user")
@click.option("--portal", "channel", flag_value="portal", help="Show them on the user's pages.")
@click.option("--webhook", metavar="URL", help="Post them to this address; the secret is printed once.")
@click.option("--apprise", "channel", flag_value="apprise", help="Send them by the URL on stdin.")
@click.option("--robots", default="*", show_default=True, metavar="PATTERN", help="Of which robots.")
@click.option("--kind", "wanted", multiple=True, help="Only this kind. Repeatable.")
@click.option("--level", type=click.Choice(kinds.LEVELS), default="warning", show_default=True)
@click.option("--group", default=60.0, show_default=True, help="Least seconds between two messages.")
@click.option("--quiet", metavar="FROM-TO[@ZONE]", help="Hours in which only errors are told.")
@click.option("--no-over", is_flag=True, help="Don't tell that one is over.")
@click.option("--label", default="", help="What it is for, one line.")
@json_option
@pass_app
def rules_add(
    app: App,
    user: str,
    channel: str | None,
    webhook: str | None,
    robots: str,
    wanted: tuple[str, ...],
    level: str,
    group: float,
    quiet: str | None,
    no_over: bool,
    label: str,
    as_json: bool,
) -> None:
    """Tell USER of alerts from now on, of robots on which he has a right."""
    if (channel is None) == (webhook is None):
        raise Invalid("give one of --portal, --webhook and --apprise")
    fields: dict[str, Any] = {
        "channel": channel or "webhook",
        "label": label,
        "robots": _own(robots, user),
        "kinds": list(wanted),
        "level": level,
        "url": webhook or (_piped() if channel == "apprise" else ""),
        "secret": secrets.token_urlsafe(32) if webhook else "",
        "over": not no_over,
        "group_s": group,
        "quiet": _quiet(quiet),
    }
    try:
        ask = msgspec.convert(fields, wording.RuleRequest)
    except msgspec.ValidationError as error:
        raise Invalid(f"this is no rule: {error}") from None
    wording.check(ask, kinds.CHANNELS)
    if webhook is not None:
        parse(webhook)
    with app.change() as change:
        record = _with_realm(keep(change.session, change.user(user).id, ask, time.time()))
        change.audit("alert_rule.add", str(record.id), user=record.user, channel=record.channel)
    answer = {**_json(record), **({"secret": ask.secret} if webhook else {})}
    told = [f"Rule {record.id}: {record.user} is told by {record.channel}."]
    if webhook:
        told.append(f"Secret, not shown again: {ask.secret}")
    tell(as_json, answer, *told)


@rules.command("remove", epilog=examples("switchboard alerts rules remove 7 --yes"))
@click.argument("number", metavar="ID", type=click.IntRange(min=1, max=2**31 - 1))
@yes_option
@json_option
@pass_app
def rules_remove(app: App, number: int, yes: bool, as_json: bool) -> None:
    """Tell nobody by the rule of number ID any more."""
    sure(f"Remove rule {number}?", yes)
    with app.change() as change:
        if not queries.remove_alert_rule(change.session, number):
            raise NotFound(f"there is no rule {number}; see 'switchboard alerts rules list'")
        change.audit("alert_rule.remove", str(number))
    tell(as_json, {"id": number, "removed": True}, f"Removed rule {number}.")


def _piped() -> str:
    """A URL that may hold a password, and so is no argument."""
    return sys.stdin.readline(wording.URL + 2).strip()


def _quiet(text: str | None) -> dict[str, str] | None:
    if text is None:
        return None
    hours, _, zone = text.partition("@")
    begin, dash, end = hours.partition("-")
    if not dash:
        raise Invalid(f"'{text}' are no hours; write 22:00-07:00@Europe/Rome")
    return {"from": begin, "to": end, "zone": zone or "UTC"}


def _own(robots: str, user: str) -> str:
    """A pattern of robots of the user's realm, as it is written there.

    :param user: as ``toad@lab1``
    :raises Invalid: it is of another realm
    """
    pattern, at, _ = robots.partition("@")
    if at and normalise(parted(robots)[1]) != normalise(parted(user)[1]):
        raise Invalid(f"'{robots}' are robots of another realm; {user} is told only of those of his own")
    return pattern


def _named(record: queries.AlertRecord) -> queries.AlertRecord:
    """An alert with the name that its robot has for the whole relay."""
    return record._replace(robot=full_name(record.robot, record.realm))


def _with_realm(record: queries.AlertRuleRecord) -> queries.AlertRuleRecord:
    return record._replace(user=full_name(record.user, record.realm))


def _what(record: queries.AlertRecord) -> str:
    return f"{record.kind} {record.about}".strip()


def _state(record: queries.AlertRecord) -> str:
    if record.over is not None:
        return "over"
    return "open" if record.ack_by is None else f"open, {record.ack_by} looks after it"


def _hours(quiet: dict[str, str] | None) -> str:
    return "–" if quiet is None else f"{quiet['from']}-{quiet['to']} {quiet['zone']}"


def _json(record: queries.AlertRuleRecord) -> dict[str, Any]:
    row = record._asdict()
    for hidden in ("secret", "user_id", "realm"):
        del row[hidden]
    return {**row, "url": wording.shown_url(record)}
