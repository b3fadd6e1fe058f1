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
from relay_protocol.realms import full_name, split_name
from relay_server.alerts import rules as alert_rules
from relay_server.alerts import types as kinds
from relay_server.alerts.schemas import AlertSummary
from relay_server.alerts.service import insert_rule
from relay_server.alerts.webhook import parse
from relay_server.cli.app import (
    App,
    confirm,
    examples,
    get_robot,
    json_option,
    number_argument,
    os_user,
    pass_app,
    user_id,
    yes_option,
)
from relay_server.cli.output import format_time, print_list, print_result


@click.group()
def alerts() -> None:
    """Show alerts of robots, and set up notifications."""


@alerts.command(
    "list",
    epilog=examples("switchboard alerts list --open", "switchboard alerts list --robot rover --json"),
)
@click.option("--robot", metavar="NAME", help="Only alerts of this robot.")
@click.option("--open", "only_open", is_flag=True, help="Only alerts that are not over.")
@click.option("--limit", default=100, show_default=True, type=click.IntRange(1, 10_000), help="How many.")
@json_option
@pass_app
def list_(app: App, robot: str | None, only_open: bool, limit: int, as_json: bool) -> None:
    """List alerts, the latest first. Those of the last half second may be missing."""
    with app.reading() as session:
        robot_ids = None if robot is None else [get_robot(session, robot).id]
        records = queries.list_alerts(session, robot_ids, open=True if only_open else None, limit=limit)
    found = [_with_robot_name(each) for each in records]
    cells = (
        (each.id, each.robot, each.level, _kind_text(each), _state(each), format_time(each.last), each.text)
        for each in found
    )
    print_list(
        as_json, map(_alert_json, found), ("id", "robot", "level", "kind", "state", "last", "text"), cells
    )


@alerts.command(epilog=examples("switchboard alerts ack 3f6c0a5d9b1e2c47"))
@click.argument("alert", metavar="ID")
@json_option
@pass_app
def ack(app: App, alert: str, as_json: bool) -> None:
    """Acknowledge the alert ID, so that others see who looks after it."""
    with app.change() as change:
        now = time.time()
        found = _with_robot_name(queries.acknowledge_alert(change.session, alert, f"cli:{os_user()}", now))
        if found.ack_at == now:
            change.audit("alert.acknowledge", f"{found.kind} of {found.robot}", id=found.id)
    print_result(as_json, _alert_json(found), f"{found.ack_by} looks after {found.kind} of {found.robot}.")


@alerts.group()
def rules() -> None:
    """Set up which alerts a user is notified of, and how."""


@rules.command("list", epilog=examples("switchboard alerts rules list --user ann"))
@click.option("--user", metavar="NAME", help="Only rules of this user.")
@json_option
@pass_app
def rules_list(app: App, user: str | None, as_json: bool) -> None:
    """List rules, without addresses and secrets."""
    with app.reading() as session:
        records = queries.list_alert_rules(session, user_id(session, user))
    found = [_with_realm(each) for each in records]
    cells = (
        (
            str(each.id),
            each.user,
            each.robots,
            " ".join(each.kinds) or "all",
            each.level,
            each.channel,
            alert_rules.shown_url(each) or "–",
            _hours(each.quiet),
        )
        for each in found
    )
    columns = ("id", "user", "robots", "kinds", "level", "channel", "to", "quiet")
    print_list(as_json, map(_json, found), columns, cells)


