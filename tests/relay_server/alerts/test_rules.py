"""What a rule tells, when it is quiet, and what of it may be seen."""

from __future__ import annotations

from datetime import datetime
from zoneinfo import ZoneInfo

import msgspec
import pytest

from relay_db.queries import AlertRecord, AlertRuleRecord
from relay_protocol.errors import Invalid
from relay_protocol.rights import Grant, Level, Rules
from relay_server.alerts import rules
from relay_server.alerts.rules import Quiet, RuleRequest
from relay_server.alerts.types import AlertEvent

ALERT = AlertRecord(
    "a1", 1, "cleaner-7", "default", "battery", "", "warning", "low", 1.0, 1.0, 1, 1, None, None, None
)
RULE = AlertRuleRecord(
    1, 7, "ann", "default", "", "*", (), "warning", "webhook", "https://example.org/hook?key=1", "s" * 32,
    True, 60.0, None, 1.0,
)  # fmt: skip
NIGHT = {"from": "22:00", "to": "07:00", "zone": "Europe/Rome", "least": "error"}
CHANNELS = ("portal", "webhook", "apprise")


def at(text: str, zone: str = "Europe/Rome") -> float:
    """Unix time of a clock on a wall there."""
    return datetime.fromisoformat(text).replace(tzinfo=ZoneInfo(zone)).timestamp()


@pytest.mark.parametrize(
    ("change", "event", "wanted"),
    [
        ({}, AlertEvent.BEGUN, True),
        ({"robots": "cleaner-*"}, AlertEvent.BEGUN, True),
        ({"robots": "Cleaner-*"}, AlertEvent.BEGUN, False),
        ({"robots": "cleaner"}, AlertEvent.BEGUN, False),
        ({"kinds": ("offline", "battery")}, AlertEvent.BEGUN, True),
        ({"kinds": ("offline",)}, AlertEvent.BEGUN, False),
        ({"level": "error"}, AlertEvent.BEGUN, False),
        ({"level": "info"}, AlertEvent.BEGUN, True),
        ({"over": False}, AlertEvent.OVER, False),
        ({"over": False}, AlertEvent.WORSE, True),
        ({"over": True}, AlertEvent.OVER, True),
    ],
)
def test_a_rule_tells_what_it_is_for(change: dict[str, object], event: AlertEvent, wanted: bool) -> None:
    """By robot, kind, level, and whether it is over."""
    assert rules.wants(RULE._replace(**change), ALERT, event, {ALERT.realm}) is wanted  # type: ignore[arg-type]  # its fields


def test_a_rule_tells_nothing_of_another_realms_robots() -> None:
    """Their names may be the same; one that is shared with its realm is one of it."""
    theirs = RULE._replace(realm="lab1", robots="cleaner-7")
    assert not rules.wants(theirs, ALERT, AlertEvent.BEGUN, {ALERT.realm})
    assert rules.wants(theirs, ALERT, AlertEvent.BEGUN, {ALERT.realm, "lab1"})


@pytest.mark.parametrize(
    ("now", "end"),
    [
        ("2026-11-22 21:59:59", None),
        ("2026-11-22 22:00:00", "2026-11-23 07:00"),
        ("2026-11-22 23:59:00", "2026-11-23 07:00"),
        ("2026-11-23 00:00:00", "2026-11-23 07:00"),
        ("2026-11-23 06:59:59", "2026-11-23 07:00"),
        ("2026-11-23 07:00:00", None),
        ("2026-12-31 22:30:00", "2027-01-01 07:00"),
    ],
)
def test_quiet_hours_may_go_over_midnight(now: str, end: str | None) -> None:
    """They begin with their first minute and end before their last."""
    rule = RULE._replace(quiet=NIGHT)
    assert rules.quiet_until(rule, at(now)) == (None if end is None else at(end))


def test_quiet_hours_within_a_day_are_of_the_rules_zone() -> None:
    """Noon in Tokyo is not noon in Rome."""
    rule = RULE._replace(quiet={"from": "12:00", "to": "13:30", "zone": "Asia/Tokyo", "least": "none"})
    assert rules.quiet_until(rule, at("2026-05-01 12:10", "Asia/Tokyo")) == at(
        "2026-05-01 13:30", "Asia/Tokyo"
    )
    assert rules.quiet_until(rule, at("2026-05-01 12:10")) is None


def test_quiet_hours_end_when_clocks_are_changed() -> None:
    """An end that does not exist that night, or exists twice, comes all the same, and only once."""
    spring = RULE._replace(quiet={**NIGHT, "to": "02:30"})
    before = at("2026-03-29 01:59:00")
    end = rules.quiet_until(spring, before)
    assert end is not None
    assert before < end <= before + 2 * 3600
    assert rules.quiet_until(spring, end) is None
    autumn = RULE._replace(quiet={**NIGHT, "to": "07:00"})
    assert rules.quiet_until(autumn, at("2026-10-25 01:00")) == at("2026-10-25 07:00")


