"""``switchboard stop`` and ``switchboard resume``: through the relay where one runs, else for when it does."""

from __future__ import annotations

import sys
import time
from collections.abc import Collection
from typing import Any

import click

from relay_db import queries
from relay_db.names import full_name_of
from relay_protocol.errors import SwitchboardError, Unavailable
from relay_server.cli.app import App, examples, json_option, os_user, pass_app, why_option
from relay_server.cli.control_socket import NoRelay, order_motion
from relay_server.cli.failure import REFUSED, UNREACHABLE
from relay_server.cli.output import say_aside, show_json, tell


@click.command(
    epilog=examples(
        "switchboard stop rover",
        "switchboard stop mobile@lab2",
        'switchboard stop rover --why "somebody is under it"',
        "switchboard stop --all",
    )
)
@click.argument("robot", required=False)
@click.option("--all", "everything", is_flag=True, help="Every robot of this relay, of all realms.")
@why_option
@json_option
@pass_app
def stop(app: App, robot: str | None, everything: bool, why: str, as_json: bool) -> None:
    """Stop ROBOT, and keep it stopped until somebody resumes it.

    A robot that is offline is stopped before anything else when it comes back, also when no relay runs now. An order
    that the relay does not confirm within some seconds is kept in the same way.
    """
    if (robot is None) is not everything:
        raise click.UsageError("name a robot, or say --all")
    told, unanswered = _StopOrder(app, None if robot is None else full_name_of(robot), why).give()
    if as_json:
        show_json({"robots": told})
    else:
        for each in told:
            tell(False, each, _words(each))
        if not told:
            tell(False, told, "There is no robot.")
    if unanswered:
        sys.exit(UNREACHABLE)
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
    robot = full_name_of(robot)
    try:
        order_motion(app.data, "resume", {"robot": robot, "why": why, "by": os_user()})
    except NoRelay:
        _take_back(app, robot, why)
    tell(as_json, {"robot": robot, "resumed": True}, f"Robot {robot} may move again.")


class _StopOrder:
    """One order to stop: given to the relay, and kept in the database where that does not confirm it.

    :param robot: its name, as ``mobile@lab2``; ``None`` for all
    """

    def __init__(self, app: App, robot: str | None, why: str) -> None:
        self._app = app
        self._robot = robot
        self._why = why
        self._kept: list[dict[str, Any]] = []

    def give(self) -> tuple[list[dict[str, Any]], bool]:
        """What became of it on each robot, and whether somebody who should have answered did not.

        :raises SwitchboardError: it could be neither given nor kept
        """
        order = {"robot": self._robot, "why": self._why, "by": os_user()}
        try:
            answer = order_motion(self._app.data, "stop", order, self._unsure)
        except NoRelay:
            return self._keep(), False
        except Unavailable as error:
            return self._unconfirmed(error), True
        told = [each for each in answer.get("robots") or () if isinstance(each, dict)]
        missed = answer.get("missed")
        if not missed:
            return told, False
        say_aside(f"Not all robots are told yet: {missed}. Their orders are kept now.")
        return told + self._keep({str(each.get("robot")) for each in told}), False

    def _unsure(self, seconds: float) -> None:
        """The relay has not answered for so long."""
        try:
            self._kept = self._keep()
        except Unavailable as error:
            say_aside(f"The relay has not answered for {seconds:g} s, and the order can't be kept: {error}")
        else:
            say_aside(
                f"The relay has not answered for {seconds:g} s. The order is kept until it is confirmed."
            )

    def _unconfirmed(self, error: Unavailable) -> list[dict[str, Any]]:
        try:
            kept = self._kept or self._keep()
        except SwitchboardError:
            raise error from None
        reason = f"not confirmed: {error}. The order is kept, and told by the next relay that runs"
        return [{**each, "reason": reason} for each in kept]

    def _keep(self, told: Collection[str] = ()) -> list[dict[str, Any]]:
        """Robots are told by the next relay that runs, or by one on another machine at once.

        :param told: names of those that need not be
        """
        kept = []
        with self._app.change() as change:
            robots = (
                queries.list_robots(change.session) if self._robot is None else [change.robot(self._robot)]
            )
            for each in robots:
                if each.full not in told:
                    queries.order_stop(change.session, each.id, os_user(), self._why, time.time(), tell=True)
                    change.audit("robot.stopped", each.full, why=self._why)
                    kept.append({"robot": each.full, "done": False})
        return kept


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
        change.audit("robot.resumed", found.full, why=why)


def _words(told: dict[str, Any]) -> str:
    robot = str(told.get("robot", "?"))
    if told.get("done"):
        return f"Robot {robot} is stopped."
    if "reason" in told:
        return f"Robot {robot}: {told['reason']}"
    return f"Robot {robot} can't be reached now; it will be stopped before anything else when it is back."
