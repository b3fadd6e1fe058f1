"""What a rule says, and whether it says so of this alert now. Pure: time is given."""

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
from relay_protocol.text import legible
from relay_protocol.wildcards import see_cheap
from relay_server.alerts import types as kinds
from relay_server.alerts.types import AlertEvent

GROUP_SECONDS = (5.0, 86400.0)
SECRET = (16, 128)
URL = 2048
"""Longest address a rule may have, in characters."""

NOTHING = "none"
"""The least level of quiet hours in which nothing is told."""

DIAGNOSTICS_TOPIC = "/diagnostics"

Time = Annotated[str, Meta(pattern=r"^([01][0-9]|2[0-3]):[0-5][0-9]$")]


class Quiet(msgspec.Struct, frozen=True, forbid_unknown_fields=True, rename={"begin": "from", "end": "to"}):
    """Hours of the day in which only the worst is told."""

    begin: Time
    end: Time
    zone: Annotated[str, Meta(min_length=1, max_length=64)] = "UTC"
    least: str = "error"


class RuleRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A rule as a user asks for it (SPEC section 1.10)."""

    channel: str
    label: Annotated[str, Meta(max_length=255)] = ""
    robots: Annotated[str, Meta(min_length=1, max_length=255)] = "*"
    kinds: Annotated[list[Annotated[str, Meta(max_length=32)]], Meta(max_length=32)] = msgspec.field(
        default_factory=list
    )
    level: str = "warning"
    url: Annotated[str, Meta(max_length=URL)] = ""
    secret: Annotated[str, Meta(max_length=SECRET[1])] = ""
    over: bool = True
    group_s: Annotated[float, Meta(ge=GROUP_SECONDS[0], le=GROUP_SECONDS[1])] = 60.0
    quiet: Quiet | None = None


def check(ask: RuleRequest, channels: Collection[str]) -> None:
    """Whether a rule makes sense; its URL is looked at by who sends.

    :param channels: those there are here
    :raises Invalid: it does not, in words
    """
    if ask.channel not in kinds.CHANNELS:
        raise Invalid(f"'channel' is one of {', '.join(kinds.CHANNELS)}, not '{ask.channel[:32]}'")
    if ask.channel not in channels:
        raise Invalid(f"this relay has no '{ask.channel}'; its administrator can switch it on")
    if ask.level not in kinds.LEVELS:
        raise Invalid(f"'level' is one of {', '.join(kinds.LEVELS)}, not '{ask.level[:32]}'")
    if not all(legible(each) for each in (ask.label, ask.robots, *ask.kinds)):
        raise Invalid("'label', 'robots' and 'kinds' must be printable lines")
    see_cheap(ask.robots)
    if "@" in ask.robots:
        raise Invalid(
            f"'robots' has names of your own realm: '{ask.robots[:64]}' must be written without '@' and a realm"
        )
    if (ask.channel == "portal") == bool(ask.url):
        raise Invalid("'url' says where a message goes; leave it out with the channel 'portal' alone")
    if ask.secret and ask.channel != "webhook":
        raise Invalid("'secret' goes with the channel 'webhook'")
    if ask.secret and not (len(ask.secret) >= SECRET[0] and ask.secret.isprintable()):
        raise Invalid(f"'secret' must have {SECRET[0]} to {SECRET[1]} printable characters")
    if ask.quiet is not None:
        _check_quiet(ask.quiet)


def _check_quiet(quiet: Quiet) -> None:
    if quiet.least not in (*kinds.LEVELS, NOTHING):
        raise Invalid(f"'least' of 'quiet' is one of {', '.join((*kinds.LEVELS, NOTHING))}")
    if quiet.begin == quiet.end:
        raise Invalid("'from' and 'to' of 'quiet' are the same; for never, leave 'quiet' out")
    _zone(quiet.zone)


def _zone(name: str) -> ZoneInfo:
    try:
        return ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        raise Invalid(f"'{name[:64]}' is no time zone this machine knows; write one as Europe/Rome") from None


def as_quiet(kept: dict[str, str] | None) -> Quiet | None:
    """Quiet hours as the table keeps them."""
    return None if kept is None else msgspec.convert(kept, Quiet)


def wants(rule: AlertRuleRecord, alert: AlertRecord, event: AlertEvent, realms: Collection[str]) -> bool:
    """Whether the rule tells of this, now or later.

    :param realms: those that the robot is of
    """
    return (
        # Before all else: names are those of a realm.
        rule.realm in realms
        and fnmatchcase(alert.robot, rule.robots)
        and (not rule.kinds or alert.kind in rule.kinds)
        and kinds.severity(alert.level) >= kinds.severity(rule.level)
        and (rule.over or event is not AlertEvent.OVER)
    )


def quiet_until(rule: AlertRuleRecord, now: float) -> float | None:
    """When the quiet hours end in which this moment lies; ``None`` when it lies in none.

    :param now: Unix seconds
    :returns: Unix seconds
    """
    quiet = as_quiet(rule.quiet)
    if quiet is None:
        return None
    here = datetime.fromtimestamp(now, _zone(quiet.zone))
    clock = here.strftime("%H:%M")
    over_midnight = quiet.begin > quiet.end
    inside = clock >= quiet.begin or clock < quiet.end if over_midnight else quiet.begin <= clock < quiet.end
    if not inside:
        return None
    hour, minute = map(int, quiet.end.split(":"))
    end = here.replace(hour=hour, minute=minute, second=0, microsecond=0)
    if clock >= quiet.end:
        end += timedelta(days=1)
    # Where clocks are put forward over the end, it has passed already.
    return max(end.timestamp(), now + 1.0)


def passes(rule: AlertRuleRecord, alert: AlertRecord, now: float) -> bool:
    """Whether the rule tells of this now, quiet hours or not."""
    quiet = as_quiet(rule.quiet)
    if quiet is None or quiet_until(rule, now) is None:
        return True
    return quiet.least != NOTHING and kinds.severity(alert.level) >= kinds.severity(quiet.least)


def visible(rights: Rules, kind: str, about: str) -> bool:
    """Whether somebody with a right on the robot may know of an alert: not everybody may know topics and addresses."""
    if kind == kinds.DIAGNOSTICS:
        return rights.judge(Operation.SUBSCRIBE, DIAGNOSTICS_TOPIC).allowed
    if kind == kinds.STALE:
        asked = (Operation.SUBSCRIBE, Operation.VIEW)
        return all(rights.judge(each, about).allowed for each in asked)
    if kind == kinds.KEY:
        return rights.judge(Operation.MANAGE, "").allowed
    return True


def shown_url(rule: AlertRuleRecord) -> str:
    """As much of an address as anybody may see: paths and apprise's URLs carry passwords."""
    if rule.channel != "webhook":
        # Apprise reads its URLs in its own ways: they need not be what the standard calls one.
        return f"{rule.url.partition('://')[0]}://…" if rule.url else ""
    parts = urlsplit(rule.url)
    port = f":{parts.port}" if parts.port else ""
    host = f"[{parts.hostname}]" if ":" in (parts.hostname or "") else parts.hostname
    return f"{parts.scheme}://{host}{port}/…"
