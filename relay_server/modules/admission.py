"""Users of a robot's modules that are admitted for one request."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from relay_server.access import Principal
from relay_server.modules.service import ModuleUser, user_of
from relay_server.sessions.manager import SessionManager


@asynccontextmanager
async def admitted_user(
    sessions: SessionManager, principal: Principal, robot: str, address: str
) -> AsyncIterator[ModuleUser]:
    """A user of a robot for one request.

    :raises NotFound: no such robot, or no right on it
    """
    async with sessions.admitted(principal, robot, address) as admission:
        yield user_of(admission.robot, admission.permit, address)
