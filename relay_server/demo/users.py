"""Users, robots and rights of the demo."""

from __future__ import annotations

import secrets
from dataclasses import dataclass

from relay_db import queries
from relay_db.engine import Database
from relay_protocol.rights import Level
from relay_server.auth import passwords
from relay_server.demo.home import HOME
from relay_server.demo.robots import ROBOTS

USERS = ("admin", "driver", "viewer")


@dataclass(frozen=True)
class DemoUser:
    name: str
    password: str
    may: str


def prepare(database: Database, home: bool) -> list[DemoUser]:
    """Create users, robots and rights of the demo. In a folder that was used before, users get new passwords.

    :param home: whether the simulated home is one of the robots
    """
    database.upgrade()
    logins = [DemoUser(name, secrets.token_urlsafe(9), _MAY[name]) for name in USERS]
    with database.begin() as session:
        for login in logins:
            hashed = passwords.hash_password(login.password)
            found = queries.find_user(session, login.name)
            if found is None:
                queries.add_user(session, login.name, hashed, admin=login.name == "admin")
            else:
                queries.set_password(session, found.id, hashed)
        for name in ROBOTS:
            if queries.find_robot(session, name) is None:
                queries.add_robot(session, name, f"Simulated robot {name.partition('-')[2]}")
        if home and queries.find_robot(session, HOME) is None:
            queries.add_robot(session, HOME, "Simulated home")
        for user, robot, level in (*_RIGHTS, *(_HOME_RIGHTS if home else ())):
            to, on = queries.find_user(session, user), queries.find_robot(session, robot)
            assert to is not None and on is not None
            queries.grant_right(session, on.id, level, user_id=to.id)
    return logins


_MAY = {
    "admin": "everything",
    "driver": "operator on robot-one",
    "viewer": "viewer on both robots",
}
_RIGHTS = (
    ("driver", "robot-one", Level.OPERATOR),
    ("viewer", "robot-one", Level.VIEWER),
    ("viewer", "robot-two", Level.VIEWER),
)
_HOME_RIGHTS = (("driver", HOME, Level.OPERATOR), ("viewer", HOME, Level.VIEWER))
