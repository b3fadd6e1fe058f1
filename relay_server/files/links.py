"""The file links of all robots: one of each, opened when its robot asks for it."""

from __future__ import annotations

from typing import Protocol

from relay_protocol import link
from relay_server.files.uploads import Uploads
from relay_server.robots.registry import RobotState
from relay_server.robots.tickets import Tickets


class OpenFileConnection(Protocol):
    """The connection of a file link."""

    def close(self, reason: str) -> None:
        """Send ``bye`` and end the connection."""


class FileLinks:
    """The file links of all robots.

    :param uploads: receives what comes over them
    :param tickets: with which robots join their links
    """

    def __init__(self, uploads: Uploads, tickets: Tickets[RobotState]) -> None:
        self.uploads = uploads
        self._tickets = tickets
        self._open: dict[int, OpenFileConnection] = {}

    def request(self, robot: RobotState) -> None:
        """The robot asks for a link: give it a ticket."""
        if robot.control_link is not None:
            robot.control_link.send(link.OpenFileLink(ticket=self._tickets.issue(robot)))

    def redeem(self, ticket: str, connection: OpenFileConnection) -> RobotState | None:
        """The robot that joins with a ticket, whose older link ends; ``None`` if the ticket is for something else."""
        robot = self._tickets.redeem(ticket)
        if robot is not None:
            self.close(robot, "the robot opened a newer link")
            self._open[robot.robot_id] = connection
        return robot

    def close(self, robot: RobotState, reason: str) -> None:
        """End a robot's link: its control link is lost, or its key is not accepted any more."""
        connection = self._open.pop(robot.robot_id, None)
        self._tickets.withdraw(robot)
        if connection is not None:
            connection.close(reason)
