"""``switchboard stop`` and ``switchboard resume``: through the relay, or in the database when none runs."""

from __future__ import annotations

import sys
import time
from collections.abc import Collection
from typing import Any
from uuid import uuid4

import click

from relay_db import queries
from relay_db.names import full_name_of
from relay_protocol.errors import SwitchboardError, Unavailable
from relay_protocol.limits import REASON_LENGTH
from relay_server.cli.admin_socket_client import NoRelay, send_order
from relay_server.cli.app import (
    REFUSED,
    UNREACHABLE,
    App,
    examples,
    json_option,
    os_user,
    pass_app,
    why_option,
)
from relay_server.cli.output import print_json, print_note, print_result


@click.command(
    epilog=examples(
        "switchboard stop rover",
        "switchboard stop mobile@lab2",
        'switchboard stop rover --why "a person is under it"',
        "switchboard stop --all",
    )
)
@click.argument("robot", required=False)
@click.option("--all", "all_robots", is_flag=True, help="Every robot of this relay, in all realms.")
@why_option
@json_option
@pass_app
def stop(app: App, robot: str | None, all_robots: bool, why: str, as_json: bool) -> None:
    """Stop ROBOT. It stays stopped until it is resumed.

    A robot that is offline is stopped as soon as it comes back, even if no relay runs now. The same holds for an order
    that the relay does not confirm within some seconds.
    """
    if (robot is None) is not all_robots:
        raise click.UsageError("name a robot, or give --all")
    result, unanswered = _StopOrder(app, None if robot is None else full_name_of(robot), why).send()
    if as_json:
        print_json({"robots": result})
    else:
        for each in result:
            print_result(False, each, _outcome_text(each))
        if not result:
            print_result(False, result, "There are no robots.")
    if unanswered:
        sys.exit(UNREACHABLE)
    if any("reason" in each for each in result):
        sys.exit(REFUSED)


@click.command(epilog=examples("switchboard resume rover", 'switchboard resume rover --why "all clear"'))
@click.argument("robot")
@why_option
@json_option
@pass_app
def resume(app: App, robot: str, why: str, as_json: bool) -> None:
    """Let ROBOT move again. It stays still until it gets a command.

    A stop that the robot has not received is cancelled. A robot that has confirmed its stop must be online.
    """
    robot = full_name_of(robot)
    try:
        send_order(app.data, "resume", {"robot": robot, "why": why, "by": os_user()})
    except NoRelay:
        _cancel_stop(app, robot, why)
    print_result(as_json, {"robot": robot, "resumed": True}, f"Robot {robot} may move again.")


class _StopOrder:
    """One order to stop, sent to the relay and stored in the database when the relay does not confirm it.

    :param robot: its name, as ``mobile@lab2``; ``None`` for all
    """

    def __init__(self, app: App, robot: str | None, why: str) -> None:
        self._app = app
        self._robot = robot
        self._why = why[:REASON_LENGTH]
        self._stop_id = uuid4().hex
        self._stored: list[dict[str, Any]] = []

    def send(self) -> tuple[list[dict[str, Any]], bool]:
        """The outcome for each robot, and whether the relay failed to confirm.

        :raises SwitchboardError: the order could neither be sent nor stored
        """
        order = {"robot": self._robot, "why": self._why, "by": os_user(), "stop_id": self._stop_id}
        try:
            answer = send_order(self._app.data, "stop", order, self._store_meanwhile)
        except NoRelay:
            return self._store(), False
        except Unavailable as error:
            return self._unconfirmed(error), True
        result = [each for each in answer.get("robots") or () if isinstance(each, dict)]
        missed = answer.get("missed")
        if not missed:
            return result, False
        print_note(f"Not all robots have the order yet: {missed}. Their orders are stored now.")
        return result + self._store({str(each.get("robot")) for each in result}), False

    def _store_meanwhile(self, seconds: float) -> None:
        try:
            self._stored = self._store()
        except Unavailable as error:
            print_note(
                f"The relay has not answered for {seconds:g} s, and the order cannot be stored: {error}"
            )
        else:
            print_note(
                f"The relay has not answered for {seconds:g} s. The order is stored until it is confirmed."
            )

    def _unconfirmed(self, error: Unavailable) -> list[dict[str, Any]]:
        try:
            stored = self._stored or self._store()
        except SwitchboardError:
            raise error from None
        reason = f"not confirmed: {error}. The order is stored; the next relay that runs sends it"
        return [{**each, "reason": reason} for each in stored]

    def _store(self, result: Collection[str] = ()) -> list[dict[str, Any]]:
        """Store the order for the next relay that runs, or for one on another machine, which sends it at
        once.

        :param result: names of robots that need no order
        """
        stored = []
        with self._app.change() as change:
            robots = (
                queries.list_robots(change.session) if self._robot is None else [change.robot(self._robot)]
            )
            for each in robots:
                if each.full not in result:
                    new = queries.store_stop_once(
                        change.session, each.id, os_user(), self._why, time.time(), self._stop_id
                    )
                    if new:
                        change.audit("robot.stopped", each.full, why=self._why)
                    stored.append({"robot": each.full, "done": False})
        return stored


def _cancel_stop(app: App, robot: str, why: str) -> None:
    """:raises NotFound: no such robot
    :raises Unavailable: without a relay there is nothing to cancel
    """
    with app.change() as change:
        found = change.robot(robot)
        if not queries.delete_stop(change.session, found.id):
            raise Unavailable(
                "no relay runs on this data folder, and no stop of this robot is waiting to be sent; "
                "a stop that the robot has confirmed can be resumed only while it is online"
            )
        change.audit("robot.resumed", found.full, why=why)


def _outcome_text(result: dict[str, Any]) -> str:
    robot = str(result.get("robot", "?"))
    if result.get("done"):
        return f"Robot {robot} is stopped."
    if "reason" in result:
        # The reason of a stop that was done in part is a sentence about the robot.
        reason = str(result["reason"])
        return f"{reason[:1].upper()}{reason[1:]}" if result.get("stopped") else f"Robot {robot}: {reason}"
    return f"Robot {robot} will be stopped as soon as it can be reached."