@pytest.mark.parametrize(
    ("least", "level", "told"),
    [
        ("error", "error", True),
        ("error", "warning", False),
        ("warning", "warning", True),
        ("none", "error", False),
    ],
)
def test_the_worst_is_told_in_quiet_hours_too(least: str, level: str, told: bool) -> None:
    """Unless nothing is to be."""
    rule, alert = RULE._replace(quiet={**NIGHT, "least": least}), ALERT._replace(level=level)
    assert rules.passes(rule, alert, at("2026-11-22 23:00")) is told
    assert rules.passes(rule, alert, at("2026-11-22 12:00"))


@pytest.mark.parametrize(
    "ask",
    [
        RuleRequest("portal"),
        RuleRequest("webhook", url="https://example.org"),
        RuleRequest("webhook", url="https://example.org", secret="0123456789abcdef"),
        RuleRequest("apprise", url="mailtos://example.org", quiet=Quiet("22:00", "07:00", "Europe/Rome")),
        RuleRequest("portal", quiet=Quiet("00:00", "23:59")),
    ],
)
def test_rules_that_make_sense_are_taken(ask: RuleRequest) -> None:
    """Each channel has what it needs."""
    rules.check(ask, CHANNELS)


@pytest.mark.parametrize(
    ("ask", "words"),
    [
        (RuleRequest("pager"), "'channel' is one of"),
        (RuleRequest("portal", level="fatal"), "'level' is one of"),
        (RuleRequest("portal", url="https://example.org"), "leave it out with the channel 'portal'"),
        (RuleRequest("webhook"), "'url' says where"),
        (RuleRequest("apprise", url="mailtos://x", secret="0123456789abcdef"), "'secret' goes with"),
        (RuleRequest("webhook", url="https://x", secret="short"), "16 to 128"),
        (RuleRequest("webhook", url="https://x", secret="0123456789abcdef\n"), "printable"),
        (RuleRequest("portal", label="a\nb"), "printable lines"),
        (RuleRequest("portal", robots="a\x00b"), "printable lines"),
        (RuleRequest("portal", robots="r*@lab1"), "'r.@lab1' must be written without '@'"),
        (RuleRequest("portal", quiet=Quiet("08:00", "08:00")), "are the same"),
        (RuleRequest("portal", quiet=Quiet("08:00", "09:00", least="all")), "'least'"),
        (RuleRequest("portal", quiet=Quiet("08:00", "09:00", "Mars/Olympus")), "no time zone"),
        (RuleRequest("portal", quiet=Quiet("08:00", "09:00", "../../etc/passwd")), "no time zone"),
        (RuleRequest("portal", quiet=Quiet("08:00", "09:00", "Europe")), "no time zone"),
    ],
)
def test_rules_that_make_none_are_refused_in_words(ask: RuleRequest, words: str) -> None:
    """Each says what is wrong."""
    with pytest.raises(Invalid, match=words):
        rules.check(ask, CHANNELS)


def test_a_channel_that_is_switched_off_is_refused() -> None:
    """Whoever asks is told who can switch it on."""
    with pytest.raises(Invalid, match="administrator"):
        rules.check(RuleRequest("apprise", url="mailtos://x"), ("portal", "webhook"))


@pytest.mark.parametrize(
    "body",
    [
        b'{"channel":"portal","group_s":1}',
        b'{"channel":"portal","group_s":1e9}',
        b'{"channel":"portal","quiet":{"from":"24:00","to":"07:00"}}',
        b'{"channel":"portal","quiet":{"from":"7:00","to":"08:00"}}',
        b'{"channel":"portal","robots":""}',
        b'{"channel":"portal","user":"bob"}',
        b'{"url":"https://x"}',
    ],
)
def test_bodies_of_another_form_are_refused(body: bytes) -> None:
    """Ranges, clocks and unknown fields are judged as they are read."""
    with pytest.raises(msgspec.ValidationError):
        msgspec.json.decode(body, type=RuleRequest)


@pytest.mark.parametrize(
    ("channel", "url", "shown"),
    [
        ("webhook", "https://example.org/hook/secret?key=1", "https://example.org/…"),
        ("webhook", "http://[2001:db8::1]:8080/x", "http://[2001:db8::1]:8080/…"),
        ("apprise", "mailtos://ann:password@example.org?to=x", "mailtos://…"),
        ("apprise", "slack://[general/password", "slack://…"),
        ("portal", "", ""),
    ],
)
def test_of_an_address_nothing_is_shown_that_could_be_secret(channel: str, url: str, shown: str) -> None:
    """Paths and apprise's URLs carry passwords."""
    assert rules.shown_url(RULE._replace(channel=channel, url=url)) == shown


@pytest.mark.parametrize(
    ("deny", "kind", "about", "seen"),
    [
        ((), "stale", "/scan", True),
        (("subscribe:/scan",), "stale", "/scan", False),
        (("view:/cam*",), "stale", "/cam/image", False),
        (("subscribe:/scan",), "offline", "", True),
        (("subscribe:/diagnostics",), "diagnostics", "motor", False),
        (("subscribe:/diagnostics",), "module", "camera", True),
    ],
)
def test_who_may_not_hear_a_topic_does_not_hear_of_it(
    deny: tuple[str, ...], kind: str, about: str, seen: bool
) -> None:
    """Its name is not for everybody, nor what it says."""
    assert rules.visible(Rules([Grant(Level.VIEWER, deny=deny)]), kind, about) is seen
