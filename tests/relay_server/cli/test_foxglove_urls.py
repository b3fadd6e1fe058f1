"""``switchboard foxglove-url``."""

from __future__ import annotations

from typing import Any

import pytest


@pytest.fixture
def rover(cli: Any) -> Any:
    """The command line, with a user and a robot."""
    cli.ok("user", "add", "ann", "--no-password")
    cli.json("robot", "add", "rover")
    cli.ok("right", "grant", "ann", "rover", "operator")
    return cli


def test_a_url_is_shown_once_listed_without_its_token_and_revoked(rover: Any) -> None:
    made = rover.json(
        "foxglove-url", "create", "rover", "ann", "--ttl", "8h", "--relay", "https://relay.example"
    )
    assert made["url"].startswith("wss://relay.example/robots/rover?token=swb_")
    assert (made["level"], made["expires_in"], made["user"]) == ("viewer", 8 * 3600, "ann")
    token = made["url"].partition("token=")[2]
    (listed,) = rover.json("foxglove-url", "list", "--robot", "rover", "--user", "ann")
    assert (listed["id"], listed["robot"], listed["level"]) == (made["id"], "rover", "viewer")
    for words in (("foxglove-url", "list"), ("audit", "list", "--json"), ("token", "list", "--json")):
        assert token not in rover.ok(*words)
    assert rover.json("foxglove-url", "revoke", str(made["id"]))["revoked"]
    assert rover.json("foxglove-url", "list") == []
    assert "no Foxglove URL" in rover.fails("foxglove-url", "revoke", str(made["id"]))


def test_the_maker_of_a_viewers_url_reads_how_to_make_one_that_drives(rover: Any) -> None:
    advice = "It can watch, but not drive. A URL that drives needs --level operator."
    create = ("foxglove-url", "create", "rover", "ann")
    assert advice in rover(*create).stderr
    assert advice not in rover(*create, "--level", "operator").stderr


LOCAL = "ws://127.0.0.1:9090/robots/rover?token="
ONLY_HERE = "It works only on this machine. For others give --relay with the relay's address"


def _create(cli: Any, *options: str) -> Any:
    cli.user("eve", "--admin")
    cli.json("robot", "add", "tank")
    return cli("foxglove-url", "create", "tank", "eve", *options)


def test_a_url_for_this_machine_alone_is_named_as_such(cli: Any) -> None:
    made = _create(cli)
    assert made.stdout.startswith(LOCAL.replace("rover", "tank"))
    assert ONLY_HERE in made.stderr


@pytest.mark.parametrize(
    ("answer", "options", "base", "local"),
    [
        (b'{"url": "https://robots.example:8443"}', (), "wss://robots.example:8443", False),
        (b'{"url": "http://127.0.0.1:8080"}', (), "ws://127.0.0.1:8080", True),
        (b'{"url": "https://robots.example"}', ("--relay", "ws://[::1]:9"), "ws://[::1]:9", True),
        (b"{}", ("--relay", "wss://relay.example"), "wss://relay.example", False),
    ],
)
def test_a_url_has_the_address_of_the_running_relay_or_the_one_that_is_given(
    live: Any, relay: Any, answer: bytes, options: tuple[str, ...], base: str, local: bool
) -> None:
    relay.answer = (200, answer)
    made = _create(live, *options)
    assert made.stdout.startswith(f"{base}/robots/tank?token=")
    assert (ONLY_HERE in made.stderr) == local


def test_a_url_needs_a_right_of_its_user_and_that_level(cli: Any) -> None:
    cli.ok("user", "add", "ann", "--no-password")
    cli.json("robot", "add", "rover")
    create = ("foxglove-url", "create", "rover", "ann", "--level")
    assert "a URL needs a right on the robot; user 'ann' is without one" in cli.fails(*create, "viewer")
    cli.ok("right", "grant", "ann", "rover", "viewer")
    reason = "a URL with the level operator needs that level; user 'ann' is viewer on this robot"
    assert reason in cli.fails(*create, "operator")
    assert cli.json("foxglove-url", "list") == []
    cli.json(*create, "viewer")
    cli.ok("right", "grant", "ann", "rover", "viewer", "--allow", "call:/reset")
    cli.json(*create, "operator")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("rover", "eve"), "no user"),
        (("tank", "ann"), "no robot"),
        (("rover", "ann", "--ttl", "10s"), "one minute"),
        (("rover", "ann", "--ttl", "60w"), "366 days"),
        (("rover", "bob@lab1"), "does not belong to the realm"),
    ],
)
def test_a_url_that_cannot_be_made_has_the_reason(rover: Any, arguments: tuple[str, ...], words: str) -> None:
    rover.ok("realm", "add", "lab1")
    rover.ok("user", "add", "bob@lab1", "--no-password")
    assert words in rover.fails("foxglove-url", "create", *arguments)
