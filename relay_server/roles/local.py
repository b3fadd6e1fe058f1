"""Commands to Roles by the command line on the relay's machine."""

from __future__ import annotations

from typing import NamedTuple

from relay_db import queries
from relay_protocol.errors import NotFound
from relay_protocol.realms import split_name
from relay_server.access import Principal
from relay_server.common.database import AsyncDatabase
from relay_server.roles.commands import RoleCommands, RoleUser
from relay_server.roles.runs import RoleRuns


class LocalRoles(NamedTuple):
    """Commands by the command line on the relay's machine, by the rights of a user."""

    commands: RoleCommands
    runs: RoleRuns
    database: AsyncDatabase

    async def user(self, name: str, earliest_sent: int | None) -> RoleUser:
        """The user of this full name.

        :raises NotFound: there is none
        """
        found = await self.database.read(queries.find_user, *split_name(name))
        if found is None:
            raise NotFound(f"there is no user '{name}'; name the user by whose rights it is done")
        return RoleUser(Principal.of_user(found), "local", earliest_sent)
