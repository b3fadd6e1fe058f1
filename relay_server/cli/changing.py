"""Changes by the command line: all realms, by full names, on record with who is at the machine."""

from __future__ import annotations

from sqlalchemy.orm import Session

from relay_db.queries import GroupRecord, RobotRecord, UserRecord
from relay_server.administration.change import Change
from relay_server.cli.app import group_of, os_user, robot_of, user_of


class LocalChange(Change):
    """A change by who may run ``switchboard`` on the relay's machine."""

    def __init__(self, session: Session) -> None:
        super().__init__(session, f"cli:{os_user()}", "local")

    def user(self, name: str) -> UserRecord:
        """:raises NotFound: no such user"""
        return user_of(self.session, name)

    def group(self, name: str) -> GroupRecord:
        """:raises NotFound: no such group"""
        return group_of(self.session, name)

    def robot(self, name: str) -> RobotRecord:
        """:raises NotFound: no such robot"""
        return robot_of(self.session, name)
