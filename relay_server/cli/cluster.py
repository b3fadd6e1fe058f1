"""``switchboard cluster`` and ``switchboard drain``: the relays that serve the same robots."""

from __future__ import annotations

import time
from typing import Any

import click

from relay_server.cli.admin_socket_client import send_order
from relay_server.cli.app import App, examples, json_option, pass_app
from relay_server.cli.output import format_duration, print_json, print_note, print_result, print_table

POLL_SECONDS = 0.5
_COLUMNS = ("relay", "state", "version", "up", "robots", "homes", "clients", "forwarded", "CPU %", "lag")
_NONE = "–"


@click.group(epilog=examples("switchboard cluster status", "switchboard cluster status --json"))
def cluster() -> None:
    """Show the relays of a cluster; see also 'switchboard drain'."""


@cluster.command(epilog=examples("switchboard cluster status", "switchboard cluster status --json"))
@json_option
@pass_app
def status(app: App, as_json: bool) -> None:
    """Show the relays, their robots and clients, and how loaded they are.

    Asks the relay that runs on the data folder, which asks the others. 'homes' are robots that belong to a relay by the
    database, 'robots' those that it says are connected. 'lag' is the age of the newest change of rights that it may not
    have read yet.
    """
    answer = send_order(app.data, "cluster", {})
    if as_json:
        print_json(answer)
        return
    print_table(_COLUMNS, [_row(each) for each in answer["relays"]])
    if not answer["bus"]:
        print_note("The bus does not answer: the other relays are as this one last saw them.")


def _row(relay: dict[str, Any]) -> tuple[str, ...]:
    load = relay.get("load")
    figures = [_NONE] * 5
    if load is not None:
        figures = [str(load["robots"]), str(load["clients"]), str(load["forwarded"])]
        figures += [f"{100 * load['cpu']:.0f}", f"{load['lag_s']:.1f} s"]
    return (
        relay["address"] + (" (this)" if relay["own"] else ""),
        relay["state"],
        relay["version"],
        format_duration(relay["uptime_s"]),
        figures[0],
        str(relay["homes"]),
        *figures[1:],
    )


@click.command(
    epilog=examples(
        "switchboard drain", "switchboard --data /srv/switchboard drain && systemctl stop switchboard"
    )
)
@json_option
@pass_app
def drain(app: App, as_json: bool) -> None:
    """Have the robots of this relay connect to the other relays of its cluster, one after another, then its clients.

    Returns once they have been asked and had 10 s to do so. The relay takes no more robots afterwards, and /readyz
    answers 503. It goes on for clients that connect to it nevertheless. SIGTERM drains it too, before it ends.
    """
    state = send_order(app.data, "drain", {})
    while not state.get("done"):
        print_note(f"{state.get('robots')} robots are still connected to this relay.")
        time.sleep(POLL_SECONDS)
        state = send_order(app.data, "drain", {})
    print_result(as_json, state, "This relay is drained; it can be stopped.")
