"""What a rule reports, when it is quiet, and which details may be shown."""

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
    """Unix time of a wall clock in this time zone."""
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
        ({"notify_end": False}, AlertEvent.OVER, False),
        ({"notify_end": False}, AlertEvent.WORSE, True),
        ({"notify_end": True}, AlertEvent.OVER, True),
    ],
)
def test_a_rule_applies_to_its_robots_kinds_and_levels(
    change: dict[str, object], event: AlertEvent, wanted: bool
) -> None:
    assert rules.wants(RULE._replace(**change), ALERT, event, {ALERT.realm}) is wanted  # type: ignore[arg-type]  # its fields


def test_a_rule_does_not_apply_to_robots_of_other_realms() -> None:
    """Their names may be the same. A robot shared with the realm counts as the realm's robot."""
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
    rule = RULE._replace(quiet={"from": "12:00", "to": "13:30", "zone": "Asia/Tokyo", "least": "none"})
    assert rules.quiet_until(rule, at("2026-05-01 12:10", "Asia/Tokyo")) == at(
        "2026-05-01 13:30", "Asia/Tokyo"
    )
    assert rules.quiet_until(rule, at("2026-05-01 12:10")) is None


def test_quiet_hours_end_when_clocks_are_changed() -> None:
    """An end that the change of clocks skips or repeats comes exactly once."""
    spring = RULE._replace(quiet={**NIGHT, "to": "02:30"})
    before = at("2026-03-29 01:59:00")
    end = rules.quiet_until(spring, before)
    assert end is not None
    assert before < end <= before + 2 * 3600
    assert rules.quiet_until(spring, end) is None
    autumn = RULE._replace(quiet={**NIGHT, "to": "07:00"})
    assert rules.quiet_until(autumn, at("2026-10-25 01:00")) == at("2026-10-25 07:00")


@pytest.mark.parametrize(
    ("least", "level", "reported"),
    [
        ("error", "error", True),
        ("error", "warning", False),
        ("warning", "warning", True),
        ("none", "error", False),
    ],
)
def test_the_worst_level_is_sent_in_quiet_hours(least: str, level: str, reported: bool) -> None:
    """Unless the rule forbids it."""
    rule, alert = RULE._replace(quiet={**NIGHT, "least": least}), ALERT._replace(level=level)
    assert rules.passes(rule, alert, at("2026-11-22 23:00")) is reported
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
    """Each channel has the fields it needs."""
    rules.check(ask, CHANNELS)


@pytest.mark.parametrize(
    ("ask", "words"),
    [
        (RuleRequest("pager"), "'channel' must be one of"),
        (RuleRequest("portal", level="fatal"), "'level' must be one of"),
        (RuleRequest("portal", url="https://example.org"), "the channel 'portal' takes none"),
        (RuleRequest("webhook"), "'url' is the address"),
        (RuleRequest("apprise", url="mailtos://x", secret="0123456789abcdef"), "'secret' is only for"),
        (RuleRequest("webhook", url="https://x", secret="short"), "16 to 128"),
        (RuleRequest("webhook", url="https://x", secret="0123456789abcdef\n"), "printable"),
        (RuleRequest("portal", label="a\nb"), "must be printable, each on one line"),
        (RuleRequest("portal", robots="a\x00b"), "must be printable, each on one line"),
        (RuleRequest("portal", robots="r*@lab1"), "write 'r.@lab1' without '@'"),
        (RuleRequest("portal", quiet=Quiet("08:00", "08:00")), "must differ"),
        (RuleRequest("portal", quiet=Quiet("08:00", "09:00", least="all")), "'least'"),
        (
            RuleRequest("portal", quiet=Quiet("08:00", "09:00", "Mars/Olympus")),
            "the time zone '.*' is unknown",
        ),
        (
            RuleRequest("portal", quiet=Quiet("08:00", "09:00", "../../etc/passwd")),
            "the time zone '.*' is unknown",
        ),
        (RuleRequest("portal", quiet=Quiet("08:00", "09:00", "Europe")), "the time zone '.*' is unknown"),
    ],
)
def test_invalid_rules_are_refused_with_a_reason(ask: RuleRequest, words: str) -> None:
    with pytest.raises(Invalid, match=words):
        rules.check(ask, CHANNELS)


def test_a_channel_that_is_switched_off_is_refused() -> None:
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
    """Ranges, clocks and unknown fields are checked while the body is read."""
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
    """Paths and URLs of apprise may contain passwords."""
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
def test_alerts_about_topics_need_the_right_to_subscribe(
    deny: tuple[str, ...], kind: str, about: str, seen: bool
) -> None:
    """Both the topic's name and the alert's text need it."""
    assert rules.visible(Rules([Grant(Level.VIEWER, deny=deny)]), kind, about) is seen
