"""``switchboard stop`` and ``switchboard resume``: through the relay where one runs, else for when it does."""

from __future__ import annotations

import sys
import time
from typing import Any

import click

from relay_db import queries
from relay_protocol.errors import Unavailable
from relay_server.cli.app import App, examples, json_option, os_user, pass_app, why_option
from relay_server.cli.failure import REFUSED
from relay_server.cli.output import show_json, tell
from relay_server.cli.relaysocket import NoRelay, order_motion


@click.command(
    epilog=examples(
        "switchboard stop rover",
        'switchboard stop rover --why "somebody is under it"',
        "switchboard stop --all",
    )
)
@click.argument("robot", required=False)
@click.option("--all", "everything", is_flag=True, help="Every robot of this relay.")
@why_option
@json_option
@pass_app
def stop(app: App, robot: str | None, everything: bool, why: str, as_json: bool) -> None:
    """Stop ROBOT, and keep it stopped until somebody resumes it.

    A robot that is offline is stopped before anything else when it comes back, also when no relay runs now.
    """
    if (robot is None) is not everything:
        raise click.UsageError("name a robot, or say --all")
    told = _stop(app, robot, why)
    if as_json:
        show_json({"robots": told})
    else:
        for each in told:
            tell(False, each, _words(each))
        if not told:
            tell(False, told, "There is no robot.")
    if any("reason" in each for each in told):
        sys.exit(REFUSED)


@click.command(epilog=examples("switchboard resume rover", 'switchboard resume rover --why "all clear"'))
@click.argument("robot")
@why_option
@json_option
@pass_app
def resume(app: App, robot: str, why: str, as_json: bool) -> None:
    """Let ROBOT move again. It stands until somebody commands it.

    A stop that a robot was not told of is taken back. One that it has confirmed it keeps, so it must be online.
    """
    try:
        order_motion(app.data, "resume", {"robot": robot, "why": why, "by": os_user()})
    except NoRelay:
        _take_back(app, robot, why)
    tell(as_json, {"robot": robot, "resumed": True}, f"Robot {robot} may move again.")


def _stop(app: App, robot: str | None, why: str) -> list[dict[str, Any]]:
    try:
        answer = order_motion(app.data, "stop", {"robot": robot, "why": why, "by": os_user()})
    except NoRelay:
        return _keep(app, robot, why)
    return [each for each in answer.get("robots") or () if isinstance(each, dict)]


def _keep(app: App, robot: str | None, why: str) -> list[dict[str, Any]]:
    """No relay runs here: robots are told by the next that does, or by one on another machine at once."""
    told = []
    with app.change() as change:
        robots = queries.list_robots(change.session) if robot is None else [change.robot(robot)]
        for each in robots:
            queries.order_stop(change.session, each.id, os_user(), why, time.time(), tell=True)
            change.audit("robot.stopped", each.name, why=why)
            told.append({"robot": each.name, "done": False})
    return told


def _take_back(app: App, robot: str, why: str) -> None:
    """:raises NotFound: no such robot
    :raises Unavailable: there is nothing that could be taken back without a relay
    """
    with app.change() as change:
        found = change.robot(robot)
        if not queries.stop_told(change.session, found.id):
            raise Unavailable(
                "no relay runs on this data folder, and no stop of this robot waits to be told; "
                "what the robot has confirmed can be resumed only while it is online"
            )
        change.audit("robot.resumed", found.name, why=why)


def _words(told: dict[str, Any]) -> str:
    robot = str(told.get("robot", "?"))
    if told.get("done"):
        return f"Robot {robot} is stopped."
    if "reason" in told:
        return f"Robot {robot}: {told['reason']}"
    return f"Robot {robot} can't be reached now; it will be stopped before anything else when it is back."