@rules.command(
    "add",
    epilog=examples(
        "switchboard alerts rules add ann --webhook https://hooks.example.org/robots --level error",
        "switchboard alerts rules add ann --portal --robots 'cleaner-*' --quiet 22:00-07:00@Europe/Rome",
        "switchboard alerts rules add ann --apprise < mail-url.txt",
    ),
)
@click.argument("user")
@click.option(
    "--portal", "channel", flag_value="portal", help="Show alerts on the user's pages of the portal."
)
@click.option("--webhook", metavar="URL", help="Post alerts to this address; the secret is printed once.")
@click.option("--apprise", "channel", flag_value="apprise", help="Send alerts by the Apprise URL on stdin.")
@click.option(
    "--robots", default="*", show_default=True, metavar="PATTERN", help="Only alerts of these robots."
)
@click.option("--kind", "only_kinds", multiple=True, help="Only alerts of this kind. Repeatable.")
@click.option("--level", type=click.Choice(kinds.LEVELS), default="warning", show_default=True)
@click.option("--group", default=60.0, show_default=True, help="Least seconds between two messages.")
@click.option("--quiet", metavar="FROM-TO[@ZONE]", help="Hours in which only errors are sent.")
@click.option("--no-end", is_flag=True, help="Do not notify when an alert is over.")
@click.option("--label", default="", help="What the rule is for, one line.")
@json_option
@pass_app
def rules_add(
    app: App,
    user: str,
    channel: str | None,
    webhook: str | None,
    robots: str,
    only_kinds: tuple[str, ...],
    level: str,
    group: float,
    quiet: str | None,
    no_end: bool,
    label: str,
    as_json: bool,
) -> None:
    """Notify USER of alerts from now on, about robots on which they have a right."""
    if (channel is None) == (webhook is None):
        raise Invalid("give one of --portal, --webhook and --apprise")
    fields: dict[str, Any] = {
        "channel": channel or "webhook",
        "label": label,
        "robots": _pattern_in_realm(robots, user),
        "kinds": list(only_kinds),
        "level": level,
        "url": webhook or (_read_url() if channel == "apprise" else ""),
        "secret": secrets.token_urlsafe(32) if webhook else "",
        "notify_end": not no_end,
        "group_s": group,
        "quiet": _quiet(quiet),
    }
    try:
        rule = msgspec.convert(fields, alert_rules.RuleRequest)
    except msgspec.ValidationError as error:
        raise Invalid(f"this is not a valid rule: {error}") from None
    alert_rules.check(rule, kinds.CHANNELS)
    if webhook is not None:
        parse(webhook)
    with app.change() as change:
        record = _with_realm(insert_rule(change.session, change.user(user).id, rule, time.time()))
        change.audit("alert_rule.add", str(record.id), user=record.user, channel=record.channel)
    answer = {**_json(record), **({"secret": rule.secret} if webhook else {})}
    result = [f"Rule {record.id}: {record.user} is notified by {record.channel}."]
    if webhook:
        result.append(f"Secret, not shown again: {rule.secret}")
    print_result(as_json, answer, *result)


@rules.command("remove", epilog=examples("switchboard alerts rules remove 7 --yes"))
@number_argument
@yes_option
@json_option
@pass_app
def rules_remove(app: App, number: int, yes: bool, as_json: bool) -> None:
    """Remove the rule of number ID."""
    confirm(f"Remove rule {number}?", yes)
    with app.change() as change:
        if not queries.remove_alert_rule(change.session, number):
            raise NotFound(f"there is no rule {number}; see 'switchboard alerts rules list'")
        change.audit("alert_rule.remove", str(number))
    print_result(as_json, {"id": number, "removed": True}, f"Removed rule {number}.")


def _read_url() -> str:
    """The URL may contain a password, so it is not an argument."""
    return sys.stdin.readline(alert_rules.MAX_URL + 2).strip()


def _quiet(text: str | None) -> dict[str, str] | None:
    if text is None:
        return None
    hours, _, zone = text.partition("@")
    begin, dash, end = hours.partition("-")
    if not dash:
        raise Invalid(f"'{text}' is not a span of hours; write 22:00-07:00@Europe/Rome")
    return {"from": begin, "to": end, "zone": zone or "UTC"}


def _pattern_in_realm(robots: str, user: str) -> str:
    """A pattern for robots of the user's realm, without the realm.

    :param user: as ``toad@lab1``
    :raises Invalid: it names another realm
    """
    pattern, at, _ = robots.partition("@")
    if at and normalise(split_name(robots)[1]) != normalise(split_name(user)[1]):
        raise Invalid(
            f"'{robots}' are robots of another realm; {user} can be notified only of robots of their own realm"
        )
    return pattern


def _with_robot_name(record: queries.AlertRecord) -> queries.AlertRecord:
    """The alert with the full name of its robot."""
    return record._replace(robot=full_name(record.robot, record.realm))


def _with_realm(record: queries.AlertRuleRecord) -> queries.AlertRuleRecord:
    return record._replace(user=full_name(record.user, record.realm))


def _kind_text(record: queries.AlertRecord) -> str:
    return f"{record.kind} {record.about}".strip()


def _state(record: queries.AlertRecord) -> str:
    if record.over is not None:
        return "over"
    return "open" if record.ack_by is None else f"open, {record.ack_by} looks after it"


def _hours(quiet: dict[str, str] | None) -> str:
    return "–" if quiet is None else f"{quiet['from']}-{quiet['to']} {quiet['zone']}"


def _alert_json(record: queries.AlertRecord) -> dict[str, Any]:
    json: dict[str, Any] = msgspec.to_builtins(AlertSummary.of(record))
    return json


def _json(record: queries.AlertRuleRecord) -> dict[str, Any]:
    row = record._asdict()
    for hidden in ("secret", "user_id", "realm"):
        del row[hidden]
    return {**row, "url": alert_rules.shown_url(record)}
