"""``switchboard status``."""

from __future__ import annotations

import time
from typing import Any

import click

from relay_server.cli.app import App, examples, json_option, pass_app
from relay_server.cli.output import say, show_json, table
from relay_server.cli.relaysocket import ask_status
from relay_server.cli.text import duration


@click.command(epilog=examples("switchboard status", "switchboard --data /srv/switchboard status --json"))
@json_option
@pass_app
def status(app: App, as_json: bool) -> None:
    """Show which robots are online, and with whom. Asks the relay that runs on the data folder."""
    answer = ask_status(app.data)
    if as_json:
        show_json(answer)
        return
    uptime = answer.get("uptime_s")
    since = f", up {duration(uptime)}" if isinstance(uptime, int | float) else ""
    say(f"Relay {answer.get('relay', '?')}{since}")
    robots = [each for each in answer.get("robots") or [] if isinstance(each, dict)]
    if not robots:
        say("No robot has dialled in yet; 'switchboard robot list' shows which may.")
        return
    table(("robot", "state", "with", "round trip"), [_row(each, time.time()) for each in robots])


def _row(robot: dict[str, Any], now: float) -> tuple[str, str, str, str]:
    clients = [each for each in robot.get("clients") or [] if isinstance(each, dict)]
    rtt = robot.get("rtt_ms")
    return (
        str(robot.get("name", "?")),
        str(robot.get("state", "?")),
        "; ".join(_client(each, now) for each in clients) or "–",
        f"{rtt:.1f} ms" if isinstance(rtt, int | float) else "–",
    )


def _client(client: dict[str, Any], now: float) -> str:
    since = client.get("since")
    span = f" for {duration(max(0.0, now - since))}" if isinstance(since, int | float) else ""
    return f"{client.get('user', '?')} from {client.get('address', '?')}{span}"
