"""``switchboard alerts``."""

from __future__ import annotations

from typing import Any

import pytest

from relay_db import queries
from relay_db.engine import Database
from relay_server import logs
from relay_server import run as running
from relay_server.config import RelaySettings


@pytest.fixture
def people(cli: Any) -> Any:
    """User ann; robot rover with an open alert and an ended one."""
    cli.ok("user", "add", "ann", "--no-password")
    cli.ok("robot", "add", "rover")
    database = Database(f"sqlite:///{cli.data / 'switchboard.db'}")
    with database.begin() as s:
        robot = queries.find_robot(s, "rover")
        assert robot is not None
        one = queries.AlertRecord(
            "a1",
            robot.id,
            "rover",
            "default",
            "module",
            "arm",
            "error",
            "gone\x1b[2J",
            10.0,
            10.0,
            1,
            1,
            None,
            None,
            None,
        )
        queries.save_alerts(s, [one, one._replace(id="b2", about="leg", over=12.0, last=11.0)])
    database.close()
    return cli


def test_alerts_are_listed_and_acknowledged(people: Any) -> None:
    assert [each["id"] for each in people.json("alerts", "list")] == ["b2", "a1"]
    assert [each["id"] for each in people.json("alerts", "list", "--open", "--robot", "rover")] == ["a1"]
    assert "\x1b" not in people.ok("alerts", "list")
    done = people.json("alerts", "ack", "a1")
    assert done["acknowledged"]["by"].startswith("cli:")
    assert "looks after it" in people.ok("alerts", "list", "--open")
    assert people.json("audit", "list")[-1]["action"] == "alert.acknowledge"
    assert people.json("alerts", "ack", "a1")["acknowledged"] == done["acknowledged"]
    assert [each["action"] for each in people.json("audit", "list")].count("alert.acknowledge") == 1
    assert "no such alert" in people.fails("alerts", "ack", "zz")
    assert "over already" in people.fails("alerts", "ack", "b2")


@pytest.mark.parametrize(
    ("options", "low", "critical"),
    [((), 0.2, 0.1), (("--battery-low", "0"), 0.0, 0.0), (("--battery-critical", "0"), 0.2, 0.0)],
)
def test_alerts_of_batteries_are_switched_off_by_a_low_charge_of_nothing(
    cli: Any, monkeypatch: pytest.MonkeyPatch, options: tuple[str, ...], low: float, critical: float
) -> None:
    """Critical levels do not matter then."""
    began: list[RelaySettings] = []
    monkeypatch.setattr(running, "run", lambda settings, ready: began.append(settings))
    monkeypatch.setattr(logs, "begin", lambda *how, **later: None)
    cli.ok("serve", *options)
    assert (began[0].alerts.battery_low, began[0].alerts.battery_critical) == (low, critical)


def test_networks_are_allowed_and_denied_by_name(cli: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    began: list[RelaySettings] = []
    monkeypatch.setattr(running, "run", lambda settings, ready: began.append(settings))
    monkeypatch.setattr(logs, "begin", lambda *how, **later: None)
    cli.ok("serve", "--webhook-networks", "10.0.0.0/8", "--webhook-deny", "10.0.0.7/32, 2606:2800:21f::/48")
    alerts = began[0].alerts
    assert alerts.webhook_networks == ("10.0.0.0/8",)
    assert alerts.webhook_deny == ("10.0.0.7/32", "2606:2800:21f::/48")


def test_rules_are_added_listed_and_removed(people: Any) -> None:
    """A secret is printed once, an address never again."""
    made = people.json(
        "alerts", "rules", "add", "ann", "--webhook", "https://example.org/secret/path", "--kind", "offline",
        "--robots", "r*", "--level", "error", "--group", "5", "--quiet", "22:00-07:00@Europe/Rome", "--no-end",
    )  # fmt: skip
    assert len(made.pop("secret")) >= 32
    (listed,) = people.json("alerts", "rules", "list", "--user", "ann")
    assert listed == made
    assert (listed["url"], listed["kinds"], listed["notify_end"]) == (
        "https://example.org/…",
        ["offline"],
        False,
    )
    assert listed["quiet"] == {"from": "22:00", "to": "07:00", "zone": "Europe/Rome", "least": "error"}
    url = "mailtos://ann:password@example.org"
    assert "password" not in people.ok("alerts", "rules", "add", "ann", "--apprise", stdin=f"{url}\n")
    people.ok("alerts", "rules", "add", "ann", "--portal")
    shown = people.ok("alerts", "rules", "list")
    assert "mailtos://…" in shown
    assert "password" not in shown + people.ok("audit", "list", "--json")
    people.ok("alerts", "rules", "remove", str(made["id"]), "--yes")
    assert len(people.json("alerts", "rules", "list")) == 2
    assert "no rule" in people.fails("alerts", "rules", "remove", str(made["id"]), "--yes")


def test_a_users_own_realm_is_left_out_of_the_robots_of_a_rule(people: Any) -> None:
    """Any spelling of the realm works. The pattern matches names as seen in that realm."""
    people.ok("realm", "add", "lab1")
    people.ok("user", "add", "ann@lab1", "--no-password")
    for user, robots in (("ann", "r*@default"), ("ann@lab1", "r*@LAB1"), ("ann@lab1", "r*")):
        made = people.json("alerts", "rules", "add", user, "--portal", "--robots", robots)
        assert made["robots"] == "r*"
    assert "another realm" in people.fails(
        "alerts", "rules", "add", "ann@lab1", "--portal", "--robots", "r*@default"
    )


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--portal", "--robots", "r*@lab1"), "'r*@lab1' are robots of another realm"),
        (("--portal", "--robots", "@default"), "this is not a valid rule"),
        ((), "give one of"),
        (("--portal", "--webhook", "https://example.org"), "give one of"),
        (("--webhook", "ftp://example.org"), "webhook's 'url'"),
        (("--portal", "--quiet", "night"), "is not a span of hours"),
        (("--portal", "--quiet", "22:00-07:00@Mars"), "is unknown"),
        (("--portal", "--quiet", "22-7"), "this is not a valid rule"),
        (("--portal", "--group", "1"), "this is not a valid rule"),
    ],
)
def test_invalid_rules_are_refused_with_a_reason(people: Any, options: tuple[str, ...], words: str) -> None:
    assert words in people.fails("alerts", "rules", "add", "ann", *options)
    assert people.json("alerts", "rules", "list") == []
