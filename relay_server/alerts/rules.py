"""Rules by which users are notified of alerts: their checks, and whether one applies to an alert now. Pure."""

from __future__ import annotations

from collections.abc import Collection
from datetime import datetime, timedelta
from fnmatch import fnmatchcase
from typing import Annotated
from urllib.parse import urlsplit
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import msgspec
from msgspec import Meta

from relay_db.queries import AlertRecord, AlertRuleRecord
from relay_protocol.errors import Invalid
from relay_protocol.rights import Operation, Rules
from relay_protocol.text import is_printable
from relay_protocol.wildcards import check_pattern
from relay_server.alerts import types as kinds
from relay_server.alerts.types import AlertEvent

GROUP_SECONDS = (5.0, 86400.0)
"""Shortest and longest time between two messages of a rule."""

SECRET = (16, 128)
"""Fewest and most characters of a webhook's secret."""

MAX_URL = 2048
"""Longest address of a rule, in characters."""

NOTHING = "none"
"""The ``least`` of quiet hours in which no message is sent at all."""

DIAGNOSTICS_TOPIC = "/diagnostics"

Time = Annotated[str, Meta(pattern=r"^([01][0-9]|2[0-3]):[0-5][0-9]$")]


class Quiet(msgspec.Struct, frozen=True, forbid_unknown_fields=True, rename={"begin": "from", "end": "to"}):
    """Hours of the day in which only alerts of a high level are sent.

    :param zone: a time zone as ``Europe/Rome``
    :param least: the mildest level that is sent, or ``none``
    """

    begin: Time
    end: Time
    zone: Annotated[str, Meta(min_length=1, max_length=64)] = "UTC"
    least: str = "error"


class RuleRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A rule as a user requests it (SPEC 1.10).

    :param robots: pattern of names in the user's realm
    :param kinds: empty for all
    :param level: the mildest level that is sent
    :param notify_end: whether ends of alerts are sent too
    :param group_s: least seconds between two messages
    """

    channel: str
    label: Annotated[str, Meta(max_length=255)] = ""
    robots: Annotated[str, Meta(min_length=1, max_length=255)] = "*"
    kinds: Annotated[list[Annotated[str, Meta(max_length=32)]], Meta(max_length=32)] = msgspec.field(
        default_factory=list
    )
    level: str = "warning"
    url: Annotated[str, Meta(max_length=MAX_URL)] = ""
    secret: Annotated[str, Meta(max_length=SECRET[1])] = ""
    notify_end: bool = True
    group_s: Annotated[float, Meta(ge=GROUP_SECONDS[0], le=GROUP_SECONDS[1])] = 60.0
    quiet: Quiet | None = None


def check(request: RuleRequest, channels: Collection[str]) -> None:
    """Check a rule, except its URL, which the transport checks.

    :param channels: the channels of this relay
    :raises Invalid: a field is not valid, or two contradict each other
    """
    if request.channel not in kinds.CHANNELS:
        raise Invalid(f"'channel' must be one of {', '.join(kinds.CHANNELS)}, not '{request.channel[:32]}'")
    if request.channel not in channels:
        raise Invalid(
            f"this relay does not offer the channel '{request.channel}'; its administrator can switch it on"
        )
    if request.level not in kinds.LEVELS:
        raise Invalid(f"'level' must be one of {', '.join(kinds.LEVELS)}, not '{request.level[:32]}'")
    if not all(is_printable(each) for each in (request.label, request.robots, *request.kinds)):
        raise Invalid("'label', 'robots' and 'kinds' must be printable, each on one line")
    check_pattern(request.robots)
    if "@" in request.robots:
        raise Invalid(
            f"'robots' is a pattern of names in your own realm: write '{request.robots[:64]}' without '@' and a realm"
        )
    if (request.channel == "portal") == bool(request.url):
        raise Invalid(
            "'url' is the address that messages go to: the channel 'portal' takes none, the others need one"
        )
    if request.secret and request.channel != "webhook":
        raise Invalid("'secret' is only for the channel 'webhook'; leave it out")
    if request.secret and not (len(request.secret) >= SECRET[0] and request.secret.isprintable()):
        raise Invalid(f"'secret' must have {SECRET[0]} to {SECRET[1]} printable characters")
    if request.quiet is not None:
        _check_quiet(request.quiet)


def _check_quiet(quiet: Quiet) -> None:
    if quiet.least not in (*kinds.LEVELS, NOTHING):
        raise Invalid(f"'least' of 'quiet' must be one of {', '.join((*kinds.LEVELS, NOTHING))}")
    if quiet.begin == quiet.end:
        raise Invalid("'from' and 'to' of 'quiet' must differ; leave 'quiet' out for no quiet hours")
    _zone(quiet.zone)


def _zone(name: str) -> ZoneInfo:
    try:
        return ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        raise Invalid(f"the time zone '{name[:64]}' is unknown; write one as Europe/Rome") from None


def quiet_hours(rule: AlertRuleRecord) -> Quiet | None:
    """The quiet hours of a stored rule."""
    return None if rule.quiet is None else msgspec.convert(rule.quiet, Quiet)


def wants(rule: AlertRuleRecord, alert: AlertRecord, event: AlertEvent, realms: Collection[str]) -> bool:
    """Whether the rule applies to this event of an alert, in quiet hours or not.

    :param realms: the realms of the robot
    """
    return (
        # First of all: names of robots are unique only within a realm.
        rule.realm in realms
        and fnmatchcase(alert.robot, rule.robots)
        and (not rule.kinds or alert.kind in rule.kinds)
        and kinds.severity(alert.level) >= kinds.severity(rule.level)
        and (rule.notify_end or event is not AlertEvent.OVER)
    )


def quiet_until(rule: AlertRuleRecord, now: float) -> float | None:
    """The end of the quiet hours (Unix seconds); ``None`` outside them.

    :param now: Unix seconds
    """
    quiet = quiet_hours(rule)
    if quiet is None:
        return None
    local = datetime.fromtimestamp(now, _zone(quiet.zone))
    clock = local.strftime("%H:%M")
    over_midnight = quiet.begin > quiet.end
    inside = clock >= quiet.begin or clock < quiet.end if over_midnight else quiet.begin <= clock < quiet.end
    if not inside:
        return None
    hour, minute = map(int, quiet.end.split(":"))
    end = local.replace(hour=hour, minute=minute, second=0, microsecond=0)
    if clock >= quiet.end:
        end += timedelta(days=1)
    # Where summer time begins within the quiet hours, their end may have passed already.
    return max(end.timestamp(), now + 1.0)


def passes(rule: AlertRuleRecord, alert: AlertRecord, now: float) -> bool:
    """Whether the rule sends an alert now, judged by its quiet hours only."""
    quiet = quiet_hours(rule)
    if quiet is None or quiet_until(rule, now) is None:
        return True
    return quiet.least != NOTHING and kinds.severity(alert.level) >= kinds.severity(quiet.least)


def visible(rights: Rules, kind: str, about: str) -> bool:
    """Whether a user with these rights on the robot may see an alert: some name topics, some network addresses."""
    if kind == kinds.DIAGNOSTICS:
        return rights.decide(Operation.SUBSCRIBE, DIAGNOSTICS_TOPIC).allowed
    if kind == kinds.STALE:
        return all(rights.decide(each, about).allowed for each in (Operation.SUBSCRIBE, Operation.VIEW))
    if kind == kinds.KEY:
        return rights.decide(Operation.MANAGE, "").allowed
    return True


def shown_url(rule: AlertRuleRecord) -> str:
    """Scheme and host of an address, for display: paths and Apprise URLs can contain passwords."""
    if rule.channel != "webhook":
        # Apprise parses its URLs in its own ways, so they need not be URLs by the standard.
        return f"{rule.url.partition('://')[0]}://…" if rule.url else ""
    parts = urlsplit(rule.url)
    port = f":{parts.port}" if parts.port else ""
    host = f"[{parts.hostname}]" if ":" in (parts.hostname or "") else parts.hostname
    return f"{parts.scheme}://{host}{port}/…"
